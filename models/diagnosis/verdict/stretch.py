"""A stretch of data and what it says about the parameters, in the form in which stretches add up.

Changes are held in the scale in which their errors are normal and do not depend on the change: the logarithm of the
ratio to nominal for stiffness and damping, the relative change itself for the eccentricity, which enters linearly. They
are held as information: matrix J (the inverse covariance) and vector J x. Independent stretches add both.

An error that all stretches share, such as that of a commissioning, does not shrink when they are added. It is carried
beside the information and added when a stretch is judged (`Stretch.complete`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from models.diagnosis.readings import (
    Diagnosis,
    UnbalanceVector,
    no_reading,
    not_determined,
    parameter_reading,
    possible_reading,
)
from models.diagnosis.window.statistics import WindowStatistics
from models.physics.rotor import PARAMETERS
from models.signals.block import FloatArray
from rotorwatch.records.windows import Parameter

_LINEAR_PARAMETERS = frozenset({"e"})
_MOST_LOSS = -0.95  # a parameter that reads as lost altogether has no logarithm
# Least share of the total variance that is a window's own: its covariance and the shared one are both estimates.
_LEAST_OWN = 1e-4


def to_scale(name: str, change: float) -> float:
    """Relative change in the scale of its errors: ln(1 + change), or the change itself for e."""
    return change if name in _LINEAR_PARAMETERS else math.log1p(max(change, _MOST_LOSS))


def from_scale(name: str, value: float) -> float:
    """Relative change from a value in the scale of its errors."""
    return value if name in _LINEAR_PARAMETERS else math.expm1(value)


def slope(name: str, value: float) -> float:
    """Standard error of the relative change over that in the scale of the errors."""
    return 1.0 if name in _LINEAR_PARAMETERS else math.exp(value)


@dataclass(frozen=True, eq=False)  # without slots, as properties are cached
class Stretch:
    """What a stretch of data says about the parameters."""

    # Oldest and newest data.
    start_ns: int
    end_ns: int
    vector: FloatArray  # (6,), J x, in the order of `PARAMETERS`; 0 for a parameter that was not evaluable
    information: FloatArray  # (6, 6), J; zero row and column for a parameter that was not evaluable
    misfit_z: float | None = None  # over-identification, standard normal where the model holds
    # (6, 6): covariance shared with every other stretch, not contained in `information`
    common: FloatArray | None = None
    # Why nothing of it should be believed, see `Diagnosis`; only for one window at most, not for sums.
    unexplained: str = ""
    unbalance: UnbalanceVector | None = None  # unbalance with its direction; only for one window at most, too

    @cached_property
    def known(self) -> tuple[int, ...]:
        """Indices into `PARAMETERS` of the evaluable parameters."""
        return tuple(int(i) for i in np.flatnonzero(self.information.diagonal() > 0))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the evaluable parameters."""
        return tuple(PARAMETERS[i] for i in self.known)

    @property
    def duration_s(self) -> float:
        """From the oldest to the newest data, s."""
        return (self.end_ns - self.start_ns) / 1e9

    @cached_property
    def estimate(self) -> tuple[FloatArray, FloatArray]:
        """Values of `names` in the scale of their errors, shape (m,), and their covariance, shape (m, m)."""
        known = list(self.known)
        covariance = np.linalg.inv(self.information[np.ix_(known, known)])
        covariance = (covariance + covariance.T) / 2
        return np.asarray(covariance @ self.vector[known], dtype=np.float64), covariance

    def blurred(self, standard_error: float) -> "Stretch":
        """Return the stretch with an error added to every parameter, in its scale, that more data do not remove."""
        return self._widened(standard_error**2 * np.eye(len(self.known)), self.common)

    def complete(self) -> "Stretch":
        """Return the stretch with the shared error in its information, as needed to judge this stretch alone."""
        if self.common is None:
            return self
        known = list(self.known)
        return self._widened(self.common[np.ix_(known, known)], None)

    def believed(self) -> "Stretch":
        """Return the stretch without its reading of e, if its 1x vectors are not those of an unbalance.

        Two conditions of a machine are still told apart with that reading: a window of both has the vectors of neither.
        """
        if self.unbalance is None or not self.unbalance.foreign:
            return self
        at = [number for number, i in enumerate(self.known) if PARAMETERS[i] != "e"]
        values, covariance = self.estimate
        vector, information = _information(
            [self.known[number] for number in at], values[at], covariance[np.ix_(at, at)]
        )
        return replace(self, vector=vector, information=information, unbalance=None)

    def _widened(self, added_covariance: FloatArray, common: FloatArray | None) -> "Stretch":
        values, covariance = self.estimate
        vector, information = _information(list(self.known), values, covariance + added_covariance)
        return replace(self, vector=vector, information=information, common=common)


def stretch_of(diagnosis: Diagnosis, start_ns: int, end_ns: int) -> Stretch:
    """Put a diagnosis into the form in which stretches add up."""
    readings = diagnosis.evaluable
    known = [PARAMETERS.index(reading.name) for reading in readings]
    unbalance = diagnosis.unbalance if any(reading.name == "e" for reading in readings) else None
    values, slopes = _scaled(readings)
    scale = np.outer(slopes, slopes)
    own, common = diagnosis.full_covariance / scale, None
    if diagnosis.common is not None:
        shared = diagnosis.common / scale
        own = _at_least(own - shared, own)
        common = np.zeros((len(PARAMETERS), len(PARAMETERS)))
        common[np.ix_(known, known)] = shared
    vector, information = _information(known, values, own)
    return Stretch(start_ns, end_ns, vector, information, diagnosis.misfit_z, common, diagnosis.unexplained, unbalance)


def _scaled(readings: Sequence[Parameter]) -> tuple[FloatArray, FloatArray]:
    """Values of readings in the scale of their errors, and their `slope` there."""
    values = [to_scale(reading.name, reading.relative_change or 0.0) for reading in readings]
    slopes = [slope(reading.name, value) for reading, value in zip(readings, values, strict=True)]
    return np.array(values, dtype=np.float64), np.array(slopes, dtype=np.float64)


def _at_least(own: FloatArray, total: FloatArray) -> FloatArray:
    """A window's own covariance, never less than a little of the total in any direction."""
    scale = 1 / np.sqrt(np.diag(total))
    values, vectors = np.linalg.eigh(own * np.outer(scale, scale))
    return np.asarray((vectors * np.maximum(values, _LEAST_OWN)) @ vectors.T / np.outer(scale, scale), dtype=np.float64)


def _information(known: list[int], values: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`Stretch.vector` and `Stretch.information` from the values of some parameters and their covariance."""
    n = len(PARAMETERS)
    information, vector = np.zeros((n, n)), np.zeros(n)
    if known:
        own = np.linalg.inv(covariance)
        own = (own + own.T) / 2
        information[np.ix_(known, known)] = own
        vector[known] = own @ values
    return vector, information


def added(stretches: Sequence[Stretch]) -> Stretch:
    """Sum of stretches that do not overlap: inverse-variance mean; misfits add as independent normal values."""
    misfits = [one.misfit_z for one in stretches if one.misfit_z is not None]
    shared = [one.common for one in stretches if one.common is not None]
    return Stretch(
        min(one.start_ns for one in stretches),
        max(one.end_ns for one in stretches),
        np.sum([one.vector for one in stretches], axis=0),
        np.sum([one.information for one in stretches], axis=0),
        sum(misfits) / math.sqrt(len(misfits)) if misfits else None,
        np.mean(shared, axis=0) if shared else None,
    )


_VAGUE = 0.2  # largest standard error in a full window with which a reading says anything
_CERTAIN = 5.0  # standard errors by which a larger unbalance must be certain to be read with an error in its proportion
_NO_PHASE = "no phase reference"
_NO_ROTATION = f"{_NO_PHASE}, and no rotation found in the vibration: measure the shaft angle to have it judged"
_NO_ROTOR = "cannot be told without the rotor's own parameters"
_PLANES = {"k_by": "y", "c_by": "y", "k_bz": "z", "c_bz": "z"}  # plane in which a bearing parameter acts


def determined(diagnosis: Diagnosis, window: WindowStatistics, length_s: float) -> Diagnosis:
    """Return the diagnosis with every parameter in the order of `PARAMETERS`, read or with the reason why not.

    The limit on standard errors grows in short stretches as they do: in a tenth of the window they are three times as
    large.
    """
    vague = _VAGUE * max(1.0, length_s / window.duration_s) ** 0.5
    found = {reading.name: reading for reading in diagnosis.parameters}
    stated = tuple(_stated(name, diagnosis, found.get(name), window, vague) for name in PARAMETERS)
    before = [reading.name for reading in diagnosis.evaluable]
    kept = [before.index(reading.name) for reading in stated if reading.relative_change is not None]
    part = np.ix_(kept, kept)
    shared = None if diagnosis.common is None else diagnosis.common[part]
    return replace(diagnosis, parameters=stated, covariance=diagnosis.full_covariance[part], common=shared)


def with_shared_error(diagnosis: Diagnosis, covariance: FloatArray) -> Diagnosis:
    """Return the diagnosis with an error added that all windows share.

    `covariance`, shape (6, 6), is that of the values to which changes are relative, in the scale of the errors and in
    the order of `PARAMETERS`.
    """
    readings = diagnosis.evaluable
    at = [PARAMETERS.index(reading.name) for reading in readings]
    slopes = _scaled(readings)[1]
    shared = covariance[np.ix_(at, at)] * np.outer(slopes, slopes)
    total = diagnosis.full_covariance + shared
    unbalance, parameters, errors = diagnosis.unbalance, [], iter(np.sqrt(np.diag(total)).tolist())
    for one in diagnosis.parameters:
        if one.relative_change is None:
            parameters.append(one)
            continue
        error, vector = next(errors), None
        if one.name == "e" and unbalance is not None:
            vector = unbalance = unbalance.widened(error**2 - (one.standard_error or 0.0) ** 2)
        parameters.append(parameter_reading(one.name, one.by, one.relative_change, error, vector))
    common = shared if diagnosis.common is None else diagnosis.common + shared
    return replace(diagnosis, covariance=total, common=common, unbalance=unbalance, parameters=tuple(parameters))


def apart(one: Diagnosis, other: Diagnosis) -> FloatArray:
    """By how much two diagnoses differ in the scale of their errors, (6,); nan unless both have a reading."""
    changes = {each.name: each.relative_change or 0.0 for each in other.evaluable}
    differences = np.full(len(PARAMETERS), np.nan)
    for each in one.evaluable:
        if each.name in changes:
            there, here = to_scale(each.name, changes[each.name]), to_scale(each.name, each.relative_change or 0.0)
            differences[PARAMETERS.index(each.name)] = there - here
    return differences


def _stated(
    name: str, diagnosis: Diagnosis, reading: Parameter | None, window: WindowStatistics, vague: float
) -> Parameter:
    """The reading of one parameter, or why these sensors do not determine it."""
    by, plane = diagnosis.by, _PLANES.get(name)
    if reading is None:
        # Where the rotation is found, its size is judged by its level at least.
        no_e = _NO_PHASE if window.speed_source == "estimated" else _NO_ROTATION
        return no_reading(name, by, no_e if name == "e" else _NO_ROTOR)
    if plane is not None and not any(state.startswith(plane) for state in window.states):
        return no_reading(name, by, f"no displacement or velocity measured in {plane}")
    if reading.relative_change is None:
        return reading
    error = math.nan if reading.standard_error is None else reading.standard_error
    if name == "e":  # of an unbalance many times the nominal one, the error is as many times larger
        vague *= max(1.0, 1 + reading.relative_change - _CERTAIN * error)
    if not error < vague:
        return no_reading(name, by, not_determined(error, vague))
    vector = diagnosis.unbalance if name == "e" else None
    return possible_reading(name, by, reading.relative_change, error, vector)
