"""Diagnosis of a window by one diagnostician: readings of parameters and equations, or why there are none."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np
from scipy.special import chdtri

from models.diagnosis.misfit import Goodness
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.physics.rotor import PARAMETER_TEXT, QUANTITY, impossible
from models.signals.block import FloatArray
from rotorwatch.records.windows import Equation, Parameter
from rotorwatch.records.windows import UnbalanceVector as VectorRecord

_DIGITS, _MOST_DIGITS = 3, 15
_MOST_LOSS = -0.95  # changes are limited to this before taking the logarithm


def beyond(value: float, limit: float) -> tuple[str, str]:
    """Print a value and its limit, with enough digits that the printed value is on the right side of the limit.

    Examples
    --------
    >>> beyond(7.4449, 5.0)
    ('7.44', '5')
    >>> beyond(20.0004, 20.0)
    ('20.0004', '20')
    """
    for digits in range(_DIGITS, _MOST_DIGITS):
        text = f"{value:.{digits}g}"
        if (float(text) > limit) == (value > limit) and float(text) != limit:
            break
    return text, f"{limit:g}"


_VECTOR_ERROR = 0.15  # relative error of every vector due to the sensors and the model's approximation of the rotor
_RATE = 1e-6  # probability that the vectors of an unbalance are taken for foreign


def foreign_rotation(observed: FloatArray, explained: FloatArray, spread: FloatArray) -> str:
    """Sentence on how badly an unbalance explains the 1x vectors; empty if it explains them.

    `observed`, shape (2n,), holds the real parts of the vectors, then the imaginary ones, with their covariance,
    `spread`; `explained` those of the best-fitting unbalance.
    """
    n = observed.size // 2
    if n < 2:
        return ""
    size = np.maximum(np.hypot(observed[:n], observed[n:]), np.hypot(explained[:n], explained[n:]))
    left = observed - explained
    allowed = spread + np.diag(np.tile((_VECTOR_ERROR * size) ** 2 / 2, 2))
    chi2, most = float(left @ np.linalg.solve(allowed, left)), float(chdtri(2 * n - 2, _RATE))
    if chi2 <= most:
        return ""
    text, limit = beyond(chi2, round(most, 1))
    return f"its misfit χ² is {text} with {2 * n - 2} degrees of freedom, evaluation limit {limit}"


_MOST_SCATTER = 0.35  # median change of a vector from hop to hop, relative, up to which reversed signs are seen
_HALF_TURN = (0.15, 3.0, 0.5)  # distance from the reversed vector: a part of it plus standard errors, and at most


def reversed_signs(window: WindowStatistics) -> str:
    """Sentence on 1x vectors that turned by 180° within the window at constant length, while no other one changed.

    They say nothing of the unbalance then: a heavy spot turns all vectors, mostly by another angle, and a change of the
    rotor changes their lengths, too. Empty if nothing of the kind is seen.
    """
    vectors = window.hop_synchronous
    if vectors is None or len(vectors) < 3 or window.removed_by_hop or not vectors.all():
        return ""
    unit = vectors / np.abs(vectors).mean(axis=0)
    scatter = np.median(np.abs(np.diff(unit, axis=0)), axis=0)
    if np.any(scatter > _MOST_SCATTER) or np.all(np.abs(np.angle(unit / unit[0])) < np.pi / 4):
        return ""  # within an eighth of a turn of the first: no two are opposite
    # Between the two sides may be a hop astride the reversal.
    sides = [(unit[:hop], unit[hop + 1 :]) for hop in range(1, len(unit) - 1)]
    before, after = min(sides, key=lambda both: sum(side.var(axis=0).sum() * len(side) for side in both))
    ratio = after.mean(axis=0) / before.mean(axis=0)
    part, errors, most = _HALF_TURN
    near = np.minimum(part + errors * scatter * np.sqrt(1 / len(before) + 1 / len(after)), most)
    turned = np.abs(ratio + 1) < near
    if np.count_nonzero(turned) < 2 or not np.all(turned | (np.abs(ratio - 1) < near)):
        return ""
    names = ", ".join(state for state, one in zip(window.states, turned, strict=True) if one)
    return f"the 1× vectors of {names} turned by 180° within the window and kept their length: reversed signs?"


_DIRECTION_ERRORS = 3.0  # standard errors from which a vector has a direction
# Least movement of the heavy spot that counts as turned, in standard errors and as part of the unbalance: angle sensors
# and probes are not mounted more accurately than to a few degrees.
_TURNED, _LEAST_TURN = 6.0, 0.05
_SAME_SIZE = 0.1  # with a smaller change of size, a turn may come from the sensor: real ones mostly change the size


@dataclass(frozen=True, slots=True)
class UnbalanceVector:
    """The unbalance over the nominal one, a complex number ρ: 1 is no change, j the same turned by 90°.

    Angles count from the nominal heavy spot in the direction of rotation.
    """

    # Parts of ρ.
    real: float
    imaginary: float
    # Covariance of these parts.
    variance_real: float
    covariance: float
    variance_imaginary: float
    # Why the 1x vectors are not those of an unbalance, so that no value here should be believed; empty if they are.
    foreign: str = ""
    directed: bool = True  # whether its direction is meaningful

    def widened(self, variance: float) -> "UnbalanceVector":
        """Return the same vector with a variance added to both parts."""
        real, imaginary = self.variance_real + variance, self.variance_imaginary + variance
        return replace(self, variance_real=real, variance_imaginary=imaginary)

    def read_as(self, change: float, own: float) -> "UnbalanceVector":
        """Return the vector scaled to the reading of e, as a window that straddles a change shows only part of it.

        `change` is the relative change of e as read, `own` that of the window by itself; see `parameter_reading`.
        """
        if self.moved:
            part = change / own if own else 1.0
            return replace(self, real=1 + part * (self.real - 1), imaginary=part * self.imaginary)
        part = abs((1 + change) / (1 + own)) if own != -1 else 1.0
        return replace(self, real=part * self.real, imaginary=part * self.imaginary)

    @property
    def magnitude_change(self) -> float:
        """|ρ| - 1: relative change of the unbalance's size, never below -1."""
        return math.hypot(self.real, self.imaginary) - 1

    @property
    def magnitude_error(self) -> float:
        """Standard error of `magnitude_change`."""
        return self._error(self.real, self.imaginary)

    @property
    def turned_deg(self) -> float | None:
        """Angle by which the heavy spot has turned, -180 to 180; None if too little unbalance is left to have one."""
        return self._angle(self.real, self.imaginary)

    @property
    def turned_error_deg(self) -> float | None:
        """Standard error of `turned_deg`."""
        if self.turned_deg is None:
            return None
        return math.degrees(self._error(-self.imaginary, self.real) / math.hypot(self.real, self.imaginary))

    @property
    def turned(self) -> bool:
        """Whether the heavy spot has moved significantly."""
        if self.turned_error_deg is None:  # too little unbalance is left to have a direction
            return False
        size = math.hypot(self.real, self.imaginary)
        turn = math.hypot(self.real - size, self.imaginary)
        return turn > max(_TURNED * size * math.radians(self.turned_error_deg), _LEAST_TURN)

    @property
    def moved(self) -> bool:
        """Whether most of the change is the turn, so that the reading of e is the size of the vector of change."""
        size = math.hypot(self.real, self.imaginary)
        return self.directed and self.turned and math.hypot(self.real - size, self.imaginary) > abs(size - 1)

    @property
    def change(self) -> float:
        """|ρ - 1|: size of the vector by which the unbalance changed, over the nominal unbalance."""
        return math.hypot(self.real - 1, self.imaginary)

    @property
    def change_error(self) -> float:
        """Standard error of `change`, along the vector."""
        return self._error(self.real - 1, self.imaginary)

    @property
    def change_angle_deg(self) -> float | None:
        """Direction of the vector of change, from the nominal heavy spot; None if the change is within its errors."""
        return self._angle(self.real - 1, self.imaginary)

    @property
    def sentence(self) -> str:
        """The change in words."""
        if self.change_angle_deg is None:
            return "no change of its vector"
        where = f"{self.change_angle_deg:z.0f}° from the heavy spot".replace("-", "−")
        size = f"size {100 * self.magnitude_change:+z.0f} %".replace("-", "−")
        turned = "" if self.turned_deg is None else f", turned by {self.turned_deg:z.0f}°".replace("-", "−")
        if self.turned and abs(self.magnitude_change) < _SAME_SIZE:
            turned += ": the heavy spot has moved, or the zero of the shaft angle"
        return f"a vector of {100 * self.change:.0f} % of the nominal unbalance at {where} ({size}{turned})"

    def _error(self, x: float, y: float) -> float:
        """Standard error in the direction (x, y)."""
        length = math.hypot(x, y)
        x, y = (x / length, y / length) if length > 0 else (1.0, 0.0)
        along = x**2 * self.variance_real + 2 * x * y * self.covariance + y**2 * self.variance_imaginary
        return math.sqrt(max(along, 0.0))

    def _angle(self, x: float, y: float) -> float | None:
        seen = math.hypot(x, y) > _DIRECTION_ERRORS * max(self._error(x, y), self._error(-y, x))
        return math.degrees(math.atan2(y, x)) if seen else None


Z95 = 1.959964  # standard errors on either side of a 95 % interval
_ROUNDED_TO_NOTHING = 0.0005  # a smaller half interval would print as 0.0 % with one digit


def percent_digits(half: float) -> int:
    """Decimal places of a change in percent: one, or more so that a small half interval shows two digits.

    Examples
    --------
    >>> percent_digits(0.014), percent_digits(0.00039)
    (1, 3)
    """
    return 1 - math.floor(math.log10(100 * half)) if 0 < half < _ROUNDED_TO_NOTHING else 1


def interval_95(value: float, standard_error: float, least: float = -math.inf) -> tuple[float, float]:
    """95 % interval of a value that cannot be less than `least`."""
    half = Z95 * standard_error
    return max(least, value - half), value + half


def parameter_reading(
    name: str, by: str, change: float, standard_error: float, vector: UnbalanceVector | None = None
) -> Parameter:
    """One diagnostician's reading of a parameter.

    For e, there is a vector if there is a phase reference. The change is then that of its size while the heavy spot
    stays in place, and the size of the vector of change once it has turned.

    Raises
    ------
    EstimationError
        If the change is not finite.
    """
    if not math.isfinite(change):
        raise EstimationError(f"{by}: change of {name} reads as {change}, expected a finite number")
    known = math.isfinite(standard_error)
    return Parameter(
        name=name,
        text=PARAMETER_TEXT[name],
        by=by,
        relative_change=change,
        standard_error=standard_error,
        interval_95=interval_95(change, standard_error, least=-1.0) if known else None,
        z=change / standard_error if known and standard_error else None,
        vector=None if vector is None else _stated(vector, seen=abs(change) > _DIRECTION_ERRORS * standard_error),
    )


def no_reading(name: str, by: str, reason: str) -> Parameter:
    """A parameter without a number, with the reason why a diagnostician cannot read it."""
    return Parameter(name=name, text=PARAMETER_TEXT[name], by=by, reason=reason)


def not_determined(error: float, most: float) -> str:
    """Reason why there is no reading with this standard error: it is above `most`, or not a number."""
    text, limit = beyond(100 * error, 100 * most)
    return f"not determined in this window (standard error {text} %, limit for a reading {limit} %)"


def possible_reading(
    name: str, by: str, change: float, standard_error: float, vector: UnbalanceVector | None = None
) -> Parameter:
    """A reading, or no reading if the change is not finite or physically impossible."""
    reason = impossible(change, QUANTITY[name]) if math.isfinite(change) else f"reads as {change}"
    return no_reading(name, by, reason) if reason else parameter_reading(name, by, change, standard_error, vector)


def _stated(vector: UnbalanceVector, *, seen: bool) -> VectorRecord:
    turned, turned_error = vector.turned_deg, vector.turned_error_deg
    return VectorRecord(
        magnitude_change=vector.magnitude_change,
        magnitude_interval_95=interval_95(vector.magnitude_change, vector.magnitude_error, least=-1.0),
        turned_deg=turned,
        turned_interval_95_deg=None if turned is None or turned_error is None else interval_95(turned, turned_error),
        change=vector.change,
        change_interval_95=interval_95(vector.change, vector.change_error, least=0.0),
        change_angle_deg=vector.change_angle_deg,
        text="direction of its change not known" if seen and vector.change_angle_deg is None else vector.sentence,
    )


class Left(NamedTuple):
    """Residual χ² of several parameters' changes under simpler explanations."""

    single: float  # only the best of the parameters changed
    common: float  # one factor on all of them, as from a wrong gain
    z: float  # the logarithm of that factor in standard errors


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One diagnostician's diagnosis of one window."""

    by: str  # diagnostician: ``likelihood``, ``network``, ``relation`` or ``baseline``
    parameters: tuple[Parameter, ...] = ()  # the parameters that it covers, with a reading or a reason why not
    equations: tuple[Equation, ...] = ()  # the equations it evaluated; empty for the likelihood
    # (m, m): covariance of the m evaluable `parameters`' changes, in their order; None if the diagnostician only knows
    # individual standard errors
    covariance: FloatArray | None = None
    # Size and direction of e, if it is evaluable and there is a phase reference.
    unbalance: UnbalanceVector | None = None
    # (m, m): part of `covariance` that all windows share, such as the error of a commissioning: further windows do not
    # reduce it. None if there is no such part.
    common: FloatArray | None = None
    # Part of the variances in `common`, by parameter, that longer healthy recordings do not reduce either: the error of
    # a relation in conditions that it was not learned in.
    elsewhere: Mapping[str, float] = field(default_factory=dict)
    # Degrees of freedom of the standard errors (Student's t), by parameter: with few, large deviations are less
    # unlikely than under a normal distribution. Parameters that are not in it are normal.
    freedom: Mapping[str, float] = field(default_factory=dict)
    # By parameter, and by another parameter that the reading assumes unchanged: the apparent change of the first if the
    # other one changes by 1.
    taken_for: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    # Over-identification: how far the window is from anything the model can explain, standard normal if the model
    # holds; None if the diagnostician has no such test.
    misfit_z: float | None = None
    goodness: Goodness | None = None  # the tests that make up the misfit, if it is made of tests of single causes
    # Cause that best explains the misfit: a sensor's gain, a mass, a shaft unequal in y and z; empty if none stands out
    # or there is no such test.
    suspect: str = ""
    # Why no reading here should be believed: the window is so far from all the model can explain that parameters fitted
    # to it mean nothing, or the relations, learned in a single condition, fail under another force. Empty otherwise,
    # however significant the misfit is.
    unexplained: str = ""
    steps: int = 0  # search steps it took (0 where there is no search)

    @property
    def evaluable(self) -> tuple[Parameter, ...]:
        """The parameters with a reading, in the order of `covariance`."""
        return tuple(one for one in self.parameters if one.relative_change is not None)

    @property
    def full_covariance(self) -> FloatArray:
        """`covariance`, or without one a diagonal matrix of the squared standard errors."""
        if self.covariance is not None:
            return self.covariance
        errors = [one.standard_error for one in self.evaluable]
        return np.diag(np.square(np.array(errors, dtype=np.float64)))

    def left_by(self, names: Sequence[str]) -> "Left | None":
        """Residuals of some parameters' changes under simpler explanations; None if one of them was not read."""
        known = [one.name for one in self.evaluable]
        if not names or not set(names) <= set(known):
            return None
        at = [known.index(name) for name in names]
        changes = np.array([max(_MOST_LOSS, self.evaluable[i].relative_change or 0.0) for i in at])
        x = np.log1p(changes)
        J = np.linalg.inv(self.full_covariance[np.ix_(at, at)] / np.outer(1 + changes, 1 + changes))
        b, everything, ones = J @ x, float(x @ J @ x), np.ones(x.size)
        weight = float(ones @ J @ ones)
        factor = float(ones @ b) / weight
        single = float(np.min(everything - b**2 / np.diag(J)))
        return Left(single, everything - factor**2 * weight, factor * math.sqrt(weight))


class Diagnostician(Protocol):
    """Reads, window by window, which parameters changed, by how much, and with which standard errors."""

    @property
    def by(self) -> str:
        """Name under which it is reported."""

    def diagnose(self, window: WindowStatistics) -> Diagnosis:
        """Judge one window.

        Raises
        ------
        models.errors.EstimationError
            If the window as a whole cannot be judged.
        """
