"""The commissioning report on one page: HTML with its pictures inside, and the same figures as JSON."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path

import numpy as np
from jinja2 import Environment, StrictUndefined

from models.commissioning.commissioned import Commissioned
from models.commissioning.healthy import HealthyRecording
from models.commissioning.knowledge import KnowledgeLevel
from models.commissioning.report import CommissioningReport
from models.errors import RecordingError
from models.machine import MachineFile
from simulator.commission.pictures import pictures_of
from simulator.commission.recording_plots import Portrait, ordered, portrait
from simulator.commission.units import (
    channel_text,
    channel_unit,
    duration,
    listed,
    parameter_value,
    percent,
    significant,
)
from simulator.commission.verdict import budget_sentences, dominant, headline, next_steps, smallest_change

__all__ = ["HTML", "JSON", "write_report"]

HTML, JSON = "report.html", "report.json"
_TEMPLATE = "report.html.jinja"
_RPM = 30 / np.pi
_KNOWN = (
    "The rotor is known, so every parameter is read by comparing the measured spectra as a whole with theory. The "
    "equations below are evaluated beside that, each by its own networks where these have been trained: whether both "
    "agree is part of every report. A parameter can thus be readable although its equation is not evaluated."
)
_EQUATIONS = {
    KnowledgeLevel.FULL: _KNOWN,
    KnowledgeLevel.PARTIAL: _KNOWN,
    KnowledgeLevel.NONE: "Nothing of the rotor is known, so parameters are read through sums of the equations of "
    "motion that hold only measured quantities. Their coefficients are learned from the recordings.",
}


@dataclass(frozen=True, slots=True)
class _Row:
    """One line of the table of recordings, in words."""

    name: str
    start: str
    used: str
    gaps: str
    refused: str
    speed: str


def write_report(
    directory: Path,
    report: CommissioningReport,
    recordings: Sequence[HealthyRecording],
    *,
    machine: MachineFile | None = None,
    commissioned: Commissioned | None = None,
) -> Path:
    """Write ``report.html`` and ``report.json``.

    Parameters
    ----------
    directory : Path
        Made if it is not there.
    recordings : sequence of HealthyRecording
        What it was made from: for the pictures and the table of recordings.
    machine : MachineFile, optional
        For its description.
    commissioned : Commissioned, optional
        What was stored: for what it replaces and why, and the hash of each file.

    Returns
    -------
    Path
        The page. The same arguments give the same page, to the last byte.

    Raises
    ------
    RecordingError
        If they cannot be written.
    """
    text = _render(report, recordings, "" if machine is None else machine.description, commissioned)
    page = directory / HTML
    try:
        directory.mkdir(parents=True, exist_ok=True)
        page.write_text(text, encoding="utf-8")
        (directory / JSON).write_text(report.model_dump_json(indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"{directory}: the report cannot be written ({error.strerror})") from error
    return page


def _render(
    report: CommissioningReport,
    recordings: Sequence[HealthyRecording],
    description: str,
    commissioned: Commissioned | None,
) -> str:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"percent": percent, "duration": duration, "channel": channel_text, "listed": listed}
    template = resources.files("simulator.commission").joinpath(_TEMPLATE).read_text(encoding="utf-8")
    portraits = [portrait(number, one) for number, one in enumerate(recordings, start=1)]
    hashes = {} if commissioned is None else {one.name: one.sha256 for one in commissioned.recordings}
    return environment.from_string(template).render(
        report=report,
        description=description,
        commissioned=commissioned,
        headline=headline(report),
        steps=next_steps(report),
        budget=budget_sentences(report),
        identified=any(one.identified is not None for one in report.parameters),
        wished=sorted({one.wished for one in report.parameters if one.wished is not None}),
        dominant=dominant,
        smallest_change=smallest_change,
        parameter_value=parameter_value,
        equations_text=_EQUATIONS[report.level],
        symbols=_symbols(report),
        pictures=pictures_of(report, [one.name for one in recordings], [one for one in portraits if one is not None]),
        speed_range=_speed_range(report),
        levels=_levels(report),
        recordings=[_row(*pair) for pair in zip(recordings, portraits, strict=True)],
        hashes=hashes,
    )


def _symbols(report: CommissioningReport) -> tuple[tuple[str, str], ...]:
    """Quantities that the table of equations calls by their symbols, in words."""
    words = {word.strip(",;") for one in report.equations for word in one.reason.split()}
    return tuple((word, channel_text(word)) for word in sorted(words) if channel_text(word) != word)


def _speed_range(report: CommissioningReport) -> str:
    if report.conditions is None or report.conditions.speed_rpm is None:
        return ""
    low, high = (f"{edge:.0f}" for edge in report.conditions.speed_rpm)
    return f"{low if low == high else f'{low} to {high}'} rpm"


def _levels(report: CommissioningReport) -> tuple[tuple[str, str], ...]:
    """Smallest and largest rms of each channel."""
    if report.conditions is None:
        return ()
    found = []
    for state in ordered(report.conditions.rms):
        edges = report.conditions.rms[state]
        unit, scale = channel_unit(state)
        low, high = (significant(scale * edge, 3) for edge in edges)
        found.append((channel_text(state), f"{low if low == high else f'{low} to {high}'} {unit}"))
    return tuple(found)


def _row(recording: HealthyRecording, seen: Portrait | None) -> _Row:
    gaps = f"{recording.gaps}, {duration(recording.missing_s)} missing" if recording.gaps else "none"
    refused = ", ".join(f"{count} {reason}" for reason, count in recording.refused) or "none"
    start = speed = "–"
    if seen is not None:
        seconds = seen.statistics.start_ns // 10**9
        start = f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S}"
        speed = "not known"
        if np.isfinite(seen.speed_hz):
            speed = f"{seen.statistics.speed_rad_s * _RPM:.0f} rpm"
            speed += ", estimated" if seen.statistics.speed_source == "estimated" else ""
    return _Row(recording.name, start, duration(recording.duration_s), gaps, refused, speed)
