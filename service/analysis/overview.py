"""Reduces a machine's health to what the plant overview shows: of the latest window, only the most critical reading."""

from collections.abc import Iterable

from rotorwatch.records.health import Health, Report
from rotorwatch.records.levels import ChannelLevels, LevelLimits
from rotorwatch.records.windows import Parameter

_NEARNESS_OF_STATE = {"normal": 0.0, "alert": 10.0, "danger": 20.0}


def overview(health: Health) -> Health:
    """Reduce the report to the parameters and channels that raised alarms are about.

    Without any, keep the parameter nearest to its minimum detectable change or the channel nearest to its limit.
    """
    report = health.report
    if report is None:
        return health
    names = {alarm.name for alarm in health.alarms if alarm.raised}
    near = nearness(report)
    if not names & near.keys() and near:
        names = {max(near, key=near.__getitem__)}
    verdict = report.verdict
    if verdict is not None:
        current = _named(verdict.current, names)
        verdict = verdict.model_copy(update={"current": current, "candidates": (), "alternatives": ()})
    left_out = dict.fromkeys(("opinions", "equations", "sensors", "shapes", "natural_frequencies"), ())
    kept = {
        "verdict": verdict,
        "parameters": _named(report.parameters, names),
        "detectable": tuple(one for one in report.detectable if one.name in names),
        "levels": tuple(one for one in report.levels if f"level:{one.channel}" in names),
        "level_growth": None,
    }
    return health.model_copy(update={"report": report.model_copy(update=left_out | kept)})


def nearness(report: Report) -> dict[str, float]:
    """Ratio of each reading to its minimum detectable change, and of each channel's level to its limit, by alarm name.

    The page chooses what it shows of a machine by the same rule (``monitor/states.js``).
    """
    current: Iterable[Parameter] = ()
    if report.verdict is not None:
        current = report.parameters if report.verdict.settled else report.verdict.current
    detectable = {one.name: one for one in report.detectable}
    near: dict[str, float] = {}
    for read in current:
        change = read.relative_change
        if change is not None and read.standard_error is not None:
            seen = detectable.get(read.name)
            least = 0.0 if seen is None else seen.loss if change < 0 else seen.gain
            near[read.name] = change / least if least else 0.0
    return near | {f"level:{one.channel}": _level_nearness(one) for one in report.levels}


def _named(parameters: Iterable[Parameter], names: set[str]) -> tuple[Parameter, ...]:
    return tuple(one for one in parameters if one.name in names)


def _level_nearness(levels: ChannelLevels) -> float:
    """Largest ratio of a channel's levels to their alert limits, plus 10 in state alert and 20 in danger."""

    def of_limit(limit: LevelLimits) -> float:
        value = getattr(levels, limit.measure, None)
        return _NEARNESS_OF_STATE[limit.state] + (value / limit.alert if limit.alert and value is not None else 0.0)

    return max(map(of_limit, levels.limits), default=0.0)
