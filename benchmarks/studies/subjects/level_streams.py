"""Streams for the study of levels: machines as lines of rotation in coloured noise, and a rolling-bearing defect.

Random numbers are independent for each purpose in `At`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import scipy

from models.machine import MachineFile
from models.signals.block import FloatArray, SampleBlock
from simulator.stream import DEFAULT_START_NS

BLOCK_S = 1.0
_ORDERS = np.arange(1.0, 4.0)


class At(IntEnum):
    """Purpose of random numbers."""

    CONDITION = 0
    REFERENCE = 1
    EVALUATION = 2


def generator(seed: int, case: int, number: int, at: At) -> np.random.Generator:
    """Random numbers of one stream for one purpose."""
    return np.random.default_rng([seed, case, number, at])


@dataclass(frozen=True, slots=True)
class Kind:
    """Machines with sensors of one kind."""

    quantity: str
    unit: str
    size: float  # typical 1x amplitude, in the unit
    rate_hz: float
    rotation: str  # source of the running speed: ``phase reference``, ``nominal``, or empty if unknown
    schedule: tuple[float, float] | None = None
    """Length and period of snapshots, s; None for continuous samples."""
    window_s: float = 60.0


KINDS = {
    "accelerometers, speed in the machine file": Kind("acceleration", "m/s2", 1.0, 5120.0, "nominal"),
    "accelerometers, speed unknown": Kind("acceleration", "m/s2", 1.0, 5120.0, ""),
    "velocity sensors, speed in the machine file": Kind("velocity", "mm/s", 1.0, 2560.0, "nominal"),
    "proximity probes, phase reference": Kind("displacement", "um", 15.0, 2560.0, "phase reference"),
}


@dataclass(frozen=True, slots=True)
class Gains:
    """Factors on the lines and the noise of each channel."""

    lines: FloatArray  # for 1x, 2x and 3x of each channel, shape (3, n)
    noise: FloatArray  # shape (n,) or (n_samples, n)


Course = Callable[[FloatArray], Gains]  # gains at times, s from the first sample


def steady(_: FloatArray) -> Gains:
    """Unit gains, for a healthy machine."""
    return Gains(np.ones((3, 2)), np.ones(2))


@dataclass(frozen=True, slots=True)
class Defect:
    """A damaged raceway at the first sensor: impacts that excite a resonance; the second sensor gets a fifth of it.

    The rms of the response grows exponentially from a fiftieth to twenty times the healthy overall rms of its channel.
    """

    begins_s: float
    growth_s: float
    rolling_hz: float
    resonance_hz: float
    damping: float

    def size(self, t: FloatArray) -> FloatArray:
        """Rms of the response over the healthy overall rms."""
        grown = 0.02 * 1000.0 ** np.clip((t - self.begins_s) / self.growth_s, 0, 1)
        return np.where(t < self.begins_s, 0.0, grown)

    def overall(self, t: float) -> float:
        """Overall rms over the healthy one."""
        return float(np.hypot(1.0, self.size(np.array(t))))


@dataclass(frozen=True, slots=True)
class Scene:
    """One machine with two sensors, at DE and NDE or at right angles, and its vibration."""

    kind: Kind
    machine: MachineFile
    speed_hz: float
    lines: FloatArray
    phases: FloatArray
    noise: FloatArray
    poles: FloatArray  # poles of the first-order filters that colour the noise, shape (2,)
    defect: Defect | None = field(default=None)

    def blocks(self, rng: np.random.Generator, seconds: float, course: Course) -> Iterator[SampleBlock]:
        """Simulate the stream from its first sample on."""
        block_s, period_s = self.kind.schedule or (BLOCK_S, BLOCK_S)
        rate_hz, size = self.kind.rate_hz, round(block_s * self.kind.rate_hz)
        kept = [np.zeros(1) for _ in self.poles]
        bearing = None if self.defect is None else _Impacts(self.defect, rate_hz, rng)
        healthy = np.sqrt((self.lines**2).sum(axis=0) / 2 + self.noise**2)
        start_rad = float(rng.uniform(0, 2 * np.pi))
        for number in range(round(seconds / period_s)):
            t = number * period_s + np.arange(size) / rate_hz
            theta = start_rad + 2 * np.pi * self.speed_hz * t
            gains = course(t)
            columns = []
            for column, pole in enumerate(self.poles.tolist()):
                white = np.sqrt(1 - pole**2) * rng.standard_normal(size)
                noise, kept[column] = scipy.signal.lfilter([1.0], [1.0, -pole], white, zi=kept[column])
                angles = np.outer(_ORDERS, theta) + self.phases[:, column, None]
                lines = (self.lines * gains.lines)[:, column] @ np.cos(angles)
                columns.append(lines + gains.noise[..., column] * self.noise[column] * noise)
            if bearing is not None:
                response = bearing.response(t)
                columns = [x + part * rms * response for x, part, rms in zip(columns, (1, 0.2), healthy, strict=True)]
            if self.kind.rotation == "phase reference":
                columns.append(np.mod(theta, 2 * np.pi))
            yield SampleBlock(
                run=1,
                sequence=number,
                start_ns=DEFAULT_START_NS + round(number * period_s * 1e9),
                rate_hz=rate_hz,
                samples=np.column_stack(columns).astype(np.float32),
            )


class _Impacts:
    """Response of a resonance to impacts with 1 % random slip of their spacing; its rms is `Defect.size`."""

    def __init__(self, defect: Defect, rate_hz: float, rng: np.random.Generator) -> None:
        self._defect, self._rate_hz, self._rng = defect, rate_hz, rng
        omega = 2 * np.pi * defect.resonance_hz / rate_hz
        radius = np.exp(-defect.damping * omega)
        self._poles = [1.0, -2 * radius * np.cos(omega), radius**2]
        impulse = scipy.signal.lfilter([1.0], self._poles, np.eye(1, round(0.1 * rate_hz))[0])
        self._scale = float(np.sqrt(rate_hz / (defect.rolling_hz * (impulse @ impulse))))
        self._kept = np.zeros(2)
        self._next_s = 0.0

    def response(self, t: FloatArray) -> FloatArray:
        """Response at the times of the next samples."""
        impacts = np.zeros(t.size)
        silence = t[0] - 0.5 / self._rate_hz - self._next_s
        self._next_s += max(0.0, np.ceil(silence * self._defect.rolling_hz)) / self._defect.rolling_hz
        while self._next_s < t[0] + t.size / self._rate_hz - 0.5 / self._rate_hz:
            impacts[min(t.size - 1, max(0, round((self._next_s - t[0]) * self._rate_hz)))] += self._scale
            self._next_s += (1 + 0.01 * float(self._rng.standard_normal())) / self._defect.rolling_hz
        found, self._kept = scipy.signal.lfilter([1.0], self._poles, impacts * self._defect.size(t), zi=self._kept)
        return np.asarray(found, dtype=np.float64)


def _file(kind: Kind, speed_rpm: float) -> MachineFile:
    places = ("DE", "45L"), ("DE", "45R")
    if kind.quantity != "displacement":
        places = ("DE", "horizontal"), ("NDE", "vertical")
    sensors = [
        {"name": f"{at}-{way}", "quantity": kind.quantity, "location": at, "direction": way, "unit": kind.unit}
        for at, way in places
    ]
    if kind.rotation == "phase reference":
        angle = {"name": "theta", "quantity": "shaft_angle", "location": "shaft", "direction": "rotation"}
        sensors.append(angle | {"unit": "rad"})
    content = {"site": "study", "name": "machine", "rate_hz": kind.rate_hz, "sensors": sensors}
    if kind.schedule is None:
        content["window"] = {"length_s": kind.window_s, "max_span_s": 1.5 * kind.window_s}
    else:
        content["schedule"] = {"on_s": kind.schedule[0], "every_s": kind.schedule[1]}
    if kind.rotation == "nominal":
        content["operation"] = {"speed_rpm": speed_rpm}
    return MachineFile.model_validate(content)


def drawn(kind: Kind, rng: np.random.Generator, noise_over_1x: tuple[float, float] = (0.3, 3.0)) -> Scene:
    """Draw a machine: nominal speed 900 to 3600 rpm, actual speed within 1 % of it; 2x is 0.1 to 1 times 1x."""
    nominal_rpm = round(float(rng.uniform(900, 3600)))
    of_1x = np.stack([np.ones(2), _spread(rng, 0.1, 1.0), _spread(rng, 0.05, 0.3)])
    lines = kind.size * _spread(rng, 0.5, 2.0) * of_1x
    return Scene(
        kind,
        _file(kind, nominal_rpm),
        nominal_rpm / 60 * float(rng.uniform(0.99, 1.01)),
        lines,
        rng.uniform(0, 2 * np.pi, (3, 2)),
        lines[0] / np.sqrt(2) * _spread(rng, *noise_over_1x),
        rng.uniform(0.0, 0.9, 2),
    )


def _spread(rng: np.random.Generator, low: float, high: float) -> FloatArray:
    """Log-uniform random numbers for both channels."""
    return np.exp(rng.uniform(np.log(low), np.log(high), 2))
