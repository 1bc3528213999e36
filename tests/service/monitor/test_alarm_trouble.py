"""No alarm may be lost: defects, a history that refuses steps, stepped clocks, stopped processes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from models.alarm_names import CLOCK, FAULT, GAP, STREAM_LOST
from models.checkpoint import from_bytes, to_bytes
from models.commissioning.commissioned import Installed, install
from models.errors import CheckpointError
from models.ingest import Reason
from models.machine import AlarmSettings, Machine
from models.signals.block import SampleBlock
from models.signals.keys import Topic
from models.signals.wire import encode_block
from models.stream_settings import IngestSettings
from rotorwatch.records.alarms import AlarmState
from rotorwatch.records.example import example
from rotorwatch.records.health import HealthState, Report
from service.history.machine import MachineStore
from service.history.records import Checkpoint, Step, StoreError
from service.history.store import Store
from service.monitor.alarms.alarm import OperatorAction
from service.monitor.alarms.book import AlarmBook
from service.monitor.monitor import MachineMonitor
from service.monitor.reports import Identity, identity_of
from service.settings.service import QueueSettings
from service.stream.checkpoints import checkpoint_step, restored, stored_readings
from service.stream.inbox import RawBlock
from service.stream.liveness import Clocks
from service.stream.worker import MachineWorker
from tests.service.rig.live import LAB, START_NS, until
from tests.service.rig.postgres import opened
from tests.service.rig.watching import named, resumed
from tests.sure import sure

S = 10**9
BLOCK_NS = S // 2
HOUR_S = 3600.0
REAL = Clocks()
YEAR_NS = 365 * 86400 * S


def machine(**alarms: object) -> Machine:
    """The rotor kit, with a data path that waits for up to 8 blocks."""
    fields = LAB.model_dump()
    fields["ingest"] |= {"reorder_blocks": 8}
    fields["alarms"] |= alarms
    return Machine.model_validate(fields)


def block(number: int, start_ns: int = START_NS, run: int = 1, sequence: int | None = None) -> SampleBlock:
    """Half a second of noise, so many blocks after `start_ns`."""
    samples = np.random.default_rng(number).normal(0, 1e-6, (round(LAB.rate_hz / 2), len(LAB.sensors)))
    place = number if sequence is None else sequence
    return SampleBlock(start_ns + number * BLOCK_NS, place, run, LAB.rate_hz, samples.astype(np.float32))


def order(kind: str, name: str, **more: object) -> OperatorAction:
    return OperatorAction(kind, name, "anna", **{"reason": "told so", **more})  # type: ignore[arg-type]


class Outlet:
    """Collects published events; fails while `is_gone`, as without a network."""

    def __init__(self) -> None:
        self.events: list[str] = []
        self.is_gone = False

    def __call__(self, topic: Topic, text: str) -> None:
        if topic == "alarm_event":
            if self.is_gone:
                raise OSError("no route")
            self.events.append(text)


class Bench:
    """A worker without a network, with a history in a file."""

    def __init__(self, store: Store, installed: Installed, clocks: Clocks = REAL, outlet: Outlet | None = None) -> None:
        self.store = store
        self.history = store.machine("demo", "lab")
        self.worker = MachineWorker(installed, QueueSettings(blocks=10_000), self.history, clocks)
        self.outlet = outlet or Outlet()
        self.worker.start(self.outlet)

    def put(self, *blocks: SampleBlock) -> None:
        for one in blocks:
            self.worker.inbox.put(RawBlock(*encode_block(one, self.worker.machine.descriptor.schema_hash)))
        self.settle()

    def settle(self) -> None:
        done: list[bool] = []
        until(lambda: len(self.worker.inbox) == 0, "empty queue")
        self.worker.inbox.call(lambda: done.append(True))
        until(lambda: bool(done), "idle monitor")

    def tick(self) -> None:
        self.worker.tick()
        self.settle()

    def log(self) -> list[tuple[int, str, str]]:
        return [(one.sequence, one.kind, one.alarm) for one in self.history.events(limit=1000)]

    def shelf_s(self, name: str) -> float:
        """How long an alarm stays shelved, from the end of the newest data."""
        alarm = next(one for one in self.worker.alarms().alarms if one.name == name)
        end_ns = sure(self.worker._monitor.end_ns)
        return (sure(alarm.shelf).until_ns - end_ns) / S


@contextmanager
def bench(folder: Path, clocks: Clocks = REAL, **alarms: object) -> Iterator[Bench]:
    with opened(f"sqlite:///{folder / 'history.sqlite'}") as store:
        made = Bench(store, install(machine(**alarms), None), clocks)
        try:
            yield made
        finally:
            made.worker.stop()


def watched(monkeypatch: pytest.MonkeyPatch, look: Callable[[Step], None]) -> None:
    commit = MachineStore.commit

    def looked_at(history: MachineStore, step: Step) -> bool:
        look(step)
        return commit(history, step)

    monkeypatch.setattr(MachineStore, "commit", looked_at)


TWO_HOLES = (*range(21), *range(25, 29), *range(41, 44))
"""Block numbers that arrive: a hole of 2 s, and one of 6 s, longer than a silence may last."""
TOLD = [(0, "raised", GAP), (1, "raised", STREAM_LOST), (2, "cleared", STREAM_LOST)]


def test_log_and_alarm_state_agree_in_every_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Several blocks are due at once: a crash between two commits must not leave alarms without events."""
    committed = [0]

    def agree(step: Step) -> None:
        committed[0] += len(step.events)
        book = AlarmBook(AlarmSettings())
        book.restore(sure(step.checkpoint).head.alarms)
        assert book.next_sequence == committed[0]

    watched(monkeypatch, agree)
    with bench(tmp_path) as at:
        at.put(*map(block, TWO_HOLES))
        assert at.log() == []  # blocks after a hole wait
        at.put(block(44, run=2, sequence=0))
        assert at.worker.errors == 0, at.worker.last_error
        assert at.log() == TOLD


def test_a_defect_after_an_alarm_loses_no_event(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with bench(tmp_path) as at:
        window = at.worker._monitor._window
        feed = window.feed

        def defective(samples: np.ndarray, start_ns: int) -> Iterator[int]:
            if start_ns == block(41).start_ns:
                raise ZeroDivisionError("defect")
            return feed(samples, start_ns)

        monkeypatch.setattr(window, "feed", defective)
        at.put(*map(block, TWO_HOLES), block(44, run=2, sequence=0))
        assert at.worker.errors == 1
        at.put(block(45, run=2, sequence=1))
        at.worker.operate(order("acknowledge", GAP))
        assert (at.log(), len(at.outlet.events)) == ([*TOLD, (3, "raised", FAULT), (4, "acknowledged", GAP)], 5)


def test_events_refused_by_the_history_are_written_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refusing = [True]

    def refuse(step: Step) -> None:
        if step.events and refusing:
            raise StoreError("demo/lab: refused")

    watched(monkeypatch, refuse)
    with bench(tmp_path) as at:
        at.put(block(0), block(30, run=2, sequence=0))
        # Events are published all the same, and the refused ones enter the log before the alarm on the refusal.
        assert [len(at.outlet.events), at.worker.errors] == [4, 2]
        # The trouble is of this machine: the history of others works.
        assert {FAULT, GAP} <= {alarm.name for alarm in at.worker.alarms().alarms if alarm.raised}
        assert ("refused" in at.worker.trouble, at.store.writer.trouble) == (True, "")
        refusing.clear()
        at.worker.operate(order("acknowledge", GAP))
        assert at.worker.trouble == ""
        assert [kind for _, kind, _ in at.log()] == ["raised", "cleared", "raised", "raised", "acknowledged"]
        assert (at.log()[3], len(at.outlet.events)) == ((3, "raised", FAULT), 5)  # once only
    with bench(tmp_path) as at:
        assert at.worker.restart.startswith("resumed")


def test_an_operation_succeeds_without_a_network(tmp_path: Path) -> None:
    with bench(tmp_path) as at:
        at.put(block(0))
        at.outlet.is_gone = True
        (event,) = at.worker.operate(order("shelve", "k_by"))
        assert event.data.kind == "shelved"
        assert (at.log(), at.worker.last_error) == ([(0, "shelved", "k_by")], "OSError: no route")


@pytest.mark.parametrize(("by_the_log", "expected"), [(5, 5), (1, 3)], ids=["log ahead", "log begun anew"])
def test_no_sequence_number_is_used_twice(by_the_log: int, expected: int) -> None:
    book = AlarmBook(AlarmSettings())
    for _ in range(3):
        book.operate(order("shelve", "k_by"), 0)
    again = AlarmBook(AlarmSettings())
    again.restore(book.checkpoint(), next_sequence=by_the_log)
    (event,) = again.operate(order("unshelve", "k_by"), 1)
    assert event.sequence == expected


def test_alarms_of_unknown_names_are_not_restored() -> None:
    book = AlarmBook(AlarmSettings())
    book.operate(order("shelve", "k_by"), 0)
    book.operate(order("shelve", "model"), 0)
    again = AlarmBook(AlarmSettings())
    again.restore(book.checkpoint().replace("k_by", "k_bx"))
    assert [one.name for one in again.alarms] == ["model"]


def test_a_checkpoint_with_an_unknown_health_state_is_refused() -> None:
    monitor = MachineMonitor(install(machine(), None))
    arrays = from_bytes(monitor.state().state) | {"calm": np.array(["splendid"])}
    with pytest.raises(CheckpointError, match=r"calm is .*splendid.*, expected one of warming, healthy"):
        MachineMonitor(install(machine(), None)).restore(to_bytes(arrays), ())


def test_shelving_keeps_its_length_when_a_wrong_clock_is_corrected(tmp_path: Path) -> None:
    with bench(tmp_path) as at:
        at.put(*(block(number, START_NS + YEAR_NS) for number in range(3)))
        at.worker.operate(order("shelve", "k_by", duration_s=HOUR_S))
        at.put(*(block(number) for number in range(3, 20)))
        assert (1, "raised", CLOCK) in at.log()
        at.worker.operate(order("shelve", "model", duration_s=HOUR_S))
        assert at.shelf_s("model") == pytest.approx(HOUR_S, abs=60)
        assert at.shelf_s("k_by") == pytest.approx(HOUR_S, abs=60)


def test_shelving_before_any_data_keeps_its_length(tmp_path: Path) -> None:
    with bench(tmp_path) as at:
        at.worker.operate(order("shelve", "k_by", duration_s=HOUR_S))
    with bench(tmp_path) as at:  # and after a restart
        at.worker.operate(order("remove-from-service", "e"))
        at.put(block(0))  # data time is months away from the time of day
        at.worker.operate(order("shelve", "model", duration_s=HOUR_S))
        assert at.shelf_s("k_by") == pytest.approx(HOUR_S, abs=60)
        assert at.shelf_s("model") == pytest.approx(HOUR_S, abs=60)


def test_shelving_expires_without_data(tmp_path: Path) -> None:
    now_ns = [START_NS]
    with bench(tmp_path, Clocks(utc_ns=lambda: now_ns[0])) as at:
        at.worker.operate(order("shelve", "k_by", duration_s=HOUR_S))
        now_ns[0] += 3601 * S
        at.tick()
        assert at.log() == [(0, "shelved", "k_by"), (1, "unshelved", "k_by")]


def test_shelving_expires_while_blocks_come_in() -> None:
    monitor = MachineMonitor(install(machine(), None))
    monitor.step(block(0))
    monitor.operate(order("shelve", "k_by", duration_s=1.5), START_NS + S)
    told = [event for number in range(1, 8) for event in monitor.step(block(number)).events]
    assert [(event.kind.value, event.time_ns - START_NS) for event in told] == [("unshelved", 2_500_000_000)]


@pytest.mark.parametrize(
    ("later_ns", "expected"),
    [
        (30 * S, [("raised", STREAM_LOST), ("cleared", STREAM_LOST), ("raised", GAP)]),
        (2 * S, [("raised", GAP)]),
        (0, []),
        (-10 * S, []),  # a publisher's cache
        (-YEAR_NS, [("raised", CLOCK)]),
        (YEAR_NS, [("raised", CLOCK)]),
    ],
)
def test_alarms_keep_their_data_time_under_another_machine_file(later_ns: int, expected: list[tuple[str, str]]) -> None:
    before = MachineMonitor(install(machine(), None))
    before.step(block(0))
    end_ns = block(0).end_ns
    before.operate(order("shelve", "k_by", duration_s=HOUR_S), end_ns)
    identity = Identity(site="demo", machine="lab", bundle=None, machine_hash="old")
    step = checkpoint_step(identity, before.state(), 1)
    then = Checkpoint(step.head, step.new_parts)
    changed = install(machine(on_delay_s=77.0), None)
    now = identity_of(changed)
    after, text = restored(lambda: MachineMonitor(changed), now, then, 1)
    assert "the window is filling anew: machine file was old" in text
    assert after.end_ns == end_ns
    report = after.step(block(1, end_ns + later_ns - BLOCK_NS))
    assert named(report.events) == expected
    (shelf,) = (one.shelf for one in after.health().alarms if one.name == "k_by")
    moved_ns = later_ns if abs(later_ns) == YEAR_NS else 0
    assert sure(shelf).until_ns == end_ns + 3600 * S + moved_ns


def test_what_another_state_of_the_program_remembered_is_called_that() -> None:
    installed = install(machine(), None)
    before = MachineMonitor(installed)
    before.step(block(0))
    step = checkpoint_step(identity_of(installed), before.state(), 1)
    arrays = dict(from_bytes(step.head.state))
    del arrays["data_path/unseen"]
    then = Checkpoint(replace(step.head, state=to_bytes(arrays)), step.new_parts)
    _, text = restored(lambda: MachineMonitor(installed), identity_of(installed), then, 1)
    assert "anew: what is remembered does not fit this state of the program (unseen is missing)" in text


def test_a_lost_stream_is_noticed_after_the_machine_file_has_changed() -> None:
    monitor = MachineMonitor(install(machine(), None))
    monitor.restore_alarms(AlarmBook(AlarmSettings()).checkpoint(), 0, START_NS)
    assert monitor.passed(START_NS + 4 * S) == ()
    (event,) = monitor.passed(START_NS + 9 * S)
    assert (event.kind, event.alarm.name, event.time_ns) == ("raised", STREAM_LOST, START_NS + 5 * S)


def test_stream_lost_names_why_blocks_were_refused() -> None:
    """NaN in a sensor costs whole blocks; the text does not depend on a restart."""
    monitor = MachineMonitor(install(machine(), None))
    for number in range(4):
        one = block(number)
        one.samples[10, 2] = np.nan if number else 0.0
        (report,) = monitor.step_payload(*encode_block(one, ""))
        assert report.verdict.accepted is (number == 0)
    for each in (monitor, resumed(monitor, install(machine(), None))):
        (event,) = each.passed(block(0).end_ns + 5 * S)
        assert event.alarm.name == STREAM_LOST
        assert "the first block since was refused: demo/lab: block 1, channel y1_dot: sample 10 is nan" in event.text


def test_stream_lost_does_not_name_blocks_refused_later() -> None:
    """Whether or not time passed before: an offline replay must give the monitor's text."""
    for live in (True, False):
        monitor = MachineMonitor(install(machine(), None))
        monitor.step(block(0))
        events = [*monitor.passed(block(0).end_ns + 5 * S)] if live else []
        late = block(16)
        late.samples[10, 2] = np.nan
        events += [*monitor.step(late).events, *monitor.step(block(20)).events]
        texts = [one.text for one in events if (one.kind, one.alarm.name) == ("raised", STREAM_LOST)]
        assert len(texts) == 1
        assert "refused" not in texts[0]


@pytest.mark.parametrize("start_ns", [-1, 2**63 - 1, 10**30])
def test_blocks_with_impossible_times_are_refused(start_ns: int) -> None:
    monitor = MachineMonitor(install(machine(), None))
    verdict = monitor.step(replace(block(0), start_ns=start_ns)).verdict
    assert verdict.reason is Reason.MALFORMED
    assert f"start_ns of block 0 is {start_ns}, expected a time from 1970 to 2199" in verdict.text
    assert monitor.step(block(0)).verdict.accepted


def test_a_stopped_program_does_not_report_a_silence_at_once(tmp_path: Path) -> None:
    now_s = [0.0]
    with bench(tmp_path, Clocks(monotonic_s=lambda: now_s[0])) as at:
        at.put(block(0))
        now_s[0] += 60.0  # stopped by the system: blocks of that time are still to come
        at.tick()
        assert not at.worker.health().stream.silent
        at.put(block(1))
        assert at.log() == []
        for _ in range(6):
            now_s[0] += 1.0
            at.tick()
        assert at.worker.health().stream.silent
        assert at.log() == [(0, "raised", STREAM_LOST)]
        for _ in range(3):  # and stays silent, however often the program is stopped
            now_s[0] += 2.5
            at.tick()
            assert at.worker.health().stream.silent
        assert at.log() == [(0, "raised", STREAM_LOST)]


def test_a_stream_gets_time_to_resume_after_a_restart(tmp_path: Path) -> None:
    now_s, now_ns = [0.0], [START_NS]
    clocks = Clocks(monotonic_s=lambda: now_s[0], utc_ns=lambda: now_ns[0])
    with bench(tmp_path, clocks) as at:
        at.put(block(0))
        assert at.worker.health().state is HealthState.WARMING
    now_ns[0] += 3600 * S
    with bench(tmp_path, clocks) as at:
        assert at.worker.health().state is HealthState.NO_DATA  # the state of an hour ago is not current
        for seconds, expected in ((19, []), (2, [(0, "raised", STREAM_LOST)])):
            for _ in range(seconds):
                now_s[0] += 1.0
                at.tick()
            assert at.log() == expected
        at.put(block(1))
        assert not at.worker.health().stream.silent


def test_health_is_updated_twice_a_second_and_after_the_last_waiting_block(tmp_path: Path) -> None:
    now_s, seen = [0.0], list[int]()
    with opened(f"sqlite:///{tmp_path / 'history.sqlite'}") as store:
        clocks = Clocks(monotonic_s=lambda: now_s[0])
        worker = MachineWorker(install(machine(), None), QueueSettings(), store.machine("demo", "lab"), clocks)
        for number in range(5):
            worker.inbox.put(RawBlock(*encode_block(block(number), "")))
        for now_s[0] in (0.0, 0.1, 0.4, 0.6, 0.7):
            one = worker.inbox.get()
            assert isinstance(one, RawBlock)
            worker._take(one)
            seen.append(worker.health().quality.accepted_blocks)
    assert seen == [1, 1, 1, 4, 5]


def test_no_data_after_s_must_exceed_the_longest_block() -> None:
    with pytest.raises(ValueError, match="no_data_after_s is 5, expected more than block_to_s, 30"):
        IngestSettings(block_to_s=30.0)


def test_an_alarm_is_unsuppressed_when_its_rule_is_removed() -> None:
    rules = [{"alarms": ["k_by"], "while_alarm": "data-stuck", "because": "a sensor is stuck"}]
    book = AlarmBook(AlarmSettings.model_validate({"suppress": rules}))
    book.update_state("data-stuck", True, 0, at_once=True)
    book.update_state("k_by", True, 0, at_once=True)
    assert named(book.suppress(None, 1)) == [("suppressed", "k_by")]
    without = AlarmBook(AlarmSettings())
    without.restore(book.checkpoint())
    assert named(without.suppress(None, 2)) == [("unsuppressed", "k_by")]
    assert {one.name: one.state for one in without.alarms}["k_by"] is AlarmState.UNACKNOWLEDGED


def test_rules_with_equal_texts_are_distinguished_and_an_unknown_speed_keeps_speed_rules() -> None:
    rules = [
        {"alarms": ["model"], "while_alarm": "data-stuck", "because": "known"},
        {"alarms": ["model"], "below_rpm": 600, "because": "known"},
    ]
    book = AlarmBook(AlarmSettings.model_validate({"suppress": rules}))
    book.update_state("data-stuck", True, 0, at_once=True)
    book.suppress(1320.0, 1)  # the machine runs at speed: only the stuck sensor suppresses
    book.update_state("data-stuck", False, 2, at_once=True)
    again = AlarmBook(AlarmSettings.model_validate({"suppress": rules}))
    again.restore(book.checkpoint())
    for one in (book, again):
        assert named(one.suppress(None, 2)) == [("unsuppressed", "model")]
        assert named(one.suppress(500.0, 3)) == [("suppressed", "model")]
        assert one.suppress(None, 4) == ()


def test_a_rule_on_stream_lost_suppresses_while_it_is_raised() -> None:
    rules = [{"alarms": ["data-gap"], "while_alarm": "stream-lost", "because": "said already"}]
    monitor = MachineMonitor(install(machine(suppress=rules), None))
    monitor.step(block(0))
    assert named(monitor.passed(START_NS + 9 * S)) == [("raised", STREAM_LOST), ("suppressed", GAP)]


def test_gaps_and_silences_have_the_time_without_data_as_evidence() -> None:
    monitor = MachineMonitor(install(machine(), None))
    monitor.step(block(0))
    lost, again, gap = monitor.step(block(21, sequence=21, run=2)).events
    assert named((lost, again, gap)) == [("raised", STREAM_LOST), ("cleared", STREAM_LOST), ("raised", GAP)]
    end_ns = block(0).end_ns
    for event, until_ns in ((lost, end_ns + 5 * S), (gap, block(21).start_ns)):
        evidence = sure(event.alarm.evidence)
        assert (evidence.start_ns, evidence.end_ns) == (end_ns, until_ns)
    monitor = MachineMonitor(install(machine(), None))
    monitor.step(block(0))
    (lost,) = monitor.passed(START_NS + 20 * S)
    (again,) = monitor.step(block(1)).events
    assert (lost.kind, again.kind) == ("raised", "cleared")
    assert again.time_ns == lost.time_ns == block(0).end_ns + 5 * S


def test_a_nan_reading_is_left_out_of_the_history() -> None:
    said = {"speed_rad_s": float("nan"), "misfit_z": 2.0, "parameters": (), "equations": (), "levels": ()}
    window = Report.model_validate(example(Report) | said)
    assert [one.quantity for one in stored_readings([window])] == ["misfit"]
