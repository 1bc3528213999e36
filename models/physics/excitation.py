"""Coloured stochastic excitation: white noise through a second-order low-pass filter (Eqs. 7-12)."""

import math

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from models.physics.matrices import M_matrix, system_A
from models.physics.parameters import RotorParameters
from models.signals.block import FloatArray

__all__ = [
    "FILTER_DAMPING",
    "Source",
    "expanded_A",
    "expanded_B",
    "filter_R",
    "low_pass",
    "low_pass_slope",
    "unit_spectrum",
]

FILTER_DAMPING = math.sqrt(0.5)
"""Damping ratio of the colouring filter: Butterworth, flat up to the cutoff."""


class Source(BaseModel):
    """One independent source of coloured force.

    Attributes
    ----------
    cutoff_hz : float
        Cutoff frequency of the colouring filter.
    direction : tuple of six floats
        Column of S (Eq. 15) on (y1, y2, psi, z1, z2, phi): dimensionless on translations, m (lever arm) on tilts.
    force_rms_N : float
        Root mean square of the coloured force that `direction` distributes.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    cutoff_hz: float = Field(gt=0, le=1e5)
    direction: tuple[float, float, float, float, float, float]
    force_rms_N: float = Field(ge=0, le=1e9)


def filter_R(cutoff_hz: float) -> FloatArray:
    """System matrix R of the colouring filter (Eq. 7), shape (2, 2), states (u, u̇/ω_c), so that both have one unit."""
    w = 2 * math.pi * cutoff_hz
    return w * np.array([[0.0, 1.0], [-1.0, -2 * FILTER_DAMPING]])


def filter_gain(cutoff_hz: float) -> float:
    """S* of Eq. (7): gain for unit-intensity white noise that makes u(t) of unit variance.

    The stationary variance of u for ü + 2ζω u̇ + ω² u = g ω w is g²/(4ζω); with states scaled by ω the gain is 2√(ζω).
    """
    return 2 * math.sqrt(FILTER_DAMPING * 2 * math.pi * cutoff_hz)


def low_pass(frequency_hz: FloatArray, cutoff_hz: float) -> FloatArray:
    """Power gain of the colouring filter, 1 at zero frequency; same shape as `frequency_hz`."""
    r2 = (frequency_hz / cutoff_hz) ** 2
    return np.asarray(1 / ((1 - r2) ** 2 + (2 * FILTER_DAMPING) ** 2 * r2), dtype=np.float64)


def low_pass_slope(frequency_hz: FloatArray, cutoff_hz: float) -> FloatArray:
    """Derivative of log `low_pass` by the logarithm of the cutoff; same shape as `frequency_hz`."""
    r2 = (frequency_hz / cutoff_hz) ** 2
    q = (2 * FILTER_DAMPING) ** 2
    return np.asarray(2 * r2 * (q - 2 * (1 - r2)) * low_pass(frequency_hz, cutoff_hz), dtype=np.float64)


def unit_spectrum(frequency_hz: FloatArray, cutoff_hz: float) -> FloatArray:
    """Two-sided power spectral density of a unit-variance coloured force, 1/Hz; same shape as `frequency_hz`."""
    return 4 * FILTER_DAMPING / (2 * math.pi * cutoff_hz) * low_pass(frequency_hz, cutoff_hz)


def expanded_A(rotor: RotorParameters, speed_rad_s: float, sources: tuple[Source, ...]) -> FloatArray:
    """System matrix A* of rotor and filters (Eq. 12), shape (12 + 2 n_sources, 12 + 2 n_sources)."""
    size = 12 + 2 * len(sources)
    A = np.zeros((size, size))
    A[:12, :12] = system_A(rotor, speed_rad_s)
    inverse_masses = 1 / np.diag(M_matrix(rotor))
    for number, source in enumerate(sources):
        u = 12 + 2 * number
        A[6:12, u] = inverse_masses * np.array(source.direction) * source.force_rms_N
        A[u : u + 2, u : u + 2] = filter_R(source.cutoff_hz)
    return A


def expanded_B(sources: tuple[Source, ...]) -> FloatArray:
    """Input matrix B* (Eq. 11) for independent white noise of unit intensity, shape (12 + 2 n_sources, n_sources)."""
    B = np.zeros((12 + 2 * len(sources), len(sources)))
    for number, source in enumerate(sources):
        B[12 + 2 * number + 1, number] = filter_gain(source.cutoff_hz)
    return B
