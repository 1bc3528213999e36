"""Snapshots over HTTP follow the stream: nothing before a window, and no samples from before a gap."""

from pathlib import Path

from rotorwatch.records.snapshots import CorrelationSnapshot, OrbitSnapshot, SpectrumSnapshot
from service.runtime import Runtime
from tests.service.live import START_NS, Feed, until
from tests.service.monitored import PLACE, answered, client, fed


def feed_on(runtime: Runtime, feed: Feed, blocks: int) -> None:
    """Put blocks of 0.1 s in which the shaft turns at 22 Hz, and wait until they are taken."""
    accepted = runtime.machines()[0].health().quality.accepted_blocks
    theta = [one.name for one in feed.machine.sensors].index("theta")
    for _ in range(blocks):
        block = feed.block()
        samples = block.samples.copy()
        for row in range(samples.shape[0]):
            turns = 22.0 * ((block.start_ns - START_NS) / 1e9 + row / block.rate_hz)
            samples[row, theta] = 6.283185307 * (turns % 1.0)
        feed.put(feed.block(samples=samples))
        feed.sequence += 1
        feed.start_ns = block.end_ns
    until(lambda: runtime.machines()[0].health().quality.accepted_blocks == accepted + blocks, "blocks")


def test_before_a_window_there_is_a_reason_instead(tmp_path: Path) -> None:
    with fed(tmp_path) as (runtime, _), client(runtime) as http:
        for found in (
            answered(http.get(f"{PLACE}/correlations"), CorrelationSnapshot),
            answered(http.get(f"{PLACE}/spectra"), SpectrumSnapshot),
            answered(http.get(f"{PLACE}/orbits"), OrbitSnapshot),
        ):
            assert found.reason == "demo/lab: no window of 60 s is full yet, 0% of one is there"
            assert found.end_ns is None


def test_a_path_has_no_samples_from_before_a_gap(tmp_path: Path) -> None:
    with fed(tmp_path) as (runtime, feed), client(runtime) as http:
        feed_on(runtime, feed, 20)
        before = answered(http.get(f"{PLACE}/orbits?revolutions=30"), OrbitSnapshot)
        assert (before.revolutions, before.path_reason) == (30, "")
        feed.start_ns += 3_000_000_000
        feed.sequence += 30
        begin_ns = feed.start_ns
        feed_on(runtime, feed, 5)
        after = answered(http.get(f"{PLACE}/orbits?revolutions=30"), OrbitSnapshot)
        assert after.path_start_ns is not None
        assert after.path_start_ns >= begin_ns
        assert 9 <= after.revolutions <= 11
        assert after.path_reason.startswith(f"{after.revolutions} of 30 revolutions: there are 0.5 s of samples")


def test_samples_are_held_for_a_bounded_time(tmp_path: Path) -> None:
    """20 000 samples and no more, however long the machine runs."""
    with fed(tmp_path) as (runtime, feed):
        feed_on(runtime, feed, 130)
        held = runtime.machines()[0].latest.blocks
        assert sum(block.samples.shape[0] for block in held) == 20_000
        assert held[-1].end_ns == feed.start_ns
