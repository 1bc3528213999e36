"""How well a machine is watched that was commissioned without its parameters, or with some of them.

Every machine is commissioned several times, each time from scratch on healthy windows of its own, so that the
commissioning's own error is sampled as well; against each commissioning, windows of later days are read, healthy and
changed.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial

from benchmarks.studies.evaluate import LAYOUTS
from benchmarks.studies.opinions import changed_in, opinion
from benchmarks.studies.results import Estimate, Goal, Record, Table, Value, grouped, median, rate, within
from benchmarks.studies.study import Cell, Options, Study
from benchmarks.studies.subjects import SUBJECTS, Later, commissioned, subject_named
from models.commissioning.knowledge import KnowledgeLevel
from models.diagnosis.readings import Z95, Diagnostician
from models.errors import EstimationError, MachineFileError
from models.physics.parameters import PARAMETERS
from simulator.training.draws import Layout

__all__ = ["unknown"]

_CHANGES: tuple[dict[str, float], ...] = (
    {},
    {"k_by": -0.1},
    {"c_by": -0.3},
    {"k_bz": -0.1},
    {"c_bz": -0.3},
    {"e": 0.2},
)
"""True changes; their place is part of the seed."""
_COMMISSIONINGS = 5


@lru_cache(maxsize=2)
def _commissioned(level: KnowledgeLevel, name: str, seed: int, commissioning: int, healthy: int) -> Diagnostician | str:
    subject = subject_named(name)
    file = subject.file(level)
    assert file is not None  # noqa: S101  # the cells leave such machines out
    try:
        return commissioned(level, file, subject.healthy(seed, commissioning, healthy))
    except EstimationError as error:
        return f"not commissioned: {error}"


def _measure(options: Options, _: None, cell: Cell, number: int) -> list[dict[str, Value]]:
    level, name, commissioning, at = cell.given
    diagnostician = _commissioned(level, name, options.seed, commissioning, 3 if options.small else 6)
    layout = Layout(number % 2)
    window, cutoff_hz = subject_named(name).later(Later(options.seed, commissioning, at, number, layout, _CHANGES[at]))
    known: dict[str, Value] = {"layout": LAYOUTS[layout], "cutoff_hz": cutoff_hz}
    known |= {f"{name} true": _CHANGES[at].get(name, 0.0) for name in PARAMETERS}
    if isinstance(diagnostician, str):
        return [known | {"refused": diagnostician}]
    return [known | opinion(diagnostician, window, (0.01,))]


def _named(record: Record) -> set[str]:
    return set(str(record.get("named", "")).split())


def _changed(record: Record) -> set[str]:
    return {name for name in PARAMETERS if record[f"{name} true"]}


def _exact(record: Record) -> bool:
    return not record["refused"] and _named(record) == _changed(record)


def _located(kind: str, rows: Sequence[Record]) -> Estimate | None:
    return rate(_exact(row) for row in rows if str(row["changed"]).startswith(kind))


def _covered(rows: Sequence[Record], *, changed: bool) -> Iterator[bool]:
    for row in rows:
        for name in PARAMETERS:
            read, error = row.get(name), row.get(f"{name} error")
            if isinstance(read, float) and isinstance(error, float) and bool(row[f"{name} true"]) is changed:
                yield abs(read - float(row[f"{name} true"] or 0)) <= Z95 * error


def _of_change(rows: Sequence[Record], column: str) -> float | None:
    return median(row.get(f"{name}{column}") for row in rows for name in _changed(row))


def _least(rows: Sequence[Record]) -> float:
    """Of the commissionings: windows of one share its error."""
    shares = [rate(map(_exact, group)) for group in grouped(rows, "commissioning").values()]
    return min(one.value for one in shares if one is not None)


_TABLES = (
    Table(
        "unknown",
        ("level", "machine"),
        {
            "healthy: any named": lambda rows: rate(_named(row) for row in rows if row["changed"] == "healthy"),
            **{
                f"{kind[0]} {change} located": partial(_located, kind)
                for kind, change in (("k_", "−10 %"), ("c_", "−30 %"), ("e ", "+20 %"))
            },
            "another named": lambda rows: rate(
                not _named(row) <= _changed(row) for row in rows if row["changed"] != "healthy"
            ),
        },
        page="*Located*: exactly the changed parameter is named.",
    ),
    Table(
        "unknown-changes",
        ("level", "machine", "layout", "changed"),
        {
            "any named": lambda rows: rate(map(_named, rows)),
            "exactly right": lambda rows: rate(map(_exact, rows)),
            "least commissioning": _least,
            "another named": lambda rows: rate(not _named(row) <= _changed(row) for row in rows),
            "called outside": lambda rows: rate(row.get("outside") for row in rows),
            "refused": lambda rows: rate(row["refused"] for row in rows),
            "it reads": lambda rows: _of_change(rows, ""),
            "stated error": lambda rows: _of_change(rows, " error"),
            "covered": lambda rows: rate(_covered(rows, changed=True)),
            "others covered": lambda rows: rate(_covered(rows, changed=False)),
        },
    ),
)


def _goals(records: Sequence[Record]) -> Iterator[Goal]:
    groups = grouped(records, "level", "machine")
    named = {f"{machine}, {level}": rows for (level, machine), rows in groups.items()}
    bearing = {key: [row for row in rows if str(row["changed"])[0] in "kc"] for key, rows in named.items()}
    for kind, change in (("k_", "−10 %"), ("c_", "−30 %")):
        yield within(
            f"{kind[0]} {change} located", {key: _located(kind, rows) for key, rows in named.items()}, 0.95, 1.0
        )
    others = {key: rate(not _named(row) <= _changed(row) for row in rows) for key, rows in bearing.items()}
    yield within("bearing changed, another parameter named", others, 0.0, 0.01)
    alarms = {key: rate(_named(row) for row in rows if row["changed"] == "healthy") for key, rows in named.items()}
    yield within("false alarms of healthy windows", alarms, 0.0, 0.01)


def unknown(options: Options) -> Study:
    """Machines commissioned without their parameters."""
    machines = options.machines or SUBJECTS
    for name in machines:
        if name not in SUBJECTS:
            raise MachineFileError(f"--machine {name}: not among {', '.join(SUBJECTS)}")
    commissionings = 1 if options.small else _COMMISSIONINGS
    share, rest = divmod(options.windows, commissionings)
    cells = tuple(
        Cell(
            {"level": level.value, "machine": name, "commissioning": commissioning, "changed": changed_in(changes)},
            share + (commissioning < rest),
            (level, name, commissioning, at),
        )
        for level in (KnowledgeLevel.NONE, KnowledgeLevel.PARTIAL, KnowledgeLevel.FULL)
        for name in machines
        if subject_named(name).file(level) is not None
        for commissioning in range(commissionings)
        for at, changes in enumerate(_CHANGES)
    )
    return Study(
        name="unknown",
        cells=cells,
        measure=partial(_measure, options),
        tables=_TABLES,
        goals=_goals,
    )
