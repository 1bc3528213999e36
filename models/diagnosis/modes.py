"""Natural frequencies found in the vibration, and whether one has moved: what stiffness or mass changes, not why.

Where no relation between bearing and disc can be learned, or it tells little, a natural frequency still shows a change
of stiffness. Whatever force drives the machine, if it is smooth within the width of a resonance, the correlation
functions of its response decay with its own modes. Covariance-driven stochastic subspace identification finds them: the
block Hankel matrix of the correlations has the extended observability matrix as its column space, whose shift
invariance gives frequency, damping and shape of each mode. True modes are found at most model orders, poles of noise at
few.

References
----------
B. Peeters, G. De Roeck, "Reference-based stochastic subspace identification for output-only modal analysis", Mechanical
Systems and Signal Processing 13 (1999). R. J. Allemang, D. L. Brown, "A correlation coefficient for modal vector
analysis", IMAC (1982), for the modal assurance criterion (MAC).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat
from scipy.special import stdtrit

from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import BoolArray, ComplexArray, FloatArray
from rotorwatch.records.windows import NaturalFrequency

LEAST_CHANGE = 0.025
"""Least relative change that is reported: so far a frequency may move with the force, the load or the temperature."""
_GROWTH = 0.025
"""How far a frequency may move if all motions are e times as powerful as recorded: a bearing may stiffen with them."""
CONFIRMED = -1
_REACH = 0.15  # largest relative change for which the mode is looked for
MOST_LIMIT = 0.1  # a mode whose limit is wider says nothing
_FEWEST_WINDOWS = 4
_LAGS_S, _COLUMNS = 0.45, 48
_ORDERS = range(10, 41, 3)
_MOST_DAMPING, _MOST_WATCHED = 0.15, 0.06  # damping ratio of a pole, and of a healthy mode
_MULTIPLES, _BESIDE = 6, 0.02  # multiples of running speed, and how near a pole may be to one
_FULL_RANK = 1e-10  # least part of the largest direction that the smallest must have to be more than rounding
# How close poles of one mode are: of different orders in one window, and of different windows.
_BETWEEN_ORDERS, _BETWEEN_WINDOWS = (0.015, 0.9), (0.03, 0.85)
_FEWEST_ORDERS = 6  # of the eleven
_ALIKE = 0.6  # least MAC of a mode before and after a change; a half is as near to an orthogonal one


@dataclass(frozen=True, slots=True)
class Mode:
    """A mode of vibration."""

    frequency_hz: float
    damping: float  # ratio
    shape: ComplexArray  # (n_states,), of length 1
    orders: int = 1  # model orders at which it was found


class HealthyMode(BaseModel, extra="forbid", frozen=True, strict=True):
    """A mode of the healthy machine."""

    frequency_hz: float = Field(gt=0, allow_inf_nan=False)
    damping: float = Field(gt=0, allow_inf_nan=False)  # ratio
    spread: float = Field(ge=0, allow_inf_nan=False)  # relative standard deviation of the frequency between windows
    windows: int = Field(ge=_FEWEST_WINDOWS)  # in which it was found
    shape: tuple[tuple[FiniteFloat, FiniteFloat], ...] = Field(min_length=2)  # real and imaginary part for each state

    @property
    def vector(self) -> ComplexArray:
        """`shape` as an array, (n_states,)."""
        return np.array([complex(*part) for part in self.shape])

    def limit(self, rate: float) -> float:
        """Relative change that is exceeded in both of two windows without common data at most at this rate by chance.

        Then their mean exceeds it as well, which has a Student distribution. Infinite for a mode that is damped so much
        that its frequency is at times far off.
        """
        if self.damping > _MOST_WATCHED:
            return math.inf
        errors = -float(stdtrit(self.windows - 1, rate / 2)) * math.sqrt(1 / 2 + 1 / self.windows)
        return max(LEAST_CHANGE, errors * self.spread)


class HealthyModes(BaseModel, extra="forbid", frozen=True, strict=True):
    """The modes of the healthy machine."""

    states: tuple[str, ...] = Field(min_length=2)
    speed_rad_s: tuple[FiniteFloat, FiniteFloat] | None  # slowest and fastest window; None where a speed is not known
    powers: tuple[tuple[FiniteFloat, FiniteFloat], ...]  # least and largest mean square of each state, SI
    modes: tuple[HealthyMode, ...] = Field(min_length=1)

    def limits(self, rate: float) -> list[tuple[HealthyMode, float]]:
        """The modes whose changes can be seen, and the relative change of each that is reported; see `judge`."""
        found = [(mode, mode.limit(rate / len(self.modes))) for mode in self.modes]
        return [(mode, limit) for mode, limit in found if limit <= MOST_LIMIT]

    def judge(
        self, window: WindowStatistics, beyond_ns: Sequence[int], rate: float
    ) -> tuple[tuple[NaturalFrequency, ...], tuple[int, ...]]:
        """Compare the natural frequencies of a window with those of the healthy machine.

        A change is reported once two windows without common data show it, and none in between shows the healthy
        frequency. Modes whose limit is too wide are left out. Limits are wider in a window that moves
        more or less than the healthy ones.

        Parameters
        ----------
        beyond_ns : sequence of int
            For every mode the end of the first window beyond its limit since it was last found within; 0 if there is
            none, `CONFIRMED` once the mode is called changed.
        rate : float
            Declared probability that any mode of an unchanged machine is called changed in a window.

        Returns
        -------
        found : tuple of NaturalFrequency
            Of the modes in `limits`.
        beyond_ns : tuple of int
            The same after this window.
        """
        why = self._not_comparable(window)
        wider = 0.0 if why else self._by_growth(window)
        now = {} if why else self._matched(modes_of(window, self.states))
        found, beyond = [], []
        for number, (mode, since_ns) in enumerate(zip(self.modes, beyond_ns, strict=True)):
            limit = mode.limit(rate / len(self.modes))
            if limit > MOST_LIMIT:
                beyond.append(0)
                continue
            hidden = why or ("" if number in now else "not found in this window: excited too little, or hidden")
            judged, since_ns_now = _judged(mode, limit + wider, hidden or now[number], window, since_ns)
            found.append(judged)
            beyond.append(since_ns_now)
        return tuple(found), tuple(beyond)

    def _not_comparable(self, window: WindowStatistics) -> str:
        if missing := [state for state in self.states if state not in window.states]:
            return f"not measured: {', '.join(missing)}"
        return "" if self.speed_rad_s is None else window.speed_beyond(*self.speed_rad_s)

    def _by_growth(self, window: WindowStatistics) -> float:
        """How far frequencies may have moved because motions are larger or smaller than recorded."""
        least, largest = np.array(self.powers).T
        now = np.maximum(_powers(window, self.states), np.finfo(float).tiny)
        return _GROWTH * float(np.mean(np.maximum(np.maximum(np.log(now / largest), np.log(least / now)), 0.0)))

    def _matched(self, found: Sequence[Mode]) -> dict[int, Mode]:
        """The mode found for each healthy one: of the same shape, at most orders and, of equals, nearest to it."""
        shapes = np.array([mode.vector for mode in self.modes])
        healthy_hz = np.array([mode.frequency_hz for mode in self.modes])
        claims = []
        for mode in found:
            apart = np.abs(mode.frequency_hz / healthy_hz - 1)
            alike = np.where(apart < _REACH, _assurance(shapes, mode.shape[None, :])[:, 0], 0.0)
            best = int(np.argmax(alike))
            if alike[best] > _ALIKE:
                claims.append(((mode.orders, -float(apart[best])), best, mode))
        return {best: mode for _, best, mode in sorted(claims, key=itemgetter(0))}


def _judged(
    mode: HealthyMode, limit: float, now: Mode | str, window: WindowStatistics, since_ns: int
) -> tuple[NaturalFrequency, int]:
    """Compare a mode with the one found, or say why there is none; and since when it is beyond its limit."""
    stated = partial(NaturalFrequency, healthy_hz=mode.frequency_hz, limit=limit)
    name = f"natural frequency {mode.frequency_hz:.4g} Hz"
    if isinstance(now, str):
        if since_ns == CONFIRMED:  # what cannot be seen has not come back
            return stated(hz=None, change=None, verdict="changed", text=f"{name} had changed; now {now}"), since_ns
        return stated(hz=None, change=None, verdict="not evaluable", text=f"{name}: not evaluable, {now}"), since_ns
    hz, change = now.frequency_hz, now.frequency_hz / mode.frequency_hz - 1
    figures = f"now {hz:.4g} Hz, {change:+.1%}, limit {limit:.1%}"
    verdict, text = "not changed", f"{name}: not changed ({figures})"
    since_ns = 0 if abs(change) <= limit else since_ns or window.end_ns
    if since_ns:
        text = f"{name}: {figures}; reported as changed once a window without common data confirms it"
        if since_ns == CONFIRMED or window.end_ns - since_ns >= window.duration_s * 1e9:
            verdict, since_ns = "changed", CONFIRMED
            text = f"{name} has changed ({figures}): a stiffness or a mass has changed, it is not known which"
    return stated(hz=hz, change=change, verdict=verdict, text=text), since_ns


def learn_modes(windows: Sequence[WindowStatistics], states: tuple[str, ...]) -> HealthyModes | None:
    """Learn the modes that most of the healthy windows show; None if there is none.

    The windows must not overlap; `states` has one motion of every coordinate that is measured.
    """
    if len(states) < 2 or len(windows) < _FEWEST_WINDOWS:
        return None
    found = [(mode, number) for number, window in enumerate(windows) for mode in modes_of(window, states)]
    fewest = max(_FEWEST_WINDOWS, len(windows) // 2)
    modes = []
    for group in _groups([mode for mode, _ in found], np.array([number for _, number in found]), *_BETWEEN_WINDOWS):
        if len(group) < fewest:
            break
        own = [found[at][0] for at in group]
        frequencies = np.array([mode.frequency_hz for mode in own])
        vector = np.linalg.svd(np.array([mode.shape for mode in own]).T)[0][:, 0]
        modes.append(
            HealthyMode(
                frequency_hz=float(np.median(frequencies)),
                damping=float(np.median([mode.damping for mode in own])),
                spread=float(np.log(frequencies).std(ddof=1)),
                windows=len(own),
                shape=tuple((float(part.real), float(part.imag)) for part in vector),
            )
        )
    if not modes:
        return None
    speeds = [window.speed_rad_s for window in windows]
    powers = np.array([_powers(window, states) for window in windows])
    return HealthyModes(
        states=states,
        powers=tuple(zip(powers.min(axis=0).tolist(), powers.max(axis=0).tolist(), strict=True)),
        speed_rad_s=(min(speeds), max(speeds)) if all(map(math.isfinite, speeds)) else None,
        modes=tuple(sorted(modes, key=lambda mode: mode.frequency_hz)),
    )


def _powers(window: WindowStatistics, states: Sequence[str]) -> FloatArray:
    """Mean square of each motion with its synchronous part, shape (n_states,)."""
    columns = [window.states.index(state) for state in states]
    found = window.correlation[0, columns, columns]
    return found if window.synchronous is None else found + np.abs(window.synchronous[columns]) ** 2 / 2


def modes_of(window: WindowStatistics, states: Sequence[str]) -> list[Mode]:
    """Modes that the motions of a window show, lowest first; none if a motion does not move or is not finite."""
    columns = [window.states.index(state) for state in states]
    step_hz = float(window.frequencies_hz[1] - window.frequencies_hz[0])
    first = round(float(window.frequencies_hz[0]) / step_hz)
    spectra = np.zeros((first + window.frequencies_hz.size, len(states), len(states)), dtype=np.complex128)
    spectra[first:] = window.spectrum[:, columns][:, :, columns]
    size = np.sqrt(np.einsum("fii->i", spectra).real)
    if not (np.all(np.isfinite(size)) and np.all(size > 0)):
        return []
    correlation = np.fft.irfft(spectra / size[:, None] / size, axis=0)
    lag_s = 1 / (2 * (len(spectra) - 1) * step_hz)
    n = len(states)
    rows, columns_ = round(_LAGS_S * window.time_scale / lag_s), -(-_COLUMNS // n)
    lags = 1 + np.arange(rows)[:, None] + np.arange(columns_)
    if lags[-1, -1] >= len(correlation) // 2 or rows * n < 2 * _ORDERS[-1]:
        return []
    hankel = correlation[lags].transpose(0, 2, 1, 3).reshape(rows * n, columns_ * n)
    left, values, _ = np.linalg.svd(hankel, full_matrices=False)
    seen = left * np.sqrt(values)
    # The matrices of all orders follow from one decomposition of the largest.
    q, r = np.linalg.qr(seen[:-n, : _ORDERS[-1]])
    shifted = q.T @ seen[n:, : _ORDERS[-1]]
    poles: list[Mode] = []
    orders: list[int] = []
    pivots = np.abs(np.diag(r))
    for order in (one for one in _ORDERS if pivots[:one].min() > _FULL_RANK * pivots[0]):
        values_, vectors = np.linalg.eig(np.linalg.solve(r[:order, :order], shifted[:order, :order]))
        rates = np.asarray(np.log(np.where(values_ == 0, 1.0, values_) + 0j) / lag_s, dtype=np.complex128)
        shapes = (seen[:n, :order] @ vectors) * size[:, None]
        for at in np.flatnonzero(_oscillates(rates, window)):
            frequency = abs(complex(rates[at]))
            shape = shapes[:, at] / np.linalg.norm(shapes[:, at])
            poles.append(Mode(frequency / (2 * math.pi), -float(rates[at].real) / frequency, shape))
            orders.append(order)
    found = []
    for group in _groups(poles, np.array(orders), *_BETWEEN_ORDERS):
        if len(group) < _FEWEST_ORDERS:
            break
        frequency, damping = np.median([(poles[at].frequency_hz, poles[at].damping) for at in group], axis=0).tolist()
        found.append(Mode(frequency, damping, poles[group[0]].shape, len(group)))
    return sorted(found, key=lambda mode: mode.frequency_hz)


def _oscillates(rates: ComplexArray, window: WindowStatistics) -> BoolArray:
    """Which poles may be modes: damped, within the band, and not at a multiple of running speed, as a line may be."""
    frequency, (lowest_hz, highest_hz) = np.abs(rates), window.frequencies_hz[[0, -1]]
    in_band = (frequency > 2 * np.pi * lowest_hz) & (frequency < 0.9 * 2 * np.pi * highest_hz)
    multiples = window.speed_rad_s * np.arange(1, _MULTIPLES + 1)
    beside = ~np.any(np.abs(frequency[:, None] / multiples - 1) < _BESIDE, axis=1)  # true of a speed that is not known
    return np.asarray(
        (rates.imag > 0) & (rates.real < 0) & (-rates.real < _MOST_DAMPING * frequency) & in_band & beside
    )


def _groups(found: Sequence[Mode], origin: np.ndarray, within: float, alike: float) -> Iterator[list[int]]:
    """Which of the modes found are one and the same, largest group first; each has one of every origin at most."""
    if not found:
        return
    frequencies, shapes = np.array([mode.frequency_hz for mode in found]), np.array([mode.shape for mode in found])
    apart = np.abs(frequencies / frequencies[:, None] - 1)
    same = (apart < within) & (_assurance(shapes, shapes) > alike)
    of_origin = origin[:, None] == np.unique(origin)
    left = np.ones(len(found), dtype=bool)
    while left.any():
        counts = np.where(left, ((same & left) @ of_origin.astype(np.float64) > 0).sum(axis=1), 0)
        centre = int(np.argmax(counts))
        members = np.flatnonzero(same[centre] & left)
        members = members[np.argsort(apart[centre, members], kind="stable")]
        yield [int(members[at]) for at in np.sort(np.unique(origin[members], return_index=True)[1])]
        left[members] = False


def _assurance(first: ComplexArray, second: ComplexArray) -> FloatArray:
    """Modal assurance criterion of shapes of length 1, (n, n_states) and (m, n_states): shape (n, m)."""
    return np.asarray(np.abs(first.conj() @ second.T) ** 2, dtype=np.float64)
