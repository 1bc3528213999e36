"""The scenario file: what happens to a simulated machine, and how well its sensors measure it.

Every field carries its unit in its name; unknown keys are refused. ``docs/scenario.md`` explains each field.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Literal, Self

from pydantic import BaseModel, Field, model_validator

from models.errors import MachineFileError
from models.machine import Machine, load_machine
from models.mistakes import checked, did_you_mean, read_toml
from models.physics.excitation import Source
from models.physics.rotor import PARAMETERS
from models.signals.channels import Channel, Quantity

_SHIPPED = Path(__file__).parent / "scenarios"
_FAULT = re.compile(r"(?P<parameter>\w+)=(?P<change>[-+.\deE]+)@(?P<at_s>[.\deE]+)")
SensorFault = Literal["offset", "gain", "noise_relative", "stuck", "dropout", "clip", "delay", "swapped", "none"]
# Kinds of sensor fault that have a value.
SENSOR_FAULTS_WITH_VALUE = ("offset", "gain", "noise_relative", "clip", "delay")
# Faults that no diagnosed parameter describes, and the largest size of each.
ANOMALIES: Mapping[str, float] = MappingProxyType({"crack": 0.8, "rub": 10.0, "added_mass": 10.0})
LONGEST_DELAY_S = 1.0  # of a sensor
_WITH_RAMP = ("offset", "gain", "noise_relative")


class NamedSource(Source, extra="forbid", frozen=True, allow_inf_nan=False):
    """An independent source of coloured force, with a name for events to refer to."""

    name: str = Field(min_length=1, max_length=64, description="unique name, as events refer to it")


class SensorSettings(BaseModel, extra="forbid", frozen=True, allow_inf_nan=False):
    """How one sensor turns the true value into samples: (value + noise) · gain + offset, rounded to a step."""

    noise_relative: float = Field(
        default=0.0, ge=0, le=100, description="rms of the noise over the channel's own theoretical rms at the start"
    )
    noise_corner_hz: float | None = Field(
        default=None, gt=0, le=1e6, description="corner of first-order coloured noise; white if left out"
    )
    offset_SI: float = Field(default=0.0, description="added to every sample: m, m/s, rad or rad/s")
    gain: float = Field(default=1.0, description="factor on every sample, 1 = true")
    step_SI: float = Field(default=0.0, ge=0, description="quantisation step: m, m/s, rad or rad/s; 0 = none")


class ChannelSettings(BaseModel, extra="forbid", frozen=True, allow_inf_nan=False):
    """Settings of one channel; those left out are taken from the settings of all channels."""

    noise_relative: float | None = Field(default=None, ge=0, le=100)
    noise_corner_hz: float | None = Field(default=None, gt=0, le=1e6)
    offset_SI: float | None = None
    gain: float | None = None
    step_SI: float | None = Field(default=None, ge=0)


class Sensors(SensorSettings):
    """Settings of all vibration channels, and exceptions by channel name."""

    channels: dict[str, ChannelSettings] = Field(default={}, description="exceptions by channel name")

    def settings(self, channel: Channel) -> SensorSettings:
        """Return the settings that hold for one channel.

        The common settings describe vibration sensors. A shaft angle is ideal unless it has its own entry, because a
        noise level relative to the rms does not suit both.
        """
        own = self.channels.get(channel.name, ChannelSettings()).model_dump(exclude_none=True)
        common = {} if channel.quantity is Quantity.SHAFT_ANGLE else self.model_dump(exclude={"channels"})
        return SensorSettings.model_validate({**common, **own})


class Rub(BaseModel, extra="forbid", frozen=True, allow_inf_nan=False):
    """Where the disc may touch the casing; the contact's stiffness is the size of the event that starts the rub."""

    clearance_m: float = Field(gt=0, le=0.1, description="radial clearance around the disc's position at rest")
    friction: float = Field(default=0.1, ge=0, le=1, description="sliding friction coefficient")


class Event(BaseModel, extra="forbid", frozen=True, allow_inf_nan=False):
    """One change at one time: of a parameter, the speed, the excitation, a source, a sensor, or outside the model."""

    at_s: float = Field(ge=0)  # start of the change, data seconds from the first sample
    ramp_s: float = Field(default=0.0, ge=0)  # duration of the change; 0 is a step. Ramps advance in steps of 0.1 s
    # One of k_by, c_by, k_bz, c_bz, e, EI, and its change from the *original* machine.
    parameter: str | None = None
    relative_change: float | None = Field(default=None, gt=-1, le=100)
    speed_rpm: float | None = Field(default=None, gt=0, le=1e6)  # new speed
    # Name of a source, and exactly one new setting of it.
    source: str | None = None
    cutoff_hz: float | None = Field(default=None, gt=0, le=1e5)
    force_rms_N: float | None = Field(default=None, ge=0, le=1e9)
    direction: tuple[float, float, float, float, float, float] | None = None
    # Factor on the white noise that drives all sources; 1 at the start.
    excitation_level: float | None = Field(default=None, ge=0, le=1e3)
    # "crack", "rub" or "added_mass", and its size: relative loss of the shaft's bending stiffness across the open
    # crack; stiffness of the contact over the shaft's 3EI/L³; relative increase of the disc's mass. 0 is none.
    anomaly: str | None = None
    size: float | None = Field(default=None, ge=0)
    # Channel name, kind of fault ("none" ends all faults of the channel), and its value: in the SI unit of the channel
    # for offset and clip, a plain ratio for gain and noise_relative, seconds for delay.
    sensor: str | None = None
    sensor_fault: SensorFault | None = None
    value_SI: float | None = None
    swapped_with: str | None = None  # the other channel of a swap, of the same quantity and unit

    @model_validator(mode="after")
    def _one_change(self) -> Self:
        allowed = {
            "parameter": ("relative_change",),
            "speed_rpm": (),
            "source": ("cutoff_hz", "force_rms_N", "direction"),
            "sensor": ("sensor_fault", "value_SI", "swapped_with"),
            "excitation_level": (),
            "anomaly": ("size",),
        }
        kinds = [name for name in allowed if getattr(self, name) is not None]
        if len(kinds) != 1:
            found = " and ".join(kinds) or "none"
            raise ValueError(f"expected exactly one of {', '.join(allowed)}; found {found}")
        for kind, fields in allowed.items():
            stray = [field for field in fields if kind != kinds[0] and getattr(self, field) is not None]
            if stray:
                raise ValueError(f"{stray[0]} belongs to an event with {kind}, this one has {kinds[0]}")
        self._check_parameter()
        self._check_source()
        self._check_sensor()
        self._check_anomaly()
        return self

    def _check_parameter(self) -> None:
        if self.parameter is None:
            return
        if self.parameter not in PARAMETERS:
            hint = did_you_mean(self.parameter, PARAMETERS)
            raise ValueError(f"parameter {self.parameter!r} is not one of {', '.join(PARAMETERS)}{hint}")
        if self.relative_change is None:
            raise ValueError(f"change of parameter {self.parameter} without relative_change")

    def _check_source(self) -> None:
        if self.source is None:
            return
        given = [name for name in ("cutoff_hz", "force_rms_N", "direction") if getattr(self, name) is not None]
        if len(given) != 1:
            wrong = f"expected exactly one of cutoff_hz, force_rms_N, direction; found {' and '.join(given) or 'none'}"
            raise ValueError(f"change of source {self.source!r}: {wrong}")

    def _check_anomaly(self) -> None:
        if self.anomaly is None:
            return
        if self.anomaly not in ANOMALIES:
            hint = did_you_mean(self.anomaly, ANOMALIES)
            raise ValueError(f"anomaly {self.anomaly!r} is not one of {', '.join(ANOMALIES)}{hint}")
        if self.size is None:
            raise ValueError(f"anomaly {self.anomaly} without size")
        if self.size > ANOMALIES[self.anomaly]:
            most = ANOMALIES[self.anomaly]
            raise ValueError(f"size of anomaly {self.anomaly} is {self.size}, expected 0 to {most:g}")

    def _check_sensor(self) -> None:
        if self.sensor is None:
            return
        if self.sensor_fault is None:
            raise ValueError(f"sensor {self.sensor!r} without sensor_fault")
        for field, kinds in (("value_SI", SENSOR_FAULTS_WITH_VALUE), ("swapped_with", ("swapped",))):
            needed = self.sensor_fault in kinds
            if needed != (getattr(self, field) is not None):
                raise ValueError(f"sensor_fault {self.sensor_fault!r} {'needs' if needed else 'has no'} {field}")
        if self.swapped_with == self.sensor:
            raise ValueError(f"swapped_with is {self.swapped_with!r}, expected another channel than {self.sensor!r}")
        if self.sensor_fault == "delay" and not 0 <= (self.value_SI or 0.0) <= LONGEST_DELAY_S:
            raise ValueError(
                f"value_SI of sensor_fault 'delay' is {self.value_SI}, expected 0 to {LONGEST_DELAY_S:g} s"
            )
        if self.sensor_fault in ("noise_relative", "clip") and (self.value_SI or 0.0) < 0:
            raise ValueError(f"value_SI of sensor_fault {self.sensor_fault!r} is {self.value_SI}, expected 0 or more")
        if self.ramp_s > 0 and self.sensor_fault not in _WITH_RAMP:
            raise ValueError(f"sensor_fault {self.sensor_fault!r} cannot ramp, only {', '.join(_WITH_RAMP)} can")


class Scenario(BaseModel, extra="forbid", frozen=True, allow_inf_nan=False):
    """A machine, its excitation, the errors of its sensors, and what happens when."""

    name: str = Field(default="scenario", description="name shown in truth records; the file's name if left out")
    description: str = ""
    machine: str = Field(min_length=1, description="shipped machine, or path of a machine file beside the scenario")
    seed: int = Field(ge=0, description="seed of all random numbers; the same seed gives the same samples")
    duration_s: float = Field(gt=0, le=1e8, description="data seconds from first to last sample")
    sources: tuple[NamedSource, ...] = Field(default=(), max_length=16)
    sensors: Sensors = Sensors()
    rub: Rub | None = Field(default=None, description="needed where an event is a rub")
    events: tuple[Event, ...] = ()

    @model_validator(mode="after")
    def _references(self) -> Self:
        names = [source.name for source in self.sources]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"source name occurs twice: {', '.join(twice)}")
        for number, event in enumerate(self.events):
            if event.source is not None and event.source not in names:
                known = ", ".join(names) or "none"
                hint = did_you_mean(event.source, names)
                raise ValueError(f"events.{number}.source: {event.source!r} is not among the sources ({known}){hint}")
            if event.anomaly == "rub" and self.rub is None:
                raise ValueError(f"events.{number}.anomaly: a rub needs the table [rub] with its clearance_m")
            if event.at_s + event.ramp_s > self.duration_s:
                end_s = event.at_s + event.ramp_s
                raise ValueError(f"events.{number}: ends at {end_s:g} s, after duration_s {self.duration_s:g}")
        return self

    def check_channels(self, machine: Machine) -> None:
        """Check that every channel the scenario names is one of the machine's, and that swaps are possible.

        Channels of different quantities or units cannot be swapped. Raises `MachineFileError`.
        """
        known = {channel.name: channel for channel in machine.sensors}
        named = [(f"sensors.channels.{name}", name) for name in self.sensors.channels]
        for field in ("sensor", "swapped_with"):
            of_events = [(number, getattr(event, field)) for number, event in enumerate(self.events)]
            named += [(f"events.{number}.{field}", name) for number, name in of_events if name is not None]
        for field, name in named:
            if name not in known:
                raise MachineFileError(
                    f"scenario {self.name}: {field}: {name!r} is not a channel of machine {machine.name} "
                    f"({', '.join(known)}){did_you_mean(name, known)}"
                )
        for number, event in enumerate(self.events):
            if event.sensor is None or event.swapped_with is None:
                continue
            one, other = known[event.sensor], known[event.swapped_with]
            if (one.quantity, one.unit) != (other.quantity, other.unit):
                found = f"{other.name} is a {other.quantity} in {other.unit}"
                expected = f"expected a {one.quantity} in {one.unit} like {one.name}"
                raise MachineFileError(f"scenario {self.name}: events.{number}.swapped_with: {found}, {expected}")

    def overridden(
        self, *, seed: int | None = None, duration_s: float | None = None, faults: Sequence[Event] = ()
    ) -> "Scenario":
        """Return the scenario with another seed or duration and with events added, checked again.

        Raises `MachineFileError` if the result is not a valid scenario (an event after the new end, say).
        """
        others = {"seed": seed, "duration_s": duration_s}
        fields = self.model_dump() | {name: value for name, value in others.items() if value is not None}
        return checked(Scenario, fields | {"events": [one.model_dump() for one in (*self.events, *faults)]}, self.name)


def shipped_scenarios() -> tuple[str, ...]:
    """Names of the scenarios that come with the program."""
    return tuple(sorted(entry.stem for entry in _SHIPPED.glob("*.toml")))


def load_scenario(name_or_path: str | Path) -> tuple[Scenario, Machine]:
    """Load a scenario by path, or a shipped one by name, together with the machine it names.

    A path of a machine file is relative to the scenario file. Raises `MachineFileError` if either cannot be used.
    """
    path = _locate(name_or_path, Path())
    fields = _merged(path, ())
    fields.setdefault("name", path.stem)
    scenario = checked(Scenario, fields, path)
    beside = path.parent / scenario.machine
    try:
        machine = load_machine(beside if beside.suffix == ".toml" else scenario.machine)
        scenario.check_channels(machine)
    except MachineFileError as error:
        raise MachineFileError(f"{path}: {error}") from error
    return scenario, machine


def parse_fault(text: str) -> Event:
    """Turn ``PARAMETER=RELATIVE_CHANGE@AT_SECONDS`` into an event.

    Raises
    ------
    MachineFileError
        If the text does not have this form or names no parameter.

    Examples
    --------
    >>> parse_fault("k_by=-0.25@140").relative_change
    -0.25
    """
    match = _FAULT.fullmatch(text.strip())
    if match is None:
        raise MachineFileError(f"fault {text!r}: expected PARAMETER=CHANGE@SECONDS, for example k_by=-0.25@140")
    fields = {"parameter": match["parameter"], "relative_change": match["change"], "at_s": match["at_s"]}
    return checked(Event, fields, f"fault {text!r}")


def _locate(name_or_path: str | Path, folder: Path) -> Path:
    shipped = _SHIPPED / f"{name_or_path}.toml"
    if str(name_or_path) in shipped_scenarios():
        return shipped
    path = folder / name_or_path
    if not path.is_file():
        known = [*shipped_scenarios(), *(entry.name for entry in path.parent.glob("*.toml"))]
        names, hint = ", ".join(shipped_scenarios()), did_you_mean(path.name, known)
        raise MachineFileError(f"{path}: no such scenario file; shipped scenarios: {names}{hint}")
    return path


def _merged(path: Path, seen: tuple[Path, ...]) -> dict[str, object]:
    """Fields of a file on top of those it extends: tables are merged key by key, anything else is replaced."""
    if path.resolve() in seen:
        raise MachineFileError(f"{path}: extends itself, directly or through another scenario")
    own = read_toml(path)
    base_name = own.pop("extends", None)
    if base_name is None:
        return own
    if not isinstance(base_name, str):
        raise MachineFileError(f"{path}: extends: expected the name or path of a scenario (found {base_name!r})")
    try:
        base = _merged(_locate(base_name, path.parent), (*seen, path.resolve()))
    except MachineFileError as error:
        raise MachineFileError(f"{path}: extends: {error}") from error
    base = {key: value for key, value in base.items() if key not in {"name", "description"}}
    for key, value in own.items():
        below = base.get(key)
        base[key] = {**below, **value} if isinstance(below, dict) and isinstance(value, dict) else value
    return base
