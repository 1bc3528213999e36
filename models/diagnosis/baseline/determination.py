"""Whether healthy windows determine a baseline well enough, and what to record where they do not."""

from collections.abc import Sequence

import numpy as np

from models.diagnosis.baseline.learned import Baseline, learned_rows
from models.diagnosis.baseline.relation import Relation
from models.diagnosis.baseline.rows import ROWS, Row
from models.physics.parameters import PARAMETER_TEXT

__all__ = ["disagreements", "undetermined"]

_FAR = 3.0  # spreads from what is expected
_VAGUE = 0.33  # relative standard error beyond which a coefficient is not known
_BEYOND = 4.0  # standard errors between conditions
_RECORD = "record a second condition: another speed, another load, or more broadband excitation at the bearing"


def undetermined(baseline: Baseline, rows: Sequence[Row] = ROWS) -> tuple[str, ...]:
    """Say of every learned row why the healthy windows do not determine it; empty where they do.

    One source of excitation leaves combinations of coefficients weakly determined. The estimate then wanders to where
    damping or inertia is not physical, and no interval around it is honest.

    Parameters
    ----------
    rows : sequence of Row
        The table it was learned by.

    Returns
    -------
    tuple of str
        A sentence with what to record instead for each row, in the order of the learned rows; empty if there is no
        doubt, or if there is no relation (``baseline.reasons`` says why).
    """
    found = []
    for row, relation in zip(learned_rows(rows), baseline.relations, strict=True):
        reason = "" if relation is None else _reason(row, relation)
        found.append(f"{row.title}: {reason}; {_RECORD}" if reason else "")
    return tuple(found)


def _reason(row: Row, relation: Relation) -> str:
    b, spread = relation.coefficients, np.sqrt(np.diag(relation.covariance))
    for own in row.own:
        for at in own.terms:
            if at and spread[at - 1] > _VAGUE * abs(b[at - 1]):
                error = spread[at - 1] / abs(b[at - 1])
                return f"the {PARAMETER_TEXT.get(own.parameter, own.parameter)} is known to {error:.0%} only"
    for number, term in enumerate(row.terms):
        if term.in_units_of is None or term.spread is None:
            continue
        unit, own_value = -b[term.in_units_of - 1], -b[number - 1]
        if unit <= 0:
            return "the disc's inertia comes out negative"
        if abs(own_value / unit - term.about) > _FAR * term.spread:
            return f"what moves with the bearing comes out at {own_value / unit:.1f} times the disc"
    return ""


def disagreements(baseline: Baseline) -> tuple[str, ...]:
    """Sentences on conditions in which a parameter reads otherwise than in all others.

    Readings of one condition share the error of the relation: their mean is compared with a standard error that does
    not fall with their number.

    Returns
    -------
    tuple of str
        Empty if one relation holds for all conditions. Otherwise keep a baseline for each, or widen (which later
        windows do by `Relation.allowance` in any case).
    """
    found = []
    for condition in dict.fromkeys(one.condition for one in baseline.consistency):
        own = [each for one in baseline.consistency if one.condition == condition for each in one.agreements]
        for name in dict.fromkeys(each.parameter for each in own):
            readings = [each for each in own if each.parameter == name]
            z = float(np.mean([each.z for each in readings]))
            if abs(z) > _BEYOND:
                change = float(np.mean([each.change for each in readings]))
                where = condition or "part of the recording"
                found.append(
                    f"{where}: {PARAMETER_TEXT.get(name, name)} reads {change:+.0%} against what the others teach "
                    f"({abs(z):.0f} standard errors)"
                )
    return tuple(found)
