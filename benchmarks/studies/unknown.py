"""How well a machine is watched that was commissioned without its parameters, or with some of them.

Every machine is commissioned several times, each time from scratch on healthy windows of its own, so that the
commissioning's own error is sampled as well; against each commissioning, windows of later days are read, healthy and
changed.
"""

from collections.abc import Iterator, Sequence
from functools import partial

from benchmarks.studies import results as r
from benchmarks.studies.opinions import LAYOUTS, changed_in, judged, opinion, readings, truth
from benchmarks.studies.results import Estimate, Goal, Record, Table, Value
from benchmarks.studies.study import Cell, Options, Study
from benchmarks.studies.subjects import SUBJECTS, commissioned, subject_named
from models.commissioning.commissioned import KnowledgeLevel
from models.errors import MachineFileError
from simulator.training.draws import Layout

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
_RAISE_ABOVE = 0.1
"""A smaller change raises no alarm, as shipped."""
_HEALTHY_WEIGHT = 8
"""Windows of the healthy machine for each one of a change: false alarms are rare."""


def _measure(options: Options, _learned: None, cell: Cell, number: int) -> list[dict[str, Value]]:
    level, name, commissioning, at = cell.given
    diagnostician, _ = commissioned(name, level, options.seed, commissioning, 3 if options.small else 6)
    window, cutoff_hz = subject_named(name).later(options.seed, commissioning, at, number, _CHANGES[at])
    known: dict[str, Value] = {"layout": LAYOUTS[Layout(number % 2)], "cutoff_hz": cutoff_hz, **truth(_CHANGES[at])}
    if isinstance(diagnostician, str):
        return [known | {"refused": diagnostician}]
    return [known | opinion(diagnostician, window, (0.01,))]


def _located(kind: str, rows: Sequence[Record]) -> Estimate | None:
    return r.share("exact")([row for row in rows if str(row["changed"]).startswith(kind)])


def _among_changed(column: str, rows: Sequence[Record]) -> Estimate | None:
    return r.share(column)([row for row in rows if row["changed"] != "healthy"])


def _false_alarms(rows: Sequence[Record]) -> Estimate | None:
    return r.share("any")(r.where(rows, changed="healthy"))


def _beyond_limit(rows: Sequence[Record]) -> Estimate | None:
    healthy = r.where(rows, changed="healthy")
    return r.rate(float(str(row.get("largest") or 0.0)) > _RAISE_ABOVE for row in healthy)


def _refused(rows: Sequence[Record]) -> Estimate | None:
    commissionings = {row["commissioning"]: str(row["refused"]).startswith("not commissioned") for row in rows}
    return r.rate(commissionings.values())


_TABLES = (
    Table(
        "unknown",
        ("level", "machine"),
        {
            "commissioning refused": _refused,
            "healthy: any named": _false_alarms,
            "healthy: named beyond 10 %": _beyond_limit,
            **{
                f"{kind} located": partial(_located, kind[:2])
                for kind in ("k_by, k_bz −10 %", "c_by, c_bz −30 %", "e +20 %")
            },
            "another named": partial(_among_changed, "wrong"),
        },
        judged,
        "*Located*: exactly the changed parameter is named.",
    ),
    Table(
        "unknown-changes",
        ("level", "machine", "layout", "changed"),
        {
            "any named": r.share("any"),
            "exactly right": r.share("exact"),
            # Windows of one commissioning share its error.
            "least commissioning": lambda rows: min(
                one.value for one in r.each(rows, ("commissioning",), r.share("exact")).values() if one
            ),
            "another named": r.share("wrong"),
            "called outside": r.share("outside"),
            "refused": lambda rows: r.rate(row["refused"] for row in rows),
        },
        judged,
    ),
    Table(
        "unknown-readings",
        ("level", "machine", "layout", "changed", "parameter"),
        {"reads": r.middle("read"), "stated error": r.middle("error"), "covered": r.share("covered")},
        readings,
    ),
)


def _goals(records: Sequence[Record]) -> Iterator[Goal]:
    rows, by = list(judged(records)), ("machine", "level")
    for kind in ("k_by, k_bz −10 %", "c_by, c_bz −30 %"):
        yield r.within(f"{kind} located", r.each(rows, by, partial(_located, kind[:2])), 0.95, 1.0)
    bearing = [row for row in rows if str(row["changed"])[0] in "kc"]
    yield r.within("bearing changed, another parameter named", r.each(bearing, by, r.share("wrong")), 0.0, 0.01)
    yield r.within("false alarms of healthy windows", r.each(rows, by, _false_alarms), 0.0, 0.01)


def unknown(options: Options) -> Study:
    """Machines commissioned without their parameters."""
    machines = options.machines or SUBJECTS
    for name in machines:
        if name not in SUBJECTS:
            raise MachineFileError(f"--machine {name}: not among {', '.join(SUBJECTS)}")
    commissionings = 1 if options.small else _COMMISSIONINGS
    plan = [options.windows * (1 if changes or options.small else _HEALTHY_WEIGHT) for changes in _CHANGES]
    cells = tuple(
        Cell(
            {"level": level.value, "machine": name, "commissioning": commissioning, "changed": changed_in(changes)},
            plan[at] // commissionings + (commissioning < plan[at] % commissionings),
            (level, name, commissioning, at),
        )
        for level in (KnowledgeLevel.NONE, KnowledgeLevel.PARTIAL, KnowledgeLevel.FULL)
        for name in machines
        if subject_named(name).file(level) is not None
        for commissioning in range(commissionings)
        for at, changes in enumerate(_CHANGES)
    )
    return Study(name="unknown", cells=cells, measure=partial(_measure, options), tables=_TABLES, goals=_goals)
