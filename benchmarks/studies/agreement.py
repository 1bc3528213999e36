"""How often the networks are said to disagree with the likelihood, on machines that are healthy or have settled."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.studies import results as r
from benchmarks.studies.bound import cramer_rao
from benchmarks.studies.evaluate import true_condition
from benchmarks.studies.opinions import (
    LAYOUTS,
    RATES,
    SEVERAL,
    TITLES,
    changed_in,
    diagnosticians,
    judged,
    opinion,
    readings,
    truth,
)  # fmt: skip
from benchmarks.studies.results import Goal, Record, Table, Value
from benchmarks.studies.study import Cell, Options, Study
from models.diagnosis.networks.bundle import Bundle, load_bundle
from models.diagnosis.readings import Diagnosis, Diagnostician
from models.diagnosis.verdict.calibration import agreements, beside
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine, load_machine
from models.physics.rotor import PARAMETERS
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, simulate_scenario

_HEALTHY, _EVERYTHING = "healthy", "all by up to 30 %"
_CHANGES = ({"k_by": -0.05}, {"k_bz": -0.05}, {"c_by": -0.2}, {"e": 0.2}, {"EI": -0.1})
_DISAGREE = 0.001  # declared, per window
_STREAM = 700


def _measure(
    machines: dict[str, tuple[Machine, Bundle]], seed: int, _: None, cell: Cell, number: int
) -> list[dict[str, Value]]:
    machine, bundle = machines[str(cell.keys["machine"])]
    scenario = draw_condition(replace(cell.given, machine=machine, seed=seed), number)
    window = simulate_scenario(scenario, machine)
    events = {event.parameter: event.relative_change or 0.0 for event in scenario.events if event.parameter}
    known: dict[str, Value] = dict(truth({str(name): change for name, change in events.items()}))
    if cell.keys["changed"] == _HEALTHY and cell.keys["layout"] == SEVERAL:
        bound = cramer_rao(machine, window.states, true_condition(scenario, machine), window.duration_s)
        known |= {f"{name} bound": value for name, value in bound.items()}
    *others, likelihood = diagnosticians(machine, bundle)
    deciding = _diagnosis(likelihood, window)
    found: list[dict[str, Value]] = []
    for other in others:
        said = agreements(deciding, beside(deciding, _diagnosis(other, window)))
        apart: dict[str, Value] = {
            "compared": any(one.difference_z is not None for one in said),
            "disagrees": " ".join(one.name for one in said if one.verdict == "disagree"),
        }
        found.append(known | opinion(other, window) | apart)
    return found


def _diagnosis(one: Diagnostician, window: WindowStatistics) -> Diagnosis:
    try:
        return one.diagnose(window)
    except (EstimationError, np.linalg.LinAlgError):
        return Diagnosis(one.by)


def _rows(records: Iterable[Record]) -> Iterator[Record]:
    for row in judged(records):
        state = "unchanged" if row["changed"] == _HEALTHY else "settled"
        yield {**row, "state": state, "apart": bool(row["disagrees"]) if row["compared"] else None}


def _each_parameter(records: Iterable[Record]) -> Iterator[Record]:
    for row in readings(records):
        if row["parameter"] != "e" or row["method"] != "relation" or not row.get("EI true"):
            yield {**row, "apart": row["parameter"] in str(row.get("disagrees") or "").split()}


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
        lambda records: (row for row in _rows(records) if row["state"] == "unchanged"),
        "What they would name by themselves on healthy windows:",
    ),
    Table(
        "agreement-readings",
        ("machine", "method", "layout", "changed", "parameter"),
        {
            "read": lambda rows: sum("off" in row for row in rows),
            "median deviation": r.middle("off"),
            "spread": r.scatter("off"),
            "stated, median": r.middle("error"),
            "spread / bound": r.scatter("in bounds"),
            "covered": r.share("covered"),
            "named": r.share("is named"),
        },
        _each_parameter,
    ),
    Table(
        "agreement-found",
        ("machine", "method", "changed"),
        {layout: partial(lambda of, rows: r.share("is named")(r.where(rows, layout=of)), layout)
         for layout in (LAYOUTS[one] for one in Layout)},
        lambda records: (row for row in readings(records)
                         if row["true"] and row["changed"] == changed_in({str(row["parameter"]): float(row["true"])})),
        "Changes that they find in one window, at 1 % declared:",
    ),
)  # fmt: skip


def _goals(records: Sequence[Record]) -> Iterator[Goal]:
    rows = list(_rows(records))
    for by in ("network", "relation"):
        for state in ("unchanged", "settled"):
            shares = r.each(r.where(rows, method=by, state=state), ("machine", "layout"), r.share("apart"))
            yield r.holding(f"{TITLES[by]}: said to disagree, {state} machine", shares, _DISAGREE)
        healthy = r.where(rows, method=by, state="unchanged")
        for column, declared in zip(("any", "strict any"), RATES, strict=True):
            alarms = r.each(healthy, ("machine", "layout"), r.share(column))
            yield r.holding(f"{TITLES[by]}: false alarms of healthy windows", alarms, declared)
        covered = r.each(r.where(_each_parameter(records), method=by), ("machine", "layout"), r.share("covered"))
        yield r.within(f"{TITLES[by]}: 95 % intervals cover, all windows", covered, 0.93, 0.97)
    sharp = r.where(readings(records), method="network", layout=SEVERAL, changed=_HEALTHY)
    for names, most in ((("k_by", "k_bz"), 1.5), (("c_by", "c_bz", "e"), 1.25)):
        own = [row for row in sharp if row["parameter"] in names]
        spreads = r.each(own, ("parameter", "machine"), r.scatter("in bounds"))
        yield r.within(
            f"amortised networks: spread of {', '.join(names)} over the bound, {SEVERAL}", spreads, 0.0, most
        )


def agreement(options: Options) -> Study:
    """Healthy machines, and machines of which one or all parameters changed before the window began."""
    machines: dict[str, tuple[Machine, Bundle]] = {}
    for name in options.machines or ("lab", "heavy"):
        machine = load_machine(name)
        machines[machine.name] = (machine, load_bundle(name, machine))
    kinds = [
        (_HEALTHY, PARAMETERS, {}, 1.0),
        (_EVERYTHING, (), {}, 0.3),
        *((changed_in(faults), PARAMETERS, faults, 0.2) for faults in _CHANGES),
    ]
    cells = tuple(
        Cell(
            {"machine": machine.name, "changed": text, "layout": LAYOUTS[layout]},
            max(2, round(options.windows * share)),
            Draw(machine, 0, Purpose.EVALUATION, _STREAM + 2 * stream + layout, kept, faults=faults, layout=layout),
        )
        for machine, _ in machines.values()
        for stream, (text, kept, faults, share) in enumerate(kinds)
        for layout in Layout
    )
    return Study(
        name="agreement",
        cells=cells,
        measure=partial(_measure, machines, options.seed),
        tables=_TABLES,
        goals=_goals,
        made_with={name: f"{one.physics_hash} {two.identity}" for name, (one, two) in machines.items()},
    )
