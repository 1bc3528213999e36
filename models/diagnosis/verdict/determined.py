"""What a window determines: readings that say nothing are taken out, with the reason."""

from dataclasses import replace

import numpy as np

from models.diagnosis.readings import Diagnosis, ParameterReading
from models.diagnosis.window import WindowStatistics
from models.physics.parameters import PARAMETERS

__all__ = ["determined"]

_VAGUE = 0.2
"""A larger standard error of a full window is no longer one: the reading says nothing."""

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
    return replace(diagnosis, parameters=stated, covariance=diagnosis.full_covariance[np.ix_(kept, kept)])


def _stated(
    name: str, by: str, reading: ParameterReading | None, states: tuple[str, ...], vague: float
) -> ParameterReading:
    """The reading of one parameter, or why these sensors do not determine it."""
    plane = _PLANES.get(name)
    if reading is None:
        return ParameterReading(name, by, reason="no phase reference")
    if plane is not None and not any(state.startswith(plane) for state in states):
        return ParameterReading(name, by, reason=f"no displacement or velocity measured in {plane}")
    if reading.change is None or reading.standard_error is None:
        return reading
    if not reading.standard_error < vague:
        return ParameterReading(
            name,
            by,
            reason=f"not determined in this window (standard error {reading.standard_error:.0%})",
        )
    return reading
