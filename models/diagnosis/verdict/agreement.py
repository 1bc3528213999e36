"""Whether two diagnosticians say the same of a parameter."""

import math
from typing import Literal

from models.diagnosis.readings import Diagnosis
from models.diagnosis.verdict.calibration import window_thresholds
from models.physics.parameters import PARAMETERS
from rotorwatch.records.windows import Agreement, Parameter

__all__ = ["agreements"]

_RATE = 1e-3
"""Probability that two diagnosticians who are both right are said to disagree in a window, about any parameter."""


def agreements(first: Diagnosis, second: Diagnosis) -> tuple[Agreement, ...]:
    """Compare two diagnosticians parameter by parameter.

    Parameters
    ----------
    first, second : Diagnosis
        Of the same window.

    Returns
    -------
    tuple of Agreement
        One per parameter that at least one of them could read, in the order of `PARAMETERS`.
    """
    one, other = ({reading.name: reading for reading in diagnosis.evaluable} for diagnosis in (first, second))
    between = (first.by, second.by)
    common = sum(name in one and name in other for name in PARAMETERS)
    threshold = window_thresholds(_RATE, max(1, common)).first
    found = []
    for name in PARAMETERS:
        if name in one and name in other:
            z = _difference_z(one[name], other[name])
            verdict: Literal["agree", "disagree"] = "agree" if abs(z) <= threshold else "disagree"
            found.append(Agreement(name=name, between=between, verdict=verdict, difference_z=z))
        elif name in one or name in other:
            found.append(Agreement(name=name, between=between, verdict="only-one"))
    return tuple(found)


def _difference_z(one: Parameter, other: Parameter) -> float:
    difference = (other.relative_change or 0.0) - (one.relative_change or 0.0)
    error = math.hypot(one.standard_error or 0.0, other.standard_error or 0.0)
    return difference / error if error > 0 else math.inf * difference if difference else 0.0
