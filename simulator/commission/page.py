"""The commissioning report on one page: HTML with its pictures inside, and the same figures as JSON."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from models.commissioning.commission import CommissioningReport
from models.commissioning.commissioned import Commissioned, KnowledgeLevel
from models.commissioning.healthy import HealthyRecording
from models.errors import RecordingError
from models.levels.limits import MEASURE_WORDS
from models.machine import MachineFile
from models.signals.channels import unit_in_text
from simulator.commission import verdict
from simulator.commission.plots import (
    Portrait,
    draw_budget,
    draw_levels,
    draw_readings,
    draw_spectra,
    inline_svg,
    ordered,
    portrait,
)

_COMPARED = {
    KnowledgeLevel.FULL: "Each healthy window against the parameters in the machine file.",
    KnowledgeLevel.PARTIAL: "Each healthy window against the rotor that was identified from all of them. They scatter "
    "about zero by construction; what matters is that none is far from the others.",
    KnowledgeLevel.NONE: "Each healthy window against what was learned from the other halves of the recordings, so "
    "that no window is compared with itself. With half of the data the intervals are wider than the monitor's will be.",
}


def pictures_of(
    report: CommissioningReport, names: Sequence[str], portraits: Sequence[Portrait]
) -> tuple[tuple[str, Markup, str], ...]:
    """Draw the pictures for which there are data, each with its title before it and its caption after it.

    Names are those of all recordings, portraits of those with usable data.
    """
    drawn: list[tuple[str, str, Callable[[], Figure | None], str]] = [
        (
            "readings",
            "Healthy readings",
            lambda: draw_readings(report, names),
            f"{_COMPARED[report.level]} Bars are 95% intervals: about one in twenty misses zero by chance, and "
            "neighbours that miss it on the same side share an error.",
        ),
        (
            "budget",
            "What limits each reading",
            lambda: draw_budget(report),
            "Errors add as squares: one that is more than twice the other is nearly all of the sum. Where the upright "
            "mark lies left of the dashed one, the wished change is found by one window with 95% probability.",
        ),
    ]
    if portraits and portraits[0].statistics.states:  # channels at other places have levels alone
        drawn += [
            ("spectra", "Spectra of the recordings", lambda: draw_spectra(portraits), _spectra_caption(portraits)),
            ("levels", "Speed and level over time", lambda: draw_levels(portraits), _levels_caption(portraits)),
        ]
    pictures = ((title, inline_svg(name, title, paint), caption) for name, title, paint, caption in drawn)
    return tuple((title, svg, caption) for title, svg, caption in pictures if svg is not None)


def _spectra_caption(portraits: Sequence[Portrait]) -> str:
    band = portraits[0].statistics.frequencies_hz
    text = f"Shaded: the band that is used, {band[0]:g} to {band[-1]:g} Hz. "
    speeds = [one.speed_hz for one in portraits if np.isfinite(one.speed_hz)]
    if speeds:
        text += f"Grey: the rotation at {_between(f'{min(speeds):.1f}', f'{max(speeds):.1f}')} Hz and its double"
        if any(one.statistics.speed_source == "estimated" for one in portraits):
            text += " (there is no phase reference: the speed is estimated from the vibration)"
        text += ". The rotation is taken out before anything is learned."
    else:
        text += "The speed is not known, so the rotation is neither marked nor taken out."
    if any(one.lines for one in portraits):
        text += " A frequency in orange is a steady line that does not belong to the rotation, "
        text += "at the channel where it is strongest."
    return text


def _levels_caption(portraits: Sequence[Portrait]) -> str:
    hop_s = portraits[0].statistics.duration_s / portraits[0].levels.shape[0]
    what = "the level is that of the random vibration without the rotation, over the median of all recordings"
    text = f"A point every {hop_s:g} s; {what}."
    if any(one.broken.any() for one in portraits):
        text += " A line is broken where data are missing."
    if len(portraits) > 1:
        text += " The number at the top is that of the recording."
    return text


HTML, JSON = "report.html", "report.json"
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


def write_report(
    directory: Path,
    report: CommissioningReport,
    recordings: Sequence[HealthyRecording],
    *,
    machine: MachineFile | None = None,
    commissioned: Commissioned | None = None,
) -> Path:
    """Write ``report.html``, whose path is returned, and ``report.json``.

    `commissioned`, if it was stored, tells what it replaces and why, and the hash of each recording. The same arguments
    give the same page, to the last byte. Raises `RecordingError` if they cannot be written.
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
    environment.filters |= {"percent": verdict.percent, "duration": verdict.duration}
    template = resources.files("simulator.commission").joinpath("report.html.jinja").read_text(encoding="utf-8")
    portraits = [portrait(number, one) for number, one in enumerate(recordings, start=1)]
    turned = None if report.conditions is None else report.conditions.speed_rpm
    words = {word.strip(",;") for one in report.equations for word in one.reason.split()}  # some of them are symbols
    return environment.from_string(template).render(
        report=report,
        description=description,
        commissioned=commissioned,
        verdict=verdict,
        identified=any(one.identified is not None for one in report.parameters),
        wished=sorted({one.wished for one in report.parameters if one.wished is not None}),
        equations_text=_EQUATIONS[report.level],
        symbols=[(word, text) for word in sorted(words) if (text := verdict.channel_text(word)) != word],
        pictures=pictures_of(report, [one.name for one in recordings], [one for one in portraits if one is not None]),
        speed_range="" if turned is None else _speeds(turned),
        levels=_levels(report),
        growths=_growths(report),
        recordings=[_row(*pair) for pair in zip(recordings, portraits, strict=True)],
        hashes={} if commissioned is None else {one.name: one.sha256 for one in commissioned.recordings},
    )


def _between(low: str, high: str) -> str:
    return low if low == high else f"{low} to {high}"


def _speeds(rpm: tuple[float, float]) -> str:
    return f"{_between(*(f'{edge:.0f}' for edge in rpm))} rpm"


def _levels(report: CommissioningReport) -> tuple[tuple[str, str], ...]:
    """Smallest and largest rms of each channel."""
    if report.conditions is None:
        return ()
    found = []
    for state in ordered(report.conditions.rms):
        edges = report.conditions.rms[state]
        unit, scale = verdict.channel_unit(state)
        shown = _between(*(verdict.significant(scale * edge, 3) for edge in edges))
        found.append((verdict.channel_text(state), f"{shown} {unit}"))
    return tuple(found)


def _growths(report: CommissioningReport) -> tuple[tuple[str, ...], ...]:
    """Rows of the table of levels: operating state, windows, channel, level, healthy, alert from, growth."""
    found = []
    for one in report.levels:
        state = "any" if one.speed_rpm is None else _speeds(one.speed_rpm)
        unit = unit_in_text(one.unit)
        healthy, alert = (f"{verdict.significant(edge, 3)} {unit}" for edge in (one.healthy, one.alert))
        growth = "–" if one.growth is None else f"{100 * one.growth:.0f}%"
        found.append((state, str(one.windows), one.channel, MEASURE_WORDS[one.measure], healthy, alert, growth))
    return tuple(found)


def _row(recording: HealthyRecording, seen: Portrait | None) -> dict[str, str]:
    """One line of the table of recordings, in words."""
    gaps = f"{recording.gaps}, {verdict.duration(recording.missing_s)} missing" if recording.gaps else "none"
    refused = ", ".join(f"{count} {reason}" for reason, count in recording.refused) or "none"
    start = speed = "–"
    if seen is not None:
        seconds = seen.statistics.start_ns // 10**9
        start = f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S}"
        speed = "not known"
        if np.isfinite(seen.speed_hz):
            speed = f"{seen.statistics.speed_rad_s * _RPM:.0f} rpm"
            speed += ", estimated" if seen.statistics.speed_source == "estimated" else ""
    used = verdict.duration(recording.duration_s)
    return {"name": recording.name, "start": start, "used": used, "gaps": gaps, "refused": refused, "speed": speed}
