"""Alternative methods on the same samples: operational modal analysis, and a feature vector.

Both learn the distribution of healthy windows and measure a window's distance from it (Hotelling's T²). Neither knows
the machine's parameters, and neither says which one changed.

The subspace identification is pyOMA2's covariance-driven SSI. Its defaults are changed where they would reject the
modes of a rotor: hard criteria on mode phase collinearity or deviation reject complex mode shapes, such as forward and
backward whirl, and a damping limit of 10 % rejects well-damped bearings.
"""

import logging

import numpy as np
import scipy.optimize
import scipy.signal
import scipy.stats

from models.diagnosis.window.moments import plan_for
from models.errors import EstimationError
from models.machine import Machine
from models.physics.rotor import STATE_INDEX, system_A
from models.signals.block import FloatArray

_MORE_ORDERS = 16
"""Model orders run from twice the number of modes to 16 above it, as in a stabilisation diagram; the result is their
median."""
_BLOCK_ROWS_PER_PERIOD = 1.4
_MOST_DAMPING = 0.3
_NEAREST = 0.3  # largest relative difference in frequency between a pole and a reference mode
_LEAST_MAC = 0.5
_MOST_SHARE_LOST = 0.5
_LEAST_SHARE_THERE = 0.8
_BANDS = 6


class Hotelling:
    """Hotelling's T² of features, with the mean and covariance of healthy windows; `shrink` after Ledoit and Wolf.

    Features that more than a fifth of the healthy windows lack are not used; T² of a window is computed from those of
    the other features that it has.
    """

    def __init__(self, *, shrink: bool) -> None:
        self._shrink = shrink
        self._used = np.empty(0, dtype=np.intp)

    def fit(self, healthy: FloatArray) -> None:
        """Learn from the features of healthy windows, shape (n_windows, n_features)."""
        used = np.flatnonzero(np.isfinite(healthy).mean(axis=0) >= _LEAST_SHARE_THERE)
        complete = healthy[np.all(np.isfinite(healthy[:, used]), axis=1)][:, used]
        n, p = complete.shape
        if p == 0 or n < 4 or (not self._shrink and n <= p):
            raise EstimationError(f"{n} complete healthy windows for {p} features, expected at least {max(4, p + 1)}")
        self._mean, self._scale = complete.mean(axis=0), complete.std(axis=0)
        standard = (complete - self._mean) / self._scale
        self._covariance: FloatArray = standard.T @ standard / (n - 1)
        if self._shrink:
            from sklearn.covariance import ledoit_wolf  # noqa: PLC0415  # takes a second to import

            self._covariance = np.asarray(ledoit_wolf(standard, assume_centered=True)[0], dtype=np.float64)
        self._used = used

    def score(self, features: FloatArray) -> float:
        """T² of one window's features; NaN if it has none."""
        if not self._used.size:
            raise EstimationError("a window was to be scored before any healthy window was learned from")
        standard = (features[self._used] - self._mean) / self._scale
        there = np.flatnonzero(np.isfinite(standard))
        if not there.size:
            return float("nan")
        return float(standard[there] @ np.linalg.solve(self._covariance[np.ix_(there, there)], standard[there]))


class SubspaceModes(Hotelling):
    """Natural frequencies and damping ratios by SSI-cov, tracked by frequency and mode shape."""

    name = "SSI-cov"

    def __init__(self, machine: Machine) -> None:
        super().__init__(shrink=False)
        plan = plan_for(machine)
        self._states, self._has_angle = plan.states, plan.angle_column is not None
        # The new Nyquist frequency stays 30 % above the band, as the decimation filter requires.
        self._factor = max(1, int(plan.rate_hz / (2.6 * machine.window.band_hz[1])))
        self._rate_hz = plan.rate_hz / self._factor
        self._frequency, self._shapes = reference_modes(machine)
        self._block_rows = max(8, round(_BLOCK_ROWS_PER_PERIOD * self._rate_hz / self._frequency[0]))
        self._orders = range(2 * self._frequency.size, 2 * self._frequency.size + _MORE_ORDERS + 1, 2)

    def features(self, samples: FloatArray) -> FloatArray:
        """Frequencies, Hz, and damping ratios of the tracked modes, shape (2 n_modes,); NaN where a mode is lost."""
        rest, _ = _without_rotation(samples, len(self._states), self._has_angle)
        if self._factor > 1:
            rest = scipy.signal.decimate(rest, self._factor, ftype="fir", axis=0)
        deviation = rest.std(axis=0)
        frequency, damping, shapes = _poles(rest / deviation, self._block_rows, self._orders[-1], self._rate_hz)
        found = np.full((len(self._orders), 2, self._frequency.size), np.nan)
        for row, order in enumerate(n // 2 for n in self._orders):
            there = np.flatnonzero(np.isfinite(frequency[:, order]))
            if there.size:
                own = shapes[there, order] * deviation
                for mode, pole in self._matched(frequency[there, order], own):
                    found[row, :, mode] = frequency[there[pole], order], damping[there[pole], order]
        lost = np.isnan(found[:, 0]).mean(axis=0) > _MOST_SHARE_LOST
        middle = np.array([[_median(values) for values in kind.T] for kind in found.transpose(1, 0, 2)])
        middle[:, lost] = np.nan
        return middle.ravel()

    def _matched(self, frequency: FloatArray, shapes: FloatArray) -> list[tuple[int, int]]:
        """Pairs of reference mode and pole, assigned by the least sum of relative frequency difference and 1 - MAC."""
        away = np.abs(frequency[None, :] / self._frequency[:, None] - 1)
        mac = np.stack([_mac(reference, shapes / _units(self._states, frequency)) for reference in self._shapes])
        pairs = zip(*scipy.optimize.linear_sum_assignment(away + (1 - mac)), strict=True)
        return [(int(m), int(p)) for m, p in pairs if away[m, p] < _NEAREST and mac[m, p] > _LEAST_MAC]


class FeatureVector(Hotelling):
    """Kurtosis, and logarithms of rms, 1× amplitude and levels in bands of equal logarithmic width, per channel."""

    name = "features"

    def __init__(self, machine: Machine) -> None:
        super().__init__(shrink=True)
        plan = plan_for(machine)
        self._n_states, self._has_angle = len(plan.states), plan.angle_column is not None
        self._rate_hz = plan.rate_hz
        self._edges_hz = np.geomspace(*machine.window.band_hz, _BANDS + 1)
        self._segment = round(machine.window.segment_s * plan.rate_hz)

    def features(self, samples: FloatArray) -> FloatArray:
        """All features, shape (n_channels · (2 + n_bands [+ 1]),)."""
        rest, amplitude = _without_rotation(samples, self._n_states, self._has_angle)
        x = samples[:, : self._n_states]
        frequency, density = scipy.signal.welch(rest, self._rate_hz, nperseg=self._segment, axis=0)
        bands = [
            np.log(density[(frequency >= low) & (frequency < high)].mean(axis=0))
            for low, high in zip(self._edges_hz[:-1], self._edges_hz[1:], strict=True)
        ]
        parts = [np.log(x.std(axis=0)), scipy.stats.kurtosis(x, axis=0), *bands]
        return np.concatenate([*parts, np.log(amplitude)] if self._has_angle else parts)


def reference_modes(machine: Machine) -> tuple[FloatArray, FloatArray]:
    """Modes of the nominal machine within the likelihood's band, as a user would select them from the diagram.

    Returns frequencies, Hz, and shapes at the measured states, (n_modes, n_states), with velocities divided by the
    mode's angular frequency.
    """
    values, vectors = np.linalg.eig(system_A(machine.rotor, machine.operation.speed_rad_s))
    frequency = np.abs(values) / (2 * np.pi)
    low, high = machine.window.band_hz
    keep = np.flatnonzero((values.imag > 0) & (frequency > low) & (frequency < high))
    keep = keep[np.argsort(frequency[keep])]
    states = plan_for(machine).states
    shapes = vectors[[STATE_INDEX[name] for name in states]][:, keep].T
    return frequency[keep], shapes / _units(states, frequency[keep])


def _units(states: tuple[str, ...], frequency_hz: FloatArray) -> FloatArray:
    """Divisors that make velocities comparable with displacements, shape (n_modes, n_states)."""
    rates = np.array([name.endswith("_dot") for name in states])
    return np.where(rates, 2 * np.pi * frequency_hz[:, None], 1.0)


def _without_rotation(samples: FloatArray, n_states: int, has_angle: bool) -> tuple[FloatArray, FloatArray]:
    """Channels with mean and 1× part removed, and the 1× amplitudes (zero without a shaft angle)."""
    x = samples[:, :n_states]
    angle = [np.cos(samples[:, n_states]), np.sin(samples[:, n_states])] if has_angle else []
    regressors = np.stack([np.ones(len(x)), *angle], axis=1)
    beta = np.linalg.lstsq(regressors, x, rcond=None)[0]
    return x - regressors @ beta, np.hypot(beta[1], beta[2]) if has_angle else np.zeros(n_states)


def _poles(x: FloatArray, block_rows: int, most: int, rate_hz: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Frequencies, damping ratios and shapes of all poles, one column for each even order from 0 on."""
    with np.errstate():  # the library changes numpy's error state on import
        from pyoma2.functions.ssi import SSI_fast, SSI_poles, build_hank  # noqa: PLC0415  # because of numpy's error state

        logging.getLogger("pyoma2").setLevel(logging.WARNING)  # it reports every step
        np.seterr(divide="ignore", invalid="ignore")
        hankel, _ = build_hank(x.T, x.T, block_rows, "cov_R")
        observability, A, C, _ = SSI_fast(hankel, block_rows, most, step=2)
        frequency, damping, shapes, *_ = SSI_poles(
            observability, A, C, most, 1 / rate_hz, step=2, HC=True, xi_max=_MOST_DAMPING  # type: ignore[arg-type]
        )  # fmt: skip
    return frequency, damping, shapes


def _mac(reference: FloatArray, shapes: FloatArray) -> FloatArray:
    """Modal assurance criterion of complex shapes with a reference, shape (n_poles,)."""
    overlap = np.abs(shapes.conj() @ reference) ** 2
    norms = np.sum(np.abs(shapes) ** 2, axis=1) * np.sum(np.abs(reference) ** 2)
    return np.asarray(overlap / norms, dtype=np.float64)


def _median(values: FloatArray) -> float:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if values.size else np.nan
