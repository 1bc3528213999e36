"""What a window determines: readings that say nothing are taken out, with the reason."""

from dataclasses import replace

import numpy as np

from models.diagnosis.limits import beyond
from models.diagnosis.readings import Diagnosis, ParameterReading
from models.diagnosis.verdict.stretch import slope, to_scale
from models.diagnosis.window import WindowStatistics
from models.physics.parameters import PARAMETERS
from models.signals.block import FloatArray

__all__ = ["determined", "with_shared_error"]

_VAGUE = 0.2
"""A larger standard error of a full window is no longer one: the reading says nothing."""

_NO_PHASE = "no phase reference"
_NO_ROTOR = "cannot be told without the rotor's own parameters"

_PLANES = {"k_by": "y", "c_by": "y", "k_bz": "z", "c_bz": "z"}
"""Plane in which a bearing parameter acts."""


def determined(diagnosis: Diagnosis, window: WindowStatistics, length_s: float) -> Diagnosis:
    """Return the diagnosis with every parameter in the order of `PARAMETERS`, read or with the reason why not.

    Parameters
    ----------
    diagnosis : Diagnosis
    window : WindowStatistics
        What it was made of. A stretch of a tenth of the window has three times its errors, and says as much as that.
    length_s : float
        Of a full window.
    """
    vague = _VAGUE * max(1.0, length_s / window.duration_s) ** 0.5
    found = {reading.name: reading for reading in diagnosis.parameters}
    stated = tuple(_stated(name, diagnosis.by, found.get(name), window.states, vague) for name in PARAMETERS)
    before = [reading.name for reading in diagnosis.evaluable]
    kept = [before.index(reading.name) for reading in stated if reading.change is not None]
    part = np.ix_(kept, kept)
    shared = None if diagnosis.common is None else diagnosis.common[part]
    return replace(diagnosis, parameters=stated, covariance=diagnosis.full_covariance[part], common=shared)


def with_shared_error(diagnosis: Diagnosis, covariance: FloatArray) -> Diagnosis:
    """Return the diagnosis with an error added that all windows share.

    Parameters
    ----------
    diagnosis : Diagnosis
    covariance : ndarray, shape (6, 6)
        Of the values that changes are relative to, in the scale of the errors, in the order of `PARAMETERS`.
    """
    readings = diagnosis.evaluable
    at = [PARAMETERS.index(reading.name) for reading in readings]
    slopes = np.array([slope(r.name, to_scale(r.name, r.change or 0.0)) for r in readings])
    shared = covariance[np.ix_(at, at)] * np.outer(slopes, slopes)
    total = diagnosis.full_covariance + shared
    errors = dict(zip((reading.name for reading in readings), np.sqrt(np.diag(total)).tolist(), strict=True))
    parameters = tuple(
        _wider(reading, errors[reading.name]) if reading.name in errors else reading for reading in diagnosis.parameters
    )
    return replace(diagnosis, parameters=parameters, covariance=total, common=shared)


def _wider(reading: ParameterReading, error: float) -> ParameterReading:
    added = error**2 - (reading.standard_error or 0.0) ** 2
    vector = None if reading.vector is None else reading.vector.widened(added)
    return replace(reading, standard_error=error, vector=vector)


def _stated(
    name: str, by: str, reading: ParameterReading | None, states: tuple[str, ...], vague: float
) -> ParameterReading:
    """The reading of one parameter, or why these sensors do not determine it."""
    plane = _PLANES.get(name)
    if reading is None:
        return ParameterReading(name, by, reason=_NO_PHASE if name == "e" else _NO_ROTOR)
    if plane is not None and not any(state.startswith(plane) for state in states):
        return ParameterReading(name, by, reason=f"no displacement or velocity measured in {plane}")
    if reading.change is None or reading.standard_error is None:
        return reading
    if not reading.standard_error < vague:
        error, limit = beyond(100 * reading.standard_error, 100 * vague)
        return ParameterReading(
            name, by, reason=f"not determined in this window (standard error {error} %, at most {limit} % is a reading)"
        )
    return ParameterReading.of(name, by, reading.change, reading.standard_error, reading.vector)
