"""Contact: whether a shaft is pushed back where it is farthest from its mean position, as by a casing that it rubs on.

The next sample of a linear machine is what the latest ones predict and a remainder. Where what shakes the machine is
Gaussian, the remainder is independent of the latest samples, and so of every function of them, whatever the machine and
its lines at the first orders of running speed. A contact is a force towards the centre while the shaft is far out, and
nothing otherwise: a remainder that goes with such a force is nothing that stiffness, damping, unbalance, a wrong gain
or a louder source makes. Cubic stiffness, and other lines, are taken out with what grows with the cube of the distance.
This is a score test of an autoregressive model against one with another regime beyond a threshold (H. Tong,
"Non-linear Time Series", Oxford 1990, chapter 5).
"""

from collections import deque
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import scipy  # its sub-packages are loaded when they are first used

from models.checkpoint import checked
from models.signals.block import FloatArray

_LAGS = (0, 2, 4, 8, 16, 64, 128)
"""Samples back that the next one is predicted from: the longest tell running speed from a line beside it."""
_FAR_OUT = (0.02, 0.15)
"""Parts of the samples: a light contact is seen best in the first, one that is there in every turn in the second."""
_BEFORE = 2
"""Samples back, one of these lags: in the second, far out is where the shaft was so then as well. A stiff contact is
over by then, and the shaft is back later than was predicted: in the first it is seen without."""
_OFF = 8.0
"""Times the average distance from what was predicted: a single sample that is off, by which nothing is far out unless
the shaft was so before. Of a Gaussian's, none."""
_LEAST = 1000
"""Samples: of less, hardly any are far out."""
_FITTED = 4
"""One of so many samples is enough to fit what predicts the next one."""
_STEPS = 20.0
"""Steps of a converter in the rms: of fewer what is rounded goes with where the shaft is. On the rotor kit *heavy*
steps of a twelfth to a seventh made 4.3 standard errors in an average hop, of half of that nothing."""
_NOTHING = 1e-6
"""Of the largest distance: less is what numbers are rounded to."""
_Hop = npt.NDArray[np.float32]  # written with every hop
_PER_TURN, _LEAST_HZ = 64, 1000.0
"""Sampled faster than both, neighbours are averaged: between them a force hardly moves the shaft."""


def contact(
    pair: FloatArray, turning: FloatArray, revolutions: float, rate_hz: float, skew: float = 0.0, velocity: bool = False
) -> FloatArray:
    """How much of a push towards the centre there is where a shaft is far out.

    Parameters
    ----------
    pair : ndarray, shape (2, n_samples)
        Displacements or velocities in two directions, from their mean.
    turning : ndarray, shape (2, n_samples)
        Cosine and sine of the shaft angle.
    skew : float
        Cosine of the angle between the directions.

    Returns
    -------
    ndarray, shape (2,)
        Beyond the radius of fewer samples and of more: each standard normal on a linear machine that is shaken at
        random, far above zero with a contact. Nan of too few samples, of coarse ones, and where a sensor shows
        nothing of its own.
    """
    size, steps = pair.shape[1], np.abs(np.diff(pair))
    step = np.min(steps, axis=1, where=steps > 0, initial=np.inf)
    coarse = bool(np.any(_STEPS * step > pair.std(axis=1)) and np.all(np.isfinite(step)))
    every = max(1, int(min(size / (_PER_TURN * max(abs(revolutions), 1.0)), rate_hz / _LEAST_HZ, size / _LEAST)))
    kept = size // every
    if every > 1:
        pair = pair[:, : kept * every].reshape(2, kept, every).mean(axis=2)
        turning = turning[:, every // 2 :: every]
    largest = float(np.abs(pair).max())
    if kept < _LEAST or largest == 0 or coarse:
        return np.full(len(_FAR_OUT), np.nan)
    x, first = pair / largest, max(_LAGS)
    latest = [x[:, first - lag : kept - 1 - lag] for lag in _LAGS]
    angle = (turning[0] + 1j * turning[1])[first : kept - 1]
    now, then = latest[0], latest[_LAGS.index(_BEFORE)]
    if velocity:
        # Where the shaft is, by its velocities of about one turn: a function of the past as the samples themselves are.
        place = scipy.signal.lfilter([1.0], [1.0, -np.exp(-max(abs(revolutions), 1.0) / kept)], x, axis=1)
        place /= np.abs(place).max()
        now, then = place[:, first : kept - 1], place[:, first - _BEFORE : kept - 1 - _BEFORE]
        latest += [now, then]
    square, before = (y * y + z * z - 2 * skew * y * z for y, z in (now, then))
    orders = np.stack([angle, angle * angle, angle * angle * angle])
    known = np.concatenate([np.ones((1, square.size)), orders.real, orders.imag, *latest, square * now])
    fitted = np.ascontiguousarray(known[:, ::_FITTED])
    products = fitted @ fitted.T

    def unpredicted(wanted: FloatArray) -> FloatArray:
        by, *_ = np.linalg.lstsq(products, fitted @ np.ascontiguousarray(wanted[:, ::_FITTED]).T, rcond=1e-12)
        return np.asarray(wanted - by.T @ known, dtype=np.float64)

    remainder = unpredicted(x[:, first + 1 :])
    both = np.minimum(square, before)
    size = np.abs(remainder)
    off = np.any(size > _OFF * size.mean(axis=1, keepdims=True), axis=0)[:-1]
    square[1:][off] = both[1:][off]
    limits, pushes = [], []
    for part, far in zip(_FAR_OUT, (square, both), strict=True):
        at = round((1 - part) * far.size)
        limits.append(np.partition(far, at)[at])
        # Towards the centre, in parts of the distance from it.
        pushes.append((np.sqrt(limits[-1] / np.maximum(far, max(limits[-1], _NOTHING**2))) - 1) * now)
    left = unpredicted(np.concatenate(pushes))
    scale = np.sqrt(np.mean(remainder**2, axis=1))
    together = remainder[0] / max(scale[0], _NOTHING) * left[::2] + remainder[1] / max(scale[1], _NOTHING) * left[1::2]
    # By their own squares: what shakes the machine may be louder while the shaft is far out.
    errors = np.sqrt(np.sum(together**2, axis=1))
    if min(scale.min(), *np.sqrt(limits)) < _NOTHING or errors.min() == 0:
        return np.full(len(_FAR_OUT), np.nan)
    return np.asarray(together.sum(axis=1) / errors, dtype=np.float64)


class LatestContact:
    """What so many latest hops have of a contact, more than a window: a light one takes minutes to stand out."""

    def __init__(self, hops: int) -> None:
        self._hops: deque[_Hop] = deque(maxlen=hops)
        self._state = 0

    def take(self, hop: FloatArray, state: int) -> FloatArray:
        """Go on with a hop, shape (n,); all of its operating state, shape (n_hops, n): others are forgotten."""
        if state != self._state:
            self._hops.clear()
        self._state = state
        self._hops.append(hop.astype(np.float32))
        return np.array(self._hops, dtype=np.float64)

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything as named arrays."""
        hops = np.stack(self._hops) if self._hops else np.empty((0, 0), np.float32)
        return {"contact": hops, "contact_state": np.array(self._state, dtype=np.int64)}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Go on where `checkpoint` was called.

        Raises
        ------
        CheckpointError
            If an array is missing or of another form.
        """
        hops, state = (
            checked(arrays, "contact", np.float32, (None, None)),
            checked(arrays, "contact_state", np.int64, ()),
        )
        self._hops, self._state = deque(hops, self._hops.maxlen), int(state)
