"""Coloured stochastic excitation: white noise through a linear filter (Eqs. 7-12).

The paper's filter is a second-order low-pass. As not all machines are like that, the order may be one to four
(Butterworth) and a broad hump may be added to the low-pass floor: Eqs. (7)-(8) with other matrices R and S*, and A* and
B* enlarged accordingly. Every source has unit variance before `force_rms_N` is applied, whatever its shape.
"""

import math
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, Field

from models.physics.rotor import M_matrix, RotorParameters, system_A
from models.signals.block import FloatArray

FILTER_DAMPING = math.sqrt(0.5)  # damping ratio of the colouring filter: Butterworth, flat up to the cutoff


class Source(BaseModel, extra="forbid", frozen=True):
    """One independent source of coloured force."""

    cutoff_hz: float = Field(gt=0, le=1e5)  # cutoff frequency of the colouring filter
    # Column of S (Eq. 15) on (y1, y2, psi, z1, z2, phi): dimensionless on translations, m (lever arm) on tilts.
    direction: tuple[float, float, float, float, float, float]
    force_rms_N: float = Field(ge=0, le=1e9)  # root mean square of the coloured force that `direction` distributes
    # Order of the Butterworth low-pass, 1 to 4: the force falls by 6 dB per octave and order above the cutoff.
    order: int = Field(default=2, ge=1, le=4)
    # Part of the force's variance in a broad hump, 0 to 1; the rest is the low-pass floor. Hump and floor are driven by
    # independent white noise, so that their spectra add.
    hump_share: float = Field(default=0.0, ge=0, le=1)
    # Centre and damping ratio of the hump, which is white noise through a second-order band-pass with a half-power
    # width of 2 · damping · centre.
    hump_hz: float = Field(default=80.0, gt=0, le=1e5)
    hump_damping: float = Field(default=0.4, gt=0, le=1)


@dataclass(frozen=True, slots=True)
class ColouringFilter:
    """ż = R z + S* w, u = output · z, with unit variance of u for white noise of unit intensity (Eqs. 7-8)."""

    R: FloatArray  # (n, n)
    S: FloatArray  # (n, p), one column for each of the p independent white drives
    output: FloatArray  # (n,), dimensionless


def colouring_filter(source: Source) -> ColouringFilter:
    """Filter of one source.

    A low-pass of order n has the states (u, u̇/ω_c, …), all of one unit, and the normalised Butterworth polynomial in
    its last row; a hump adds two states (v, v̇/ω_h), the second of which is the output of the band-pass.
    """
    floor = _butterworth(source.cutoff_hz, source.order)
    if source.hump_share == 0:
        return floor
    w = 2 * math.pi * source.hump_hz
    drive = 2 * math.sqrt(source.hump_damping * w)  # makes both states of unit variance
    R = _block_diag(floor.R, w * np.array([[0.0, 1.0], [-1.0, -2 * source.hump_damping]]))
    output = np.append(math.sqrt(1 - source.hump_share) * floor.output, [0.0, math.sqrt(source.hump_share)])
    return ColouringFilter(R, _block_diag(floor.S, np.array([[0.0], [drive]])), output)


def _block_diag(*blocks: FloatArray) -> FloatArray:
    """Return the matrix with these blocks on its diagonal."""
    from scipy.linalg import block_diag  # noqa: PLC0415  # no --help waits for SciPy

    return np.asarray(block_diag(*blocks), dtype=np.float64)


def _butterworth(cutoff_hz: float, order: int) -> ColouringFilter:
    output = np.zeros(order)
    output[0] = 1.0
    S = np.zeros((order, 1))
    w = 2 * math.pi * cutoff_hz
    if order == 2:
        # The stationary variance of u for ü + 2ζω u̇ + ω² u = g ω w is g²/(4ζω); with states scaled by ω, g is 2√(ζω).
        S[1, 0] = 2 * math.sqrt(FILTER_DAMPING * 2 * math.pi * cutoff_hz)
        return ColouringFilter(w * np.array([[0.0, 1.0], [-1.0, -2 * FILTER_DAMPING]]), S, output)
    angles = math.pi * (2 * np.arange(order) + 1 + order) / (2 * order)
    polynomial = np.poly(np.exp(1j * angles)).real  # highest power first, 1 at both ends
    R = np.diag(np.ones(order - 1), 1)
    R[-1] = -polynomial[:0:-1]
    S[-1, 0] = w * math.sqrt(floor_density(cutoff_hz, order))
    return ColouringFilter(w * R, S, output)


def floor_density(cutoff_hz: float, order: int) -> float:
    """Two-sided density at zero frequency of Butterworth low-pass noise with unit variance, 1/Hz.

    The filter's two-sided noise bandwidth is 2 f_c (π/2n) / sin(π/2n).
    """
    return math.sin(math.pi / (2 * order)) * order / (math.pi * cutoff_hz)


def low_pass(frequency_hz: FloatArray, cutoff_hz: float, order: float = 2.0) -> FloatArray:
    """Power gain of a Butterworth low-pass, 1 at zero frequency; same shape as `frequency_hz`.

    The filters have orders 1 to 4 (the paper's is of second order); an estimate may lie between them.
    """
    return np.asarray(1 / (1 + np.abs(frequency_hz / cutoff_hz) ** (2 * order)), dtype=np.float64)


def low_pass_slopes(frequency_hz: FloatArray, cutoff_hz: float, order: float = 2.0) -> tuple[FloatArray, FloatArray]:
    """Derivatives of log `low_pass` with respect to the logarithms of cutoff and order; shaped like `frequency_hz`."""
    ratio = np.abs(frequency_hz / cutoff_hz)
    stopped = 2 * order * (1 - low_pass(frequency_hz, cutoff_hz, order))
    return stopped, -stopped * np.log(np.maximum(ratio, 1e-12))


def expanded_A(rotor: RotorParameters, speed_rad_s: float, sources: tuple[Source, ...]) -> FloatArray:
    """System matrix A* of rotor and filters (Eq. 12), shape (n, n): 12 rotor states, then each source's filter."""
    filters = [colouring_filter(source) for source in sources]
    A = _block_diag(system_A(rotor, speed_rad_s), *(colour.R for colour in filters))
    inverse_masses = 1 / np.diag(M_matrix(rotor))
    u = 12
    for source, colour in zip(sources, filters, strict=True):
        for state in np.flatnonzero(colour.output):
            A[6:12, u + state] = inverse_masses * np.array(source.direction) * source.force_rms_N * colour.output[state]
        u += colour.output.size
    return A


def expanded_B(sources: tuple[Source, ...]) -> FloatArray:
    """Input matrix B* (Eq. 11) for independent white noise of unit intensity, shape (n, p).

    One column per source, two for a source with a hump.
    """
    return _block_diag(np.empty((12, 0)), *(colouring_filter(source).S for source in sources))
