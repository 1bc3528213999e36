"""A defect in the monitor, a state that cannot be saved, a computer that cannot keep up: each has its own alarm."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from models.alarm_names import FAULT, GAP, OVERLOADED, STREAM_LOST
from models.commissioning.commissioned import install
from models.machine import Machine
from models.signals.wire import ARROW_ENCODING, encode_block, write_arrow
from rotorwatch.records.alarms import Evidence
from rotorwatch.records.health import HealthState
from service.history.records import Checkpoint
from service.monitor.known_machine import KnownMachineEvaluator
from service.monitor.monitor import MachineMonitor
from service.monitor.reports import identity_of
from service.stream.checkpoints import checkpoint_step, restored
from tests.service.monitor.test_alarm_trouble import bench, block, order
from tests.service.rig.live import (
    IN_ORDER,
    LAB,
    PATIENT,
    START_NS,
    endpoint,
    fed_service,
    machine_file,
    scenario_blocks,
    send,
    service,
    until,
)
from tests.service.rig.monitored import client
from tests.service.rig.watching import named, raised

DEFECT = "a defect of the evaluation"


def defective(*_: object, **__: object) -> None:
    raise RuntimeError(DEFECT)


def machine_in_order() -> Machine:
    """The rotor kit without patience for late blocks."""
    fields = LAB.model_dump()
    fields["ingest"] |= {"reorder_blocks": 0}
    return Machine.model_validate(fields)


def soon_over(machine: Machine) -> Machine:
    """The machine with alarms that clear after 10 s."""
    return machine.model_copy(update={"alarms": machine.alarms.model_copy(update={"off_delay_s": 10.0})})


def test_a_defect_in_evaluation_raises_an_alarm_and_is_not_healthy(monkeypatch: pytest.MonkeyPatch) -> None:
    monitor = MachineMonitor(install(soon_over(LAB), None))
    *stream, later = scenario_blocks(92.1)
    for one in stream[:660]:
        monitor.step(one)
    assert monitor.health().state is HealthState.HEALTHY
    with monkeypatch.context() as patch:
        patch.setattr(KnownMachineEvaluator, "evaluate", defective)
        reports = [monitor.step(one) for one in stream[660:710]]
    (window,) = (window for report in reports for window in report.windows)
    assert window.state is HealthState.NOT_EVALUABLE
    assert DEFECT in window.reason
    assert [str(report.fault) for report in reports if report.fault is not None] == [DEFECT]
    assert [event for report in reports for event in named(report.events)] == [("raised", FAULT)]
    health = monitor.health()
    assert (health.state, raised(monitor)) == (HealthState.NOT_EVALUABLE, {FAULT})
    assert DEFECT in health.reason
    # Its end clears the alarm.
    events = [event for one in stream[710:] for event in monitor.step(one).events]
    assert named(events) == [("cleared", FAULT)]
    assert (monitor.health().state, monitor.health().reason) == (HealthState.HEALTHY, "")
    # A defect before the evaluation.
    monkeypatch.setattr(monitor._window, "feed", defective)
    report = monitor.step(later)
    assert (str(report.fault), named(report.events)) == (DEFECT, [("raised", FAULT)])
    assert monitor.health().state is HealthState.NOT_EVALUABLE
    assert DEFECT in monitor.health().reason


def test_a_service_with_a_defect_is_not_ready_with_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(KnownMachineEvaluator, "evaluate", defective)
    address = endpoint()
    with service(address, machine_file(tmp_path, PATIENT), when_full="wait") as (runtime, worker):
        send(address, scenario_blocks(70.0), worker.machine)
        until(lambda: worker.tally.windows >= 13, "all windows")
        with client(runtime) as http:
            health = http.get("/api/v1/machines/demo/lab/health").json()
            assert health["state"] == "not-evaluable"
            assert DEFECT in health["reason"]
            assert [alarm["name"] for alarm in health["alarms"] if alarm["raised"]] == [FAULT]
            answer = http.get("/readyz")
        assert answer.status_code == 503
        (reason,) = answer.json()["reasons"]
        assert reason.startswith("demo/lab: ")
        assert DEFECT in reason
        until(lambda: worker.errors == worker.tally.windows - 11, "an error for each window that was full")


def test_blocks_dropped_by_the_monitor_are_overload_until_it_keeps_up_and_no_gap() -> None:
    monitor, stream = MachineMonitor(install(soon_over(machine_in_order()), None)), scenario_blocks(60.0)

    def give(number: int, dropped: int) -> None:
        monitor.step_payload(*encode_block(stream[number], ""), dropped)

    for number in range(20):
        give(number, 0)
    give(120, 100)  # 10 s, longer than a silence may last
    assert raised(monitor) == {OVERLOADED}
    assert {alarm.name for alarm in monitor.health().alarms} & {GAP, STREAM_LOST} == set()
    (alarm,) = monitor.health().alarms
    assert "100 blocks" in alarm.note
    assert "10 s" in alarm.note
    for number in range(121, 130):
        give(number, 0)
    give(150, 20)
    (alarm,) = monitor.health().alarms
    assert "120 blocks" in alarm.note
    assert "12 s" in alarm.note
    # A gap in the stream itself is still one.
    give(190, 0)
    assert raised(monitor) == {OVERLOADED, GAP}
    for number in range(191, 450):  # keeps up
        give(number, 0)
    assert raised(monitor) == set()


def test_a_full_queue_raises_the_overload_alarm(tmp_path: Path) -> None:
    with fed_service(machine_file(tmp_path, IN_ORDER), bound=30) as (_, worker, feed):
        feed.put_good()
        until(lambda: worker.health().quality.accepted_blocks == 1, "first block")
        held = np.zeros(1, dtype=bool)
        worker.inbox.call(lambda: until(lambda: bool(held[0]), "the end of the hold-up"))
        feed.put_good(40)
        until(lambda: worker.inbox.dropped == 30, "a queue that was thrown away")
        held[0] = True
        until(lambda: worker.health().quality.gaps == 1, "what came after")
        (alarm,) = worker.alarms().alarms
        assert (alarm.name, alarm.raised) == (OVERLOADED, True)
        assert "30 blocks" in alarm.note
        assert "cannot keep up" in worker.health().quality.last_gap
        (event,) = worker.history.events()
        assert event.alarm == OVERLOADED


def test_alarms_are_logged_even_if_no_checkpoint_can_be_built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with bench(tmp_path) as at:
        at.put(block(0))
        with monkeypatch.context() as patch:
            patch.setattr(MachineMonitor, "state", defective)
            at.put(block(30, run=2, sequence=0))
            assert [(kind, alarm) for _, kind, alarm in at.log()] == [
                ("raised", STREAM_LOST), ("cleared", STREAM_LOST), ("raised", GAP), ("raised", FAULT)
            ]  # fmt: skip
            assert len(at.outlet.events) == 4
            assert DEFECT in at.worker.trouble
        at.put(*(block(number, run=2, sequence=number - 30) for number in range(31, 45)))
        at.worker.operate(order("acknowledge", GAP))
        assert at.worker.trouble == ""
    with bench(tmp_path) as at:
        assert at.worker.restart.startswith("resumed")
        assert at.log()[-1][1:] == ("acknowledged", GAP)
        monkeypatch.setattr(MachineMonitor, "state", defective)  # nor does it prevent the last step
        at.worker.stop()
        assert not at.worker.status().alive
        assert DEFECT in at.worker.last_error


@pytest.mark.parametrize("kind", ["unheard-of", "gap"])
def test_an_event_without_a_text_holds_up_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    told = []
    with bench(tmp_path) as at:
        at.put(block(0))
        book = at.worker._monitor.alarms
        poison = Evidence.model_construct(start_ns=0, end_ns=1, confidence="not a number") if kind == "gap" else None  # type: ignore[arg-type]
        at.worker.inbox.call(
            lambda: told.append(book.update_state(f"data-{kind}", True, START_NS, evidence=poison, at_once=True))
        )
        at.settle()
        at.worker.operate(order("shelve", "k_by"))
        assert [(kind, alarm) for _, kind, alarm in at.log()][:2] == [("raised", f"data-{kind}"), ("shelved", "k_by")]
        assert len(at.outlet.events) == len(at.log())
        assert (kind == "gap") == (FAULT in {alarm for _, _, alarm in at.log()})
    assert told


INTEGER = st.one_of(st.integers(-(2**70), 2**70), st.sampled_from([0, 2**16 - 1, 2**63 - 1, 2**64 - 1, 10**4300]))


@settings(max_examples=40)
@given(
    headers=st.lists(
        st.tuples(INTEGER, INTEGER, st.sampled_from([LAB.rate_hz, 1e-320, 1e6, 1e308, float("nan")]), INTEGER),
        min_size=1,
        max_size=4,
    ),
    start_ns=st.one_of(st.just(START_NS), INTEGER),
)
@example(headers=[(0, 0, LAB.rate_hz, 0), (0, 0, LAB.rate_hz, 1)], start_ns=START_NS)  # two versions of one block
def test_the_state_after_any_headers_can_be_restored(headers: list[tuple[int, int, float, int]], start_ns: int) -> None:
    installed = install(machine_in_order(), None)
    monitor = MachineMonitor(installed)
    good = block(0)
    for number, (sequence, run, rate_hz, step_ns) in enumerate(headers):
        whole = {"start_ns": start_ns + number * step_ns, "sequence": sequence, "run": run}
        metadata = {"rate_hz": repr(rate_hz), **{name: decimal(value) for name, value in whole.items()}}
        payload = write_arrow(good.samples, metadata)
        monitor.step_payload(payload, b"", ARROW_ENCODING)
    identity = identity_of(installed)
    step = checkpoint_step(identity, monitor.state(), 1)
    again, text = restored(lambda: MachineMonitor(installed), identity, Checkpoint(step.head, step.new_parts), 0)
    assert again.state().state == monitor.state().state
    assert text.startswith("resumed")


def decimal(value: int) -> str:
    """An integer in decimal, also beyond Python's limit of digits."""
    return str(value) if abs(value) < 10**4000 else "1" + "0" * 4300
