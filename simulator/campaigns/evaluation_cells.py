"""The cells of the evaluation: which machines, changes and conditions are drawn, and how many windows of each."""

from dataclasses import dataclass, field
from enum import StrEnum

from models.physics.parameters import PARAMETERS
from simulator.training.draws import Anomaly, Excitation, Layout

__all__ = ["PAPER_CONDITIONS", "EvaluationCell", "Topic", "cells_for"]

PAPER_CONDITIONS: tuple[tuple[str, ...], ...] = (
    ("k_by",),
    ("c_by",),
    ("c_bz",),
    ("e",),
    ("c_by", "c_bz"),
    ("k_by", "k_bz"),
    ("e", "c_bz"),
    ("e", "c_by"),
)
"""The eight fault conditions of the paper's Table 2, as far as its section 4.2 tells, in physical parameters."""


class Topic(StrEnum):
    """What a cell is evidence for; a heading of the results page."""

    HEALTHY = "healthy"
    SMALL = "small changes"
    PAPER = "the paper's eight conditions"
    EXCITATION = "excitation the model was not told about"
    OUTSIDE = "outside the model"
    LENGTH = "window length"
    DETECTABLE = "at the quoted minimum detectable change"


@dataclass(frozen=True, slots=True)
class EvaluationCell:
    """Windows of one kind.

    Attributes
    ----------
    topic : Topic
    faults : dict of str to float
        True relative changes.
    layout : Layout or None
        None draws one of them at random for each window.
    excitation : Excitation
    anomaly : Anomaly
    length_s : float or None
        Window length, where it is not the machine's own.
    windows : float
        Number of windows, as a multiple of the number asked for.
    """

    topic: Topic
    faults: dict[str, float] = field(default_factory=dict)
    layout: Layout | None = None
    excitation: Excitation = Excitation.SECOND_ORDER
    anomaly: Anomaly = Anomaly.NONE
    length_s: float | None = None
    windows: float = 1.0

    def count(self, n_windows: int) -> int:
        """Windows of this cell where a cell of weight one has `n_windows`."""
        return max(2, round(n_windows * self.windows))


_TOGETHER = ({"k_by": -0.02, "c_bz": -0.10, "e": 0.10}, {"k_bz": -0.05, "c_by": -0.05, "e": 0.05})
_ALONE = ({"k_by": -0.02}, {"c_bz": -0.10}, {"e": 0.10}, {"c_by": -0.05}, {"e": 0.05}, {"k_bz": -0.05})
_LENGTHS_S = {15.0: 0.2, 30.0: 0.2, 120.0: 0.1, 300.0: 0.06, 600.0: 0.04}
"""Window lengths with their share of windows: a ten-minute window costs forty 15-second ones."""


def cells_for(fault: float, *, full: bool) -> list[EvaluationCell]:
    """Return the cells in the order in which they are evaluated.

    Parameters
    ----------
    fault : float
        Size of the large changes: e up, everything else down.
    full : bool
        Everything; otherwise what calibration needs: healthy windows and small changes.
    """
    large = {name: fault if name == "e" else -fault for name in PARAMETERS}
    cells = [EvaluationCell(Topic.HEALTHY, layout=layout, windows=1.6 if full else 1.0) for layout in Layout]
    cells += [
        EvaluationCell(Topic.SMALL, faults=faults, layout=layout, windows=0.5)
        for faults in _TOGETHER
        for layout in Layout
    ]
    if not full:
        return cells
    # One source reads a hundredth of these changes: they are asked of independent sources alone.
    cells += [EvaluationCell(Topic.SMALL, faults=faults, layout=Layout.INDEPENDENT) for faults in _ALONE]
    cells += [
        EvaluationCell(Topic.PAPER, faults={name: large[name] for name in names}, windows=0.4)
        for names in PAPER_CONDITIONS
    ]
    cells += [
        EvaluationCell(
            Topic.EXCITATION,
            layout=layout,
            excitation=excitation,
            windows=0.4 if layout is Layout.INDEPENDENT else 0.2,
        )
        for layout in (Layout.INDEPENDENT, Layout.ONE_SOURCE)
        for excitation in Excitation
        if excitation is not Excitation.SECOND_ORDER
        and not (excitation is Excitation.OWN_CUTOFFS and layout is Layout.ONE_SOURCE)
    ]
    cells += [EvaluationCell(Topic.DETECTABLE, windows=0.8)]
    cells += [
        EvaluationCell(Topic.OUTSIDE, anomaly=anomaly, windows=0.4)
        for anomaly in Anomaly
        if anomaly is not Anomaly.NONE
    ]
    cells += [
        EvaluationCell(Topic.LENGTH, layout=layout, length_s=length_s, windows=windows)
        for length_s, windows in _LENGTHS_S.items()
        for layout in Layout
    ]
    return cells
