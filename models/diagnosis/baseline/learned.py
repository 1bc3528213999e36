"""The baseline of a machine without parameters: what its healthy windows teach."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.diagnosis.baseline.lag_moments import absent, shared_covariance
from models.diagnosis.baseline.relation import N_COEFFICIENTS, Contribution, PlaneRelation, learn_plane
from models.diagnosis.baseline.unbalance import SPEED_TOLERANCE, Rotation, rotation_of
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.signals.block import FloatArray

__all__ = ["PLANES", "Baseline", "learn_baseline", "positive", "unsuitable"]

PLANES = ("y", "z")
"""Horizontal and vertical."""

_SHORTEST_LAG_RANGE_S = 0.1
_FEWEST_HOPS = 2


@dataclass(frozen=True, slots=True)
class Baseline:
    """What was learned on a healthy machine.

    Attributes
    ----------
    relations : tuple of PlaneRelation or None
        In y and z; None where channels are missing.
    reasons : tuple of str
        Why there is no relation; empty where there is one.
    covariance : ndarray, shape (8, 8)
        Of the coefficients in y, then in z; zero where there is no relation.
    rotation : Rotation or None
        Synchronous vectors of the healthy machine.
    duration_s : float
        Healthy data.
    """

    relations: tuple[PlaneRelation | None, ...]
    reasons: tuple[str, ...]
    covariance: FloatArray
    rotation: Rotation | None
    duration_s: float

    @property
    def coefficients(self) -> FloatArray:
        """Of both planes, shape (8,)."""
        parts = [np.zeros(N_COEFFICIENTS) if one is None else one.coefficients for one in self.relations]
        return np.concatenate(parts)


def learn_baseline(windows: Sequence[WindowStatistics]) -> Baseline:
    """Learn a baseline from healthy windows.

    Parameters
    ----------
    windows : sequence of WindowStatistics
        They must not overlap; a long recording is best cut into windows of about a minute. Each window weighs by its
        own spectra, so that they may differ in level, colour and layout of the excitation. Unbalance is learned from
        those within 3 % of the median speed.

    Raises
    ------
    EstimationError
        If there is nothing to learn from, or if neither plane has a relation.
    """
    if not windows:
        raise EstimationError("no healthy window to learn from")
    for window in windows:
        reason = unsuitable(window)
        if reason:
            raise EstimationError(f"healthy window: {reason}")
    relations: list[PlaneRelation | None] = []
    reasons, parts = [], []
    for plane in PLANES:
        relation, contributions, reason = _learn(tuple(windows), plane)
        relations.append(relation)
        reasons.append(reason)
        parts.append(contributions)
    if all(relation is None for relation in relations):
        raise EstimationError("; ".join(reasons))
    covariance = np.zeros((2 * N_COEFFICIENTS, 2 * N_COEFFICIENTS))
    for number, relation in enumerate(relations):
        if relation is not None:
            own = slice(N_COEFFICIENTS * number, N_COEFFICIENTS * (number + 1))
            covariance[own, own] = relation.covariance
    first, second = relations
    if first is not None and second is not None:
        shared = np.zeros((N_COEFFICIENTS, N_COEFFICIENTS))
        for a, b, window in zip(*parts, windows, strict=True):
            between = shared_covariance(a.moments, first.combination, b.moments, second.combination, window)
            shared += a.projection @ between @ b.projection.T
        covariance[:N_COEFFICIENTS, N_COEFFICIENTS:] = shared
        covariance[N_COEFFICIENTS:, :N_COEFFICIENTS] = shared.T
    return Baseline(
        relations=tuple(relations),
        reasons=tuple(reasons),
        covariance=positive(covariance),
        rotation=_healthy_rotation(windows),
        duration_s=sum(window.duration_s for window in windows),
    )


def _learn(windows: tuple[WindowStatistics, ...], plane: str) -> tuple[PlaneRelation | None, list[Contribution], str]:
    lacking = absent(windows[0].states, plane)
    if lacking:
        return None, [], f"not measured: {', '.join(lacking)}"
    try:
        relation, contributions = learn_plane(windows, plane)
    except (EstimationError, np.linalg.LinAlgError) as error:
        return None, [], str(error)
    return relation, contributions, ""


def unsuitable(window: WindowStatistics) -> str:
    """Why a window cannot be used at all; empty if it can."""
    if window.lags_s[-1] < _SHORTEST_LAG_RANGE_S:
        return f"correlations reach {window.lags_s[-1]:g} s, {_SHORTEST_LAG_RANGE_S:g} s are needed"
    if window.hop_correlation.shape[0] < _FEWEST_HOPS:
        return f"it has one hop, {_FEWEST_HOPS} are needed"
    if not np.all(np.isfinite(window.correlation)):
        return "its correlations are not finite"
    return ""


def _healthy_rotation(windows: Sequence[WindowStatistics]) -> Rotation | None:
    rotations = [rotation for rotation in map(rotation_of, windows) if rotation is not None]
    if not rotations:
        return None
    middle = float(np.median([rotation.speed_rad_s for rotation in rotations]))
    near = [one for one in rotations if abs(one.speed_rad_s / middle - 1) <= SPEED_TOLERANCE]
    if not near:
        return None
    return Rotation(
        vectors=np.mean([one.vectors for one in near], axis=0),
        covariance=np.sum([one.covariance for one in near], axis=0) / len(near) ** 2,
        speed_rad_s=float(np.mean([one.speed_rad_s for one in near])),
    )


def positive(covariance: FloatArray) -> FloatArray:
    """The same covariance without negative eigenvalues (of correlations just beyond one)."""
    if covariance.size == 0:
        return covariance
    scale = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    if values[0] > 1e-9:
        return covariance
    return np.asarray((vectors * np.maximum(values, 1e-9)) @ vectors.T * np.outer(scale, scale), dtype=np.float64)
