"""What each ingredient of the relation networks buys: the same windows, read by variants of the same equations.

The variants lead from the networks as printed to the present ones, one ingredient after the other, and leave each
ingredient out of the present ones in turn. A variant is data: which references and inputs, which lags, what the network
is trained on, and what is made of its residual. Every variant alarms at the same rate of false alarms, by a limit from
the same calibration windows.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from typing import TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict

from models.diagnosis.amortised import NetworkDiagnostician
from models.diagnosis.bundle import Bundle
from models.diagnosis.equations import EQUATIONS, Equation, EquationRows, StatisticsView, SynchronousEquation
from models.diagnosis.likelihood import LikelihoodFit
from models.diagnosis.networks import EquationNetwork, Network, read_equation, window_view
from models.diagnosis.paper import PAPER_EQUATIONS, PaperEquation, PaperNetwork, mean_squared_deviation
from models.diagnosis.paper_training import train_paper_network
from models.diagnosis.readings import Diagnostician
from models.diagnosis.training import train_network
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from models.signals.block import FloatArray
from simulator.campaign import Draw, Layout, Purpose, simulate_window
from simulator.opinions import opinion_of
from simulator.rates import Rate

__all__ = [
    "FAULTS",
    "VARIANTS",
    "Ablation",
    "AblationPlan",
    "AblationRow",
    "LinearRelation",
    "Measure",
    "Variant",
    "VariantEquation",
    "run_ablation",
]

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


class Measure(StrEnum):
    """What is made of the residual."""

    MSD = "mean squared deviation"
    PROJECTION = "projection on the signatures"
    OWN_ERROR = "projection in block standard errors"


class Reader(StrEnum):
    """Who reads the window."""

    PAPER = "paper"
    NETWORK = "network"
    LINEAR = "linear fit"
    SHIPPED = "shipped network"
    AMORTISED = "amortised network"
    LIKELIHOOD = "likelihood"


@dataclass(frozen=True, slots=True)
class Variant:
    """One row of the table, and what of it is switched on.

    Attributes
    ----------
    group, label : str
        Part of the table, and what distinguishes the row.
    equations : tuple of str
        Equations it exists for.
    reader : Reader
    synchronous_out : bool
        Rotation-synchronous part removed.
    long_lags : bool
        Lags from ``lag_from_s`` on, not from zero.
    normalised : bool
        Every window divided by the rms of its target.
    every_reference : bool
        All measured displacements as references, not y1 alone.
    tilt_out : bool
        The disc's acceleration among the inputs.
    speed_powers : bool
        Powers of Ω among the inputs of equation 29.
    varied : bool
        Trained on windows in which everything else varies, not on one condition.
    measure : Measure
    """

    group: str
    label: str
    equations: tuple[str, ...] = ("28", "31")
    reader: Reader = Reader.NETWORK
    synchronous_out: bool = True
    long_lags: bool = True
    normalised: bool = True
    every_reference: bool = True
    tilt_out: bool = True
    speed_powers: bool = True
    varied: bool = True
    measure: Measure = Measure.OWN_ERROR

    @property
    def network_key(self) -> "Variant":
        """The same for all variants that share a trained network."""
        return replace(self, group="", label="", equations=(), measure=Measure.MSD)


_PRINTED = Variant(
    "one after the other",
    "as printed",
    equations=("28", "29", "31"),
    reader=Reader.PAPER,
    synchronous_out=False,
    long_lags=False,
    normalised=False,
    every_reference=False,
    tilt_out=False,
    varied=False,
    measure=Measure.MSD,
)
_OUT = replace(_PRINTED, label="+ synchronous part removed", equations=("28", "31"), reader=Reader.NETWORK)
_OUT = replace(_OUT, synchronous_out=True)
_LAGS = replace(_OUT, label="+ lags beyond the excitation's memory", long_lags=True)
_NORMALISED = replace(_LAGS, label="+ every window normalised", normalised=True)
_REFERENCES = replace(_NORMALISED, label="+ all measured references", every_reference=True)
_TILT = replace(_REFERENCES, label="+ tilt eliminated", tilt_out=True)
_VARIED = replace(_TILT, label="+ trained while everything else varies", varied=True)
_PROJECTED = replace(_VARIED, label="+ projection on the signatures", measure=Measure.PROJECTION)
_PRESENT = replace(_PROJECTED, label="+ block standard error (the present one)", measure=Measure.OWN_ERROR)

_ALL = ("28", "29", "31")
_29 = replace(_VARIED, equations=("29",))
_WITHOUT = replace(_PRESENT, group="the present one without")
_BESIDE = replace(_PRESENT, group="in its place", equations=_ALL)

VARIANTS: tuple[Variant, ...] = (
    _PRINTED,
    _OUT,
    _LAGS,
    _NORMALISED,
    _REFERENCES,
    _TILT,
    replace(_29, label="+ phase reference as the reference", varied=False, speed_powers=False),
    replace(_29, label="+ powers of Ω among the inputs", varied=False),
    replace(_VARIED, equations=_ALL),
    replace(_PROJECTED, equations=_ALL),
    replace(_PRESENT, equations=_ALL),
    replace(_WITHOUT, label="synchronous part removed", synchronous_out=False),
    replace(_WITHOUT, label="lags beyond the excitation's memory", long_lags=False),
    replace(_WITHOUT, label="normalisation", normalised=False),
    replace(_WITHOUT, label="all references (y1 alone)", every_reference=False),
    replace(_WITHOUT, label="tilt eliminated", tilt_out=False),
    replace(_WITHOUT, label="powers of Ω among the inputs", equations=("29",), speed_powers=False),
    replace(_WITHOUT, label="varied training (one condition)", equations=_ALL, varied=False),
    replace(_WITHOUT, label="projection (MSD)", equations=_ALL, measure=Measure.MSD),
    replace(_WITHOUT, label="block standard error", equations=_ALL, measure=Measure.PROJECTION),
    replace(_BESIDE, label="as printed, trained while everything else varies", reader=Reader.PAPER, varied=True),
    replace(_BESIDE, label="linear fit", reader=Reader.LINEAR),
    replace(_BESIDE, label="linear fit, one condition", reader=Reader.LINEAR, varied=False),
    replace(_BESIDE, label="shipped relation network", reader=Reader.SHIPPED),
    replace(_BESIDE, label="amortised network", reader=Reader.AMORTISED),
    replace(_BESIDE, label="likelihood", reader=Reader.LIKELIHOOD),
)
"""The rows of the table."""


class _LevelRows(EquationRows):
    """Rows that are not divided by their own target."""

    __slots__ = ()

    @property
    def norm(self) -> float:
        """The rows come in units of the training windows' target."""
        return 1.0


@dataclass(frozen=True, slots=True)
class VariantEquation(Equation):
    """Equation 28 or 31 with some of its references, and in fixed units if it is not normalised.

    Attributes
    ----------
    references : int
        How many of y1, y2, z1, z2.
    unit : float or None
        Unit of target, inputs and signatures; None divides every window by its own target.
    """

    references: int = 4
    unit: float | None = None

    def rows(self, view: StatisticsView, machine: Machine) -> EquationRows:
        """Rows of one view, one per lag and reference kept."""
        rows = Equation.rows(self, view, machine)
        kept = np.arange(rows.target.size).reshape(-1, 4)[:, : self.references].ravel()
        parts = (rows.inputs[kept], rows.target[kept], rows.signatures[kept])
        if self.unit is None:
            return EquationRows(*parts)
        return _LevelRows(*(part / self.unit for part in parts))


@dataclass(frozen=True, slots=True)
class _FixedSpeedEquation(SynchronousEquation):
    """Equation 29 without powers of Ω among its inputs."""

    def rows(self, view: StatisticsView, machine: Machine) -> EquationRows:
        """Rows of one view."""
        rows = SynchronousEquation.rows(self, view, machine)
        speed2 = (view.speed_rad_s / machine.operation.speed_rad_s) ** 2
        inputs = rows.inputs[:, (0, 3, 4)] / np.array([1.0, speed2, speed2])
        return EquationRows(inputs, rows.target, rows.signatures)


@dataclass(frozen=True, slots=True)
class LinearRelation(Network):
    """A linear map in the network's place; `W2` and `b2` alone are used."""

    def __call__(self, inputs: FloatArray) -> FloatArray:
        """Output for each row of inputs, shape (n_rows,)."""
        return np.asarray(inputs / self.input_scale @ self.W2 + self.b2[0], dtype=np.float64)


def _linear_fit(
    equation: Equation | SynchronousEquation, windows: Sequence[WindowStatistics], machine: Machine
) -> Network:
    """Least squares on the rows that a network would be trained on."""
    rows = [equation.rows(window_view(window, machine), machine) for window in windows]
    inputs = np.concatenate([row.inputs / row.norm for row in rows])
    target = np.concatenate([row.target / row.norm for row in rows])
    scale = np.sqrt(np.mean(inputs**2, axis=0))
    design = np.column_stack([inputs / scale, np.ones(target.size)])
    weights = np.linalg.lstsq(design, target, rcond=None)[0]
    none = np.zeros(0)
    return LinearRelation(scale, none, none, weights[:-1], weights[-1:])


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
            plan.machine, plan.seed, Purpose.TRAINING, int(number), kept_nominal=_equation(number).kept_nominal
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
            (Draw(plan.machine, plan.seed, Purpose.CALIBRATION, _FIXED_STREAM), k)
            for k in range(plan.calibration_windows)
        ]
        evaluation = [
            (Draw(plan.machine, plan.seed, Purpose.EVALUATION, cell, faults=dict(faults)), k)
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
        windows=plan.windows,
        training_windows=plan.training_windows,
        calibration_windows=n,
        false_alarm_rate=rate,
        rows=rows,
    )


def _equation(number: str) -> Equation | SynchronousEquation:
    return next(equation for equation in EQUATIONS if equation.number == number)


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


def _first(function: Callable[..., tuple[float, ...]], count: int, rotor: object) -> tuple[float, ...]:
    return function(rotor)[:count]


def _build(variant: Variant, number: str) -> Equation | SynchronousEquation:
    """The variant's equation, still without a unit."""
    equation = _equation(number)
    if isinstance(equation, SynchronousEquation):
        kind = SynchronousEquation if variant.speed_powers else _FixedSpeedEquation
        return kind(equation.number, equation.title)
    count = len(equation.inputs) if variant.tilt_out else len(equation.inputs) - 1
    return VariantEquation(
        number=equation.number,
        title=equation.title,
        target=equation.target,
        inputs=equation.inputs[:count],
        signatures={name: partial(_first, function, count) for name, function in equation.signatures.items()},
        references=4 if variant.every_reference else 1,
    )


def _seen(variant: Variant, window: WindowStatistics) -> WindowStatistics:
    """The window with the rotation-synchronous part put back where the variant does not remove it (Eqs. 17-18)."""
    if variant.synchronous_out or window.synchronous is None:
        return window
    q = window.synchronous
    turn = np.exp(1j * window.speed_rad_s * window.lags_s)
    part = 0.5 * np.real(np.conj(q)[None, :, None] * q[None, None, :] * turn[:, None, None])
    hops = window.hop_correlation
    return replace(window, correlation=window.correlation + part, hop_correlation=hops + part if hops.size else hops)


def _train(task: tuple[Variant, str, Sequence[WindowStatistics], Machine, int]) -> _Trained:
    """Fit one variant of one equation."""
    variant, number, windows, machine, seed = task
    if variant.reader is Reader.PAPER:
        return _Trained(variant, machine, None, train_paper_network(_printed(number), windows, machine, seed))
    if not variant.long_lags:
        settings = machine.window.model_copy(update={"lag_from_s": 0.0})
        machine = machine.model_copy(update={"window": settings})
    windows = [_seen(variant, window) for window in windows]
    equation = _build(variant, number)
    if isinstance(equation, VariantEquation) and not variant.normalised:
        norms = [equation.rows(window_view(window, machine), machine).norm for window in windows]
        equation = replace(equation, unit=float(np.sqrt(np.mean(np.square(norms)))))
    if variant.reader is Reader.LINEAR:
        relation = EquationNetwork(equation, _linear_fit(equation, windows, machine), None)
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
    window = _seen(one.variant, window)
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
    own = _equation(number).parameters
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
