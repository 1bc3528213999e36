"""The pictures of the report, each with the words below it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from models.commissioning.knowledge import KnowledgeLevel
from models.commissioning.report import CommissioningReport
from simulator.commission.plots import draw_budget, draw_readings
from simulator.commission.recording_plots import Portrait, draw_levels, draw_spectra
from simulator.commission.svg import inline_svg

__all__ = ["Picture", "pictures_of"]

_COMPARED = {
    KnowledgeLevel.FULL: "Each healthy window against the parameters in the machine file.",
    KnowledgeLevel.PARTIAL: "Each healthy window against the rotor that was identified from all of them. They scatter "
    "about zero by construction; what counts is that none stands apart.",
    KnowledgeLevel.NONE: "Each healthy window against what the other halves of the recordings teach, so that no window "
    "is compared with itself. With half of the data the intervals are wider than those of the monitor will be.",
}


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture and what stands below it."""

    title: str
    svg: Markup
    caption: str


def pictures_of(
    report: CommissioningReport, names: Sequence[str], portraits: Sequence[Portrait]
) -> tuple[Picture, ...]:
    """Draw all that there is something to draw of.

    Parameters
    ----------
    names : sequence of str
        Of the recordings, in the order in which they are numbered.
    portraits : sequence of Portrait
        Of those that hold usable data.
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
    if portraits:
        drawn += [
            ("spectra", "Spectra of the recordings", lambda: draw_spectra(portraits), _spectra_caption(portraits)),
            ("levels", "Speed and level over time", lambda: draw_levels(portraits), _levels_caption(portraits)),
        ]
    pictures = ((title, inline_svg(name, title, paint), caption) for name, title, paint, caption in drawn)
    return tuple(Picture(title, svg, caption) for title, svg, caption in pictures if svg is not None)


def _spectra_caption(portraits: Sequence[Portrait]) -> str:
    band = portraits[0].statistics.frequencies_hz
    text = f"Shaded: the band that is used, {band[0]:g} to {band[-1]:g} Hz. "
    speeds = [one.speed_hz for one in portraits if np.isfinite(one.speed_hz)]
    if speeds:
        low, high = f"{min(speeds):.1f}", f"{max(speeds):.1f}"
        text += f"Grey: the rotation at {low if low == high else f'{low} to {high}'} Hz and its double"
        if any(one.statistics.speed_source == "estimated" for one in portraits):
            text += " (there is no phase reference: the speed is estimated from the vibration)"
        text += ". The rotation is taken out before anything is learned."
    else:
        text += "The speed is not known, so the rotation is neither marked nor taken out."
    if any(one.lines for one in portraits):
        text += (
            " A frequency in orange is a steady line that does not belong to the rotation, at the channel where it is "
        )
        text += "strongest."
    return text


def _levels_caption(portraits: Sequence[Portrait]) -> str:
    hop_s = portraits[0].statistics.duration_s / portraits[0].levels.shape[0]
    text = (
        f"A point every {hop_s:g} s; the level is that of the random vibration without the rotation, over the median "
        "of all recordings."
    )
    if any(one.broken.any() for one in portraits):
        text += " A line is broken where data are missing."
    if len(portraits) > 1:
        text += " The number on top is that of the recording."
    return text
