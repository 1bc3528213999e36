"""Declaration of studies, and the runner.

A study declares its cells (kinds and numbers of windows), the measurement of a window, and the evaluation of its
records. The runner simulates windows in worker processes and stores one line of JSON for each, so that an interrupted
study continues where it stopped; windows of different plans are never mixed.

::

    Options ──> Study.cells ──> measure(learned, number) ──> records ──> tables (CSV), goals, charts, page
"""

import importlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.studies.reporting.results import Chart, Goal, Record, Table, Value
from models.errors import MachineFileError, RecordingError
from simulator.commands import labelled_bars

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class Options:
    """Options of the command line."""

    machines: tuple[str, ...] = ()  # the study's own if empty
    windows: int = 100  # per cell; a study gives some cells a fixed multiple of it
    seed: int = 20261122
    small: bool = False
    """The smallest plan that exercises everything, at a declared rate of 10 % false alarms: a check, not a result."""

    @property
    def machine(self) -> str:
        """The machine of a study that takes only one; raises MachineFileError if several are given."""
        if len(self.machines) > 1:
            raise MachineFileError(f"--machine {', '.join(self.machines)}: this study takes one machine")
        return (self.machines or ("lab",))[0]

    def machines_among(self, known: Sequence[str], *own: str) -> tuple[str, ...]:
        """The machines given, or the study's own; raises MachineFileError if one is not among `known`."""
        for name in self.machines:
            if name not in known:
                raise MachineFileError(f"--machine {name}: not among {', '.join(known)}")
        return self.machines or own

    @property
    def rate(self) -> float:
        """Declared false alarms per window."""
        return 0.1 if self.small else 0.01


@dataclass(frozen=True, slots=True)
class Cell:
    """Windows of one kind."""

    keys: Mapping[str, Value]  # values that identify the cell; columns of its records
    windows: int
    measure: Callable[[Any, int], Iterable[Mapping[str, Value]]]
    """Function from the result of `Study.learn` and a window's number to the window's records."""

    @property
    def name(self) -> str:
        """The keys in words."""
        return ", ".join(f"{value}" for value in self.keys.values() if value not in ("", None))


@dataclass(frozen=True, slots=True)
class Over:
    """Applies a function to tasks, in order, with a progress bar."""

    name: str
    spread: Callable[..., Iterable[Any]]  # like `map`
    progress: Callable[[str, int, int], None]

    def __call__(self, label: str, function: Callable[[_Task], _Result], tasks: Sequence[_Task]) -> list[_Result]:
        """Results of all tasks; the function must be defined at module level, or be a partial of such a function."""
        results = []
        for result in self.spread(function, tasks):
            results.append(result)
            self.progress(f"{self.name}: {label}", len(results), len(tasks))
        return results


@dataclass(frozen=True, slots=True)
class Study:
    """Declaration of one study.

    Functions sent to workers, such as `Cell.measure`, must be defined at module level, or be partials of such.
    """

    name: str  # name of its records, and of its texts in ``texts.toml``
    cells: tuple[Cell, ...]
    tables: tuple[Table, ...]
    goals: Callable[[Sequence[Record]], Iterable[Goal]] = field(default=lambda _: ())
    charts: Callable[[Sequence[Record]], Iterable[Chart]] = field(default=lambda _: ())
    learn: Callable[[Over], Any] | None = None
    """Training or calibration done beforehand; repeated when a study is continued."""
    made_with: Mapping[str, str] = field(default_factory=dict)
    """Further properties that all records of a file must share: digests of machine and bundle."""


@contextmanager
def spread_over(processes: int, ray_address: str | None = None) -> Iterator[Callable[..., Iterable[Any]]]:
    """A `map` over processes of this computer, or over all cores of a Ray cluster."""
    with ExitStack() as undo:
        if ray_address is not None:
            from service.runtime.fleet import join_cluster  # noqa: PLC0415  # needs Ray, an optional package

            join_cluster(ray_address, undo)
            yield undo.enter_context(importlib.import_module("ray.util.multiprocessing").Pool()).imap
        elif processes > 1:
            yield undo.enter_context(ProcessPoolExecutor(processes)).map
        else:
            yield map


def run(study: Study, options: Options, folder: Path, spread: Callable[..., Iterable[Any]]) -> Path:
    """Measure the missing windows of a study, with the map of `spread_over`; returns the file of records.

    Raises
    ------
    RecordingError
        If the file holds windows of another plan, or cannot be written.
    RotorwatchError
        If `Study.learn` fails.
    """
    kept = folder / f"{study.name}.jsonl"
    head = {"study": study.name, "options": asdict(options), "made_with": dict(study.made_with)}
    head = json.loads(json.dumps(head))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lines = _lines(kept)
        if lines and _of_plan(lines[0]) != _of_plan(head):
            raise RecordingError(f"{kept}: holds windows of {lines[0]}, expected {head}; choose another --out")
        # Rewritten, because the next record would be appended to a truncated last line.
        kept.write_text("".join(json.dumps(line) + "\n" for line in [head, *lines[1:]]), encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"{kept}: cannot be written ({error.strerror})") from error
    done = {(line["cell"], line["number"]) for line in lines[1:]}
    tasks = [(cell, n) for cell in study.cells for n in range(cell.windows) if (cell.name, n) not in done]
    if not tasks:
        return kept
    with labelled_bars(remaining=True) as progress:
        learned = None if study.learn is None else study.learn(Over(study.name, spread, progress))
        found = spread(partial(_measured, learned), tasks)
        before = sum(cell.windows for cell in study.cells) - len(tasks)
        with kept.open("a", encoding="utf-8") as out:
            for at, line in enumerate(found, start=before + 1):
                out.write(json.dumps(line) + "\n")
                out.flush()
                progress(f"{study.name}: windows", at, before + len(tasks))
    return kept


def _measured(learned: object, task: tuple[Cell, int]) -> dict[str, Any]:
    cell, number = task
    return {"cell": cell.name, "number": number, "found": [dict(found) for found in cell.measure(learned, number)]}


def _lines(path: Path) -> list[dict[str, Any]]:
    """Stored lines; a last line truncated by an interruption is left out.

    Raises RecordingError if another line is damaged.
    """
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    whole = text.splitlines() if text.endswith("\n") else text.splitlines()[:-1]
    try:
        return [json.loads(line) for line in whole]
    except ValueError as error:
        raise RecordingError(f"{path}: a line is not JSON ({error}), expected the records of a study") from error


def _of_plan(head: Mapping[str, Any]) -> Mapping[str, Any]:
    """Parts of the head that must agree; the number of windows may differ."""
    options = {name: value for name, value in head.get("options", {}).items() if name != "windows"}
    return {**head, "options": options}


def read(study: Study, folder: Path) -> list[Record]:
    """Records of all windows of the plan, with the keys of their cells; windows beyond the plan are left out.

    Raises RecordingError if there are none, or a line is damaged.
    """
    path = folder / f"{study.name}.jsonl"
    lines = _lines(path)[1:]
    if not lines:
        raise RecordingError(f"{path}: no records; run the study first")
    cells = {cell.name: cell for cell in study.cells}
    records: list[Record] = []
    for name, of_cell in groupby(lines, key=lambda line: line["cell"]):
        cell = cells.get(name)
        if cell is not None:
            records += [
                {**cell.keys, "number": line["number"], **found}
                for line in of_cell
                if line["number"] < cell.windows
                for found in line["found"]
            ]
    return records
