"""The overhung rotor of `benchmarks.finite_elements`, for tests that must not depend on six degrees of freedom."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from benchmarks.finite_elements import observed
from benchmarks.finite_elements.assembly import probed
from benchmarks.finite_elements.forces import Force
from benchmarks.finite_elements.machines import rotor_named
from benchmarks.finite_elements.motion import PROBES
from benchmarks.finite_elements.rotor import BeamRotor
from models.diagnosis.window.moments import Plan
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import FloatArray

ROTOR = replace(rotor_named("overhung"), speed_rad_s=2 * np.pi * 24.0)


@dataclass(frozen=True)
class Excitation:
    cutoff_hz: float = 80.0
    sources: tuple[tuple[float, float, float, float], ...] = ((0.6, 0.5, 0.4, -0.5),)
    """Force of each source at bearing y, disc y, bearing z, disc z."""
    level_N: float = 4.0


OTHER = Excitation(50.0, ((0.7, 0, 0, 0), (0, 0.5, 0, 0), (0, 0, 0.6, 0), (0, 0, 0, 0.8)))


def simulate(
    rotor: BeamRotor,
    excitation: Excitation,
    duration_s: float,
    seed: int,
    *,
    noise: float = 0.01,
    noise_corner_hz: float | None = None,
) -> FloatArray:
    """Samples of `PROBES` and the shaft angle, shape (n_samples, 13); noise is relative to each channel's rms."""
    forces = tuple(
        Force(excitation.cutoff_hz, excitation.level_N, tuple(zip(probed(rotor), source, strict=True)))
        for source in excitation.sources
    )
    condition = observed.RunCondition(forces, rotor.speed_rad_s, {}, noise, noise_corner_hz)
    return observed.sampled(rotor, condition, duration_s, seed, PROBES)


SIZES = observed.WindowSizes(length_s=30.0, hop_s=2.5, segment_s=2.5)


def windows_under(
    rotor: BeamRotor, run: observed.RunCondition, count: int, seed: int, change: Callable[[FloatArray], object] = len
) -> list[WindowStatistics]:
    """Consecutive windows of 30 s of samples that `change` may alter in place."""
    sizes = observed.plan(rotor, SIZES)
    samples = observed.sampled(rotor, run, 30.0 * count + sizes.preamble / sizes.rate_hz + 0.1, seed)
    change(samples)
    return observed.windows_of(samples, sizes)


def plan(hops: int = 12, states: tuple[str, ...] = observed.MOTION, speed_rad_s: float | None = None) -> Plan:
    """A plan for some columns of these samples; given a speed to look for, it has no shaft angle."""
    made = observed.plan(ROTOR, observed.WindowSizes(length_s=5.0 * hops), states)
    columns = np.array([PROBES.index(name) for name in states])
    angle_column = len(PROBES) if speed_rad_s is None else None
    return replace(made, columns=columns, angle_column=angle_column, speed_rad_s=speed_rad_s)


@cache
def recorded(
    rotor: BeamRotor, excitation: Excitation, seed: int, count: int = 1, **noise: float
) -> tuple[WindowStatistics, ...]:
    """Consecutive windows of one minute."""
    return tuple(observed.windows_of(simulate(rotor, excitation, 60.0 * count + 3, seed, **noise), plan()))


def of_states(window: WindowStatistics, states: tuple[str, ...]) -> WindowStatistics:
    at = [window.states.index(name) for name in states]
    return replace(
        window, states=states, correlation=window.correlation[:, at][:, :, at],
        hop_correlation=window.hop_correlation[:, :, at][:, :, :, at], spectrum=window.spectrum[:, at][:, :, at],
        synchronous=None if window.synchronous is None else window.synchronous[at],
    )  # fmt: skip
