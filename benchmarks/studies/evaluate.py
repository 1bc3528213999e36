"""Spread of the readings, coverage of their intervals, parameters named, and false alarms."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.special import ndtr

from benchmarks.studies.methods.bound import bound_of
from benchmarks.studies.reporting import opinions as o
from benchmarks.studies.reporting import results as r
from benchmarks.studies.reporting.results import Chart, Estimate, Goal, Record, Table, Value
from benchmarks.studies.reporting.study import Cell, Options, Study
from benchmarks.studies.subjects.unusual import Anomaly, Excitation, UnusualDraw
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.readings import Z95
from models.diagnosis.verdict.calibration import detectable_changes, window_thresholds
from models.diagnosis.verdict.stretch import slope, stretch_of, to_scale
from models.machine import Machine, load_machine
from models.physics.rotor import PARAMETERS
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, simulate_scenario

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
"""The paper's eight fault conditions (its Table 2, as far as section 4.2 describes it), in physical parameters."""
_LARGE = {name: 0.2 if name == "e" else -0.2 for name in PARAMETERS}
_TOGETHER = ({"k_by": -0.02, "c_bz": -0.10, "e": 0.10}, {"k_bz": -0.05, "c_by": -0.05, "e": 0.05})
_ALONE = ({"k_by": -0.02}, {"c_bz": -0.10}, {"e": 0.10}, {"c_by": -0.05}, {"e": 0.05}, {"k_bz": -0.05})
_LENGTHS_S = {15.0: 0.2, 30.0: 0.2, 120.0: 0.1, 300.0: 0.06, 600.0: 0.04}
"""Window lengths with their share of windows: a ten-minute window costs as much as forty of 15 s."""
_WHOLE = ("lab",)  # machines with all topics; the others only have healthy windows and small changes
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
    """Kinds of windows that are drawn; the index in this order is part of the seed."""
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


def _measure(trained: o.Trained, seed: int, stream: int, kind: _Kind, _: None, number: int) -> list[dict[str, Value]]:
    if kind.length_s is not None:
        trained = o.Trained(_with_length(trained.machine, kind.length_s), None)
    machine, faults = trained.machine, kind.faults
    draw = UnusualDraw(
        machine, seed, Purpose.EVALUATION, stream, faults=faults,
        layout=kind.layout, excitation=kind.excitation, anomaly=kind.anomaly,
    )  # fmt: skip
    if kind.topic == "detectable":
        faults = _quoted(draw, number)
        draw = replace(draw, faults=faults)
    scenario = draw_condition(draw, number)
    if kind.topic == "detectable":
        scenario = scenario.model_copy(update={"seed": scenario.seed ^ _OTHER_REALISATION})
    window = simulate_scenario(scenario, machine)
    known: dict[str, Value] = {
        "layout": o.LAYOUTS[Layout.INDEPENDENT if len(scenario.sources) > 1 else Layout.ONE_SOURCE],
        "cutoff_hz": scenario.sources[0].cutoff_hz,
        "noise": scenario.sensors.noise_relative,
        **o.truth(faults),
    }
    if kind.topic in ("healthy", "length", "small", "paper"):
        known |= {f"{name} bound": value for name, value in bound_of(scenario, machine).items()}
    return [known | o.opinion(one, window) for one in trained.diagnosticians()]


def _quoted(draw: Draw, number: int) -> dict[str, float]:
    """Minimum detectable change of a random parameter, as stated by the likelihood in this condition."""
    diagnosis = LikelihoodFit(draw.machine).diagnose(simulate_scenario(draw_condition(draw, number), draw.machine))
    rng = np.random.default_rng([draw.seed, _OTHER_REALISATION, number])
    stretch = stretch_of(diagnosis, 0, 0)
    thresholds = window_thresholds(o.RATES[0], len(stretch.known))
    quoted = detectable_changes(stretch, thresholds, draw.machine.window.length_s)
    one = quoted[int(rng.integers(len(quoted)))]
    # A total loss, stated if not even that would be found with certainty, cannot be simulated.
    return {one.name: one.gain if rng.random() < 0.5 or one.loss < _LARGEST_LOSS else one.loss}


def _with_length(machine: Machine, length_s: float) -> Machine:
    """The machine with another window length; the hop is shortened if the window would hold fewer than four."""
    window = machine.window
    hop_s = window.hop_s if length_s >= 4 * window.hop_s else window.segment_s
    changed = {"length_s": round(length_s / hop_s) * hop_s, "hop_s": hop_s, "max_span_s": 2 * length_s}
    return machine.model_copy(update={"window": window.model_copy(update=changed)})


_KIND = ("machine", "topic", "changed", "excitation", "anomaly", "length_s", "layout", "method")
_TABLES = (
    Table(
        "evaluate-sharpness",
        ("parameter",),
        {
            "bound, median": lambda rows: f"{100 * (r.middle('bound')(rows) or 0):.2g} %",
            **{
                f"{o.TITLES[by]}: {text}": r.among(o.READING_COLUMNS[name], method=by)
                for text, name in (("spread / bound", "spread / bound"), ("95 % covers", "covered"))
                for by in ("likelihood", "network")
            },
        },
        lambda records: o.readings(r.where(records, machine="lab", topic="healthy", layout=o.SEVERAL)),
        "Sharpness on healthy windows of `lab`, independent sources:",
    ),
    Table("evaluate-readings", (*_KIND, "parameter"), o.READING_COLUMNS, o.readings),
    Table(
        "evaluate-windows",
        _KIND,
        {
            "refused": lambda rows: sum(bool(row["refused"]) for row in rows),
            "any named at 1 %": r.share("any"),
            "any named at 0.1 %": r.share("strict any"),
            "exactly the changed": r.share("exact"),
            "an unchanged one": r.share("wrong"),
            "called outside": r.share("outside"),
            "outside or a suspect": r.share("noticed"),
            "bearing or unbalance claimed": r.share("claimed"),
            "misfit, median": r.middle("misfit"),
            "processor time, s": r.middle("seconds"),
        },
        o.judged,
    ),
)

_SMALL = (("k_by", -0.02), ("c_bz", -0.10), ("e", 0.10), ("c_by", -0.05), ("e", 0.05))
_NETWORK = (("k_bz", -0.05), ("c_by", -0.20), ("c_bz", -0.20), ("e", 0.20))
_READ = ("k_by", "k_bz", "c_by", "c_bz", "e")


def _goals(records: Sequence[Record]) -> Iterator[Goal]:
    """The declared goals; those beyond the Cramér-Rao bound are replaced by the rate of a reading at the bound."""
    rows, windows = list(o.readings(records)), list(o.judged(records))
    asked = [by for by in ("likelihood", "network") if r.where(records, method=by)]
    lab, whole = r.where(rows, machine="lab"), r.where(windows, machine="lab")
    if lab:
        yield from _detection(lab, asked)
        for by in asked:
            least, exact = (0.99 if by == "likelihood" else 0.95), r.where(whole, topic="paper", method=by)
            yield r.within(f"{by}: exactly the changed ones named, paper's eight conditions",
                         r.each(exact, ("layout",), r.share("exact")), least, 1.0)  # fmt: skip
        wrong = r.share("wrong")(r.where(whole, topic="paper", method="likelihood"))
        yield r.at_most("likelihood: an unchanged one named, paper's eight conditions", wrong, 0.005)
    for machine, by, layout, names, column, most in (
        ("lab", "likelihood", o.SEVERAL, _READ, "in bounds", 1.15),
        ("lab", "network", o.SEVERAL, ("k_by", "k_bz"), "in bounds", 2.0),
        ("lab", "network", o.SEVERAL, ("c_by", "c_bz"), "in bounds", 1.5),
        ("light", "likelihood", o.SEVERAL, _READ, "in bounds", 1.3),
        ("lab", "likelihood", o.ONE, ("k_by", "k_bz"), "off %", 0.08),
        ("lab", "likelihood", o.ONE, ("c_by", "c_bz"), "off %", 0.3),
    ):
        own = r.where(rows, topic="healthy", machine=machine, method=by, layout=layout)
        spreads = r.each(r.where(own, parameter=names), ("parameter",), r.scatter(column))
        over = " over the bound" if column == "in bounds" else " in %"
        of = "" if names == _READ else f" of {', '.join(names)}"
        if own:
            yield r.within(f"{by}: spread{of}{over}, {layout}, {machine}", spreads, 0.0, most)
    for by in asked:
        yield from o.false_alarms(by, r.where(windows, topic="healthy", method=by), ("machine",))
        for text, topics in (("healthy", ("healthy",)), ("changed", ("small", "paper"))):
            own = r.where(rows, method=by, topic=topics)
            covered = r.each(own, ("parameter", "machine", "layout"), r.share("covered"))
            yield r.within(f"{by}: 95 % intervals cover, {text} windows", covered, 0.93, 0.97)
    if lab:
        yield from _strained(lab)
        outside = r.where(whole, topic="outside", method="likelihood")
        claimed = r.each(outside, ("anomaly",), r.share("claimed"))
        yield r.within("likelihood: outside the model, bearing or unbalance claimed all the same", claimed, 0.0, 0.05)
        seen = "; ".join(f"{name} {one}" for name, one in r.each(outside, ("anomaly",), r.share("noticed")).items())
        yield Goal("likelihood: called outside the model, or a suspect named", "", seen, "–")


def _detection(lab: Sequence[Record], asked: Sequence[str]) -> Iterator[Goal]:
    named = r.share("is named")
    for name, true in _SMALL:
        windows = _changed(lab, "likelihood", o.SEVERAL, name, true)
        found, possible = named(windows), _found_at_bound(windows, name, true)
        if possible is None:
            continue
        declared = f"≥ {100 * possible:.1f} %, as at the bound"
        yield r.at_least(f"likelihood: {name} {true:+.0%} detected, {o.SEVERAL}", found, possible, declared)
    one = {f"{name} {true:+.0%}": named(_changed(lab, "likelihood", o.ONE, name, true)) for name, true in _SMALL}
    yield r.within(f"likelihood: the same changes, {o.ONE}", one, 0.99, 1.0)
    for layout in (o.SEVERAL, o.ONE) if "network" in asked else ():
        rates = {f"{name} {true:+.0%}": named(_changed(lab, "network", layout, name, true)) for name, true in _NETWORK}
        yield r.within(f"network: k −5 %, c −20 %, e +20 % detected, {layout}", rates, 0.99, 1.0)


def _strained(lab: Sequence[Record]) -> Iterator[Goal]:
    """Goals for the likelihood at the stated minimum detectable change, under other excitations and window lengths."""
    own = r.where(lab, method="likelihood")
    power = r.rate(row["is named"] for row in r.where(own, topic="detectable") if row["true"])
    yield r.within("likelihood: found at the quoted minimum detectable change", {"all": power}, 0.92, 0.98)
    untold = r.where(own, topic="excitation", parameter=_READ)
    for what, figure, low, high in (
        ("95 % intervals cover", r.share("covered"), 0.93, 0.97),
        ("bias / stated error", o.BIAS, -0.5, 0.5),
        ("spread / stated error", r.scatter("in errors"), 0.0, 1.5),
    ):
        figures = r.each(untold, ("parameter", "excitation", "layout"), figure)
        yield r.within(f"likelihood: {what}, another excitation than assumed", figures, low, high)
    lengths = [row for row in r.where(own, parameter=_READ, topic=("healthy", "length")) if "bound" in row]
    exponents = r.each(lengths, ("parameter", "layout"), _exponent)
    yield r.within("likelihood: exponent of the window length in the spread", exponents, -0.6, -0.4)


def _changed(rows: Iterable[Record], by: str, layout: str, name: str, true: float) -> list[Record]:
    """Readings of a change; of windows without other changes if measured, because several need stronger evidence."""
    same = r.where(rows, method=by, layout=layout, parameter=name, true=true, topic=("small", "paper"))
    alone = [row for row in same if sum(bool(row[f"{other} true"]) for other in PARAMETERS) == 1]
    return alone or r.where(same, topic="small")


def _found_at_bound(windows: Sequence[Record], name: str, true: float) -> float | None:
    """Fraction of windows in which a normally distributed reading at the bound exceeds the threshold; None without any.

    The bound is that of the changed machine in each window's own condition.
    """
    if not windows:
        return None
    threshold = window_thresholds(o.RATES[0], len(PARAMETERS)).first
    scaled = to_scale(name, true)
    z = abs(scaled) * slope(name, scaled) / r.floats(row.get("bound") for row in windows)
    return float(np.mean(ndtr(z - threshold) + ndtr(-z - threshold)))


def _exponent(rows: Sequence[Record]) -> Estimate | None:
    """Exponent of the window length in the spread; None with fewer than three lengths.

    It is fitted to the spread over the bound, which is itself proportional to 1/√T, so that windows of different
    conditions can be compared.
    """
    points = {float(length): one for length, one in r.each(rows, ("length_s",), r.scatter("in bounds")).items() if one}
    known = {length: one for length, one in points.items() if one.low > 0}
    if len(known) < 3:
        return None
    x, y = np.log(list(known)), np.log([one.value for one in known.values()])
    weight = np.array([(2 * Z95 / np.log(one.high / one.low)) ** 2 for one in known.values()])
    x = x - np.average(x, weights=weight)
    precision = float(np.sum(weight * x**2))
    slope, half = float(np.sum(weight * x * y)) / precision - 0.5, Z95 / precision**0.5
    return Estimate(slope, slope - half, slope + half, len(rows))


def _charts(records: Sequence[Record]) -> Iterator[Chart]:
    """Fraction of windows in which a change is named, by its size, and the fraction expected at the bound."""
    lab = list(o.readings(r.where(records, machine="lab")))
    if not lab:
        return
    at_bound = "at the Cramér–Rao bound"
    panels = r.panels(
        (layout, title, [(f"{name} {true:+.0%}", one)])
        for layout in (o.SEVERAL, o.ONE)
        for name, true in (*_SMALL, *_NETWORK)
        for title, one in (
            *((title, r.share("is named")(_changed(lab, by, layout, name, true))) for by, title in o.TITLES.items()),
            (at_bound, _found_at_bound(_changed(lab, "likelihood", layout, name, true), name, true)),
        )
        if one is not None
    )
    text = "Windows of lab in which a change is named at 1 % false alarms, with 95 % intervals"
    yield Chart("results-detection", text, panels, "true change", "share of windows")


def evaluate(options: Options) -> Study:
    """Healthy, changed and foreign machines in conditions drawn at random."""
    machines: dict[str, o.Trained] = {}
    for name in options.machines or ("lab", "heavy", "light"):
        one = o.Trained(load_machine(name), None) if name == "light" else o.Trained.named(name)
        machines[one.machine.name] = one
    cells = tuple(
        Cell(
            {
                "machine": name,
                "topic": kind.topic,
                "changed": "one, as quoted" if kind.topic == "detectable" else o.changed_in(kind.faults),
                "force": o.LAYOUTS[kind.layout],
                "excitation": _EXCITATIONS[kind.excitation],
                "anomaly": _ANOMALIES[kind.anomaly],
                "length_s": kind.length_s or one.machine.window.length_s,
            },
            max(2, round(options.windows * kind.share * (1.0 if name in _WHOLE else 0.32))),
            partial(_measure, one, options.seed, stream, kind),
        )
        for name, one in machines.items()
        for stream, kind in enumerate(_kinds(whole=name in _WHOLE))
    )
    return Study(
        name="evaluate",
        cells=cells,
        tables=_TABLES,
        goals=_goals,
        charts=_charts,
        made_with=o.made_with(machines.values()),
    )
