"""A channel of NaN loses only its own readings, and none of the others."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from models.alarm_names import PHASE_REFERENCE
from models.commissioning.commissioned import Installed, install
from models.diagnosis.sensors.missing import MissingNumbers
from models.ingest import Reason
from models.levels.settings import LevelLimit
from models.machine import AlarmSettings
from models.signals.block import SampleBlock
from models.signals.channels import Sensor
from models.signals.wire import encode_block
from rotorwatch.records.health import HealthState, Report
from rotorwatch.records.levels import ChannelLevels
from service.monitor.monitor import MachineMonitor
from simulator.scenario import Event
from tests.commissioning.rotor_kit import commissioned, elsewhere, recording, stream
from tests.service.rig.live import LAB, scenario_blocks
from tests.service.rig.watching import feed, held, named, raised, resumed
from tests.sure import sure

KIT = LAB.model_copy(update={"window": LAB.window.model_copy(update={"length_s": 20.0, "max_span_s": 40.0})})
CASING = Sensor(name="DE-H", quantity="acceleration", location="DE", direction="horizontal", unit="m/s2")
SOON = KIT.model_copy(update={"alarms": KIT.alarms.model_copy(update={"off_delay_s": 20.0})})
RIG = KIT.model_copy(update={"sensors": (*KIT.sensors, CASING)})
Z1_DOT, THETA = 3, 8
FROM_S, TO_S, END_S = 31.0, 33.0, 125.0


def without(
    column: int, from_s: float, to_s: float, value: float = np.nan, *, end_s: float = END_S
) -> list[SampleBlock]:
    """A stream in which one channel is NaN, or another value, for a time."""
    return held(scenario_blocks(end_s), column, value, from_s, to_s)


def blamed(stream: Iterable[SampleBlock]) -> set[str]:
    reports, _ = feed(MachineMonitor(install(KIT, None)), stream)
    return {state for report in reports for one in report.sensors for state in one.states}


def ends_s(reports: Sequence[Report], first_ns: int) -> list[float]:
    return [(one.end_ns - first_ns) / 1e9 for one in reports]


@cache
def usual(end_s: float, *, moved: bool = False) -> Sequence[Report]:
    """Reports of a complete stream, with the sensors in place or on the casing."""
    return feed(MachineMonitor(Installed(elsewhere(KIT) if moved else SOON)), scenario_blocks(end_s))[0]


def test_a_missing_channel_is_reported_until_its_gap_has_left_the_window() -> None:
    monitor, sound = MachineMonitor(install(SOON, None)), usual(85.0)
    stream = without(Z1_DOT, FROM_S, TO_S, end_s=85.0)
    reports, events = feed(monitor, stream)
    assert monitor.health().quality.refused_blocks == {}
    first_ns = stream[0].start_ns
    assert ends_s(reports, first_ns) == ends_s(sound, first_ns)
    lacking = [one for one in reports if one.sensors]
    assert all(one.start_ns < first_ns + round(TO_S * 1e9) <= one.end_ns + 10**9 for one in lacking)
    assert {one.state for one in lacking} <= {HealthState.DATA_HEALTH, HealthState.ALERT}
    assert all("; the machine is diagnosed without it" in one.sensors[0].text for one in lacking[1:])
    assert {(fault.states, fault.kind) for one in lacking for fault in one.sensors} == {(("z1_dot",), "missing")}
    fault = lacking[2].sensors[0]
    assert fault.value == pytest.approx(2.0)
    assert fault.text.startswith("z1_dot: sent as NaN, the last time for 2 s, expected numbers")
    assert named(events) == [("raised", "data-missing"), ("cleared", "data-missing")]
    gone = [level for one in lacking for level in one.levels if level.channel == "z1_dot"]
    assert {(one.overall, one.x1, one.growth) for one in gone} == {(None, None, None)}  # not 0
    # Levels of the other channels are identical, and the machine is diagnosed again.
    for one, other in zip(reports, sound, strict=True):
        kept = [level for level in one.levels if level.channel != "z1_dot"]
        assert kept == [level for level in other.levels if level.channel != "z1_dot"]
    last, other = reports[-1], sound[-1]
    assert (last.state, last.sensors, last.levels) == (other.state, (), other.levels)
    assert [one.name for one in last.parameters] == [one.name for one in other.parameters]


def test_s_max_is_not_stated_if_one_of_its_two_probes_is_missing() -> None:
    monitor = MachineMonitor(install(KIT, None))
    reports, _ = feed(monitor, without(0, 31.0, 45.0, np.inf, end_s=50.0))  # no more of a number than NaN
    told = {level.channel: level for level in reports[-1].levels}
    assert (told["y1"].overall, told["y1"].s_max, told["z1"].s_max) == (None, None, None)
    assert told["z1"].overall is not None
    assert told["y2"].s_max is not None


@pytest.mark.parametrize(("measure", "column"), [("overall", 0), ("s_max", 1)])
def test_a_level_alarm_stays_while_samples_of_its_level_are_missing(measure: str, column: int) -> None:
    own = LAB.levels.model_copy(update={"limits": (LevelLimit(channel="y1", measure=measure, alert=0.1),)})
    soon = AlarmSettings(on_delay_s=1.0, off_delay_s=1.0)
    monitor = MachineMonitor(install(KIT.model_copy(update={"levels": own, "alarms": soon}), None))
    _, events = feed(monitor, without(column, FROM_S, END_S, end_s=60.0))
    assert named(events) == [("raised", "level:y1"), ("raised", "data-missing")]


@pytest.mark.parametrize(("value", "kind"), [(np.nan, "missing"), (0.0, "stuck")])
def test_a_dead_casing_sensor_does_not_change_the_diagnosis(value: float, kind: str) -> None:
    monitor, alone = MachineMonitor(install(RIG, None)), MachineMonitor(install(KIT, None))
    stream = scenario_blocks(40.0)
    gap = np.full((len(stream[0].samples), 1), value, np.float32)
    wider = [replace(one, samples=np.hstack([one.samples.astype(np.float32), gap])) for one in stream]
    told, plain = feed(monitor, wider)[0][-1], feed(alone, stream)[0][-1]
    assert [(fault.states, fault.kind) for fault in told.sensors] == [(("@DE-H",), kind)]
    assert (told.state, told.verdict, told.parameters) == (plain.state, plain.verdict, plain.parameters)
    assert raised(monitor) == {f"data-{kind}"}


@pytest.mark.parametrize(
    ("column", "state", "alarm"), [(THETA, "theta", PHASE_REFERENCE), (2, "y1_dot", "data-missing")]
)
def test_a_sensor_never_connected_is_reported_before_the_first_full_window(column: int, state: str, alarm: str) -> None:
    monitor, stream = MachineMonitor(install(KIT, None)), without(column, 0.0, END_S, end_s=50.0)
    reports = feed(monitor, stream[:190])[0]
    assert [[fault.states for fault in one.sensors] for one in reports] == [[(state,)]] * len(reports)
    assert {one.state for one in reports} == {HealthState.WARMING}
    assert raised(monitor) == {alarm}
    reports = feed(monitor, stream[190:])[0]
    assert [fault.states for fault in reports[-1].sensors] == [(state,)]
    assert raised(monitor) == {alarm}


@pytest.mark.parametrize("lost", [pytest.param(np.nan, marks=pytest.mark.long), 1.0])
def test_a_lost_phase_reference_raises_only_its_own_alarm(lost: float) -> None:
    """The hop in which it was lost turned half as far; no vibration is at a multiple of that speed."""
    made = commissioned(KIT, recording(KIT, scenario_blocks(END_S)[:800])).commissioned
    monitor, told = MachineMonitor(Installed(KIT, None, made)), set[str]()
    levels: dict[bool, list[ChannelLevels]] = {True: [], False: []}
    for block in without(THETA, 114.4, END_S + 25, lost, end_s=END_S + 25)[800:]:
        done = monitor.step(block)
        told |= {event.alarm.name for event in done.events}
        for report in done.windows:
            levels[bool(report.sensors)] += report.levels
    assert told == {PHASE_REFERENCE}
    turning = [(one.x1, one.x1_phase_lag_deg, one.x2, one.x2_phase_lag_deg, one.not_x1) for one in levels[True]]
    assert set(turning) == {(None,) * 5}
    assert None not in {one.overall for one in levels[True]} | {one.x1 for one in levels[False]}


@pytest.mark.parametrize("lost", [pytest.param(np.nan, marks=pytest.mark.long), 1.0])
def test_first_windows_with_a_lost_angle_are_not_a_reference(lost: float) -> None:
    """The speed seems to differ in them."""
    first = LAB.levels.model_copy(update={"reference": "first windows", "reference_windows": 2})
    monitor = MachineMonitor(install(KIT.model_copy(update={"levels": first}), None))
    feed(monitor, without(THETA, 25.0, 26.0, lost, end_s=80.0))
    (state,) = sure(monitor._levels.reference).states
    assert state.windows == 2
    assert state.speed_rad_s == pytest.approx((LAB.operation.speed_rad_s,) * 2)


def at_speed(rpm: float, end_s: float) -> Sequence[SampleBlock]:
    return stream(end_s, 20263313 + round(rpm), Event(at_s=0.0, speed_rpm=rpm))


def test_without_an_angle_levels_are_not_compared_with_another_speed() -> None:
    rig = elsewhere(KIT)
    healthy = [recording(rig, at_speed(rpm, end_s), f"{rpm}.mcap") for rpm, end_s in ((1320.0, 85.0), (2600.0, 45.0))]
    monitor, told = MachineMonitor(Installed(rig, None, commissioned(rig, *healthy).commissioned)), set[str]()
    for block in held(at_speed(2600.0, 75.0), THETA, np.nan, 30.0):
        told |= {event.alarm.name for event in monitor.step(block).events}
    assert told == {PHASE_REFERENCE}


@pytest.mark.parametrize("lost", [np.nan, pytest.param(1.0, marks=pytest.mark.long)])
def test_run_out_is_not_a_sensor_fault_while_the_angle_is_lost(lost: float) -> None:
    stream = []
    for block in without(THETA, 0.0, 0.0, end_s=38.0):
        samples = block.samples
        samples[:, 0] += 50.0 * np.cos(samples[:, THETA])  # µm; the motion has 24 (rms)
        samples[:, THETA] = lost
        stream.append(block)
    assert blamed(stream) == {"theta"}


@pytest.mark.parametrize("lost", [pytest.param(np.nan, marks=pytest.mark.long), 1.0])
def test_a_lost_phase_reference_is_not_taken_for_a_slow_machine(lost: float) -> None:
    rule = {"alarms": ["model"], "below_rpm": 600, "because": "coasting down"}
    alarms = AlarmSettings.model_validate({"suppress": [rule]})
    monitor = MachineMonitor(install(KIT.model_copy(update={"alarms": alarms}), None))
    events = feed(monitor, without(THETA, 31.0, 50.0, lost, end_s=50.0))[1]
    assert named(events) == [("raised", PHASE_REFERENCE)]


@pytest.mark.parametrize(("from_s", "faults"), [(0.0, {"theta", "z1", "z1_dot"}), (28.0, {"theta"})])
def test_without_an_angle_other_sensors_are_checked_except_where_it_comes_or_goes(
    from_s: float, faults: set[str]
) -> None:
    stream = without(THETA, from_s, END_S, end_s=38.0)
    for block in stream:
        block.samples[:, 1] *= 1.25 if from_s == 0 else 1.0
    assert blamed(stream) == faults


@pytest.mark.parametrize(
    ("rows", "columns"), [((7, 8), (3, 4)), ((7, None), (3, 4)), ((7, 8), (0, 9)), ((0, None), (0, 9))]
)
def test_blocks_with_single_nan_samples_or_only_nan_are_refused(
    rows: tuple[int, int | None], columns: tuple[int, int]
) -> None:
    (block, *_), monitor = scenario_blocks(1.0), MachineMonitor(install(KIT, None))
    samples = block.samples.copy()
    samples[slice(*rows), slice(*columns)] = np.nan
    done = monitor.step(replace(block, samples=samples))
    assert done.verdict.reason is Reason.NOT_FINITE
    assert "is nan, expected a finite number" in done.verdict.text


def test_a_restored_monitor_with_a_recalled_window_continues_bit_for_bit() -> None:
    stream = without(Z1_DOT, FROM_S, TO_S, end_s=75.0)
    monitor = MachineMonitor(install(KIT, None))
    half = 340  # a second after the last missing sample
    feed(monitor, stream[:half])[0]
    again = resumed(monitor, install(KIT, None), whole=False)
    for block in stream[:half]:
        again.recall(*encode_block(block, ""))
    assert not again.recalled
    assert feed(again, stream[half:])[0] == feed(monitor, stream[half:])[0]


def test_missing_time_is_right_with_jitter_and_hops_that_end_within_blocks() -> None:
    simulated, size = scenario_blocks(61.0), 270
    samples, first = np.concatenate([block.samples for block in simulated]), simulated[0]
    samples[230 * size : 270 * size, Z1_DOT] = np.nan  # 31.05 s to 36.45 s
    jitter_ns = np.random.default_rng(20263311).integers(-1_000, 1_000, len(samples) // size)
    stream = [
        replace(first, sequence=k, start_ns=first.start_ns + k * 135_000_000 + late_ns, samples=samples[at : at + size])
        for k, (at, late_ns) in enumerate(zip(range(0, len(samples) - size, size), jitter_ns.tolist(), strict=False))
    ]
    reports = [one for one in feed(MachineMonitor(install(KIT, None)), stream)[0] if one.filled == 1]
    told = [[(fault.kind.value, round(fault.value or 0.0, 2)) for fault in one.sensors] for one in reports]
    # Including what a hop needs before it counts: 2.5 s here.
    lacking = ((1.45,), (5.4,), (5.4,), (5.4,), (5.4,), (1.45,))
    assert told == [[], [], *([("missing", value) for value in values] for values in lacking)]


def test_an_unplugged_casing_sensor_is_not_a_wrong_gain() -> None:
    noise, stream = np.random.default_rng(20263312), list[SampleBlock]()
    for block in scenario_blocks(END_S + 1):
        shaken = np.diff(block.samples[:, 2:3], axis=0, append=block.samples[-1:, 2:3]) * block.rate_hz
        own = shaken + noise.normal(scale=0.3, size=shaken.shape)
        stream.append(replace(block, samples=np.hstack([block.samples, own]).astype(np.float32)))
    made = sure(commissioned(RIG, recording(RIG, stream[:800])).commissioned)
    assert sure(made.levels).gains is not None
    for block in stream[1050:]:
        block.samples[:, -1] = np.nan
    reports = feed(MachineMonitor(Installed(RIG, None, made)), stream[800:])[0]
    lacking = [one for one in reports if one.sensors]
    assert {fault.states for one in lacking for fault in one.sensors} == {("@DE-H",)}
    assert [one.reason for one in lacking] == [""] * 4
    assert not any(one.verdict is None or one.verdict.outside_model for one in lacking)


@pytest.mark.parametrize("missing_to_s", [30.0, 150.0])
def test_the_first_windows_are_a_reference_for_the_channels_present(missing_to_s: float) -> None:
    rig = elsewhere(KIT)
    monitor, reports = MachineMonitor(Installed(rig)), list[Report]()
    for block in without(Z1_DOT, 0.0, missing_to_s, end_s=170.0):
        reports += feed(monitor, [block])[0]
        assert not any(name.startswith("level:") for name in raised(monitor))
    last, limited = reports[-1].levels, missing_to_s == 30.0
    for level, other in zip(last, usual(170.0, moved=True)[-1].levels, strict=True):
        assert (level == other) == (level.channel != "z1_dot")
        assert len(level.limits) == (len(other.limits) if limited or level == other else 0)


def test_a_clock_set_back_ends_the_report_of_earlier_missing_samples() -> None:
    missing = MissingNumbers(LAB.sensors[:1])
    block = SampleBlock(5_000_000_000, 0, 0, 1000.0, np.full((2, 1), np.nan))
    missing.take(block)
    assert missing.found(0, block.end_ns)
    assert not missing.found(0, block.start_ns)
    again = MissingNumbers(LAB.sensors[:1])
    again.restore(missing.checkpoint())
    for one in (missing, again):
        one.take(replace(block, start_ns=4_000_000_000, samples=np.zeros((2, 1))))
        assert not one.found(0, block.end_ns)
