"""How well a machine is diagnosed that was commissioned without its parameters, or with some of them.

Every machine is commissioned several times, each time from scratch on new healthy windows, so that the error of the
commissioning is sampled too; with each commissioning, windows of later days are read, healthy and changed.
"""

from collections.abc import Iterator, Sequence
from functools import partial

from benchmarks.studies.reporting import results as r
from benchmarks.studies.reporting.opinions import LAYOUTS, changed_in, judged, opinion, readings, truth
from benchmarks.studies.reporting.results import Estimate, Goal, Record, Table, Value
from benchmarks.studies.reporting.study import Cell, Options, Study
from benchmarks.studies.subjects.machines import SUBJECTS, commissioned, subject_named
from models.commissioning.commissioned import KnowledgeLevel
from simulator.training.draws import Layout

_CHANGES: tuple[dict[str, float], ...] = (
    {},
    {"k_by": -0.1},
    {"c_by": -0.3},
    {"k_bz": -0.1},
    {"c_bz": -0.3},
    {"e": 0.2},
)
"""True changes; their index is part of the seed."""
_COMMISSIONINGS = 5
_RAISE_ABOVE = 0.1  # default alarm limit; a smaller change raises no alarm
_HEALTHY_WEIGHT = 8  # healthy windows per window of each change, because false alarms are rare


def _measure(
    options: Options, level: KnowledgeLevel, name: str, commissioning: int, at: int, _learned: None, number: int
) -> list[dict[str, Value]]:
    diagnostician, _ = commissioned(name, level, options.seed, commissioning, 3 if options.small else 6)
    window, cutoff_hz = subject_named(name).later(options.seed, commissioning, at, number, _CHANGES[at])
    known: dict[str, Value] = {"layout": LAYOUTS[Layout(number % 2)], "cutoff_hz": cutoff_hz, **truth(_CHANGES[at])}
    if isinstance(diagnostician, str):
        return [known | {"refused": diagnostician}]
    return [known | opinion(diagnostician, window, (0.01,))]


_KINDS = {
    "k_by, k_bz −10 %": r.among(r.share("exact"), changed=("k_by -10%", "k_bz -10%")),
    "c_by, c_bz −30 %": r.among(r.share("exact"), changed=("c_by -30%", "c_bz -30%")),
    "e +20 %": r.among(r.share("exact"), changed="e +20%"),
}
_FALSE_ALARMS = r.among(r.share("any"), changed="healthy")
_OUTSIDE = r.among(r.share("outside"), changed="healthy")
_CHANGED = tuple(changed_in(changes) for changes in _CHANGES[1:])


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
            "healthy: any named": _FALSE_ALARMS,
            "healthy: named beyond 10 %": _beyond_limit,
            "healthy: called outside": _OUTSIDE,
            **{f"{kind} located": located for kind, located in _KINDS.items()},
            "another named": r.among(r.share("wrong"), changed=_CHANGED),
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
            # Windows with the same commissioning share its error.
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
    for kind in list(_KINDS)[:2]:
        yield r.within(f"{kind} located", r.each(rows, by, _KINDS[kind]), 0.95, 1.0)
    bearing = r.where(rows, changed=_CHANGED[:4])
    yield r.within("bearing changed, another parameter named", r.each(bearing, by, r.share("wrong")), 0.0, 0.01)
    yield r.within("false alarms of healthy windows", r.each(rows, by, _FALSE_ALARMS), 0.0, 0.01)
    yield r.within("healthy windows called outside the model", r.each(rows, by, _OUTSIDE), 0.0, 0.01)


def unknown(options: Options) -> Study:
    """Machines commissioned without their parameters."""
    commissionings = 1 if options.small else _COMMISSIONINGS
    plan = [options.windows * (1 if changes or options.small else _HEALTHY_WEIGHT) for changes in _CHANGES]
    cells = tuple(
        Cell(
            {"level": level.value, "machine": name, "commissioning": commissioning, "changed": changed_in(changes)},
            plan[at] // commissionings + (commissioning < plan[at] % commissionings),
            partial(_measure, options, level, name, commissioning, at),
        )
        for level in (KnowledgeLevel.NONE, KnowledgeLevel.PARTIAL, KnowledgeLevel.FULL)
        for name in options.machines_among(SUBJECTS, *SUBJECTS)
        if subject_named(name).file(level) is not None
        for commissioning in range(commissionings)
        for at, changes in enumerate(_CHANGES)
    )
    return Study(name="unknown", cells=cells, tables=_TABLES, goals=_goals)
