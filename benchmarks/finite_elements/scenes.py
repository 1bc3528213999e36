"""Random conditions of a finite-element rotor: places, colour and level of the forces, speed, noise."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from benchmarks.finite_elements.assembly import assemble, place, probed, unbalance_response
from benchmarks.finite_elements.forces import Force, covariance_under
from benchmarks.finite_elements.observed import RunCondition
from benchmarks.finite_elements.rotor import BeamRotor


class SourceLayout(StrEnum):
    """Layout of the stochastic forces."""

    ONE_SOURCE = "one source"
    """One source that acts at all bearings and discs in both planes with random signs and weights."""
    INDEPENDENT = "independent sources"
    """An independent source of random level at every bearing and disc in each plane."""


@dataclass(frozen=True, slots=True)
class SceneRange:
    """Limits of the uniform distributions from which conditions are drawn."""

    cutoff_hz: tuple[float, float] = (25.0, 200.0)
    stochastic_to_1x: tuple[float, float] = (0.7, 3.0)  # displacement of the measured disc, rms over rms
    noise_relative: tuple[float, float] = (0.01, 0.05)
    speed_relative: tuple[float, float] = (0.99, 1.01)  # over nominal


COMMISSIONED = SceneRange(cutoff_hz=(80.0, 80.0), stochastic_to_1x=(1.5, 1.5), noise_relative=(0.02, 0.02))
"""A single cutoff and level, as in one healthy recording."""


def drawn_condition(
    rotor: BeamRotor, layout: SourceLayout, limits: SceneRange, changes: dict[str, float], rng: np.random.Generator
) -> RunCondition:
    """Draw a condition; force levels are set for the linear, unchanged rotor, so a change alters only the rotor.

    Raises EstimationError if the rotor is unstable.
    """
    speed_rad_s = rotor.speed_rad_s * float(rng.uniform(*limits.speed_relative))
    cutoff_hz = float(rng.uniform(*limits.cutoff_hz))
    ratio = float(rng.uniform(*limits.stochastic_to_1x))
    nodes = [*(bearing.node for bearing in rotor.bearings), *(disc.node for disc in rotor.discs)]
    places = [place(rotor, node, plane) for plane in ("y", "z") for node in nodes]
    if layout is SourceLayout.ONE_SOURCE:
        weights = rng.standard_normal(len(places))
        share = tuple(zip(places, (weights / np.linalg.norm(weights)).tolist(), strict=True))
        unit: tuple[Force, ...] = (Force(cutoff_hz, 1.0, share),)
    else:
        unit = tuple(Force(cutoff_hz, float(rng.uniform(0.3, 1.0)), ((at, 1.0),)) for at in places)
    disc = [probed(rotor)[1], probed(rotor)[3]]
    whirl = unbalance_response(rotor, speed_rad_s)[disc]
    variance = np.diag(covariance_under(assemble(rotor, speed_rad_s), unit))[disc]
    level = ratio * float(np.sqrt(np.sum(np.abs(whirl) ** 2) / 2 / np.sum(variance)))
    coloured = bool(rng.random() < 0.5)
    corner_hz = float(np.exp(rng.uniform(np.log(50), np.log(500))))
    return RunCondition(
        forces=tuple(replace(force, rms_N=force.rms_N * level) for force in unit),
        speed_rad_s=speed_rad_s,
        changes=changes,
        noise_relative=float(rng.uniform(*limits.noise_relative)),
        noise_corner_hz=corner_hz if coloured else None,
    )
