"""What a diagnostician says about a window: readings of parameters and of equations, or why there are none."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from models.diagnosis.unbalance_vector import UnbalanceVector
from models.diagnosis.window import WindowStatistics
from models.physics.parameters import QUANTITY
from models.physics.possible import impossible
from models.signals.block import FloatArray

__all__ = ["Z95", "Diagnosis", "Diagnostician", "EquationReading", "ParameterReading", "interval_95"]

Z95 = 1.959964
"""Standard errors on either side of a 95 % interval."""


def interval_95(value: float, standard_error: float, least: float = -math.inf) -> tuple[float, float]:
    """95 % interval of a value that cannot be less than `least`."""
    half = Z95 * standard_error
    return max(least, value - half), value + half


@dataclass(frozen=True, slots=True)
class ParameterReading:
    """One parameter's relative change in one window, as one diagnostician sees it.

    Attributes
    ----------
    name : str
        One of ``models.physics.parameters.PARAMETERS``.
    by : str
        Who says so: ``likelihood``, ``network`` (amortised) or ``relation``.
    change, standard_error : float or None
        Relative change from nominal and its standard error; None if not evaluable.
    reason : str
        Why it could not be evaluated; empty if it was.
    vector : UnbalanceVector or None
        Of e, where there is a phase reference: size and direction. `change` is then that of the size as long as the
        heavy spot stays where it is, and the size of the vector of change once it has turned.
    """

    name: str
    by: str
    change: float | None = None
    standard_error: float | None = None
    reason: str = ""
    vector: UnbalanceVector | None = None

    @classmethod
    def of(
        cls, name: str, by: str, change: float, standard_error: float, vector: UnbalanceVector | None = None
    ) -> "ParameterReading":
        """A reading, or the reason why the number is none: physics does not allow it."""
        reason = impossible(change, QUANTITY[name])
        return cls(name, by, reason=reason) if reason else cls(name, by, change, standard_error, vector=vector)

    @property
    def interval(self) -> tuple[float, float] | None:
        """95 % interval of the change."""
        if self.change is None or self.standard_error is None:
            return None
        return interval_95(self.change, self.standard_error, least=-1.0)

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


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One diagnostician's opinion of one window.

    Attributes
    ----------
    by : str
        Who: ``likelihood``, ``network``, ``relation`` or ``paper``.
    parameters : tuple of ParameterReading
        The parameters it speaks of, evaluable or with the reason why not.
    equations : tuple of EquationReading
        The equations it evaluated; empty for the likelihood.
    covariance : ndarray, shape (m, m), or None
        Covariance of the m evaluable `parameters`' changes, in their order; None where a diagnostician knows only
        single standard errors.
    common : ndarray, shape (m, m), or None
        Part of `covariance` that every window shares, as the error of a commissioning does: further windows do not
        remove it. None where there is no such part.
    misfit_z : float or None
        Over-identification: how far the window is from anything the model can explain, standard normal where the model
        holds; None where the diagnostician has no such test.
    suspect : str
        What explains the misfit best, if one thing does: a sensor's gain, a mass, a shaft unequal in y and z; empty if
        nothing stands out or there is no such test.
    unexplained : str
        Why nothing that is read here should be believed: the window is so far from all the model can explain that
        parameters fitted to it mean nothing. Empty where the model explains it, however significant a misfit is.
    steps : int
        Search steps it took (0 where there is no search).
    """

    by: str
    parameters: tuple[ParameterReading, ...] = ()
    equations: tuple[EquationReading, ...] = ()
    covariance: FloatArray | None = None
    common: FloatArray | None = None
    misfit_z: float | None = None
    suspect: str = ""
    unexplained: str = ""
    steps: int = 0

    @property
    def evaluable(self) -> tuple[ParameterReading, ...]:
        """The parameters with a reading, in the order of `covariance`."""
        return tuple(reading for reading in self.parameters if reading.change is not None)

    @property
    def full_covariance(self) -> FloatArray:
        """`covariance`, or the diagonal of the squared standard errors where there is none."""
        if self.covariance is not None:
            return self.covariance
        errors = [reading.standard_error for reading in self.evaluable]
        return np.diag(np.square(np.array(errors, dtype=np.float64)))


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
