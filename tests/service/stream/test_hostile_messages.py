"""Messages made to use up resources, forged blocks, and streams that no such rotor makes."""

import json
import struct
import threading
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import structlog
import zenoh

from models.alarm_names import CONFLICT, DATA, MODEL, STREAM_LOST, alarm_kind
from models.commissioning.commissioned import install
from models.descriptor import MOST_BYTES, MOST_DIFFERENCES, descriptor_mismatch
from models.machine import load_machine
from models.physics.rotor import PARAMETERS
from models.signals.block import SampleBlock
from models.signals.link import LinkSettings
from models.signals.wire import ARROW_ENCODING, BLOCK_ENCODING, REPLAY_MARK, encode_arrow, encode_block, sender_of
from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.example import example
from rotorwatch.records.health import HealthState, Report
from service.monitor.monitor import MachineMonitor
from service.runtime.runtime import running
from service.stream.inbox import Inbox, RawBlock
from service.stream.transport import Link, route
from tests.service.monitor.test_alarm_trouble import bench
from tests.service.rig.foreign import FOREIGN, Foreign, as_blocks, foreign, simulated
from tests.service.rig.live import (
    LAB,
    Feed,
    endpoint,
    fed_service,
    machine_file,
    open_session,
    scenario_blocks,
    service,
    settings,
    until,
)
from tests.service.rig.monitored import PLACE, client
from tests.service.rig.watching import at_once, feed, named, raised

KB = 1024


def empty_channels(count: int) -> bytes:
    fields = LAB.descriptor.model_dump(mode="json") | {"channels": [{}] * count}
    return json.dumps(fields).encode()


def other_names(length: int) -> bytes:
    fields = LAB.descriptor.model_dump(mode="json")
    channels = [one | {"name": "n" * length + one["name"]} for one in fields["channels"]]
    return json.dumps(fields | {"site": "s" * length, "channels": channels}).encode()


@pytest.mark.parametrize(
    "announced",
    [empty_channels(300_000), empty_channels(10_000), other_names(3_000), b"[" * 60_000, b'"' + b"x" * 60_000],
)
def test_the_differences_of_a_hostile_descriptor_are_kept_short(announced: bytes) -> None:
    said = descriptor_mismatch(announced, LAB)
    assert 1 <= len(said) <= MOST_DIFFERENCES + 1
    assert sum(map(len, said)) < 20 * KB
    if len(announced) > MOST_BYTES:
        assert said == (f"descriptor has {len(announced)} bytes, expected at most {MOST_BYTES}",)


def test_log_lines_on_descriptors_publishers_and_replays_are_limited(tmp_path: Path) -> None:
    with bench(tmp_path) as at, structlog.testing.capture_logs() as lines:
        for number in range(200):
            at.worker.descriptor(other_names(number + 1))
        assert len([line for line in lines if "differences" in line]) <= 2
        lines.clear()
        for number in range(200):
            at.worker.publisher(number % 2 == 0)
            at.worker.replay(number % 2 == 0)
        assert 1 <= len(lines) <= 4


def test_the_health_message_stays_small_whatever_is_sent() -> None:
    with fed_service() as (_, worker, feed):
        feed.put_good()
        feed.put_raw(b"", b"", "text/" + "x" * 200)
        feed.put_raw(b"", b"", f"{BLOCK_ENCODING};" + "y" * 200)
        payload, header = b"\0" * 7200, b"\0" * 32
        feed.put_raw(payload, header, f"{BLOCK_ENCODING};" + "z" * 200)
        feed.put(feed.block(), schema_hash="h" * 200)
        descriptor, block = empty_channels(300_000), zenoh.CongestionControl.BLOCK
        feed.session.put(LAB.keys.descriptor, descriptor, congestion_control=block)
        until(lambda: sum(worker.health().quality.refused_blocks.values()) == 4, "refusals")
        until(lambda: worker.health().stream.descriptor_mismatch != (), "the descriptor")
        assert len(worker.health().model_dump_json()) < 100 * KB
        feed.session.put(LAB.keys.descriptor, LAB.descriptor.model_dump_json(), congestion_control=block)
        until(lambda: worker.health().stream.descriptor_mismatch == (), "the right one")


def test_two_publishers_on_one_key_raise_a_conflict_alarm_with_their_runs() -> None:
    monitor = MachineMonitor(install(LAB, None))
    ours = scenario_blocks(10.0)
    theirs = [replace(one, run=2, samples=one.samples[::-1].copy()) for one in ours]
    for number, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        monitor.step_payload(*encode_block(a, ""))
        if number >= 20:
            monitor.step_payload(*encode_block(b, ""))
    (alarm,) = [alarm for alarm in monitor.health().alarms if alarm.raised]
    assert alarm.name == CONFLICT
    assert "runs 1 and 2" in alarm.note
    assert monitor.health().quality.accepted_blocks == len(ours)  # the first is not disturbed


@pytest.mark.parametrize("ahead", [0, pytest.param(1, marks=pytest.mark.long), 5])
def test_forged_blocks_raise_a_conflict_and_no_machine_alarm(ahead: int) -> None:
    monitor = MachineMonitor(install(at_once(LAB), None))
    ours = scenario_blocks(70.0)
    for number, one in enumerate(ours):
        later = number + ahead
        if number % 50 == 30 and later < len(ours):
            forged = replace(ours[later], samples=(1.4 * ours[later].samples).astype(np.float32))
            monitor.step_payload(*encode_block(forged, ""))
        monitor.step_payload(*encode_block(one, ""))
    monitor.flush()
    health = monitor.health()
    assert dict(health.quality.refused_blocks)["conflict"] == 14
    told = raised(monitor)
    assert CONFLICT in told
    assert {name for name in told if alarm_kind(name).about == "machine"} == set()


def misshapen(good: SampleBlock, rng: np.random.Generator) -> SampleBlock:
    """An unusable block whose run, number and time are close to those of a good one."""
    sequences = [good.sequence + ahead for ahead in (0, 1, 2, -1, int(rng.integers(40)))]
    sequence = max(0, [*sequences, 2**63, 2**64 - 1][rng.integers(7)])
    start_ns = good.start_ns + (min(sequence, good.sequence + 50) - good.sequence) * 10**8
    wrong: list[dict[str, object]] = [
        {"rate_hz": 1000.0}, {"samples": np.full_like(good.samples, np.nan)}, {"samples": good.samples[:1]},
        {"samples": good.samples[:, :3]}, {"start_ns": -1},
    ]  # fmt: skip
    place = {"sequence": sequence, "start_ns": start_ns, "run": int(rng.integers(1, 3))}
    return replace(good, **(place | wrong[rng.integers(5)]))  # type: ignore[arg-type]  # fields of any kind


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 4))])
def test_unusable_blocks_cost_no_good_block(seed: int) -> None:
    monitor, rng = MachineMonitor(install(LAB, None)), np.random.default_rng(seed)
    ours = scenario_blocks(30.0)
    for one in ours:
        if rng.random() < 0.5:
            forged = encode_block(misshapen(one, rng), "")
            assert not monitor.could_use(*forged)
            monitor.step_payload(*forged)
        assert monitor.could_use(*encode_block(one, ""))
        monitor.step_payload(*encode_block(one, ""))
    monitor.flush()
    quality = monitor.health().quality
    assert (quality.accepted_blocks, quality.gaps) == (len(ours), 0)
    assert not monitor.health().alarms


@pytest.mark.parametrize("encode", [encode_block, encode_arrow])
def test_usable_blocks_are_recognised_by_their_format(encode: Callable[..., tuple[bytes, bytes, str]]) -> None:
    monitor = MachineMonitor(install(LAB, None))
    (block,) = scenario_blocks(0.1)
    assert monitor.could_use(*encode(block, ""))
    assert monitor.could_use(*encode(block, LAB.descriptor.schema_hash))
    assert not monitor.could_use(
        *encode(replace(block, samples=np.tile(block.samples, (100, 1)).astype(np.float32)), "")
    )
    payload, attachment, encoding = encode(block, "")
    assert not monitor.could_use(payload, attachment, "text/plain")
    assert not monitor.could_use(payload[1:], attachment, encoding)


def test_a_forged_block_that_releases_waiting_ones_does_not_count_as_used() -> None:
    monitor, ours = MachineMonitor(install(LAB, None)), scenario_blocks(3.0)
    for one in ours[:5]:
        monitor.step_payload(*encode_block(one, ""))
        assert monitor.used
    for one in ours[6:26]:  # these wait for the missing one
        monitor.step_payload(*encode_block(one, ""))
        assert not monitor.used
    forged = replace(ours[0], sequence=90_000)
    reports = monitor.step_payload(*encode_block(forged, ""))
    assert any(report.verdict.accepted for report in reports)
    assert not monitor.used


def raw(run: int, size: int = 4, encoding: str = BLOCK_ENCODING, source: str = "") -> RawBlock:
    header = struct.pack("<qQdBBHI", 0, 0, 2000.0, 1, 1, run, size // 4)
    return RawBlock(b"\0" * size, header, encoding, source)


def test_non_blocks_take_no_room_and_a_queue_is_bounded_in_bytes_too() -> None:
    inbox = Inbox(10, "drop", may_be_block=lambda one, _: one.encoding == BLOCK_ENCODING)
    good = [raw(1) for _ in range(10)]
    for one in good:
        for _ in range(1000):
            inbox.put(raw(1, encoding="text/plain"))
        inbox.put(one)
    assert inbox.dropped == 0
    assert [inbox.get() for _ in range(10)] == good
    assert len(inbox) + inbox.unread == 10_000
    assert len(inbox) < 100  # only a few are decoded
    inbox = Inbox(1000, "drop", most_bytes=1_000_000)
    for _ in range(50):
        inbox.put(raw(1, size=100_000))
    assert len(inbox) <= 10
    assert inbox.dropped == 50 - len(inbox)
    first = inbox.get()
    assert isinstance(first, RawBlock)
    assert first.dropped_before == inbox.dropped  # of all the times that it was full


def test_only_the_followed_session_is_known_not_a_run_number_alone() -> None:
    told: list[bool] = []

    def may_be_block(_: RawBlock, known: bool) -> bool:
        told.append(known)
        return True

    inbox = Inbox(10, "drop", may_be_block=may_be_block)
    for followed, source in (("a", "a"), ("a", "b"), ("", "")):
        inbox.follow(raw(1, source=followed))
        inbox.put(raw(1, source=source))
    assert told == [True, False, False]


@pytest.mark.parametrize("same_run", [False, True])
def test_another_publisher_costs_the_followed_one_no_block(same_run: bool) -> None:
    inbox = Inbox(20, "drop")
    good = [raw(1, source="ours") for _ in range(15)]
    inbox.follow(good[0])
    for one in good:
        for run in range(2, 50):
            inbox.put(raw(1 if same_run else run, source="theirs"))
        inbox.put(one)
    assert inbox.dropped == 0  # of the publisher that is followed
    assert [inbox.get() for _ in range(15)] == good  # ahead of the others
    assert len(inbox) + inbox.unread == 15 * 48


def test_waiting_blocks_of_the_followed_publisher_come_first() -> None:
    inbox = Inbox(20, "drop")
    inbox.follow(raw(1))
    for run in (2, 3, 2, 3):
        inbox.put(raw(run))
    inbox.follow(raw(3))
    order = [inbox.get() for _ in range(4)]
    assert [sender_of(one.attachment, one.encoding)[1] for one in order if isinstance(one, RawBlock)] == [3, 3, 2, 2]


def test_a_flood_of_bad_messages_costs_no_good_block() -> None:
    """Ten thousand bad messages for every second of good data, at the pace of the data."""
    address = endpoint()
    with service(address, bound=100) as (_, worker), open_session(address) as session:
        feed, stop = Feed(session), threading.Event()
        bad = [b"", b"rubbish", b"\0" * 7200]
        misfits = [encode_block(misshapen(feed.block(), np.random.default_rng(seed)), "") for seed in range(50)]
        sent = [0]

        def flood() -> None:
            with open_session(address) as other:
                while not stop.wait(0.01):
                    for _ in range(100):
                        sent[0] += 1
                        kind = (BLOCK_ENCODING, ARROW_ENCODING, "text/plain")[sent[0] % 3]
                        other.put(LAB.keys.stream, bad[sent[0] % 3], attachment=b"x" * 32, encoding=kind)
                        payload, attachment, encoding = misfits[sent[0] % 50]
                        other.put(LAB.keys.stream, payload, attachment=attachment, encoding=encoding)

        thread = threading.Thread(target=flood)
        thread.start()
        try:
            for _ in range(20):
                feed.put_good()
                stop.wait(0.1)  # the length of a block
        finally:
            stop.set()
            thread.join()
        until(lambda: worker.health().quality.accepted_blocks == 20, "all good blocks")
        health = worker.health()
        assert (health.quality.gaps, health.quality.queue_dropped_blocks) == (0, 0)
        assert sum(health.quality.refused_blocks.values()) > 1000  # how many arrive depends on the network


def test_an_oversized_message_is_dropped_and_the_link_stays_open() -> None:
    address, key = endpoint(), LAB.keys.stream
    sizes: list[int] = []
    with closing(Link(LinkSettings(listen=(address,), max_message_mb=2.0))) as link, ExitStack() as stack:
        link.session.declare_subscriber(key, lambda sample: sizes.append(len(sample.payload)))
        sender = stack.enter_context(open_session(address))
        for size in (4_000_000, 1_900_000, 3_000_000):
            sender.put(key, bytes(size), congestion_control=zenoh.CongestionControl.BLOCK)
        sender.put(key, b"last", congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: 4 in sizes, "the last message")
    assert sizes == [1_900_000, 4]


@pytest.mark.parametrize("first", ["monitor", "token"])
def test_an_announced_replay_does_not_silence_a_live_machine(first: str) -> None:
    """Without grants anybody can announce a replay: the machine's own blocks are evaluated all the same."""
    address = endpoint()
    joined = LinkSettings(mode="client", connect=(address,))
    with route(LinkSettings(listen=(address,))), closing(Link(joined)) as liar:
        plan = settings(address, link=joined)
        announce = liar.session.liveliness().declare_token
        early = None if first == "monitor" else announce(LAB.keys.replay_alive)
        with running(plan) as runtime, open_session(address, "client") as session:
            worker, feed = runtime.machines()[0], Feed(session)
            feed.put_good(5)
            token = early or announce(LAB.keys.replay_alive)
            until(lambda: worker.health().stream.replay_announced, "the announcement")
            assert "replay" in worker.health().reason
            feed.put_good(5)
            until(lambda: worker.health().quality.accepted_blocks == 10, "all blocks of the machine")
            token.undeclare()  # type: ignore[no-untyped-call]
            until(lambda: not worker.health().stream.replay_announced, "its end")
            assert "replay" not in worker.health().reason
            feed.put_good(5)
            until(lambda: worker.health().quality.accepted_blocks == 15, "what comes afterwards")
            assert worker.health().quality.gaps == 0


def test_blocks_marked_as_replayed_are_ignored() -> None:
    with fed_service() as (_, worker, feed):
        feed.put_good()
        for one in scenario_blocks(2.0, start_ns=feed.start_ns, run=2):
            payload, header, encoding = encode_block(one, "")
            feed.put_raw(payload, header, encoding + REPLAY_MARK)
        feed.put_good()
        until(lambda: worker.health().quality.accepted_blocks == 2, "the machine's own blocks")
        assert worker.health().quality.refused_blocks == {}


def test_forged_messages_in_the_monitors_name_do_not_enter_its_history(tmp_path: Path) -> None:
    """Nor does a liveliness token without a publisher hide that the data have stopped."""
    address, quick = endpoint(), ("[operation]", "[ingest]\nno_data_after_s = 1.0\nblock_to_s = 0.5\n\n[operation]")
    with service(address, machine_file(tmp_path, quick)) as (runtime, worker), open_session(address) as session:
        _token = session.liveliness().declare_token(LAB.keys.publisher_alive)
        feed, forged = Feed(session), AlarmCloudEvent.model_validate(example(AlarmCloudEvent)).model_dump_json()
        feed.put_good()
        until(lambda: worker.health().stream.publisher_alive, "the token")
        for key in (LAB.keys.alarm_event, LAB.keys.alarm_state, LAB.keys.health, LAB.keys.report):
            session.put(key, forged)
        feed.put_good()
        until(lambda: worker.health().quality.accepted_blocks == 2, "what came after the forgeries")
        until(lambda: worker.history.last_sequence == 0, "an alarm of the monitor's own")
        with client(runtime) as http:
            (event,) = http.get(f"{PLACE}/alarms/events").json()["events"]
            health = http.get(f"{PLACE}/health").json()
            assert http.get(f"{PLACE}/reports").json()["reports"] == []
        assert (event["data"]["name"], health["state"]) == (STREAM_LOST, "no-data")
        assert health["stream"]["publisher_alive"]


DURATION_S = 63.0
SEED = 7_730_001
LONG = pytest.mark.long


def watched(name: str, kind: Foreign, seed: int) -> tuple[list[Report], set[str]]:
    """Reports of full windows, and names of the alarms raised."""
    machine = at_once(load_machine(name))
    monitor = MachineMonitor(install(machine, None))
    windows, events = feed(monitor, as_blocks(machine, foreign(machine, kind, seed, DURATION_S)))
    return [one for one in windows if one.filled == 1], {name for what, name in named(events) if what == "raised"}


CASES = [
    *(pytest.param("lab", kind, SEED, marks=LONG if kind in ("two sines", "drift") else ()) for kind in FOREIGN),
    # A sine far from every mode of the lightly damped machine looks like the one resonance of a softer shaft.
    *(pytest.param(name, kind, SEED + 2, marks=LONG) for name in ("heavy", "light") for kind in FOREIGN),
]


@pytest.mark.parametrize(("name", "kind", "seed"), CASES)
def test_no_parameter_is_blamed_for_a_stream_that_no_rotor_makes(name: str, kind: Foreign, seed: int) -> None:
    windows, raised = watched(name, kind, seed)
    assert windows
    assert not raised & set(PARAMETERS)
    assert raised
    assert all(alarm == MODEL or alarm.startswith(DATA) for alarm in raised)
    for window in windows:
        assert window.state not in {HealthState.HEALTHY, HealthState.DANGER}
        assert window.reason
        assert not window.suspect or ("sine" in kind and window.suspect.startswith("a line "))
        assert all(reading.relative_change is None for reading in window.parameters)
        assert window.verdict is None or not window.verdict.changed


# Factors of both masses, length and inertia. The first fits no parameters except for ten seconds at a time, the second
# fits those of a machine with another shaft.
@pytest.mark.parametrize(
    ("duration_s", "factors"),
    [pytest.param(110.0, (0.44, 0.7, 0.54, 0.61), marks=LONG), (70.0, (0.56, 1.33, 0.7, 0.44))],
)
def test_no_parameter_is_blamed_if_the_file_is_of_another_rotor(
    duration_s: float, factors: tuple[float, float, float, float]
) -> None:
    machine = load_machine("lab")
    rotor, (m1, m2, length, inertia) = machine.rotor, factors
    other = rotor.model_copy(update={
        "m1_kg": m1 * rotor.m1_kg, "m2_kg": m2 * rotor.m2_kg, "shaft_length_m": length * rotor.shaft_length_m,
        "I2_kg_m2": inertia * rotor.I2_kg_m2, "I2p_kg_m2": inertia * rotor.I2p_kg_m2,
    })  # fmt: skip
    monitor = MachineMonitor(install(machine, None))
    samples = simulated(machine.model_copy(update={"rotor": other}), SEED, duration_s)
    _, events = feed(monitor, as_blocks(machine, samples))
    assert {name for what, name in named(events) if what == "raised"} == {MODEL}


@pytest.mark.parametrize(("gain", "unbalance", "name"), [(25.4, 1.0, MODEL), (1.0, 10.0, "e")])
def test_wrong_units_raise_a_model_alarm_and_not_unbalance(gain: float, unbalance: float, name: str) -> None:
    machine = at_once(load_machine("lab"))
    rotor = machine.rotor.model_copy(update={"e_m": unbalance * machine.rotor.e_m})
    samples = simulated(machine.model_copy(update={"rotor": rotor}), SEED, DURATION_S).copy()
    samples[:, [channel.name != "theta" for channel in machine.sensors]] *= gain
    monitor = MachineMonitor(install(machine, None))
    _, events = feed(monitor, as_blocks(machine, samples))
    assert [alarm for what, alarm in named(events) if what == "raised"] == [name]
    assert ("check the units of the channels and e_m" in events[0].text) == (name == MODEL)
