"""What a commissioning tells people: fit or not and why, what can be read, how sharply, and what would sharpen it."""

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.special import ndtri

from models.commissioning.checks import Check
from models.commissioning.conditions import OperatingRange
from models.commissioning.knowledge import KnowledgeLevel
from models.diagnosis.readings import Diagnosis
from models.diagnosis.verdict.sequential import SequentialSettings
from models.diagnosis.verdict.stretch import from_scale, slope, to_scale
from models.machine import MachineFile
from models.physics.parameters import PARAMETER_TEXT, PARAMETERS

__all__ = ["CommissioningReport", "EquationRow", "HealthyReading", "ParameterSummary", "parameter_summaries"]

_JSON = ConfigDict(extra="forbid", frozen=True)
_POWER = 0.95


class EquationRow(BaseModel):
    """One row of the equation table, and whether these sensors allow it."""

    model_config = _JSON

    number: str
    title: str
    parameters: tuple[str, ...]
    used: bool
    reason: str = Field(default="", description="why it is not used")


class HealthyReading(BaseModel):
    """One parameter in one healthy window, read against what was learned on other data where there is enough of it."""

    model_config = _JSON

    recording: str
    end_ns: int
    relative_change: float
    standard_error: float


class ParameterSummary(BaseModel):
    """What is known of one parameter."""

    model_config = _JSON

    name: str
    text: str
    evaluable: bool
    reason: str = ""
    identified: float | None = Field(default=None, description="identified value, SI; level partial")
    healthy_spread: float | None = Field(default=None, description="standard deviation of healthy windows' readings")
    window_error: float | None = Field(default=None, description="standard error that a window has of its own")
    commissioning_error: float | None = Field(
        default=None, description="standard error that all windows share because the healthy data were finite"
    )
    detectable_loss: float | None = Field(default=None, description="found by one window with 95 % probability")
    detectable_gain: float | None = None
    wished: float | None = Field(default=None, description="change that is wished to be found, either sign")
    window_s_for_wished: float | None = Field(default=None, description="window that this takes")
    healthy_s_for_wished: float | None = Field(default=None, description="healthy data that this takes besides")
    readings: tuple[HealthyReading, ...] = ()


class CommissioningReport(BaseModel):
    """The whole report."""

    model_config = _JSON

    site: str
    machine: str
    level: KnowledgeLevel
    level_text: str
    verdict: Literal["commissioned", "limited", "refused"]
    summary: str
    version: int
    identity: str | None = None
    healthy_s: float
    window_s: float
    false_alarms_per_month: float
    checks: tuple[Check, ...]
    equations: tuple[EquationRow, ...]
    parameters: tuple[ParameterSummary, ...]
    conditions: OperatingRange | None = None
    notes: tuple[str, ...] = ()


def parameter_summaries(
    machine: MachineFile,
    diagnoses: Sequence[tuple[str, int, Diagnosis]],
    compared: Sequence[tuple[str, int, Diagnosis]],
    healthy_s: float,
    window_s: float,
    *,
    wished: float,
    short: bool,
    identified: Mapping[str, float],
) -> tuple[ParameterSummary, ...]:
    """Sum up what healthy windows say of each parameter.

    Parameters
    ----------
    diagnoses : sequence of (recording, end_ns, Diagnosis)
        Healthy windows read as later ones will be, with the shared error in each.
    compared : sequence of (recording, end_ns, Diagnosis)
        The same windows read against what was learned without them.
    healthy_s, window_s : float
        Data learned from; length of each window in `diagnoses`.
    wished : float
        Relative change that is wished to be found.
    short : bool
        Whether stretches shorter than a window are looked at, too: they share the declared rate.
    identified : mapping of str to float
        Identified values, SI.
    """
    settings = SequentialSettings.for_machine(machine, short=short)
    threshold = settings.thresholds(settings.window_hops).first + float(ndtri(_POWER))
    found = []
    for name in PARAMETERS:
        errors = [_errors(name, diagnosis) for _, _, diagnosis in diagnoses]
        known = [each for each in errors if each is not None]
        if not known:
            reasons = dict.fromkeys(
                reading.reason
                for _, _, diagnosis in diagnoses
                for reading in diagnosis.parameters
                if reading.name == name and reading.reason
            )
            reason = "; ".join(reasons) or "cannot be told without the rotor's own parameters"
            found.append(ParameterSummary(name=name, text=PARAMETER_TEXT[name], evaluable=False, reason=reason))
            continue
        own, shared = (float(np.median(part)) for part in zip(*known, strict=True))
        own *= math.sqrt(window_s / machine.window.length_s)
        readings = _readings(name, compared)
        found.append(
            ParameterSummary(
                name=name,
                text=PARAMETER_TEXT[name],
                evaluable=True,
                identified=identified.get(name),
                healthy_spread=float(np.std([r.relative_change for r in readings], ddof=1))
                if len(readings) > 1
                else None,
                window_error=own,
                commissioning_error=shared,
                detectable_loss=max(-1.0, from_scale(name, -threshold * math.hypot(own, shared))),
                detectable_gain=from_scale(name, threshold * math.hypot(own, shared)),
                wished=wished,
                readings=readings,
                **_needed(name, wished, threshold, own, shared, healthy_s, machine.window.length_s),
            )
        )
    return tuple(found)


def _needed(
    name: str, wished: float, threshold: float, own: float, shared: float, healthy_s: float, window_s: float
) -> dict[str, float]:
    """Healthy data and window length for a wished change: both errors fall as one over the root of the length."""
    allowed = abs(to_scale(name, wished)) / threshold
    # At most half of what is allowed to the window: a commissioning that leaves nothing to chance takes for ever.
    window = window_s * max(1.0, 2 * (own / allowed) ** 2)
    left = allowed**2 - own**2 * window_s / window
    return {"healthy_s_for_wished": healthy_s * shared**2 / left, "window_s_for_wished": window}


def _errors(name: str, diagnosis: Diagnosis) -> tuple[float, float] | None:
    """A window's own and its shared standard error of a parameter, in the scale of the errors."""
    names = [reading.name for reading in diagnosis.evaluable]
    if name not in names:
        return None
    at = names.index(name)
    factor = slope(name, to_scale(name, diagnosis.evaluable[at].relative_change or 0.0))
    total = float(diagnosis.full_covariance[at, at])
    shared = 0.0 if diagnosis.common is None else float(diagnosis.common[at, at])
    return math.sqrt(max(0.0, total - shared)) / factor, math.sqrt(shared) / factor


def _spread(readings: Sequence[HealthyReading]) -> float | None:
    return float(np.std([one.relative_change for one in readings], ddof=1)) if len(readings) > 1 else None


def _readings(name: str, compared: Sequence[tuple[str, int, Diagnosis]]) -> tuple[HealthyReading, ...]:
    return tuple(
        HealthyReading(
            recording=recording,
            end_ns=end_ns,
            relative_change=reading.relative_change,
            standard_error=reading.standard_error,
        )
        for recording, end_ns, diagnosis in compared
        for reading in diagnosis.evaluable
        if reading.name == name and reading.relative_change is not None and reading.standard_error is not None
    )
