"""What a diagnostician says about a window: readings of parameters and of equations, or why there are none."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from models.diagnosis.unbalance_vector import UnbalanceVector
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.physics.parameters import PARAMETER_TEXT, QUANTITY
from models.physics.possible import impossible
from models.signals.block import FloatArray
from rotorwatch.records.windows import Equation, Parameter
from rotorwatch.records.windows import UnbalanceVector as VectorRecord

__all__ = ["Z95", "Diagnosis", "Diagnostician", "interval_95", "no_reading", "parameter_reading", "possible_reading"]

Z95 = 1.959964
"""Standard errors on either side of a 95 % interval."""


def interval_95(value: float, standard_error: float, least: float = -math.inf) -> tuple[float, float]:
    """95 % interval of a value that cannot be less than `least`."""
    half = Z95 * standard_error
    return max(least, value - half), value + half


def parameter_reading(
    name: str, by: str, change: float, standard_error: float, vector: UnbalanceVector | None = None
) -> Parameter:
    """One parameter as one diagnostician reads it.

    Parameters
    ----------
    name : str
        One of ``models.physics.parameters.PARAMETERS``.
    by : str
        Who says so: ``likelihood``, ``network`` (amortised), ``relation`` or ``baseline``.
    change, standard_error : float
        Relative change from nominal and its standard error.
    vector : UnbalanceVector, optional
        Of e, where there is a phase reference. `change` is then that of its size as long as the heavy spot stays where
        it is, and the size of the vector of change once it has turned.

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


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One diagnostician's opinion of one window.

    Attributes
    ----------
    by : str
        Who: ``likelihood``, ``network``, ``relation`` or ``paper``.
    parameters : tuple of Parameter
        The parameters it speaks of, evaluable or with the reason why not.
    equations : tuple of Equation
        The equations it evaluated; empty for the likelihood.
    covariance : ndarray, shape (m, m), or None
        Covariance of the m evaluable `parameters`' changes, in their order; None where a diagnostician knows only
        single standard errors.
    unbalance : UnbalanceVector or None
        Of e, where it is evaluable and there is a phase reference: size and direction.
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
    parameters: tuple[Parameter, ...] = ()
    equations: tuple[Equation, ...] = ()
    covariance: FloatArray | None = None
    unbalance: UnbalanceVector | None = None
    common: FloatArray | None = None
    misfit_z: float | None = None
    suspect: str = ""
    unexplained: str = ""
    steps: int = 0

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
