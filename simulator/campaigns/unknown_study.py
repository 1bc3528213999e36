"""How well a machine is watched that was commissioned without its parameters, or with some of them.

Every machine is commissioned several times, each time from scratch on healthy windows of its own, so that the
commissioning's own error is sampled as well; against each commissioning, windows of later days are read, healthy and
changed. Every window becomes a record, one per line, so that a campaign can be stopped and carried on.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from models.commissioning.identified import identify
from models.commissioning.knowledge import KnowledgeLevel
from models.commissioning.levels import learned_baseline
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.readings import Diagnosis, Diagnostician
from models.diagnosis.verdict.determined import determined, with_shared_error
from models.diagnosis.verdict.isolation import isolate_window
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError, RecordingError
from models.machine import Machine, MachineFile
from models.signals.block import FloatArray
from simulator.campaigns.unknown_subjects import Later, subject_named
from simulator.training.draws import Layout

__all__ = ["CELLS", "UnknownPlan", "UnknownRecord", "commissioned", "read_unknown", "run_unknown"]

CELLS: tuple[dict[str, float], ...] = (
    {},
    {"k_by": -0.1},
    {"c_by": -0.3},
    {"k_bz": -0.1},
    {"c_bz": -0.3},
    {"e": 0.2},
)
"""True changes; the first cell is healthy."""

_APART = 1000
"""Between the numbers of a commissioning's conditions: more than there are commissionings."""


@dataclass(frozen=True, slots=True)
class UnknownPlan:
    """What to run.

    Attributes
    ----------
    machines : tuple of str
        Among `simulator.campaigns.unknown_subjects.SUBJECTS`.
    levels : tuple of KnowledgeLevel
        A machine without a file of a level is left out there.
    seed : int
    windows : int
        Of each cell and machine, spread evenly over the commissionings.
    commissionings : int
    healthy : int
        Windows of each condition of a commissioning.
    conditions : int
        Healthy recordings of a commissioning, each with a source, cutoff and level of its own.
    rate : float
        Declared false alarms per window.
    """

    machines: tuple[str, ...]
    levels: tuple[KnowledgeLevel, ...]
    seed: int
    windows: int
    commissionings: int = 5
    healthy: int = 6
    conditions: int = 1
    rate: float = 0.01

    def pairs(self) -> Iterator[tuple[KnowledgeLevel, str]]:
        """Levels and the machines that have a file of them."""
        for level in self.levels:
            for machine in self.machines:
                if subject_named(machine).file(level) is not None:
                    yield level, machine

    def numbers(self, commissioning: int) -> range:
        """Numbers of the windows that each cell has in a commissioning."""
        share, rest = divmod(self.windows, self.commissionings)
        return range(share + (commissioning < rest))


class UnknownRecord(BaseModel):
    """One window, read against one commissioning.

    Attributes
    ----------
    level : KnowledgeLevel
    machine : str
    commissioning, cell, number : int
    layout : Layout
        Alternates with the number.
    cutoff_hz : float
    change, error : dict of str to float
        Relative changes and standard errors.
    named : tuple of str
        Parameters said to have changed at the declared rate.
    outside : bool
        Whether it is said to be outside the model.
    misfit_z : float or None
    refused : str
        Why the machine was not commissioned, or the window not read.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    level: KnowledgeLevel = KnowledgeLevel.NONE
    machine: str
    commissioning: int
    cell: int
    number: int
    layout: Layout
    cutoff_hz: float
    change: dict[str, float] = {}
    error: dict[str, float] = {}
    named: tuple[str, ...] = ()
    outside: bool = False
    misfit_z: float | None = None
    refused: str = ""


@dataclass(frozen=True, slots=True)
class _Compared:
    """Windows compared with a machine's theory, each from a cold start: no two share their condition."""

    machine: Machine
    shared: FloatArray | None

    @property
    def by(self) -> str:
        return "likelihood"

    def diagnose(self, window: WindowStatistics) -> Diagnosis:
        read = determined(LikelihoodFit(self.machine).diagnose(window), window, self.machine.window.length_s)
        return read if self.shared is None else with_shared_error(read, self.shared)


def commissioned(
    level: KnowledgeLevel,
    machine: MachineFile,
    windows: Sequence[WindowStatistics],
    conditions: Sequence[str] | None = None,
) -> Diagnostician:
    """Commission on healthy windows with what the machine file tells; the one place where that is decided.

    Raises
    ------
    EstimationError
        If the windows do not suffice.
    """
    if level is KnowledgeLevel.NONE:
        return BaselineDiagnostician(learned_baseline(windows, conditions or [""] * len(windows)))
    if isinstance(machine, Machine):
        return _Compared(machine, None)
    identified = identify(machine, windows)
    return _Compared(identified.machine, identified.covariance)


def run_unknown(plan: UnknownPlan, kept: Path, processes: int, progress: Callable[[str, int, int], None]) -> None:
    """Read window after window, appending to a file of records; what is there already is not done again.

    Parameters
    ----------
    plan : UnknownPlan
    kept : Path
        JSON lines.
    processes : int
    progress : callable
        Called with machine and level, the windows done and the windows in all.

    Raises
    ------
    RecordingError
        If records that are already there are damaged.
    """
    records = list(read_unknown(kept))
    if records:  # a line that was cut short would swallow the next one
        kept.write_text("".join(map(_line, records)), encoding="utf-8")
    done = {(one.level, one.machine, one.commissioning, one.cell, one.number) for one in records}
    with ProcessPoolExecutor(processes) as pool, kept.open("a", encoding="utf-8") as out:
        for level, machine in plan.pairs():
            tasks: list[tuple[int, int, tuple[int, ...]]] = []
            finished = 0
            for commissioning in range(plan.commissionings):
                for cell in range(len(CELLS)):
                    numbers = plan.numbers(commissioning)
                    missing = tuple(n for n in numbers if (level, machine, commissioning, cell, n) not in done)
                    finished += len(numbers) - len(missing)
                    if missing:
                        tasks.append((commissioning, cell, missing))
            total = plan.windows * len(CELLS)
            label = f"{machine}, {level}"
            progress(label, finished, total)
            for read in pool.map(partial(_read, plan, level, machine), tasks):
                out.writelines(map(_line, read))
                out.flush()
                finished += len(read)
                progress(label, finished, total)


def _line(record: UnknownRecord) -> str:
    return record.model_dump_json(exclude_defaults=True) + "\n"


def read_unknown(path: Path) -> Iterator[UnknownRecord]:
    """Read records back, none if there is no file; a last line cut short by an interruption is left out.

    Raises
    ------
    RecordingError
        If a line is damaged.
    """
    if not path.exists():
        return
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            yield UnknownRecord.model_validate_json(line)
        except ValidationError as error:
            if number == len(lines) and not text.endswith("\n"):
                return
            raise RecordingError(f"{path}: line {number} is not a record of this campaign") from error


@lru_cache(maxsize=2)
def _commissioned(
    level: KnowledgeLevel, machine: str, seed: int, commissioning: int, healthy: int, conditions: int
) -> Diagnostician | str:
    subject = subject_named(machine)
    file = subject.file(level)
    if file is None:
        raise AssertionError("the plan leaves such machines out")
    try:
        found = [
            (window, f"recording {number + 1}")
            for number in range(conditions)
            for window in subject.healthy(seed, commissioning + _APART * number, healthy)
        ]
        return commissioned(level, file, [window for window, _ in found], [name for _, name in found])
    except EstimationError as error:
        return str(error)


def _read(
    plan: UnknownPlan, level: KnowledgeLevel, machine: str, task: tuple[int, int, tuple[int, ...]]
) -> list[UnknownRecord]:
    commissioning, cell, numbers = task
    diagnostician = _commissioned(level, machine, plan.seed, commissioning, plan.healthy, plan.conditions)
    subject = subject_named(machine)
    records = []
    for number in numbers:
        layout = Layout(number % 2)
        window, cutoff_hz = subject.later(Later(plan.seed, commissioning, cell, number, layout, CELLS[cell]))
        known = {
            "level": level,
            "machine": machine,
            "commissioning": commissioning,
            "cell": cell,
            "number": number,
            "layout": layout,
            "cutoff_hz": cutoff_hz,
        }
        records.append(UnknownRecord.model_validate(known | _opinion(diagnostician, window, plan.rate)))
    return records


def _opinion(diagnostician: Diagnostician | str, window: WindowStatistics, rate: float) -> dict[str, object]:
    if isinstance(diagnostician, str):
        return {"refused": f"not commissioned: {diagnostician}"}
    try:
        diagnosis = diagnostician.diagnose(window)
    except (EstimationError, np.linalg.LinAlgError) as error:
        return {"refused": str(error)}
    if not diagnosis.evaluable:
        return {"refused": next((one.reason for one in diagnosis.parameters), "nothing was read")}
    verdict = isolate_window(diagnosis, rate)
    read = diagnosis.evaluable
    return {
        "change": {one.name: one.change for one in read},
        "error": {one.name: one.standard_error for one in read},
        "named": verdict.changed,
        "outside": verdict.outside,
        "misfit_z": diagnosis.misfit_z,
    }
