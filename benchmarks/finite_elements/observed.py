"""Measurements of a finite-element rotor: samples, windows of the monitor, a stream, a machine file."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from scipy.signal import lfilter

from benchmarks.finite_elements.forces import Force
from benchmarks.finite_elements.motion import PROBES, move
from benchmarks.finite_elements.rotor import BeamRotor, changed_rotor
from models.diagnosis.window.moments import Plan, plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import MachineFile
from models.signals.block import FloatArray, SampleBlock
from models.signals.channels import ChannelDescriptor

RATE_HZ = 2000.0
SITE = "beams"
MOTION = PROBES[:8]
"""Displacement and velocity of bearing and disc in both planes, measured by default."""

_START_NS = 1_767_225_600_000_000_000
_UNITS = {"displacement": "um", "velocity": "mm/s", "acceleration": "m/s2"}


@dataclass(frozen=True, slots=True)
class RunCondition:
    """Operating and measuring conditions of a rotor."""

    forces: tuple[Force, ...]
    speed_rad_s: float
    changes: Mapping[str, float] = field(default_factory=dict)  # relative changes of `rotor.CHANGEABLE`
    noise_relative: float = 0.02  # rms over each channel's own rms
    noise_corner_hz: float | None = None  # corner of first-order coloured noise; None for white noise


@dataclass(frozen=True, slots=True)
class WindowSizes:
    """Window, hop and segment, s, and the band of the spectra, Hz."""

    length_s: float = 60.0
    hop_s: float = 5.0
    segment_s: float = 5.0
    band_hz: tuple[float, float] = (3.0, 150.0)


def sampled(
    rotor: BeamRotor,
    condition: RunCondition,
    duration_s: float,
    seed: int | list[int],
    probes: tuple[str, ...] = MOTION,
) -> FloatArray:
    """Simulated samples of all probes in SI, and the shaft angle last; shape (n_samples, n_probes + 1).

    Raises EstimationError if the rotor is unstable.
    """
    motion_rng, noise_rng = np.random.default_rng(seed).spawn(2)
    changed = changed_rotor(rotor, condition.changes)
    motion = move(changed, condition.speed_rad_s, condition.forces, duration_s, RATE_HZ, motion_rng)
    seen = motion.values[:, [PROBES.index(name) for name in probes]]
    noise = _noise(seen.shape, condition.noise_corner_hz, noise_rng)
    seen = seen + condition.noise_relative * seen.std(axis=0) * noise
    return np.column_stack([seen, np.mod(motion.angle_rad, 2 * np.pi)])


def _noise(shape: tuple[int, int], corner_hz: float | None, rng: np.random.Generator) -> FloatArray:
    white = rng.standard_normal(shape)
    if corner_hz is None:
        return white
    memory = float(np.exp(-2 * np.pi * corner_hz / RATE_HZ))
    innovation = float(np.sqrt(1 - memory**2))
    carried = white[:1] * (1 - innovation)  # the first sample has the full variance
    return np.asarray(lfilter([innovation], [1.0, -memory], white, axis=0, zi=carried)[0], dtype=np.float64)


def machine_of(
    rotor: BeamRotor, sizes: WindowSizes, probes: tuple[str, ...] = MOTION, *, phase_reference: bool = True
) -> MachineFile:
    """Machine file with channels in usual units, rate and window only, without parameters of the rotor."""
    sensors = [_channel(name) for name in probes]
    if phase_reference:
        theta = {"name": "theta", "quantity": "shaft_angle", "location": "shaft", "direction": "rotation"}
        sensors.append(theta | {"unit": "rad"})
    fields = {
        "site": SITE,
        "name": rotor.name,
        "description": f"{rotor.description}; its parameters are not given",
        "rate_hz": RATE_HZ,
        "window": {**asdict(sizes), "max_span_s": 1.5 * sizes.length_s},
        "sensors": sensors,
    }
    return MachineFile.model_validate(fields)


def _channel(probe: str) -> dict[str, str]:
    place, _, rate = probe.partition("_")
    quantity = {"": "displacement", "dot": "velocity", "ddot": "acceleration"}[rate]
    location = "bearing" if place[1] == "1" else "disc"
    unit = _UNITS[quantity]
    return {"name": probe, "quantity": quantity, "location": location, "direction": place[0], "unit": unit}


def plan(rotor: BeamRotor, sizes: WindowSizes, probes: tuple[str, ...] = MOTION) -> Plan:
    """Plan of the monitor's sliding window for SI samples from `sampled`."""
    monitored = plan_for(machine_of(rotor, sizes, probes))
    return replace(monitored, scales=np.ones(len(monitored.states)))


def windows_of(samples: FloatArray, sizes: Plan) -> list[WindowStatistics]:
    """Non-overlapping windows of a run."""
    sliding, found = SlidingWindow(sizes), []
    for number, _ in enumerate(sliding.feed(sizes.to_si(samples), _START_NS), start=1):
        statistics = sliding.statistics() if number % sizes.hops == 0 else None
        if statistics is not None:
            found.append(statistics)
    return found


def blocks(samples: FloatArray, described: ChannelDescriptor, block_s: float = 0.5) -> Iterator[SampleBlock]:
    """Convert samples from `sampled` to the stream that a live machine would send."""
    factors = np.array([channel.to_si for channel in described.channels])
    scaled = np.asarray(samples / factors, dtype=np.float32)
    if described.states[-1] == "theta":
        scaled[:, -1] = np.where(scaled[:, -1] >= 2 * np.pi, 0.0, scaled[:, -1])
    length = round(block_s * described.rate_hz)
    for sequence, first in enumerate(range(0, len(scaled), length)):
        start = _START_NS + round(first * 1e9 / described.rate_hz)
        yield SampleBlock(start, sequence, 1, described.rate_hz, scaled[first : first + length])
