"""Effects on a rotor's measured motion of faults other than changes of the diagnosed parameters.

Forces and changed supports are applied to the healthy motion through the rotor's frequency response, which is exact for
a linear rotor; sensor faults are applied to the measured motion. Rubs and cracks are simulated in the plant instead.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.finite_elements.assembly import ComplexArray
from models.levels.bands import NYQUIST_PART
from models.signals.block import FloatArray

MOTIONS = (("bearing", "y"), ("disc", "y"), ("bearing", "z"), ("disc", "z"))
_BEARING_Y, _DISC_Y, _BEARING_Z, _DISC_Z = range(4)


@dataclass(frozen=True, slots=True)
class Rotor:
    """Properties of a rotor at its speed that faults need."""

    speed_hz: float
    rate_hz: float
    response: Callable[[FloatArray], ComplexArray]
    """Frequency response of displacements to forces at `MOTIONS`, at n frequencies, Hz: shape (n, 4, 4), m/N."""
    bearing: tuple[float, float]  # stiffness, N/m, and damping, Ns/m, of the measured bearing, mean of both planes


@dataclass(frozen=True, slots=True)
class Seen:
    """Measured motion, SI: displacements and velocities at `MOTIONS`, and the shaft angle."""

    displacement: FloatArray  # (n_samples, 4)
    velocity: FloatArray  # (n_samples, 4)
    angle_rad: FloatArray

    def plus(self, displacement: FloatArray, velocity: FloatArray) -> "Seen":
        """The sum with further motion."""
        return replace(self, displacement=self.displacement + displacement, velocity=self.velocity + velocity)


def _of_1x(seen: Seen) -> float:
    """1x displacement amplitude of the bearing, rms over both directions, m."""
    q = 2 * (seen.displacement * np.exp(-1j * seen.angle_rad)[:, None]).mean(axis=0)
    return float(np.sqrt((abs(q[_BEARING_Y]) ** 2 + abs(q[_BEARING_Z]) ** 2) / 2))


def line(rotor: Rotor, seen: Seen, order: float, force: ComplexArray, part: float, start_rad: float) -> Seen:
    """Add a force at an order of the speed, scaled so that the bearing moves by `part` of its 1x."""
    response = rotor.response(np.array([order * rotor.speed_hz]))[0] @ force
    at_bearing = np.sqrt((abs(response[_BEARING_Y]) ** 2 + abs(response[_BEARING_Z]) ** 2) / 2)
    q = part * _of_1x(seen) / at_bearing * response
    wave = np.exp(1j * (order * np.unwrap(seen.angle_rad) + start_rad))[:, None] * q
    return seen.plus(wave.real, (2j * np.pi * order * rotor.speed_hz * wave).real)


def _lines(rotor: Rotor, seen: Seen, rng: np.random.Generator, orders: Mapping[float, float], size: float) -> Seen:
    """Add forces at the bearing at several orders, with the given fractions of 1x, times `size`."""
    for order, part in orders.items():
        force = np.zeros(4, dtype=np.complex128)
        force[[_BEARING_Y, _BEARING_Z]] = rng.standard_normal(2) + 1j * rng.standard_normal(2)
        seen = line(rotor, seen, order, force, size * part, float(rng.uniform(0, 2 * np.pi)))
    return seen


def _at_order(low: float, high: float, parts: tuple[float, float]) -> "Change":
    def fault(rotor: Rotor, seen: Seen, rng: np.random.Generator) -> Seen:
        return _lines(rotor, seen, rng, {float(rng.uniform(low, high)): 1.0}, _size(rng, *parts))

    return fault


def _whirl(rotor: Rotor, seen: Seen, rng: np.random.Generator) -> Seen:
    force = np.array([1, 0, -1j, 0], dtype=np.complex128)
    order = float(rng.uniform(0.40, 0.48))
    return line(rotor, seen, order, force, _size(rng, 0.5, 2.0), float(rng.uniform(0, 2 * np.pi)))


def _looseness(rotor: Rotor, seen: Seen, rng: np.random.Generator) -> Seen:
    return _lines(rotor, seen, rng, {0.5: 0.5, 1.5: 0.5, 2.0: 0.7, 2.5: 0.3, 3.0: 0.5, 4.0: 0.2}, _size(rng, 0.5, 1.5))


def _gear(rotor: Rotor, seen: Seen, rng: np.random.Generator) -> Seen:
    """Gear mesh of 13 to 23 teeth with a sideband on either side; sizes are relative to the bearing's velocity at 1x.

    There are fewer teeth if the mesh would lie above 0.4 of the sampling rate, where levels are not measured.
    """
    most = int(NYQUIST_PART * rotor.rate_hz / 2 / rotor.speed_hz) - 1
    teeth = float(min(int(rng.integers(13, 24)), most))
    return _lines(
        rotor, seen, rng, {teeth: 1 / teeth, teeth - 1: 0.3 / teeth, teeth + 1: 0.3 / teeth}, _size(rng, 0.5, 2.0)
    )


def _raceway(rotor: Rotor, seen: Seen, rng: np.random.Generator) -> Seen:
    """Impacts 3 to 5 times per revolution, with a velocity of 0.5 to 1.5 times the bearing's overall rms."""
    n = len(seen.angle_rad)
    times = np.cumsum((1 + 0.01 * rng.standard_normal(n // 8)) / (rotor.speed_hz * rng.uniform(3, 5))) * rotor.rate_hz
    impulses = np.zeros(n)
    impulses[times[times < n].astype(int)] = 1.0
    moved = _through(rotor, impulses, _BEARING_Y)
    scale = _size(rng, 0.5, 1.5) * seen.velocity[:, _BEARING_Y].std() / moved[1][:, _BEARING_Y].std()
    return seen.plus(scale * moved[0], scale * moved[1])


def _through(rotor: Rotor, force: FloatArray, at: int) -> tuple[FloatArray, FloatArray]:
    """Displacements and velocities under a periodic force."""
    f = _bins(len(force), rotor)
    spectrum = rotor.response(f)[:, :, at] * np.fft.rfft(force)[:, None]
    return _in_time(spectrum, len(force)), _in_time(2j * np.pi * f[:, None] * spectrum, len(force))


def _bins(count: int, rotor: Rotor) -> FloatArray:
    return np.asarray(np.fft.rfftfreq(count, 1 / rotor.rate_hz), dtype=np.float64)


def _in_time(spectrum: ComplexArray, count: int) -> FloatArray:
    return np.asarray(np.fft.irfft(spectrum, count, axis=0), dtype=np.float64)


def _soft_foundation(rotor: Rotor, seen: Seen, rng: np.random.Generator) -> Seen:
    """Foundation of the bearing: a mass on a spring 2 to 4 times as stiff as the bearing, tuned to 0.7 to 3x."""
    n = len(seen.angle_rad)
    f = _bins(n, rotor)
    omega = 2 * np.pi * f
    k, c = rotor.bearing
    own = k + 1j * omega * c
    stiffness = k * float(rng.uniform(2, 4))
    natural = 2 * np.pi * rotor.speed_hz * float(rng.uniform(0.7, 3))
    below = stiffness * (1 - (omega / natural) ** 2 + 0.1j * omega / natural)
    lost = own * below / (own + below) - own
    G, at = rotor.response(f), [_BEARING_Y, _BEARING_Z]
    moved = np.fft.rfft(seen.displacement[:, at], axis=0)
    held = np.linalg.solve(np.eye(2) + lost[:, None, None] * G[:, at][:, :, at], moved[:, :, None])
    more = -(G[:, :, at] @ (lost[:, None, None] * held))[:, :, 0]
    more[0] = 0
    return seen.plus(_in_time(more, n), _in_time(1j * omega[:, None] * more, n))


def _runout(_: Rotor, seen: Seen, rng: np.random.Generator) -> Seen:
    """Run-out of the disc's surface: 1x to 4x in its displacements only, with the phase between the two probes."""
    size = _of_1x(seen) * _size(rng, 0.3, 1.0)
    added = np.zeros_like(seen.displacement)
    for order in range(1, 5):
        q = size / order * np.exp(2j * np.pi * rng.random())
        added[:, _DISC_Y] += (q * np.exp(1j * order * seen.angle_rad)).real
        added[:, _DISC_Z] += (q * np.exp(1j * order * (seen.angle_rad - np.pi / 2))).real
    return seen.plus(added, np.zeros_like(added))


def _wrong_gain(_: Rotor, seen: Seen, rng: np.random.Generator) -> Seen:
    """Gain of all sensors of one location and direction wrong by 15 to 30 %."""
    factor = np.ones(4)
    factor[rng.integers(4)] = 1 + rng.choice([-1, 1]) * rng.uniform(0.15, 0.3)
    return replace(seen, displacement=seen.displacement * factor, velocity=seen.velocity * factor)


def _tones(rotor: Rotor, seen: Seen, rng: np.random.Generator) -> Seen:
    """Replace the vibration by 1x and a sine, with random phases in every channel, scaled by its standard deviation."""
    omega = 2 * np.pi * rotor.speed_hz * float(rng.uniform(0.3, 3))
    t = np.arange(len(seen.angle_rad)) / rotor.rate_hz
    turns = np.unwrap(seen.angle_rad)
    motion, rate = np.zeros_like(seen.displacement), np.zeros_like(seen.velocity)
    for angle, omega_ in ((turns, 2 * np.pi * rotor.speed_hz), (omega * t, omega)):
        wave = seen.displacement.std(axis=0) * np.exp(1j * (angle[:, None] + 2 * np.pi * rng.random(4)))
        motion, rate = motion + wave.real, rate + (1j * omega_ * wave).real
    return replace(seen, displacement=motion, velocity=rate)


def _noise(slope: float) -> "Change":
    def fault(rotor: Rotor, seen: Seen, rng: np.random.Generator) -> Seen:
        """Independent noise in every channel, with a power spectrum falling with frequency to the power `slope`."""
        n = len(seen.angle_rad)
        f = _bins(n, rotor)
        shape = np.where(f > 0.5, np.maximum(f, 0.5) ** (-slope / 2), 0.0)[:, None]
        found = []
        for of in (seen.displacement, seen.velocity):
            noise = _in_time(shape * np.fft.rfft(rng.standard_normal(of.shape), axis=0), n)
            found.append(noise * of.std(axis=0) / noise.std(axis=0))
        return replace(seen, displacement=found[0], velocity=found[1])

    return fault


def _copied(rotor: Rotor, seen: Seen, rng: np.random.Generator) -> Seen:
    """Replace the disc's motion in y by the bearing's, delayed by 0.1 to 0.5 revolutions."""
    late = round(float(rng.uniform(0.1, 0.5)) * rotor.rate_hz / rotor.speed_hz)
    motion, rate = seen.displacement.copy(), seen.velocity.copy()
    for of in (motion, rate):
        of[:, _DISC_Y] = np.roll(of[:, _BEARING_Y], late)
    return replace(seen, displacement=motion, velocity=rate)


def _size(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def as_simulated(_rotor: Rotor, seen: Seen, _rng: np.random.Generator) -> Seen:
    """Return the motion unchanged, because the fault (if any) is already simulated."""
    return seen


Change = Callable[[Rotor, Seen, np.random.Generator], Seen]  # effect of a fault on the motion of a rotor

RUBS = {"rub, light": (0.5, 2.0), "rub, intermittent": (3.0, 1.6), "rub, heavy": (2.0, 1.0)}
"""Contact stiffness over the shaft's, and clearance over the disc's radial rms."""
CRACK = "breathing crack"
ANOTHER = "no rotor: another one"
HEALTHY = "none"
FAULTS: Mapping[str, Change] = {
    **dict.fromkeys((HEALTHY, *RUBS, CRACK), as_simulated),
    "soft foundation": _soft_foundation,
    "2x forcing": _at_order(2, 2, (0.3, 1.0)),
    "3x forcing": _at_order(3, 3, (0.3, 1.0)),
    "subharmonic whirl": _whirl,
    "loose bearing cap": _looseness,
    "gear mesh": _gear,
    "rolling-element defect": _raceway,
    "electrical run-out": _runout,
    "neighbour's line": _at_order(0.6, 1.7, (0.5, 1.5)),
    "wrong gain of a place": _wrong_gain,
    "no rotor: tones": _tones,
    "no rotor: white noise": _noise(0.0),
    "no rotor: 1/f noise": _noise(1.0),
    "no rotor: a copied channel": _copied,
    ANOTHER: as_simulated,
}
"""Faults by name; their index is part of the seed."""
