"""The stream, identical for any block length, and its publisher over real Zenoh sessions, awaited without sleeping."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import zenoh
import zenoh.ext

from models.errors import MachineFileError
from models.signals.block import FloatArray
from models.signals.channels import ChannelDescriptor
from models.signals.link import LinkSettings
from models.signals.wire import ARROW_ENCODING, decode_block
from simulator.publisher import PublishError, PublishSettings, publish
from simulator.scenario import ChannelSettings, Event, Scenario, Sensors, load_scenario, parse_fault
from simulator.stream import DEFAULT_START_NS, RunSummary, TruthRecord, blocks
from tests.loopback import endpoint, session_of
from tests.service.rig.live import until

HEALTHY, MACHINE = load_scenario("healthy")
SENT = HEALTHY.overridden(duration_s=6.0, faults=[parse_fault("k_by=-0.25@3")])


@pytest.fixture(name="endpoint")
def _endpoint() -> str:
    return endpoint()


@pytest.fixture
def monitor(endpoint: str) -> Iterator[zenoh.Session]:
    """A session that listens where the publisher connects."""
    with session_of(LinkSettings(listen=(endpoint,))) as session:
        yield session


class _Received:
    """Collects samples of a key the way the monitor does: with history and recovery."""

    def __init__(self, session: zenoh.Session, key: str, delay_s: float = 0.0) -> None:
        self.samples: list[tuple[bytes, bytes, str]] = []
        self._delay_s = delay_s
        self._subscriber = zenoh.ext.declare_advanced_subscriber(
            session, key, self._keep, history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=300),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )  # fmt: skip

    def _keep(self, sample: zenoh.Sample) -> None:
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        self.samples.append((sample.payload.to_bytes(), attachment, str(sample.encoding)))
        time.sleep(self._delay_s)

    @property
    def sequences(self) -> list[int]:
        return [decode_block(*sample).sequence for sample in self.samples]


@contextmanager
def _publishing(
    endpoint: str, on_block: Callable[[RunSummary], None] | None = None, scenario: Scenario = SENT, **settings: Any
) -> Iterator[tuple[threading.Event, list[RunSummary | Exception]]]:
    stop = threading.Event()
    outcome: list[RunSummary | Exception] = []
    link = LinkSettings(connect=(endpoint,))

    def run() -> None:
        try:
            made = blocks(scenario, MACHINE, run=7)
            outcome.append(publish(MACHINE, made, PublishSettings(link, **settings), stop=stop, on_block=on_block))
        except Exception as error:  # handed to the test
            outcome.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield stop, outcome
    finally:
        stop.set()
        thread.join(180)
        assert not thread.is_alive()


def test_a_late_subscriber_receives_everything(endpoint: str, monitor: zenoh.Session) -> None:
    half = threading.Event()
    with _publishing(endpoint, lambda s: half.set() if s.blocks >= 40 else None, pace=20.0, linger_s=60.0) as (
        stop,
        outcome,
    ):
        assert half.wait(180)
        stream = _Received(monitor, MACHINE.keys.stream)
        truth = _Received(monitor, MACHINE.keys.truth)
        descriptor = _Received(monitor, MACHINE.keys.descriptor)
        until(lambda: len(stream.samples) >= 60, "60 blocks")
        until(lambda: len(truth.samples) >= 2, "two truth records")
        until(lambda: len(descriptor.samples) >= 1, "descriptor")
        stop.set()
    (summary,) = outcome
    assert isinstance(summary, RunSummary)
    assert (summary.blocks, summary.data_s) == (60, 6.0)
    assert stream.sequences == list(range(60))
    for sample, (block, _) in zip(stream.samples, blocks(SENT, MACHINE, run=7), strict=True):
        received = decode_block(*sample)
        assert received.schema_hash == MACHINE.descriptor.schema_hash
        assert (received.run, received.start_ns) == (7, block.start_ns)
        np.testing.assert_array_equal(received.samples, block.samples)
    records = [TruthRecord.model_validate_json(payload) for payload, _, _ in truth.samples]
    assert [record.relative_changes["k_by"] for record in records] == [0.0, -0.25]
    assert {encoding for _, _, encoding in truth.samples} == {"application/json"}
    assert ChannelDescriptor.model_validate_json(descriptor.samples[0][0]) == MACHINE.descriptor


def test_the_descriptor_answers_a_query_and_a_token_shows_the_publisher(endpoint: str, monitor: zenoh.Session) -> None:
    changes: list[zenoh.SampleKind] = []
    monitor.liveliness().declare_subscriber(
        MACHINE.keys.publisher_alive, lambda s: changes.append(s.kind), history=True
    )
    with _publishing(endpoint, pace=1.0) as (stop, _):
        until(lambda: changes == [zenoh.SampleKind.PUT], "publisher")
        replies = [reply.ok for reply in monitor.get(MACHINE.keys.descriptor, timeout=60)]
        stop.set()
    ok = [reply for reply in replies if reply is not None]
    assert [str(reply.encoding) for reply in ok] == ["application/json"]
    assert ChannelDescriptor.model_validate_json(ok[0].payload.to_bytes()) == MACHINE.descriptor
    until(lambda: changes == [zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE], "end of the publisher")


def test_an_unpaced_stream_waits_for_a_slow_subscriber_and_loses_nothing(endpoint: str, monitor: zenoh.Session) -> None:
    """More than cache and sockets hold, to a subscriber slower than the simulation; the session closes at once."""
    with monitor.declare_queryable(MACHINE.keys.health, lambda query: query.reply(MACHINE.keys.health, b"{}")):
        stream = _Received(monitor, MACHINE.keys.stream, delay_s=0.003)
        with _publishing(
            endpoint, scenario=SENT.overridden(duration_s=150.0), pace=None, wait_for_subscriber_s=30.0, linger_s=0.0
        ) as (_, outcome):
            until(lambda: len(outcome) == 1, "end of the stream", 60.0)
            until(lambda: len(stream.samples) >= 1500, "last block", 60.0)
    assert isinstance(outcome[0], RunSummary)
    assert outcome[0].blocks == 1500
    assert stream.sequences == list(range(1500))


def test_an_unpaced_stream_waits_for_a_subscriber_that_was_lost(endpoint: str) -> None:
    """It does not send the rest to nobody and leave: the next subscriber gets everything."""
    lost = threading.Event()

    def on_block(summary: RunSummary) -> None:
        if summary.blocks == 10:
            lost.wait(180)

    with _publishing(endpoint, on_block, pace=None, wait_for_subscriber_s=180.0, linger_s=1e6) as (stop, outcome):
        with session_of(LinkSettings(listen=(endpoint,))) as monitor:
            stream = _Received(monitor, MACHINE.keys.stream)
            until(lambda: len(stream.samples) >= 10, "10 blocks")
        lost.set()
        with session_of(LinkSettings(listen=(endpoint,))) as monitor:
            stream = _Received(monitor, MACHINE.keys.stream)
            until(lambda: len(stream.samples) >= 60, "last block")
            stop.set()
    assert isinstance(outcome[0], RunSummary)
    assert sorted(stream.sequences) == list(range(60))


def test_arrow_streams_carry_the_same_samples(endpoint: str, monitor: zenoh.Session) -> None:
    stream = _Received(monitor, MACHINE.keys.stream)
    with _publishing(endpoint, pace=None, encoding="arrow", wait_for_subscriber_s=30.0):
        until(lambda: len(stream.samples) >= 60, "60 blocks")
    received = [decode_block(*sample) for sample in stream.samples]
    assert {sample[2] for sample in stream.samples} == {f"{ARROW_ENCODING};{MACHINE.descriptor.schema_hash}"}
    for one, (other, _) in zip(received, blocks(SENT, MACHINE), strict=True):
        np.testing.assert_array_equal(one.samples, other.samples)


def test_nothing_is_sent_before_there_is_a_subscriber(endpoint: str, monitor: zenoh.Session) -> None:
    alive = threading.Event()
    monitor.liveliness().declare_subscriber(MACHINE.keys.publisher_alive, lambda _: alive.set(), history=True)
    sent = threading.Event()
    with _publishing(endpoint, lambda _: sent.set(), pace=1.0, wait_for_subscriber_s=60.0) as (stop, outcome):
        assert alive.wait(180)
        # Answered by the waiting publisher: it is up, and has had every occasion to send.
        assert len(list(monitor.get(MACHINE.keys.descriptor, timeout=60))) == 1
        assert not sent.is_set()
        stream = _Received(monitor, MACHINE.keys.stream)
        assert sent.wait(180)
        stop.set()
    assert isinstance(outcome[0], RunSummary)
    until(lambda: stream.sequences[:1] == [0], "first block")


def test_no_subscriber_in_time_is_an_error(endpoint: str) -> None:
    with _publishing(endpoint, pace=1.0, wait_for_subscriber_s=0.1) as (_, outcome):
        until(lambda: len(outcome) == 1, "outcome")
    assert isinstance(outcome[0], PublishError)
    assert "nobody subscribed to rotorwatch/demo/lab/stream within 0.1 s" in str(outcome[0])


@pytest.mark.parametrize("settings", [{"wait_for_subscriber_s": 1e6}, {"pace": 1e-6}, {"pace": None, "linger_s": 1e6}])
def test_a_stop_ends_every_wait(endpoint: str, settings: dict[str, Any]) -> None:
    with _publishing(endpoint, **settings) as (stop, outcome):
        stop.set()
    assert isinstance(outcome[0], RunSummary)
    assert outcome[0].blocks <= 60


def test_pace_follows_the_data_time(endpoint: str) -> None:
    """A block goes out after its last sample: never early, however fast the machine is."""
    summaries: list[RunSummary] = []
    with _publishing(endpoint, summaries.append, pace=30.0, linger_s=0.0) as (_, outcome):
        until(lambda: len(outcome) == 1, "end of the stream")
    assert [summary.blocks for summary in summaries] == list(range(1, 61))
    assert all(summary.elapsed_s >= summary.data_s / 30.0 - 1e-3 for summary in summaries)


EVENTS = (
    Event(at_s=1.0, ramp_s=2.5, parameter="k_by", relative_change=-0.3),
    Event(at_s=1.2345, sensor="y1", sensor_fault="stuck"), Event(at_s=2.0, sensor="z2", sensor_fault="dropout"),
    Event(at_s=2.2, sensor="y1", sensor_fault="none"), Event(at_s=3.0111, speed_rpm=1500.0),
    Event(at_s=3.3, source="disc y", force_rms_N=2.0), Event(at_s=3.5, parameter="e", relative_change=0.3),
)  # fmt: skip
SCENARIO = HEALTHY.overridden(duration_s=4.2345, faults=EVENTS)


def _all(scenario: Scenario, block_s: float = 0.1) -> tuple[FloatArray, list[TruthRecord]]:
    stream = list(blocks(scenario, MACHINE, block_s))
    samples = np.concatenate([block.samples for block, _ in stream])
    return np.asarray(samples, dtype=np.float64), [entry for _, truth in stream for entry in truth]


@pytest.mark.parametrize("block_s", [0.0005, 0.37, 100.0])
def test_the_block_length_changes_no_bit(block_s: float) -> None:
    samples, truth = _all(SCENARIO)
    again, truth_again = _all(SCENARIO, block_s)
    assert again.tobytes() == samples.tobytes()
    assert truth_again == truth


def test_blocks_are_contiguous() -> None:
    made = [block for block, _ in blocks(SCENARIO, MACHINE, start_ns=5, run=9)]
    assert [block.sequence for block in made] == list(range(43))
    assert {(block.run, block.rate_hz, block.samples.dtype.str) for block in made} == {(9, 2000.0, "<f4")}
    assert made[0].start_ns == 5
    assert [block.start_ns for block in made[1:]] == [block.end_ns for block in made[:-1]]
    assert [len(block.samples) for block in made] == [200] * 42 + [69]
    assert made[-1].end_ns == 5 + 4_234_500_000


def test_a_rate_that_is_no_whole_number_of_nanoseconds_does_not_drift() -> None:
    odd = MACHINE.model_copy(update={"rate_hz": 2048.0 / 3})
    made = [block for block, _ in blocks(SCENARIO, odd, 0.05)]
    first, last = made[0], made[-1]
    count = sum(len(block.samples) for block in made[:-1])
    assert last.start_ns - first.start_ns == round(count * 3e9 / 2048)


def test_truth_records_state_every_change_with_its_time() -> None:
    _, truth = _all(SCENARIO)
    assert [entry.data_s for entry in truth] == [0, 1, 1.2345, 2, 2.2, 3, 3.011, 3.3, 3.5]
    assert [entry.time_ns - DEFAULT_START_NS for entry in truth] == [round(entry.data_s * 1e9) for entry in truth]
    by_time = {entry.data_s: entry for entry in truth}
    assert (set(by_time[0].relative_changes.values()), by_time[0].ramping, by_time[1].ramping) == ({0.0}, (), ("k_by",))
    assert by_time[1.2345].sensor_faults == {"y1": {"stuck": None}}
    assert by_time[2].sensor_faults == {"y1": {"stuck": None}, "z2": {"dropout": None}}
    assert by_time[2.2].sensor_faults == {"z2": {"dropout": None}}
    assert by_time[3].relative_changes["k_by"] == pytest.approx(-0.3 * 2.05 / 2.5)
    assert (by_time[3].speed_rpm, by_time[3.011].speed_rpm) == (1320.0, 1500.0)
    assert by_time[3.3].sources[2].force_rms_N == 2.0
    last = by_time[3.5]
    assert (last.relative_changes["k_by"], last.relative_changes["e"], last.ramping) == (-0.3, 0.3, ())
    assert (last.machine, last.scenario, last.seed, last.run) == ("lab", "healthy", 1, 1)
    assert TruthRecord.model_validate_json(last.model_dump_json()) == last
    for block, came_with in blocks(SCENARIO, MACHINE, 0.013):
        assert all(block.start_ns <= entry.time_ns < block.end_ns for entry in came_with)


def test_samples_show_what_the_truth_says() -> None:
    samples, _ = _all(SCENARIO)
    column = {channel.name: samples[:, n] for n, channel in enumerate(MACHINE.sensors)}
    assert np.array_equal(np.flatnonzero(np.isnan(column["z2"])), np.arange(4000, 8469))
    held = column["y1"][2469:4400]
    assert np.ptp(held) == 0
    assert held[0] == column["y1"][2468]
    assert np.ptp(column["y1"][4400:4500]) > 0
    turns = np.diff(np.unwrap(column["theta"])) * 2000 * 60 / (2 * np.pi)
    assert np.allclose(turns[:6021], 1320.0, atol=0.1)  # float32 resolves 2π to 5e-7 rad, 0.01 rpm
    assert np.allclose(turns[6022:], 1500.0, atol=0.1)


def test_sensors_never_change_how_the_machine_moves() -> None:
    plain = Scenario.model_validate({
        **SCENARIO.model_dump(),
        "sensors": Sensors(channels={"z1": ChannelSettings(noise_relative=1.0, gain=2.0)}).model_dump(),
        "events": [event.model_dump() for event in EVENTS if event.sensor is None],
    })  # fmt: skip
    noiseless = SCENARIO.model_copy(update={"sensors": Sensors()})
    one, _ = _all(noiseless)
    other, _ = _all(plain)
    names = [channel.name for channel in MACHINE.sensors]
    same = [name for name, a, b in zip(names, one.T, other.T, strict=True) if np.array_equal(a, b)]
    assert same == [name for name in names if name not in ("y1", "z1", "z2")]
    np.testing.assert_array_equal(one[:4000, names.index("z2")], other[:4000, names.index("z2")])


def test_channels_have_independent_noise() -> None:
    quiet = SCENARIO.model_copy(update={"events": (), "duration_s": 20.0, "sensors": Sensors()})
    clean, _ = _all(quiet)
    noisy, _ = _all(quiet.model_copy(update={"sensors": Sensors(noise_relative=0.5)}))
    noise = (noisy - clean)[:, :8]
    correlations = np.corrcoef(noise.T) - np.eye(8)
    assert np.abs(correlations).max() < 5 / np.sqrt(40_000)


def test_a_machine_without_the_channel_is_refused() -> None:
    short = MACHINE.model_copy(update={"sensors": MACHINE.sensors[1:]})
    with pytest.raises(MachineFileError, match=r"events\.1\.sensor: 'y1' is not a channel of machine lab"):
        blocks(SCENARIO, short)
    with pytest.raises(ValueError, match="holds no sample"):
        blocks(SCENARIO, MACHINE, 1e-4)
