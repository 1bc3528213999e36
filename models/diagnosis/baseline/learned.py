"""The baseline of a machine without parameters: what its healthy windows teach."""

import itertools
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.diagnosis.baseline.consistency import LeftOut, allowance_of, left_out
from models.diagnosis.baseline.kernels import LONGEST_LAG_STEP_S
from models.diagnosis.baseline.kinematics import not_measured, state_of
from models.diagnosis.baseline.lag_moments import LagMoments, RowWindow, row_window, shared_covariance
from models.diagnosis.baseline.relation import Contribution, Relation, lags_of, learn_row
from models.diagnosis.baseline.rows import ROWS, Row
from models.diagnosis.baseline.unbalance import SynchronousVectors, rotation_of, rotations_by_speed
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.signals.block import FloatArray

__all__ = ["Baseline", "coefficient_slices", "learn_baseline", "learned_rows", "positive", "unsuitable"]

_SHORTEST_LAG_RANGE_S = 0.1
_FEWEST_HOPS = 2


@dataclass(frozen=True, slots=True, eq=False)
class Baseline:
    """What was learned on a healthy machine.

    Attributes
    ----------
    relations : tuple of Relation or None
        One for each learned row of the table; None where there is none.
    reasons : tuple of str
        Why there is no relation; empty where there is one.
    covariance : ndarray, shape (n, n)
        Of the coefficients of all rows one after the other; zero where there is no relation.
    rotations : tuple of SynchronousVectors
        Synchronous vectors of the healthy machine, one for each distinct speed, slowest first.
    duration_s : float
        Healthy data.
    consistency : tuple of LeftOut
        Every healthy window of every row against what the windows of other conditions teach.
    """

    relations: tuple[Relation | None, ...]
    reasons: tuple[str, ...]
    covariance: FloatArray
    rotations: tuple[SynchronousVectors, ...]
    duration_s: float
    consistency: tuple[LeftOut, ...] = ()

    @property
    def states(self) -> tuple[str, ...]:
        """Measured states that it was learned with and that later windows must have."""
        return tuple(sorted({name for one in self.relations if one is not None for name in one.states}))


def learned_rows(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Rows that are learned on the stochastic part."""
    return tuple(row for row in rows if not row.synchronous)


def coefficient_slices(rows: Sequence[Row]) -> tuple[slice, ...]:
    """Where the coefficients of each row stand among those of all."""
    ends = np.cumsum([0, *(row.n_coefficients for row in rows)]).tolist()
    return tuple(slice(a, b) for a, b in itertools.pairwise(ends))


def learn_baseline(
    windows: Sequence[WindowStatistics], conditions: Sequence[Hashable] | None = None, rows: Sequence[Row] = ROWS
) -> Baseline:
    """Learn a baseline from healthy windows.

    Parameters
    ----------
    windows : sequence of WindowStatistics
        They must not overlap; a long recording is best cut into windows of about a minute. Each window weighs by its
        own spectra, so that they may differ in speed, load, and level, colour and layout of the excitation.
    conditions : sequence, optional
        What each window belongs to, for example the recording it was cut from; one condition without it.
    rows : sequence of Row
        Table of rows.

    Raises
    ------
    EstimationError
        If there is nothing to learn from, or if no row has a relation.
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
    reasons, parts = [], []
    consistency: list[LeftOut] = []
    for row in learned:
        relation, contributions, reason = _learn(row, windows, states)
        if relation is not None:
            found = left_out(row, [one.moments for one in contributions], groups)
            relation = replace(relation, allowance=allowance_of(found))
            consistency += found
        relations.append(relation)
        reasons.append(reason)
        parts.append(contributions)
    if all(relation is None for relation in relations):
        raise EstimationError("; ".join(dict.fromkeys(reasons)))
    coordinates = _coordinates(rows, learned, relations)
    rotations = [rotation_of(window, coordinates) for window in windows]
    return Baseline(
        relations=tuple(relations),
        reasons=tuple(reasons),
        covariance=_covariance(learned, relations, parts),
        rotations=rotations_by_speed([one for one in rotations if one is not None]),
        duration_s=sum(window.duration_s for window in windows),
        consistency=tuple(consistency),
    )


def _learn(
    row: Row, windows: Sequence[WindowStatistics], states: tuple[str, ...]
) -> tuple[Relation | None, list[Contribution], str]:
    reason = not_measured(row.motions, states)
    if not reason and row.needs_speed and not all(np.isfinite(window.speed_rad_s) for window in windows):
        reason = "no phase reference"
    if reason:
        return None, [], reason
    try:
        relation, contributions = learn_row(row, _moments(row, windows, states))
    except EstimationError as error:
        return None, [], str(error)
    except np.linalg.LinAlgError:
        return None, [], f"{row.title}: the healthy recording does not determine it; a channel may hardly move"
    return relation, contributions, ""


def _moments(row: Row, windows: Sequence[WindowStatistics], states: tuple[str, ...]) -> list[LagMoments]:
    references = references_of(states)
    prepared: list[RowWindow] = [row_window(row, window, states, references) for window in windows]
    return [one.beyond(lag) for one, lag in zip(prepared, lags_of(row, prepared), strict=True)]


def references_of(states: tuple[str, ...]) -> tuple[str, ...]:
    """States that serve as references: the lowest derivative of bearing and disc in both planes."""
    found = []
    for coordinate in ("y1", "y2", "z1", "z2"):
        measured = [state_of(coordinate, order) for order in range(3) if state_of(coordinate, order) in states]
        found += measured[:1]
    return tuple(found)


def _coordinates(
    rows: Sequence[Row], learned: tuple[Row, ...], relations: Sequence[Relation | None]
) -> tuple[str, ...]:
    """Whose synchronous vectors are kept: of all rows that the unbalance can be read by."""
    there = {row.name for row, relation in zip(learned, relations, strict=True) if relation is not None}
    used = [row for row in rows if row.synchronous and row.rests_on in there]
    return tuple(sorted({motion.coordinate for row in used for motion in row.motions}))


def _covariance(
    rows: tuple[Row, ...], relations: Sequence[Relation | None], parts: Sequence[list[Contribution]]
) -> FloatArray:
    slices = coefficient_slices(rows)
    total = np.zeros((slices[-1].stop, slices[-1].stop))
    for i, first in enumerate(relations):
        if first is None:
            continue
        total[slices[i], slices[i]] = first.covariance
        for j, second in enumerate(relations[:i]):
            if second is None:
                continue
            for a, b in zip(parts[i], parts[j], strict=True):
                between = shared_covariance(a.moments, first.combination, b.moments, second.combination)
                total[slices[i], slices[j]] += a.projection @ between @ b.projection.T
            total[slices[j], slices[i]] = total[slices[i], slices[j]].T
    return positive(total)


def unsuitable(window: WindowStatistics) -> str:
    """Why a window cannot be used at all; empty if it can."""
    if window.lags_s[-1] < _SHORTEST_LAG_RANGE_S:
        return f"correlations reach {window.lags_s[-1]:g} s, {_SHORTEST_LAG_RANGE_S:g} s are needed"
    step_s = float(window.lags_s[1] - window.lags_s[0])
    if step_s > LONGEST_LAG_STEP_S:
        return f"lags are {1e3 * step_s:g} ms apart, at most {1e3 * LONGEST_LAG_STEP_S:g} ms are needed"
    if window.hop_correlation.shape[0] < _FEWEST_HOPS:
        return f"it has one hop, {_FEWEST_HOPS} are needed"
    if not np.all(np.isfinite(window.correlation)):
        return "its correlations are not finite"
    return ""


def positive(covariance: FloatArray) -> FloatArray:
    """The same covariance without negative eigenvalues (of correlations just beyond one)."""
    if covariance.size == 0:
        return covariance
    variances = np.diag(covariance)
    scale = np.sqrt(np.where(variances > np.finfo(float).tiny, variances, 1.0))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    if values[0] > 1e-9:
        return covariance
    return np.asarray((vectors * np.maximum(values, 1e-9)) @ vectors.T * np.outer(scale, scale), dtype=np.float64)
