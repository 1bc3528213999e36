"""Whether healthy windows of different conditions tell of one relation: each is read against what the others teach."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, ndtri

from models.diagnosis.baseline.lag_moments import LagMoments
from models.diagnosis.baseline.relation import RowChange, change_of, learn_row
from models.diagnosis.baseline.rows import Row
from models.errors import EstimationError
from models.signals.block import FloatArray

__all__ = ["HeldOutReading", "LeftOut", "allowance_of", "left_out"]

_FOLDS = 6
_FEWEST_OTHERS = 2
_BEYOND = 2.0  # standard deviations of a mean beyond which it is taken for more than scatter


@dataclass(frozen=True, slots=True)
class HeldOutReading:
    """One parameter of one healthy window, read against the relation that the other conditions teach.

    Attributes
    ----------
    change, standard_error : float
        Relative change and its standard error, the relation's included.
    """

    parameter: str
    change: float
    standard_error: float

    @property
    def z(self) -> float:
        """Change in standard errors: standard normal if one relation holds for all."""
        return self.change / self.standard_error


@dataclass(frozen=True, slots=True)
class LeftOut:
    """One healthy window of one row against what the windows of other conditions teach.

    Attributes
    ----------
    row : str
        Name of the row.
    window : int
        Number of the window, from 0.
    condition : str
        What it belongs to.
    agreements : tuple of HeldOutReading
        One for each of the row's own parameters.
    misfit : float
        χ² of what is left per degree of freedom.
    """

    row: str
    window: int
    condition: str
    agreements: tuple[HeldOutReading, ...]
    misfit: float
    degrees_of_freedom: int

    @property
    def misfit_z(self) -> float:
        """The misfit as a standard normal variable."""
        tail = float(chdtrc(self.degrees_of_freedom, self.misfit * self.degrees_of_freedom))
        return -float(ndtri(np.clip(tail, 1e-300, 1 - 1e-16)))


def left_out(row: Row, parts: Sequence[LagMoments], conditions: Sequence[Hashable]) -> tuple[LeftOut, ...]:
    """Read every healthy window against the relation learned without its condition.

    Where there is one condition, windows are left out one by one, or in up to six runs of neighbours.

    Parameters
    ----------
    parts : sequence of LagMoments
        One of each healthy window.
    conditions : sequence
        What each belongs to.

    Returns
    -------
    tuple of LeftOut
        Without those for which too few others are left or do not determine the relation.
    """
    groups = list(dict.fromkeys(conditions))
    if len(groups) > 1:
        folds = [[n for n, one in enumerate(conditions) if one == group] for group in groups]
    else:
        folds = [list(map(int, run)) for run in np.array_split(np.arange(len(parts)), min(_FOLDS, len(parts)))]
    found = []
    for fold in folds:
        others = [part for number, part in enumerate(parts) if number not in fold]
        if len(others) < min(_FEWEST_OTHERS, len(parts) - 1) or not others:
            continue
        try:
            relation, _ = learn_row(row, others, widened=False)
            changes = [(number, change_of(row, relation, parts[number])) for number in fold]
        except (EstimationError, np.linalg.LinAlgError):
            continue
        for number, change in changes:
            uncertain = change.sensitivity @ relation.covariance @ change.sensitivity.T
            found.append(_left_out(row, number, str(conditions[number]), change, np.diag(uncertain)))
    return tuple(sorted(found, key=lambda one: one.window))


def _left_out(row: Row, number: int, condition: str, change: RowChange, uncertain: FloatArray) -> LeftOut:
    noise = change.projection @ change.moments.covariance(change.combination) @ change.projection.T
    errors = np.sqrt(np.diag(noise) * change.widening + uncertain)
    return LeftOut(
        row=row.name,
        window=number,
        condition=condition,
        agreements=tuple(
            HeldOutReading(own.parameter, float(value), float(error))
            for own, value, error in zip(row.own, change.change, errors, strict=True)
        ),
        misfit=change.chi2 / change.degrees_of_freedom,
        degrees_of_freedom=change.degrees_of_freedom,
    )


def allowance_of(found: Sequence[LeftOut]) -> float:
    """Factor on variances that makes what windows of other conditions leave over as large as expected, at least 1.

    A relation that is not quite the machine leaves over more in a condition that it was not learned in. The condition
    that it fits worst counts.
    """
    worst = 1.0
    for condition in {one.condition for one in found}:
        own = [one for one in found if one.condition == condition]
        freedom = sum(one.degrees_of_freedom for one in own)
        mean = sum(one.misfit * one.degrees_of_freedom for one in own) / freedom
        if mean > 1 + _BEYOND * np.sqrt(2 / freedom):
            worst = max(worst, mean)
        readings = [agreement.z**2 for one in own for agreement in one.agreements]
        spread = float(np.mean(readings))
        # neighbouring windows share the relation's error: their readings count as one window
        if spread > 1 + _BEYOND * np.sqrt(2 / len(own[0].agreements)):
            worst = max(worst, spread)
    return worst
