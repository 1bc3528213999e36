"""How far estimates can wander before the data object: coefficients of a relation, or the change in a window.

A covariance describes the bottom of the criterion by a parabola. Where windows determine a direction weakly the
criterion is flatter than that: the estimate moves to where the noise of the terms hides the misfit, and the parabola is
drawn there. The interval is then taken from the criterion itself, which is right however weak the instruments are.

References
----------
J. H. Stock and J. H. Wright, "GMM with weak identification", Econometrica 68 (2000).
"""

from collections.abc import Callable, Sequence

import numpy as np

from models.diagnosis.baseline.lag_moments import LagMoments, inverse
from models.signals.block import FloatArray

__all__ = ["relation_criterion", "stretching"]

_RISE = 4.0
"""What the criterion gains at two standard errors if the covariance is right."""
_STEPS = 2.0 * 1.4 ** np.arange(10)
"""Distances that are tried, standard errors: to about twenty times what the covariance says."""


def stretching(criterion: Callable[[FloatArray], float], b: FloatArray, covariance: FloatArray) -> FloatArray:
    """Matrix A that stretches errors e with the given covariance to A e, whose covariance is what the criterion says.

    Parameters
    ----------
    criterion : callable
        χ² at an estimate.
    b : ndarray, shape (n,)
        Estimate.
    covariance : ndarray, shape (n, n)
        Its own.
    """
    spread = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(spread, spread))
    lowest = criterion(b)
    scales = np.ones(b.size)
    for number, (value, vector) in enumerate(zip(np.maximum(values, 1e-12), vectors.T, strict=True)):
        step = np.sqrt(value) * vector * spread
        for sign in (1, -1):
            for distance in _STEPS:
                if criterion(b + sign * distance * step) - lowest >= _RISE:
                    break
                scales[number] = max(scales[number], distance / np.sqrt(_RISE))
    return np.asarray((vectors * scales) @ vectors.T * np.outer(spread, 1 / spread), dtype=np.float64)


def relation_criterion(parts: Sequence[LagMoments], prior: FloatArray, b: FloatArray) -> float:
    """Left-over moments of healthy windows, weighted as at these coefficients, less what scatter explains.

    Parameters
    ----------
    parts : sequence of LagMoments
        One of each healthy window.
    prior : ndarray, shape (n, n)
        Precision of what was expected of the coefficients.
    b : ndarray, shape (n,)
        Coefficients.
    """
    combination = np.concatenate([[1.0], -b])
    total = float(b @ prior @ b)
    for part in parts:
        W, kept = inverse(part.covariance(combination))
        left = part.values @ combination
        total += float(left @ W @ left) / max(1.0, part.scatter(combination, W, kept)) - kept
    return total
