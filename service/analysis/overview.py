"""Health of a machine as an overview of the plant needs it: of the latest window only the reading that matters most."""

from collections.abc import Iterable

from rotorwatch.records.health import Health, Report
from rotorwatch.records.levels import ChannelLevels, LevelLimits
from rotorwatch.records.windows import Parameter

_BEYOND = {"normal": 0.0, "alert": 10.0, "danger": 20.0}


def overview(health: Health) -> Health:
    """Leave out most of the report.

    What stays are the parameters and channels that raised alarms are about; without any, the one nearest to what would
    be seen, or to its limit.
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
    left_out = dict.fromkeys(("opinions", "equations", "sensors", "shapes"), ())
    kept = {
        "verdict": verdict,
        "parameters": _named(report.parameters, names),
        "detectable": tuple(one for one in report.detectable if one.name in names),
        "levels": tuple(one for one in report.levels if f"level:{one.channel}" in names),
        "level_growth": None,
    }
    return health.model_copy(update={"report": report.model_copy(update=left_out | kept)})


def nearness(report: Report) -> dict[str, float]:
    """How near each reading is to what would be seen, and each channel to its limit, 1 there.

    By the names of their alarms; what a page shows of a machine is chosen by the same rule (``monitor/states.js``).
    """
    near = {one.name: _parameter_nearness(report, one) for one in _readings(report)}
    return near | {f"level:{one.channel}": _level_nearness(one) for one in report.levels}


def _named(parameters: Iterable[Parameter], names: set[str]) -> tuple[Parameter, ...]:
    return tuple(one for one in parameters if one.name in names)


def _readings(report: Report) -> tuple[Parameter, ...]:
    """Readings of the machine as it is now, as far as there are any."""
    if report.verdict is None:
        return ()
    current = report.parameters if report.verdict.settled else report.verdict.current
    return tuple(one for one in current if one.relative_change is not None and one.standard_error is not None)


def _parameter_nearness(report: Report, read: Parameter) -> float:
    """Change over the smallest that would be seen; 0 without one."""
    change = read.relative_change or 0.0
    seen = next((one for one in report.detectable if one.name == read.name), None)
    least = 0.0 if seen is None else seen.loss if change < 0 else seen.gain
    return change / least if least else 0.0


def _level_nearness(levels: ChannelLevels) -> float:
    """The level of a channel that is nearest to its alert limit, over that; whatever is beyond one comes first."""

    def of_limit(limit: LevelLimits) -> float:
        value = getattr(levels, limit.measure, None)
        return _BEYOND[limit.state] + (value / limit.alert if limit.alert and value is not None else 0.0)

    return max(map(of_limit, levels.limits), default=0.0)
