"""Diagnosis of a window against a baseline, including wrong gains that look like a change of the bearing.

A row balances the bearing's forces against the disc's inertia, so a gain error of all sensors at the bearing or at the
disc scales all of the row's own parameters by one factor. If one of several sensors at a place is wrong, they disagree;
with a single sensor, or several on one transducer, the common factor is the only evidence.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from scipy.special import chdtrc, ndtr, ndtri

from models.diagnosis.baseline.conditions import alike, force_spectrum, motion_power
from models.diagnosis.baseline.lag_moments import row_window, shared_covariance
from models.diagnosis.baseline.learned import positive, unsuitable
from models.diagnosis.baseline.relation import LOST, Relation, RowChange, one_source, read_row
from models.diagnosis.baseline.rows import Row, consecutive, learned_rows, parameters_of
from models.diagnosis.baseline.stored import Baseline
from models.diagnosis.baseline.unbalance import (
    SPEED_TOLERANCE,
    ForceRow,
    ForeignRotationError,
    SynchronousVectors,
    combination,
    relative_force,
    rotation_of,
)
from models.diagnosis.readings import Diagnosis, beyond, foreign_rotation, no_reading, parameter_reading, reversed_signs
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.signals.block import FloatArray

_SINGLE = 2.326  # standard errors beyond which no single parameter explains a window (one per cent, one-sided)
_COMMON = 2.576  # standard errors within which a common factor explains it (one per cent, two-sided)
_MOST_LOSS = -0.95
_SURE = 3.0  # standard errors up to which the size of a change is not in doubt


def gain_suspicion(
    diagnosis: Diagnosis, rows: Sequence[Row], relations: Sequence[Relation | None]
) -> tuple[float, str]:
    """Find the row whose changes look most like a gain error of all sensors of a place: ``gain of y1 or of y2``.

    A common factor explains its own parameters as well as separate changes do. With it comes that factor in standard
    errors, as a one-sided normal variable that allows for the number of rows tested. The sentence is empty if single
    parameters explain the changes of every row, or a common factor does not.
    """
    tested = [
        (row, relation)
        for row, relation in zip(rows, relations, strict=True)
        if relation is not None and len(row.own) > 1
    ]
    found = []
    for row, relation in tested:
        left = diagnosis.left_by([own.parameter for own in row.own])
        if left is None or left.single <= _SINGLE**2 or left.common > _COMMON**2:
            continue
        tail = 2 * len(tested) * float(ndtr(-abs(left.z)))
        places = [
            " and ".join(name for name in relation.states if name == coordinate or name.startswith(f"{coordinate}_"))
            for coordinate in dict.fromkeys(motion.coordinate for motion in row.motions)
        ]
        z = -float(ndtri(min(0.5, max(tail, 1e-300))))
        found.append((z, f"gain of {' or of '.join(filter(None, places))}"))
    return max(found, key=itemgetter(0), default=(0.0, ""))


_WORST_ERROR = 0.2
_RPM = 30 / math.pi
_GONE = -0.95  # a loss beyond this is not a real change of a bearing
_SURELY_OUTSIDE = 8.0
OTHER_FORCE = (
    "either another force drives the machine than in commissioning (then record a healthy condition like this one), or "
    "something has changed that no parameter describes"
)
"""What a misfit of learned relations may mean."""
# Factor on the standard errors of the bearing's parameters in windows with another force, for a relation learned in one
# condition: its error is not normal (decision 0012).
_OTHER_FORCE = 1.2


@dataclass(frozen=True, slots=True, eq=False)
class _Bearing:
    """Changes of all rows' own parameters."""

    values: FloatArray  # (n_own,)
    noise: FloatArray  # (n_own, n_own), covariance from the window alone
    sensitivity: FloatArray  # (n_own, n_coefficients), to the relations' coefficients
    common: FloatArray  # (n_own, n_own), covariance from the commissioning


class BaselineDiagnostician:
    """Reads changes of bearing and unbalance against a baseline.

    Changes of stiffness are relative to the stiffness to ground that holds the bearing, changes of damping and
    unbalance relative to the healthy ones.
    """

    by = "baseline"

    def __init__(self, baseline: Baseline, rows: Sequence[Row] | None = None) -> None:
        rows = baseline.rows if rows is None else rows
        self._baseline = baseline
        self._rows = learned_rows(rows)
        self._slices = consecutive(row.n_coefficients for row in self._rows)
        self._own = consecutive(len(row.own) for row in self._rows)
        self._forces = {
            row.name: ForceRow(row, at, own)
            for row, at, own in zip(self._rows, self._slices, self._own, strict=True)
            if any(other.rests_on == row.name for other in rows)
        }
        self._names = tuple(own.parameter for row in self._rows for own in row.own)
        self._parameters = parameters_of(rows)
        self._own_of = {own.parameter: own for row in rows for own in row.own}
        self._conditions = max(1, len({one.condition for one in baseline.consistency}))
        # Records from before growth was learned do not say whether the relations were tested in one condition only.
        self._one_condition = self._conditions == 1 and bool(baseline.growth)
        self._coefficients = np.zeros(self._slices[-1].stop)
        for at, relation in zip(self._slices, baseline.relations, strict=True):
            if relation is not None:
                self._coefficients[at] = relation.coefficients

    def reads(self, states: Collection[str]) -> bool:
        """Whether a relation can be read if these states are measured."""
        return any(one is not None and set(one.states).issubset(states) for one in self._baseline.relations)

    def diagnose(self, window: WindowStatistics) -> Diagnosis:
        """Judge one window; never raises: a parameter that cannot be read carries the reason."""
        reason = unsuitable(window)
        if reason:
            return Diagnosis(self.by, tuple(no_reading(n, self.by, reason) for n in self._parameters))
        changes: list[RowChange | None] = []
        reasons: dict[str, str] = {}
        for row, relation, why in zip(self._rows, self._baseline.relations, self._baseline.reasons, strict=True):
            change, why_not = _read(row, relation, window, why)
            changes.append(change)
            reasons |= {own.parameter: why_not for own in row.own}
        bearing = self._bearing(changes)
        names = list(self._names)
        values, total, common = bearing.values, bearing.noise + bearing.common, bearing.common
        through = np.eye(values.size)  # Jacobian of all changes with respect to the bearing's
        foreign = ""
        if "e" in self._parameters:
            names.append("e")
            reasons["e"] = ""
            try:
                values, total, common, through = self._with_unbalance(changes, bearing, window)
            except EstimationError as error:
                reasons["e"] = str(error)
                foreign = reasons["e"] if isinstance(error, ForeignRotationError) else ""
        same = self._as_commissioned(changes)
        if not same:
            least = _OTHER_FORCE if self._one_condition else 1.0
            alone = one_source(window)
            own = [self._own_of[name] for name in names[: values.size]]
            wider = np.array([max(least if one.terms else 1.0, one.one_source if alone else 1.0) for one in own])
            total, common = total * np.outer(wider, wider), common * np.outer(wider, wider)
        errors = np.sqrt(np.diag(total)[: bearing.values.size])
        elsewhere = through @ np.diag(self._relation_variances(bearing.values, errors, same=same)) @ through.T
        # A stiffness that grew with the motion has really changed, so the unbalance is read with it and gets no part of
        # this variance. Under the commissioned force, growth that commissioning did not show is not assumed.
        seen, unseen = self._growth_variances(changes)
        elsewhere[range(seen.size), range(seen.size)] += seen if same else seen + unseen
        total, common = total + elsewhere, common + elsewhere
        known = [names.index(name) for name in self._parameters if not reasons[name]]
        covariance = positive(total[np.ix_(known, known)])
        stated = dict(zip(known, np.sqrt(np.diag(covariance)).tolist(), strict=True))
        parameters = tuple(
            no_reading(name, self.by, reasons[name])
            if reasons[name]
            else parameter_reading(name, self.by, float(values[names.index(name)]), stated[names.index(name)])
            for name in self._parameters
        )
        diagnosis = Diagnosis(
            by=self.by,
            parameters=parameters,
            covariance=covariance if known else None,
            common=positive(common[np.ix_(known, known)]) if known else None,
            elsewhere=dict(zip(names, np.diag(elsewhere).tolist(), strict=False)),  # without e if it was not read
            misfit_z=_misfit(changes),
        )
        # The variance that allows for another force is left out here: it must not make a reading impossible.
        unlike = foreign or impossible(
            diagnosis, dict(zip(self._names, np.diag(bearing.noise + bearing.common), strict=True))
        )
        if unlike:
            return replace(diagnosis, misfit_z=max(_SURELY_OUTSIDE, diagnosis.misfit_z or 0.0), unexplained=unlike)
        z, suspect = gain_suspicion(diagnosis, self._rows, self._baseline.relations) if known else (0.0, "")
        if not suspect:
            abstains = self._one_condition and not same
            return replace(diagnosis, unexplained=_unexplained(diagnosis.misfit_z)) if abstains else diagnosis
        misfit = z if diagnosis.misfit_z is None else max(diagnosis.misfit_z, z)
        return replace(diagnosis, misfit_z=misfit, suspect=suspect)

    def _as_commissioned(self, changes: Sequence[RowChange | None]) -> bool:
        """Whether the force, computed with the changes of the window, is the commissioned one."""
        seen = [change for change in changes if change is not None]
        if not self._baseline.force.size or len(seen) < len(changes):
            return False
        now = force_spectrum([one.moments.of for one in seen], [one.combination for one in seen])
        return alike(self._baseline.force, now)

    def _relation_variances(self, changes: FloatArray, errors: FloatArray, *, same: bool) -> FloatArray:
        """Variances from the relations' errors: in other conditions, over the number learned from, and of size."""
        own = [self._own_of[name] for name in self._names]
        elsewhere = np.array([0.0 if same and not one.always else one.elsewhere for one in own])
        left = np.maximum(1 + changes, 1 + _MOST_LOSS)
        # Nothing is in doubt of the size of no change, so that this error never hides one.
        beyond = np.maximum(0.0, np.abs(np.log(left)) - _SURE * errors / left)
        of_size = np.array([one.of_size for one in own]) * beyond
        return np.asarray(left**2 * (elsewhere**2 / self._conditions + of_size**2), dtype=np.float64)

    def _growth_variances(self, changes: Sequence[RowChange | None]) -> tuple[FloatArray, FloatArray]:
        """Variances of stiffnesses at another power of motion: from growth that was seen, and from growth unseen."""
        found = np.zeros((2, len(self._names)))
        known = zip(self._rows, self._own, self._baseline.relations, self._baseline.growth, changes, strict=False)
        for row, at, relation, growth, change in known:
            if relation is None or growth is None or change is None:
                continue
            powers = motion_power(row, relation, change.moments.of.window)
            if powers is not None and powers.mean() > 0:
                power, scale = float(powers.mean()), [0 in own.terms for own in row.own]
                found[:, at] = np.outer([growth.seen_variance(power), growth.unseen_variance(power)], scale)
        return found[0], found[1]

    def _bearing(self, changes: list[RowChange | None]) -> _Bearing:
        n = len(self._names)
        values, noise, sensitivity = np.zeros(n), np.zeros((n, n)), np.zeros((n, self._coefficients.size))
        for i, a in enumerate(changes):
            if a is None:
                continue
            values[self._own[i]] = a.change
            sensitivity[self._own[i], self._slices[i]] = a.sensitivity
            for j, b in enumerate(changes[: i + 1]):
                if b is None:
                    continue
                both = a.moments, a.combination, b.moments, b.combination
                own = a.moments.covariance(a.combination) if i == j else shared_covariance(*both)
                own = a.projection @ own @ b.projection.T * math.sqrt(a.widening * b.widening)
                noise[self._own[i], self._own[j]] = own
                noise[self._own[j], self._own[i]] = own.T
        common = sensitivity @ self._baseline.covariance @ sensitivity.T
        for i, relation in enumerate(self._baseline.relations):
            if relation is None or changes[i] is None:
                continue
            for place, parameter in enumerate(self._rows[i].own, start=self._own[i].start):
                if len(parameter.terms) == 1 and parameter.terms != (0,):
                    # a relative change of damping is in units of a damping that is itself only estimated
                    at = parameter.terms[0] - 1
                    relative = relation.covariance[at, at] / relation.coefficients[at] ** 2
                    common[place, place] += max(0.0, (1 + values[place]) ** 2 - 1) * relative
        return _Bearing(values, noise, sensitivity, common)

    def _with_unbalance(
        self, changes: list[RowChange | None], bearing: _Bearing, window: WindowStatistics
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Changes of the bearing and of the unbalance, their covariance, and that from the commissioning alone.

        Last their Jacobian with respect to the bearing's changes. Raises EstimationError with the reason why the
        unbalance cannot be read.
        """
        rows = [
            self._forces[row.name]
            for row, change in zip(self._rows, changes, strict=True)
            if change is not None and row.name in self._forces
        ]
        if not rows:
            raise EstimationError("no relation could be read")
        if reversed_within := reversed_signs(window):
            raise EstimationError(reversed_within)
        coordinates = tuple(sorted({motion.coordinate for one in rows for motion in one.row.motions}))
        healthy, now = self._rotations(coordinates, window, rows)
        cov = self._baseline.covariance
        force = relative_force(rows, self._coefficients, bearing.values, now, healthy)
        to_d, to_now, to_healthy = force.to_change, force.to_now, force.to_healthy
        # errors of the coefficients act directly and through the bearing's changes
        through = to_d @ bearing.sensitivity + force.to_coefficients
        extra = bearing.common - bearing.sensitivity @ cov @ bearing.sensitivity.T
        shared = through @ cov @ through.T + to_d @ extra @ to_d.T + to_healthy @ healthy.covariance @ to_healthy.T
        spread = shared + to_d @ bearing.noise @ to_d.T + to_now @ now.covariance @ to_now.T
        shared_with = bearing.sensitivity @ cov @ through.T + extra @ to_d.T
        with_bearing = shared_with + bearing.noise @ to_d.T
        observed = force.value
        if not (np.all(np.isfinite(observed)) and np.all(np.isfinite(spread))):
            raise EstimationError("no unbalance in the healthy recording")
        design = np.kron(np.eye(2), np.ones((len(rows), 1))).astype(np.float64)
        # weighted as if the bearing were known: sharpest where the verdict is that nothing else changed
        total = positive(bearing.noise + bearing.common)
        known = with_bearing.T @ np.linalg.pinv(total, hermitian=True) @ with_bearing
        combine = combination(design, positive(spread - known))
        vector = combine @ observed
        usual = design @ [1.0, 0.0]
        if foreign := foreign_rotation(usual + observed, usual + design @ vector, spread):
            raise ForeignRotationError(
                "the 1× vibration is not what an unbalance causes, as if sensors of one "
                f"plane were swapped or reversed: {foreign}"
            )
        size = math.hypot(1 + vector[0], vector[1])
        along = np.array([1 + vector[0], vector[1]]) / max(size, 1e-9) @ combine
        variance = float(along @ spread @ along)
        error, most = math.sqrt(variance), _WORST_ERROR * max(1.0, size)
        if error > most:
            text, limit = beyond(100 * error, round(100 * most, 1))
            raise EstimationError(
                f"unbalance not determined well enough: standard error {text} %, limit for a reading {limit} %"
            )
        both = _bordered(bearing.noise + bearing.common, with_bearing @ along, variance)
        common = _bordered(bearing.common, shared_with @ along, float(along @ shared @ along))
        slopes = np.vstack([np.eye(bearing.values.size), along @ to_d])
        return np.append(bearing.values, size - 1), both, common, slopes

    def _rotations(
        self, coordinates: tuple[str, ...], window: WindowStatistics, rows: Sequence[ForceRow]
    ) -> tuple[SynchronousVectors, SynchronousVectors]:
        relations = [(one.row, np.append(1.0, -self._coefficients[one.coefficients])) for one in rows]
        now = rotation_of(window, coordinates, relations)
        if not self._baseline.rotations:
            raise EstimationError("the baseline has no phase reference and no speed found in the vibration")
        if now is None:
            slowest, fastest = (speed * _RPM for speed in window.speed_range)
            reason = "no phase reference, and no speed found in the vibration"
            if fastest > slowest * (1 + SPEED_TOLERANCE):
                varied = f"the speed varies from {slowest:.0f} to {fastest:.0f} rpm within the window"
                reason = f"{varied}, compared up to {SPEED_TOLERANCE:.0%}"
            raise EstimationError(reason)
        healthy = min(self._baseline.rotations, key=lambda one: abs(now.speed_rad_s / one.speed_rad_s - 1))
        if abs(now.speed_rad_s / healthy.speed_rad_s - 1) > SPEED_TOLERANCE:
            learned = ", ".join(f"{one.speed_rad_s * _RPM:.0f}" for one in self._baseline.rotations)
            raise EstimationError(f"speed {now.speed_rad_s * _RPM:.0f} rpm, the baseline was learned at {learned} rpm")
        healthy = healthy.of(coordinates)
        if healthy.absolute and now.absolute:
            return healthy, now
        return healthy.turned(healthy.largest), now.turned(healthy.largest)


def _unexplained(misfit_z: float | None) -> str:
    """Why no parameter is named if the relations fail under another force; empty if the misfit is small enough."""
    if misfit_z is None or misfit_z <= _SURELY_OUTSIDE:
        return ""
    text, limit = beyond(misfit_z, _SURELY_OUTSIDE)
    return (
        f"the learned relations do not hold here: their remainder is {text} standard errors more than "
        f"chance leaves, limit for a reading {limit}; {OTHER_FORCE}"
    )


def impossible(diagnosis: Diagnosis, variances: Mapping[str, float]) -> str:
    """Sentence on a stiffness or damping that has vanished or changed sign, or a stiffness of unknown size, else "".

    The variances are those of the readings without the allowance for another force.
    """
    unfit = (diagnosis.misfit_z or 0.0) > _SURELY_OUTSIDE
    for reading in diagnosis.evaluable:
        if reading.name == "e" or reading.relative_change is None or reading.standard_error is None:
            continue
        gone = reading.relative_change + 2 * reading.standard_error < _GONE
        # A reversed sensor makes nearly any stiffness fit, best one of the other sign; a force that hardly moves the
        # bearing does not, although the relation may not quite hold under it.
        lost = reading.name.startswith("k") and variances[reading.name] > LOST**2
        if gone or (lost and (unfit or abs(reading.relative_change) > LOST)):
            return f"{reading.name} is impossible, as if a sensor of this plane were swapped, reversed or delayed"
    return ""


def _bordered(matrix: FloatArray, border: FloatArray, corner: float) -> FloatArray:
    return np.block([[matrix, border[:, None]], [border[None, :], np.array([[corner]])]])


def _read(row: Row, relation: Relation | None, window: WindowStatistics, why: str) -> tuple[RowChange | None, str]:
    if relation is None:
        return None, why
    lacking = [name for name in relation.states if name not in window.states]
    if lacking:
        return None, f"not measured: {', '.join(lacking)}, which the baseline was learned with"
    references = tuple(name for name in relation.references if name in window.states)
    try:
        return read_row(row, relation, row_window(row, window, relation.states, references)), ""
    except EstimationError as error:
        return None, str(error)
    except np.linalg.LinAlgError:
        return None, f"{row.title}: a channel hardly vibrates in this window"


def _misfit(changes: list[RowChange | None]) -> float | None:
    """Misfit of the worst row as a standard normal variable, corrected for the number of rows."""
    used = [change for change in changes if change is not None]
    if not used:
        return None
    tail = min(float(chdtrc(change.degrees_of_freedom, change.chi2)) for change in used)
    tail = -math.expm1(len(used) * math.log1p(-min(tail, 1 - 1e-16)))
    return -float(ndtri(np.clip(tail, 1e-300, 1 - 1e-16)))
