"""The data path of one machine: block in, report out. Read this first.

::

    SampleBlock -> Gate -> SlidingWindow -> WindowEvaluator -> SequentialTest -> AlarmBook -> MonitorReport
                 (ingest)  (correlations)     (residuals)     (what changed)     (alarms)

`MachineMonitor` knows no network, clock or thread: all times are the data's own. Live running and replay are two ways
of feeding it, and the same blocks give the same reports.
"""

from collections import Counter
from dataclasses import dataclass, replace
from enum import StrEnum

from models.commissioning.installed import Installed
from models.diagnosis.fallback.shape import ChannelShape
from models.diagnosis.moments import plan_for
from models.diagnosis.readings import Diagnosis, EquationReading, ParameterReading
from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.finding import SensorFinding
from models.diagnosis.verdict.detectable import DetectableChange, detectable_changes
from models.diagnosis.verdict.sequential import SequentialSettings, SequentialTest, SequentialVerdict
from models.diagnosis.verdict.stretch import Stretch, stretch_of
from models.diagnosis.window import SlidingWindow, WindowStatistics
from models.errors import EstimationError, WireError
from models.ingest import Gate, Reason, Verdict
from models.signals.block import SampleBlock
from models.signals.channels import with_channel_names
from models.signals.wire import decode_block
from service.alarms import MODEL, SENSOR, SHAPE, Alarm, AlarmBook, AlarmEvent, Severity
from service.residuals import Evaluation, Opinion, evaluator_for

__all__ = ["DataQuality", "HealthState", "MachineHealth", "MachineMonitor", "MonitorReport", "WindowReport"]


class HealthState(StrEnum):
    """Health of a machine in one word."""

    WARMING = "warming"
    HEALTHY = "healthy"
    ALERT = "alert"
    DANGER = "danger"
    OUTSIDE_MODEL = "outside-model"
    DATA_HEALTH = "data-health"
    UNCHANGED = "unchanged"
    NO_DATA = "no-data"
    NOT_EVALUABLE = "not-evaluable"


@dataclass(frozen=True, slots=True)
class DataQuality:
    """What came in since the monitor started.

    Attributes
    ----------
    accepted : int
        Blocks accepted.
    refused : dict of str to int
        Blocks refused, by reason.
    gaps : int
        Interruptions before accepted blocks.
    missing_s : float
        Data time that the gaps cost.
    last_refusal : str
        Latest reason for refusing a block, in a sentence.
    last_gap : str
        Latest gap, in a sentence.
    """

    accepted: int = 0
    refused: tuple[tuple[str, int], ...] = ()
    gaps: int = 0
    missing_s: float = 0.0
    last_refusal: str = ""
    last_gap: str = ""


@dataclass(frozen=True, slots=True)
class WindowReport:
    """One evaluation of the window, at the end of a hop.

    Attributes
    ----------
    start_ns, end_ns : int
        Oldest and newest data in the window.
    state : HealthState
        After this window: warming, healthy, alert, danger, outside-model, data-health, unchanged (no
        equation can be evaluated, but every channel is as it was) or not-evaluable.
    filled : float
        Fraction of a full window.
    speed_rad_s : float or None
        Mean speed in the window.
    parameters : tuple of ParameterReading
        Readings of the whole window by the diagnostician that decides: the likelihood, or the baseline.
    equations : tuple of EquationReading
        The networks' opinion, equation by equation.
    opinions : tuple of Opinion
        What the other diagnosticians read, and whether they agree.
    misfit_z : float or None
        How far the window is from what the model can explain; standard normal where the model holds.
    suspect : str
        What explains the misfit best, if one thing does.
    verdict : SequentialVerdict or None
        What has changed since the machine was nominal; the alarms are decided on it.
    detectable : tuple of DetectableChange
        What would have been noticed in this window, parameter by parameter.
    reason : str
        Why the window was not evaluated; empty if it was.
    sensors : tuple of SensorFinding
        Faults of sensors in the window; with any of them nothing is said of the machine.
    shapes : tuple of ChannelShape
        Where no equation can be evaluated: whether each channel's vibration is as it was.
    """

    start_ns: int
    end_ns: int
    state: HealthState
    filled: float
    speed_rad_s: float | None = None
    parameters: tuple[ParameterReading, ...] = ()
    equations: tuple[EquationReading, ...] = ()
    opinions: tuple[Opinion, ...] = ()
    misfit_z: float | None = None
    suspect: str = ""
    verdict: SequentialVerdict | None = None
    detectable: tuple[DetectableChange, ...] = ()
    reason: str = ""
    sensors: tuple[SensorFinding, ...] = ()
    shapes: tuple[ChannelShape, ...] = ()


@dataclass(frozen=True, slots=True)
class MonitorReport:
    """What one block did.

    Attributes
    ----------
    verdict : Verdict
        Accepted or refused, and why.
    windows : tuple of WindowReport
        One per hop that the block completed.
    events : tuple of AlarmEvent
        What operators should hear.
    """

    verdict: Verdict
    windows: tuple[WindowReport, ...] = ()
    events: tuple[AlarmEvent, ...] = ()


@dataclass(frozen=True, slots=True)
class MachineHealth:
    """Where the machine stands: the latest window, the alarms, and the quality of the data."""

    state: HealthState
    filled: float
    latest: WindowReport | None
    alarms: tuple[Alarm, ...]
    quality: DataQuality


class MachineMonitor:
    """Monitors one machine.

    Parameters
    ----------
    installed : Installed
        The machine file, and what was trained and commissioned for the machine.
    """

    def __init__(self, installed: Installed) -> None:
        self.machine = machine = installed.machine
        self._evaluator = evaluator_for(installed)
        self._sensors = None if installed.commissioned is None else installed.commissioned.sensors
        self._plan = plan_for(machine, lagged=self._evaluator.needs_lags)
        self._gate = Gate(machine)
        self._window = SlidingWindow(self._plan)
        settings = SequentialSettings.for_machine(machine, short=self._evaluator.takes_short)
        self._test = SequentialTest(settings, by=self._evaluator.by)
        self._alarms = AlarmBook(machine.alarms)
        self._quality = DataQuality()
        self._refused: Counter[str] = Counter()
        self._latest: WindowReport | None = None

    def step_payload(self, payload: bytes, attachment: bytes, encoding: str) -> MonitorReport:
        """Decode a message of the stream and take it as `step` does; undecodable bytes are a refusal like any other."""
        try:
            block, schema_hash = decode_block(payload, attachment, encoding)
        except WireError as error:
            name = f"{self.machine.site}/{self.machine.name}"
            return MonitorReport(self._count(Verdict(Reason.MALFORMED, f"{name}: {error}")))
        return self.step(block, schema_hash)

    def step(self, block: SampleBlock, schema_hash: str = "") -> MonitorReport:
        """Take one block: gate, window, evaluation, alarms.

        Parameters
        ----------
        block : SampleBlock
            The next block of the stream.
        schema_hash : str
            Hash of the channel descriptor the sender named, empty if none.

        Returns
        -------
        MonitorReport
            Immutable; refused blocks and gaps are stated in it, never raised.
        """
        verdict = self._count(self._gate.judge(block, schema_hash))
        if not verdict.accepted:
            return MonitorReport(verdict)
        if not verdict.continuous:
            self._window.gap()
        if verdict.clock_step_s:
            self._window.clear()
            self._test.clear()
            self._alarms.clock_stepped(block.start_ns)
        windows: list[WindowReport] = []
        events: list[AlarmEvent] = []
        for end_ns in self._window.feed(self._plan.to_si(block.samples), block.start_ns):
            report, heard = self._evaluate(end_ns)
            windows.append(report)
            events.extend(heard)
        return MonitorReport(verdict, tuple(windows), tuple(events))

    def health(self) -> MachineHealth:
        """Where the machine stands now."""
        state = HealthState.WARMING if self._latest is None else self._latest.state
        return MachineHealth(state, self._window.filled, self._latest, self._alarms.alarms, self._quality)

    def _count(self, verdict: Verdict) -> Verdict:
        quality = self._quality
        if verdict.reason is not None:
            self._refused[verdict.reason] += 1
            self._quality = replace(quality, refused=tuple(sorted(self._refused.items())), last_refusal=verdict.text)
        elif verdict.continuous:
            self._quality = replace(quality, accepted=quality.accepted + 1)
        else:
            missing_s = quality.missing_s + verdict.gap_s
            self._quality = replace(
                quality,
                accepted=quality.accepted + 1,
                gaps=quality.gaps + 1,
                missing_s=missing_s,
                last_gap=verdict.text,
            )
        return verdict

    def _evaluate(self, end_ns: int) -> tuple[WindowReport, tuple[AlarmEvent, ...]]:
        """Evaluate the window as it is after a completed hop."""
        filled = self._window.filled
        statistics = self._window.statistics()
        if statistics is None:
            report = WindowReport(end_ns, end_ns, self._state(HealthState.WARMING), filled)
            self._latest = report
            return report, ()
        findings = sensor_findings(statistics, self._sensors, self.machine.sensors)
        events = self._alarms.update_state(SENSOR, bool(findings), end_ns, "; ".join(each.text for each in findings))
        if findings:
            report = WindowReport(
                statistics.start_ns,
                end_ns,
                self._state(HealthState.DATA_HEALTH),
                filled,
                sensors=findings,
                reason="; ".join(each.text for each in findings),
            )
            self._latest = report
            return report, events
        short = {hops: self._window.statistics(hops) for hops in self._test.wanted()}
        present = {hops: latest for hops, latest in short.items() if latest is not None}
        try:
            evaluation = self._evaluator.evaluate(statistics, present)
        except EstimationError as error:
            report = WindowReport(
                statistics.start_ns, end_ns, self._state(HealthState.NOT_EVALUABLE), filled, reason=str(error)
            )
            self._latest = report
            return report, events
        evaluation = self._named(evaluation)
        looks = {hops: _stretch(evaluation.short[hops], present[hops]) for hops in evaluation.short}
        whole = self._test.settings.window_hops
        looks[whole] = _stretch(evaluation.deciding, statistics)
        verdict = self._test.update(looks)
        changed = [shape.sentence for shape in evaluation.shapes if shape.changed]
        events += self._alarm(verdict, evaluation.deciding.suspect, end_ns)
        if evaluation.shapes:
            events += self._alarms.update_state(SHAPE, bool(changed), end_ns, "; ".join(changed))
        outside = verdict.isolation.outside
        report = WindowReport(
            start_ns=statistics.start_ns,
            end_ns=end_ns,
            state=self._state(_calm_state(evaluation, outside=outside)),
            filled=filled,
            speed_rad_s=evaluation.speed_rad_s,
            parameters=evaluation.deciding.parameters,
            equations=evaluation.equations,
            opinions=evaluation.opinions,
            misfit_z=evaluation.deciding.misfit_z,
            suspect=evaluation.deciding.suspect if outside else "",
            verdict=verdict,
            detectable=detectable_changes(
                looks[whole].complete(), self._test.thresholds(whole), self.machine.window.length_s
            ),
            reason="" if evaluation.deciding.evaluable else _why_nothing(evaluation.deciding),
            shapes=evaluation.shapes,
        )
        self._latest = report
        return report, events

    def _named(self, evaluation: Evaluation) -> Evaluation:
        """The same with sentences in the names of this machine's channels."""
        channels = self.machine.sensors
        suspect = with_channel_names(evaluation.deciding.suspect, channels)
        return replace(
            evaluation,
            deciding=replace(evaluation.deciding, suspect=suspect),
            shapes=tuple(
                replace(one, sentence=with_channel_names(one.sentence, channels)) for one in evaluation.shapes
            ),
        )

    def _alarm(self, verdict: SequentialVerdict, suspect: str, end_ns: int) -> tuple[AlarmEvent, ...]:
        """Bring what was found to the alarms; without clean data they stay where they are."""
        named = {finding.name for finding in verdict.findings}
        events: list[AlarmEvent] = []
        for reading in verdict.current:
            if reading.change is not None and reading.standard_error is not None:
                events.extend(
                    self._alarms.update(
                        reading.name,
                        reading.change,
                        reading.standard_error,
                        end_ns,
                        named=reading.name in named,
                        low_confidence=verdict.isolation.outside,
                    )
                )
        if verdict.current:
            note = f"best explained by: {suspect}" if suspect else ""
            events.extend(self._alarms.update_state(MODEL, verdict.isolation.outside, end_ns, note))
        return tuple(events)

    def _state(self, otherwise: HealthState) -> HealthState:
        """A raised alarm outranks warming and not-evaluable: missing data clears nothing."""
        match self._alarms.severity:
            case Severity.DANGER:
                return HealthState.DANGER
            case Severity.ALERT:
                return HealthState.ALERT
            case None:
                return otherwise


def _calm_state(evaluation: Evaluation, *, outside: bool) -> HealthState:
    """What a machine without raised alarms is: healthy only if something was read that could have said otherwise."""
    if evaluation.deciding.evaluable:
        return HealthState.OUTSIDE_MODEL if outside else HealthState.HEALTHY
    states = {shape.state for shape in evaluation.shapes}
    if "not changed" in states and "changed" not in states:
        return HealthState.UNCHANGED
    return HealthState.NOT_EVALUABLE


def _why_nothing(diagnosis: Diagnosis) -> str:
    """Why no parameter could be read, every reason once."""
    return "; ".join(dict.fromkeys(reading.reason for reading in diagnosis.parameters if reading.reason))


def _stretch(diagnosis: Diagnosis, window: WindowStatistics) -> Stretch:
    return stretch_of(diagnosis, window.start_ns, window.end_ns)
