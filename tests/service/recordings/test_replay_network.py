"""What a replay publishes, under which keys, and that it never mixes with or disturbs a live machine."""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from models.alarm_names import STREAM_LOST
from models.commissioning.commissioned import install
from models.signals.link import LinkSettings
from models.signals.recording import RecordedMessage, read_recording
from rotorwatch.records.replays import OfflineSummary
from service.recordings.replay.offline import OfflineReplay
from service.recordings.replay.player import Control
from service.recordings.replay.source import RecordingSource
from service.runtime.runtime import running
from service.stream.inbox import RawBlock
from service.stream.replay_link import LiveMachineError, NetworkPlan, replay_to_network
from service.stream.transport import Link, MachineCallbacks, MachineLink, TopicMessage, follow, route
from service.stream.worker import MachineWorker
from simulator.scenario import parse_fault
from tests.loopback import session_of
from tests.service.rig.live import (
    LAB,
    endpoint,
    ignore,
    no_events,
    scenario_blocks,
    send,
    service,
    settings,
    until,
    worker_of,
)
from tests.service.rig.replaying import digest_of, lines_of, recording, write

Heard = list[tuple[str, bytes, bytes, str]]
BLOCKS = 700


def session(listen: str, namespace: str = "") -> zenoh.Session:
    return session_of(LinkSettings(listen=(listen,), namespace=namespace))


def plan(source: RecordingSource, address: str, prefix: str, **changes: object) -> NetworkPlan:
    fields: dict[str, object] = {
        "link": LinkSettings(mode="client", connect=(address,)), "machines": source.machines, "everything": False,
        "prefix": prefix, "pace": None, "passes": 1, "from_ns": source.span().start_ns,
        "to_ns": source.span().end_ns + 1, "linger_s": 0.3,
    }  # fmt: skip
    return NetworkPlan(**(fields | changes))  # type: ignore[arg-type]  # fields of many types


@contextmanager
def hearing(session: zenoh.Session, key: str = "**") -> Iterator[Heard]:
    heard = Heard()

    def collect(sample: zenoh.Sample) -> None:
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        heard.append((str(sample.key_expr), sample.payload.to_bytes(), attachment, str(sample.encoding)))

    subscriber = session.declare_subscriber(key, collect)
    yield heard
    subscriber.undeclare()  # type: ignore[no-untyped-call]


def as_heard(message: RecordedMessage, prefix: str) -> tuple[str, bytes, bytes, str]:
    return (prefix + message.key, message.payload, message.attachment, message.encoding)


@pytest.fixture
def source(tmp_path: Path) -> RecordingSource:
    messages = list(read_recording(recording(tmp_path / "plain.mcap", scenario_blocks(3.0))))
    report = RecordedMessage(LAB.keys.report, b"{}", b"", "application/json", messages[5].log_time_ns, 7)
    return RecordingSource([write(tmp_path / "more.mcap", [*messages[:6], report, *messages[6:]])])


@pytest.mark.parametrize("everything", [False, True])
def test_messages_are_replayed_byte_for_byte(source: RecordingSource, everything: bool) -> None:
    address, alive = endpoint(), list[str]()
    with session(address) as listener, hearing(listener) as heard:
        tokens = listener.liveliness().declare_subscriber(
            "x/rotorwatch/**", lambda sample: alive.append(f"{sample.kind} {sample.key_expr}"), history=True
        )
        replay_to_network(source, plan(source, address, "x", everything=everything), Control())
        sent = [one for one in source.messages() if everything or one.key != LAB.keys.report]
        expected = [as_heard(one, "x/") for one in sent]
        until(lambda: len(heard) >= len(expected), "everything")
        until(lambda: len(alive) == 2, "the token's end")
        tokens.undeclare()  # type: ignore[no-untyped-call]
    # Different keys may overtake each other.
    for key in {entry[0] for entry in expected}:
        assert [entry for entry in heard if entry[0] == key] == [entry for entry in expected if entry[0] == key]
    assert len(heard) == len(expected)
    assert alive == [f"SampleKind.{kind} x/{LAB.keys.publisher_alive}" for kind in ("PUT", "DELETE")]


def test_a_section_begins_with_the_descriptor_valid_then(source: RecordingSource) -> None:
    address = endpoint()
    begin_ns, end_ns = source.span().start_ns + 10**9, source.span().start_ns + 2 * 10**9
    with session(address, "x") as listener, hearing(listener, "rotorwatch/**") as heard:
        replay_to_network(source, plan(source, address, "x", from_ns=begin_ns, to_ns=end_ns), Control())
        until(lambda: len(heard) >= 11, "everything")
    (descriptor,) = [entry for entry in heard if entry[0] == LAB.keys.descriptor]
    assert json.loads(descriptor[1]) == LAB.descriptor.model_dump(mode="json")
    blocks = [as_heard(one, "") for one in source.messages({LAB.keys.stream}, from_ns=begin_ns, to_ns=end_ns)]
    assert [entry for entry in heard if entry[0] == LAB.keys.stream] == blocks
    assert len(blocks) == 10


def test_each_pass_has_a_prefix_of_its_own(source: RecordingSource) -> None:
    address = endpoint()
    with session(address) as listener, hearing(listener, "**/stream") as heard:
        count = replay_to_network(source, plan(source, address, "r/x", passes=2), Control())
        until(lambda: len(heard) == 60, "both passes")
    assert count == 62
    assert [entry[0] for entry in heard] == [f"r/x/{number}/{LAB.keys.stream}" for number in (1, 2) for _ in range(30)]


@pytest.mark.parametrize("who", ["publisher", "monitor"])
def test_original_keys_are_refused_while_a_publisher_or_monitor_is_alive(source: RecordingSource, who: str) -> None:
    address, alive = endpoint(), getattr(LAB.keys, f"{who}_alive")
    with session(address) as other, hearing(other) as heard:
        token = other.liveliness().declare_token(alive)
        with pytest.raises(LiveMachineError, match=f"a live {who} of demo/lab is there .{alive}.: replay under"):
            replay_to_network(source, plan(source, address, ""), Control())
        token.undeclare()  # type: ignore[no-untyped-call]
    assert heard == []


def replay_until_refused(source: RecordingSource, what: NetworkPlan, errors: list[str]) -> None:
    try:
        replay_to_network(source, what, Control())
    except LiveMachineError as error:
        errors.append(str(error))


@pytest.mark.parametrize("who", ["publisher", "monitor"])
def test_replay_on_original_keys_stops_when_a_publisher_or_monitor_appears(source: RecordingSource, who: str) -> None:
    address, errors = endpoint(), list[str]()
    with session(address) as other, hearing(other, LAB.keys.stream) as heard:
        # Three seconds of recording at this pace would take half a minute.
        slow = plan(source, address, "", pace=0.1)
        thread = threading.Thread(target=replay_until_refused, args=(source, slow, errors))
        thread.start()
        until(lambda: bool(heard), "first block")
        token = other.liveliness().declare_token(getattr(LAB.keys, f"{who}_alive"))
        thread.join()
        token.undeclare()  # type: ignore[no-untyped-call]
    (error,) = errors
    assert error.startswith(f"a live {who} of demo/lab is there")
    assert error.endswith("the replay on the original keys was stopped")
    assert 1 <= len(heard) < 30


def test_a_monitor_started_during_a_replay_on_original_keys_takes_no_block(source: RecordingSource) -> None:
    address, taken, errors = endpoint(), list[RawBlock](), list[str]()

    callbacks = MachineCallbacks(taken.append, ignore, ignore, ignore, lambda: "{}", lambda: "{}", no_events)
    with route(LinkSettings(listen=(address,))):
        other = Link(LinkSettings(mode="client", connect=(address,)))
        slow = plan(source, address, "", pace=0.5)
        thread = threading.Thread(target=replay_until_refused, args=(source, slow, errors))
        with hearing(other.session, LAB.keys.stream) as heard:
            thread.start()
            until(lambda: bool(heard), "first block")
        late = Link(LinkSettings(mode="client", connect=(address,)))
        monitor = MachineLink(late, LAB.keys, callbacks, wait_when_full=False)
        thread.join()
        assert errors  # the replay has noticed the monitor
        monitor.close()
        late.close()
        other.close()
    assert taken == []


def offline(file: Path) -> tuple[OfflineSummary, list[str]]:
    lines: list[str] = []
    source = RecordingSource([file])
    run = OfflineReplay(source, source.machine(), install(LAB, "lab"), lines.append)
    return run.run(), lines


@contextmanager
def monitor_in(namespace: str, link: LinkSettings) -> Iterator[MachineWorker]:
    apart = link.model_copy(update={"namespace": namespace})
    with running(settings(endpoint(), bundle="lab", bound=2000, link=apart)) as runtime:
        yield worker_of(runtime)


def test_a_replay_does_not_disturb_a_live_monitor(tmp_path: Path) -> None:
    """A healthy machine live, and on the same network the replay of its fault with a second monitor."""
    faulty = recording(tmp_path / "faulty.mcap", scenario_blocks(BLOCKS / 10, parse_fault("c_bz=0.5@0")))
    expected, _ = offline(faulty)
    assert (expected.windows, expected.alarms, expected.raised) == (13, 1, ("c_bz",))
    assert (expected.blocks, expected.refused_blocks, expected.stopped) == (BLOCKS, {}, False)
    assert expected.data_s == pytest.approx(BLOCKS / 10)
    assert expected.descriptor_differences == ()
    healthy = scenario_blocks(BLOCKS / 10)
    undisturbed, lines = offline(recording(tmp_path / "healthy.mcap", healthy))
    assert undisturbed.alarms == 0
    address, source = endpoint(), RecordingSource([faulty])
    heard: list[TopicMessage] = []
    client = LinkSettings(mode="client", connect=(address,))
    with (
        service(address, bundle="lab", bound=2000) as (_, live),
        monitor_in("replay/x", client) as replayed,
        follow(client, "demo/lab", ("alarm_event", "report"), heard.append),
    ):
        paced = plan(source, address, "replay/x", pace=30.0, wait_for_subscriber_s=20.0)
        thread = threading.Thread(target=replay_to_network, args=(source, paced, Control()))
        thread.start()
        until(lambda: replayed.health().quality.accepted_blocks > 0, "replayed blocks")
        assert not live.health().stream.publisher_alive
        assert live.health().quality.accepted_blocks == 0
        send(address, healthy)
        thread.join()
        until(lambda: live.health().quality.accepted_blocks == BLOCKS, "live blocks")
        until(lambda: replayed.health().quality.accepted_blocks == BLOCKS, "replayed blocks")
        until(lambda: len(heard) >= undisturbed.windows, "live reports")
        health, elsewhere = live.health(), replayed.health()
        said, digests = lines_of(live), (digest_of(live), digest_of(replayed))
    assert health.quality.refused_blocks == elsewhere.quality.refused_blocks == {}
    assert elsewhere.stream.descriptor_mismatch == ()
    assert health.quality.queue_dropped_blocks == health.quality.link_missed_blocks == 0
    # The live machine may go silent while the replay is still running; no other alarm is allowed.
    assert {alarm.name for alarm in health.alarms} <= {STREAM_LOST}
    assert said == lines
    assert digests == (undisturbed.sha256, expected.sha256)  # the replayed monitor did raise its alarm
    reports = [message for message in heard if message.key == LAB.keys.report]
    assert len(reports) == undisturbed.windows
    assert all(STREAM_LOST in message.text for message in heard if message not in reports)
