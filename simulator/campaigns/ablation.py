"""What each ingredient of the relation networks buys: the same windows, read by variants of the same equations.

The variants lead from the networks as printed to the present ones, one ingredient after the other, and leave each
ingredient out of the present ones in turn. A variant is data: which references and inputs, which lags, what the network
is trained on, and what is made of its residual. Every variant alarms at the same rate of false alarms, by a limit from
the same calibration windows.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict

from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.networks.amortised import NetworkDiagnostician
from models.diagnosis.networks.bundle import Bundle
from models.diagnosis.networks.equations import EQUATIONS
from models.diagnosis.networks.paper import PAPER_EQUATIONS, PaperEquation, PaperNetwork, mean_squared_deviation
from models.diagnosis.networks.paper_training import train_paper_network
from models.diagnosis.networks.relation import EquationNetwork, read_equation, window_view
from models.diagnosis.networks.relation_training import train_network
from models.diagnosis.readings import Diagnostician
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from simulator.campaigns.ablation_variants import (
    VARIANTS,
    Measure,
    Reader,
    Variant,
    VariantEquation,
    as_seen,
    equation_numbered,
    linear_fit,
    variant_equation,
)
from simulator.campaigns.opinions import opinion_of
from simulator.campaigns.rates import Rate
from simulator.training.draws import Draw, Layout, Purpose, simulate_window

__all__ = ["FAULTS", "Ablation", "AblationPlan", "AblationRow", "run_ablation"]

_STRICT = ConfigDict(extra="forbid", frozen=True)
_S = TypeVar("_S")
_T = TypeVar("_T")

FAULTS: tuple[dict[str, float], ...] = (
    {},
    {"k_by": -0.2},
    {"k_by": -0.05},
    {"c_by": -0.2},
    {"k_bz": -0.2},
    {"k_bz": -0.05},
    {"c_bz": -0.2},
    {"e": 0.2},
    {"e": 0.05},
)
"""True changes of the evaluation windows, one cell each."""

_LARGE = 0.2
_FIXED_STREAM = 90
_SCALE_QUANTILE = 0.9
_MAD = 1.4826
_EVERY_LAG = 3
"""Training takes every third lag: neighbours 1 ms apart are nearly the same numbers, up to 150 Hz."""


@dataclass(frozen=True, slots=True)
class _Trained:
    """A trained variant of one equation, with the machine file that has its lags."""

    variant: Variant
    machine: Machine
    relation: EquationNetwork | None
    paper: PaperNetwork | None


@dataclass(frozen=True, slots=True)
class AblationPlan:
    """What to run.

    Attributes
    ----------
    machine : Machine
    bundle : Bundle
        The shipped networks.
    seed : int
    windows : int
        Evaluation windows per true change.
    training_windows, calibration_windows : int
        Training windows of each equation; calibration windows of all.
    false_alarm_rate : float
        Per window and equation.
    variants : tuple of Variant
    faults : tuple of dict of str to float
    layout : Layout or None
        Of calibration and evaluation windows; None mixes them. Training always mixes them.
    """

    machine: Machine
    bundle: Bundle
    seed: int
    windows: int
    training_windows: int = 60
    calibration_windows: int = 199
    false_alarm_rate: float = 0.01
    variants: tuple[Variant, ...] = VARIANTS
    faults: tuple[dict[str, float], ...] = FAULTS
    layout: Layout | None = None


class AblationRow(BaseModel):
    """One variant of one equation.

    Attributes
    ----------
    detected : dict of str to Rate
        For every change of an own parameter, windows in which the equation alarms.
    named : dict of str to Rate
        Of all windows, those in which it alarms and the changed parameter stands out most; empty for the MSD.
    false_alarms : Rate
        On healthy windows that neither training nor calibration saw.
    elsewhere : Rate
        Alarms on windows in which a parameter of another equation has changed by 20 %.
    spread : dict of str to float
        Robust standard deviation of the readings on healthy windows.
    reads : dict of str to float
        Median reading of the changed parameter.
    refused : int
        Evaluation windows without a reading.
    """

    model_config = _STRICT

    group: str
    label: str
    equation: str
    measure: str
    detected: dict[str, Rate]
    named: dict[str, Rate]
    false_alarms: Rate
    elsewhere: Rate
    spread: dict[str, float]
    reads: dict[str, float]
    refused: int


class Ablation(BaseModel):
    """The whole table and what it was made with."""

    model_config = _STRICT

    machine: str
    bundle: str
    seed: int
    layout: str
    windows: int
    training_windows: int
    calibration_windows: int
    false_alarm_rate: float
    rows: tuple[AblationRow, ...]


@dataclass(frozen=True, slots=True)
class _Reading:
    """What one variant of one equation makes of one window: test values, and relative changes where it has any."""

    values: Mapping[str, float]
    change: Mapping[str, float]


_Key = tuple[int, str]
"""Number of the variant, and equation."""


def run_ablation(plan: AblationPlan, processes: int, progress: Callable[[str, int, int], None]) -> Ablation:
    """Train all variants, read all windows with each, and count.

    Parameters
    ----------
    plan : AblationPlan
    processes : int
    progress : callable
        Called with what is being done, how much of it is done, and how much there is.

    Raises
    ------
    EstimationError
        If there are too few calibration windows for the rate of false alarms, or a fit diverges.
    """
    n, rate = plan.calibration_windows, plan.false_alarm_rate
    if np.ceil((n + 1) * (1 - rate) - 1e-9) > n:
        raise EstimationError(
            f"{plan.machine.name}: {n} calibration windows for a false-alarm rate of {rate:g}, expected at least "
            f"{int(np.ceil(1 / rate - 1e-9)) - 1}"
        )
    numbers = sorted({number for variant in plan.variants for number in variant.equations})
    draws = {
        number: Draw(
            plan.machine, plan.seed, Purpose.TRAINING, int(number), kept_nominal=equation_numbered(number).kept_nominal
        )
        for number in numbers
    }
    draws["one"] = Draw(
        plan.machine, plan.seed, Purpose.TRAINING, _FIXED_STREAM, layout=Layout.ONE_SOURCE, fixed_condition=True
    )
    jobs = [(name, draw, k) for name, draw in draws.items() for k in range(plan.training_windows)]
    with ProcessPoolExecutor(processes) as pool:

        def over(label: str, function: Callable[[_S], _T], tasks: Sequence[_S], chunk: int) -> list[_T]:
            made = []
            for one in pool.map(function, tasks, chunksize=chunk):
                made.append(one)
                progress(label, len(made), len(tasks))
            return made

        simulated = over("training windows", _training_window, [(draw, k) for _, draw, k in jobs], 4)
        training: dict[str, list[WindowStatistics]] = {name: [] for name in draws}
        for (name, _, _), window in zip(jobs, simulated, strict=True):
            training[name].append(window)
        fits: list[tuple[Variant, str]] = []
        for variant in plan.variants:
            if variant.reader in (Reader.PAPER, Reader.NETWORK, Reader.LINEAR):
                fits += [(variant.network_key, number) for number in variant.equations]
        fits = list(dict.fromkeys(fits))
        sets = [
            (variant, number, training[number if variant.varied else "one"], plan.machine, plan.seed)
            for variant, number in fits
        ]
        networks = dict(zip(fits, over("networks", _train, sets, 1), strict=True))
        trained = {
            (at, number): networks[variant.network_key, number]
            for at, variant in enumerate(plan.variants)
            for number in variant.equations
            if (variant.network_key, number) in networks
        }
        judge = partial(_judge, plan, trained)
        calibration = [
            (Draw(plan.machine, plan.seed, Purpose.CALIBRATION, _FIXED_STREAM, layout=plan.layout), k)
            for k in range(plan.calibration_windows)
        ]
        evaluation = [
            (Draw(plan.machine, plan.seed, Purpose.EVALUATION, cell, faults=dict(faults), layout=plan.layout), k)
            for cell, faults in enumerate(plan.faults)
            for k in range(plan.windows)
        ]
        healthy = over("calibration windows", judge, calibration, 4)
        judged = over("evaluation windows", judge, evaluation, 4)
    rows = tuple(
        _row(plan, (at, number), healthy, judged)
        for number in numbers
        for at, variant in enumerate(plan.variants)
        if number in variant.equations
    )
    return Ablation(
        machine=plan.machine.name,
        bundle=plan.bundle.identity,
        seed=plan.seed,
        layout="both" if plan.layout is None else plan.layout.name.lower(),
        windows=plan.windows,
        training_windows=plan.training_windows,
        calibration_windows=n,
        false_alarm_rate=rate,
        rows=rows,
    )


def _training_window(job: tuple[Draw, int]) -> WindowStatistics:
    """Simulate one window and keep what training looks at."""
    window = simulate_window(*job)
    return replace(
        window,
        lags_s=window.lags_s[::_EVERY_LAG],
        correlation=window.correlation[::_EVERY_LAG],
        hop_correlation=window.hop_correlation[:0],
        spectrum=window.spectrum[:0],
    )


def _train(task: tuple[Variant, str, Sequence[WindowStatistics], Machine, int]) -> _Trained:
    """Fit one variant of one equation."""
    variant, number, windows, machine, seed = task
    if variant.reader is Reader.PAPER:
        return _Trained(variant, machine, None, train_paper_network(_printed(number), windows, machine, seed))
    if not variant.long_lags:
        settings = machine.window.model_copy(update={"lag_from_s": 0.0})
        machine = machine.model_copy(update={"window": settings})
    windows = [as_seen(variant, window) for window in windows]
    equation = variant_equation(variant, number)
    if isinstance(equation, VariantEquation) and not variant.normalised:
        norms = [equation.rows(window_view(window, machine), machine).norm for window in windows]
        equation = replace(equation, unit=float(np.sqrt(np.mean(np.square(norms)))))
    if variant.reader is Reader.LINEAR:
        relation = EquationNetwork(equation, linear_fit(equation, windows, machine), None)
    else:
        relation = train_network(equation, windows, machine, seed)
    return _Trained(variant, machine, relation, None)


def _printed(number: str) -> PaperEquation:
    return next(equation for equation in PAPER_EQUATIONS if equation.number == number)


def _judge(plan: AblationPlan, trained: Mapping[_Key, _Trained], job: tuple[Draw, int]) -> dict[_Key, _Reading]:
    """Simulate one window and let every variant read it."""
    window = simulate_window(*job)
    found: dict[_Key, _Reading] = {}
    seen: dict[tuple[Variant, str], dict[Measure, _Reading]] = {}
    others: dict[Reader, dict[str, _Reading]] = {}
    for at, variant in enumerate(plan.variants):
        for number in variant.equations:
            one = trained.get((at, number))
            if one is None:
                if variant.reader not in others:
                    others[variant.reader] = _other(plan, variant.reader, window)
                found[at, number] = others[variant.reader][number]
                continue
            key = (one.variant, number)
            if key not in seen:
                seen[key] = _readings(one, window)
            found[at, number] = seen[key][Measure.MSD if variant.reader is Reader.PAPER else variant.measure]
    return found


def _readings(one: _Trained, window: WindowStatistics) -> dict[Measure, _Reading]:
    """All measures of one trained variant."""
    if one.paper is not None:
        return {Measure.MSD: _Reading({"msd": mean_squared_deviation(one.paper, window, one.machine)}, {})}
    assert one.relation is not None  # noqa: S101  # one of the two is there by construction
    window = as_seen(one.variant, window)
    reading = read_equation(one.relation, window, one.machine)
    rows = one.relation.equation.rows(window_view(window, one.machine), one.machine)
    power = float(np.mean((rows.target / rows.norm) ** 2))  # 1 where the window is normalised
    change = {parameter.name: parameter.change or 0.0 for parameter in reading.parameters}
    z = {parameter.name: parameter.z or 0.0 for parameter in reading.parameters}
    return {
        Measure.MSD: _Reading({"msd": (reading.msd or 0.0) / power}, {}),
        Measure.PROJECTION: _Reading(change, change),
        Measure.OWN_ERROR: _Reading(z, change),
    }


def _other(plan: AblationPlan, reader: Reader, window: WindowStatistics) -> dict[str, _Reading]:
    """What shipped networks or the likelihood say of each equation's own parameters; nothing where they refuse."""
    own = {equation.number: equation.parameters for equation in EQUATIONS}
    if reader is Reader.SHIPPED:
        read = [read_equation(network, window, plan.machine) for network in plan.bundle.networks]
        parameters = [parameter for one in read for parameter in one.parameters]
    else:
        judge: Diagnostician = LikelihoodFit(plan.machine)
        if reader is Reader.AMORTISED:
            if plan.bundle.amortised is None:
                raise EstimationError(f"{plan.machine.name}: the bundle holds no amortised networks, expected some")
            judge = NetworkDiagnostician(plan.machine, plan.bundle.amortised)
        opinion = opinion_of(judge, window)
        parameters = [] if opinion is None else list(opinion.evaluable)
    z = {parameter.name: parameter.z for parameter in parameters}
    change = {parameter.name: parameter.change for parameter in parameters}
    return {
        number: _Reading(
            {name: z[name] or 0.0 for name in names if name in z},
            {name: change[name] or 0.0 for name in names if name in change},
        )
        for number, names in own.items()
    }


def _row(
    plan: AblationPlan,
    key: _Key,
    healthy: Sequence[Mapping[_Key, _Reading]],
    judged: Sequence[Mapping[_Key, _Reading]],
) -> AblationRow:
    """Set the limit of one variant from the calibration windows, and count."""
    variant, number = plan.variants[key[0]], key[1]
    values = [one[key].values for one in healthy]
    # Every test value in units of its own upper quantile: no parameter decides the limits of another.
    scale = {
        name: float(np.quantile([abs(one[name]) for one in values if name in one], _SCALE_QUANTILE))
        for name in sorted({name for one in values for name in one})
    }

    def leading(one: _Reading) -> tuple[str, float]:
        ratios = {name: abs(value) / scale[name] for name, value in one.values.items()}
        return max(ratios.items(), key=lambda item: item[1], default=("", 0.0))

    rank = int(np.ceil((len(healthy) + 1) * (1 - plan.false_alarm_rate) - 1e-9))
    limit = float(np.sort([leading(one[key])[1] for one in healthy])[rank - 1]) * (1 + 1e-12)
    own = equation_numbered(number).parameters
    detected, named, reads = {}, {}, {}
    spread: dict[str, float] = {}
    false_alarms, elsewhere = Rate.of_counts(0, plan.windows), [0, 0]
    refused = 0
    for cell, faults in enumerate(plan.faults):
        readings = [one[key] for one in judged[cell * plan.windows : (cell + 1) * plan.windows]]
        refused += sum(not one.values for one in readings)
        leaders = [leading(one) for one in readings]
        alarms = [ratio > limit for _, ratio in leaders]
        if not faults:
            false_alarms = Rate.of_counts(sum(alarms), len(alarms))
            for name in own:
                found = [one.change[name] for one in readings if name in one.change]
                if found:
                    spread[name] = float(np.median(np.abs(np.array(found) - np.median(found)))) * _MAD
        elif not set(faults) & set(own):
            if max(abs(change) for change in faults.values()) >= _LARGE:
                elsewhere[0] += sum(alarms)
                elsewhere[1] += len(alarms)
        else:
            ((parameter, change),) = faults.items()
            label = f"{parameter} {change:+.0%}"
            detected[label] = Rate.of_counts(sum(alarms), len(alarms))
            found = [one.change[parameter] for one in readings if parameter in one.change]
            if found:
                right = sum(alarm and name == parameter for alarm, (name, _) in zip(alarms, leaders, strict=True))
                named[label] = Rate.of_counts(right, len(alarms))
                reads[label] = float(np.median(found))
    return AblationRow(
        group=variant.group,
        label=variant.label,
        equation=number,
        measure=variant.measure.value,
        detected=detected,
        named=named,
        false_alarms=false_alarms,
        elsewhere=Rate.of_counts(*elsewhere),
        spread=spread,
        reads=reads,
        refused=refused,
    )
