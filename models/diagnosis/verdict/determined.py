"""What a window determines: readings that say nothing are taken out, with the reason."""

import math
from dataclasses import replace

import numpy as np

from models.diagnosis.limits import beyond
from models.diagnosis.readings import Diagnosis, no_reading, parameter_reading, possible_reading
from models.diagnosis.unbalance_vector import UnbalanceVector
from models.diagnosis.verdict.stretch import slope, to_scale
from models.diagnosis.window import WindowStatistics
from models.physics.parameters import PARAMETERS
from models.signals.block import FloatArray
from rotorwatch.records.windows import Parameter

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
    window : WindowStatistics
        What it was made of. A stretch of a tenth of the window has three times its errors, and says as much as that.
    length_s : float
        Of a full window.
    """
    vague = _VAGUE * max(1.0, length_s / window.duration_s) ** 0.5
    found = {reading.name: reading for reading in diagnosis.parameters}
    stated = tuple(_stated(name, diagnosis, found.get(name), window.states, vague) for name in PARAMETERS)
    before = [reading.name for reading in diagnosis.evaluable]
    kept = [before.index(reading.name) for reading in stated if reading.relative_change is not None]
    part = np.ix_(kept, kept)
    shared = None if diagnosis.common is None else diagnosis.common[part]
    return replace(diagnosis, parameters=stated, covariance=diagnosis.full_covariance[part], common=shared)


def with_shared_error(diagnosis: Diagnosis, covariance: FloatArray) -> Diagnosis:
    """Return the diagnosis with an error added that all windows share.

    Parameters
    ----------
    covariance : ndarray, shape (6, 6)
        Of the values that changes are relative to, in the scale of the errors, in the order of `PARAMETERS`.
    """
    readings = diagnosis.evaluable
    at = [PARAMETERS.index(reading.name) for reading in readings]
    slopes = np.array([slope(r.name, to_scale(r.name, r.relative_change or 0.0)) for r in readings])
    shared = covariance[np.ix_(at, at)] * np.outer(slopes, slopes)
    total = diagnosis.full_covariance + shared
    errors = dict(zip((reading.name for reading in readings), np.sqrt(np.diag(total)).tolist(), strict=True))
    own = {reading.name: reading.standard_error or 0.0 for reading in readings}
    unbalance = diagnosis.unbalance
    if unbalance is not None and "e" in own:
        unbalance = unbalance.widened(errors["e"] ** 2 - own["e"] ** 2)
    wider = replace(diagnosis, covariance=total, common=shared, unbalance=unbalance)
    parameters = tuple(
        parameter_reading(one.name, one.by, one.relative_change, errors[one.name], _vector(wider, one.name))
        if one.relative_change is not None
        else one
        for one in diagnosis.parameters
    )
    return replace(wider, parameters=parameters)


def _vector(diagnosis: Diagnosis, name: str) -> UnbalanceVector | None:
    return diagnosis.unbalance if name == "e" else None


def _stated(
    name: str, diagnosis: Diagnosis, reading: Parameter | None, states: tuple[str, ...], vague: float
) -> Parameter:
    """The reading of one parameter, or why these sensors do not determine it."""
    by, plane = diagnosis.by, _PLANES.get(name)
    if reading is None:
        return no_reading(name, by, _NO_PHASE if name == "e" else _NO_ROTOR)
    if plane is not None and not any(state.startswith(plane) for state in states):
        return no_reading(name, by, f"no displacement or velocity measured in {plane}")
    if reading.relative_change is None:
        return reading
    error = math.nan if reading.standard_error is None else reading.standard_error
    if not error < vague:
        text, limit = beyond(100 * error, 100 * vague)
        return no_reading(
            name, by, f"not determined in this window (standard error {text} %, at most {limit} % is a reading)"
        )
    return possible_reading(name, by, reading.relative_change, error, _vector(diagnosis, name))
