"""How often networks are reported to disagree with the likelihood, on healthy machines and after settled changes."""

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import product

import numpy as np

from benchmarks.studies.methods.bound import bound_of
from benchmarks.studies.reporting import opinions as o
from benchmarks.studies.reporting import results as r
from benchmarks.studies.reporting.results import Goal, Record, Table, Value
from benchmarks.studies.reporting.study import Cell, Options, Study
from models.diagnosis.readings import Diagnosis, Diagnostician
from models.diagnosis.verdict.calibration import agreements, beside
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.physics.rotor import PARAMETERS
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, simulate_scenario

_HEALTHY, _EVERYTHING = "healthy", "all by up to 30 %"
_CHANGES = ({"k_by": -0.05}, {"k_bz": -0.05}, {"c_by": -0.2}, {"e": 0.2}, {"EI": -0.1})
_DISAGREE = 0.001  # declared, per window
_STREAM = 700


def _measure(trained: o.Trained, draw: Draw, bounded: bool, _: None, number: int) -> Iterator[dict[str, Value]]:
    scenario = draw_condition(draw, number)
    window = simulate_scenario(scenario, trained.machine)
    events = {event.parameter: event.relative_change or 0.0 for event in scenario.events if event.parameter}
    known: dict[str, Value] = dict(o.truth({str(name): change for name, change in events.items()}))
    if bounded:
        known |= {f"{name} bound": value for name, value in bound_of(scenario, trained.machine).items()}
    *others, likelihood = trained.diagnosticians()
    deciding = _diagnosis(likelihood, window)
    for other in others:
        said = agreements(deciding, beside(deciding, _diagnosis(other, window)))
        apart: dict[str, Value] = {
            "compared": any(one.difference_z is not None for one in said),
            "disagrees": " ".join(one.name for one in said if one.verdict == "disagree"),
        }
        yield known | o.opinion(other, window) | apart


def _diagnosis(one: Diagnostician, window: WindowStatistics) -> Diagnosis:
    try:
        return one.diagnose(window)
    except (EstimationError, np.linalg.LinAlgError):
        return Diagnosis(one.by)


def _rows(records: Iterable[Record]) -> Iterator[Record]:
    for row in o.judged(records):
        state = "unchanged" if row["changed"] == _HEALTHY else "settled"
        yield {**row, "state": state, "apart": bool(row["disagrees"]) if row["compared"] else None}


def _each_parameter(records: Iterable[Record]) -> Iterator[Record]:
    for row in o.readings(records):
        if row["parameter"] != "e" or row["method"] != "relation" or not row.get("EI true"):
            yield {**row, "apart": row["parameter"] in str(row.get("disagrees") or "").split()}


def _said_of(row: Record) -> str:
    return o.changed_in({str(row["parameter"]): float(row["true"] or 0.0)})


_TABLES = (
    Table(
        "agreement-windows",
        ("machine", "method", "layout", "changed"),
        {
            "disagrees": r.share("apart"),
            "any named at 1 %": r.share("any"),
            "any named at 0.1 %": r.share("strict any"),
            "exactly the changed": r.share("exact"),
        },
        _rows,
    ),
    Table(
        "agreement",
        ("machine", "method", "state", "layout"),
        {"said to disagree": r.share("apart")},
        _rows,
        "Windows in which one of them is said to disagree about any parameter; 0.1 % is declared:",
    ),
    Table(
        "agreement-healthy",
        ("machine", "method", "layout"),
        {"named at 1 % declared": r.share("any"), "named at 0.1 % declared": r.share("strict any")},
        lambda records: r.where(_rows(records), state="unchanged"),
        "What they would name by themselves on healthy windows:",
    ),
    Table(
        "agreement-readings",
        ("machine", "method", "layout", "changed", "parameter"),
        {
            name: o.READING_COLUMNS[name]
            for name in ("read", "median deviation", "spread", "stated, median", "spread / bound", "covered", "named")
        },
        _each_parameter,
    ),
    Table(
        "agreement-found",
        ("machine", "method", "changed"),
        {o.LAYOUTS[layout]: r.among(r.share("is named"), layout=o.LAYOUTS[layout]) for layout in Layout},
        lambda records: (row for row in o.readings(records) if row["true"] and _said_of(row) == row["changed"]),
        "Changes that they find in one window, at 1 % declared:",
    ),
)


def _goals(records: Sequence[Record]) -> Iterator[Goal]:
    rows = list(_rows(records))
    for by in ("network", "relation"):
        for state in ("unchanged", "settled"):
            shares = r.each(r.where(rows, method=by, state=state), ("machine", "layout"), r.share("apart"))
            yield r.holding(f"{o.TITLES[by]}: said to disagree, {state} machine", shares, _DISAGREE)
        yield from o.false_alarms(o.TITLES[by], r.where(rows, method=by, state="unchanged"), ("machine", "layout"))
        covered = r.each(r.where(_each_parameter(records), method=by), ("machine", "layout"), r.share("covered"))
        yield r.within(f"{o.TITLES[by]}: 95 % intervals cover, all windows", covered, 0.93, 0.97)
    sharp = r.where(o.readings(records), method="network", layout=o.SEVERAL, changed=_HEALTHY)
    for names, most in ((("k_by", "k_bz"), 1.5), (("c_by", "c_bz", "e"), 1.25)):
        spreads = r.each(r.where(sharp, parameter=names), ("parameter", "machine"), r.scatter("in bounds"))
        yield r.within(
            f"amortised networks: spread of {', '.join(names)} over the bound, {o.SEVERAL}", spreads, 0.0, most
        )


def agreement(options: Options) -> Study:
    """Healthy machines, and machines of which one or all parameters changed before the window began."""
    machines = {one.machine.name: one for one in map(o.Trained.named, options.machines or ("lab", "heavy"))}
    kinds = [
        (_HEALTHY, PARAMETERS, {}, 1.0),
        (_EVERYTHING, (), {}, 0.3),
        *((o.changed_in(faults), PARAMETERS, faults, 0.2) for faults in _CHANGES),
    ]
    cells = []
    for (name, one), (at, (text, kept, faults, share)), layout in product(machines.items(), enumerate(kinds), Layout):
        stream = _STREAM + 2 * at + layout
        draw = Draw(one.machine, options.seed, Purpose.EVALUATION, stream, kept, faults=faults, layout=layout)
        measure = partial(_measure, one, draw, text == _HEALTHY and layout is Layout.INDEPENDENT)
        keys = {"machine": name, "changed": text, "layout": o.LAYOUTS[layout]}
        cells.append(Cell(keys, max(2, round(options.windows * share)), measure))
    return Study(
        name="agreement", cells=tuple(cells), tables=_TABLES, goals=_goals, made_with=o.made_with(machines.values())
    )
