"""Moments of one plane: every term of the bearing's equation of motion, correlated with past displacements.

The sum of the rows of bearing and disc holds no shaft force and no tilt. Divided by the bearing's stiffness to ground,

    y1 + (c/k) ẏ1 + (m2/k) ÿ2 + (m1/k) ÿ1 + s (y2 - y1) = f / k,

where s is zero on the six-degree-of-freedom machine and takes up a shaft that is held elsewhere too. Correlated with
any displacement that lies further back than the force f remembers, the right side is zero. Sensor noise of shorter
memory is gone as well.

Accelerations are not formed: each moment is a correlation function under a smooth kernel over lags, and the derivative
stands on the kernel. What the moments scatter by follows from the window's spectra (Bartlett's formula), without
assuming a model of the machine.
"""

from dataclasses import dataclass

import numpy as np

from models.diagnosis.moments import ComplexArray
from models.diagnosis.window import WindowStatistics
from models.signals.block import FloatArray

__all__ = [
    "LAG_FROM_S",
    "N_TERMS",
    "REFERENCES",
    "TERMS",
    "LagMoments",
    "absent",
    "inverse",
    "lag_moments",
    "shared_covariance",
]

REFERENCES = ("y1", "y2", "z1", "z2")
"""Displacements that serve as references, where they are measured."""

TERMS = ("y1", "y1'", "y2''", "y1''", "y2 - y1")
"""Terms of the relation in the horizontal plane; the first is the target."""

N_TERMS = len(TERMS)

LAG_FROM_S = 0.036
"""Shortest lag where the memory of the excitation is not known yet: enough for a cutoff of 25 Hz."""

_WIDTH_S = 0.010
_SPACING_S = 0.004
_RANK = 1e-4
# y1, y1', y2'', y1'' and y2 as measured; the last column becomes y2 - y1
_MIX = np.eye(N_TERMS)
_MIX[0, -1] = -1.0


@dataclass(frozen=True, slots=True)
class LagMoments:
    """Moments of one plane in one window.

    Attributes
    ----------
    values : ndarray, shape (n_moments, 5)
        One row per reference and kernel, one column per term of `TERMS`, SI units.
    hop_values : ndarray, shape (n_hops, n_moments, 5)
        The same of every hop.
    factor : ndarray of complex, shape (n_bins, n_moments, n_references)
        Square root of the references' spectra seen through the kernels, per √(two-sided bin over duration).
    spectra : ndarray of complex, shape (n_bins, 5, 5)
        Cross-spectra of the terms.
    frequencies_hz : ndarray, shape (n_bins,)
    terms : ndarray of complex, shape (n_bins, n_states, 5)
        The terms as combinations of the measured states.
    """

    values: FloatArray
    hop_values: FloatArray
    factor: ComplexArray
    spectra: ComplexArray
    frequencies_hz: FloatArray
    terms: ComplexArray

    def residual_spectrum(self, combination: FloatArray) -> FloatArray:
        """Power spectral density of a combination of the terms, shape (n_bins,)."""
        density = np.einsum("i,fij,j->f", combination, self.spectra, combination, optimize=True).real
        return np.asarray(np.clip(density, 0.0, None), dtype=np.float64)

    def covariance(self, combination: FloatArray) -> FloatArray:
        """Covariance of the combination's moments where it is unrelated to the past, shape (n_moments, n_moments)."""
        weighted = self.factor * np.sqrt(self.residual_spectrum(combination))[:, None, None]
        flat = weighted.transpose(1, 0, 2).reshape(self.values.shape[0], -1)
        return np.asarray(flat.real @ flat.real.T + flat.imag @ flat.imag.T, dtype=np.float64)

    def noise(self, weight: FloatArray) -> FloatArray:
        """Mean of values' W values that scatter alone would give, shape (5, 5): the errors in the variables."""
        through = np.einsum("fmr,fmr->f", self.factor.conj(), np.matmul(weight, self.factor)).real
        return np.asarray(np.einsum("f,fij->ij", through, self.spectra).real, dtype=np.float64)

    def scatter(self, combination: FloatArray, weight: FloatArray, rank: int) -> float:
        """Scatter of the combination from hop to hop in units of what `weight` (the inverse covariance) expects."""
        hops = self.hop_values @ combination
        hops = hops - hops.mean(axis=0)
        count = hops.shape[0]
        if count < 3:
            return 1.0
        return float(np.einsum("hm,mn,hn->", hops, weight, hops, optimize=True) / (count * (count - 1) * rank))


def absent(states: tuple[str, ...], plane: str) -> tuple[str, ...]:
    """States that the relation of a plane (``y`` or ``z``) needs and that are not measured."""
    return tuple(name for name in (f"{plane}1", f"{plane}1_dot", f"{plane}2", f"{plane}2_dot") if name not in states)


def lag_moments(window: WindowStatistics, plane: str, lag_from_s: float) -> LagMoments:
    """Moments of one plane.

    Parameters
    ----------
    window : WindowStatistics
        With correlations at lags up to 0.1 s or more.
    plane : str
        ``y`` or ``z``.
    lag_from_s : float
        Shortest lag that is used.
    """
    index = {name: position for position, name in enumerate(window.states)}
    references = [index[name] for name in REFERENCES if name in index]
    one, two, rate_1, rate_2 = (index[f"{plane}{name}"] for name in ("1", "2", "1_dot", "2_dot"))
    columns = [one, rate_1, rate_2, rate_1, two]
    derived = [False, False, True, True, False]
    kernel, slope = _kernels(window.lags_s, lag_from_s)

    def moments(correlation: FloatArray) -> FloatArray:
        terms = [
            (-slope if derive else kernel) @ correlation[..., references, column]
            for column, derive in zip(columns, derived, strict=True)
        ]
        stacked = np.stack(terms, axis=-1)  # (..., n_kernels, n_references, 5)
        swapped = np.swapaxes(stacked, -3, -2)
        return np.asarray(swapped.reshape(*stacked.shape[:-3], -1, N_TERMS) @ _MIX, dtype=np.float64)

    f = window.frequencies_hz
    step_hz = f[1] - f[0]
    bins_hz = np.full(f.size, step_hz)
    bins_hz[0] += f[0] - step_hz / 2  # below the band the spectra are taken as level
    rate = np.where(np.array(derived)[None, :], 2j * np.pi * f[:, None], 1.0)
    terms = np.zeros((f.size, len(window.states), N_TERMS), dtype=np.complex128)
    terms[:, columns, range(N_TERMS)] = rate
    terms = terms @ _MIX
    root = _square_root(window.spectrum[:, references][:, :, references].conj())
    through = np.exp(2j * np.pi * f[:, None] * window.lags_s) @ kernel.T
    factor = root[:, :, None, :] * through[:, None, :, None]
    factor = factor * np.sqrt(2 * bins_hz / window.duration_s)[:, None, None, None]
    return LagMoments(
        values=moments(window.correlation),
        hop_values=moments(window.hop_correlation),
        factor=factor.reshape(f.size, -1, len(references)),
        spectra=terms.transpose(0, 2, 1) @ window.spectrum @ terms.conj(),
        frequencies_hz=f,
        terms=terms,
    )


def shared_covariance(
    a: LagMoments, of_a: FloatArray, b: LagMoments, of_b: FloatArray, window: WindowStatistics
) -> FloatArray:
    """Covariance between the moments of two combinations in one window, shape (n_moments of a, n_moments of b)."""
    left, right = a.terms @ of_a, b.terms @ of_b
    density = np.einsum("fi,fij,fj->f", left, window.spectrum, right.conj(), optimize=True)
    first = (a.factor * density[:, None, None]).transpose(1, 0, 2).reshape(a.values.shape[0], -1)
    second = b.factor.transpose(1, 0, 2).reshape(b.values.shape[0], -1)
    return np.asarray((first @ second.conj().T).real, dtype=np.float64)


def inverse(covariance: FloatArray) -> tuple[FloatArray, int]:
    """Inverse on the directions that the covariance resolves, and how many they are.

    Neighbouring kernels overlap. Directions with less than 1e-4 of the largest variance hold what the spectra do not
    know (sampling of the lags, frequencies above their band), not information.
    """
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > _RANK * values[-1]
    basis = vectors[:, kept] / scale[:, None]
    return np.asarray((basis / values[kept]) @ basis.T, dtype=np.float64), int(kept.sum())


def _kernels(lags_s: FloatArray, lag_from_s: float) -> tuple[FloatArray, FloatArray]:
    """Smooth kernels cos⁴ over lags, and their slopes, each shape (n_kernels, n_lags), with the lags' spacing."""
    centres = np.arange(lag_from_s + _WIDTH_S / 2, lags_s[-1] - _WIDTH_S / 2 + 1e-9, _SPACING_S)
    u = (lags_s[None, :] - centres[:, None]) / _WIDTH_S
    inside = np.abs(u) < 0.5
    spacing = (lags_s[1] - lags_s[0]) / _WIDTH_S
    kernel = np.where(inside, np.cos(np.pi * u) ** 4, 0.0) * spacing
    slope = np.where(inside, -4 * np.pi * np.cos(np.pi * u) ** 3 * np.sin(np.pi * u), 0.0) * spacing / _WIDTH_S
    return kernel, slope


def _square_root(spectra: ComplexArray) -> ComplexArray:
    """Lower factor of Hermitian matrices, which may be singular (one source)."""
    scale = np.sqrt(np.maximum(np.einsum("fii->fi", spectra).real, np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(spectra / scale[:, :, None] / scale[:, None, :])
    return np.asarray(scale[:, :, None] * vectors * np.sqrt(np.clip(values, 0, None))[:, None, :], dtype=np.complex128)
