"""Snapshots: some seconds of samples at regular intervals, with silence between them that is no gap."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.alarm_names import GAP, LEVEL
from models.commissioning.commissioned import install
from models.commissioning.healthy import healthy_from_blocks
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import window_statistics
from models.errors import MachineFileError
from models.ingest import Admission, Gate, Reason
from models.machine import Machine, MachineFile
from models.mistakes import checked
from models.signals.block import FloatArray, SampleBlock
from models.signals.wire import encode_block
from rotorwatch.records.health import HealthState
from service.monitor.monitor import MachineMonitor
from service.monitor.reports import MonitorReport
from simulator.scenario import Event, load_scenario
from simulator.stream import DEFAULT_START_NS, blocks
from tests.commissioning.rotor_kit import windows_of
from tests.service.rig.live import LAB, scenario_blocks
from tests.service.rig.watching import resumed
from tests.sure import sure

SECOND = 10**9
ON_S, EVERY_S = 4.0, 20.0
A_DAY = {"length_s": 4 * 86400.0, "hop_s": 86400.0, "max_span_s": 5 * 86400.0}


def scheduled(on_s: float, every_s: float, **window: float) -> dict[str, Any]:
    """Fields of the lab machine, with windows and ingest as they follow from a schedule."""
    fields = LAB.model_dump(mode="json", exclude={"window", "ingest"})
    return fields | {"schedule": {"on_s": on_s, "every_s": every_s}, "window": window}


KIT = Machine.model_validate(scheduled(ON_S, EVERY_S, length_s=6 * EVERY_S))


def snapshots(everything: Sequence[SampleBlock], machine: MachineFile) -> tuple[SampleBlock, ...]:
    """Blocks of a stream that lie in snapshots, numbered consecutively."""
    schedule = sure(machine.schedule)
    within = [
        one
        for one in everything
        if (one.start_ns - everything[0].start_ns) / 1e9 % schedule.every_s < schedule.on_s - 0.01
    ]
    return tuple(replace(one, sequence=number) for number, one in enumerate(within))


@cache
def stream() -> tuple[SampleBlock, ...]:
    """A bearing that loses a quarter of its stiffness after twelve of 24 snapshots."""
    fault = Event(at_s=12 * EVERY_S, parameter="k_by", relative_change=-0.25)
    return snapshots(scenario_blocks(24 * EVERY_S, fault), KIT)


def run(monitor: MachineMonitor, sent: Sequence[SampleBlock]) -> list[MonitorReport]:
    return [monitor.step(block) for block in sent]


def test_a_schedule_sets_the_defaults_of_windows_and_ingest() -> None:
    minute = Machine.model_validate(scheduled(10.0, 60.0))
    assert (minute.window.hop_s, minute.window.length_s, minute.window.segment_s) == (60.0, 720.0, 2.0)
    assert (minute.hop_data_s, minute.window_data_s) == (10.0, 120.0)
    assert minute.ingest.no_data_after_s == 150.0
    assert minute.holds_band
    assert Machine.model_validate(minute.model_dump(mode="json")) == minute
    short = Machine.model_validate(scheduled(0.1, 10.0))
    assert short.window.lag_to_s == 0.025
    assert not short.holds_band
    assert plan_for(short, levels=True).states == ()
    assert install(short, None).watching


@pytest.mark.parametrize(
    ("schedule", "window", "says"),
    [
        (None, A_DAY, "window.hop_s is 86400, expected at most 600, or snapshots ([schedule])"),
        ((10.0, 10.0), {}, "on_s 10 must be below every_s 10: there is silence between"),
        ((10.0, 60.0), {"hop_s": 5.0}, "window.hop_s is 5, but a hop is a snapshot, one every 60 s"),
        ((0.1, 10.0), {"segment_s": 2.0}, "window.segment_s is 2, expected at most half of a snapshot, 0.05"),
        ((0.1, 10.0), {"lag_to_s": 0.06}, "window.lag_to_s is 0.06, expected at most half of a snapshot, 0.05"),
    ],
)
def test_bad_schedules_are_named(tmp_path: Path, schedule: tuple[float, float] | None, window: Any, says: str) -> None:
    fields = scheduled(*schedule, **window) if schedule else LAB.model_dump(mode="json") | {"window": window}
    with pytest.raises(MachineFileError) as told:
        checked(Machine, fields, tmp_path / "kit.toml")
    assert says in str(told.value)


def test_the_simulator_sends_snapshots_of_the_continuous_motion() -> None:
    scenario = load_scenario("healthy")[0].overridden(duration_s=3 * EVERY_S, seed=9)
    everything = [block for block, _ in blocks(scenario, LAB)]
    for one, other in zip(blocks(scenario, KIT), snapshots(everything, KIT), strict=True):
        assert (one[0].start_ns, one[0].sequence) == (other.start_ns, other.sequence)
        np.testing.assert_array_equal(one[0].samples, other.samples)


def test_silence_between_snapshots_is_no_gap_but_a_missing_snapshot_is() -> None:
    gate, per = Gate(KIT), round(ON_S / 0.1)
    sent = stream()[: 4 * per]
    told = [gate.judge(one) for one in (*sent[: 2 * per], *sent[3 * per :])]
    starts = {per: Admission(new_snapshot=True)}
    assert told[: 2 * per] == [starts.get(number, Admission()) for number in range(2 * per)]
    assert told[2 * per] == Admission(
        text="demo/lab: a snapshot is missing, 20 s (40 blocks)", gap_s=EVERY_S, new_snapshot=True
    )
    assert set(told[2 * per + 1 :]) == {Admission()}


def test_missing_snapshots_and_lost_blocks_are_reported() -> None:
    gate, (first, second) = Gate(KIT), stream()[:2]
    assert gate.judge(first).accepted
    late = gate.judge(replace(second, start_ns=second.start_ns + 50 * SECOND))
    assert late.text == "demo/lab: 2 snapshots are missing, 34 s"
    gate, sent = Gate(KIT), stream()
    assert gate.judge(sent[0]).accepted
    told = gate.judge(sent[2])
    assert (told.gap_s, told.new_snapshot) == (0.1, False)
    assert gate.judge(sent[1]).reason is Reason.OVERLAP


def si(sent: Sequence[SampleBlock]) -> FloatArray:
    return np.concatenate([plan_for(KIT).to_si(one.samples) for one in sent])


@settings(max_examples=5)
@given(cuts=st.lists(st.integers(1, 3 * 8000 - 1), max_size=12))
def test_hops_are_snapshots_however_the_blocks_are_cut(cuts: list[int]) -> None:
    plan, per = plan_for(KIT), round(ON_S / 0.1)
    window = SlidingWindow(plan)
    ends: list[int] = []
    for number in range(3):
        samples, start_ns = si(stream()[number * per : (number + 1) * per]), DEFAULT_START_NS + 20 * number * SECOND
        window.gap()
        edges = [0, *sorted({cut - 8000 * number for cut in cuts if 0 < cut - 8000 * number < 8000}), 8000]
        for first, last in pairwise(edges):
            ends += list(window.feed(samples[first:last], start_ns + first * SECOND // 2000))
    assert ends == [DEFAULT_START_NS + (20 * number + 4) * SECOND for number in range(3)]
    assert [hop.start_ns for hop in window.hops] == [end - 4 * SECOND for end in ends]
    latest = si(stream()[2 * per : 3 * per])
    own = latest[plan.preamble :, : len(plan.states)]
    mean = window_statistics(plan, window.hops[-1:]).waveforms[0].mean[:-1]
    np.testing.assert_allclose(mean, latest[:, :-1].mean(axis=0), atol=1e-12)
    products = window.hops[-1].products[0][: own.shape[1], : own.shape[1]]
    shifted = own - np.median(si(stream()[:per])[:, : own.shape[1]], axis=0)
    np.testing.assert_allclose(products, shifted.T @ shifted, rtol=1e-9, atol=1e-12)


@settings(max_examples=5)
@given(cuts=st.lists(st.integers(1, 60 * 2000 - 1), max_size=20))
def test_snapshots_are_taken_from_a_continuous_stream(cuts: list[int]) -> None:
    plan = plan_for(KIT)
    rng = np.random.default_rng(5)
    samples = rng.standard_normal((60 * 2000, plan.width))
    window = SlidingWindow(plan)
    ends: list[int] = []
    for first, last in pairwise([0, *sorted(set(cuts)), len(samples)]):
        ends += list(window.feed(samples[first:last], first * SECOND // 2000))
    assert ends == [(20 * number + 4) * SECOND for number in range(3)]


def test_a_fault_is_named_from_snapshots_and_nothing_is_missing() -> None:
    monitor = MachineMonitor(install(KIT, None))
    reports = run(monitor, stream())
    windows = [window for report in reports for window in report.windows]
    assert len(windows) == 24
    assert [window.state for window in windows[5:12]] == [HealthState.HEALTHY] * 7
    events = [event for report in reports for event in report.events]
    assert [event.alarm.name for event in events] == ["k_by"]
    change = {one.name: one.relative_change for one in sure(windows[-1].verdict).current}["k_by"]
    assert change == pytest.approx(-0.25, abs=0.03)
    assert monitor.health().quality.gaps == 0


@cache
def not_stopped() -> list[MonitorReport]:
    return run(MachineMonitor(install(KIT, None)), stream()[:360])


# Within a snapshot, before one.
@pytest.mark.parametrize(("at", "whole"), [(279, False), (280, True)])
def test_a_monitor_stopped_between_or_in_snapshots_continues_bit_for_bit(at: int, whole: bool) -> None:
    sent = stream()[:360]
    first = MachineMonitor(install(KIT, None))
    done = run(first, sent[:at])
    again = resumed(first, install(KIT, None), whole=whole)
    if not whole:
        for block in sent[:at]:
            again.recall(*encode_block(block, ""))
    assert done + run(again, sent[at:]) == not_stopped()


def test_a_healthy_recording_of_snapshots_uses_all_of_them() -> None:
    found = healthy_from_blocks("kit", KIT, stream()[:480])
    assert (len(found.hops), len(windows_of(found)), found.gaps) == (12, 2, 0)
    assert found.duration_s == 12 * ON_S


def test_growth_in_short_snapshots_raises_level_alarms() -> None:
    machine = Machine.model_validate(scheduled(0.1, 10.0, length_s=40.0) | {"levels": {"reference_windows": 3}})
    sent = snapshots(scenario_blocks(180.0), machine)
    quiet, loud = sent[:14], [replace(one, samples=one.samples * np.float32(3)) for one in sent[14:]]
    monitor = MachineMonitor(install(machine, None))
    reports = run(monitor, [*quiet, *loud])
    assert sum(len(report.windows) for report in reports) == 18
    raised = [(number, event.alarm.name) for number, report in enumerate(reports) for event in report.events]
    assert {number for number, _ in raised} <= {14, 15, 16}
    assert {name for _, name in raised} >= {f"{LEVEL}y1", f"{LEVEL}z2_dot"}
    assert GAP not in {name for _, name in raised}
