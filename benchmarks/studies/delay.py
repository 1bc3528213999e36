"""Time to detection of step changes on streams, compared with the bound's time.

A stream is simulated sample by sample and fed to the sliding window, the likelihood and the sequential test as in the
monitor. The bound's time is the length of data that a test of one fixed length needs for a power of 95 % if it reads
the parameter with the Cramér-Rao standard error, which is proportional to 1/√T.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import ndtri

from benchmarks.studies import alarm_readings as t
from benchmarks.studies.methods.bound import bound_of
from benchmarks.studies.reporting import results as r
from benchmarks.studies.reporting.opinions import LAYOUTS, SEVERAL, physics_hash
from benchmarks.studies.reporting.results import Chart, Goal, Record, Table, Value
from benchmarks.studies.reporting.study import Cell, Options, Study
from models.commissioning.commissioned import KnowledgeLevel
from models.diagnosis.likelihood.lengths import LengthFits
from models.diagnosis.verdict.calibration import MONTH_S, month_thresholds
from models.diagnosis.verdict.sequential import SequentialSettings, SequentialTest
from models.diagnosis.verdict.stretch import Stretch, determined, stretch_of, to_scale
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.errors import EstimationError
from models.machine import Machine, load_machine
from models.physics.rotor import PARAMETERS
from simulator.scenario import Event, Scenario
from simulator.stream import DEFAULT_START_NS, blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition

_CHANGES = (("k_by", -0.05), ("c_by", -0.2), ("c_by", -0.1), ("e", 0.2))
"""Steps whose detection is timed; their index is part of the seed."""
_POWER = 0.95  # probability of finding a change within the bound's time
_HEALTHY_HOPS = 3
_AFTER_S = 120.0
_BLOCK_S = 0.5
_STREAM = 40


@dataclass(frozen=True, slots=True)
class _Case:
    """One change in one layout at one hop, common to all trials of a cell."""

    draw: Draw
    parameter: str
    change: float

    def trial(self, number: int) -> tuple[Scenario, float, dict[str, float]]:
        """The stream with its step, the time of the step, s, and the bound for one window of the unchanged machine."""
        draw, healthy = self.draw, draw_condition(self.draw, number)
        rng = np.random.default_rng([draw.seed, Purpose.EVALUATION, draw.stream, number, _STREAM])
        step_s = healthy.duration_s + draw.machine.window.hop_s * float(rng.uniform(0, _HEALTHY_HOPS))
        step = Event(at_s=step_s, parameter=self.parameter, relative_change=self.change)
        return healthy.overridden(duration_s=step_s + _AFTER_S, faults=[step]), step_s, bound_of(healthy, draw.machine)

    def times(self, settings: SequentialSettings, bound: dict[str, float]) -> dict[str, Value]:
        """The bound's time at the threshold of a test of whole windows only, and at the sequential test's threshold."""
        hops, own = settings.window_hops, settings.thresholds(settings.window_hops).first
        fixed = month_thresholds(settings.false_alarms_per_month, settings.hop_s, hops, len(PARAMETERS)).first
        length_s, error = self.draw.machine.window.length_s, bound[self.parameter]
        return {
            name: _rounded(bound_time_s(error, length_s, self.parameter, self.change, threshold))
            for name, threshold in (("bound_fixed_s", fixed), ("bound_s", own))
        }


def with_hop(machine: Machine, hop_s: float) -> Machine:
    """The machine with another hop; raises ValueError if its window cannot be divided so."""
    fields = machine.model_dump()
    return type(machine).model_validate(fields | {"window": fields["window"] | {"hop_s": hop_s}})


def bound_time_s(error: float, duration_s: float, parameter: str, change: float, threshold: float) -> float:
    """Data that a test of fixed length needs for a power of 95 % at the Cramér-Rao bound, s.

    `error` is the bound of the relative change for `duration_s` of data, `threshold` the test's, in standard errors.
    """
    return duration_s * ((threshold + float(ndtri(_POWER))) * error / abs(to_scale(parameter, change))) ** 2


class _Watch:
    """One sequential test on one stream, with its results as columns of a record."""

    def __init__(self, settings: SequentialSettings, step_ns: int, parameter: str) -> None:
        self.settings, self.test = settings, SequentialTest(settings)
        self._step_ns, self._parameter = step_ns, parameter
        self.said: dict[str, Value] = {"detected_s": None, "named_s": None, "early": False, "wrong": False}

    @property
    def finished(self) -> bool:
        return bool(self.said["early"]) or self.said["named_s"] is not None

    def update(self, looks: dict[int, Stretch], end_ns: int) -> None:
        verdict, delay_s = self.test.update(looks), (end_ns - self._step_ns) / 1e9
        if delay_s <= 0:
            self.said["early"] = verdict.detected
            return
        names = {finding.name for finding in verdict.changed}
        self.said["wrong"] = bool(self.said["wrong"]) or bool(names - {self._parameter})
        if verdict.detected and self.said["detected_s"] is None:
            self.said["detected_s"] = _rounded(delay_s)
        if names == {self._parameter} and self.said["named_s"] is None:
            self.said["named_s"] = _rounded(delay_s)


def _rates(machine: Machine) -> dict[str, float]:
    """Declared false alarms per month: the machine file's, and 1 % per window length."""
    per_window = 0.01 * MONTH_S / machine.window.length_s
    return {"machine file": machine.alarms.false_alarms_per_month, "1 % per window": per_window}


def _measure(case: _Case, _: None, number: int) -> list[dict[str, Value]]:
    machine, plan = case.draw.machine, plan_for(case.draw.machine)
    scenario, step_s, bound = case.trial(number)
    step_ns = DEFAULT_START_NS + round(step_s * 1e9)
    watches = {
        name: _Watch(SequentialSettings.for_machine(machine, rate), step_ns, case.parameter)
        for name, rate in _rates(machine).items()
    }
    window, whole, fits = SlidingWindow(plan), plan.hops, LengthFits(machine)

    def look(hops: int) -> Stretch | None:
        statistics = window.statistics(hops)
        if statistics is None:
            return None
        try:
            read = fits.window(statistics) if hops == whole else fits.short(hops, statistics)
        except (EstimationError, np.linalg.LinAlgError):
            return None  # refused, as in the monitor
        known = determined(read, statistics, machine.window.length_s)
        return stretch_of(known, statistics.start_ns, statistics.end_ns)

    for block, _truth in blocks(scenario, machine, block_s=_BLOCK_S):
        for end_ns in window.feed(plan.to_si(block.samples), block.start_ns):
            full = look(whole)
            if full is None:
                continue
            going = [watch for watch in watches.values() if not watch.finished]
            wanted = {hops for watch in going for hops in watch.test.wanted()}
            short = {hops: found for hops in sorted(wanted) if (found := look(hops)) is not None}
            for watch in going:
                mine = {hops: short[hops] for hops in watch.test.wanted() if hops in short}
                watch.update(mine | {whole: full}, end_ns)
        if all(watch.finished for watch in watches.values()):
            break
    return [{"rate": rate, **one.said, **case.times(one.settings, bound)} for rate, one in watches.items()]


def _rounded(value: float) -> float | None:
    return float(f"{value:.5g}") if np.isfinite(value) else None


def _judged(records: Sequence[Record]) -> Iterator[Record]:
    """Records with the ratio of delay to bound's time, infinite if the change was not found within the stream."""
    for row in (row for row in records if "detected_s" in row):
        found, named = (np.inf if row[name] is None else float(row[name] or 0.0) for name in ("detected_s", "named_s"))
        ratio, fixed = (found / float(row[bound] or 1.0) for bound in ("bound_s", "bound_fixed_s"))
        within = None if row["early"] else ratio <= 2
        yield {**row, "found": found, "named": named, "ratio": ratio, "fixed ratio": fixed, "within": within}


def _quantile(column: str, level: float) -> Callable[[Sequence[Record]], str]:
    def of(rows: Sequence[Record]) -> str:
        values = [float(row[column] or 0.0) for row in rows if not row["early"]]
        found = float(np.quantile(values, level, method="higher")) if values else np.nan
        return f"{found:.3g}" if np.isfinite(found) else "not within 120 s"

    return of


_COLUMNS = {
    "bound's time, median s": r.middle("bound_s"),
    "detected, median s": _quantile("found", 0.5),
    "95 %, s": _quantile("found", 0.95),
    "named, 95 %, s": _quantile("named", 0.95),
    "over bound's time, 50 %": _quantile("ratio", 0.5),
    "95 %": _quantile("ratio", 0.95),
    "within twice": r.share("within"),
}


def _tables(own_s: float) -> tuple[Table, ...]:
    """All tables, including a short one for the page with the machine's own hop."""
    return (
        Table(
            "delay",
            ("layout", "changed", "rate", "hop_s", "short_s"),
            _COLUMNS
            | {
                "95 %, fixed threshold": _quantile("fixed ratio", 0.95),
                "wrong name": r.share("wrong"),
                "alarm before the step": r.share("early"),
            },
            _judged,
        ),
        Table(
            "delay-own-hop",
            ("changed", "rate"),
            _COLUMNS,
            lambda records: _judged(r.where(records, hop_s=own_s, layout=SEVERAL)),
            f"Streams with independent sources, hop of {own_s:g} s:",
        ),
        *t.TABLES,
    )


def _goals(own_s: float, records: Sequence[Record]) -> Iterator[Goal]:
    streams = list(_judged(records))
    several = r.where(streams, layout=SEVERAL, hop_s=own_s, early=False)
    for (declared,), rows in r.grouped(several, "rate").items():
        within_twice = r.each(rows, ("changed",), r.share("within"))
        yield r.within(f"found within twice the bound's time, {declared}", within_twice, 0.95, 1.0)
    yield r.within("a wrong name on the way", r.each(streams, ("layout",), r.share("wrong")), 0.0, 0.01)
    yield r.within("an alarm before the step", r.each(streams, ("layout",), r.share("early")), 0.0, 0.01)
    yield from t.goals(records)


def _shares(rows: Sequence[Record]) -> list[tuple[float, float]]:
    """Delays, s, and the cumulative fraction of streams in which the change was found."""
    found = np.sort([float(row["found"] or 0.0) for row in rows])
    return [(float(x), (n + 1) / found.size) for n, x in enumerate(found) if np.isfinite(x)]


def _charts(records: Sequence[Record]) -> Iterator[Chart]:
    found = _judged(r.where(records, layout=SEVERAL, early=False))
    panels = r.panels(
        (f"{changed}, {declared}", f"hop {hop_s:g} s", _shares(rows))
        for (changed, declared, hop_s), rows in r.grouped(found, "changed", "rate", "hop_s").items()
    )
    yield Chart(
        "delay", "Share of streams in which the change is found, over the time since",
        panels, "time since the change, s", "found", steps=True, lines=(0.95,),
    )  # fmt: skip


def delay(options: Options) -> Study:
    """Step changes on streams."""
    machine = load_machine(options.machine)
    own = machine.window.hop_s
    hops = [own / 2] if (own / machine.window.segment_s).is_integer() else []  # a hop holds whole half segments
    cells = []
    ways = [(own, Layout.INDEPENDENT), (own, Layout.ONE_SOURCE), *((h, Layout.INDEPENDENT) for h in hops)]
    for hop_s, layout in ways:
        one = with_hop(machine, hop_s)
        most = options.small or (hop_s == own and layout is Layout.INDEPENDENT)
        trials = options.windows if most else max(2, round(0.4 * options.windows))
        short = "+".join(f"{n * hop_s:g}" for n in SequentialSettings.for_machine(one, 1.0).short_hops)
        for at, (name, change) in enumerate(_CHANGES):
            keys: dict[str, Value] = {
                "layout": LAYOUTS[layout],
                "changed": f"{name} {change:+.0%}",
                "hop_s": hop_s,
                "short_s": f"{short} s",
            }
            draw = Draw(one, options.seed, Purpose.EVALUATION, _STREAM + 10 * layout + at, layout=layout)
            cells.append(Cell(keys, trials, partial(_measure, _Case(draw, name, change))))
    for level in (KnowledgeLevel.FULL, KnowledgeLevel.NONE):
        keys = {"layout": "either", "changed": "one or two", "hop_s": own, "short_s": "", "level": level.value}
        trials = 1 if options.small else round(2.5 * options.windows)
        cells.append(Cell(keys, trials, partial(t.told, t.Told(options.machine, level, options.seed))))
    return Study(
        name="delay",
        cells=tuple(cells),
        tables=_tables(own),
        goals=partial(_goals, own),
        charts=_charts,
        made_with={machine.name: physics_hash(machine)},
    )
