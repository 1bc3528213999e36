"""What a window says of pairs of channels: correlation functions with standard errors, at lags or from the spectra."""

from dataclasses import dataclass

import numpy as np

from models.diagnosis.moments import ComplexArray, plan_for
from models.diagnosis.window import WindowStatistics
from models.machine import MachineFile
from models.signals.block import FloatArray


@dataclass(frozen=True, slots=True)
class MeasuredCorrelations:
    """Correlation functions of some pairs, SI.

    Attributes
    ----------
    lags_s : ndarray, shape (n_lags,)
    values, errors : ndarray, shape (n_lags, n_pairs)
        R_ij(τ) and its standard error.
    band_hz : tuple of float or None
        What they are limited to; None where they come from the samples.
    outside_band : ndarray, shape (n_pairs,)
        What that leaves out at lag zero, over the product of the rms; nan where they come from the samples.
    """

    lags_s: FloatArray
    values: FloatArray
    errors: FloatArray
    band_hz: tuple[float, float] | None
    outside_band: FloatArray


def measured_correlations(
    machine: MachineFile, window: WindowStatistics, pairs: list[tuple[int, int]]
) -> MeasuredCorrelations:
    """Correlation functions of a window, from its spectra if it holds them at lag zero alone.

    Parameters
    ----------
    pairs : list of (int, int)
        Reference and response, as columns of the window.
    """
    reference, response = (np.array(column, dtype=np.intp) for column in zip(*pairs, strict=True))
    if window.lags_s.size > 1:
        hops = window.hop_correlation[:, :, reference, response]
        errors = hops.std(axis=0, ddof=1) / np.sqrt(hops.shape[0])
        values = window.correlation[:, reference, response]
        return MeasuredCorrelations(window.lags_s, values, errors, None, np.full(len(pairs), np.nan))
    segment_s = machine.window.segment_s
    lags_s = plan_for(machine).lags_s
    lags_s = lags_s[lags_s <= segment_s / 2]
    spacing_hz = float(window.frequencies_hz[1] - window.frequencies_hz[0])
    band_hz = (window.frequencies_hz[0] - spacing_hz / 2, window.frequencies_hz[-1] + spacing_hz / 2)
    turn = np.exp(-2j * np.pi * np.outer(lags_s, window.frequencies_hz))
    values = (
        2 * spacing_hz * (turn @ window.spectrum[:, reference, response]).real / _hann_fade(lags_s / segment_s)[:, None]
    )
    zero = window.correlation[0]
    rms = np.sqrt(zero[reference, reference] * zero[response, response])
    with np.errstate(invalid="ignore", divide="ignore"):  # a channel that does not move has no share
        outside = (zero[reference, response] - values[0]) / rms
    errors = _bartlett_errors(window, reference, response, turn, spacing_hz)
    return MeasuredCorrelations(lags_s, values, errors, (float(band_hz[0]), float(band_hz[1])), outside)


def _bartlett_errors(
    window: WindowStatistics,
    reference: np.typing.NDArray[np.intp],
    response: np.typing.NDArray[np.intp],
    turn: ComplexArray,
    spacing_hz: float,
) -> FloatArray:
    """Standard errors of correlations of a Gaussian process that is T seconds long.

    Var R̂_ij(τ) = (2/T) ∫ S_ii S_jj + Re{S_ij² e^{-4πjfτ}} df over positive frequencies (M. S. Bartlett, Supplement to
    the J. Roy. Statist. Soc. 8 (1946), for one channel). A product of estimated spectra is larger than that of the true
    ones by one over the number of averages.
    """
    spectrum = window.spectrum
    own = spectrum[:, reference, reference].real * spectrum[:, response, response].real
    both = (turn**2 @ spectrum[:, reference, response] ** 2).real
    variance = 2 * spacing_hz / window.duration_s * (own.sum(axis=0) + both)
    return np.asarray(np.sqrt(np.maximum(variance, 0) / (1 + 1 / window.n_segments)), dtype=np.float64)


def _hann_fade(part: FloatArray) -> FloatArray:
    """By how much a Hann-windowed segment weakens a correlation at a lag that is a part of its length."""
    angle = 2 * np.pi * part
    return np.asarray((1 - part) * (2 + np.cos(angle)) / 3 + np.sin(angle) / (2 * np.pi), dtype=np.float64)
