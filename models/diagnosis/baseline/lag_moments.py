"""Moments of one row in one window: every term, correlated with past motions.

The correlation of a row of motion with any motion further back than the memory of the force is zero. So is that of
sensor noise with a shorter memory. No signal is differentiated: each moment is the integral of a correlation function
times a smooth kernel over lags, and derivatives are taken of the kernel.

The covariance of the moments follows from the window's spectra (Bartlett's formula), without a model of the machine.
As the kernels are shifted copies of one another, every covariance consists of blocks that depend only on the distance
between two kernels; they are summed over frequency once, for all combinations of terms.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from math import comb

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dpstrf

from models.diagnosis.baseline.rows import Formation, Row, formation_of
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import ComplexArray, FloatArray, IndexArray

_SPACING_S = 0.004  # at time scale 1
_FALLEN_TO = 0.1
_FALLEN_AT = 3.0  # kernel width times the band's upper end for cos⁸: gain 1/10 there, 1/70 a third further up
_LEAD = 0.375


@dataclass(frozen=True, slots=True)
class Shape:
    """Kernel cosᵖ of a given width: a sum of cosines at multiples of 1/width."""

    power: int
    width_s: float
    # Shortest lag to the first kernel's centre; less than a thousandth of the kernel lies below the shortest lag.
    lead_s: float
    spacing_s: float  # of neighbouring kernels, rounded to the spacing of the lags

    @property
    def cosines(self) -> FloatArray:
        """Weights of cos(2π m u), m = 0 … p/2."""
        half = self.power // 2
        row = np.array([comb(self.power, half + m) for m in range(half + 1)]) / 2**self.power
        row[1:] *= 2
        return np.asarray(row, dtype=np.float64)


def shape_for(deepest: int, band_to_hz: float, time_scale: float) -> Shape:
    """Shape of kernels that can be differentiated `deepest` times (`Formation.deepest`), at most 4.

    For one derivative a narrow kernel is enough. Each further one amplifies the sensors' noise by another power of the
    frequency. Kernels must then be wide enough to pass hardly anything beyond the band of the spectra, which ends at
    `band_to_hz`, as the scatter of the moments is computed from the spectra.
    """
    spacing_s = _SPACING_S * time_scale
    if deepest <= 1:
        return Shape(4, 0.010 * time_scale, 0.005 * time_scale, spacing_s)
    width_s = _FALLEN_AT / band_to_hz
    return Shape(8, width_s, _LEAD * width_s, spacing_s)


@lru_cache(maxsize=256)
def kernels(lags: bytes, lag_from_s: float, shape: Shape, deepest: int) -> tuple[tuple[FloatArray, ...], FloatArray]:
    """Kernels from a shortest lag on, and up to `deepest` derivatives, at most 4; the lags are equally spaced.

    By order n of the derivative, (n_kernels, n_lags): (-1)ⁿ κ⁽ⁿ⁾ times the spacing of the lags. With them come their
    centres, (n_kernels,).
    """
    lags_s = np.frombuffer(lags)
    step_s = float(lags_s[1] - lags_s[0])
    spacing_s = max(1, round(shape.spacing_s / step_s)) * step_s
    width_s = shape.width_s
    centres = np.arange(lag_from_s + shape.lead_s, lags_s[-1] - width_s / 2 + 1e-9, spacing_s)
    u = (lags_s[None, :] - centres[:, None]) / width_s
    inside = np.abs(u) < 0.5
    values = []
    for order in range(deepest + 1):
        value = np.zeros_like(u)
        for m, weight in enumerate(shape.cosines):
            # d/dτ advances the phase of cos(2π m u) by π/2
            value += weight * (2 * np.pi * m / width_s) ** order * np.cos(2 * np.pi * m * u + order * np.pi / 2)
        values.append(np.where(inside, (-1) ** order * value, 0.0) * (step_s / width_s))
    return tuple(values), centres


def gain(frequencies_hz: FloatArray, shape: Shape) -> FloatArray:
    """Fourier transform of a kernel, shape (n_bins,): real, as the kernel is even."""
    x = np.asarray(frequencies_hz, dtype=np.float64) * shape.width_s
    total = np.zeros_like(x)
    for m, weight in enumerate(shape.cosines):
        total += weight * (np.sinc(x - m) + np.sinc(x + m)) / 2
    return total


def passband_hz(deepest: int, band_to_hz: float, time_scale: float) -> float:
    """Frequency, Hz, up to which kernels pass at least a tenth: the end of the differentiator's valid band."""
    f = np.linspace(0.0, 2000.0, 8001) / time_scale
    through = gain(f, shape_for(deepest, band_to_hz, time_scale))
    return float(min(band_to_hz, f[np.argmax(through < _FALLEN_TO * through[0])]))


LAG_FROM_S = 0.036  # shortest lag while the memory of the excitation is not known yet: enough for a cutoff of 25 Hz
SHORTEST_LAG_FROM_S, LONGEST_LAG_FROM_S = 0.014, 0.045  # limits of the shortest lag once the memory is known
_RANK, _OWN = 1e-4, 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class LagMoments:
    """Moments of one row in one window beyond a shortest lag."""

    of: "RowWindow"
    centres_s: FloatArray  # (n_kernels,)
    values: FloatArray  # (n_moments, n_terms), one row per reference and kernel, SI units
    hop_values: FloatArray  # (n_hops, n_moments, n_terms), the same for every hop
    index: IndexArray  # (n_moments, n_moments), positions of a covariance's elements in `of.blocks`

    def only(self, kept: IndexArray) -> "LagMoments":
        """Select some of the moments by index."""
        return replace(
            self, values=self.values[kept], hop_values=self.hop_values[:, kept], index=self.index[np.ix_(kept, kept)]
        )

    def covariance(self, combination: FloatArray) -> FloatArray:
        """Covariance of the combination's moments if it is uncorrelated with the past, shape (n_moments, n_moments)."""
        pairs = self.of.pairs
        weights = combination[pairs[0]] * combination[pairs[1]] * np.where(pairs[0] == pairs[1], 1.0, 2.0)
        blocks = np.tensordot(weights, self.of.blocks, axes=1)
        return np.asarray(blocks.reshape(-1)[self.index], dtype=np.float64)

    def noise(self, weight: npt.NDArray[np.floating]) -> FloatArray:
        """Expectation of valuesᵀ W values due to scatter alone, shape (n_terms, n_terms): the errors in variables."""
        blocks = self.of.blocks
        summed = np.bincount(self.index.reshape(-1), weight.reshape(-1), blocks[0].size)
        found = blocks.reshape(blocks.shape[0], -1) @ summed
        n_terms = self.values.shape[1]
        matrix = np.empty((n_terms, n_terms))
        matrix[self.of.pairs[0], self.of.pairs[1]] = found
        matrix[self.of.pairs[1], self.of.pairs[0]] = found
        return matrix

    def widening(self, combination: FloatArray, weight: npt.NDArray[np.floating], rank: int) -> float:
        """Hop-to-hop variance of the combination over that of `weight`, an inverse covariance; at least 1."""
        hops = self.hop_values @ combination
        hops = hops - hops.mean(axis=0)
        count = hops.shape[0]
        if count < 3:
            return 1.0
        return max(1.0, float(np.sum((hops @ weight) * hops) / (count * (count - 1) * rank)))


@dataclass(frozen=True, slots=True, eq=False)
class RowWindow:
    """The part of one row in one window that does not depend on the shortest lag."""

    window: WindowStatistics
    formation: Formation
    references: tuple[str, ...]  # states that serve as references
    terms: ComplexArray  # (n_bins, n_states, n_terms), the terms as combinations of the measured states
    spectra: ComplexArray  # (n_bins, n_terms, n_terms), cross-spectra of the terms
    # (n_pairs, n_references, n_references, 2 n_distances - 1): covariance of the moments of each pair of terms, by
    # their references and by the distance of their kernels
    blocks: FloatArray
    pairs: IndexArray  # (2, n_pairs), the pairs of terms
    shape: Shape  # of the kernels

    def beyond(self, lag_from_s: float) -> LagMoments:
        """Moments beyond a shortest lag."""
        window, formation = self.window, self.formation
        references = [window.states.index(name) for name in self.references]
        over, centres_s = kernels(window.lags_s.tobytes(), lag_from_s, self.shape, formation.deepest)

        def moments(correlation: FloatArray) -> FloatArray:
            seen: dict[tuple[str, int], FloatArray] = {}
            columns = []
            for term in formation.terms:
                total: FloatArray | float = 0.0
                for source in term:
                    key = source.state, source.derivatives
                    if key not in seen:
                        column = window.states.index(source.state)
                        seen[key] = over[source.derivatives] @ correlation[..., references, column]
                    total = total + source.factor * seen[key]
                columns.append(np.swapaxes(np.asarray(total), -2, -1))
            stacked = np.stack(columns, axis=-1)
            return np.asarray(stacked.reshape(*stacked.shape[:-3], -1, len(columns)), dtype=np.float64)

        index = _block_index(len(references), centres_s.size, self.blocks.shape[3])
        return LagMoments(self, centres_s, moments(window.correlation), moments(window.hop_correlation), index)


def row_window(row: Row, window: WindowStatistics, states: tuple[str, ...], references: tuple[str, ...]) -> RowWindow:
    """Prepare a row in a window, whose correlations must reach to lags of 0.1 s times the time scale or more."""
    formation = formation_of([term.motions for term in row.terms], states)
    f = window.frequencies_hz
    n_terms = len(row.terms)
    terms = np.zeros((f.size, len(window.states), n_terms), dtype=np.complex128)
    for number, sources in enumerate(formation.terms):
        for source in sources:
            rate = (2j * np.pi * f) ** source.derivatives
            terms[:, window.states.index(source.state), number] += source.factor * rate
    spectra = terms.transpose(0, 2, 1) @ window.spectrum @ terms.conj()
    columns = [window.states.index(name) for name in references]
    pairs = np.array(np.triu_indices(n_terms))
    own = spectra[:, pairs[0], pairs[1]].real
    shape = shape_for(formation.deepest, float(f[-1]), window.time_scale)
    # The references' cross-spectra times the kernels' squared gain and each bin's weight in Bartlett's formula.
    weight = _bin_weights(window) * gain(f, shape) ** 2
    between = window.spectrum[:, columns][:, :, columns].conj() * weight[:, None, None]
    shortest_s = SHORTEST_LAG_FROM_S * window.time_scale
    _, centres_s = kernels(window.lags_s.tobytes(), shortest_s, shape, formation.deepest)
    cosine, sine = _waves(f.tobytes(), float(centres_s[1] - centres_s[0]), centres_s.size)
    flat = between.reshape(f.size, -1)
    # one product for all reference pairs and distances, weighted with the cross-spectra of the pairs of terms
    even = own.T @ (flat.real[:, :, None] * cosine[:, None, :]).reshape(f.size, -1)
    odd = own.T @ (flat.imag[:, :, None] * sine[:, None, :]).reshape(f.size, -1)
    earlier, later = (each.reshape(pairs.shape[1], len(columns), len(columns), -1) for each in (even + odd, even - odd))
    blocks = np.concatenate([earlier[..., :0:-1], later], axis=-1)
    return RowWindow(window, formation, references, terms, spectra, blocks, pairs, shape)


def _bin_weights(window: WindowStatistics) -> FloatArray:
    f = window.frequencies_hz
    step_hz = f[1] - f[0]
    bins_hz = np.full(f.size, step_hz)
    bins_hz[0] += f[0] - step_hz / 2  # below the band the spectra are taken as flat
    return np.asarray(2 * bins_hz / window.duration_s, dtype=np.float64)


@lru_cache(maxsize=16)
def _waves(frequencies: bytes, spacing_s: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Cosine and sine of 2π f Δ for every distance Δ of `count` kernels to the first, shape (n_bins, count)."""
    phase = 2 * np.pi * np.frombuffer(frequencies)[:, None] * spacing_s * np.arange(count)
    return np.cos(phase), np.sin(phase)


@lru_cache(maxsize=64)
def _block_index(n_references: int, n_kernels: int, n_distances: int) -> IndexArray:
    """Positions of a covariance's elements in its flattened blocks, shape (n_moments, n_moments)."""
    middle = n_distances // 2
    k = np.arange(n_kernels)
    distance = middle + k[:, None] - k[None, :]
    r = np.arange(n_references)
    which = r[:, None] * n_references + r[None, :]
    index = which[:, None, :, None] * n_distances + distance[None, :, None, :]
    return np.asarray(index.reshape(n_references * n_kernels, -1), dtype=np.intp)


def shared_covariance(a: LagMoments, of_a: FloatArray, b: LagMoments, of_b: FloatArray) -> FloatArray:
    """Covariance between the moments of two combinations in one window, shape (n_moments of a, n_moments of b)."""
    window = a.of.window
    f = window.frequencies_hz
    left, right = a.of.terms @ of_a, b.of.terms @ of_b
    density = np.einsum("fi,fij,fj->f", left, window.spectrum, right.conj(), optimize=True)
    rows, columns = ([window.states.index(name) for name in one.of.references] for one in (a, b))
    weight = _bin_weights(window) * gain(f, a.of.shape) * gain(f, b.of.shape) * density
    between = window.spectrum[:, rows][:, :, columns].conj() * weight[:, None, None]
    ours, theirs = a.centres_s, b.centres_s
    distances_s = np.concatenate([ours[0] - theirs[:0:-1], ours - theirs[0]])
    found = (between.reshape(f.size, -1).T @ np.exp(2j * np.pi * f[:, None] * distances_s)).real
    distance = np.arange(ours.size)[:, None] - np.arange(theirs.size) + theirs.size - 1
    found = found.reshape(len(rows), len(columns), -1)[..., distance].swapaxes(1, 2)
    return np.asarray(found.reshape(a.values.shape[0], b.values.shape[0]), dtype=np.float64)


def telling(covariance: FloatArray) -> IndexArray:
    """Indices of moments with variance of their own, shape (n_kept,).

    Neighbouring kernels overlap. If the others account for a moment's variance to within a hundredth, the rest is not
    described by the spectra, as in `inverse`. A pivoted Cholesky decomposition finds the remaining moments in a
    twentieth of the time that eigenvectors take.

    Raises
    ------
    LinAlgError
        If a moment does not scatter.
    """
    # Scale each moment slightly smaller than the one before, so that rounding does not decide between equal ones.
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.sqrt(np.diag(covariance) * (1 + np.linspace(0, _OWN, covariance.shape[0])))
        scaled = covariance / np.outer(scale, scale)
    if not np.all(np.isfinite(scaled)):
        raise np.linalg.LinAlgError("a moment does not scatter")
    _, order, rank, _ = dpstrf(scaled, tol=_OWN)
    return np.asarray(order[:rank] - 1, dtype=np.intp)


def inverse(covariance: FloatArray) -> tuple[FloatArray, int]:
    """Inverse on the directions that the covariance resolves, and their number.

    Neighbouring kernels overlap. Directions with less than 1e-4 of the largest variance contain no information, only
    errors not described by the spectra (sampling of the lags, frequencies above the band).
    """
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > _RANK * values[-1]
    basis = vectors[:, kept] / scale[:, None]
    return np.asarray((basis / values[kept]) @ basis.T, dtype=np.float64), int(kept.sum())
