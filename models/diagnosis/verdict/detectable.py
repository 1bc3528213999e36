"""Minimum detectable change: what this machine, with this excitation, would have to show to be noticed."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from models.diagnosis.verdict.calibration import Thresholds
from models.diagnosis.verdict.stretch import Stretch, from_scale, to_scale

__all__ = ["DetectableChange", "detectable_changes", "length_for", "length_to_find"]

_POWER = 0.95


@dataclass(frozen=True, slots=True)
class DetectableChange:
    """Smallest change of one parameter, alone, that is found with the stated power.

    Attributes
    ----------
    name : str
        Parameter.
    loss, gain : float
        Relative change downwards (negative; -1 where even a total loss would not be found for certain) and upwards.
    length_s : float
        Data it takes.
    """

    name: str
    loss: float
    gain: float
    length_s: float


def detectable_changes(
    stretch: Stretch, thresholds: Thresholds, length_s: float, power: float = _POWER
) -> tuple[DetectableChange, ...]:
    """Minimum detectable changes of a stretch of data, from its own information.

    In the scale of the errors the change is (threshold + quantile of the power) times the standard error. The standard
    error is the one with all other parameters free: the change shall not only be noticed, it shall be told from a
    change of any other parameter, so where estimates hang together the power is higher than stated.

    Parameters
    ----------
    stretch : Stretch
        What the data says; the errors of a parameter hardly depend on its value.
    thresholds : Thresholds
        From the declared rate.
    length_s : float
        Length of the data in it, s.
    power : float
        Probability of finding the change.
    """
    variances = np.diag(stretch.estimate()[1]).tolist()
    return tuple(
        _detectable(name, math.sqrt(variance), length_s, thresholds, power)
        for name, variance in zip(stretch.names, variances, strict=True)
    )


def _detectable(
    name: str, standard_error: float, length_s: float, thresholds: Thresholds, power: float
) -> DetectableChange:
    size = (thresholds.first + float(ndtri(power))) * standard_error
    return DetectableChange(name, max(-1.0, from_scale(name, -size)), from_scale(name, size), length_s)


def length_for(
    name: str, change: float, standard_error: float, length_s: float, thresholds: Thresholds, power: float = _POWER
) -> float:
    """Data it takes to find a change of one parameter whose standard error is known.

    Parameters
    ----------
    name : str
        Parameter.
    change : float
        Relative change that is to be found, not 0 and above -1.
    standard_error : float
        Of the parameter in the scale of its errors, on data of `length_s`.
    length_s : float
        Length that `standard_error` belongs to, s.
    thresholds : Thresholds
        From the declared rate.
    power : float
        Probability of finding it.

    Returns
    -------
    float
        Length, s.

    Raises
    ------
    ValueError
        If the change is 0 or -1 and below.
    """
    return length_to_find(_detectable(name, standard_error, length_s, thresholds, power), change)


def length_to_find(found: DetectableChange, change: float) -> float:
    """Data it takes to find another change of the parameter: standard errors fall as one over the root of the length.

    Parameters
    ----------
    found : DetectableChange
        Smallest change and the length it takes.
    change : float
        Relative change that is to be found instead, not 0 and above -1.

    Returns
    -------
    float
        Length, s.

    Raises
    ------
    ValueError
        If the change is 0 or -1 and below.
    """
    if change == 0 or not change > -1:
        raise ValueError(f"change of {found.name} to be found is {change}, expected above -1 and not 0")
    return found.length_s * (to_scale(found.name, found.gain) / to_scale(found.name, change)) ** 2
