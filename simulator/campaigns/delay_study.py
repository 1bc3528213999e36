"""Time to detection of step changes: real streams, the same test on Gaussian hops, and the bound's time beside them.

A stream is simulated sample by sample and fed to the sliding window, the likelihood and the sequential test as the
monitor feeds them. The bound's time is the data that a test of one fixed length needs for a power of 95 % if it reads
the parameter with the Cramér-Rao standard error, which falls as 1/√T. The Gaussian hops have that standard error: what
they need beyond the bound's time is the price of looking at every hop and of the hop itself.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from pydantic import BaseModel, ConfigDict

from models.diagnosis.likelihood.bound import cramer_rao
from models.diagnosis.likelihood.lengths import LengthFits
from models.diagnosis.moments import plan_for
from models.diagnosis.readings import Diagnosis
from models.diagnosis.verdict.calibration import MONTH_S, month_thresholds
from models.diagnosis.verdict.delay import detection_delays
from models.diagnosis.verdict.determined import determined
from models.diagnosis.verdict.sequential import SequentialSettings, SequentialTest
from models.diagnosis.verdict.stretch import Stretch, stretch_of, to_scale
from models.diagnosis.window import SlidingWindow, WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from models.physics.parameters import PARAMETERS
from simulator.campaigns.evaluation import true_condition
from simulator.scenario import Event, Scenario
from simulator.stream import blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition

__all__ = [
    "CHANGES",
    "GAUSSIAN",
    "DelayCell",
    "DelayPlan",
    "DelayResult",
    "bound_time_s",
    "run_delay_study",
    "settings_for",
    "with_hop",
]

_STRICT = ConfigDict(extra="forbid", frozen=True)

CHANGES: tuple[tuple[str, float], ...] = (("k_by", -0.05), ("c_by", -0.2), ("c_by", -0.1), ("e", 0.2))
"""Steps that are timed."""

GAUSSIAN: tuple[tuple[float, tuple[int, ...]], ...] = (
    (5.0, (2, 4)),
    (5.0, (2, 4, 7)),
    (2.5, (2, 4, 7)),
    (2.5, (2, 4, 8, 14)),
)
"""Hop lengths and short stretches that are compared on Gaussian hops."""

_POWER = 1.644854
"""Normal quantile of 95 %: how far above its threshold a change must lie to be found that often."""
_HEALTHY_HOPS = 3
_BLOCK_S = 0.5
_STREAM = 40


@dataclass(frozen=True, slots=True)
class DelayPlan:
    """What to run.

    Attributes
    ----------
    machine : Machine
    seed : int
    trials : int
        Streams per change with independent sources at the machine's own hop.
    other_trials : int
        Streams per change with one source, and at the other hops.
    gaussian_trials : int
        Trials on Gaussian hops per curve.
    hops_s : tuple of float
        Hop lengths; the first one is the machine's own.
    after_s : float
        How long a stream is watched after its step.
    changes : tuple of (str, float)
    layouts : tuple of Layout
    """

    machine: Machine
    seed: int
    trials: int
    other_trials: int
    gaussian_trials: int = 200
    hops_s: tuple[float, ...] = (5.0, 2.5)
    after_s: float = 120.0
    changes: tuple[tuple[str, float], ...] = CHANGES

    @property
    def rates(self) -> dict[str, float]:
        """Declared rates of false alarms per month: the machine file's, and one that is 1 % per window length."""
        window_s = self.machine.window.length_s
        return {
            "machine file": self.machine.alarms.false_alarms_per_month,
            "1 % per window": 0.01 * MONTH_S / window_s,
        }


class DelayCell(BaseModel):
    """Delays of one change in one layout, at one hop and one declared rate.

    Attributes
    ----------
    source : str
        ``stream``, or ``bound``: Gaussian hops with the Cramér-Rao standard errors.
    short_hops : tuple of int
        Hops of the stretches shorter than the window.
    threshold_fixed, threshold : float
        Standard errors that a test of one length and this test ask for, at the same declared rate.
    detected_s, named_s : tuple of float or None
        Delay of every trial without an early alarm; None where it did not happen within `watched_s`.
    bound_fixed_s, bound_s : tuple of float
        The bound's time in the same trials' conditions, at the two thresholds; one value for Gaussian hops.
    bound_error : dict of str to float
        Median Cramér-Rao standard error of each parameter for a window in these conditions.
    early : int
        Trials with an alarm before the step, which are left out.
    wrong : int
        Trials that named, at some time, a parameter that did not change.
    """

    model_config = _STRICT

    source: str
    layout: str
    parameter: str
    change: float
    rate: str
    per_month: float
    hop_s: float
    short_hops: tuple[int, ...]
    watched_s: float
    threshold_fixed: float
    threshold: float
    detected_s: tuple[float | None, ...]
    named_s: tuple[float | None, ...]
    bound_fixed_s: tuple[float, ...]
    bound_s: tuple[float, ...]
    bound_error: dict[str, float]
    early: int
    wrong: int

    def quantile_s(self, level: float, *, named: bool = False) -> float:
        """Quantile of the delay, infinite where too few were found."""
        delays = np.array([np.inf if s is None else s for s in (self.named_s if named else self.detected_s)])
        return float(np.quantile(delays, level, method="higher")) if delays.size else np.inf

    def ratio_quantile(self, level: float, *, fixed: bool = False) -> float:
        """Quantile of each trial's delay over the bound's time in its own condition."""
        bound = np.array(self.bound_fixed_s if fixed else self.bound_s)
        delays = np.array([np.inf if s is None else s for s in self.detected_s])
        return float(np.quantile(delays / bound, level, method="higher")) if delays.size else np.inf


class DelayResult(BaseModel):
    """All cells, and what they were made with."""

    model_config = _STRICT

    machine: str
    seed: int
    trials: int
    other_trials: int
    gaussian_trials: int
    cells: tuple[DelayCell, ...]


def with_hop(machine: Machine, hop_s: float) -> Machine:
    """The machine with another hop.

    Raises
    ------
    ValueError
        If its window cannot be cut so (`models.machine.WindowSettings`).
    """
    window = type(machine.window).model_validate(machine.window.model_dump() | {"hop_s": hop_s})
    return machine.model_copy(update={"window": window})


def settings_for(machine: Machine, per_month: float, short_hops: tuple[int, ...] | None = None) -> SequentialSettings:
    """The monitor's settings of the sequential test, at another declared rate."""
    settings = SequentialSettings.for_machine(machine, per_month)
    return settings if short_hops is None else replace(settings, short_hops=short_hops)


def bound_time_s(standard_error: float, duration_s: float, parameter: str, change: float, threshold: float) -> float:
    """Data that a test of fixed length needs for a power of 95 % at the Cramér-Rao bound.

    Parameters
    ----------
    standard_error : float
        Bound of the relative change for `duration_s` of data of the unchanged machine.
    duration_s : float
    parameter : str
    change : float
        Relative change to be found.
    threshold : float
        Of the test, in standard errors.
    """
    return duration_s * ((threshold + _POWER) * standard_error / abs(to_scale(parameter, change))) ** 2


def _thresholds(settings: SequentialSettings) -> tuple[float, float]:
    """Of a test of the window alone at the same declared rate, and of the sequential test on its window."""
    fixed = month_thresholds(
        settings.false_alarms_per_month, settings.hop_s, settings.window_hops, len(PARAMETERS)
    ).first
    return fixed, settings.thresholds(settings.window_hops).first


@dataclass(frozen=True, slots=True)
class _Trial:
    machine: Machine
    seed: int
    stream: int
    number: int
    layout: Layout
    parameter: str
    change: float
    after_s: float


@dataclass(frozen=True, slots=True)
class _Outcome:
    """What one test made of one stream; bound: Cramér-Rao standard errors of a window in the stream's condition."""

    detected_s: float
    named_s: float
    early: bool
    wrong: bool
    bound: dict[str, float]


class _Watch:
    """One sequential test on one stream."""

    def __init__(self, settings: SequentialSettings, step_ns: int, parameter: str) -> None:
        self.test = SequentialTest(settings)
        self._step_ns, self._parameter = step_ns, parameter
        self.detected_s = self.named_s = np.inf
        self.early = self.wrong = False

    @property
    def finished(self) -> bool:
        return self.early or bool(np.isfinite(self.named_s))

    def update(self, looks: dict[int, Stretch], end_ns: int) -> None:
        verdict = self.test.update(looks)
        delay_s = (end_ns - self._step_ns) / 1e9
        if delay_s <= 0:
            self.early = self.early or verdict.detected
            return
        said = {finding.name for finding in verdict.findings}
        self.wrong = self.wrong or bool(said - {self._parameter})
        if verdict.detected:
            self.detected_s = min(self.detected_s, delay_s)
        if said == {self._parameter}:
            self.named_s = min(self.named_s, delay_s)


def _scenario(trial: _Trial) -> tuple[Scenario, Scenario, float]:
    """Condition without the step, the stream with it, and when it comes: at random, once the window is full."""
    draw = Draw(trial.machine, trial.seed, Purpose.EVALUATION, trial.stream, layout=trial.layout)
    healthy = draw_condition(draw, trial.number)
    rng = np.random.default_rng([trial.seed, Purpose.EVALUATION, trial.stream, trial.number, _STREAM])
    hop_s = trial.machine.window.hop_s
    step_s = healthy.duration_s + hop_s * float(rng.uniform(0, _HEALTHY_HOPS))
    step = Event(at_s=step_s, parameter=trial.parameter, relative_change=trial.change)
    return healthy, healthy.overridden(duration_s=step_s + trial.after_s, faults=[step]), step_s


def _follow(settings: tuple[SequentialSettings, ...], trial: _Trial) -> tuple[_Outcome, ...]:
    """Play one stream to tests with several settings until all have named the change."""
    machine, plan = trial.machine, plan_for(trial.machine)
    healthy, scenario, step_s = _scenario(trial)
    bound = cramer_rao(machine, plan.states, true_condition(healthy, machine), machine.window.length_s)
    window, whole = SlidingWindow(plan), plan.hops
    fits = LengthFits(machine)
    watches: list[_Watch] = []

    def look(hops: int) -> Stretch | None:
        statistics = window.statistics(hops)
        if statistics is None:
            return None
        try:
            read = fits.window(statistics) if hops == whole else fits.short(hops, statistics)
        except (EstimationError, np.linalg.LinAlgError):
            return None  # refused, as the monitor refuses it
        return _stretch(machine, read, statistics)

    start_ns: int | None = None
    for block, _ in blocks(scenario, machine, block_s=_BLOCK_S):
        if start_ns is None:
            start_ns = block.start_ns
            watches = [_Watch(one, start_ns + round(step_s * 1e9), trial.parameter) for one in settings]
        for end_ns in window.feed(plan.to_si(block.samples), block.start_ns):
            full = look(whole)
            if full is None:
                continue
            wanted = {hops for watch in watches if not watch.finished for hops in watch.test.wanted()}
            short = {hops: found for hops in sorted(wanted) if (found := look(hops)) is not None}
            for watch in watches:
                if not watch.finished:
                    mine = {hops: short[hops] for hops in watch.test.wanted() if hops in short}
                    watch.update(mine | {whole: full}, end_ns)
        if all(watch.finished for watch in watches):
            break
    return tuple(_Outcome(one.detected_s, one.named_s, one.early, one.wrong, bound) for one in watches)


def _stretch(machine: Machine, diagnosis: Diagnosis, window: WindowStatistics) -> Stretch:
    """What is determined of a diagnosis, as the monitor takes it."""
    return stretch_of(determined(diagnosis, window, machine.window.length_s), window.start_ns, window.end_ns)


def run_delay_study(plan: DelayPlan, processes: int, progress: Callable[[str, int, int], None]) -> DelayResult:
    """Time all changes on streams, and on Gaussian hops at the bound.

    Parameters
    ----------
    plan : DelayPlan
    processes : int
    progress : callable
        Called with what is being done, how much of it is done, and how much there is.
    """
    cells: list[DelayCell] = []
    with ProcessPoolExecutor(processes) as pool:
        for hop_s in plan.hops_s:
            machine = with_hop(plan.machine, hop_s)
            settings = tuple(settings_for(machine, per_month) for per_month in plan.rates.values())
            own = hop_s == plan.hops_s[0]
            counts = {Layout.INDEPENDENT: plan.trials if own else plan.other_trials}
            if own:
                counts[Layout.ONE_SOURCE] = plan.other_trials
            cases = [
                [
                    # The same number is the same condition at every hop.
                    _Trial(machine, plan.seed, _STREAM + 10 * layout + at, k, layout, parameter, change, plan.after_s)
                    for k in range(count)
                ]
                for layout, count in counts.items()
                for at, (parameter, change) in enumerate(plan.changes)
            ]
            trials = [trial for case in cases for trial in case]
            label = f"streams, hop {hop_s:g} s"
            outcomes = []
            for outcome in pool.map(partial(_follow, settings), trials, chunksize=2):
                outcomes.append(outcome)
                progress(label, len(outcomes), len(trials))
            first = 0
            for case in cases:
                cells += _stream_cells(plan, settings, case[0], outcomes[first : first + len(case)])
                first += len(case)
        jobs = [
            (settings_for(with_hop(plan.machine, hop_s), cell.per_month, short_hops), cell)
            for cell in cells
            # One source is limited by sensor noise alone: its bound says nothing of a test on hops.
            if cell.hop_s == plan.hops_s[0] and cell.layout == Layout.INDEPENDENT.name.lower()
            for hop_s, short_hops in GAUSSIAN
        ]
        gaussian = []
        for found in pool.map(partial(_gaussian_cell, plan), jobs):
            gaussian.append(found)
            progress("Gaussian hops at the bound", len(gaussian), len(jobs))
    return DelayResult(
        machine=plan.machine.name,
        seed=plan.seed,
        trials=plan.trials,
        other_trials=plan.other_trials,
        gaussian_trials=plan.gaussian_trials,
        cells=(*cells, *gaussian),
    )


def _stream_cells(
    plan: DelayPlan,
    settings: Sequence[SequentialSettings],
    trial: _Trial,
    outcomes: Sequence[tuple[_Outcome, ...]],
) -> list[DelayCell]:
    """One cell for every declared rate from the trials of one change in one layout."""
    cells = []
    for at, (rate, one) in enumerate(zip(plan.rates, settings, strict=True)):
        valid = [outcome[at] for outcome in outcomes if not outcome[at].early]
        fixed, own = _thresholds(one)
        error = {name: float(np.median([outcome[0].bound[name] for outcome in outcomes])) for name in PARAMETERS}

        def times(threshold: float, among: Sequence[_Outcome] = valid) -> tuple[float, ...]:
            length_s = trial.machine.window.length_s
            bounds = [outcome.bound[trial.parameter] for outcome in among]
            return tuple(
                _rounded(bound_time_s(bound, length_s, trial.parameter, trial.change, threshold)) for bound in bounds
            )

        cells.append(
            DelayCell(
                source="stream",
                layout=trial.layout.name.lower(),
                parameter=trial.parameter,
                change=trial.change,
                rate=rate,
                per_month=one.false_alarms_per_month,
                hop_s=one.hop_s,
                short_hops=one.short_hops,
                watched_s=trial.after_s,
                threshold_fixed=fixed,
                threshold=own,
                detected_s=tuple(_found(outcome.detected_s) for outcome in valid),
                named_s=tuple(_found(outcome.named_s) for outcome in valid),
                bound_fixed_s=times(fixed),
                bound_s=times(own),
                bound_error=error,
                early=len(outcomes) - len(valid),
                wrong=sum(outcome.wrong for outcome in valid),
            )
        )
    return cells


def _gaussian_cell(plan: DelayPlan, job: tuple[SequentialSettings, DelayCell]) -> DelayCell:
    """The same change on Gaussian hops with the median Cramér-Rao standard errors of a stream cell's conditions."""
    settings, cell = job
    errors = np.array([cell.bound_error[name] for name in PARAMETERS])
    watched_s = min(plan.after_s, max(30.0, 4 * float(np.median(cell.bound_s))))
    after = round(watched_s / settings.hop_s)
    study = detection_delays(
        settings,
        np.diag(errors**2),
        {cell.parameter: cell.change},
        trials=plan.gaussian_trials,
        seed=plan.seed,
        before_hops=settings.window_hops + _HEALTHY_HOPS,
        after_hops=after,
    )
    fixed, own = _thresholds(settings)
    length_s, error = plan.machine.window.length_s, cell.bound_error[cell.parameter]
    return cell.model_copy(
        update={
            "source": "bound",
            "hop_s": settings.hop_s,
            "short_hops": settings.short_hops,
            "watched_s": after * settings.hop_s,
            "threshold_fixed": fixed,
            "threshold": own,
            "detected_s": tuple(_found(delay) for delay in study.detected_s),
            "named_s": tuple(_found(delay) for delay in study.named_s),
            "bound_fixed_s": (_rounded(bound_time_s(error, length_s, cell.parameter, cell.change, fixed)),),
            "bound_s": (_rounded(bound_time_s(error, length_s, cell.parameter, cell.change, own)),),
            "early": study.early,
            "wrong": study.wrong,
        }
    )


def _found(delay_s: float) -> float | None:
    return _rounded(delay_s) if np.isfinite(delay_s) else None


def _rounded(value: float) -> float:
    return float(f"{value:.5g}")
