"""The report on the window after each hop: sensors first, then levels, then the diagnosticians' readings."""

from collections.abc import Callable
from typing import Any

import numpy as np

from models.alarm_names import SHAPE
from models.commissioning.commissioned import Installed
from models.diagnosis.sensors.check import dead_sensors, sensor_findings
from models.diagnosis.sensors.disagreement import is_drift
from models.diagnosis.sensors.reference import implicated
from models.diagnosis.sensors.standstill import Standstill
from models.diagnosis.verdict.calibration import detectable_changes
from models.diagnosis.verdict.sequential import SequentialSettings, SequentialTest
from models.diagnosis.verdict.stretch import stretch_of
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.levels.judgement import growth_seen
from rotorwatch.records.alarms import Evidence
from rotorwatch.records.fields import finite
from rotorwatch.records.health import HealthState, Report
from rotorwatch.records.windows import SensorFault, Verdict
from service.monitor.alarms.book import AlarmBook
from service.monitor.alarms.data_path import DataPathAlarms
from service.monitor.evaluators import evaluator_for
from service.monitor.levels import LevelWatch
from service.monitor.reports import identity_of

_RPM = 30 / np.pi
_SKIPPED = "not evaluated: this computer cannot keep up; levels and sensors were judged"


class WindowReporter:
    """Reports on the windows of one machine and updates its alarms.

    Parameters
    ----------
    remembered : bool
        See `MachineMonitor`.

    Attributes
    ----------
    samples : SlidingWindow
        The window reported on; the caller feeds it with samples.
    window : callable or None
        Computes the statistics of the latest report's window; None before that was full.
    calm : HealthState
        State of the latest report, raised alarms left aside.
    """

    def __init__(self, installed: Installed, alarms: AlarmBook, data_path: DataPathAlarms, *, remembered: bool) -> None:
        self._machine = machine = installed.machine
        self.identity = identity_of(installed)
        self.evaluator = judge = evaluator_for(installed)
        self._sensors = None if installed.commissioned is None else installed.commissioned.sensors
        self.standstill = Standstill(self._sensors)
        self._plan = plan = plan_for(machine, lagged=judge.needs_lags, levels=True, thorough=installed.thorough)
        self.watching = installed.watching or not plan.states
        self.levels = LevelWatch(plan, machine, installed)
        channels = len(machine.sensors)
        self.samples = SlidingWindow(plan, remembered=remembered, lines=installed.lines, channels=channels)
        self.test = SequentialTest(SequentialSettings.for_machine(machine, short=judge.takes_short), by=judge.by)
        self._alarms, self._data_path = alarms, data_path
        self.window: Callable[[], WindowStatistics] | None = None
        self.calm = HealthState.WARMING

    def report(self, end_ns: int, missing: tuple[SensorFault, ...], *, skipped: bool) -> Report:
        """Report on the window after a completed hop; `missing` are channels that lacked numbers in it.

        With `skipped`, it is not evaluated because the monitor cannot keep up.
        """
        samples, levels, test = self.samples, self.levels, self.test
        statistics, self.window = samples.statistics(), samples.again()
        there = statistics or samples.statistics(len(samples.hops))  # while it fills
        stood = "" if there is None else self.standstill.found(there)
        # At a standstill, a sensor without a signal may be alive.
        dead = missing if there is None or stood else dead_sensors(there, self._machine.sensors, missing)
        levels.take(samples, implicated(dead))
        if statistics is None:
            return self._while_it_fills(end_ns, there, dead, standing=bool(stood))
        findings = sensor_findings(
            samples.settled() if statistics.partly_settled else statistics,  # what a ramp leaves looks like a delay
            self._sensors, self._machine.sensors, missing, standing=bool(stood),
        )  # fmt: skip
        if not stood and "theta" not in implicated(findings):
            findings += levels.rewired()
        lost, start_ns, faulty = self.evaluator.spared(self._plan, findings), statistics.start_ns, implicated(findings)
        faulted = lost != () or not faulty.issubset(self._plan.others)
        if faulted and lost is not None and not (stood or skipped):
            despite = self.evaluator.despite_drift
            how = ("without it" if set(one.states).issubset(lost) or not is_drift(one) else despite for one in findings)
            told = (f"{one.text}; the machine is diagnosed {by}" for one, by in zip(findings, how, strict=True))
            findings = tuple(one.model_copy(update={"text": text}) for one, text in zip(findings, told, strict=True))
        speed = None if "theta" in faulty else finite(statistics.speed_rad_s)
        self._alarms.suppress(None if speed is None else speed * _RPM, end_ns)
        self._data_path.sensors(findings, statistics, standing=bool(stood))
        self.evaluator.heard(findings)

        def unread(state: HealthState, reason: str) -> Report:
            levels.tell(self._alarms, end_ns, faulty=faulty, standing=bool(stood))
            calm = HealthState.DATA_HEALTH if faulted else state  # a sensor fault takes precedence
            return self.unread(start_ns, end_ns, calm, speed_rad_s=speed, sensors=findings, reason=reason)

        if lost is None:
            return unread(HealthState.DATA_HEALTH, "; ".join(each.text for each in findings))
        if stood or skipped:
            return unread(HealthState.NOT_EVALUABLE, stood or _SKIPPED)
        try:
            used = samples.statistics(lost=lost) if lost else None
            evaluation = self.evaluator.evaluate(used or statistics, (samples, test))
        except EstimationError as error:
            return unread(HealthState.WATCHING if self.watching else HealthState.NOT_EVALUABLE, str(error))
        foreign = evaluation.doubted(
            levels.foreign(samples, statistics, named=bool(test.state.findings), faulty=faulty)
        )
        evaluation = evaluation.named(self._machine.sensors, statistics, foreign.text, faulty)
        looks = {n: stretch_of(one, samples.hops[-n].start_ns, end_ns) for n, one in evaluation.short.items()}
        deciding, whole = evaluation.deciding, test.settings.window_hops
        looks[whole] = stretch_of(deciding, start_ns, end_ns)
        verdict = test.update(looks, foreign=foreign.text != "", rivals=evaluation.rivals(foreign))
        look, limits = looks[whole].complete(), test.settings.thresholds(whole)
        astride_s = test.astride_s if evaluation.alone and not foreign.text else 0.0
        verdict, rival = self._beside_rivals(verdict)
        explains = self._alarms.found(
            verdict,
            test.unexplained or evaluation.unfit(verdict),
            deciding.suspect,
            end_ns,
            astride_s,
            hidden=foreign.hides,
            rival=rival,
        )
        levels.tell(self._alarms, end_ns, faulty=faulty, explained=explains)
        if evaluation.shapes or evaluation.modes:
            changed, evidence = evaluation.unlike_healthy, Evidence(start_ns=start_ns, end_ns=end_ns)
            self._alarms.update_state(SHAPE, changed != "", end_ns, changed, evidence=evidence)
        read = bool(verdict.current)
        calm = evaluation.calm(outside=verdict.outside_model, told=read, without=faulted)
        reason = evaluation.reason(told=read)
        if not self._plan.states and levels.reference is not None:
            calm, reason = HealthState.UNCHANGED, ""
        return Report(
            **self._window_now(start_ns, end_ns, calm),
            speed_rad_s=evaluation.speed_rad_s,
            sensors=findings,
            parameters=evaluation.readings,
            equations=evaluation.equations,
            opinions=evaluation.opinions,
            gyroscopic=evaluation.gyroscopic,
            misfit_z=deciding.misfit_z,
            suspect=deciding.suspect if verdict.outside_model or foreign.hides else "",
            verdict=verdict,
            detectable=() if deciding.unexplained else detectable_changes(look, limits, self._machine.window.length_s),
            reason=reason,
            shapes=evaluation.shapes,
            natural_frequencies=evaluation.modes,
        )

    def _beside_rivals(self, verdict: Verdict) -> tuple[Verdict, str | None]:
        """The verdict, and what outside the model explains the data as well; see `AlarmBook.found`."""
        rivals = self.evaluator.rivals(wanted=verdict.changed != ())
        if not rivals:
            return verdict, None
        rival = self.test.rival([one.name for one in verdict.changed], rivals)
        text = f"{verdict.text}; a change of {rival} explains the data as well"
        return verdict.model_copy(update={"low_confidence": True, "text": text}) if rival else verdict, rival

    def _while_it_fills(
        self, end_ns: int, there: WindowStatistics | None, dead: tuple[SensorFault, ...], *, standing: bool
    ) -> Report:
        """Report on the hops that are `there`: no alarm clears, as other faults are looked for in full windows."""
        if dead and there is not None:
            self._data_path.sensors(dead, there, standing=True)
        self.levels.tell(self._alarms, end_ns, faulty=implicated(dead), standing=standing)
        return self.unread(end_ns, end_ns, HealthState.WARMING, sensors=dead)

    def unread(self, start_ns: int, end_ns: int, calm: HealthState, **seen: Any) -> Report:
        """Report of the levels and the sensors alone."""
        return Report(**self._window_now(start_ns, end_ns, calm), **seen)

    def _window_now(self, start_ns: int, end_ns: int, calm: HealthState) -> dict[str, Any]:
        """Fields common to all reports on a window."""
        state = self.state(calm)
        little = state in {HealthState.UNCHANGED, HealthState.WATCHING}  # is claimed: add what growth would be seen
        return {
            **self.identity,
            "start_ns": start_ns,
            "end_ns": end_ns,
            "state": state,
            "filled": self.samples.filled,
            "levels": self.levels.latest,
            "level_growth": growth_seen(self.levels.latest) if little else None,
        }

    def state(self, otherwise: HealthState) -> HealthState:
        """State with alarms: a raised one outranks warming and not-evaluable, as missing data clear nothing."""
        self.calm = otherwise
        severity = self._alarms.severity
        return otherwise if severity is None else HealthState[severity.name]
