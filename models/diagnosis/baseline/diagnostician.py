"""The diagnosis of a window against a baseline."""

import math

import numpy as np
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import norm

from models.diagnosis.baseline.lag_moments import absent, shared_covariance
from models.diagnosis.baseline.learned import PLANES, Baseline, positive, unsuitable
from models.diagnosis.baseline.relation import N_COEFFICIENTS, PlaneChange, PlaneRelation, read_plane
from models.diagnosis.baseline.unbalance import (
    SPEED_TOLERANCE,
    Rotation,
    SynchronousState,
    relative_force,
    rotation_of,
    slopes,
)
from models.diagnosis.readings import Diagnosis, ParameterReading
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.signals.block import FloatArray

__all__ = ["BASELINE_PARAMETERS", "BaselineDiagnostician"]

BASELINE_PARAMETERS = ("k_by", "c_by", "k_bz", "c_bz", "e")
"""What can be read without any parameter of the machine; the shaft cannot."""

_WORST_ERROR = 0.2


class BaselineDiagnostician:
    """Reads changes of bearing and unbalance against a baseline.

    Changes of stiffness are relative to the stiffness to ground that holds the bearing, changes of damping and
    unbalance relative to the healthy ones.

    Parameters
    ----------
    baseline : Baseline
    """

    def __init__(self, baseline: Baseline) -> None:
        self._baseline = baseline

    @property
    def by(self) -> str:
        """Name under which it is reported."""
        return "baseline"

    def diagnose(self, window: WindowStatistics) -> Diagnosis:
        """Judge one window; never raises: what cannot be read carries its reason."""
        reason = unsuitable(window)
        if reason:
            return Diagnosis(self.by, tuple(ParameterReading(n, self.by, reason=reason) for n in BASELINE_PARAMETERS))
        changes: list[PlaneChange | None] = []
        reasons: dict[str, str] = {}
        for plane, relation, why in zip(PLANES, self._baseline.relations, self._baseline.reasons, strict=True):
            change, why_not = _read(relation, window, plane, why)
            changes.append(change)
            reasons |= {f"k_b{plane}": why_not, f"c_b{plane}": why_not}
        values, total, couplings = _bearing(changes, self._baseline, window)
        reasons["e"] = ""
        try:
            value, row, variance = _unbalance(changes, values, total, couplings, self._baseline, window)
        except EstimationError as error:
            reasons["e"] = str(error)
        else:
            values = np.append(values, value)
            total = np.block([[total, row[:, None]], [row[None, :], np.array([[variance]])]])
        known = [n for n, name in enumerate(BASELINE_PARAMETERS) if not reasons[name]]
        covariance = positive(total[np.ix_(known, known)])
        errors = dict(zip(known, np.sqrt(np.diag(covariance)).tolist(), strict=True))
        parameters = tuple(
            ParameterReading(name, self.by, float(values[n]), errors[n])
            if n in errors
            else ParameterReading(name, self.by, reason=reasons[name])
            for n, name in enumerate(BASELINE_PARAMETERS)
        )
        return Diagnosis(self.by, parameters, covariance=covariance if known else None, misfit_z=_misfit(changes))


def _read(
    relation: PlaneRelation | None, window: WindowStatistics, plane: str, why: str
) -> tuple[PlaneChange | None, str]:
    if relation is None:
        return None, why
    lacking = absent(window.states, plane)
    if lacking:
        return None, f"not measured: {', '.join(lacking)}"
    try:
        return read_plane(relation, window), ""
    except (EstimationError, np.linalg.LinAlgError) as error:
        return None, str(error)


def _bearing(
    changes: list[PlaneChange | None], baseline: Baseline, window: WindowStatistics
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Changes of both planes, their covariance, and their sensitivity to the relations' coefficients."""
    values, noise, sensitivity = np.zeros(4), np.zeros((4, 4)), np.zeros((4, 2 * N_COEFFICIENTS))
    for i, a in enumerate(changes):
        if a is None:
            continue
        values[2 * i : 2 * i + 2] = a.change
        sensitivity[2 * i : 2 * i + 2, N_COEFFICIENTS * i : N_COEFFICIENTS * (i + 1)] = a.sensitivity
        for j, b in enumerate(changes):
            if b is None:
                continue
            between = shared_covariance(a.moments, a.combination, b.moments, b.combination, window)
            between *= math.sqrt(a.widening * b.widening)
            noise[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = a.projection @ between @ b.projection.T
    total = noise + sensitivity @ baseline.covariance @ sensitivity.T
    for i, (change, relation) in enumerate(zip(changes, baseline.relations, strict=True)):
        if change is not None and relation is not None:
            # a relative change of damping is in units of a damping that is itself only estimated
            relative = relation.covariance[0, 0] / relation.coefficients[0] ** 2
            total[2 * i + 1, 2 * i + 1] += max(0.0, (1 + change.change[1]) ** 2 - 1) * relative
    return values, total, sensitivity


def _unbalance(
    changes: list[PlaneChange | None],
    values: FloatArray,
    total: FloatArray,
    sensitivity: FloatArray,
    baseline: Baseline,
    window: WindowStatistics,
) -> tuple[float, FloatArray, float]:
    """Change of the unbalance, its covariance with the bearing's changes, and its variance.

    Raises
    ------
    EstimationError
        With the reason why it cannot be read.
    """
    healthy, now = _rotations(baseline, window)
    used = [plane for plane, change in enumerate(changes) if change is not None]
    if not used:
        raise EstimationError("no relation could be read")
    state = SynchronousState(baseline.coefficients, values, now.vectors, healthy.vectors)
    speeds = (now.speed_rad_s, healthy.speed_rad_s)
    to_b, to_d, to_now, to_healthy = slopes(state, *speeds)
    rows = [*used, *(plane + 2 for plane in used)]
    # the error of the coefficients comes in directly and through the bearing's changes
    through = to_d @ sensitivity + to_b
    own = total - sensitivity @ baseline.covariance @ sensitivity.T
    spread = (
        to_d @ own @ to_d.T
        + through @ baseline.covariance @ through.T
        + to_now @ now.covariance @ to_now.T
        + to_healthy @ healthy.covariance @ to_healthy.T
    )[np.ix_(rows, rows)]
    with_bearing = (own @ to_d.T + sensitivity @ baseline.covariance @ through.T)[:, rows]
    observed = relative_force(state, *speeds)[rows]
    if not (np.all(np.isfinite(observed)) and np.all(np.isfinite(spread))):
        raise EstimationError("no unbalance in the healthy recording")
    design = np.kron(np.eye(2), np.ones((len(used), 1)))
    # weighted as if the bearing were known: sharpest where the verdict is that nothing else changed
    known = with_bearing.T @ np.linalg.pinv(positive(total), hermitian=True) @ with_bearing
    weight = np.linalg.inv(positive(spread - known))
    combine = np.linalg.solve(design.T @ weight @ design, design.T @ weight)
    vector = combine @ observed
    size = math.hypot(1 + vector[0], vector[1])
    along = np.array([1 + vector[0], vector[1]]) / max(size, 1e-9) @ combine
    variance = float(along @ spread @ along)
    if variance > (_WORST_ERROR * max(1.0, size)) ** 2:
        raise EstimationError(f"unbalance not seen well enough: standard error {100 * math.sqrt(variance):.0f} %")
    return size - 1, with_bearing @ along, variance


def _rotations(baseline: Baseline, window: WindowStatistics) -> tuple[Rotation, Rotation]:
    healthy, now = baseline.rotation, rotation_of(window)
    if healthy is None:
        raise EstimationError("the baseline has no phase reference or not all displacements")
    if now is None:
        raise EstimationError("no phase reference or not all displacements")
    if abs(now.speed_rad_s / healthy.speed_rad_s - 1) > SPEED_TOLERANCE:
        rpm = 30 / math.pi
        raise EstimationError(
            f"speed {now.speed_rad_s * rpm:.0f} rpm, the baseline was learned at {healthy.speed_rad_s * rpm:.0f} rpm"
        )
    return healthy, now


def _misfit(changes: list[PlaneChange | None]) -> float | None:
    """What the worse of both planes leaves, as a standard normal variable that knows it is the worse of two."""
    used = [change for change in changes if change is not None]
    if not used:
        return None
    tail = min(float(chi2_distribution.sf(change.chi2, change.degrees_of_freedom)) for change in used)
    tail = tail if len(used) == 1 else tail * (2 - tail)
    return float(norm.isf(np.clip(tail, 1e-300, 1 - 1e-16)))
