"""Compares size and time of a step change as stated in the monitor's alarms with the truth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from benchmarks.studies.reporting import results as r
from benchmarks.studies.reporting.results import Goal, Record, Table, Value
from benchmarks.studies.subjects.machines import drawn_in_one_condition, without_parameters
from benchmarks.studies.subjects.watched import commissioned
from models.commissioning.commissioned import Installed, KnowledgeLevel
from models.diagnosis.readings import Z95
from models.machine import Machine, load_machine
from models.physics.rotor import PARAMETERS
from models.signals.block import SampleBlock
from rotorwatch.records.alarms import EventKind
from rotorwatch.records.windows import Finding, Verdict
from service.monitor.alarms.alarm import Alarm
from service.monitor.monitor import MachineMonitor
from simulator.scenario import Event
from simulator.stream import blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition

_NAMES = ("k_by", "c_by", "k_bz", "c_bz", "e")
_TWO = 1 / 3  # fraction of streams with two changes
_LEAST = {"k": 0.03, "c": 0.1, "e": 0.1}  # smallest changes; twice that if the parameters are not known
_LOSS, _GAIN = 0.25, 0.5
_CONDITIONS, _STREAMS = 3, 10  # healthy conditions per commissioning, and streams watched with it
_HEALTHY_WINDOWS, _WATCHED_WINDOWS, _STREAM, _BLOCK_S = 4.1, 2.1, 91, 0.5


@dataclass(frozen=True, slots=True)
class Told:
    """A machine with its knowledge level and the seed of its streams."""

    name: str
    level: KnowledgeLevel
    seed: int

    @property
    def machine(self) -> Machine:
        """The machine with all its parameters."""
        return load_machine(self.name)

    def changes(self, number: int) -> tuple[dict[str, float], float]:
        """Relative changes in a stream, and their time, s."""
        rng, window = np.random.default_rng([self.seed, number, 77]), self.machine.window
        names = rng.choice(_NAMES, 1 if rng.random() > _TWO else 2, replace=False).tolist()
        found = {}
        for name in names:
            most = _GAIN if (up := rng.random() < 0.5) else _LOSS
            least = _LEAST[name[0]] * (1 if self.level is KnowledgeLevel.FULL else 2)
            size = float(np.exp(rng.uniform(np.log(least), np.log(most))))
            found[name] = size if up else -size
        return found, 2 * window.length_s + window.hop_s * float(rng.uniform(1, 4))

    def stream(self, number: int, changes: dict[str, float], step_s: float) -> Iterator[SampleBlock]:
        """Blocks of the machine in a new condition or, without its parameters, in a commissioned one."""
        if self.level is KnowledgeLevel.FULL:
            condition = number
            draw = Draw(self.machine, self.seed, Purpose.EVALUATION, _STREAM, layout=Layout(number % 2))
        else:
            condition = 2 + number
            draw = _condition(self, number // _STREAMS, number % _CONDITIONS)
        steps = [Event(at_s=step_s, parameter=name, relative_change=size) for name, size in changes.items()]
        duration_s = step_s + _WATCHED_WINDOWS * self.machine.window.length_s
        scenario = draw_condition(draw, condition).overridden(duration_s=duration_s, faults=steps)
        return (block for block, _ in blocks(scenario, draw.machine, _BLOCK_S))


def _condition(case: Told, commissioning: int, at: int) -> Draw:
    rng = np.random.default_rng([case.seed, commissioning, 78, at])
    return drawn_in_one_condition(case.machine, rng, at)


@lru_cache(maxsize=2)
def _installed(case: Told, commissioning: int) -> Installed | str:
    if case.level is KnowledgeLevel.FULL:
        return Installed(case.machine, None, None)
    streams = []
    for at in range(_CONDITIONS):
        draw = _condition(case, commissioning, at)
        healthy = draw_condition(draw, 1).overridden(duration_s=_HEALTHY_WINDOWS * case.machine.window.length_s)
        streams.append([block for block, _ in blocks(healthy, draw.machine, _BLOCK_S)])
    return commissioned(without_parameters(case.machine), *streams)


def told(case: Told, _: None, number: int) -> list[dict[str, Value]]:
    """One record for each changed parameter, each wrongly named one, and each parameter read before the step."""
    installed = _installed(case, 0 if case.level is KnowledgeLevel.FULL else number // _STREAMS)
    if isinstance(installed, str):
        return [{"refused": installed}]
    changes, step_s = case.changes(number)
    monitor = MachineMonitor(installed)
    step_ns, rest = 0, list[dict[str, Value]]()
    found: dict[str, dict[str, Value]] = {name: {"parameter": name, "true": size} for name, size in changes.items()}
    for block in case.stream(number, changes, step_s):
        step_ns = step_ns or block.start_ns + round(step_s * 1e9)
        report = monitor.step(block)
        if report.fault is not None:
            raise report.fault
        for window in report.windows:
            delay_s = (window.end_ns - step_ns) / 1e9
            verdict = window.verdict
            if delay_s <= 0:
                rest = _at_rest(verdict)
            dated = {one.name: one for one in verdict.changed} if verdict is not None else {}
            for alarm in (event.alarm for event in report.events if event.kind is EventKind.RAISED):
                row = found.setdefault(alarm.name, {"parameter": alarm.name, "true": 0.0})
                if alarm.name in PARAMETERS and "first z" not in row:
                    row |= _quoted("first", alarm, row) | _dated(dated.get(alarm.name), step_ns)
                    row |= {"delay_s": delay_s, "wrong": alarm.name not in changes or delay_s <= 0}
            for alarm in monitor.health().alarms:
                if alarm.present and "first z" in found.get(alarm.name, {}) and delay_s > 0:
                    _standing(alarm, found[alarm.name], delay_s / case.machine.window.length_s)
    for row in found.values():
        row["named"] = "first z" in row if row["true"] else None
    return [*(row for row in found.values() if row["parameter"] in PARAMETERS), *rest]


def _at_rest(verdict: Verdict | None) -> list[dict[str, Value]]:
    readings = () if verdict is None else verdict.current
    return [
        {"parameter": one.name, "true": 0.0, "at rest": abs(one.z) <= Z95, "at rest z": one.z}
        for one in readings
        if one.z is not None
    ]


def _standing(alarm: Alarm, row: dict[str, Value], windows: float) -> None:
    """Add the reading in an alarm at a hop, `windows` windows after the step; keep the first after 1 and 2 windows."""
    row["hops"] = int(row.get("hops") or 0) + 1
    row["hops covered"] = int(row.get("hops covered") or 0) + bool(_quoted("now", alarm, row)["now"])
    for tag, after in (("window", 1), ("settled", 2)):
        if windows >= after and tag not in row:
            row |= _quoted(tag, alarm, row)


def _quoted(tag: str, alarm: Alarm, row: dict[str, Value]) -> dict[str, Value]:
    """Whether the 95 % interval of an alarm covers the truth, and the deviation in standard errors."""
    z = ((alarm.change or 0.0) - float(row["true"] or 0.0)) / (alarm.standard_error or np.nan)
    return {tag: bool(abs(z) <= Z95), f"{tag} z": float(f"{z:.5g}")}


def _dated(one: Finding | None, step_ns: int) -> dict[str, Value]:
    if one is None:
        return {}
    holds = None if one.between_ns is None else one.between_ns[0] <= step_ns <= one.between_ns[1]
    return {"since_s": (one.since_ns - step_ns) / 1e9, "since": holds}


def _alarms(records: Sequence[Record]) -> list[Record]:
    return [row for row in records if "true" in row]


_COLUMNS = {
    "changes by name": r.share("named"),
    "first: covers": r.share("first"),
    "first: z rms": r.statistic("first z", r.rms),
    "after a window": r.share("window"),
    "settled": r.share("settled"),
    "settled: z rms": r.statistic("settled z", r.rms),
    "wrong names": r.share("wrong"),
    "limits of `since` hold": r.share("since"),
    "`since` off, 95 %, s": r.statistic("since_s", lambda x: np.quantile(np.abs(x), 0.95)),
}
TABLES = (
    Table("delay-alarms", ("level",), _COLUMNS, _alarms, "What alarms quote, lab watched by the whole monitor:"),
    Table(
        "delay-alarms-parameters",
        ("level", "parameter"),
        _COLUMNS | {"delay, median s": r.middle("delay_s"), "unchanged: covers": r.share("at rest")},
        _alarms,
    ),
)


def goals(records: Sequence[Record]) -> Iterator[Goal]:
    """Goals for the readings stated in alarms."""
    rows = _alarms(records)
    for what, column in (("first raised", "first"), ("after a window", "window"), ("settled", "settled")):
        yield r.within(f"alarms cover, {what}", r.each(rows, ("level",), r.share(column)), 0.93, 1.0)
    yield r.within("alarms by a wrong name", r.each(rows, ("level",), r.share("wrong")), 0.0, 0.005)
