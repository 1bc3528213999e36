"""Minimum detectable change: what this machine, with this excitation, would have to show to be noticed."""

import numpy as np
from scipy.special import ndtri

from models.diagnosis.verdict.calibration import Thresholds
from models.diagnosis.verdict.stretch import Stretch, from_scale, to_scale
from rotorwatch.records.windows import Detectable

__all__ = ["detectable_changes", "length_to_find"]

_POWER = 0.95


def detectable_changes(
    stretch: Stretch, thresholds: Thresholds, length_s: float, power: float = _POWER
) -> tuple[Detectable, ...]:
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
    distance, errors = thresholds.first + float(ndtri(power)), np.sqrt(np.diag(stretch.estimate()[1])).tolist()
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
    """Data it takes to find another change of the parameter: standard errors fall as one over the root of the length.

    Parameters
    ----------
    found : Detectable
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
