"""Keeps what alarms rest on: pictures of the machine before, when they were raised, and after the change.

An alarm can then be understood long after its window is gone. Nothing of this decides anything.
"""

from models.alarm_names import alarm_kind
from models.errors import RotorwatchError
from rotorwatch.records.alarms import Alarm
from rotorwatch.records.health import Health, HealthState, Report
from rotorwatch.records.history import AlarmEvidence, Picture
from rotorwatch.records.snapshots import CorrelationSnapshot
from service.stream.worker import MachineWorker
from service.terminal.logs import Limiter, logger

_CALM = {HealthState.HEALTHY, HealthState.UNCHANGED, HealthState.WATCHING}
_CALM_NS = 3_600 * 10**9  # between pictures of a machine that nothing is wrong with
_NOT_KEPT = "predictions are not kept with an alarm"
_BEFORE = ""  # stands for the alarm where none is meant
_log = logger(part="evidence")


class EvidenceCollector:
    """Keeps pictures of one machine; for one thread."""

    def __init__(self, worker: MachineWorker) -> None:
        self._worker = worker
        self._looked_ns: int | None = None
        self._before: Picture | None = None
        self._standing: dict[tuple[str, int], AlarmEvidence] = {}
        self._limiter = Limiter()

    def look(self, health: Health) -> None:
        """Take pictures, if the latest window is worth any; at most once for a window."""
        report = health.report
        if report is None or report.end_ns == self._looked_ns:
            return
        try:
            if self._looked_ns is None and (text := self._worker.history.evidence(_BEFORE)):
                self._before = Picture.model_validate_json(text)
            raised = {(one.name, one.occurrence): one for one in health.alarms if _rests_on_a_window(one)}
            self._standing = {key: kept for key, kept in self._standing.items() if key in raised}
            for (name, occurrence), alarm in raised.items():
                self._keep(name, occurrence, alarm, report)
            if _is_calm(health, report) and (
                self._before is None or abs(report.end_ns - self._before.report.end_ns) >= _CALM_NS
            ):
                self._before = self._picture(report)
                self._worker.history.keep_evidence(_BEFORE, 0, self._before.model_dump_json())
            self._looked_ns = report.end_ns
        except RotorwatchError as error:  # tried again at the next look
            place = f"{health.site}/{health.machine}"
            self._limiter.say("", _log.warning, "evidence is not kept yet", machine=place, why=str(error))

    def _keep(self, name: str, occurrence: int, alarm: Alarm, report: Report) -> None:
        kept = self._standing.get((name, occurrence))
        if kept is None and (text := self._worker.history.evidence(name, occurrence)):  # from before a restart
            kept = AlarmEvidence.model_validate_json(text)
        settled = None
        if (kept is None or kept.settled is None) and _is_settled(alarm, report):
            settled = self._picture(report)
        if kept is None:
            kept = AlarmEvidence(
                site=report.site,
                machine=report.machine,
                name=name,
                occurrence=occurrence,
                before=self._before,
                raised=settled or self._picture(report),
                settled=settled,
            )
        elif settled is not None:
            kept = kept.model_copy(update={"settled": settled})
        if self._standing.get((name, occurrence)) is not kept:
            self._worker.history.keep_evidence(name, occurrence, kept.model_dump_json())
            self._standing[name, occurrence] = kept

    def _picture(self, report: Report) -> Picture:
        latest, snapshots = self._worker.latest, self._worker.snapshots
        return Picture(
            report=report,
            spectra=snapshots.spectra(latest),
            orbits=snapshots.orbits(latest),
            correlations=_measured(snapshots.correlations(latest)),
        )


def _measured(found: CorrelationSnapshot) -> CorrelationSnapshot:
    """What was measured, in half the space: how far theory was from it is still told."""
    theory = found.theory
    reasons = {
        "nominal_reason": theory.nominal_reason or _NOT_KEPT,
        "estimated_reason": theory.estimated_reason or _NOT_KEPT,
    }
    pairs = tuple(pair.model_copy(update={"nominal": None, "estimated": None}) for pair in found.pairs)
    return found.model_copy(update={"pairs": pairs, "theory": theory.model_copy(update=reasons)})


def _rests_on_a_window(alarm: Alarm) -> bool:
    return alarm.raised and alarm.evidence is not None and alarm_kind(alarm.name).about == "machine"


def _is_calm(health: Health, report: Report) -> bool:
    quiet = not any(alarm.present or alarm.pending for alarm in health.alarms)
    verdict = report.verdict
    same = verdict is None or (verdict.settled and not verdict.detected)
    return quiet and same and report.filled >= 1 and report.state in _CALM


def _is_settled(alarm: Alarm, report: Report) -> bool:
    """Whether a window holds no data from before the change."""
    if report.verdict is not None:
        return report.verdict.settled
    return alarm.raised_ns is not None and report.start_ns >= alarm.raised_ns
