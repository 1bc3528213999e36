"""Reads one machine's reports, each with the levels of its window, from the history of a monitor."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from models.errors import MachineFileError, RotorwatchError
from models.levels.limits import unit_of
from models.machine import MachineFile
from models.signals.channels import UNIT_TO_SI, ChannelDescriptor
from rotorwatch.records.health import Report
from rotorwatch.records.levels import LEVEL_MEASURES, ChannelLevels, LevelBound, LevelLimits
from service.analysis.recorded import Described
from service.history.database import Database
from service.history.shared import ReportLog, alarms_since
from service.recordings.replay.source import parse_moment
from service.settings.service import load_settings

_TIMEOUT_S = 5.0
_MOST = 2000
_LATEST_NS = 2**63 - 1


@dataclass(frozen=True, slots=True)
class Past(Described):
    """Reports of one machine, oldest first, thinned out if there are many."""

    machine: MachineFile
    name: str
    place: str
    reports: tuple[Report, ...]
    alarm_texts: tuple[str, ...]

    @property
    def descriptor(self) -> ChannelDescriptor:
        """Names and units of the channels, from the current machine file."""
        return self.machine.descriptor

    @classmethod
    def of(cls, machine: MachineFile, log: ReportLog, since_ns: int | None, until_ns: int | None, most: int) -> "Past":
        """Read the history of a monitored machine without its alarms, thinned out to about `most` reports.

        Raises
        ------
        RotorwatchError
            If there are no reports.
        """
        texts = log.texts(since_ns or 0, _LATEST_NS if until_ns is None else until_ns, most)
        units = _units(machine)
        reports = tuple(in_units(one, units) for one in parsed_reports(texts))
        name = machine.title
        if not reports:
            raise RotorwatchError(f"{name}: no reports in this stretch of time")
        return cls(machine, name, "the history", reports, ())

    @classmethod
    def find(cls, settings: Path, key: str | None, between: tuple[str | None, str | None]) -> "Past":
        """Read the history named in a monitor's settings; the monitor may be running.

        Parameters
        ----------
        key : str or None
            ``SITE/MACHINE``, required if the settings name several machines.
        between : (str or None, str or None)
            From and to: seconds after the end of the oldest window, or times.

        Raises
        ------
        MachineFileError
            If settings or times cannot be used, or there is no such machine.
        RotorwatchError
            If the history cannot be read, or has no reports there.
        """
        chosen = load_settings(settings)
        there = {one.title: one for one in (entry.load() for entry in chosen.machines)}
        name = key or next(iter(there))
        if name not in there or (key is None and len(there) > 1):
            raise MachineFileError(f"{settings}: machines: {', '.join(there)}; name one, as --key SITE/MACHINE")
        machine = there[name]
        database = Database(chosen.history.database, _TIMEOUT_S)
        database.start(read_only=True)
        try:
            log = ReportLog(database, machine.site, machine.name)
            span = log.span_ns()
            if span is None:
                raise RotorwatchError(f"{settings}: no reports of {name} in the history")
            first, last = span
            since, until = (
                other if text is None else parse_moment(text, first, option)
                for text, other, option in zip(between, (first, last + 1), ("--from", "--to"), strict=True)
            )
            alarms = alarms_since(database, machine.site, machine.name, 0)
            units = _units(machine)
            reports = tuple(in_units(one, units) for one in parsed_reports(log.texts(since, until, _MOST)))
        finally:
            database.stop()
        if not reports:
            raise RotorwatchError(f"{settings}: no reports of {name} in this stretch of time")
        texts = tuple(one.text for one in alarms if since <= one.time_ns < until)
        return cls(machine, name, str(settings), reports, texts)


def parsed_reports(texts: Iterable[str | bytes]) -> Iterator[Report]:
    """Parse published reports in order; unreadable ones are left out."""
    for text in texts:
        with suppress(ValidationError):  # from another version of the program
            yield Report.model_validate_json(text)


def in_units(report: Report, units: Mapping[str, str]) -> Report:
    """Convert the levels of a report to other units, by channel; left out where the channel was of another quantity.

    So levels from before and after a change of the machine file are comparable.
    """
    if all(one.unit == units.get(one.channel, one.unit) for one in report.levels):
        return report
    levels = (_converted(one, units.get(one.channel, one.unit)) for one in report.levels)
    return report.model_copy(update={"levels": tuple(one for one in levels if one is not None)})


def _converted(levels: ChannelLevels, unit: str) -> ChannelLevels | None:
    known = next((factors for factors in UNIT_TO_SI.values() if {levels.unit, unit} <= set(factors)), None)
    if known is None:
        return None
    factor = known[levels.unit] / known[unit]
    pp = levels.detection == "peak to peak"
    scaled = {name for name in LEVEL_MEASURES if unit_of(levels.unit, name, pp) != unit_of(unit, name, pp)}
    values = {name: value * factor for name in scaled if (value := getattr(levels, name)) is not None}
    limits = (_times(one, factor) if one.measure in scaled else one for one in levels.limits)
    return levels.model_copy(update={"unit": unit, "limits": tuple(limits), **values})


def _times(limit: LevelLimits, factor: float) -> LevelLimits:
    def scaled(one: LevelLimits | LevelBound) -> dict[str, float]:
        known = {name: getattr(one, name) for name in ("alert", "danger", "fall")}
        return {name: value * factor for name, value in known.items() if value is not None}

    bounds = (
        one.model_copy(update={"zones": one.zones and tuple(factor * zone for zone in one.zones), **scaled(one)})
        for one in limit.bounds
    )
    return limit.model_copy(update={"bounds": tuple(bounds), **scaled(limit)})


def _units(machine: MachineFile) -> dict[str, str]:
    return {sensor.name: sensor.unit for sensor in machine.sensors}
