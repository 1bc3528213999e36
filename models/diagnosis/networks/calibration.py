"""Calibration of the networks on simulated windows: bias, gain and true size of the errors of their readings.

Readings are compared with the truth in windows in which everything changes, including own parameters: a network that
has learned to explain part of its own parameter's change reads only the rest, and an error that all hops of a window
share does not show in their scatter. Errors with heavy tails follow Student's t: a standard error that is right for
95 % of the windows says little about one in a thousand.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.optimize import minimize
from scipy.special import ndtri, poch, stdtrit

from models.diagnosis.networks.amortised import OWN, AmortisedNetworks, Calibration, NetworkDiagnostician
from models.diagnosis.networks.relation import EquationNetwork, Healthy, read_equation
from models.diagnosis.readings import Z95
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine
from models.signals.block import FloatArray

Held = tuple[WindowStatistics, dict[str, float]]
"""A window and its true relative changes by parameter; parameters not in it are nominal."""
_MAD = 1.4826  # ratio of standard deviation to median absolute deviation
_FREEDOMS = (3.0, 5.0, 8.0, 12.0, 20.0, 40.0, 100.0)
# A hundred windows per layout of the sources hardly distinguish 5 degrees of freedom from the 11 of the scatter of
# twelve hops; 300 windows of `lab` with one source show 3 to 5 for the stiffness.
_RELATION_FREEDOMS = (3.0, 4.0, 5.0)
_LEAST_GAIN = 0.02


def calibrate(
    trained: EquationNetwork, healthy: Iterable[WindowStatistics], changed: Sequence[Iterable[Held]], machine: Machine
) -> EquationNetwork:
    """Measure how a relation network reads windows with seeds other than those of the training.

    In `healthy` windows the equation's own parameters are nominal. In `changed` ones they are changed, too, while other
    parameters that the equation assumes unchanged are nominal. `changed` has one group for each layout of the sources;
    the group with the heaviest tails determines the degrees of freedom.
    """
    raw = replace(trained, healthy=None)
    names = trained.equation.parameters

    def read(window: WindowStatistics) -> tuple[float, list[float], list[float]]:
        one = read_equation(raw, window, machine)
        own = [(reading.relative_change or 0.0, reading.standard_error or 0.0) for reading in one.parameters]
        return one.msd or 0.0, [change for change, _ in own], [error for _, error in own]

    groups = [
        [(*read(window)[1:], [changes.get(name, 0.0) for name in names]) for window, changes in group]
        for group in changed
    ]
    figures = [np.array(group, dtype=np.float64).transpose(1, 2, 0) for group in groups]  # (3, n_parameters, n)
    fitted = [_relation_errors([group[:, k] for group in figures]) for k in range(len(names))]
    z_scale, floor, gain, freedom = (tuple(part) for part in zip(*fitted, strict=True))
    still = [read(window)[:2] for window in healthy]
    spread = np.median(np.abs([change for _, change in still]), axis=0) * _MAD / np.array(gain)
    healthy_figures = Healthy(
        windows=len(still) + sum(map(len, groups)),
        msd=float(np.mean([msd for msd, _ in still])),
        z_scale=z_scale,
        spread=tuple(spread.tolist()),
        floor=floor,
        gain=gain,
        freedom=freedom,
    )
    return replace(trained, healthy=healthy_figures)


def _relation_errors(groups: Sequence[FloatArray]) -> tuple[float, float, float, float]:
    """Scale, floor, gain and degrees of freedom by maximum likelihood for change = gain · true + error.

    Each group, shape (3, n), holds the projected change, its scatter over the hops, and the true change.
    """
    freedom = min(min((_fitted(group, one)[0], one) for one in _RELATION_FREEDOMS)[1] for group in groups)
    _, scale, floor, gain = _fitted(np.concatenate(groups, axis=1), freedom)
    wider = _t_factor(freedom) / gain
    return scale * wider, floor * wider, gain, freedom


def _fitted(figures: FloatArray, freedom: float) -> tuple[float, float, float, float]:
    """Smallest negative log-likelihood, with its scale, floor and gain."""
    change, scatter, true = figures
    usual = float(np.median(scatter))

    def unlikely(point: FloatArray) -> float:
        scale, floor, gain = np.exp(point)
        error = np.hypot(scale * scatter, floor * usual)
        return -float(np.sum(_t_logpdf((change - gain * true) / error, freedom) - np.log(error)))

    starts = [np.array([0.0, start, -0.1]) for start in (-1.0, 1.0)]
    found = [minimize(unlikely, start, method="Nelder-Mead", options={"maxiter": 2000}) for start in starts]
    best = min(found, key=lambda one: float(one.fun))
    scale, floor, gain = np.exp(best.x).tolist()
    return float(best.fun), scale, floor * usual, max(gain, _LEAST_GAIN)


def _t_logpdf(x: FloatArray, freedom: float) -> FloatArray:
    """Like `scipy.stats.t.logpdf`, which spends ten times as long on checking its arguments as on computing."""
    constant = np.log(poch(0.5 * freedom, 0.5)) - 0.5 * (np.log(freedom) + np.log(np.pi))
    return np.asarray(constant - (freedom + 1) / 2 * np.log1p(x * x / freedom), dtype=np.float64)


def _t_factor(freedom: float) -> float:
    """Factor on the scale of a t distribution with which ±1.96 scales contain 95 %."""
    return float(stdtrit(freedom, 0.975)) / Z95


_KNOTS = 3
_QUANTILES = (0.9, 0.95, 0.98)
_FEWEST_OF_KNOT = 40  # least number of windows for the quantiles of a knot


def calibrate_networks(
    machine: Machine, trained: AmortisedNetworks, coherent: Iterable[Held], independent: Iterable[Held]
) -> AmortisedNetworks:
    """Measure the bias of the amortised networks and the true size of their standard errors.

    With one source the forces are coherent, with independent sources they are not. Both cases are calibrated
    separately, on windows with seeds of their own; the coherence of a window tells which calibration applies.
    """
    reader = NetworkDiagnostician(machine, trained)
    calibrated, coherences = [], []
    for windows in (coherent, independent):
        errors: dict[str, list[tuple[float, float]]] = {}
        seen: list[float] = []
        for window, changes in windows:
            found = reader.inputs(window)
            if found is None:
                continue
            inputs, coherence = found
            seen.append(coherence)
            for equation, (mean, factor) in reader.stated(window, inputs).items():
                for name, value, deviation in zip(OWN[equation], mean, np.linalg.norm(factor, axis=1), strict=True):
                    error = float(value - np.log1p(changes.get(name, 0.0)))
                    errors.setdefault(name, []).append((error, float(deviation)))
        calibrated.append({name: _calibration(np.array(pairs)) for name, pairs in errors.items()})
        coherences.append(seen)
    # Midway between the 1 % quantile of coherent windows and the 99 % quantile of the others.
    limit = (float(np.quantile(coherences[0], 0.01)) + float(np.quantile(coherences[1], 0.99))) / 2
    return replace(trained, calibration=calibrated[1], coherent=calibrated[0], coherence_limit=limit)


def _calibration(pairs: FloatArray) -> Calibration:
    """Bias, and scale of z by thirds of the stated standard error, as precise and imprecise readings differ."""
    error, deviation = pairs[:, 0], pairs[:, 1]
    # Weighted median: windows that determine the parameter well count more.
    order, weight = np.argsort(error), 1 / deviation**2
    cumulated = np.cumsum(weight[order])
    bias = float(error[order][np.searchsorted(cumulated, cumulated[-1] / 2)])
    z = np.abs(error - bias) / deviation
    n_knots = max(1, min(_KNOTS, len(pairs) // _FEWEST_OF_KNOT))
    knots, scales = [], []
    for low, high in pairwise(np.quantile(deviation, np.linspace(0, 1, n_knots + 1))):
        own = (deviation >= low) & (deviation <= high)
        knots.append(float(np.median(np.log(deviation[own]))))
        # The mean of several quantiles scatters less than one quantile, and includes the tail.
        scales.append(float(np.mean(np.quantile(z[own], _QUANTILES) / ndtri((1 + np.array(_QUANTILES)) / 2))))
    scaled = z / np.interp(np.log(deviation), knots, scales)
    # Only the shape is fitted: for any degrees of freedom, ±1.96 standard errors contain 95 %.
    freedom = max(_FREEDOMS, key=lambda n: float(np.sum(_t_logpdf(scaled * _t_factor(n), n) + np.log(_t_factor(n)))))
    return Calibration(bias=bias, log_deviation=tuple(knots), z_scale=tuple(scales), freedom=freedom)
