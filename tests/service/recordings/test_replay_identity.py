"""Live, replayed and offline: the same reports and alarms; and a replay does not reach a live monitor."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from models.alarm_names import STREAM_LOST
from models.commissioning.commissioned import install
from models.signals.keys import MachineKeys
from models.signals.link import LinkSettings
from rotorwatch.records.replays import OfflineSummary
from service.recordings.replay.offline import OfflineReplay
from service.recordings.replay.player import Control
from service.recordings.replay.source import RecordingSource
from service.runtime.runtime import running
from service.stream.replay_link import replay_to_network
from service.stream.transport import TopicMessage, follow
from service.stream.worker import MachineWorker
from simulator.scenario import parse_fault
from tests.service.recordings.test_replay_network import plan
from tests.service.rig.live import LAB, endpoint, scenario_blocks, send, service, settings, until, worker_of
from tests.service.rig.replaying import digest_of, lines_of, recording, split

BLOCKS = 700
FAULT = parse_fault("c_bz=0.5@0")


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    stream = scenario_blocks(BLOCKS / 10, FAULT)
    return recording(tmp_path_factory.mktemp("recordings") / "faulty.mcap", stream)


def offline(*files: Path) -> tuple[OfflineSummary, list[str]]:
    lines: list[str] = []
    source = RecordingSource(files)
    run = OfflineReplay(source, source.machine(), install(LAB, "lab"), lines.append)
    return run.run(), lines


@pytest.fixture(scope="module")
def expected(faulty: Path) -> OfflineSummary:
    summary, _ = offline(faulty)
    return summary


@contextmanager
def monitor_in(namespace: str, link: LinkSettings) -> Iterator[MachineWorker]:
    apart = link.model_copy(update={"namespace": namespace})
    with running(settings(endpoint(), bundle="lab", bound=2000, link=apart)) as runtime:
        yield worker_of(runtime)


def test_offline_replay_gives_the_same_counts_from_one_file_and_from_two(
    faulty: Path, expected: OfflineSummary, tmp_path: Path
) -> None:
    assert (expected.windows, expected.alarms) == (13, 1)
    assert (expected.raised, expected.blocks, expected.refused_blocks) == (("c_bz",), BLOCKS, {})
    assert expected.data_s == pytest.approx(BLOCKS / 10)
    assert expected.descriptor_differences == ()
    assert not expected.stopped
    summary, _ = offline(*split(faulty, tmp_path, 400))
    assert (summary.sha256, summary.windows) == (expected.sha256, expected.windows)


def test_a_single_changed_sample_changes_the_digest(tmp_path: Path) -> None:
    """The digest is sensitive to a single sample."""
    stream = scenario_blocks(20.0, FAULT)
    summary, _ = offline(recording(tmp_path / "as_it_was.mcap", stream))
    samples = stream[100].samples.copy()
    samples[7, 2] *= 1.001
    stream[100] = replace(stream[100], samples=samples)
    touched, _ = offline(recording(tmp_path / "touched.mcap", stream))
    assert touched.windows == summary.windows
    assert touched.sha256 != summary.sha256


def test_a_replay_does_not_disturb_a_live_monitor(faulty: Path, expected: OfflineSummary, tmp_path: Path) -> None:
    """A healthy machine live, and on the same network the replay of its fault with a second monitor."""
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
    reports = [message for message in heard if message.key == MachineKeys("demo", "lab").report]
    assert len(reports) == undisturbed.windows
    assert all(STREAM_LOST in message.text for message in heard if message not in reports)
