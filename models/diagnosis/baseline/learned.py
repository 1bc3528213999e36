"""The baseline of a machine without parameters: learning it from healthy windows, and how well they agree."""

from collections.abc import Hashable, Sequence
from dataclasses import replace

import numpy as np

from models.diagnosis.baseline.conditions import force_spectrum, growth_of
from models.diagnosis.baseline.lag_moments import LagMoments, RowWindow, row_window, shared_covariance
from models.diagnosis.baseline.relation import Contribution, Relation, beyond_memory, change_of, learn_row
from models.diagnosis.baseline.rows import (
    COUPLED_ROWS,
    ROWS,
    Row,
    consecutive,
    learned_rows,
    lowest,
    not_measured,
    state_of,
)
from models.diagnosis.baseline.stored import NO_FORCE, Baseline, HeldOutReading, LeftOut
from models.diagnosis.baseline.unbalance import rotation_of, rotations_by_speed
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.physics.rotor import PARAMETER_TEXT
from models.signals.block import FloatArray
from models.stream_settings import LONGEST_LAG_STEP_S

_FOLDS = 6
_FEWEST_OTHERS = 2
_BEYOND = 2.0  # standard deviations beyond which a mean is taken for more than scatter


def left_out(row: Row, parts: Sequence[LagMoments], conditions: Sequence[Hashable]) -> tuple[LeftOut, ...]:
    """Read every healthy window against the relation learned without its condition, if the others determine one.

    With a single condition, up to six runs of neighbouring windows (single windows, if there are six or fewer) are left
    out in turn.
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
            readings = zip(row.own, change.change.tolist(), change.error(relation).tolist(), strict=True)
            agreements = tuple(HeldOutReading(own.parameter, value, error) for own, value, error in readings)
            freedom = change.degrees_of_freedom
            misfit = change.chi2 / freedom
            found.append(LeftOut(row.name, number, str(conditions[number]), agreements, misfit, freedom))
    return tuple(sorted(found, key=lambda one: one.window))


def allowance_of(found: Sequence[LeftOut]) -> float:
    """Factor on variances, at least 1, with which the residuals in held-out conditions are as large as expected.

    A relation that only approximates the machine leaves a larger residual in a condition that it was not learned in.
    The factor is that of the condition with the worst fit.
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


_SHORTEST_LAG_RANGE_S = 0.1
# Planes are coupled if in one of them the cross stiffness exceeds this part of the direct one, and so many standard
# errors.
_COUPLED, _SHOWN = 0.03, 4.0
_FEWEST_HOPS = 2


def learn_baseline(
    windows: Sequence[WindowStatistics], conditions: Sequence[Hashable] | None = None, rows: Sequence[Row] = ROWS
) -> Baseline:
    """Learn a baseline from healthy windows.

    Parameters
    ----------
    windows : sequence of WindowStatistics
        They must not overlap; a long recording is best cut into windows of about a minute. Each window is weighted by
        its own spectra, so windows may differ in speed, load, and level, colour and layout of the excitation.
    conditions : sequence, optional
        Condition of each window, for example the recording it was cut from; by default all are of one condition.

    Raises
    ------
    EstimationError
        If there is no window, if one is unsuitable, or if no row has a relation.
    """
    if not windows:
        raise EstimationError("no healthy window to learn from")
    if conditions is not None and len(conditions) != len(windows):
        raise EstimationError(f"{len(conditions)} conditions are given for {len(windows)} healthy windows")
    for window in windows:
        reason = unsuitable(window)
        if reason:
            raise EstimationError(f"healthy window: {reason}")
    states = tuple(name for name in windows[0].states if all(name in window.states for window in windows))
    learned = learned_rows(rows)
    groups = ("",) * len(windows) if conditions is None else tuple(conditions)
    relations: list[Relation | None] = []
    reasons, parts, growth = [], [], []
    consistency: list[LeftOut] = []
    for row in learned:
        relation, contributions, reason = _learn(row, windows, states)
        moments = [one for one, _ in contributions]
        growth.append(None if relation is None else growth_of(row, relation, moments))
        if relation is not None:
            found = left_out(row, moments, groups)
            relation = replace(relation, allowance=allowance_of(found))
            consistency += found
        relations.append(relation)
        reasons.append(reason)
        parts.append(contributions)
    if all(relation is None for relation in relations):
        raise EstimationError("; ".join(dict.fromkeys(reasons)))
    # Keep the synchronous vectors of all rows from which the unbalance can be read.
    there = {relation.row for relation in relations if relation is not None}
    used = [row for row in rows if row.rests_on in there]
    coordinates = tuple(sorted({motion.coordinate for row in used for motion in row.motions}))
    known = [(row, one.combination) for row, one in zip(learned, relations, strict=True) if one is not None]
    known = [(row, combination) for row, combination in known if any(other.rests_on == row.name for other in used)]
    rotations = [rotation_of(window, coordinates, known) for window in windows]
    return Baseline(
        relations=tuple(relations),
        reasons=tuple(reasons),
        covariance=_covariance(learned, relations, parts),
        rotations=rotations_by_speed([one for one in rotations if one is not None]),
        duration_s=sum(window.duration_s for window in windows),
        consistency=tuple(consistency),
        growth=tuple(growth),
        force=_learned_under(relations, parts, groups),
    )


def _learned_under(
    relations: Sequence[Relation | None], parts: Sequence[list[Contribution]], groups: Sequence[Hashable]
) -> FloatArray:
    known = [relation.combination for relation in relations if relation is not None]
    if len(known) < len(relations) or len(set(groups)) > 1:
        return NO_FORCE
    by_window = zip(*parts, strict=True)
    found = [force_spectrum([moments.of for moments, _ in rows], known) for rows in by_window]
    if len({one.shape for one in found}) > 1:
        return NO_FORCE
    return np.asarray(np.mean(found, axis=0), dtype=np.float64)


def _learn(
    row: Row, windows: Sequence[WindowStatistics], states: tuple[str, ...], *, widened: bool = True
) -> tuple[Relation | None, list[Contribution], str]:
    reason = not_measured(row.motions, states)
    if reason:
        return None, [], reason
    try:
        references = references_of(states)
        prepared: list[RowWindow] = [row_window(row, window, states, references) for window in windows]
        relation, contributions = learn_row(row, *beyond_memory(row, prepared), widened=widened)
    except EstimationError as error:
        return None, [], str(error)
    except np.linalg.LinAlgError:
        return None, [], f"{row.title}: the healthy recording does not determine it; a channel may hardly vibrate"
    return relation, contributions, ""


def planes_coupled(windows: Sequence[WindowStatistics]) -> bool:
    """Whether healthy windows show that the bearing answers a motion in one plane with a force in the other.

    Relations of single planes are then invalid: the contribution of the other plane depends on the direction of the
    force. Planes count as coupled if one of them shows it; a single source may hide it in one plane, but not in both.
    """
    if not windows or any(unsuitable(window) for window in windows):
        return False
    states = tuple(name for name in windows[0].states if all(name in window.states for window in windows))
    relations = (_learn(row, windows, states, widened=False)[0] for row in learned_rows(COUPLED_ROWS))
    return any(
        abs(one.coefficients[-2]) > max(_COUPLED, _SHOWN * np.sqrt(one.covariance[-2, -2]))
        for one in relations
        if one is not None
    )


def references_of(states: tuple[str, ...]) -> tuple[str, ...]:
    """States that serve as references: the lowest derivative of bearing and disc in both planes."""
    lowest_of = [(coordinate, lowest(coordinate, states)) for coordinate in ("y1", "y2", "z1", "z2")]
    return tuple(state_of(coordinate, order) for coordinate, order in lowest_of if order is not None)


def _covariance(
    rows: tuple[Row, ...], relations: Sequence[Relation | None], parts: Sequence[list[Contribution]]
) -> FloatArray:
    slices = consecutive(row.n_coefficients for row in rows)
    total = np.zeros((slices[-1].stop, slices[-1].stop))
    for i, first in enumerate(relations):
        if first is None:
            continue
        total[slices[i], slices[i]] = first.covariance
        for j, second in enumerate(relations[:i]):
            if second is None:
                continue
            for (a, of_a), (b, of_b) in zip(parts[i], parts[j], strict=True):
                between = shared_covariance(a, first.combination, b, second.combination)
                total[slices[i], slices[j]] += of_a @ between @ of_b.T
            total[slices[j], slices[i]] = total[slices[i], slices[j]].T
    return positive(total)


def unsuitable(window: WindowStatistics) -> str:
    """Why a window cannot be used at all; empty if it can."""
    wanted_s, most_s = _SHORTEST_LAG_RANGE_S * window.time_scale, LONGEST_LAG_STEP_S * window.time_scale
    if window.lags_s[-1] < wanted_s:
        return f"correlations reach {window.lags_s[-1]:g} s, {wanted_s:g} s are needed"
    step_s = float(window.lags_s[1] - window.lags_s[0])
    if step_s > most_s:
        return f"lags are {1e3 * step_s:g} ms apart, at most {1e3 * most_s:g} ms are needed"
    if window.hop_correlation.shape[0] < _FEWEST_HOPS:
        return f"it has one hop, {_FEWEST_HOPS} are needed"
    if not np.all(np.isfinite(window.correlation)):
        return "its correlations are not finite"
    return ""


def positive(covariance: FloatArray) -> FloatArray:
    """The covariance with negative eigenvalues (from correlations just beyond one) raised to almost zero."""
    if covariance.size == 0:
        return covariance
    variances = np.diag(covariance)
    scale = np.sqrt(np.where(variances > np.finfo(float).tiny, variances, 1.0))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    if values[0] > 1e-9:
        return covariance
    return np.asarray((vectors * np.maximum(values, 1e-9)) @ vectors.T * np.outer(scale, scale), dtype=np.float64)


_FAR = 3.0  # largest distance of a coefficient from its expected value, in expected spreads
_VAGUE = 0.33  # relative standard error beyond which a coefficient is not known
_LEFT_OVER = 5.0  # largest χ² per degree of freedom with one condition; several are compared with each other instead
_DISAGREE = 4.0  # standard errors beyond which conditions disagree
_ADVICE = (
    "make sure that the sensors of bearing and disc are not exchanged, that none has the wrong sign, and that all are "
    "sampled at once and AC-coupled alike (or state delay_us and high_pass_hz), or record a second condition: another "
    "speed, another load, or more broadband excitation at the bearing"
)


def undetermined(baseline: Baseline) -> tuple[str, ...]:
    """For every learned row a sentence on why the healthy windows do not determine it; empty if they do.

    With one source of excitation, combinations of coefficients are weakly determined. The estimate may then end where
    damping or inertia is not physical, and no interval around it is valid. Each sentence says what to record instead.
    It is also empty for a row without a relation (``baseline.reasons`` says why).
    """
    found, alone = [], len({one.condition for one in baseline.consistency}) < 2
    for row, relation in zip(learned_rows(baseline.rows), baseline.relations, strict=True):
        reason = "" if relation is None else _reason(row, relation, alone=alone)
        found.append(f"{row.title}: {reason}; {_ADVICE}" if reason else "")
    return tuple(found)


def _reason(row: Row, relation: Relation, *, alone: bool) -> str:
    if alone and relation.misfit > _LEFT_OVER:
        return f"the remainder is {relation.misfit:.1f} times what chance leaves, so no such relation holds"
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


def disagreements(baseline: Baseline) -> tuple[tuple[str, float, str], ...]:
    """Conditions in which a parameter reads differently than in all others: parameter, its change, and a sentence.

    Readings of one condition share the error of the relation, so the mean of their z is tested as a single one. If
    there are such conditions, keep a baseline for each. In any case `Relation.allowance` widens the errors of later
    windows.
    """
    found = []
    for condition in dict.fromkeys(one.condition for one in baseline.consistency):
        own = [each for one in baseline.consistency if one.condition == condition for each in one.agreements]
        for name in dict.fromkeys(each.parameter for each in own):
            readings = [each for each in own if each.parameter == name]
            z = float(np.mean([each.z for each in readings]))
            if abs(z) > _DISAGREE:
                change = float(np.mean([each.change for each in readings]))
                where = condition or "part of the recording"
                text = f"{where}: {PARAMETER_TEXT.get(name, name)} reads {change:+.0%} against what was learned"
                found.append((name, change, f"{text} from the others ({abs(z):.0f} standard errors)"))
    return tuple(found)
