"""Sums of products of samples with earlier ones, from which correlation functions are made."""

import numpy as np
from scipy.fft import next_fast_len

from models.signals.block import FloatArray, IndexArray


def lagged_products(a: FloatArray, lags: IndexArray, before: int) -> FloatArray:
    """Sums ``[l, i, j] = Σ_t a_i(t - lag_l) a_j(t)`` over the samples after the history, shape (n_lags, n, n).

    `a` has shape (n, before + n_samples): the first `before` samples, the history, are references only. The lags begin
    at zero and are at most `before`.

    The lags are short and the samples many, so the samples are cut into blocks of twice the longest lag. The blocks'
    cross-spectra (each block's reference reaches back by the longest lag, where its response is zero) are added up
    before one inverse transform. If only every k-th lag is wanted, the cross-spectra are folded first, which shortens
    the transform: for every second lag, the two halves of the spectrum are added.
    """
    longest, n, n_samples = int(lags[-1]), a.shape[0], a.shape[1] - before
    if longest == 0:
        own = a[:, before:]
        return np.asarray((own @ own.T)[np.newaxis], dtype=np.float64)
    step = int(np.gcd.reduce(lags))
    kept = next_fast_len(-(-(longest + max(2 * longest, 256)) // step), real=True)
    size, half = step * kept, kept // 2 + 1
    block = size - longest
    count = -(-n_samples // block)
    padded = np.zeros((n, longest + count * block))
    padded[:, : longest + n_samples] = a[:, before - longest :]
    reference = np.lib.stride_tricks.sliding_window_view(padded, size, axis=1)[:, ::block]
    response = reference.copy()
    response[:, :, :longest] = 0
    spectrum_reference, spectrum_response = np.fft.rfft(reference), np.fft.rfft(response)  # (n, count, n_frequencies)
    np.conjugate(spectrum_reference, out=spectrum_reference)
    cross = (spectrum_reference.transpose(2, 0, 1) @ spectrum_response.transpose(2, 1, 0)).reshape(-1, n * n)
    folded = cross[:half].copy()
    for first in range(kept, size, kept):  # from half the size on a spectrum mirrors itself
        if 2 * first < size:
            folded += cross[first : first + half]
        else:
            folded += cross[size - first - half + 1 : size - first + 1][::-1].conj()
    products = np.fft.irfft(np.ascontiguousarray(folded.T), kept)[:, lags // step].T / step
    return np.ascontiguousarray(products).reshape(-1, n, n)
