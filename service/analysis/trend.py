"""Trends: readings of every parameter, or levels, and the states and alarms of the monitor over time."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from models.commissioning.commissioned import Installed
from models.errors import MachineFileError, RotorwatchError
from models.levels.limits import MEASURE_WORDS, unit_of
from models.machine import AlarmSettings
from models.physics.rotor import PARAMETER_TEXT
from models.signals.block import FloatArray
from models.signals.channels import unit_in_text
from models.signals.keys import MachineKeys
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmEventData, EventKind
from rotorwatch.records.health import MEASURES, HealthState, Report
from rotorwatch.records.levels import LEVEL_MEASURES
from service.analysis.past import Past, in_units, parsed_reports
from service.analysis.recorded import Recorded
from service.monitor.reports import machine_hash
from service.recordings.replay.offline import OfflineReplay, choose_machine

SHOWN = frozenset({EventKind.RAISED, EventKind.ESCALATED, EventKind.CLEARED})
"""Events shown in a trend: those caused by the machine, not by what operators did to alarms."""


@dataclass(frozen=True, slots=True)
class ParameterTrend:
    """Relative change of one parameter, window by window; NaN where it was not read."""

    name: str
    text: str
    # (n_reports,), relative change and the ends of its 95 % interval, as ratios.
    change: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, slots=True)
class LevelTrend:
    """One level of one channel, window by window; NaN where there was none."""

    title: str  # channel, measure and unit
    # (n_reports,), level and the limits then in force, in that unit; NaN where there was no limit.
    level: FloatArray
    alert: FloatArray
    danger: FloatArray


@dataclass(frozen=True, slots=True)
class TrendSeries:
    """Reports and alarm events of one machine."""

    name: str  # ``site/machine``
    end_ns: npt.NDArray[np.int64]  # (n_reports,), end of each window
    states: tuple[HealthState, ...]
    # (n_reports,), measures of the windows by name, see `MEASURES`; NaN where unknown.
    measures: Mapping[str, FloatArray]
    parameters: tuple[ParameterTrend, ...]
    levels: tuple[LevelTrend, ...]
    alarms: tuple[AlarmEventData, ...]
    limits: AlarmSettings | None  # limits in force, if the machine file is available
    origin: str  # origin of the reports, in words


def past_trend(data: Past, *, levels: bool = False) -> TrendSeries:
    """The trend of the reports in the history."""
    alarms = _shown_alarms(data.alarm_texts)
    return trend_of([_slim(one) for one in data.reports], alarms, data.machine.alarms, "of the history", levels=levels)


def read_trend(data: Recorded, machine: str | None = None, *, levels: bool = False) -> TrendSeries:
    """The trend of the recorded reports or, without any or with another machine file, of those of an offline replay.

    Parameters
    ----------
    machine : str, optional
        ``FILE`` or ``FILE@BUNDLE`` with which the samples are evaluated again.
    levels : bool
        Show vibration levels even if parameters were read.

    Raises
    ------
    RotorwatchError
        If there are no reports and none can be computed, or no report has a reading or level.
    """
    recorded = parsed_reports(message.payload for message in data.messages(data.keys.report))
    if machine is None and (reports := [_slim(one) for one in recorded]):
        limits = _limits(data.keys, reports[-1])
        return trend_of(reports, recorded_alarms(data), limits, "as recorded", levels=levels)
    if data.keys.stream not in data.source.keys:
        raise RotorwatchError(
            f"{data.place}: no reports of {data.name} in this stretch of time, and no sample blocks to compute them "
            "from"
        )
    return _computed(data, choose_machine(data.keys, machine), levels)


def recorded_alarms(data: Recorded) -> tuple[AlarmEventData, ...]:
    """Recorded alarm events without repetitions, in order of time; unreadable ones are left out."""
    return _shown_alarms(message.payload for message in data.messages(data.keys.alarm_event))


def _shown_alarms(texts: Iterable[str | bytes]) -> tuple[AlarmEventData, ...]:
    found: dict[str, AlarmEventData] = {}
    for text in texts:
        with suppress(ValidationError):
            event = AlarmCloudEvent.model_validate_json(text)
            if event.data.kind in SHOWN:
                found[event.id] = event.data
    return tuple(sorted(found.values(), key=lambda data: data.time_ns))


def trend_of(
    reports: list[Report],
    alarms: tuple[AlarmEventData, ...],
    limits: AlarmSettings | None,
    origin: str,
    *,
    levels: bool = False,
) -> TrendSeries:
    """Reports as series, in the order in which they were recorded.

    While a window straddles a change, the readings are those of the data since the change: a mean of before and after
    describes no state of the machine.

    Raises
    ------
    RotorwatchError
        If nothing was read in any report.
    """
    ordered: list[Report] = []
    for report in {report.model_dump_json(): report for report in reports}.values():  # repetitions left out
        while ordered and ordered[-1].end_ns >= report.end_ns:
            ordered.pop()  # if runs overlap in time, the one recorded last is shown
        ordered.append(report)
    units = {one.channel: one.unit for report in ordered for one in report.levels}  # the latest of each channel
    ordered = [in_units(report, units) for report in ordered]
    series = {name: np.full((3, len(ordered)), np.nan) for name in PARAMETER_TEXT}
    for number, report in enumerate(ordered):
        verdict = report.verdict
        shown = report.parameters if verdict is None or verdict.settled else verdict.current
        for reading in shown:
            if reading.relative_change is not None and reading.interval_95 is not None and reading.name in series:
                series[reading.name][:, number] = reading.relative_change, *reading.interval_95
    read = {} if levels else {name: values for name, values in series.items() if not np.isnan(values).all()}
    level_trends = () if read else tuple(_level_trends(ordered))
    if not read and not level_trends:
        reasons = dict.fromkeys(report.reason for report in ordered if report.reason)
        why = "; ".join(reasons) or f"{len(ordered)} reports, while the window was filling"
        raise RotorwatchError(f"neither parameter nor level was read in this stretch of time: {why}")
    return TrendSeries(
        name=f"{ordered[-1].site}/{ordered[-1].machine}",
        end_ns=np.array([report.end_ns for report in ordered], dtype=np.int64),
        states=tuple(report.state for report in ordered),
        measures={
            name: np.array([getattr(report, field) for report in ordered], dtype=np.float64)  # None becomes nan
            for name, (field, _) in MEASURES.items()
        },
        parameters=tuple(ParameterTrend(name, PARAMETER_TEXT[name], *values) for name, values in read.items()),
        levels=level_trends,
        alarms=alarms,
        limits=limits,
        origin=origin,
    )


def _level_trends(reports: Sequence[Report]) -> Iterator[LevelTrend]:
    """For each channel, velocity if it has a limit, else the overall level; and every level ever beyond its limit."""
    by_report = [{one.channel: one for one in report.levels} for report in reports]
    for channel in dict.fromkeys(name for levels in by_report for name in levels):
        there = [levels.get(channel) for levels in by_report]
        known = [one for one in there if one is not None]
        as_velocity = any(one.velocity is not None and one.limit("velocity") is not None for one in known)
        out = {limit.measure for one in known for limit in one.limits if limit.state != "normal"}
        for measure in LEVEL_MEASURES:
            if measure not in out and measure != ("velocity" if as_velocity else "overall"):
                continue
            unit = unit_of(unit_in_text(known[-1].unit), measure, known[-1].detection == "peak to peak")
            limits = [None if one is None else one.limit(measure) for one in there]
            yield LevelTrend(
                f"{channel}   {MEASURE_WORDS[measure]}" + (f", {unit}" if unit else ""),
                np.array([None if one is None else getattr(one, measure) for one in there], dtype=np.float64),
                np.array([None if one is None else one.alert for one in limits], dtype=np.float64),
                np.array([None if one is None else one.danger for one in limits], dtype=np.float64),
            )


def _slim(report: Report) -> Report:
    """The report without parts that a trend does not show: a month of reports must fit into memory."""
    return report.model_copy(update={"opinions": (), "equations": (), "detectable": ()})


def _limits(keys: MachineKeys, report: Report) -> AlarmSettings | None:
    """Alarm limits of the shipped machine file, if the report was made with it."""
    try:
        machine = choose_machine(keys, None).machine
    except MachineFileError:
        return None
    return machine.alarms if machine_hash(machine) == report.machine_hash else None


def _computed(data: Recorded, installed: Installed, levels: bool) -> TrendSeries:
    """The trend of an offline replay, whose reports are bit-identical to those of ``rotorwatch replay``."""
    machine = installed.machine
    reports: list[Report] = []
    alarms: list[AlarmEventData] = []

    def take(line: str) -> None:
        message = json.loads(line)
        if message["topic"] == machine.keys.report:
            reports.append(_slim(Report.model_validate(message["message"])))
        else:
            alarms.append(AlarmCloudEvent.model_validate(message["message"]).data)

    run = OfflineReplay(data.source, data.keys, installed, take, from_ns=data.from_ns, to_ns=data.to_ns)
    summary = run.run()
    if summary.blocks == 0:
        raise RotorwatchError(f"no block was accepted: {summary.last_refusal or 'there was none'}")
    origin = f"computed with machine file {summary.machine_hash}"
    return trend_of(reports, tuple(alarms), machine.alarms, origin, levels=levels)
