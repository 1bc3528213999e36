"""Compares the diagnosticians with alternative methods on the same windows.

In the setting *laboratory* only the realisation varies; in *varying* every window has its own condition. A change only
alters the machine: force and noise are drawn for the healthy one.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks.studies.methods.other_methods import FeatureVector, SubspaceModes
from benchmarks.studies.methods.paper import PAPER_EQUATIONS, PaperDiagnostician, train_paper_network
from benchmarks.studies.reporting import results as r
from benchmarks.studies.reporting.opinions import TITLES, Trained, changed_in, made_with, named_in, opinion
from benchmarks.studies.reporting.results import Chart, Goal, Record, Table, Value
from benchmarks.studies.reporting.study import Cell, Options, Over, Study
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine
from models.signals.block import FloatArray
from simulator.scenario import Event
from simulator.stream import blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition

_BLOCK_S = 5.0
_APART = 1_000_000  # offset between window numbers of learning, limits and each cell in the laboratory setting
_SETTINGS = ("laboratory", "varying")
_CHANGES: tuple[dict[str, float], ...] = (
    {},
    *({name: sign * size} for name, sign in (("k_by", -1), ("c_by", -1), ("e", 1)) for size in (0.05, 0.1, 0.2)),
)
"""Healthy, and bearing stiffness, bearing damping and unbalance changed by 5, 10 and 20 %."""


_Series = tuple[str, int, dict[str, float]]
"""Setting, purpose (0 for learning, 1 for the limits, 2 and up for the cells), true changes."""


@dataclass(frozen=True, slots=True)
class _Learned:
    """Methods fitted to healthy windows of one setting, and their limits."""

    peers: tuple[SubspaceModes | FeatureVector, ...]
    limits: tuple[float, ...]
    paper: PaperDiagnostician


def _methods(machine: Machine) -> tuple[SubspaceModes | FeatureVector, ...]:
    return SubspaceModes(machine), FeatureVector(machine)


def _simulate(machine: Machine, seed: int, series: _Series, number: int) -> tuple[FloatArray, WindowStatistics]:
    """SI samples and statistics of one window."""
    setting, at, faults = series
    if setting == "laboratory":
        draw = Draw(machine, seed, Purpose.EVALUATION, layout=Layout.ONE_SOURCE, fixed_condition=True)
        number += at * _APART
    else:
        purpose = (Purpose.TRAINING, Purpose.CALIBRATION, Purpose.EVALUATION)[min(at, 2)]
        draw = Draw(machine, seed, purpose, at)
    events = [Event(at_s=0, parameter=name, relative_change=change) for name, change in faults.items()]
    scenario = draw_condition(draw, number).overridden(faults=events)
    sizes = plan_for(machine)
    parts = [(sizes.to_si(block.samples), block.start_ns) for block, _ in blocks(scenario, machine, block_s=_BLOCK_S)]
    samples, statistics = np.concatenate([part for part, _ in parts]), SlidingWindow(sizes)
    for _ in statistics.feed(samples, parts[0][1]):
        pass
    window = statistics.statistics()
    assert window is not None  # noqa: S101  # the drawn scenario lasts one window by construction
    return samples, window


def _looked(machine: Machine, seed: int, job: tuple[_Series, int]) -> tuple[tuple[FloatArray, ...], WindowStatistics]:
    """Features for every other method, and statistics without hops and spectra, which printed networks do not use."""
    samples, window = _simulate(machine, seed, *job)
    kept = replace(
        window,
        hop_correlation=window.hop_correlation[:0],
        spectrum=window.spectrum[:0],
        frequencies_hz=window.frequencies_hz[:0],
    )
    return tuple(peer.features(samples) for peer in _methods(machine)), kept


def _learn(machine: Machine, options: Options, over: Over) -> Mapping[str, _Learned]:
    """Fit the methods in both settings, with as many healthy windows for the limits as for learning."""
    count = 19 if options.small else 199
    found = {}
    for setting in _SETTINGS:
        look = partial(_looked, machine, options.seed)
        fit, limit = (
            over(f"{setting}, {label}", look, [((setting, at, {}), number) for number in range(count)])
            for at, label in enumerate(("healthy to learn", "healthy for the limits"))
        )
        methods, limits = _methods(machine), []
        for n, peer in enumerate(methods):
            peer.fit(np.stack([features[n] for features, _ in fit]))
            limits.append(r.limit_of(np.array([peer.score(features[n]) for features, _ in limit]), options.rate))
        windows = [window for _, window in fit]
        networks = [
            train_paper_network(equation, windows, machine, options.seed)
            for equation in PAPER_EQUATIONS
            if equation.measured_in(windows[0])
        ]
        paper = PaperDiagnostician.calibrated(networks, [window for _, window in limit], options.rate)
        found[setting] = _Learned(methods, tuple(limits), paper)
    return found


def _measure(
    trained: Trained, options: Options, series: _Series, learned: Mapping[str, _Learned], number: int
) -> list[dict[str, Value]]:
    own = learned[series[0]]
    samples, window = _simulate(trained.machine, options.seed, series, number)
    rows: list[dict[str, Value]] = []
    for peer, limit in zip(own.peers, own.limits, strict=True):
        score = peer.score(peer.features(samples))
        judged = bool(np.isfinite(score))
        rows.append(
            {"method": peer.name, "score": score if judged else None, "detected": score > limit, "refused": not judged}
        )
    equations = {equation.number for equation in PAPER_EQUATIONS if set(equation.parameters) & set(series[2])}
    flagged = own.paper.flagged(own.paper.deviations(window))
    said: list[dict[str, Value]] = [{"method": "paper", "named": " ".join(flagged), "refused": ""}]
    said += [opinion(one, window, (options.rate,)) for one in trained.diagnosticians()]
    for one in said:
        named, true = named_in(one), equations if one["method"] == "paper" else set(series[2])
        row: dict[str, Value] = {"method": one["method"], "named": one.get("named") or "", "detected": bool(named)}
        rows.append(row | {"exact": not one["refused"] and named == true, "refused": bool(one["refused"])})
    return rows


_HEADS = {"SSI-cov": "SSI-cov", "features": "features, T²", **TITLES}


def _short(method: str, rows: Sequence[Record]) -> str:
    """Per cent of windows detected and, if the method names changes, of those named exactly."""
    figures = [r.share(column)(r.where(rows, method=method)) for column in ("detected", "exact")]
    return " / ".join(f"{100 * one.value:.0f}" for one in figures if one is not None)


_TABLES = (
    Table(
        "peers",
        ("setting", "changed", "method"),
        {"detected": r.share("detected"), "exactly named": r.share("exact"), "refused": r.share("refused")},
    ),
    Table(
        "peers-short",
        ("setting", "changed"),
        {head: partial(_short, name) for name, head in _HEADS.items()},
        page="Per cent of windows in which something is said to have changed / exactly the right parameters (printed "
        "networks: equations) are named:",
    ),
)


def _goals(records: Sequence[Record]) -> Iterator[Goal]:
    """The goal that no other method detects a change significantly more often than the likelihood."""
    lost = []
    changed = [row for row in records if row["changed"] != "healthy"]
    for (setting, change), rows in r.grouped(changed, "setting", "changed").items():
        shares = r.each(rows, ("method",), r.share("detected"))
        own = shares["likelihood"]
        for name in ("SSI-cov", "features", "paper"):
            other = shares[name]
            if own is not None and other is not None and other.low > own.high:
                lost.append(f"{setting}, {change}: {_HEADS[name]} {other}, likelihood {own}")
    what = "another method notices a change more often than the likelihood (intervals apart)"
    yield Goal(what, "nowhere", "; ".join(lost) or "nowhere", "missed" if lost else "met")


def _charts(records: Sequence[Record]) -> Iterator[Chart]:
    panels = r.panels(
        (f"{setting}: {title}", _HEADS[str(method)], [(str(changed), found)])
        for (setting, changed, method), rows in r.grouped(records, "setting", "changed", "method").items()
        for column, title in (("detected", "something changed"), ("exact", "exactly the right set"))
        if (found := r.share(column)(rows)) is not None
    )
    text = "Every method on the same windows, with 95 % intervals"
    yield Chart("peers", text, panels, "true change", "share of windows")


def peers(options: Options) -> Study:
    """Comparison with operational modal analysis, a feature vector and the networks as printed."""
    trained = Trained.named(options.machine)
    changes = (_CHANGES[0], _CHANGES[3], _CHANGES[6]) if options.small else _CHANGES
    cells = tuple(
        Cell(
            {"setting": setting, "changed": changed_in(faults)},
            options.windows,
            partial(_measure, trained, options, (setting, at + 2, faults)),
        )
        for setting in _SETTINGS
        for at, faults in enumerate(changes)
    )
    return Study(
        name="peers",
        cells=cells,
        learn=partial(_learn, trained.machine, options),
        tables=_TABLES,
        goals=_goals,
        charts=_charts,
        made_with=made_with([trained]),
    )
