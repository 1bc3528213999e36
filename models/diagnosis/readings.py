"""What a diagnostician says about a window: readings of parameters and of equations, or why there are none."""

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
_MOST_LOSS = -0.95  # of which the logarithm is taken


def beyond(value: float, limit: float) -> tuple[str, str]:
    """Print a value and the limit it is beyond with so many digits that it is beyond the limit as printed, too.

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


_GAIN = 0.15  # relative error of every vector: what sensors, and a rotor that is not quite that of the model, make
_RATE = 1e-6  # probability that vectors of an unbalance are taken for those of something else


def foreign_rotation(observed: FloatArray, explained: FloatArray, spread: FloatArray) -> str:
    """By how much what turns with the shaft is not what an unbalance makes; empty if it is.

    Observed are real parts of the vectors, then imaginary ones, shape (2n,), with their covariance, `spread`; explained
    are those of the unbalance that is nearest.
    """
    n = observed.size // 2
    if n < 2:
        return ""
    size = np.maximum(np.hypot(observed[:n], observed[n:]), np.hypot(explained[:n], explained[n:]))
    left = observed - explained
    allowed = spread + np.diag(np.tile((_GAIN * size) ** 2 / 2, 2))
    chi2, most = float(left @ np.linalg.solve(allowed, left)), float(chdtri(2 * n - 2, _RATE))
    if chi2 <= most:
        return ""
    text, limit = beyond(chi2, round(most, 1))
    return f"its misfit χ² is {text} with {2 * n - 2} degrees of freedom, evaluation limit {limit}"


_SEEN = 3.0  # standard errors from which a vector has a direction
# Standard errors, and part of the unbalance, by which the heavy spot must have moved to count as turned: angle sensors
# and probes are not mounted better than to a few degrees.
_TURNED, _LEAST_TURN = 6.0, 0.05
_SAME_SIZE = 0.1  # a heavy spot seldom moves without a change of its size; a sensor does


@dataclass(frozen=True, slots=True)
class UnbalanceVector:
    """The unbalance over the nominal one, a complex number ρ: 1 is no change, j the same turned by 90°.

    Angles count from the nominal heavy spot in the direction of rotation.
    """

    # Of ρ.
    real: float
    imaginary: float
    # Of these two.
    variance_real: float
    covariance: float
    variance_imaginary: float
    # Why what turns with the shaft is not what an unbalance makes, so that none of this should be believed; empty if it
    # is.
    foreign: str = ""
    directed: bool = True  # whether its direction says something

    def widened(self, variance: float) -> "UnbalanceVector":
        """Return the same with an error added to both parts."""
        real, imaginary = self.variance_real + variance, self.variance_imaginary + variance
        return replace(self, variance_real=real, variance_imaginary=imaginary)

    def read_as(self, change: float, own: float) -> "UnbalanceVector":
        """Return the same as large as e is read: a window that is astride a change shows a part of it.

        The relative change of e is `change` as read, `own` as the window by itself says; see `parameter_reading`.
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
        """Angle of the heavy spot from where it was, -180 to 180; None where so little is left that it has none."""
        return self._angle(self.real, self.imaginary)

    @property
    def turned_error_deg(self) -> float | None:
        """Standard error of `turned_deg`."""
        if self.turned_deg is None:
            return None
        return math.degrees(self._error(-self.imaginary, self.real) / math.hypot(self.real, self.imaginary))

    @property
    def turned(self) -> bool:
        """Whether the heavy spot is elsewhere."""
        if self.turned_error_deg is None:  # so little is left that it has no direction
            return False
        size = math.hypot(self.real, self.imaginary)
        turn = math.hypot(self.real - size, self.imaginary)
        return turn > max(_TURNED * size * math.radians(self.turned_error_deg), _LEAST_TURN)

    @property
    def moved(self) -> bool:
        """Whether most of the change is the turn, so that what is read as e is the size of the vector of change."""
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
        """Direction of that vector, from the nominal heavy spot; None where the change is within its errors."""
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
        """Standard error along a direction."""
        length = math.hypot(x, y)
        x, y = (x / length, y / length) if length > 0 else (1.0, 0.0)
        along = x**2 * self.variance_real + 2 * x * y * self.covariance + y**2 * self.variance_imaginary
        return math.sqrt(max(along, 0.0))

    def _angle(self, x: float, y: float) -> float | None:
        seen = math.hypot(x, y) > _SEEN * max(self._error(x, y), self._error(-y, x))
        return math.degrees(math.atan2(y, x)) if seen else None


Z95 = 1.959964  # standard errors on either side of a 95 % interval
_ROUNDED_TO_NOTHING = 0.0005  # one digit would leave 0.0 % of half an interval below it


def percent_digits(half: float) -> int:
    """Digits after the point of a change in percent: one, or two of the half of its interval where that is smaller.

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
    """One parameter as one diagnostician reads it.

    Of e there is a vector where there is a phase reference. The change is then that of its size as long as the heavy
    spot stays where it is, and the size of the vector of change once it has turned.

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
        vector=None if vector is None else _stated(vector),
    )


def no_reading(name: str, by: str, reason: str) -> Parameter:
    """Why one diagnostician cannot read a parameter."""
    return Parameter(name=name, text=PARAMETER_TEXT[name], by=by, reason=reason)


def possible_reading(
    name: str, by: str, change: float, standard_error: float, vector: UnbalanceVector | None = None
) -> Parameter:
    """A reading, or the reason why the number is none: physics does not allow it."""
    reason = impossible(change, QUANTITY[name]) if math.isfinite(change) else f"reads as {change}"
    return no_reading(name, by, reason) if reason else parameter_reading(name, by, change, standard_error, vector)


def _stated(vector: UnbalanceVector) -> VectorRecord:
    turned, turned_error = vector.turned_deg, vector.turned_error_deg
    return VectorRecord(
        magnitude_change=vector.magnitude_change,
        magnitude_interval_95=interval_95(vector.magnitude_change, vector.magnitude_error, least=-1.0),
        turned_deg=turned,
        turned_interval_95_deg=None if turned is None or turned_error is None else interval_95(turned, turned_error),
        change=vector.change,
        change_interval_95=interval_95(vector.change, vector.change_error, least=0.0),
        change_angle_deg=vector.change_angle_deg,
        text=vector.sentence,
    )


class Left(NamedTuple):
    """What simpler explanations leave of several parameters' changes, in squared standard errors."""

    single: float  # the best of them alone
    common: float  # one factor on all of them, as of a wrong gain
    factor: float  # its logarithm
    z: float  # that in standard errors


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One diagnostician's opinion of one window."""

    by: str  # who: ``likelihood``, ``network``, ``relation`` or ``paper``
    parameters: tuple[Parameter, ...] = ()  # the parameters it speaks of, evaluable or with the reason why not
    equations: tuple[Equation, ...] = ()  # the equations it evaluated; empty for the likelihood
    # (m, m): covariance of the m evaluable `parameters`' changes, in their order; None where a diagnostician knows only
    # single standard errors
    covariance: FloatArray | None = None
    # Of e, where it is evaluable and there is a phase reference: size and direction.
    unbalance: UnbalanceVector | None = None
    # (m, m): part of `covariance` that every window shares, as the error of a commissioning does: further windows do
    # not remove it. None where there is no such part.
    common: FloatArray | None = None
    # Part of the variances in `common`, by parameter, that longer healthy recordings do not remove either: what a
    # relation is off in conditions that it was not learned in.
    elsewhere: Mapping[str, float] = field(default_factory=dict)
    # Degrees of freedom of the standard errors (Student's t), by parameter: far from zero a reading with few of them is
    # less unlikely than a normal one. What is not in it is normal.
    freedom: Mapping[str, float] = field(default_factory=dict)
    # Of a parameter, what the reading takes for a change of it when another one changes by 1, which it takes as
    # unchanged.
    taken_for: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    # Over-identification: how far the window is from anything the model can explain, standard normal where the model
    # holds; None where the diagnostician has no such test.
    misfit_z: float | None = None
    goodness: Goodness | None = None  # what that is made of, where it is made of tests of single things
    # What explains the misfit best, if one thing does: a sensor's gain, a mass, a shaft unequal in y and z; empty if
    # nothing stands out or there is no such test.
    suspect: str = ""
    # Why nothing that is read here should be believed: the window is so far from all the model can explain that
    # parameters fitted to it mean nothing, or another force moves the machine than the one that a single condition
    # was learned under, and the relations do not hold. Empty otherwise, however significant a misfit is.
    unexplained: str = ""
    steps: int = 0  # search steps it took (0 where there is no search)

    @property
    def evaluable(self) -> tuple[Parameter, ...]:
        """The parameters with a reading, in the order of `covariance`."""
        return tuple(one for one in self.parameters if one.relative_change is not None)

    @property
    def full_covariance(self) -> FloatArray:
        """`covariance`, or the diagonal of the squared standard errors where there is none."""
        if self.covariance is not None:
            return self.covariance
        errors = [one.standard_error for one in self.evaluable]
        return np.diag(np.square(np.array(errors, dtype=np.float64)))

    def left_by(self, names: Sequence[str]) -> "Left | None":
        """What simpler explanations leave of some parameters' changes; None where one of them was not read."""
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
        return Left(single, everything - factor**2 * weight, factor, factor * math.sqrt(weight))


class Diagnostician(Protocol):
    """Looks at one window after the other and says which parameter changed, by how much, and how sure."""

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
