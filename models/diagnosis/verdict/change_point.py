"""Size and time of a change, averaged over all possible moments and over what else may have changed.

The reading of a changed parameter depends on what else changed, perhaps too little to be named, and on how much of the
window is from after the change. Neither is known. So every set of parameters that includes the named ones is tried with
every moment, and the result is the mean over them by their probability, with the variance within and between.

A window that holds the new state for a share of its time reads about that share of the change. One window cannot tell
a small change from a late one; the windows before, which overlap it, show the share growing. Given the moment, the
values before and after it are linear in the windows' readings. Moments are tried so close together that the difference
between two of them is less than the windows' errors: otherwise a growth that is seen far more sharply would fit another
moment, power and size better than the true ones.
"""

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from models.diagnosis.verdict.stretch import Stretch
from models.signals.block import FloatArray

_STEPS, _MOST_STEPS = 2, 20  # moments that are tried in every hop, at least and at most
_APART = 2.0  # standard errors by which a window's reading may differ from one of these moments to the next
# Weight of a second of the new state relative to one of the old state: their ratio of vibration power.
_POWER_RATIOS = np.array([0.25, 0.5, 1.0, 2.0, 4.0])
# Independent variance of each window over a window's variance: its maximum is followed to a fraction of an error.
_OWN_VARIANCE = 0.1
_MIXTURE_ERROR = 0.1  # difference between the reading of a mixture and the mixture of the readings, over the change
_CHANGE_SPREAD = 0.3  # standard deviation of possible changes, in the scale of the errors
_UNCHANGED_SPREAD = 0.002  # the same of a parameter before it changes for the first time
_ODDS = 0.1  # odds that a further parameter has changed, once one has
_EARLIER_ODDS = 100.0  # odds of a change before data that have just begun
_MOST = 2  # further parameters that are tried
_QUANTILES = (0.5, 0.025, 0.975)


def read_changes(
    windows: Sequence[Stretch], named: Sequence[int], hop_ns: int, by_ns: int
) -> tuple[FloatArray, FloatArray, tuple[int, int, int] | None]:
    """Estimate the values that the `named` parameters (indices into `PARAMETERS`) have at the end of the latest window.

    With values and errors, in the scale of the errors, come median and 95 % limits of the moment of the change, never
    closer than half a hop; None where it is before the data.

    The windows overlap and hold equally much data, the latest one last; all know the same parameters, and some may
    contain a gap. The parameters had changed by `by_ns` at the latest.
    """
    last = windows[-1]
    known = list(last.known)
    own, values = last.estimate[1], np.array([one.estimate[0] for one in windows])
    shared = np.zeros_like(own) if last.common is None else last.common[np.ix_(known, known)]
    whiten = np.linalg.inv(np.linalg.cholesky(own + shared))
    seen = values @ whiten.T
    steps, coarse = _resolution(seen)
    whiten, seen = whiten / coarse, seen / coarse
    bent = _MIXTURE_ERROR**2 * float(np.sum((seen[-1] - seen[0]) ** 2)) + 1e-12
    starts, ends = (np.array([getattr(one, at) for one in windows], dtype=np.float64) for at in ("start_ns", "end_ns"))
    # The first one stands for all before the data. It is as probable as the others together, and much more so where
    # the data have only just begun: few machines change in their first minute.
    moments = np.append(starts[0] - hop_ns, np.arange(starts[0], min(by_ns, ends[-1]), hop_ns / steps))
    watched = ends[0] <= starts[-1] + hop_ns / 2
    odds = max(1, moments.size - 1) * (1.0 if watched else _EARLIER_ODDS)
    before = np.log(np.where(moments < starts[0], odds, 1.0))
    length = np.min(ends - starts)
    # Gaps are taken out of the time: a gap enters with a window that ends late and leaves with one that starts late.
    gone = np.append(0.0, np.cumsum(np.maximum(np.diff(ends) - np.diff(starts), 0.0)))
    times, gaps = np.append(starts, ends), np.append(gone - (ends - starts - length), gone)
    order = np.argsort(times)
    ends, changed = ends - gone, moments - np.interp(moments, times[order], gaps[order])
    overlap = np.clip((length - np.abs(ends[:, None] - ends)) / length, 0.0, 1.0)
    decorrelate = np.linalg.inv(np.linalg.cholesky(overlap + _OWN_VARIANCE * np.eye(ends.size)))
    share = np.clip((ends - changed[:, None]) / length, 0.0, 1.0)
    part = _POWER_RATIOS[:, None, None] * share
    part /= part + 1 - share  # (n_powers, n_moments, n_windows)
    design = decorrelate @ np.stack([1 - part, part, 4 * part * (1 - part)], axis=-1)
    gram, right = (np.swapaxes(design, -1, -2) @ side for side in (design, decorrelate @ seen))

    first = [known.index(i) for i in named]
    others = [at for at in range(len(known)) if at not in first]
    weights, means, variances = [], [], []
    for count in range(min(_MOST, len(others)) + 1):
        sets = np.array([[*first, *further] for further in combinations(others, count)])
        basis, scale = np.linalg.qr(np.moveaxis(whiten[:, sets], 0, 1))  # (n_sets, m, n), (n_sets, n, n)
        back = np.linalg.inv(scale)  # from observations along the basis to the set's parameters
        gain = back @ np.swapaxes(basis, -1, -2) @ whiten
        common, errors = (np.sum(gain @ side * gain, axis=-1) for side in (shared, own))
        unit = np.mean(np.sum(back**2, axis=-1), axis=-1)
        spread = np.stack([_UNCHANGED_SPREAD**2 + np.mean(common, axis=-1), np.full(unit.size, _CHANGE_SPREAD**2)])
        prior = np.stack(np.broadcast_arrays(unit / spread, unit / _CHANGE_SPREAD**2, 1 / bent), axis=-1)
        fit, best, variance = _fitted(gram, right[:, :, None] @ basis, prior[:, None, None])
        weights.append(before[:, None] + fit + count * np.log(_ODDS))
        means.append((best[..., None, :] @ np.swapaxes(back, -1, -2))[..., 0, : len(first)])
        variances.append(variance[..., None] * coarse**2 * errors[:, : len(first)] + common[:, : len(first)])
    log_weight, every = np.concatenate(weights, axis=-1)[..., None], np.concatenate(means, axis=-2)
    weight = np.exp(log_weight - np.max(log_weight))
    weight /= weight.sum()
    mean = np.sum(weight * every, axis=(0, 1, 2, 3))
    variance = np.sum(weight * (np.concatenate(variances, axis=-2) + (every - mean) ** 2), axis=(0, 1, 2, 3))
    passed = np.cumsum(weight.sum(axis=(0, 1, 3, 4)))
    at = np.minimum(np.searchsorted(passed, _QUANTILES), moments.size - 1)
    middle, low, high = (round(moment) for moment in (moments[at] + np.array([0, -0.5, 0.5]) * hop_ns).tolist())
    return mean, np.sqrt(variance), None if middle < starts[0] else (middle, low, high)


def _resolution(seen: FloatArray) -> tuple[int, float]:
    """Number of moments to try in a hop, and the factor on all errors if those moments are not close enough."""
    moved = float(np.max(np.linalg.norm(np.diff(seen, axis=0), axis=1), initial=0.0))
    steps = min(max(_STEPS, math.ceil(moved / _APART)), _MOST_STEPS)
    return steps, max(1.0, moved / (_APART * steps))


def _fitted(gram: FloatArray, right: FloatArray, prior: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit the values before, after and of the mixture, in closed form: the value after is eliminated last.

    Parameters
    ----------
    gram : ndarray, shape (n_powers, n_moments, 3, 3)
    right : ndarray, shape (n_powers, n_moments, n_sets, 3, n)
    prior : ndarray, shape (2, 1, 1, n_sets, 3)
        Inverse variances of the three.

    Returns
    -------
    tuple
        Log likelihood relative to that without any values, shape (2, n_powers, n_moments, n_sets); the value after, of
        the same shape with a last axis n; its variance in units of the observations, without that axis.
    """
    before, after, mixed = 0, 1, 2
    own = gram[..., None, :, :]
    pivot = own[..., before, before] + prior[..., before]
    to_mixed, to_after = own[..., before, mixed] / pivot, own[..., before, after] / pivot
    mixed_pivot = own[..., mixed, mixed] + prior[..., mixed] - to_mixed * own[..., before, mixed]
    between = own[..., mixed, after] - to_mixed * own[..., before, after]
    last = own[..., after, after] + prior[..., after] - to_after * own[..., before, after] - between**2 / mixed_pivot
    of_before = right[..., before, :]
    of_mixed = right[..., mixed, :] - to_mixed[..., None] * of_before
    of_after = right[..., after, :] - to_after[..., None] * of_before - (between / mixed_pivot)[..., None] * of_mixed
    fit = sum(
        np.sum(one**2, axis=-1) / by for one, by in ((of_before, pivot), (of_mixed, mixed_pivot), (of_after, last))
    )
    occam = right.shape[-1] * (np.sum(np.log(prior), axis=-1) - np.log(pivot * mixed_pivot * last))
    return (fit + occam) / 2, of_after / last[..., None], 1 / last
