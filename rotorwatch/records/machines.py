"""Machines: description, configuration, and detectable changes."""

from pydantic import Field, JsonValue

from rotorwatch.records.example import example
from rotorwatch.records.fields import (
    EXAMPLE_NS,
    BundleIdentity,
    MachineHash,
    OfMachine,
    ParameterName,
    ParameterText,
    Record,
)
from rotorwatch.records.health import State


class Channel(Record):
    """One column of a machine's stream."""

    name: str = Field(description="name of the channel, unique in the stream", examples=["y1"])
    quantity: str = Field(
        description="displacement, velocity, acceleration, tilt, tilt_rate or shaft_angle", examples=["displacement"]
    )
    location: str = Field(
        description="bearing, disc or shaft; or a place with another name, at which only levels are watched",
        examples=["bearing"],
    )
    direction: str = Field(description="y, z or rotation; or another one, such as X with an angle", examples=["y"])
    unit: str = Field(description="unit of the samples", examples=["um"])
    angle_deg: float | None = Field(
        default=None,
        description="angle of the sensor's axis from +y towards +z; null if `direction` defines the axis",
        examples=[None],
    )


class MachineDescription(OfMachine):
    """A monitored machine: description, state, channels of its stream, and keys of its topics."""

    description: str = Field(description="as in the machine file", examples=["Rotor kit with an overhung disc"])
    state: State
    speed_rpm: float | None = Field(
        description="nominal speed, null where the machine file gives none", examples=[1320.0]
    )
    rate_hz: float = Field(description="samples per second and channel", examples=[2000.0])
    channels: tuple[Channel, ...] = Field(description="columns of the stream", examples=[(example(Channel),)])
    window_length_s: float = Field(description="length of the sliding window", examples=[60.0])
    window_hop_s: float = Field(description="data time between reports", examples=[5.0])
    keys: dict[str, str] = Field(
        description="Zenoh keys by name",
        examples=[{"stream": "rotorwatch/demo/lab/stream", "health": "rotorwatch/demo/lab/health"}],
    )
    bundle: BundleIdentity
    machine_hash: MachineHash


class MachineList(Record):
    """Every monitored machine."""

    machines: tuple[MachineDescription, ...] = Field(description="in the order of the settings")


class MachineConfiguration(OfMachine):
    """Machine file and bundle with which a machine is monitored."""

    file: dict[str, JsonValue] = Field(
        description="the machine file, with defaults filled in", examples=[{"site": "demo", "name": "lab"}]
    )
    bundle: BundleIdentity
    machine_hash: MachineHash


class DetectableParameter(Record):
    """Smallest changes of one parameter that can be found, and the data needed to find a requested one."""

    name: ParameterName
    text: ParameterText
    loss: float = Field(description="smallest relative change downwards found in one window", examples=[-0.025])
    gain: float = Field(description="smallest relative change upwards found in one window", examples=[0.026])
    length_s: float | None = Field(
        description="length of data needed to find the requested `change`; null if none is requested", examples=[16.0]
    )


class DetectableChanges(OfMachine):
    """Changes that would be found with 95 % probability on this machine as it runs now."""

    window_end_ns: int | None = Field(description="end of the window this is computed from", examples=[EXAMPLE_NS])
    window_length_s: float = Field(description="length of the window", examples=[60.0])
    false_alarms_per_month: float = Field(description="false-alarm rate declared in the machine file", examples=[1.0])
    change: float | None = Field(description="requested relative change; null if none is requested", examples=[-0.05])
    parameters: tuple[DetectableParameter, ...] = Field(description="one entry per parameter that can be read")
    reason: str = Field(description="why there is no entry; empty otherwise", examples=[""])
    bundle: BundleIdentity
    machine_hash: MachineHash
