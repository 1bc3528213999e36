"""The ellipse that a shaft describes at running speed, from the vectors of two directions."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Ellipse:
    """Orbit y = Re{y e^{jθ}}, z = Re{z e^{jθ}} over the shaft angle θ.

    In the plane y + jz it is a part that goes round with the shaft and one that goes against it:
    y(θ) + j z(θ) = F e^{jθ} + B e^{-jθ}.

    Attributes
    ----------
    y, z : complex
        Vectors, both in one unit; so are all lengths below.

    Examples
    --------
    >>> circle = Ellipse(2.0, -2.0j)
    >>> circle.semi_major, circle.semi_minor, circle.precession
    (2.0, 2.0, 'forward')
    """

    y: complex
    z: complex

    @property
    def _forward(self) -> complex:
        return (self.y + 1j * self.z) / 2

    @property
    def _backward(self) -> complex:
        return (self.y.conjugate() + 1j * self.z.conjugate()) / 2

    @property
    def semi_major(self) -> float:
        """Half of the long axis."""
        return abs(self._forward) + abs(self._backward)

    @property
    def semi_minor(self) -> float:
        """Half of the short axis."""
        return abs(abs(self._forward) - abs(self._backward))

    @property
    def precession(self) -> str:
        """``forward``: round the orbit as θ grows from y to z; ``backward``: against it."""
        return "forward" if abs(self._forward) >= abs(self._backward) else "backward"

    @property
    def tilt_deg(self) -> float:
        """Angle from y, towards z, to the long axis, above -90 and up to 90°."""
        turned = np.degrees(np.angle(self._forward) + np.angle(self._backward)) / 2
        return float(90 - (90 - turned) % 180)


def phase_lag_deg(vector: complex, direction: int) -> float:
    """How far the shaft turns from the reference (angle 0) to the positive peak of Re{vector e^{jθ}}, 0 to 360°.

    Parameters
    ----------
    direction : int
        1 if the shaft angle grows, -1 if it falls.
    """
    return float(np.degrees(-np.angle(vector) * direction) % 360)
