"""Contact: whether a shaft is pushed back where it is farthest from its mean position, as by a casing that it rubs on.

The next sample of a linear machine is a prediction from the latest samples plus a remainder. Under Gaussian excitation
the remainder is independent of the latest samples, and so of every function of them, whatever the machine and its lines
at the first orders of running speed. A contact is a force towards the centre while the shaft is far out, and zero
otherwise: no stiffness, damping, unbalance, wrong gain or louder source makes the remainder correlate with such a
force. The cube of the distance is among the predictors: it takes out cubic stiffness and other lines. This is a score
test of an autoregressive model against one with another regime beyond a threshold (H. Tong, "Non-linear Time Series",
Oxford 1990, chapter 5).
"""

from collections import deque
from collections.abc import Mapping

import numpy as np
import scipy  # its sub-packages are loaded when they are first used

from models.checkpoint import checked
from models.signals.block import Float32Array, FloatArray

_LAGS = (0, 2, 4, 8, 16, 64, 128)
"""Samples back from which the next is predicted: the longest lags separate running speed from a line beside it."""
_FAR_OUT = (0.02, 0.15)
"""Fractions of samples that count as far out: the first shows a light contact best, the second one in every turn."""
_BEFORE = 2
"""The second test counts the shaft as far out only if it was so this many samples earlier (one of the lags) as well. A
stiff contact is over by then and the shaft returns later than predicted: the first test, without this, shows it."""
_SPIKE_RATIO = 8.0
"""A sample whose remainder exceeds its mean size this many times is a spike: it counts as far out only if the shaft was
so before as well. No sample of a Gaussian vibration is that far off its prediction."""
_FEWEST = 1000
"""Fewest samples: of fewer, hardly any are far out."""
_FITTED = 4
"""The predictor is fitted to one sample in this many, which is enough."""
_STEPS = 20.0
"""Least rms in converter steps. With fewer, the rounding error correlates with the shaft position: on the rotor kit
*heavy*, steps of rms/12 to rms/7 gave 4.3 standard errors in an average hop, steps half that size none."""
_NOTHING = 1e-6
"""Fraction of the largest deviation below which a value is rounding error."""
_PER_TURN, _LEAST_HZ = 48, 1000.0
"""Samples per turn, and Hz: sampled at twice both or more, neighbours are averaged, as no force moves the shaft much
between them. Without averaging, a healthy rotor with 117 samples a turn and 2 % noise gave one standard error a hop."""


def contact(
    pair: FloatArray, turning: FloatArray, revolutions: float, rate_hz: float, skew: float = 0.0, velocity: bool = False
) -> FloatArray:
    """Test statistics of a push towards the centre while a shaft is far out.

    Parameters
    ----------
    pair : ndarray, shape (2, n_samples)
        Displacements or velocities in two directions, less their mean.
    turning : ndarray, shape (2, n_samples)
        Cosine and sine of the shaft angle.
    skew : float
        Cosine of the angle between the directions.

    Returns
    -------
    ndarray, shape (2,)
        One for each radius (`_FAR_OUT`): standard normal on a linear machine under random excitation, far above zero
        with a contact. NaN if there are too few samples, they are too coarsely quantised, or a sensor carries no
        signal of its own.
    """
    size, steps = pair.shape[1], np.abs(np.diff(pair))
    step = np.min(steps, axis=1, where=steps > 0, initial=np.inf)
    coarse = bool(np.any(_STEPS * step > pair.std(axis=1)) and np.all(np.isfinite(step)))
    every = max(1, int(min(size / (_PER_TURN * max(abs(revolutions), 1.0)), rate_hz / _LEAST_HZ, size / _FEWEST)))
    kept = size // every
    if every > 1:
        pair = pair[:, : kept * every].reshape(2, kept, every).mean(axis=2)
        turning = turning[:, every // 2 :: every]
    largest = float(np.abs(pair).max())
    if kept < _FEWEST or largest == 0 or coarse:
        return np.full(len(_FAR_OUT), np.nan)
    x, first = pair / largest, max(_LAGS)
    latest = [x[:, first - lag : kept - 1 - lag] for lag in _LAGS]
    angle = (turning[0] + 1j * turning[1])[first : kept - 1]
    now, then = latest[0], latest[_LAGS.index(_BEFORE)]
    if velocity:
        # The position, by a leaky integral of the velocity over about one turn: a function of past samples as well.
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
    off = np.any(size > _SPIKE_RATIO * size.mean(axis=1, keepdims=True), axis=0)[:-1]
    square[1:][off] = both[1:][off]
    limits, pushes = [], []
    for part, far in zip(_FAR_OUT, (square, both), strict=True):
        at = round((1 - part) * far.size)
        limits.append(np.partition(far, at)[at])
        # A force towards the centre, proportional to the distance beyond the radius.
        pushes.append((np.sqrt(limits[-1] / np.maximum(far, max(limits[-1], _NOTHING**2))) - 1) * now)
    left = unpredicted(np.concatenate(pushes))
    scale = np.sqrt(np.mean(remainder**2, axis=1))
    together = remainder[0] / max(scale[0], _NOTHING) * left[::2] + remainder[1] / max(scale[1], _NOTHING) * left[1::2]
    # Standard errors by the products' own squares: the excitation may be louder while the shaft is far out.
    errors = np.sqrt(np.sum(together**2, axis=1))
    if min(scale.min(), *np.sqrt(limits)) < _NOTHING or errors.min() == 0:
        return np.full(len(_FAR_OUT), np.nan)
    return np.asarray(together.sum(axis=1) / errors, dtype=np.float64)


class LatestContact:
    """Contact statistics of the latest hops, more than a window has: a light contact takes minutes to stand out."""

    def __init__(self, hops: int) -> None:
        self._hops: deque[Float32Array] = deque(maxlen=hops)  # written with every hop
        self._state = 0

    def take(self, hop: FloatArray, state: int) -> FloatArray:
        """Add a hop, shape (n,), and return all of its operating state, shape (n_hops, n); others are discarded."""
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
        """Go on where `checkpoint` was called; `CheckpointError` if an array is missing or of another form."""
        hops = checked(arrays, "contact", np.float32, (None, None))
        self._state = int(checked(arrays, "contact_state", np.int64, ()))
        self._hops = deque(hops, self._hops.maxlen)
