"""The unbalance as what it is, a vector: how large it has become, and where the heavy spot has gone."""

import math
from dataclasses import dataclass, replace

__all__ = ["UnbalanceVector"]

_SEEN = 3.0
"""Standard errors from which a vector has a direction."""


@dataclass(frozen=True, slots=True)
class UnbalanceVector:
    """The unbalance over the nominal one, a complex number ρ: 1 is no change, j the same turned by 90°.

    Angles count from the nominal heavy spot in the direction of rotation.

    Attributes
    ----------
    real, imaginary : float
        Of ρ.
    variance_real, covariance, variance_imaginary : float
        Of these two.
    foreign : str
        Why what turns with the shaft is not what an unbalance makes, so that none of this should be believed; empty if
        it is.
    """

    real: float
    imaginary: float
    variance_real: float
    covariance: float
    variance_imaginary: float
    foreign: str = ""

    def widened(self, variance: float) -> "UnbalanceVector":
        """Return the same with an error added to both parts."""
        return replace(
            self, variance_real=self.variance_real + variance, variance_imaginary=self.variance_imaginary + variance
        )

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
        where = f"{self.change_angle_deg:.0f}° from the heavy spot".replace("-", "−")
        size = f"size {100 * self.magnitude_change:+.0f} %".replace("-", "−")
        turned = "" if self.turned_deg is None else f", turned by {self.turned_deg:.0f}°".replace("-", "−")
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
