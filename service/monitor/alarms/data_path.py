"""Alarms that are not about the machine: on the stream, its clock, the sensors, and the monitor itself."""

from collections.abc import Mapping

import numpy as np

from models.alarm_names import CLOCK, CONFLICT, FAULT, GAP, OVERLOADED, PHASE_REFERENCE, STREAM_LOST, data_alarm
from models.checkpoint import checked, texts
from models.diagnosis.window.statistics import WindowStatistics
from models.ingest import Admission, Reason, lasting
from models.machine import MachineFile
from rotorwatch.records.alarms import Evidence
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault
from service.monitor.alarms.book import AlarmBook

_MOST_HOPS = 4
"""Time without a whole hop, in hops, from which gaps are too frequent: after a single gap it takes three at most."""


class DataPathAlarms:
    """Judges the data on their way from the sensors through the monitor."""

    def __init__(self, book: AlarmBook, machine: MachineFile) -> None:
        self._book = book
        self._gap_s = machine.alarms.gap_s
        self._silence_s = machine.ingest.no_data_after_s
        self._silence_ns = round(self._silence_s * 1e9)
        self._hop_ns = round(machine.window.hop_s * 1e9)
        self._whole_ns: int | None = None  # end of the latest hop, or where the first could have begun
        self._refused = ""  # why the first block after those that were used was refused, and when it begins
        self._refused_ns = 0
        self._unseen_windows, self._unseen_blocks, self._unseen_s = 0, 0, 0.0

    def checkpoint(self) -> dict[str, np.ndarray]:
        """The complete state as named arrays."""
        unseen = [self._unseen_windows, self._unseen_blocks, self._unseen_s]
        return {
            "whole_ns": np.array([] if self._whole_ns is None else [self._whole_ns], dtype=np.int64),
            "unseen": np.array(unseen, dtype=np.float64),
            "refused": np.array([self._refused]),
            "refused_ns": np.array(self._refused_ns),
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Continue from where `checkpoint` was called, see `models.checkpoint`."""
        windows, blocks, self._unseen_s = checked(arrays, "unseen", np.float64, (3,)).tolist()
        self._unseen_windows, self._unseen_blocks = int(windows), int(blocks)
        self._whole_ns = next(iter(checked(arrays, "whole_ns", np.int64, (None,)).tolist()), None)
        self._refused = "".join(texts(arrays, "refused"))
        self._refused_ns = int(checked(arrays, "refused_ns", np.int64, ()))

    def judged(self, verdict: Admission, start_ns: int) -> None:
        """Remember why the first block was refused, in case no usable data follow; repeated blocks do not count."""
        if verdict.reason is not None and verdict.reason is not Reason.OVERLAP and not self._refused:
            self._refused, self._refused_ns = verdict.text, start_ns

    def accepted(self, verdict: Admission, start_ns: int, dropped: int) -> str:
        """Take note of an accepted block, before which the monitor itself dropped `dropped` blocks.

        Returns why nothing has been evaluated for long although data arrive; empty if something has been.
        """
        book, before_ns = self._book, start_ns - round(verdict.gap_s * 1e9)
        missing = Evidence(start_ns=before_ns, end_ns=start_ns) if verdict.gap_s > 0 else None
        overloaded = dropped > 0 and verdict.gap_s > 0
        if verdict.gap_s >= self._silence_s and not overloaded:
            self._raise_silence(before_ns)
        # Blocks wait for a refused one as for one that comes late; meanwhile others after it are refused.
        until_ns = start_ns + _MOST_HOPS * self._hop_ns
        refused = self._refused if before_ns <= self._refused_ns < until_ns else ""
        self._refused = ""
        book.update_state(STREAM_LOST, False, self._found_again_ns(start_ns), at_once=True)
        if overloaded:
            note = self._add_unevaluated(blocks=dropped, gap_s=verdict.gap_s)
            book.update_state(OVERLOADED, True, start_ns, note, evidence=missing, at_once=True)
        elif verdict.gap_s > 0 and verdict.gap_s >= self._gap_s:
            book.update_state(GAP, True, start_ns, verdict.text, evidence=missing, at_once=True)
        if verdict.clock_step_s and not verdict.new_run:
            book.update_state(CLOCK, True, start_ns, verdict.text, at_once=True)
        torn = self._frequent_gaps(verdict, start_ns, refused)
        if torn:
            book.update_state(GAP, True, start_ns, torn, at_once=True)
        book.suppress(None, start_ns)
        return torn

    def _frequent_gaps(self, verdict: Admission, start_ns: int, refused: str) -> str:
        """Sentence saying that gaps, each too short for an alarm, are so frequent that no hop is whole; else empty."""
        if self._whole_ns is None or verdict.clock_step_s or verdict.gap_s >= self._gap_s:
            self._whole_ns = start_ns
        without_ns = start_ns - self._whole_ns
        if verdict.continuous or without_ns < _MOST_HOPS * self._hop_ns:
            return ""
        lost = f"are lost, or their times do not come from counting samples; the latest: {verdict.text}"
        return (
            f"no {self._hop_ns / 1e9:g} s without a gap for {without_ns / 1e9:.3g} s, so nothing is evaluated: blocks "
            f"{f'are refused, for example: {refused}' if refused else lost}"
        )

    def passed(self, time_ns: int, end_ns: int | None) -> None:
        """Raise the alarm on silence if the newest data ended long enough ago."""
        if end_ns is not None and time_ns - end_ns >= self._silence_ns:
            self._raise_silence(end_ns)

    def conflict(self, text: str, time_ns: int, *, at_once: bool = False) -> None:
        """Update the alarm on publishers that contradict each other; `text` is empty if none do."""
        self._book.update_state(CONFLICT, bool(text), time_ns, text, at_once=at_once)

    def hop(self, end_ns: int, *, skipped: bool) -> None:
        """Take note of a complete hop, without a gap: alarms on what could have spoiled it may clear.

        With `skipped`, its window is not evaluated because the monitor cannot keep up, which raises an alarm.
        """
        self._whole_ns = end_ns
        for name in (GAP, CLOCK) if skipped else (GAP, CLOCK, FAULT, OVERLOADED):
            self._book.update_state(name, False, end_ns)
        if skipped:
            evidence = Evidence(start_ns=end_ns - self._hop_ns, end_ns=end_ns)
            note = self._add_unevaluated(windows=1)
            self._book.update_state(OVERLOADED, True, end_ns, note, evidence=evidence, at_once=True)

    def sensors(self, findings: tuple[SensorFault, ...], statistics: WindowStatistics, *, standing: bool) -> None:
        """Update one alarm for each kind of fault, with a sentence for each channel it is found in.

        While the machine stands, most faults cannot be seen, so alarms that are present stay.
        """
        said: dict[str, list[str]] = {}
        for found in findings:
            # With any fault of the shaft angle the phase reference is lost.
            name = PHASE_REFERENCE if found.states == ("theta",) else data_alarm(found.kind)
            said.setdefault(name, []).append(found.text)
        evidence = Evidence(start_ns=statistics.start_ns, end_ns=statistics.end_ns)
        for name in (PHASE_REFERENCE, *map(data_alarm, FaultKind)):
            note = "; ".join(said.get(name, ()))
            small = name not in said and not standing
            self._book.update_state(name, name in said, statistics.end_ns, note, evidence=evidence, small=small)

    def fault(self, what: str, time_ns: int) -> None:
        """The monitor itself is at fault; that is over once a hop has been evaluated for the off-delay."""
        self._book.update_state(FAULT, True, time_ns, what, at_once=True)

    def _add_unevaluated(self, *, windows: int = 0, blocks: int = 0, gap_s: float = 0.0) -> str:
        """Add to what has not been evaluated since the alarm on it was raised, and return the sum in words."""
        if not self._book.present(OVERLOADED):
            self._unseen_windows, self._unseen_blocks, self._unseen_s = 0, 0, 0.0
        self._unseen_windows += windows
        self._unseen_blocks += blocks
        self._unseen_s += gap_s
        skipped = f"; windows skipped: {self._unseen_windows}" if self._unseen_windows else ""
        lost = f"; not evaluated: {self._unseen_blocks} blocks, {lasting(self._unseen_s)} of data"
        return f"this computer cannot keep up{skipped}{lost if self._unseen_blocks else ''}"

    def _raise_silence(self, end_ns: int) -> None:
        """Raise the alarm on silence, at the time at which it was due, so that live and replay say the same."""
        # Not blocks that came later, or just before the alarm was due: live they are not known yet.
        known = self._refused and end_ns - self._silence_ns < self._refused_ns < end_ns + self._silence_ns // 2
        refused = f"; the first block since was refused: {self._refused}" if known else ""
        note = f"no usable data for {self._silence_s:g} s; alarms already raised stay raised{refused}"
        due_ns = end_ns + self._silence_ns
        evidence = Evidence(start_ns=end_ns, end_ns=due_ns)
        self._book.update_state(STREAM_LOST, True, due_ns, note, evidence=evidence, at_once=True)
        self._book.suppress(None, due_ns)

    def _found_again_ns(self, start_ns: int) -> int:
        """When the silence ended: the time of its alarm, if late data without a gap are older than that."""
        raised_ns = next((one.raised_ns for one in self._book.alarms if one.name == STREAM_LOST), None)
        late = raised_ns is not None and 0 <= raised_ns - start_ns <= self._silence_ns
        return raised_ns if raised_ns is not None and late else start_ns
