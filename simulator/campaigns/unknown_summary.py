"""The records of commissioned unknown machines, summed up cell by cell."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict

from models.commissioning.knowledge import KnowledgeLevel
from models.diagnosis.readings import Z95
from simulator.campaigns.rates import Rate
from simulator.campaigns.unknown_study import CELLS, UnknownPlan, UnknownRecord
from simulator.training.draws import Layout

__all__ = ["CellSummary", "Reading", "UnknownSummary", "pooled", "summarize_unknown"]

_STRICT = ConfigDict(extra="forbid", frozen=True)


class Reading(BaseModel):
    """How one parameter was read in a cell.

    Attributes
    ----------
    truth : float
        Its relative change.
    windows : int
        In which it was read.
    median, median_error : float
        Of reading and standard error.
    covered : Rate
        Its 95 % interval holds the truth.
    z_rms : float
        Root mean square of (reading - truth) / standard error.
    """

    model_config = _STRICT

    truth: float
    windows: int
    median: float
    median_error: float
    covered: Rate
    z_rms: float


class CellSummary(BaseModel):
    """One true change on one machine.

    Attributes
    ----------
    level : KnowledgeLevel
    machine : str
    truth : dict of str to float
    layout : Layout or None
        None is both.
    windows : int
    detected : Rate
        Any parameter is named; on a healthy machine a false alarm.
    exact : Rate
        The changed ones and no others, nothing on a healthy machine.
    other : Rate
        A parameter is named that did not change.
    outside, refused : Rate
    by_commissioning : tuple of Rate
        `exact`, for each commissioning alone.
    readings : dict of str to Reading
    """

    model_config = _STRICT

    level: KnowledgeLevel
    machine: str
    truth: dict[str, float]
    layout: Layout | None
    windows: int
    detected: Rate
    exact: Rate
    other: Rate
    outside: Rate
    refused: Rate
    by_commissioning: tuple[Rate, ...]
    readings: dict[str, Reading]


class UnknownSummary(BaseModel):
    """All cells, and what they were made with."""

    model_config = _STRICT

    machines: dict[str, str]
    seed: int
    windows: int
    commissionings: int
    healthy_windows: int
    conditions: int = 1
    rate: float
    cells: tuple[CellSummary, ...]

    @property
    def pairs(self) -> tuple[tuple[KnowledgeLevel, str], ...]:
        """Levels and machines, in their order."""
        return tuple(dict.fromkeys((cell.level, cell.machine) for cell in self.cells))

    def of(self, level: KnowledgeLevel, machine: str, layout: Layout | None = None) -> tuple[CellSummary, ...]:
        """Cells of one machine at one level."""
        wanted = (level, machine, layout)
        return tuple(cell for cell in self.cells if (cell.level, cell.machine, cell.layout) == wanted)


def pooled(rates: Iterable[Rate]) -> Rate | None:
    """Rate over several cells; None without any."""
    found = list(rates)
    return Rate.of_counts(sum(one.count for one in found), sum(one.of for one in found)) if found else None


def summarize_unknown(
    plan: UnknownPlan, records: Sequence[UnknownRecord], descriptions: dict[str, str]
) -> UnknownSummary:
    """Sum up the records that belong to the plan.

    Parameters
    ----------
    plan : UnknownPlan
    records : sequence of UnknownRecord
        Others in it, of other machines or beyond the plan's windows, are left out.
    descriptions : dict of str to str
        Machines and what they are.
    """
    cells = []
    for level, machine in dict.fromkeys((one.level, one.machine) for one in records):
        if level not in plan.levels or machine not in plan.machines:
            continue
        for layout in (None, *Layout):
            for number, truth in enumerate(CELLS):
                own = [
                    one
                    for one in records
                    if (one.level, one.machine, one.cell) == (level, machine, number)
                    and layout in (None, one.layout)
                    and one.commissioning < plan.commissionings
                    and one.number in plan.numbers(one.commissioning)
                ]
                if own:
                    cells.append(_cell(level, machine, truth, layout, own))
    return UnknownSummary(
        machines={name: descriptions[name] for name in plan.machines},
        seed=plan.seed,
        windows=plan.windows,
        commissionings=plan.commissionings,
        healthy_windows=plan.healthy,
        conditions=plan.conditions,
        rate=plan.rate,
        cells=tuple(cells),
    )


def _cell(
    level: KnowledgeLevel, machine: str, truth: dict[str, float], layout: Layout | None, own: list[UnknownRecord]
) -> CellSummary:
    def exact(one: UnknownRecord) -> bool:
        return not one.refused and set(one.named) == set(truth)

    numbers = sorted({one.commissioning for one in own})
    names = dict.fromkeys(name for one in own for name in one.change)
    return CellSummary(
        level=level,
        machine=machine,
        truth=truth,
        layout=layout,
        windows=len(own),
        detected=_share(own, lambda one: bool(one.named)),
        exact=_share(own, exact),
        other=_share(own, lambda one: not set(one.named) <= set(truth)),
        outside=_share(own, lambda one: one.outside),
        refused=_share(own, lambda one: bool(one.refused)),
        by_commissioning=tuple(_share([one for one in own if one.commissioning == n], exact) for n in numbers),
        readings={name: _reading(name, truth.get(name, 0.0), own) for name in names},
    )


def _share(records: Sequence[UnknownRecord], true: Callable[[UnknownRecord], bool]) -> Rate:
    return Rate.of_counts(sum(true(one) for one in records), len(records))


def _reading(name: str, truth: float, own: list[UnknownRecord]) -> Reading:
    read = [one for one in own if name in one.change]
    change = np.array([one.change[name] for one in read])
    error = np.array([one.error[name] for one in read])
    z = (change - truth) / error
    return Reading(
        truth=truth,
        windows=len(read),
        median=float(np.median(change)),
        median_error=float(np.median(error)),
        covered=Rate.of_counts(int(np.sum(np.abs(z) <= Z95)), len(read)),
        z_rms=float(np.sqrt(np.mean(z**2))),
    )
