"""Runs recordings through the monitor's data path, with a chosen machine file, at full speed, without network or clock.

The blocks meet the same `MachineMonitor` as they would live, so the reports are the same to the last bit. Windows that
the live monitor skipped, because it could not keep up, are skipped here as well: its recorded reports say which.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterable
from contextlib import suppress

from models.commissioning.commissioned import Installed, install
from models.descriptor import descriptor_mismatch
from models.diagnosis.networks.bundle import MANIFEST, SHIPPED_BUNDLES
from models.errors import MachineFileError, RecordingError
from models.machine import SHIPPED_MACHINES, MachineFile, load_machine_file
from models.mistakes import changed, checked, parse_toml
from models.physics.rotor import PARAMETERS
from models.signals.keys import MachineKeys
from models.signals.recording import RecordedMessage
from rotorwatch.records.health import Report
from rotorwatch.records.replays import OfflineSummary, ParameterLimits, ReplayProgress
from service.monitor.conversion import alarm_cloud_event
from service.monitor.monitor import MachineMonitor
from service.monitor.reports import Identity, MonitorReport
from service.recordings.replay.player import Control
from service.recordings.replay.source import RecordingSource

_LONGEST_LINE = 500


def result_lines(identity: Identity, keys: MachineKeys, report: MonitorReport) -> list[str]:
    """JSON lines of one block's results: topic and message, in the order of their data time, report before alarm."""
    timed = [(window.end_ns, 0, keys.report, window.model_dump_json()) for window in report.windows]
    timed += [
        (event.time_ns, 1, keys.alarm_event, alarm_cloud_event(identity, event).model_dump_json())
        for event in report.events
    ]
    ordered = sorted(timed, key=lambda entry: entry[:2])  # stable: several events of one window keep their order
    return [f'{{"topic": {json.dumps(topic)}, "message": {text}}}' for _, _, topic, text in ordered]


def skipped_windows(source: RecordingSource, keys: MachineKeys) -> frozenset[int]:
    """Ends of the windows that the monitor skipped when they were recorded, as far as its reports can be read."""
    found: set[int] = set()
    with suppress(RecordingError):  # damage is reported where the blocks are read
        for message in source.messages({keys.report}):
            if b'"skipped":true' in message.payload:
                with suppress(ValueError):  # anybody may have sent it
                    report = Report.model_validate_json(message.payload)
                    found |= {report.end_ns} if report.skipped else set()
    return frozenset(found)


class OfflineReplay:
    """One run of recordings through a monitor: blocks from `from_ns` up to, and without, `to_ns`, as data time.

    `write` takes each result line, without its line end.
    """

    def __init__(
        self,
        source: RecordingSource,
        keys: MachineKeys,
        installed: Installed,
        write: Callable[[str], object],
        *,
        from_ns: int | None = None,
        to_ns: int | None = None,
    ) -> None:
        self._source = source
        self._keys = keys
        self._machine = machine = installed.machine
        self._write = write
        span = source.span(keys)
        self._from_ns = span.start_ns if from_ns is None else from_ns
        self._to_ns = span.end_ns + 1 if to_ns is None else to_ns
        self._monitor = MachineMonitor(installed, skipped_windows(source, keys).__contains__, remembered=False)
        self.identity = self._monitor.identity
        self._digest = hashlib.sha256()
        self._windows = self._alarms = self._messages = 0
        self._data_s = 0.0
        # How the recorded channel descriptor differs from the machine file, one sentence per field.
        self.descriptor_differences: tuple[str, ...] = ()
        self._other_name = (machine.site, machine.name) != (keys.site, keys.machine)
        descriptor = source.descriptor(keys, self._from_ns)
        if descriptor is not None:
            self._describe(descriptor)

    def run(
        self, control: Control | None = None, on_progress: Callable[[ReplayProgress], None] = lambda _: None
    ) -> OfflineSummary:
        """Replay, until the end or until `control` says stop; raises `RecordingError` where a recording is damaged."""
        control, begin_s = control or Control(), time.perf_counter()
        keys = {self._keys.stream, self._keys.descriptor}
        for time_ns, message in self._source.timed(keys, from_ns=self._from_ns, to_ns=self._to_ns):
            if control.stopped:
                break
            self._messages += 1
            if message.key == self._keys.descriptor:
                self._describe(message)
                continue
            encoding = self._encoding(message.encoding)
            self._note(self._monitor.step_payload(message.payload, message.attachment, encoding))
            on_progress(self._progress(time_ns))
        if not control.stopped:
            self._note(self._monitor.flush())
            on_progress(self._progress(self._to_ns - 1))
        return self._summary(time.perf_counter() - begin_s, stopped=control.stopped)

    def _describe(self, message: RecordedMessage) -> None:
        found = descriptor_mismatch(message.payload, self._machine)
        self.descriptor_differences = tuple(dict.fromkeys((*self.descriptor_differences, *found)))

    def _note(self, reports: Iterable[MonitorReport]) -> None:
        for report in reports:
            self._data_s += report.data_s
            self._windows += len(report.windows)
            self._alarms += len(report.events)
            for line in result_lines(self.identity, self._machine.keys, report):
                self._digest.update(line.encode() + b"\n")
                self._write(line)

    def _encoding(self, encoding: str) -> str:
        """Leave out the schema hash where it differs only because the machine has another name.

        The hash covers site and name; with another machine's file the number of channels is checked, and every other
        difference of the descriptors is stated.
        """
        only_named = all(text.startswith(("site is ", "machine is ")) for text in self.descriptor_differences)
        return encoding.partition(";")[0] if self._other_name and only_named else encoding

    def _progress(self, at_ns: int) -> ReplayProgress:
        length_ns = max(1, self._to_ns - 1 - self._from_ns)
        return ReplayProgress(
            fraction=min(1.0, max(0.0, (at_ns - self._from_ns) / length_ns)),
            position_ns=at_ns,
            messages=self._messages,
            windows=self._windows,
            alarms=self._alarms,
            pass_number=1,
            paused=False,
        )

    def _summary(self, elapsed_s: float, *, stopped: bool) -> OfflineSummary:
        health = self._monitor.health()
        quality = health.quality
        return OfflineSummary(
            **self.identity,
            windows=self._windows,
            skipped_windows=quality.skipped_windows,
            alarms=self._alarms,
            raised=tuple(alarm.name for alarm in health.alarms if alarm.raised),
            blocks=quality.accepted_blocks,
            refused_blocks=quality.refused_blocks,
            last_refusal=quality.last_refusal,
            gaps=quality.gaps,
            missing_s=quality.missing_s,
            data_s=round(self._data_s, 6),
            elapsed_s=round(elapsed_s, 3),
            times_real_time=round(self._data_s / max(elapsed_s, 1e-9), 1),
            descriptor_differences=self.descriptor_differences,
            first_windows=self._monitor.first_windows,
            limits={
                name: ParameterLimits(**self._machine.alarms.for_parameter(name).model_dump()) for name in PARAMETERS
            },
            stopped=stopped,
            sha256=self._digest.hexdigest(),
        )


def choose_machine(keys: MachineKeys, wanted: str | None, changes: str = "") -> Installed:
    """Load the machine file, and what was trained or commissioned, for a recorded machine.

    `wanted` is ``FILE`` or ``FILE@BUNDLE``, shipped names or paths. Without it, the shipped machine with the recorded
    site and name is taken, with its shipped networks. `changes` are TOML that overrides fields of the machine file.

    Raises
    ------
    MachineFileError
        If the file cannot be used, or none was named and no shipped machine fits.
    BundleError
        If the bundle cannot be used, or the machine needs one that was commissioned.
    """
    if wanted is not None:
        before, found, name = wanted.partition(".toml@")  # the name of a folder may hold an @ as well
        if found or before.endswith(".toml"):
            file = before + found.removesuffix("@")
        else:
            file, _, name = wanted.partition("@")
        return install(load_machine_file(file, changes), name or None)
    shipped = sorted(SHIPPED_MACHINES.glob("*.toml"))
    for path in shipped:
        machine = load_machine_file(path)
        if (machine.site, machine.name) == (keys.site, keys.machine):
            return install(load_machine_file(path, changes), path.stem if is_shipped_bundle(path.stem) else None)
    names = ", ".join(path.stem for path in shipped)
    raise MachineFileError(
        f"the recording is of {keys.site}/{keys.machine}, and none of the shipped machines ({names}) has this site "
        "and name: name its machine file, as --machine FILE or --machine FILE@BUNDLE"
    )


def check_sent(text: str, changes: str, recorded: str) -> None:
    """Check the text of a machine file that is to be used for a recorded machine.

    Raises
    ------
    MachineFileError
        Naming the field, the value found and what was expected; also if it is of another machine than ``site/name``.
    """
    place = "machine_file"
    for number, line in enumerate(text.splitlines(), start=1):
        if len(line) > _LONGEST_LINE:  # reading it may take long: as the square of the length
            raise MachineFileError(
                f"{place}: line {number} has {len(line)} characters, at most {_LONGEST_LINE} are read"
            )
    machine = checked(MachineFile, changed(parse_toml(text, place), changes), place)
    if machine.title != recorded:
        raise MachineFileError(f"{place}: of {machine.title}, the recordings are of {recorded}")


def is_shipped_machine(name: str) -> bool:
    """Whether a machine file of this name is shipped."""
    return name in {path.stem for path in SHIPPED_MACHINES.glob("*.toml")}


def is_shipped_bundle(name: str) -> bool:
    """Whether trained networks of this name are shipped."""
    return name in {path.name for path in SHIPPED_BUNDLES.iterdir() if (path / MANIFEST).is_file()}
