"""Ablation study of the relation networks: variants of the same equations read the same windows.

Every variant's limit is set for the same false-alarm rate, with the same calibration windows.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from benchmarks.studies.methods import variants as v
from benchmarks.studies.methods.paper import PAPER_EQUATIONS, PaperNetwork, train_paper_network
from benchmarks.studies.methods.variants import VARIANTS, Measure, Reader, Variant
from benchmarks.studies.reporting import results as r
from benchmarks.studies.reporting.opinions import LAYOUTS, Trained, changed_in, made_with
from benchmarks.studies.reporting.results import Estimate, Record, Table, Value
from benchmarks.studies.reporting.study import Cell, Options, Over, Study
from models.diagnosis.networks.equations import EQUATIONS
from models.diagnosis.networks.relation import EquationNetwork, equation_by_number, read_equation, window_view
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from rotorwatch.records.windows import Parameter
from simulator.training.draws import Draw, Layout, Purpose, simulate_window

_FAULTS: tuple[dict[str, float], ...] = (
    {}, {"k_by": -0.2}, {"k_by": -0.05}, {"c_by": -0.2}, {"k_bz": -0.2}, {"k_bz": -0.05}, {"c_bz": -0.2},
    {"e": 0.2}, {"e": 0.05},
)  # fmt: skip
"""True changes; their index is part of the seed."""
_NUMBERS = ("28", "29", "31")
_OWN = {equation.number: equation.parameters for equation in EQUATIONS}
_FIXED_STREAM = 90
_EVERY_LAG = 3  # training takes every third lag: below 150 Hz, adjacent lags (1 ms) are nearly identical

_Values = dict[str, Value]
"""Columns of a record: test values of parameters (or of the MSD), and relative changes of parameters if read."""


@dataclass(frozen=True, slots=True)
class _Fitted:
    """A fitted variant of one equation, with the machine file whose window settings it uses."""

    variant: Variant
    machine: Machine
    network: EquationNetwork | PaperNetwork

    def values(self, window: WindowStatistics) -> dict[Measure, _Values]:
        """Columns of a window for every measure."""
        if isinstance(self.network, PaperNetwork):
            return {Measure.MSD: {"msd value": self.network.deviation(window)}}
        window = v.as_seen(self.variant, window)
        reading = read_equation(self.network, window, self.machine)
        rows = self.network.equation.rows(window_view(window, self.machine), self.machine)
        power = float(np.mean((rows.target / rows.norm) ** 2))  # 1 if the window is normalised
        changes = {one.name: one.relative_change or 0.0 for one in reading.parameters}
        return {
            Measure.MSD: {"msd value": (reading.msd or 0.0) / power},
            Measure.PROJECTION: _columns(changes, changes),
            Measure.OWN_ERROR: _columns({one.name: one.z or 0.0 for one in reading.parameters}, changes),
        }


def _columns(values: Mapping[str, float], changes: Mapping[str, float]) -> _Values:
    return {key: one for name in values for key, one in ((f"{name} value", values[name]), (name, changes[name]))}


_Networks = dict[tuple[Variant, str], _Fitted]


def _learn(machine: Machine, options: Options, over: Over) -> _Networks:
    count = 4 if options.small else 60
    drawn = partial(Draw, machine, options.seed, Purpose.TRAINING)
    draws = {n: drawn(int(n), kept_nominal=equation_by_number(n).kept_nominal) for n in _NUMBERS}
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
    return dict(zip(fits, over("networks", _fit, tasks), strict=True))


def _training_window(job: tuple[Draw, int]) -> WindowStatistics:
    """Simulate one window, and keep only the data that training uses."""
    window = simulate_window(*job)
    return replace(
        window,
        lags_s=window.lags_s[::_EVERY_LAG],
        correlation=window.correlation[::_EVERY_LAG],
        hop_correlation=window.hop_correlation[:0],
        spectrum=window.spectrum[:0],
    )


def _fit(task: tuple[Variant, str, Sequence[WindowStatistics], Machine, int]) -> _Fitted:
    variant, number, windows, machine, seed = task
    if variant.reader is Reader.PAPER:
        printed = next(equation for equation in PAPER_EQUATIONS if equation.number == number)
        return _Fitted(variant, machine, train_paper_network(printed, windows, machine, seed))
    if "lags" not in variant.has:
        settings = machine.window.model_copy(update={"lag_from_s": 0.0})
        machine = machine.model_copy(update={"window": settings})
    windows = [v.as_seen(variant, window) for window in windows]
    equation = v.variant_equation(variant, number)
    if isinstance(equation, v.VariantEquation) and "normalised" not in variant.has:
        norms = [equation.rows(window_view(window, machine), machine).norm for window in windows]
        equation = replace(equation, unit=float(np.sqrt(np.mean(np.square(norms)))))
    if variant.reader is Reader.LINEAR:
        return _Fitted(variant, machine, EquationNetwork(equation, v.linear_fit(equation, windows, machine), None))
    from models.diagnosis.networks.training import train_network  # noqa: PLC0415  # imports torch, which takes seconds

    return _Fitted(variant, machine, train_network(equation, windows, machine, seed))


def _measure(trained: Trained, draw: Draw, networks: _Networks, number: int) -> list[dict[str, Value]]:
    """One row for every variant of every equation."""
    window = simulate_window(draw, number)
    fitted = cache(lambda key: networks[key].values(window))
    others = cache(lambda reader: _others(trained, reader, window))
    rows: list[dict[str, Value]] = []
    for variant in VARIANTS:
        for equation in variant.equations:
            key = (variant.network_key, equation)
            values = fitted(key)[variant.measure] if key in networks else others(variant.reader)[equation]
            rows.append({"equation": equation, "group": variant.group, "variant": variant.label, **values})
    return rows


def _others(trained: Trained, reader: Reader, window: WindowStatistics) -> dict[str, _Values]:
    """Readings by the shipped networks or the likelihood of each equation's own parameters; empty if refused."""
    parameters: Sequence[Parameter] = ()
    with suppress(EstimationError):
        said = next(one for one in trained.diagnosticians() if one.by == reader).diagnose(window)
        # As for all equation networks, parameters that are not evaluable get the value 0.
        parameters = said.parameters if reader is Reader.SHIPPED else said.evaluable
    values = {one.name: one.z or 0.0 for one in parameters}
    changes = {one.name: one.relative_change or 0.0 for one in parameters}
    read = {number: [name for name in own if name in values] for number, own in _OWN.items()}
    return {number: _columns({name: values[name] for name in names}, changes) for number, names in read.items()}


def _test_values(row: Record) -> dict[str, float]:
    return {
        key.removesuffix(" value"): abs(float(value or 0.0)) for key, value in row.items() if key.endswith(" value")
    }


def _judged(false_alarm_rate: float, records: Sequence[Record]) -> Iterator[Record]:
    """Evaluation windows, judged by the limits from the calibration windows of the same variant."""
    for rows in r.grouped(records, "layout", "equation", "group", "variant").values():
        limits = r.limits_of([_test_values(row) for row in rows if row["purpose"] == "calibration"], false_alarm_rate)
        for row in rows:
            if row["purpose"] != "calibration":
                ratios = {name: value / limits[name] for name, value in _test_values(row).items()}
                leader = max(ratios, key=lambda name: ratios[name], default="")
                own, _, size = str(row["changed"]).partition(" ")
                yield {
                    **row,
                    "alarm": ratios.get(leader, 0.0) > 1,
                    "right": ratios.get(leader, 0.0) > 1 and leader == own,
                    "refused": not ratios,
                    "own": own in _OWN[str(row["equation"])],
                    "kind": f"{own[:1]} {size}",
                    "read": row.get(own),
                }


_LARGE = ("k -20%", "c -20%", "e +20%")


def _found(kind: str) -> r.Of[Estimate | None]:
    return r.among(r.share("alarm"), kind=kind, own=True)


def _reads(rows: Sequence[Record]) -> str:
    """Median readings of own parameters that changed by 20 %, in the order of the changes."""
    own = r.where(rows, own=True, kind=_LARGE)
    found = [r.middle("read")(group) for group in r.grouped(own, "changed").values()]
    return ", ".join(f"{100 * one:+.1f} %" for one in found if one is not None)


def _spread(rows: Sequence[Record]) -> str:
    healthy = r.where(rows, changed="healthy")
    spreads = {name: r.statistic(name, r.robust)(healthy) for name in _OWN[str(rows[0]["equation"])]}
    return ", ".join(f"{name} {100 * one:.2f} %" for name, one in spreads.items() if one is not None)


def _short(rows: Sequence[Record]) -> str:
    """Per cent of windows in which changes of own parameters by 20 % are found, and the median readings."""
    text = " / ".join(f"{100 * one.value:.0f}" for kind in _LARGE if (one := _found(kind)(rows)) is not None)
    return text + (f" ({_reads(rows)})" if rows and _reads(rows) else "")


def _tables(false_alarm_rate: float) -> tuple[Table, ...]:
    rows = partial(_judged, false_alarm_rate)
    by = ("layout", "equation", "group", "variant")
    found = {kind: _found(kind) for kind in ("k -20%", "k -5%", "c -20%", "e +20%", "e +5%")}
    wrong = {
        "false alarms": r.among(r.share("alarm"), changed="healthy"),
        "elsewhere": r.among(r.share("alarm"), kind=_LARGE, own=False),
    }
    figures = {"spread": _spread, "reads": _reads, "refused": r.share("refused")}
    return (
        Table("ablation", by, {**found, **wrong, **figures}, rows),
        Table(
            "ablation-changes",
            (*by, "changed"),
            {"alarm": r.share("alarm"), "alarm, the changed one leading": r.share("right"), "reads": r.middle("read")},
            lambda records: r.where(rows(records), own=True),
        ),
        Table(
            "ablation-short",
            ("group", "variant"),
            {f"equation {number}": r.among(_short, equation=number) for number in _NUMBERS},
            lambda records: r.where(rows(records), layout=LAYOUTS[None]),
            "Both layouts mixed: per cent of windows in which k −20 % / c −20 % (28, 31) or e +20 % (29) is found, and "
            "the median readings:",
        ),
    )


def ablation(options: Options) -> Study:
    """Variants of the relation networks on the same windows."""
    trained = Trained.named(options.machine)
    calibration = 9 if options.small else 199
    cells = []
    for layout in (None, Layout.INDEPENDENT):
        few = not options.small and layout is not None  # half as many as with both layouts mixed
        drawn = partial(Draw, trained.machine, options.seed, layout=layout)
        plan = [("calibration", "healthy", 99 if few else calibration, drawn(Purpose.CALIBRATION, _FIXED_STREAM))]
        windows = options.windows if layout is None else max(2, options.windows // 2)
        plan += [
            ("evaluation", changed_in(faults), windows, drawn(Purpose.EVALUATION, at, faults=faults))
            for at, faults in enumerate(_FAULTS)
        ]
        for purpose, changed, count, draw in plan:
            keys: dict[str, Value] = {"layout": LAYOUTS[layout], "purpose": purpose, "changed": changed}
            cells.append(Cell(keys, count, partial(_measure, trained, draw)))
    return Study(
        name="ablation",
        cells=tuple(cells),
        learn=partial(_learn, trained.machine, options),
        tables=_tables(options.rate),
        made_with=made_with([trained]),
    )
