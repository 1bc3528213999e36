"""Coloured forces at any coordinates of a rotor, and the stationary covariance of its response.

The colour is that of `models.physics.excitation`: white noise through a Butterworth low-pass.
"""

from dataclasses import dataclass

import numpy as np

from benchmarks.finite_elements.assembly import Equations
from models.physics.excitation import ColouringFilter, Source, colouring_filter
from models.physics.response import advance, discretise, stationary_covariance
from models.signals.block import FloatArray


@dataclass(frozen=True, slots=True)
class Force:
    """One independent source, which may act at several coordinates with signs and weights.

    `share` holds coordinates (`benchmarks.finite_elements.assembly.place`) with the fraction of the force there.
    """

    cutoff_hz: float
    rms_N: float
    share: tuple[tuple[int, float], ...]

    @property
    def colour(self) -> ColouringFilter:
        """Filter from white noise to a force of unit variance."""
        return colouring_filter(Source(cutoff_hz=self.cutoff_hz, direction=(0.0,) * 6, force_rms_N=1.0))


def forced(forces: tuple[Force, ...]) -> tuple[int, ...]:
    """Coordinates at which any force acts, ascending."""
    return tuple(sorted({at for force in forces for at, _ in force.share}))


def distribution(forces: tuple[Force, ...]) -> FloatArray:
    """Force at each of the `forced` coordinates per unit of each source, shape (n_sources, n_coordinates), N."""
    places = forced(forces)
    spread = np.zeros((len(forces), len(places)))
    for number, force in enumerate(forces):
        for at, part in force.share:
            spread[number, places.index(at)] += force.rms_N * part
    return spread


def force_samples(forces: tuple[Force, ...], count: int, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Samples of the force at the `forced` coordinates, exact and stationary from the start; shape (count, n), N."""
    if not forces:
        return np.zeros((count, 0))
    drives = np.empty((count, len(forces)))
    for number, force in enumerate(forces):
        colour = force.colour
        F, G = discretise(colour.R, colour.S, 1 / rate_hz)
        stationary = stationary_covariance(colour.R, colour.S)
        values, vectors = np.linalg.eigh((stationary + stationary.T) / 2)
        start = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
        noise = rng.standard_normal((count, len(values)))
        drives[:, number] = advance(F, G, start, noise) @ colour.output
    return drives @ distribution(forces)


def covariance_under(equations: Equations, forces: tuple[Force, ...]) -> FloatArray:
    """Stationary covariance of (ξ, ξ̇) under coloured forces, from the Lyapunov equation; shape (2n, 2n), SI.

    Raises EstimationError if the rotor is unstable.
    """
    n = len(equations.M)
    colours = [force.colour for force in forces]
    places, spread = forced(forces), distribution(forces)
    inverse = np.linalg.inv(equations.M)[:, list(places)]
    size = 2 * n + sum(colour.output.size for colour in colours)
    A = np.zeros((size, size))
    B = np.zeros((size, sum(colour.S.shape[1] for colour in colours)))
    A[: 2 * n, : 2 * n] = equations.A
    row, column = 2 * n, 0
    for colour, part in zip(colours, spread, strict=True):
        states, drives = colour.S.shape
        A[n : 2 * n, row : row + states] = np.outer(inverse @ part, colour.output)
        A[row : row + states, row : row + states] = colour.R
        B[row : row + states, column : column + drives] = colour.S
        row, column = row + states, column + drives
    return stationary_covariance(A, B)[: 2 * n, : 2 * n]
