"""What each ingredient of the relation networks buys: the same windows, read by variants of the same equations.

Every variant alarms at the same rate of false alarms, by a limit from the same calibration windows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks.studies import results as r
from benchmarks.studies import variants as v
from benchmarks.studies.opinions import LAYOUTS, changed_in
from benchmarks.studies.paper import PAPER_EQUATIONS, PaperNetwork, mean_squared_deviation
from benchmarks.studies.paper_training import train_paper_network
from benchmarks.studies.results import Estimate, Record, Table, Value
from benchmarks.studies.study import Cell, Options, Over, Study
from benchmarks.studies.variants import VARIANTS, Measure, Reader, Variant
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.networks.amortised import NetworkDiagnostician
from models.diagnosis.networks.bundle import Bundle, load_bundle
from models.diagnosis.networks.equations import EQUATIONS
from models.diagnosis.networks.relation import EquationNetwork, read_equation, window_view
from models.diagnosis.readings import Diagnostician
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from rotorwatch.records.windows import Parameter
from simulator.training.draws import Draw, Layout, Purpose, simulate_window

_FAULTS: tuple[dict[str, float], ...] = (
    {}, {"k_by": -0.2}, {"k_by": -0.05}, {"c_by": -0.2}, {"k_bz": -0.2}, {"k_bz": -0.05}, {"c_bz": -0.2},
    {"e": 0.2}, {"e": 0.05},
)  # fmt: skip
"""True changes; their place is part of the seed."""
_NUMBERS = ("28", "29", "31")
_OWN = {equation.number: equation.parameters for equation in EQUATIONS}
_FIXED_STREAM = 90
_SCALE_QUANTILE = 0.9
_EVERY_LAG = 3
"""Training takes every third lag: neighbours 1 ms apart are nearly the same numbers, up to 150 Hz."""

_Values = dict[str, tuple[float, float | None]]
"""Test value, and relative change where there is one, of each parameter (or of the MSD)."""


@dataclass(frozen=True, slots=True)
class _Trained:
    """A trained variant of one equation, with the machine file that has its lags."""

    variant: Variant
    machine: Machine
    relation: EquationNetwork | None
    paper: PaperNetwork | None


_Networks = dict[tuple[Variant, str], _Trained]


def _learn(machine: Machine, options: Options, over: Over) -> _Networks:
    count = 4 if options.small else 60
    drawn = partial(Draw, machine, options.seed, Purpose.TRAINING)
    draws = {n: drawn(int(n), kept_nominal=v.equation_numbered(n).kept_nominal) for n in _NUMBERS}
    draws["one"] = drawn(_FIXED_STREAM, layout=Layout.ONE_SOURCE, fixed_condition=True)
    training = {
        name: over(f"training windows, {name}", _training_window, [(draw, k) for k in range(count)])
        for name, draw in draws.items()
    }
    fits = dict.fromkeys(
        (variant.network_key, number)
        for variant in VARIANTS
        if variant.reader in (Reader.PAPER, Reader.NETWORK, Reader.LINEAR)
        for number in variant.equations
    )
    tasks = [
        (one, number, training[number if "varied" in one.has else "one"], machine, options.seed) for one, number in fits
    ]
    return dict(zip(fits, over("networks", _train, tasks), strict=True))


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
    variant, number, windows, machine, seed = task
    if variant.reader is Reader.PAPER:
        printed = next(equation for equation in PAPER_EQUATIONS if equation.number == number)
        return _Trained(variant, machine, None, train_paper_network(printed, windows, machine, seed))
    if "lags" not in variant.has:
        settings = machine.window.model_copy(update={"lag_from_s": 0.0})
        machine = machine.model_copy(update={"window": settings})
    windows = [v.as_seen(variant, window) for window in windows]
    equation = v.variant_equation(variant, number)
    if isinstance(equation, v.VariantEquation) and "normalised" not in variant.has:
        norms = [equation.rows(window_view(window, machine), machine).norm for window in windows]
        equation = replace(equation, unit=float(np.sqrt(np.mean(np.square(norms)))))
    if variant.reader is Reader.LINEAR:
        return _Trained(
            variant, machine, EquationNetwork(equation, v.linear_fit(equation, windows, machine), None), None
        )
    from models.diagnosis.networks.training import train_network  # noqa: PLC0415  # with torch, which takes seconds

    return _Trained(variant, machine, train_network(equation, windows, machine, seed), None)


def _measure(
    machine: Machine, bundle: Bundle, seed: int, networks: _Networks, cell: Cell, number: int
) -> list[dict[str, Value]]:
    """One row for every variant of every equation."""
    purpose, stream, faults, layout = cell.given
    window = simulate_window(Draw(machine, seed, purpose, stream, faults=faults, layout=layout), number)
    seen: dict[tuple[Variant, str], dict[Measure, _Values]] = {}
    others: dict[Reader, dict[str, _Values]] = {}
    rows: list[dict[str, Value]] = []
    for variant in VARIANTS:
        for equation in variant.equations:
            key = (variant.network_key, equation)
            if key in networks:
                if key not in seen:
                    seen[key] = _values(networks[key], window)
                values = seen[key][Measure.MSD if variant.reader is Reader.PAPER else variant.measure]
            else:
                if variant.reader not in others:
                    others[variant.reader] = _others(machine, bundle, variant.reader, window)
                values = others[variant.reader][equation]
            row: dict[str, Value] = {"equation": equation, "group": variant.group, "variant": variant.label}
            for name, (value, change) in values.items():
                row |= {f"{name} value": value} | ({} if change is None else {name: change})
            rows.append(row)
    return rows


def _values(one: _Trained, window: WindowStatistics) -> dict[Measure, _Values]:
    """All measures of one trained variant."""
    if one.paper is not None:
        return {Measure.MSD: {"msd": (mean_squared_deviation(one.paper, window, one.machine), None)}}
    assert one.relation is not None  # noqa: S101  # one of the two is there by construction
    window = v.as_seen(one.variant, window)
    reading = read_equation(one.relation, window, one.machine)
    rows = one.relation.equation.rows(window_view(window, one.machine), one.machine)
    power = float(np.mean((rows.target / rows.norm) ** 2))  # 1 where the window is normalised
    return {
        Measure.MSD: {"msd": ((reading.msd or 0.0) / power, None)},
        Measure.PROJECTION: {
            one.name: (one.relative_change or 0.0, one.relative_change or 0.0) for one in reading.parameters
        },
        Measure.OWN_ERROR: {one.name: (one.z or 0.0, one.relative_change or 0.0) for one in reading.parameters},
    }


def _others(machine: Machine, bundle: Bundle, reader: Reader, window: WindowStatistics) -> dict[str, _Values]:
    """What shipped networks or the likelihood say of each equation's own parameters; nothing where they refuse."""
    parameters: Sequence[Parameter] = ()
    if reader is Reader.SHIPPED:
        parameters = [one for network in bundle.networks for one in read_equation(network, window, machine).parameters]
    else:
        judge: Diagnostician = LikelihoodFit(machine)
        if reader is Reader.AMORTISED and bundle.amortised is not None:
            judge = NetworkDiagnostician(machine, bundle.amortised)
        try:
            parameters = judge.diagnose(window).evaluable
        except EstimationError:
            parameters = ()
    read = {one.name: (one.z or 0.0, one.relative_change or 0.0) for one in parameters}
    return {number: {name: read[name] for name in own if name in read} for number, own in _OWN.items()}


def _test_values(row: Record) -> dict[str, float]:
    return {
        key.removesuffix(" value"): abs(float(value or 0.0)) for key, value in row.items() if key.endswith(" value")
    }


def _judged(false_alarm_rate: float, records: Sequence[Record]) -> Iterator[Record]:
    """Evaluation windows with the verdict of the limit that the calibration windows of the same row set."""
    for rows in r.grouped(records, "layout", "equation", "group", "variant").values():
        healthy = [_test_values(row) for row in rows if row["purpose"] == "calibration"]
        # Every test value in units of its own upper quantile: no parameter decides the limits of another.
        scale = {
            name: float(np.quantile([one[name] for one in healthy if name in one], _SCALE_QUANTILE))
            for name in sorted({name for one in healthy for name in one})
        }
        leading = [max((value / scale[name] for name, value in one.items()), default=0.0) for one in healthy]
        limit = r.limit_of(np.array(leading), false_alarm_rate) * (1 + 1e-12)
        for row in rows:
            if row["purpose"] != "calibration":
                ratios = {name: value / scale[name] for name, value in _test_values(row).items()}
                leader = max(ratios, key=lambda name: ratios[name], default="")
                own, size = _changed(row)
                yield {
                    **row,
                    "alarm": ratios.get(leader, 0.0) > limit,
                    "right": ratios.get(leader, 0.0) > limit and leader == own,
                    "refused": not ratios,
                    "own": own in _OWN[str(row["equation"])],
                    "kind": f"{own[:1]} {size}",
                    "read": row.get(own),
                }


def _changed(row: Record) -> tuple[str, str]:
    """Parameter and size of the true change."""
    name, _, size = str(row["changed"]).partition(" ")
    return name, size


def _found(kind: str, rows: Sequence[Record]) -> Estimate | None:
    return r.share("alarm")(r.where(rows, kind=kind, own=True))


def _elsewhere(rows: Sequence[Record]) -> Estimate | None:
    return r.rate(row["alarm"] for row in rows if str(row["kind"]).endswith("20%") and not row["own"])


def _reads(rows: Sequence[Record]) -> str:
    """Median readings of own parameters that changed by 20 %, in the order of the changes."""
    own = [row for row in r.where(rows, own=True) if str(row["kind"]).endswith("20%")]
    found = [r.median(row["read"] for row in group) for group in r.grouped(own, "changed").values()]
    return ", ".join(f"{100 * one:+.1f} %" for one in found if one is not None)


def _spread(rows: Sequence[Record]) -> str:
    healthy = r.where(rows, changed="healthy")
    values = {name: r.floats(row.get(name) for row in healthy) for name in _OWN[str(rows[0]["equation"])]}
    return ", ".join(f"{name} {100 * float(r.robust(x)):.2f} %" for name, x in values.items() if x.size)


def _short(rows: Sequence[Record]) -> str:
    """Found at 20 % of its own parameters, and what it reads there."""
    shares = [_found(kind, rows) for kind in ("k -20%", "c -20%", "e +20%")]
    text = " / ".join(f"{100 * one.value:.0f}" for one in shares if one is not None)
    return text + (f" ({_reads(rows)})" if rows and _reads(rows) else "")


def _tables(false_alarm_rate: float) -> tuple[Table, ...]:
    rows = partial(_judged, false_alarm_rate)
    wrong = {"false alarms": lambda rows: r.share("alarm")(r.where(rows, changed="healthy")), "elsewhere": _elsewhere}
    by = ("layout", "equation", "group", "variant")
    kinds = ("k -20%", "k -5%", "c -20%", "e +20%", "e +5%")
    figures = {"spread": _spread, "reads": _reads, "refused": r.share("refused")}
    return (
        Table("ablation", by, {**{kind: partial(_found, kind) for kind in kinds}, **wrong, **figures}, rows),
        Table(
            "ablation-changes",
            (*by, "changed"),
            {"alarm": r.share("alarm"), "alarm, the changed one leading": r.share("right"), "reads": r.middle("read")},
            lambda records: r.where(rows(records), own=True),
        ),
        Table(
            "ablation-short",
            ("group", "variant"),
            {f"equation {n}": partial(lambda n, rows: _short(r.where(rows, equation=n)), n) for n in _NUMBERS},
            lambda records: r.where(rows(records), layout=LAYOUTS[None]),
            "Both layouts mixed: per cent of windows in which k −20 % / c −20 % (28, 31) or e +20 % (29) is found, and "
            "the median readings:",
        ),
    )


def ablation(options: Options) -> Study:
    """Variants of the relation networks on the same windows."""
    machine = options.machine()
    bundle = load_bundle(machine.name, machine)
    calibration = 9 if options.small else 199
    cells = []
    for layout in (None, Layout.INDEPENDENT):
        given: object = (Purpose.CALIBRATION, _FIXED_STREAM, {}, layout)
        fewer = calibration if options.small or layout is None else 99
        cells.append(Cell({"layout": LAYOUTS[layout], "purpose": "calibration", "changed": "healthy"}, fewer, given))
        cells += [
            Cell(
                {"layout": LAYOUTS[layout], "purpose": "evaluation", "changed": changed_in(faults)},
                options.windows if layout is None else max(2, options.windows // 2),
                (Purpose.EVALUATION, at, faults, layout),
            )
            for at, faults in enumerate(_FAULTS)
        ]
    return Study(
        name="ablation",
        cells=tuple(cells),
        measure=partial(_measure, machine, bundle, options.seed),
        learn=partial(_learn, machine, options),
        tables=_tables(options.rate),
        made_with={machine.name: f"{machine.physics_hash} {bundle.identity}"},
    )
