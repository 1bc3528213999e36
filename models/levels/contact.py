"""Contact: whether a shaft is pushed back where it is farthest from its mean position, as by a casing that it rubs on.

The next sample of a linear machine is what the latest ones predict and a remainder. Where what shakes the machine is
Gaussian, the remainder is independent of the latest samples, and so of every function of them, whatever the machine and
its lines at orders of running speed. A contact is a force towards the centre while the shaft is far out, and nothing
otherwise: a remainder that goes with such a force is nothing that stiffness, damping, unbalance, a wrong gain or a
louder source makes. Cubic stiffness, and lines that are no orders, are taken out with what grows with the cube of the
distance. This is a score test of an autoregressive model against one with another regime beyond a threshold (H. Tong,
"Non-linear Time Series", Oxford 1990, chapter 5).
"""

import numpy as np

from models.signals.block import FloatArray

_LAGS = (0, 2, 4, 8, 16)
"""Samples back that the next one is predicted from."""
_FAR_OUT = (0.02, 0.15)
"""Parts of the samples: a light contact is seen best in the first, one that is there in every turn in the second."""
_LEAST = 1000
"""Samples: of less, hardly any are far out."""
_PER_TURN, _LEAST_HZ = 64, 1000.0
"""Sampled faster than both, neighbours are averaged: between them a force hardly moves the shaft."""


def contact(pair: FloatArray, turning: FloatArray, revolutions: float, rate_hz: float) -> FloatArray:
    """How much of a push towards the centre there is where a shaft is far out.

    Parameters
    ----------
    pair : ndarray, shape (2, n_samples)
        Displacements in two directions, from their mean.
    turning : ndarray, shape (2, n_samples)
        Cosine and sine of the shaft angle.
    revolutions : float
        How many there are.
    rate_hz : float
        Sampling rate.

    Returns
    -------
    ndarray, shape (2,)
        Of the samples that are far out, fewer and more: each standard normal on a linear machine that is shaken at
        random, far above zero with a contact. Nan of too few samples, and where a sensor shows nothing of its own.
    """
    every = max(1, int(min(pair.shape[1] / (_PER_TURN * max(abs(revolutions), 1.0)), rate_hz / _LEAST_HZ)))
    kept = pair.shape[1] // every
    if every > 1:
        pair = pair[:, : kept * every].reshape(2, kept, every).mean(axis=2)
        turning = turning[:, every // 2 :: every]
    largest = float(np.abs(pair).max())
    if kept < _LEAST or largest == 0:
        return np.full(len(_FAR_OUT), np.nan)
    x, first = pair / largest, max(_LAGS)
    now, angle = x[:, first:-1], (turning[0] + 1j * turning[1])[first : kept - 1]
    square = now[0] ** 2 + now[1] ** 2
    at = [round((1 - part) * square.size) for part in _FAR_OUT]
    limits = np.partition(square, at)[at]
    # Towards the centre, in parts of the distance from it.
    pushes = [(np.sqrt(limit / np.maximum(square, limit)) - 1) * now for limit in limits]
    orders = np.stack([angle, angle * angle, angle * angle * angle])
    latest = [x[:, first - lag : kept - 1 - lag] for lag in _LAGS]
    known = np.concatenate([np.ones((1, square.size)), orders.real, orders.imag, *latest, square * now])
    rows = np.concatenate([known, x[:, first + 1 :], *pushes])
    sums, n = rows @ rows.T, len(known)
    predicted, *_ = np.linalg.lstsq(sums[:n, :n], sums[:n, n:], rcond=1e-12)
    left = rows[n:] - predicted.T @ known  # the remainder, and what is left of the pushes
    scale = np.sqrt(np.mean(left[:2] ** 2, axis=1))
    if not np.all(scale > 1e-9):
        return np.full(len(_FAR_OUT), np.nan)
    together = left[0] / scale[0] * left[2::2] + left[1] / scale[1] * left[3::2]
    # By their own squares: what shakes the machine may be louder while the shaft is far out.
    return np.asarray(together.sum(axis=1) / np.sqrt(np.sum(together**2, axis=1)), dtype=np.float64)
