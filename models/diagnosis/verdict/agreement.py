"""Whether two diagnosticians say the same of a parameter."""

import math
from dataclasses import dataclass
from enum import StrEnum

from models.diagnosis.readings import Diagnosis, ParameterReading
from models.diagnosis.verdict.calibration import window_thresholds
from models.physics.parameters import PARAMETERS

__all__ = ["Agreement", "Verdict", "agreements"]

_RATE = 1e-3
"""Probability that two diagnosticians who are both right are said to disagree in a window, about any parameter."""


class Verdict(StrEnum):
    """What comparing two opinions on a parameter gives."""

    AGREE = "agree"
    DISAGREE = "disagree"
    ONLY_ONE = "only-one"


@dataclass(frozen=True, slots=True)
class Agreement:
    """Comparison of two diagnosticians on one parameter.

    Attributes
    ----------
    name : str
        Parameter.
    between : tuple of str
        The diagnosticians.
    verdict : Verdict
        Agree, disagree, or only one of them could read the parameter.
    difference_z : float or None
        Second minus first change, in units of the combined standard error. Both look at the same data, so the combined
        standard error is rather too large and a disagreement is meant.
    """

    name: str
    between: tuple[str, str]
    verdict: Verdict
    difference_z: float | None = None


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
            verdict = Verdict.AGREE if abs(z) <= threshold else Verdict.DISAGREE
            found.append(Agreement(name, between, verdict, z))
        elif name in one or name in other:
            found.append(Agreement(name, between, Verdict.ONLY_ONE))
    return tuple(found)


def _difference_z(one: ParameterReading, other: ParameterReading) -> float:
    difference = (other.change or 0.0) - (one.change or 0.0)
    error = math.hypot(one.standard_error or 0.0, other.standard_error or 0.0)
    return difference / error if error > 0 else math.inf * difference if difference else 0.0
