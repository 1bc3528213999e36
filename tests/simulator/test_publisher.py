"""The publisher over real Zenoh sessions on loopback. Everything is waited for, nothing is slept for."""

import json
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
from models.machine import Machine
from models.signals.channels import ChannelDescriptor
from models.signals.link import LinkSettings
from models.signals.wire import ARROW_ENCODING, decode_block
from simulator.publisher import PublishError, PublishSettings, publish
from simulator.scenario import Scenario, load_scenario, parse_fault
from simulator.stream import RunSummary, TruthRecord, blocks
from tests.loopback import endpoint


@pytest.fixture(scope="module")
def loaded() -> tuple[Scenario, Machine]:
    scenario, machine = load_scenario("healthy")
    return scenario.overridden(duration_s=6.0, faults=[parse_fault("k_by=-0.25@3")]), machine


@pytest.fixture(name="endpoint")
def _endpoint() -> str:
    return endpoint()


@pytest.fixture
def monitor(endpoint: str) -> Iterator[zenoh.Session]:
    """A session that listens where the publisher connects."""
    config = zenoh.Config()
    for path, value in LinkSettings(listen=(endpoint,)).zenoh_items().items():
        config.insert_json5(path, value)
    with zenoh.open(config) as session:
        yield session


def _until(condition: Callable[[], bool], what: str, timeout_s: float = 30.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"no {what} within {timeout_s} s"
        time.sleep(0.005)


class _Received:
    """Collects samples of a key the way the monitor does: with history and recovery."""

    def __init__(self, session: zenoh.Session, key: str, delay_s: float = 0.0) -> None:
        self.samples: list[tuple[bytes, bytes, str]] = []
        self._delay_s = delay_s
        self._subscriber = zenoh.ext.declare_advanced_subscriber(
            session,
            key,
            self._keep,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=300),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )

    def _keep(self, sample: zenoh.Sample) -> None:
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        self.samples.append((sample.payload.to_bytes(), attachment, str(sample.encoding)))
        time.sleep(self._delay_s)

    @property
    def sequences(self) -> list[int]:
        return [decode_block(*sample)[0].sequence for sample in self.samples]


@contextmanager
def _publishing(
    loaded: tuple[Scenario, Machine],
    endpoint: str,
    on_block: Callable[[RunSummary], None] | None = None,
    **settings: Any,
) -> Iterator[tuple[threading.Event, list[RunSummary | Exception]]]:
    """Publish in a thread; on leaving, stop and collect the outcome."""
    scenario, machine = loaded
    stop = threading.Event()
    outcome: list[RunSummary | Exception] = []
    link = LinkSettings(connect=(endpoint,))

    def run() -> None:
        try:
            made = blocks(scenario, machine, run=7)
            outcome.append(publish(machine, made, PublishSettings(link, **settings), stop=stop, on_block=on_block))
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


def test_a_late_subscriber_gets_every_block_and_truth_from_the_start(
    loaded: tuple[Scenario, Machine], endpoint: str, monitor: zenoh.Session
) -> None:
    scenario, machine = loaded
    half = threading.Event()
    with _publishing(loaded, endpoint, lambda s: half.set() if s.blocks >= 40 else None, pace=20.0, linger_s=60.0) as (
        stop,
        outcome,
    ):
        assert half.wait(180)
        stream = _Received(monitor, machine.keys.stream)
        truth = _Received(monitor, machine.keys.truth)
        descriptor = _Received(monitor, machine.keys.descriptor)
        _until(lambda: len(stream.samples) >= 60, "60 blocks")
        _until(lambda: len(truth.samples) >= 2, "two truth records")
        _until(lambda: len(descriptor.samples) >= 1, "descriptor")
        stop.set()
    (summary,) = outcome
    assert isinstance(summary, RunSummary)
    assert (summary.blocks, summary.data_s) == (60, 6.0)
    assert stream.sequences == list(range(60))
    for sample, (block, _) in zip(stream.samples, blocks(scenario, machine, run=7), strict=True):
        received, schema_hash = decode_block(*sample)
        assert schema_hash == machine.descriptor.schema_hash
        assert (received.run, received.start_ns) == (7, block.start_ns)
        np.testing.assert_array_equal(received.samples, block.samples)
    records = [TruthRecord.model_validate_json(payload) for payload, _, _ in truth.samples]
    assert [record.relative_changes["k_by"] for record in records] == [0.0, -0.25]
    assert {encoding for _, _, encoding in truth.samples} == {"application/json"}
    assert ChannelDescriptor.model_validate_json(descriptor.samples[0][0]) == machine.descriptor


def test_the_descriptor_answers_a_query_and_the_token_shows_who_is_there(
    loaded: tuple[Scenario, Machine], endpoint: str, monitor: zenoh.Session
) -> None:
    _, machine = loaded
    changes: list[zenoh.SampleKind] = []
    monitor.liveliness().declare_subscriber(
        machine.keys.publisher_alive, lambda s: changes.append(s.kind), history=True
    )
    with _publishing(loaded, endpoint, pace=1.0) as (stop, _):
        _until(lambda: changes == [zenoh.SampleKind.PUT], "publisher")
        replies = [reply.ok for reply in monitor.get(machine.keys.descriptor, timeout=60)]
        stop.set()
    ok = [reply for reply in replies if reply is not None]
    assert [str(reply.encoding) for reply in ok] == ["application/json"]
    assert ChannelDescriptor.model_validate_json(ok[0].payload.to_bytes()) == machine.descriptor
    _until(lambda: changes == [zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE], "end of the publisher")


def test_an_unpaced_stream_waits_for_a_slow_subscriber_and_loses_nothing(
    loaded: tuple[Scenario, Machine], endpoint: str, monitor: zenoh.Session
) -> None:
    """More than cache and sockets hold, to a subscriber slower than the simulation; the session closes at once."""
    scenario, machine = loaded
    long = scenario.overridden(duration_s=150.0)
    with monitor.declare_queryable(machine.keys.health, lambda query: query.reply(machine.keys.health, b"{}")):
        stream = _Received(monitor, machine.keys.stream, delay_s=0.003)
        with _publishing((long, machine), endpoint, pace=None, wait_for_subscriber_s=30.0, linger_s=0.0) as (
            _,
            outcome,
        ):
            _until(lambda: len(outcome) == 1, "end of the stream", 60.0)
            _until(lambda: len(stream.samples) >= 1500, "last block", 60.0)
    assert isinstance(outcome[0], RunSummary)
    assert outcome[0].blocks == 1500
    assert stream.sequences == list(range(1500))


def test_an_arrow_stream_arrives_as_the_same_samples(
    loaded: tuple[Scenario, Machine], endpoint: str, monitor: zenoh.Session
) -> None:
    scenario, machine = loaded
    stream = _Received(monitor, machine.keys.stream)
    with _publishing(loaded, endpoint, pace=None, encoding="arrow", wait_for_subscriber_s=30.0):
        _until(lambda: len(stream.samples) >= 60, "60 blocks")
    received = [decode_block(*sample) for sample in stream.samples]
    assert {sample[2] for sample in stream.samples} == {f"{ARROW_ENCODING};{machine.descriptor.schema_hash}"}
    for (one, _), (other, _) in zip(received, blocks(scenario, machine), strict=True):
        np.testing.assert_array_equal(one.samples, other.samples)


def test_nothing_is_sent_before_somebody_listens(
    loaded: tuple[Scenario, Machine], endpoint: str, monitor: zenoh.Session
) -> None:
    _, machine = loaded
    alive = threading.Event()
    monitor.liveliness().declare_subscriber(machine.keys.publisher_alive, lambda _: alive.set(), history=True)
    sent = threading.Event()
    with _publishing(loaded, endpoint, lambda _: sent.set(), pace=1.0, wait_for_subscriber_s=60.0) as (stop, outcome):
        assert alive.wait(180)
        # Answered by the waiting publisher: it is up, and has had every occasion to send.
        assert len(list(monitor.get(machine.keys.descriptor, timeout=60))) == 1
        assert not sent.is_set()
        stream = _Received(monitor, machine.keys.stream)
        assert sent.wait(180)
        stop.set()
    assert isinstance(outcome[0], RunSummary)
    _until(lambda: stream.sequences[:1] == [0], "first block")


def test_nobody_in_time_is_an_error(loaded: tuple[Scenario, Machine], endpoint: str) -> None:
    with _publishing(loaded, endpoint, pace=1.0, wait_for_subscriber_s=0.1) as (_, outcome):
        _until(lambda: len(outcome) == 1, "outcome")
    assert isinstance(outcome[0], PublishError)
    assert "nobody subscribed to rotorwatch/demo/lab/stream within 0.1 s" in str(outcome[0])


@pytest.mark.parametrize("settings", [{"wait_for_subscriber_s": 1e6}, {"pace": 1e-6}, {"pace": None, "linger_s": 1e6}])
def test_a_stop_ends_every_wait(loaded: tuple[Scenario, Machine], endpoint: str, settings: dict[str, Any]) -> None:
    with _publishing(loaded, endpoint, **settings) as (stop, outcome):
        stop.set()
    assert isinstance(outcome[0], RunSummary)
    assert outcome[0].blocks <= 60


def test_pace_follows_the_data_time(loaded: tuple[Scenario, Machine], endpoint: str) -> None:
    """A block goes out after its last sample: never early, however fast the machine is."""
    summaries: list[RunSummary] = []
    with _publishing(loaded, endpoint, summaries.append, pace=30.0, linger_s=0.0) as (_, outcome):
        _until(lambda: len(outcome) == 1, "end of the stream")
    assert [summary.blocks for summary in summaries] == list(range(1, 61))
    assert all(summary.elapsed_s >= summary.data_s / 30.0 - 1e-3 for summary in summaries)


def test_a_malformed_endpoint_is_named(loaded: tuple[Scenario, Machine]) -> None:
    scenario, machine = loaded
    settings = PublishSettings(LinkSettings().model_copy(update={"connect": ("nowhere",)}))
    with pytest.raises(MachineFileError, match="connect: 'nowhere'"):
        publish(machine, blocks(scenario, machine), settings)


def test_an_endpoint_in_use_is_named(loaded: tuple[Scenario, Machine], endpoint: str, monitor: zenoh.Session) -> None:
    scenario, machine = loaded
    settings = PublishSettings(LinkSettings(listen=(endpoint,)))
    with pytest.raises(PublishError, match="no Zenoh session") as caught:
        publish(machine, blocks(scenario, machine), settings)
    assert json.dumps(endpoint).strip('"') in str(caught.value)
    assert ".rs:" not in str(caught.value)
