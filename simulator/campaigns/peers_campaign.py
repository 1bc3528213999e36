"""The diagnosticians and the methods a user would otherwise pick, on the same windows.

Two settings: in the laboratory nothing varies but the realisation, in the varying setting every window has a condition
of its own. A change alters the machine and nothing else: force and noise are drawn for the healthy one.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from models.diagnosis.moments import plan_for
from models.diagnosis.networks.bundle import Bundle
from models.diagnosis.networks.paper import PAPER_EQUATIONS, PaperDiagnostician, calibrate_paper
from models.diagnosis.networks.paper_training import train_paper_network
from models.diagnosis.window import SlidingWindow, WindowStatistics
from models.machine import Machine
from models.signals.block import FloatArray
from simulator.campaigns.opinions import diagnosticians, named_parameters, opinion_of
from simulator.campaigns.peers import FeatureVector, Peer, SubspaceModes, score_limit
from simulator.campaigns.pool import done_in
from simulator.campaigns.rates import Rate
from simulator.scenario import Event
from simulator.stream import blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition

__all__ = ["CHANGES", "SETTINGS", "Comparison", "ComparisonCell", "ComparisonPlan", "MethodRates", "Setting", "compare"]

_STRICT = ConfigDict(extra="forbid", frozen=True)
_BLOCK_S = 5.0
_APART = 1_000_000
"""Numbers of the laboratory's windows: fit, limit and every cell have a million of their own."""

Setting = Literal["laboratory", "varying"]
SETTINGS: tuple[Setting, ...] = ("laboratory", "varying")

CHANGES: tuple[dict[str, float], ...] = (
    {},
    *({name: sign * size} for name, sign in (("k_by", -1), ("c_by", -1), ("e", 1)) for size in (0.05, 0.1, 0.2)),
)
"""Healthy, and bearing stiffness, bearing damping and unbalance changed by 5, 10 and 20 %."""


class MethodRates(BaseModel):
    """How one method did in a cell.

    Attributes
    ----------
    detected : Rate
        Windows in which it says that something changed.
    exact : Rate or None
        Windows in which it names exactly what changed; None if it does not say what.
    refused : int
        Windows it could not judge; they count as not detected.
    """

    model_config = _STRICT

    detected: Rate
    exact: Rate | None
    refused: int


class ComparisonCell(BaseModel):
    """One true change in one setting."""

    model_config = _STRICT

    setting: Setting
    faults: dict[str, float]
    methods: dict[str, MethodRates]


class Comparison(BaseModel):
    """All cells, and what they were made with."""

    model_config = _STRICT

    machine: str
    bundle: str
    seed: int
    windows: int
    healthy_windows: int
    false_alarm_rate: float
    cells: tuple[ComparisonCell, ...]


@dataclass(frozen=True, slots=True)
class ComparisonPlan:
    """What to run.

    Attributes
    ----------
    machine : Machine
    bundle : Bundle
    seed : int
    windows : int
        Per cell.
    healthy_windows : int
        From which peers learn; as many again set their limits. At least 1/α - 1.
    false_alarm_rate : float
        α, declared per window for every method.
    """

    machine: Machine
    bundle: Bundle
    seed: int
    windows: int
    healthy_windows: int
    false_alarm_rate: float = 0.01


@dataclass(frozen=True, slots=True)
class _Series:
    """Windows of one purpose: 0 fit, 1 limit, 2 and up the cells."""

    setting: Setting
    number: int
    faults: dict[str, float]


@dataclass(frozen=True, slots=True)
class _Looked:
    features: tuple[FloatArray, ...]
    window: WindowStatistics
    named: dict[str, tuple[str, ...] | None]


def compare(plan: ComparisonPlan, processes: int, progress: Callable[[str, int, int], None]) -> Comparison:
    """Run both settings.

    Parameters
    ----------
    plan : ComparisonPlan
    processes : int
    progress : callable
        Called with what is being done, how much is done, and how much there is.

    Raises
    ------
    EstimationError
        If there are too few healthy windows for the declared rate.
    """
    with ProcessPoolExecutor(processes) as pool:
        cells = [cell for setting in SETTINGS for cell in _setting(plan, setting, pool, progress)]
    return Comparison(
        machine=plan.machine.name,
        bundle=plan.bundle.identity,
        seed=plan.seed,
        windows=plan.windows,
        healthy_windows=plan.healthy_windows,
        false_alarm_rate=plan.false_alarm_rate,
        cells=tuple(cells),
    )


def _setting(
    plan: ComparisonPlan, setting: Setting, pool: ProcessPoolExecutor, progress: Callable[[str, int, int], None]
) -> list[ComparisonCell]:
    def over(label: str, series: _Series, count: int, *, judge: bool) -> list[_Looked]:
        look = partial(_look, plan, series, judge)
        return done_in(pool, look, range(count), partial(progress, f"{setting}: {label}"), chunk=2)

    machine, rate, n_healthy = plan.machine, plan.false_alarm_rate, plan.healthy_windows
    fit = over("healthy, to learn", _Series(setting, 0, {}), n_healthy, judge=False)
    limit = over("healthy, for the limits", _Series(setting, 1, {}), n_healthy, judge=False)
    peers = _peers(machine)
    limits = []
    for n, peer in enumerate(peers):
        peer.fit(np.stack([one.features[n] for one in fit]))
        limits.append(score_limit(np.array([peer.score(one.features[n]) for one in limit]), rate))
    paper = _paper(plan, [one.window for one in fit], [one.window for one in limit])
    cells = []
    for number, faults in enumerate(CHANGES):
        label = ", ".join(f"{name} {change:+.0%}" for name, change in faults.items()) or "healthy"
        looked = over(label, _Series(setting, number + 2, faults), plan.windows, judge=True)
        rates = {
            peer.name: _scored([peer.score(one.features[n]) for one in looked], limits[n])
            for n, peer in enumerate(peers)
        }
        own = {equation.number for equation in PAPER_EQUATIONS if set(equation.parameters) & set(faults)}
        flagged = [paper.flagged_equations(paper.diagnose(one.window)) for one in looked]
        rates["paper"] = _named(flagged, own)
        for by in looked[0].named:
            rates[by] = _named([one.named[by] for one in looked], set(faults))
        cells.append(ComparisonCell(setting=setting, faults=faults, methods=rates))
    return cells


def _peers(machine: Machine) -> tuple[Peer, ...]:
    return SubspaceModes(machine), FeatureVector(machine)


def _paper(plan: ComparisonPlan, fit: list[WindowStatistics], limit: list[WindowStatistics]) -> PaperDiagnostician:
    """The printed networks whose channels the machine has, learned from the same healthy windows as the peers."""
    machine = plan.machine
    measured = {*fit[0].states, *(() if fit[0].synchronous is None else ("theta",))}
    networks = [
        train_paper_network(equation, fit, machine, plan.seed)
        for equation in PAPER_EQUATIONS
        if set(equation.channels) <= measured
    ]
    return PaperDiagnostician(machine, networks, calibrate_paper(networks, limit, machine, plan.false_alarm_rate))


def _scored(scores: Sequence[float], limit: float) -> MethodRates:
    return MethodRates(
        detected=Rate.of_counts(sum(score > limit for score in scores), len(scores)),
        exact=None,
        refused=sum(not np.isfinite(score) for score in scores),
    )


def _named(named: Sequence[tuple[str, ...] | None], truth: set[str]) -> MethodRates:
    return MethodRates(
        detected=Rate.of_counts(sum(bool(one) for one in named), len(named)),
        exact=Rate.of_counts(sum(one is not None and set(one) == truth for one in named), len(named)),
        refused=sum(one is None for one in named),
    )


def _look(plan: ComparisonPlan, series: _Series, judge: bool, number: int) -> _Looked:
    samples, window = _simulate(plan, series, number)
    features = tuple(peer.features(samples) for peer in _peers(plan.machine))
    named = _verdicts(plan, window) if judge else {}
    # Hops and spectra are only needed by those who have looked already.
    kept = replace(
        window,
        hop_correlation=window.hop_correlation[:0],
        spectrum=window.spectrum[:0],
        frequencies_hz=window.frequencies_hz[:0],
    )
    return _Looked(features, kept, named)


def _simulate(plan: ComparisonPlan, series: _Series, number: int) -> tuple[FloatArray, WindowStatistics]:
    """SI samples and statistics of one window."""
    machine = plan.machine
    if series.setting == "laboratory":
        draw = Draw(machine, plan.seed, Purpose.EVALUATION, layout=Layout.ONE_SOURCE, fixed_condition=True)
        number += series.number * _APART
    else:
        purpose = (Purpose.TRAINING, Purpose.CALIBRATION, Purpose.EVALUATION)[min(series.number, 2)]
        draw = Draw(machine, plan.seed, purpose, series.number)
    events = [Event(at_s=0, parameter=name, relative_change=change) for name, change in series.faults.items()]
    scenario = draw_condition(draw, number).overridden(faults=events)
    sizes = plan_for(machine)
    statistics = SlidingWindow(sizes)
    parts = []
    for block, _ in blocks(scenario, machine, block_s=_BLOCK_S):
        parts.append(sizes.to_si(block.samples))
        for _ in statistics.feed(parts[-1], block.start_ns):
            pass
    window = statistics.statistics()
    if window is None:
        raise AssertionError("the drawn scenario lasts one window by construction")
    return np.concatenate(parts), window


def _verdicts(plan: ComparisonPlan, window: WindowStatistics) -> dict[str, tuple[str, ...] | None]:
    """Parameters that each diagnostician names; None where it cannot judge the window."""
    return {
        one.by: named_parameters(opinion_of(one, window), plan.false_alarm_rate)
        for one in diagnosticians(plan.machine, plan.bundle)
    }
