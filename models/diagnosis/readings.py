"""What a diagnostician says about a window: readings of parameters and of equations, or why there are none."""

from dataclasses import dataclass

__all__ = ["EquationReading", "ParameterReading"]

_Z95 = 1.959964


@dataclass(frozen=True, slots=True)
class ParameterReading:
    """One parameter's relative change in one window, as one diagnostician sees it.

    Attributes
    ----------
    name : str
        One of ``models.physics.parameters.PARAMETERS``.
    by : str
        Who says so: ``likelihood`` or ``network``.
    change, standard_error : float or None
        Relative change from nominal and its standard error; None if not evaluable.
    reason : str
        Why it could not be evaluated; empty if it was.
    """

    name: str
    by: str
    change: float | None = None
    standard_error: float | None = None
    reason: str = ""

    @property
    def interval(self) -> tuple[float, float] | None:
        """95 % interval of the change."""
        if self.change is None or self.standard_error is None:
            return None
        return self.change - _Z95 * self.standard_error, self.change + _Z95 * self.standard_error

    @property
    def z(self) -> float | None:
        """Change in standard errors."""
        if self.change is None or self.standard_error is None:
            return None
        return self.change / self.standard_error


@dataclass(frozen=True, slots=True)
class EquationReading:
    """Residual of one compatibility equation in one window.

    Attributes
    ----------
    equation : str
        The paper's number: "28" to "31".
    title : str
        What the equation is about.
    msd : float or None
        Mean squared deviation between the network's output and the estimated correlation, in units of the target's mean
        square (the paper's measure).
    msd_healthy : float or None
        The same on healthy windows that training did not see: mean.
    parameters : tuple of ParameterReading
        The residual projected on the equation's own parameters.
    reason : str
        Why the equation could not be evaluated; empty if it was.
    """

    equation: str
    title: str
    msd: float | None = None
    msd_healthy: float | None = None
    parameters: tuple[ParameterReading, ...] = ()
    reason: str = ""

    @property
    def evaluable(self) -> bool:
        """Whether the equation was evaluated."""
        return not self.reason
