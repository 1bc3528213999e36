"""How sharp the readings are, whether their intervals hold what they promise, what is named and how often falsely."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy.special import ndtr

from benchmarks.studies.opinions import RATES, TITLES, changed_in, diagnosticians, opinion
from benchmarks.studies.results import (
    Chart,
    Estimate,
    Goal,
    Record,
    Table,
    Value,
    at_least,
    at_most,
    floats,
    grouped,
    median,
    rate,
    resampled,
    spread,
    within,
)
from benchmarks.studies.study import Cell, Options, Study
from models.diagnosis.likelihood.bound import TrueCondition, cramer_rao
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.moments import plan_for
from models.diagnosis.networks.bundle import Bundle, load_bundle
from models.diagnosis.readings import Z95
from models.diagnosis.verdict.calibration import window_thresholds
from models.diagnosis.verdict.detectable import detectable_changes
from models.diagnosis.verdict.stretch import stretch_of, to_scale
from models.machine import Machine, load_machine
from models.physics.excitation import source_spectrum
from models.physics.matrices import STATE_INDEX
from models.physics.parameters import PARAMETERS
from simulator.integrator import theoretical_rms
from simulator.scenario import Scenario
from simulator.timeline import Condition
from simulator.training.draws import Anomaly, Draw, Excitation, Layout, Purpose, draw_condition, simulate_scenario

__all__ = ["LAYOUTS", "evaluate", "true_condition"]

LAYOUTS = {None: "either", Layout.ONE_SOURCE: "one source", Layout.INDEPENDENT: "independent sources"}
_EXCITATIONS = {
    Excitation.SECOND_ORDER: "as assumed",
    Excitation.FIRST_ORDER: "first-order low-pass",
    Excitation.FOURTH_ORDER: "fourth-order low-pass",
    Excitation.OWN_CUTOFFS: "a cutoff for every source",
    Excitation.HUMP: "hump at 40–120 Hz",
    Excitation.DRIFT: "level doubles or halves",
}
_ANOMALIES = {
    Anomaly.NONE: "",
    Anomaly.CRACK: "breathing crack",
    Anomaly.RUB: "rub",
    Anomaly.ADDED_MASS: "deposit on the disc",
    Anomaly.GAIN_DRIFT: "gain of a sensor",
}
_PAPER = (("k_by",), ("c_by",), ("c_bz",), ("e",), ("c_by", "c_bz"), ("k_by", "k_bz"), ("e", "c_bz"), ("e", "c_by"))
"""The paper's eight fault conditions (its Table 2, as far as its section 4.2 tells), in physical parameters."""
_LARGE = {name: 0.2 if name == "e" else -0.2 for name in PARAMETERS}
_TOGETHER = ({"k_by": -0.02, "c_bz": -0.10, "e": 0.10}, {"k_bz": -0.05, "c_by": -0.05, "e": 0.05})
_ALONE = ({"k_by": -0.02}, {"c_bz": -0.10}, {"e": 0.10}, {"c_by": -0.05}, {"e": 0.05}, {"k_bz": -0.05})
_LENGTHS_S = {15.0: 0.2, 30.0: 0.2, 120.0: 0.1, 300.0: 0.06, 600.0: 0.04}
"""Window lengths with their share of windows: a ten-minute window costs forty 15-second ones."""
_WHOLE = ("lab",)
"""Machines with all topics; the others have healthy windows and small changes."""
_OTHER_REALISATION = 7919
_LARGEST_LOSS = -0.9


@dataclass(frozen=True, slots=True)
class _Kind:
    topic: str
    faults: dict[str, float] = field(default_factory=dict)
    layout: Layout | None = None
    excitation: Excitation = Excitation.SECOND_ORDER
    anomaly: Anomaly = Anomaly.NONE
    length_s: float | None = None
    share: float = 1.0


def _kinds(*, whole: bool) -> Iterator[_Kind]:
    """What is drawn; the place in this order is part of the seed."""
    yield from (_Kind("healthy", layout=layout, share=1.6 if whole else 1.0) for layout in Layout)
    yield from (_Kind("small", faults, layout, share=0.5) for faults in _TOGETHER for layout in Layout)
    if not whole:
        return
    yield from (_Kind("small", faults, Layout.INDEPENDENT) for faults in _ALONE)
    yield from (_Kind("paper", {name: _LARGE[name] for name in names}, share=0.4) for names in _PAPER)
    for layout in (Layout.INDEPENDENT, Layout.ONE_SOURCE):
        for excitation in list(Excitation)[1:]:
            if excitation is not Excitation.OWN_CUTOFFS or layout is Layout.INDEPENDENT:
                share = 0.4 if layout is Layout.INDEPENDENT else 0.2
                yield _Kind("excitation", layout=layout, excitation=excitation, share=share)
    yield _Kind("detectable", share=0.8)
    yield from (_Kind("outside", anomaly=anomaly, share=0.4) for anomaly in list(Anomaly)[1:])
    yield from (
        _Kind("length", layout=layout, length_s=length_s, share=share)
        for length_s, share in _LENGTHS_S.items()
        for layout in Layout
    )


def true_condition(scenario: Scenario, machine: Machine) -> TrueCondition:
    """What the scenario makes of the machine from its first sample on, as the bound needs it."""
    changes = {one.parameter: one.relative_change for one in scenario.events if one.parameter}
    truth = {name: float(change) for name, change in changes.items() if change is not None}
    speed_rpm = [one.speed_rpm for one in scenario.events if one.speed_rpm is not None][-1]
    rms = theoretical_rms(machine, Condition(truth, speed_rpm, scenario.sources))
    states = [STATE_INDEX[name] for name in plan_for(machine).states]
    low_hz, high_hz = machine.window.band_hz
    frequencies_hz = np.linspace(low_hz, high_hz, 64)
    corner_hz = scenario.sensors.noise_corner_hz
    memory = 0.0 if corner_hz is None else float(np.exp(-2 * np.pi * corner_hz / machine.rate_hz))
    density = (1 - memory**2) / np.abs(1 - memory * np.exp(-2j * np.pi * frequencies_hz / machine.rate_hz)) ** 2
    colour = np.stack([np.ones(64), np.log1p((frequencies_hz / (2 / 3 * high_hz)) ** 2)], axis=1)
    (level, exponent), *_ = np.linalg.lstsq(colour, np.log(density / machine.rate_hz), rcond=None)
    variance = (scenario.sensors.noise_relative * rms[states]) ** 2
    levels = np.zeros((6, 6))
    for source in scenario.sources:
        levels += np.outer(source.direction, source.direction) * float(source_spectrum(np.array([1e-6]), source)[0])
    return TrueCondition(
        changes=truth,
        speed_rad_s=speed_rpm * 2 * np.pi / 60,
        cutoff_hz=scenario.sources[0].cutoff_hz,
        levels=levels,
        noise=np.asarray(np.exp(level) * variance, dtype=np.float64),
        noise_colour=np.full(len(states), float(exponent)),
    )


def _measure(
    machines: dict[str, tuple[Machine, Bundle | None]], seed: int, _: None, cell: Cell, number: int
) -> list[dict[str, Value]]:
    stream, kind = cell.given
    machine, bundle = machines[str(cell.keys["machine"])]
    if kind.length_s is not None:
        machine, bundle = _with_length(machine, kind.length_s), None
    faults = kind.faults
    draw = Draw(
        machine, seed, Purpose.EVALUATION, stream, faults=faults,
        layout=kind.layout, excitation=kind.excitation, anomaly=kind.anomaly,
    )  # fmt: skip
    if kind.topic == "detectable":
        faults = _quoted(draw, number)
        draw = Draw(machine, seed, Purpose.EVALUATION, stream, faults=faults)
    scenario = draw_condition(draw, number)
    if kind.topic == "detectable":
        scenario = scenario.model_copy(update={"seed": scenario.seed ^ _OTHER_REALISATION})
    window = simulate_scenario(scenario, machine)
    known: dict[str, Value] = {
        "layout": LAYOUTS[Layout.INDEPENDENT if len(scenario.sources) > 1 else Layout.ONE_SOURCE],
        "cutoff_hz": scenario.sources[0].cutoff_hz,
        "noise": scenario.sensors.noise_relative,
        **{f"{name} true": faults.get(name, 0.0) for name in PARAMETERS},
    }
    if kind.topic in ("healthy", "length"):
        bound = cramer_rao(machine, window.states, true_condition(scenario, machine), window.duration_s)
        known |= {f"{name} bound": value for name, value in bound.items()}
    return [known | opinion(one, window) for one in diagnosticians(machine, bundle)]


def _quoted(draw: Draw, number: int) -> dict[str, float]:
    """Change of one parameter, drawn at random, that the likelihood quotes as just detectable in this condition."""
    diagnosis = LikelihoodFit(draw.machine).diagnose(simulate_scenario(draw_condition(draw, number), draw.machine))
    rng = np.random.default_rng([draw.seed, _OTHER_REALISATION, number])
    stretch = stretch_of(diagnosis, 0, 0)
    thresholds = window_thresholds(RATES[0], len(stretch.known))
    quoted = detectable_changes(stretch, thresholds, draw.machine.window.length_s)
    one = quoted[int(rng.integers(len(quoted)))]
    # A loss of everything, quoted where not even that would be found for certain, cannot be simulated.
    return {one.name: one.gain if rng.random() < 0.5 or one.loss < _LARGEST_LOSS else one.loss}


def _with_length(machine: Machine, length_s: float) -> Machine:
    """The machine with another window length; the hop gives way where the window would hold fewer than four."""
    window = machine.window
    hop_s = window.hop_s if length_s >= 4 * window.hop_s else window.segment_s
    changed = {"length_s": round(length_s / hop_s) * hop_s, "hop_s": hop_s, "max_span_s": 2 * length_s}
    return machine.model_copy(update={"window": window.model_copy(update=changed)})


def _readings(records: Iterable[Record]) -> Iterator[Record]:
    """One row for every parameter of every window, refused ones too: deviation, in errors and in bounds, covered."""
    for record in records:
        named = str(record.get("named", "")).split()
        for name in PARAMETERS:
            row = {**record, "parameter": name, "is named": name in named, "true": record[f"{name} true"]}
            change, error = record.get(name), record.get(f"{name} error")
            if isinstance(change, float) and isinstance(error, float):
                off, bound = change - float(record[f"{name} true"] or 0.0), record.get(f"{name} bound")
                row |= {"off": off, "error": error, "in errors": off / error, "covered": abs(off) <= Z95 * error}
                row |= {"in bounds": off / float(bound), "bound": bound} if bound else {}
            yield row


def _column(rows: Iterable[Record], name: str) -> list[Value]:
    return [row[name] for row in rows if name in row]


def _biased(rows: Sequence[Record]) -> Estimate | None:
    found = floats(_column(rows, "in errors"))
    return resampled(lambda x: np.asarray(np.mean(x, axis=-1)), found) if len(found) > 1 else None


def _wrong(record: Record) -> bool:
    return any(not record[f"{name} true"] for name in str(record.get("named", "")).split())


def _exact(record: Record, prefix: str = "") -> bool:
    named = set(str(record.get(f"{prefix}named", "")).split())
    return named == {name for name in PARAMETERS if record[f"{name} true"]}


def _claimed(record: Record) -> bool:
    """A bearing parameter or the unbalance named without reserve."""
    return bool({*str(record.get("named", "")).split()} - {"EI"}) and not record.get("outside")


def _noticed(record: Record) -> bool:
    return bool(record.get("outside") or record.get("suspect"))


def _spread_in_bounds(method: str, rows: Sequence[Record]) -> Estimate | None:
    return spread(_column(_of(rows, method=method), "in bounds"))


_KIND = ("machine", "topic", "changed", "excitation", "anomaly", "length_s", "layout", "method")


_TABLES = (
    Table(
        "evaluate-sharpness",
        ("parameter",),
        {
            "bound, median": lambda rows: f"{100 * (median(_column(rows, 'bound')) or 0):.2g} %",
            **{f"{TITLES[by]}: spread / bound": partial(_spread_in_bounds, by) for by in ("likelihood", "network")},
            "likelihood: 95 % interval covers": lambda rows: rate(_column(_of(rows, method="likelihood"), "covered")),
        },
        lambda records: (
            row
            for row in _readings(records)
            if (row["machine"], row["topic"], row["layout"]) == ("lab", "healthy", "independent sources")
        ),
        "Sharpness on healthy windows of `lab`, independent sources:",
    ),
    Table(
        "evaluate-readings",
        (*_KIND, "parameter"),
        {
            "read": lambda rows: len(_column(rows, "off")),
            "median deviation": lambda rows: median(_column(rows, "off")),
            "bias / stated": _biased,
            "spread": lambda rows: spread(_column(rows, "off")),
            "stated, median": lambda rows: median(_column(rows, "error")),
            "spread / stated": lambda rows: spread(_column(rows, "in errors")),
            "bound, median": lambda rows: median(_column(rows, "bound")),
            "spread / bound": lambda rows: spread(_column(rows, "in bounds")),
            "covered": lambda rows: rate(_column(rows, "covered")),
            "named": lambda rows: rate(_column(rows, "is named")),
        },
        _readings,
    ),
    Table(
        "evaluate-windows",
        _KIND,
        {
            "refused": lambda rows: sum(bool(row["refused"]) for row in rows),
            "any named at 1 %": lambda rows: rate(row.get("named") for row in rows),
            "any named at 0.1 %": lambda rows: rate(row.get("strict named") for row in rows),
            "exactly the changed": lambda rows: rate(map(_exact, rows)),
            "an unchanged one": lambda rows: rate(map(_wrong, rows)),
            "called outside": lambda rows: rate(row.get("outside") for row in rows),
            "outside or a suspect": lambda rows: rate(map(_noticed, rows)),
            "bearing or unbalance claimed": lambda rows: rate(map(_claimed, rows)),
            "misfit, median": lambda rows: median(row.get("misfit") for row in rows),
            "processor time, ms": lambda rows: 1000 * (median(row["seconds"] for row in rows) or 0.0),
        },
    ),
)


_SMALL = (("k_by", -0.02), ("c_bz", -0.10), ("e", 0.10), ("c_by", -0.05), ("e", 0.05))
_NETWORK = (("k_bz", -0.05), ("c_by", -0.20), ("c_bz", -0.20), ("e", 0.20))
_READ = ("k_by", "k_bz", "c_by", "c_bz", "e")
_ONE, _SEVERAL = LAYOUTS[Layout.ONE_SOURCE], LAYOUTS[Layout.INDEPENDENT]


def _goals(records: Sequence[Record]) -> Iterator[Goal]:
    """The declared goals; what asked for more than the bound allows is held to what a reading at the bound finds."""
    rows = list(_readings(records))
    lab = _of(rows, machine="lab")
    asked = [by for by in ("likelihood", "network") if _of(records, method=by)]
    if lab:
        yield from _detection(lab, "network" in asked)
        yield from _sets(_of(records, machine="lab", topic="paper"), asked)
    yield from _sharpness(rows)
    for by in asked:
        yield from _errors(_of(records, method=by), _of(rows, method=by), by)
    if lab:
        yield from _strained(lab)
        outside = grouped(_of(records, machine="lab", topic="outside", method="likelihood"), "anomaly")
        claimed = {str(anomaly): rate(map(_claimed, found)) for (anomaly,), found in outside.items()}
        yield within("likelihood: outside the model, bearing or unbalance claimed all the same", claimed, 0.0, 0.05)
        seen = [f"{anomaly} {rate(map(_noticed, found))}" for (anomaly,), found in outside.items()]
        yield Goal("likelihood: called outside the model, or a suspect named", "", "; ".join(seen), "–")


def _detection(lab: Sequence[Record], networks: bool) -> Iterator[Goal]:
    for name, true in _SMALL:
        possible = _found_at_bound(lab, _SEVERAL, name, true)
        if possible is not None:
            found = _found(lab, "likelihood", _SEVERAL, name, true)
            declared = f"≥ {100 * possible:.1f} %, as at the bound"
            yield at_least(f"likelihood: {name} {true:+.0%} detected, {_SEVERAL}", found, possible, declared)
    one = {f"{name} {true:+.0%}": _found(lab, "likelihood", _ONE, name, true) for name, true in _SMALL}
    yield within(f"likelihood: the same changes, {_ONE}", one, 0.99, 1.0)
    for layout in (_SEVERAL, _ONE) if networks else ():
        rates = {f"{name} {true:+.0%}": _found(lab, "network", layout, name, true) for name, true in _NETWORK}
        yield within(f"network: k −5 %, c −20 %, e +20 % detected, {layout}", rates, 0.99, 1.0)


def _sets(paper: Sequence[Record], asked: Sequence[str]) -> Iterator[Goal]:
    for by in asked:
        exact = {
            str(layout): rate(map(_exact, found))
            for (layout,), found in grouped(_of(paper, method=by), "layout").items()
        }
        least = 0.99 if by == "likelihood" else 0.95
        yield within(f"{by}: exactly the changed ones named, the paper's eight conditions", exact, least, 1.0)
    wrong = rate(map(_wrong, _of(paper, method="likelihood")))
    yield at_most("likelihood: an unchanged one named, the paper's eight conditions", wrong, 0.005)


def _sharpness(rows: Sequence[Record]) -> Iterator[Goal]:
    healthy = _of(rows, topic="healthy")
    for machine, by, layout, names, column, most in (
        ("lab", "likelihood", _SEVERAL, _READ, "in bounds", 1.15),
        ("lab", "network", _SEVERAL, ("k_by", "k_bz"), "in bounds", 2.0),
        ("lab", "network", _SEVERAL, ("c_by", "c_bz"), "in bounds", 1.5),
        ("light", "likelihood", _SEVERAL, _READ, "in bounds", 1.3),
        ("lab", "likelihood", _ONE, ("k_by", "k_bz"), "off", 0.0008),
        ("lab", "likelihood", _ONE, ("c_by", "c_bz"), "off", 0.003),
    ):
        own = _of(healthy, machine=machine, method=by, layout=layout)
        spreads = {name: spread(_column(_of(own, parameter=name), column)) for name in names}
        over = " over the bound" if column == "in bounds" else ""
        if own:
            yield within(f"{by}: spread{over}, {layout}, {machine}", spreads, 0.0, most)


def _errors(records: Sequence[Record], rows: Sequence[Record], by: str) -> Iterator[Goal]:
    """False alarms, and the coverage of the intervals, on every machine."""
    for prefix, declared in zip(("", "strict "), RATES, strict=True):
        alarms = {
            str(machine): rate(record.get(f"{prefix}named") for record in found)
            for (machine,), found in grouped(_of(records, topic="healthy"), "machine").items()
        }
        yield _holding(f"{by}: false alarms of healthy windows", alarms, declared)
    for text, topics in (("healthy", ("healthy",)), ("changed", ("small", "paper"))):
        groups = grouped((row for row in rows if row["topic"] in topics), "parameter", "machine", "layout")
        covered = {", ".join(map(str, key)): rate(_column(found, "covered")) for key, found in groups.items()}
        yield within(f"{by}: 95 % intervals cover, {text} windows", covered, 0.93, 0.97)


def _strained(lab: Sequence[Record]) -> Iterator[Goal]:
    """The likelihood at the quoted minimum detectable change, under other excitations, in windows of other lengths."""
    power = [row["is named"] for row in _of(lab, topic="detectable", method="likelihood") if row["true"]]
    yield within("likelihood: found at the quoted minimum detectable change", {"all": rate(power)}, 0.92, 0.98)
    untold = [row for row in _of(lab, topic="excitation", method="likelihood") if row["parameter"] != "EI"]
    groups = grouped(untold, "parameter", "excitation", "layout").items()
    named = {", ".join(map(str, key)): found for key, found in groups}
    for what, figures, low, high in (
        ("95 % intervals cover", {key: rate(_column(found, "covered")) for key, found in named.items()}, 0.93, 0.97),
        ("bias / stated error", {key: _biased(found) for key, found in named.items()}, -0.5, 0.5),
        ("spread / stated error", {key: spread(_column(f, "in errors")) for key, f in named.items()}, 0.0, 1.5),
    ):
        yield within(f"likelihood: {what}, another excitation than assumed", figures, low, high)
    exponents = {f"{name}, {layout}": _exponent(lab, name, layout) for layout in (_SEVERAL, _ONE) for name in _READ}
    yield within("likelihood: exponent of the window length in the spread", exponents, -0.6, -0.4)


def _of(rows: Iterable[Record], **wanted: Value) -> list[Record]:
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def _found(rows: Iterable[Record], by: str, layout: str, name: str, true: float) -> Estimate | None:
    """Windows in which a change is named; alone, where that was measured: beside another it needs stronger evidence."""
    same = [
        r for r in _of(rows, method=by, layout=layout, parameter=name, true=true) if r["topic"] in ("small", "paper")
    ]
    alone = [r for r in same if sum(bool(r[f"{other} true"]) for other in PARAMETERS) == 1]
    return rate(r["is named"] for r in (alone or [r for r in same if r["topic"] == "small"]))


def _found_at_bound(rows: Iterable[Record], layout: str, name: str, true: float) -> float | None:
    """Share of windows in which a normal reading with the bound's standard error would cross the same threshold.

    Over the conditions of the healthy windows, which are drawn as those of the changed ones are.
    """
    healthy = _of(rows, method="likelihood", layout=layout, parameter=name, topic="healthy")
    bounds = floats(_column(healthy, "bound"))
    if not bounds.size:
        return None
    threshold = window_thresholds(RATES[0], len(PARAMETERS)).first
    z = abs(to_scale(name, true)) / bounds
    return float(np.mean(ndtr(z - threshold) + ndtr(-z - threshold)))


def _holding(what: str, rates: dict[str, Estimate | None], declared: float) -> Goal:
    """Goal of rates whose intervals should hold the declared one."""
    found = {name: one for name, one in rates.items() if one is not None}
    met = all(one.low <= declared <= one.high for one in found.values())
    text = "; ".join(f"{name} {one}" for name, one in found.items())
    return Goal(what, f"{100 * declared:g} % inside", text or "–", ("met" if met else "missed") if found else "–")


def _exponent(rows: Iterable[Record], name: str, layout: str) -> Estimate | None:
    """Exponent of the window length in the spread.

    Fitted to the spread over the bound, which is itself proportional to 1/√T, so that windows of different conditions
    can be compared. None with fewer than three lengths.
    """
    own = (r for r in _of(rows, method="likelihood", layout=layout, parameter=name) if "bound" in r)
    points = {length: spread(_column(found, "in bounds")) for (length,), found in grouped(own, "length_s").items()}
    known = [(float(length or 0), one) for length, one in points.items() if one is not None and one.low > 0]
    if len(known) < 3:
        return None
    x, y = np.log([length for length, _ in known]), np.log([one.value for _, one in known])
    weight = np.array([(2 * Z95 / np.log(one.high / one.low)) ** 2 for _, one in known])
    x = x - np.average(x, weights=weight)
    precision = float(np.sum(weight * x**2))
    slope, half = float(np.sum(weight * x * y)) / precision - 0.5, Z95 / precision**0.5
    return Estimate(slope, slope - half, slope + half, sum(one.n for _, one in known))


def _charts(records: Sequence[Record]) -> Iterator[Chart]:
    """What is named over the size of the change, and what would be named at the bound."""
    lab = list(_readings(_of(records, machine="lab")))
    panels: dict[str, dict[str, list[tuple[str | float, Estimate | float]]]] = {}
    for layout in (_SEVERAL, _ONE):
        panel = panels.setdefault(layout, {})
        for name, true in (*_SMALL, *_NETWORK):
            label = f"{name} {true:+.0%}"
            for by, title in TITLES.items():
                found = _found(lab, by, layout, name, true)
                if found is not None:
                    panel.setdefault(title, []).append((label, found))
            possible = _found_at_bound(lab, layout, name, true)
            if possible is not None:
                panel.setdefault("at the Cramér–Rao bound", []).append((label, possible))
    yield Chart(
        "results-detection", "Windows of lab in which a change is named at 1 % false alarms, 95 % intervals",
        panels, "true change", "share of windows",
    )  # fmt: skip


def evaluate(options: Options) -> Study:
    """Healthy, changed and foreign machines in conditions drawn at random."""
    names = options.machines or ("lab", "heavy", "light")
    machines: dict[str, tuple[Machine, Bundle | None]] = {}
    for name in names:
        machine = load_machine(name)
        machines[machine.name] = (machine, None if name == "light" else load_bundle(name, machine))
    cells = tuple(
        Cell(
            {
                "machine": machine.name,
                "topic": kind.topic,
                "changed": "one, as quoted" if kind.topic == "detectable" else changed_in(kind.faults),
                "force": LAYOUTS[kind.layout],
                "excitation": _EXCITATIONS[kind.excitation],
                "anomaly": _ANOMALIES[kind.anomaly],
                "length_s": kind.length_s or machine.window.length_s,
            },
            max(2, round(options.windows * kind.share * (1.0 if machine.name in _WHOLE else 0.32))),
            (stream, kind),
        )
        for machine, _ in machines.values()
        for stream, kind in enumerate(_kinds(whole=machine.name in _WHOLE))
    )
    return Study(
        name="evaluate",
        cells=cells,
        measure=partial(_measure, machines, options.seed),
        tables=_TABLES,
        goals=_goals,
        charts=_charts,
        made_with={name: f"{one.physics_hash} {two.identity if two else ''}" for name, (one, two) in machines.items()},
    )
