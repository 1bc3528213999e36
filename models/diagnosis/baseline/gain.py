"""A sensor's gain, told from a bearing: it changes stiffness and damping of a plane by the same factor.

In a row that balances the bearing's forces against the disc's inertia, a gain error at the bearing or at the disc
scales every one of the row's own parameters alike. Where a place has one sensor only, nothing else would show it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from models.diagnosis.baseline.relation import Relation
from models.diagnosis.baseline.rows import Row
from models.diagnosis.readings import Diagnosis

__all__ = ["GainSuspicion", "gain_suspicion"]

_SINGLE = 2.326  # standard errors beyond which no single parameter explains a window (one per cent, one-sided)
_COMMON = 2.576  # within which the common factor does (one per cent, two-sided)
_MOST_LOSS = -0.95


@dataclass(frozen=True, slots=True)
class GainSuspicion:
    """A common factor that explains the row's own parameters as well as separate changes do.

    Attributes
    ----------
    sentence : str
        ``gain of y1 or y2``.
    factor : float
        Relative change of all of the row's own parameters.
    z : float
        The factor in standard errors, as a one-sided normal variable that knows of how many rows it is the largest.
    """

    sentence: str
    factor: float
    z: float


def gain_suspicion(
    diagnosis: Diagnosis, rows: Sequence[Row], relations: Sequence[Relation | None]
) -> GainSuspicion | None:
    """Find the row whose changes look most like a gain error of a place with a single sensor.

    Parameters
    ----------
    diagnosis : Diagnosis
        Readings with their covariance.
    rows : sequence of Row
        Learned rows.
    relations : sequence of Relation or None
        What was learned of each.

    Returns
    -------
    GainSuspicion or None
        None where single parameters explain the window, or a common factor does not.
    """
    tested = [
        (row, single)
        for row, relation in zip(rows, relations, strict=True)
        if relation is not None and len(row.own) > 1 and (single := _single_sensors(row, relation))
    ]
    found = [_row_suspicion(diagnosis, row, single, len(tested)) for row, single in tested]
    return max((one for one in found if one is not None), key=lambda one: one.z, default=None)


def _single_sensors(row: Row, relation: Relation) -> tuple[str, ...]:
    """States of the row's coordinates that are measured in one way only."""
    single = []
    for coordinate in dict.fromkeys(motion.coordinate for motion in row.motions):
        states = [name for name in relation.states if name == coordinate or name.startswith(f"{coordinate}_")]
        if len(states) == 1:
            single += states
    return tuple(single)


def _row_suspicion(diagnosis: Diagnosis, row: Row, single: tuple[str, ...], tested: int) -> GainSuspicion | None:
    readings = diagnosis.evaluable
    names = [reading.name for reading in readings]
    if any(own.parameter not in names for own in row.own):
        return None
    at = [names.index(own.parameter) for own in row.own]
    changes = np.array([max(_MOST_LOSS, readings[i].relative_change or 0.0) for i in at])
    x = np.log1p(changes)
    J = np.linalg.inv(diagnosis.full_covariance[np.ix_(at, at)] / np.outer(1 + changes, 1 + changes))
    b, everything = J @ x, float(x @ J @ x)
    left_alone = everything - b**2 / np.diag(J)
    ones = np.ones(x.size)
    weight = float(ones @ J @ ones)
    factor = float(ones @ b) / weight
    left_common = everything - factor**2 * weight
    if np.min(left_alone) <= _SINGLE**2 or left_common > _COMMON**2:
        return None
    tail = 2 * tested * float(ndtr(-abs(factor) * math.sqrt(weight)))
    z = -float(ndtri(min(0.5, max(tail, 1e-300))))
    return GainSuspicion(f"gain of {' or '.join(single)}", math.expm1(factor), z)
