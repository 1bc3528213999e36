"""Thresholds that keep declared false-alarm rates, minimum detectable changes, and agreement of diagnosticians."""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from scipy.special import ndtr, ndtri, stdtr, stdtrit

from models.diagnosis.readings import Z95, Diagnosis, no_reading
from models.diagnosis.verdict.stretch import Stretch, from_scale, to_scale
from models.physics.rotor import PARAMETERS
from rotorwatch.records.windows import Agreement, Detectable, Parameter

MONTH_S = 30 * 86400.0  # the month of "false alarms per month", s
_FURTHER_PART = 0.25  # share of the rate at which a parameter is wrongly added to one that is known to have changed


@dataclass(frozen=True, slots=True)
class Thresholds:
    """What a test value must exceed, in standard errors."""

    first: float  # for the first changed parameter: this one carries the declared rate
    further: float  # for every one more; larger, because a wrong name beside a right one misleads
    outside: float  # for the over-identification test (one-sided), which has the declared rate to itself


def _upper_quantile(probability: float) -> float:
    """Point that a standard normal exceeds with this probability."""
    return -float(ndtri(probability))


def _rate_per_test(probability: float, tests: int) -> float:
    """Probability for each of several tests that keeps `probability` for all of them (Šidák)."""
    return -math.expm1(math.log1p(-probability) / tests)


def window_thresholds(rate: float, n_parameters: int) -> Thresholds:
    """Thresholds of one window by itself; `rate` is the probability, over all parameters, of a false alarm in it."""
    others = max(1, n_parameters - 1)
    return Thresholds(
        first=_upper_quantile(_rate_per_test(rate, n_parameters) / 2),
        further=_upper_quantile(_rate_per_test(_FURTHER_PART * rate, others) / 2),
        outside=_upper_quantile(rate),
    )


def overshoot_correction(x: float) -> float:
    """Siegmund's ν(x): how much rarer a crossing is in discrete time.

    x is the threshold times the standard deviation of one step; 0 is continuous time, where ν = 1.
    """
    if x < 1e-6:
        return 1.0
    density = math.exp(-(x**2) / 8) / math.sqrt(2 * math.pi)
    distribution = float(ndtr(x / 2))
    return (2 / x) * (distribution - 0.5) / (x / 2 * distribution + density)


def crossing_rate(threshold: float, overlap: int) -> float:
    """How often per hop a sliding window's test value newly exceeds a threshold, upwards only.

    The test value of a window of `overlap` hops (one if windows do not overlap) is a moving average of independent
    hops: its autocorrelation falls linearly to zero over the window. For such a process the rate is b φ(b) μ ν(b √(2μ))
    with μ = 1/overlap and the threshold b, in standard errors; -b is crossed downwards as often.
    """
    tail = float(ndtr(-threshold))
    if overlap <= 1:
        return tail
    density = math.exp(-(threshold**2) / 2) / math.sqrt(2 * math.pi)
    rate = threshold * density / overlap * overshoot_correction(threshold * math.sqrt(2 / overlap))
    return min(rate, tail)


def month_thresholds(
    per_month: float, hop_s: float, overlap: int, n_parameters: int, n_stretches: int = 1
) -> Thresholds:
    """Thresholds of a sliding window of `overlap` hops that is tested at every hop.

    The machine is to have `per_month` false alarms in 30 days of data. If windows of `n_stretches` different lengths
    are tested side by side, each gets an equal share of that rate.
    """
    per_hop = per_month * hop_s / MONTH_S / n_stretches
    others = max(1, n_parameters - 1)
    return Thresholds(
        first=_crossing_threshold(per_hop / (2 * n_parameters), overlap),
        further=_crossing_threshold(_FURTHER_PART * per_hop / (2 * others), overlap),
        outside=_crossing_threshold(per_hop * n_stretches, overlap),
    )


@lru_cache(maxsize=256)
def _crossing_threshold(per_hop: float, overlap: int) -> float:
    """Threshold with this crossing rate; never below one standard error, where crossings are as frequent as can be."""
    low, high = 1.0, 37.0
    if crossing_rate(low, overlap) <= per_hop:
        return low
    while low < (middle := (low + high) / 2) < high:  # a root finder of SciPy's would take 0.1 s to import
        low, high = (middle, high) if crossing_rate(middle, overlap) > per_hop else (low, middle)
    return low


# Probability that two diagnosticians who are both right are said to disagree in a window, about any parameter.
_DISAGREEMENT_RATE = 1e-3


def agreements(first: Diagnosis, second: Diagnosis) -> tuple[Agreement, ...]:
    """Compare two diagnosticians' readings of one window, parameter by parameter, in the order of `PARAMETERS`.

    Parameters that neither of them could read are left out.
    """
    one, other = ({reading.name: reading for reading in diagnosis.evaluable} for diagnosis in (first, second))
    between = (first.by, second.by)
    common = sum(name in one and name in other for name in PARAMETERS)
    threshold = window_thresholds(_DISAGREEMENT_RATE, max(1, common)).first
    found = []
    for name in PARAMETERS:
        if name in one and name in other:
            freedom = (first.freedom.get(name, math.inf), second.freedom.get(name, math.inf))
            z = _difference_z(one[name], other[name], freedom)
            verdict: Literal["agree", "disagree"] = "agree" if abs(z) <= threshold else "disagree"
            found.append(Agreement(name=name, between=between, verdict=verdict, difference_z=z))
        elif name in one or name in other:
            found.append(Agreement(name=name, between=between, verdict="only-one"))
    return tuple(found)


def _difference_z(one: Parameter, other: Parameter, freedom: tuple[float, float]) -> float:
    """Difference of two readings as a standard normal value.

    Standard errors are such that the 95 % interval holds 95 %. With few degrees of freedom the tails beyond are heavier
    than normal; those of the difference are approximated after F. E. Satterthwaite, Biometrics Bulletin 2 (1946).
    """
    difference = (other.relative_change or 0.0) - (one.relative_change or 0.0)
    errors = (one.standard_error or 0.0, other.standard_error or 0.0)
    if math.hypot(*errors) == 0:
        return math.inf * difference if difference else 0.0
    z = difference / math.hypot(*errors)
    scales = [_scale(n) * error for error, n in zip(errors, freedom, strict=True)]
    variance = sum(scale**2 for scale in scales)
    uncertain = sum(scale**4 / n for scale, n in zip(scales, freedom, strict=True))
    if uncertain == 0:
        return z
    tail = float(stdtr(variance**2 / uncertain, -abs(difference) / math.sqrt(variance)))
    return math.copysign(_upper_quantile(tail), difference) if tail > 0 else z


def _scale(freedom: float) -> float:
    """Scale of the t distribution that has 95 % within ±1.96."""
    return Z95 / float(stdtrit(freedom, 0.975)) if freedom < math.inf else 1.0


def widened(diagnosis: Diagnosis, rate: float) -> Diagnosis:
    """The diagnosis with errors so wide that normal thresholds keep a declared rate, however few degrees of freedom."""
    if not diagnosis.freedom:
        return diagnosis
    readings = diagnosis.evaluable
    tail = _rate_per_test(rate, max(1, len(readings))) / 2
    wider = np.ones(len(readings))
    for position, reading in enumerate(readings):
        freedom = diagnosis.freedom.get(reading.name, math.inf)
        if freedom < math.inf:
            wider[position] = -float(stdtrit(freedom, tail)) * _scale(freedom) / _upper_quantile(tail)
    return replace(diagnosis, covariance=diagnosis.full_covariance * np.outer(wider, wider))


def beside(first: Diagnosis, second: Diagnosis) -> Diagnosis:
    """The second diagnosis without readings that may only reflect changes of other parameters found by the first.

    Equation (29) reads the unbalance assuming an unchanged shaft: a changed shaft looks to it like an unbalance.
    """
    read = {reading.name: reading for reading in first.evaluable}
    changed = {name for name, one in read.items() if abs(one.z or 0.0) > window_thresholds(_DISAGREEMENT_RATE, 1).first}
    parameters = []
    for one in second.parameters:
        shifts = {
            name: times * (read[name].relative_change or 0.0)
            for name, times in second.taken_for.get(one.name, {}).items()
            if name in changed
        }
        if one.relative_change is not None and sum(map(abs, shifts.values())) > (one.standard_error or 0.0):
            reason = f"not told from the change of {', '.join(shifts)} that the {first.by} reads"
            one = no_reading(one.name, second.by, reason)  # noqa: PLW2901
        parameters.append(one)
    return replace(second, parameters=tuple(parameters))


_POWER = 0.95


def detectable_changes(stretch: Stretch, thresholds: Thresholds, length_s: float) -> tuple[Detectable, ...]:
    """Minimum detectable changes of a stretch of data, from its own information.

    In the scale of the errors the change is (threshold + quantile of the power) times the standard error. The standard
    error is the one with all other parameters free, because the change is not only to be noticed but also to be told
    from a change of any other parameter; where estimates are correlated, the power with which it is found is therefore
    higher than stated. The errors of a parameter hardly depend on its value.
    """
    distance, errors = thresholds.first + float(ndtri(_POWER)), np.sqrt(np.diag(stretch.estimate[1])).tolist()
    return tuple(
        Detectable(
            name=name,
            loss=max(-1.0, from_scale(name, -distance * error)),
            gain=from_scale(name, distance * error),
            length_s=length_s,
        )
        for name, error in zip(stretch.names, errors, strict=True)
    )


def length_to_find(found: Detectable, change: float) -> float:
    """Length of data, s, that finds another change of the parameter: errors fall with the square root of the length."""
    return found.length_s * (to_scale(found.name, found.gain) / to_scale(found.name, change)) ** 2
