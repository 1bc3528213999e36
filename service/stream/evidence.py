"""Keeps the evidence of alarms: pictures of the machine before the change, when they were raised, and after it.

An alarm can then be understood long after its window is gone. The pictures decide nothing.
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
_CALM_PICTURE_NAME = ""  # stands for the alarm's name in the picture of a machine that nothing is wrong with
_log = logger(part="evidence")


class EvidenceCollector:
    """Keeps pictures of one machine in its history, as they are large; for one thread."""

    def __init__(self, worker: MachineWorker) -> None:
        self._worker = worker
        self._looked_ns: int | None = None
        self._calm_ns: int | None = None  # end of the latest window kept while nothing was wrong
        # Evidence of raised alarms; None once it is complete.
        self._standing: dict[tuple[str, int], AlarmEvidence | None] = {}
        self._generation = worker.history.claim.generation
        self._limiter = Limiter()

    def look(self, health: Health) -> None:
        """Take pictures, if the latest window is worth any; at most once for a window."""
        report = health.report
        if report is None or report.end_ns == self._looked_ns:
            return
        try:
            if self._generation != (now := self._worker.history.claim.generation):  # begun anew, without pictures
                self._generation, self._calm_ns = now, None
            elif self._looked_ns is None and (before := self._calm_picture()) is not None:
                self._calm_ns = before.report.end_ns
            raised = {(one.name, one.occurrence): one for one in health.alarms if _rests_on_a_window(one)}
            self._standing = {key: kept for key, kept in self._standing.items() if key in raised}
            for key, alarm in raised.items():
                if key not in self._standing or self._standing[key] is not None:
                    self._standing[key] = self._keep(self._standing.get(key), alarm, report)
            is_new = self._calm_ns is None or abs(report.end_ns - self._calm_ns) >= _CALM_NS
            if is_new and _is_calm(health, report):
                self._worker.history.keep_evidence(_CALM_PICTURE_NAME, 0, self._picture(report).model_dump_json())
                self._calm_ns = report.end_ns
            self._looked_ns = report.end_ns
        except RotorwatchError as error:  # tried again at the next look
            place = f"{health.site}/{health.machine}"
            self._limiter.say("", _log.warning, "evidence is not kept yet", machine=place, why=str(error))

    def _calm_picture(self) -> Picture | None:
        text = self._worker.history.evidence(_CALM_PICTURE_NAME)
        return Picture.model_validate_json(text) if text else None

    def _keep(self, kept: AlarmEvidence | None, alarm: Alarm, report: Report) -> AlarmEvidence | None:
        """Keep the pictures that an alarm still lacks; return its evidence, or None once that is complete."""
        history, settled = self._worker.history, _is_settled(alarm, report)
        if kept is None and (text := history.evidence(alarm.name, alarm.occurrence)):  # from before a restart
            kept = AlarmEvidence.model_validate_json(text)
        if kept is None or (settled and kept.settled is None):
            now = self._picture(report)
            if kept is None:
                kept = AlarmEvidence(
                    site=report.site,
                    machine=report.machine,
                    name=alarm.name,
                    occurrence=alarm.occurrence,
                    before=self._calm_picture(),
                    raised=now,
                    settled=now if settled else None,
                )
            else:
                kept = kept.model_copy(update={"settled": now})
            history.keep_evidence(alarm.name, alarm.occurrence, kept.model_dump_json())
        return kept if kept.settled is None else None

    def _picture(self, report: Report) -> Picture:
        from service.analysis.snapshots.orbit import orbit_snapshot  # noqa: PLC0415  # needed for few windows
        from service.analysis.snapshots.window import correlation_snapshot, spectrum_snapshot  # noqa: PLC0415

        seen = self._worker.snapshots, self._worker.latest
        correlations = _measured(correlation_snapshot(*seen))
        return Picture(
            report=report, spectra=spectrum_snapshot(*seen), orbits=orbit_snapshot(*seen), correlations=correlations
        )


def _measured(found: CorrelationSnapshot) -> CorrelationSnapshot:
    """Leave out the predictions, which halves the size; how far theory was from the measurement is kept."""
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
