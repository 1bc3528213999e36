"""Machines with nothing known but their sensors: levels are watched from the first hop on."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from models.commissioning.commissioned import FILE, Installed, install
from models.commissioning.healthy import healthy_from_blocks
from models.diagnosis.window.moments import plan_for
from models.machine import AlarmSettings, MachineFile, Operation
from models.signals.block import FloatArray, SampleBlock
from models.signals.channels import Sensor
from rotorwatch.records.alarms import EventKind
from rotorwatch.records.example import example
from rotorwatch.records.health import Health, HealthState, Report
from rotorwatch.records.levels import ChannelLevels, LevelGrowth
from service.commands import watching
from service.commands.rotorwatch import app
from service.history.records import Checkpoint
from service.monitor.alarms.book import AlarmBook
from service.monitor.levels import LevelWatch
from service.monitor.monitor import MachineMonitor
from service.monitor.reports import identity_of
from service.stream.checkpoints import checkpoint_step, restored
from simulator.scenario import Event
from tests.commissioning.rotor_kit import NOTHING, commissioned, elsewhere, healthy, stream
from tests.service.rig.live import LAB, scenario_blocks
from tests.service.rig.watching import held, resumed
from tests.sure import sure

RATE_HZ, BLOCK_S, START_NS = 5120.0, 0.5, 1_767_225_600_000_000_000
FAN = MachineFile.model_validate({
    "site": "plant", "name": "fan", "rate_hz": RATE_HZ,
    "sensors": [
        {"name": "DE-H", "quantity": "acceleration", "location": "DE", "direction": "horizontal", "unit": "m/s2"},
        {"name": "NDE-V", "quantity": "velocity", "location": "NDE", "direction": "vertical", "unit": "mm/s"},
    ],
    "window": {"length_s": 20.0, "max_span_s": 30.0}, "levels": {"reference_windows": 3},
})  # fmt: skip


def blocks(
    seed: int, seconds: float, growth: tuple[float, float] = (1e9, 1.0), first: int = 0
) -> Iterator[SampleBlock]:
    """A fan whose drive end becomes louder at a time, in seconds from the start of all streams."""
    rng = np.random.default_rng([91, seed, first])
    size = round(BLOCK_S * RATE_HZ)
    for number in range(first, first + round(seconds / BLOCK_S)):
        t = number * BLOCK_S + np.arange(size) / RATE_HZ
        gain = np.where(t >= growth[0], growth[1], 1.0)
        drive = gain * (0.4 * np.sin(2 * np.pi * 24.8 * t) + 0.5 * rng.standard_normal(size))
        other = 1.1 * np.sin(2 * np.pi * 24.8 * t) + 0.3 * rng.standard_normal(size)
        samples = np.column_stack([drive, other]).astype(np.float32)
        yield SampleBlock(START_NS + round(number * BLOCK_S * 1e9), number, 1, RATE_HZ, samples)


def run(monitor: MachineMonitor, stream: Iterable[SampleBlock]) -> tuple[list[str], list[tuple[EventKind, str, float]]]:
    """Reports as JSON, and alarm events: kind, alarm and time, in seconds from the start of all streams."""
    windows, events = [], []
    for block in stream:
        report = monitor.step(block)
        assert report.verdict.accepted, report.verdict.text
        assert report.fault is None
        windows += [window.model_dump_json() for window in report.windows]
        events += [(one.kind, one.alarm.name, (one.time_ns - START_NS) / 1e9) for one in report.events]
    return windows, events


def latest(monitor: MachineMonitor) -> Report:
    return sure(monitor.health().latest)


def test_levels_are_watched_from_the_first_hop_with_only_sensors_in_the_file() -> None:
    monitor = MachineMonitor(install(FAN, None))
    windows, events = run(monitor, blocks(1, 30))
    assert len(windows) == 5  # the first hop needs a second of history
    assert '"levels":[{"channel":"DE-H"' in windows[0]
    assert not events
    health = monitor.health()
    assert health.state is HealthState.WATCHING
    assert "neither known nor commissioned" in health.reason
    drive, other = latest(monitor).levels
    assert drive.overall == pytest.approx(np.hypot(0.4 / np.sqrt(2), 0.5), rel=0.02)
    assert other.overall == pytest.approx(np.hypot(1.1 / np.sqrt(2), 0.3 * np.sqrt(990 / 2560)), rel=0.02)
    assert (drive.unit, other.unit, other.velocity) == ("m/s2", "mm/s", None)


def test_a_running_speed_in_the_machine_file_is_tracked_in_the_vibration() -> None:
    monitor = MachineMonitor(install(FAN.model_copy(update={"operation": Operation(speed_rpm=1500.0)}), None))
    run(monitor, blocks(1, 30))
    health = monitor.health()
    assert (health.state, health.filled) == (HealthState.WATCHING, 1.0)
    assert [one.x1 for one in latest(monitor).levels] == pytest.approx([0.4 / np.sqrt(2), 1.1 / np.sqrt(2)], rel=0.02)


def test_growth_to_four_times_is_a_danger_and_clears_when_it_ends() -> None:
    monitor = MachineMonitor(install(FAN, None))
    _, events = run(monitor, blocks(4, 120, growth=(80.0, 4.0)))
    kinds = [kind for kind, name, _ in events if name == "level:DE-H"]
    assert kinds in ([EventKind.RAISED], [EventKind.RAISED, EventKind.ESCALATED])
    assert {name for _, name, _ in events} == {"level:DE-H"}
    assert 80 < events[0][2] <= 80 + 2 * FAN.window.length_s
    assert monitor.health().state is HealthState.DANGER
    _, events = run(monitor, blocks(4, 120, first=240))
    assert [(kind, name) for kind, name, _ in events] == [(EventKind.CLEARED, "level:DE-H")]
    assert monitor.health().state is HealthState.WATCHING


def test_an_alarm_stays_in_the_deadband_and_clears_below_it() -> None:
    machine = FAN.model_copy(update={"alarms": AlarmSettings(on_delay_s=0.0, off_delay_s=0.0)})
    watch, book = LevelWatch(plan_for(machine, levels=True), machine, install(machine, None)), AlarmBook(machine.alarms)
    healthy = ChannelLevels.model_validate(example(ChannelLevels))
    (limit,) = healthy.limits
    for second, (level, state, raised) in enumerate(
        [(9.9, "normal", False), (10.1, "alert", True), (9.5, "normal", True), (8.9, "normal", False)]
    ):
        changes = {"measure": "overall", "alert": 10.0, "danger": 20.0, "fall": None, "state": state}
        now = limit.model_copy(update=changes)
        watch.latest = (healthy.model_copy(update={"overall": level, "limits": (now,)}),)
        watch.tell(book, START_NS + second * 10**9)
        assert book.present("level:DE-H") == raised, level


def test_a_restarted_monitor_continues_bit_for_bit() -> None:
    stream = list(blocks(5, 100, growth=(85.0, 3.0)))
    expected = run(MachineMonitor(install(FAN, None)), stream)
    first = MachineMonitor(install(FAN, None))
    before = run(first, stream[:90])
    for whole in (True, False):
        second = resumed(first, install(FAN, None), whole=whole)
        for number, block in enumerate(() if whole else stream[:90]):
            second._window.recall(block.samples, block.start_ns, newest=number == 89)
        after = run(second, stream[90:])
        assert (before[0] + after[0], before[1] + after[1]) == expected, whole


@pytest.mark.parametrize(
    ("changes", "kept"),
    [
        ({"description": "a fan"}, True),
        ({"alarms": AlarmSettings(on_delay_s=20.0)}, True),
        ({"levels": FAN.levels.model_copy(update={"reference_since": "2026-11-25, new bearing"})}, False),
        ({"sensors": (FAN.sensors[0].model_copy(update={"unit": "g"}), FAN.sensors[1])}, False),
    ],
)
def test_first_windows_are_kept_unless_sensors_or_their_settings_change(changes: dict[str, Any], kept: bool) -> None:
    """Otherwise a machine that has become louder would be healthy after an update of the program."""
    before = install(FAN, None)
    monitor = MachineMonitor(before)
    run(monitor, blocks(8, 65))
    step = checkpoint_step(identity_of(before), monitor.state(), 1)
    now = install(FAN.model_copy(update=changes), None)
    told = Checkpoint(replace(step.head, code_version="0.0.9"), step.new_parts)
    after, text = restored(lambda: MachineMonitor(now), identity_of(now), told, 0)
    assert ("they are taken again (the levels are of other sensors or settings)" in text) == (not kept)
    _, events = run(after, blocks(8, 60, growth=(0.0, 3.0), first=130))
    assert [name for kind, name, _ in events if kind is EventKind.RAISED] == (["level:DE-H"] if kept else [])


def test_commissioned_levels_are_the_reference_and_the_state_is_unchanged(tmp_path: Path) -> None:
    found = healthy_from_blocks("healthy.mcap", FAN, blocks(6, 150))
    made = commissioned(FAN, found)
    assert made.report.verdict == "limited"
    (tmp_path / FILE).write_text(sure(made.commissioned).model_dump_json())
    monitor = MachineMonitor(install(FAN, tmp_path))
    assert monitor.watching  # so no window is skipped when the computer cannot keep up
    _, events = run(monitor, blocks(7, 60))
    assert (monitor.health().state, monitor.health().reason, events) == (HealthState.UNCHANGED, "", [])
    _, events = run(monitor, blocks(7, 40, growth=(0.0, 2.2), first=120))
    assert [(kind, name) for kind, name, _ in events] == [(EventKind.RAISED, "level:DE-H")]
    assert monitor.health().state is HealthState.ALERT


def test_levels_are_judged_at_a_speed_not_commissioned() -> None:
    machine = elsewhere(NOTHING)
    made = sure(commissioned(machine, healthy(machine, 70.0, 60163)).commissioned)
    faster = Event(at_s=0.0, speed_rpm=1.06 * LAB.operation.speed_rpm)
    for size, state in ((1.0, HealthState.WATCHING), (4.0, HealthState.ALERT)):
        monitor = MachineMonitor(Installed(machine, None, made))
        for block in stream(66.0, 60164, faster, Event(at_s=0.0, excitation_level=size)):
            monitor.step(replace(block, schema_hash=machine.descriptor.schema_hash))
        now = monitor.health()
        assert now.state is state
        assert "levels are judged as at the nearest commissioned speed: speed is 1399 rpm" in now.reason


def drive(
    seconds: float,
    speed_hz: Callable[[FloatArray], FloatArray],
    line: float = 0.0,
    *,
    by_angle: bool = True,
    length_s: float = 20.0,
    power: int = 0,
) -> tuple[list[tuple[ChannelLevels, ...]], list[tuple[EventKind, str]]]:
    """Levels and alarms of a drive with four first windows and a line at 61 Hz from 100 s on.

    Its speed is known by a shaft angle, or followed in the vibration near 1380 rpm. Apart from the line, its vibration
    rises with this `power` of the speed.
    """
    angle = Sensor(name="angle", quantity="shaft_angle", location="shaft", direction="rotation", unit="rad")
    limits = FAN.levels.model_copy(update={"reference_windows": 4})
    alarms_as_windows = FAN.alarms.model_copy(update={"off_delay_s": 20.0})
    known = {"sensors": (*FAN.sensors, angle)} if by_angle else {"operation": Operation(speed_rpm=1380.0)}
    window = FAN.window.model_copy(update={"length_s": length_s, "max_span_s": 1.5 * length_s})
    changes = {**known, "levels": limits, "alarms": alarms_as_windows, "window": window}
    monitor = MachineMonitor(install(FAN.model_copy(update=changes), None))
    rng, size, turned = np.random.default_rng(92), round(BLOCK_S * RATE_HZ), 0.0
    found, alarms = list[tuple[ChannelLevels, ...]](), list[tuple[EventKind, str]]()
    for number in range(round(seconds / BLOCK_S)):
        t = number * BLOCK_S + np.arange(size) / RATE_HZ
        theta = turned + np.cumsum(2 * np.pi * speed_hz(t) / RATE_HZ)
        turned = theta[-1]
        samples = 3.0 * np.cos(theta)[:, None] + 0.3 * rng.standard_normal((size, 2))
        samples *= np.maximum(speed_hz(t) / 24.8, 0.05)[:, None] ** power
        samples += (line * np.sin(2 * np.pi * 61.0 * t) * (t > 100.0))[:, None]
        every = (np.column_stack([samples, theta % (2 * np.pi)]) if by_angle else samples).astype(np.float32)
        report = monitor.step(SampleBlock(START_NS + round(number * BLOCK_S * 1e9), number, 1, RATE_HZ, every))
        found += [one.levels for one in report.windows]
        alarms += [(one.kind, one.alarm.name) for one in report.events]
    return found, alarms


def set_points(slow_hz: float, *slow: tuple[float, float]) -> Callable[[FloatArray], FloatArray]:
    return lambda t: np.where(np.any([(t >= begin) & (t < end) for begin, end in slow], axis=0), slow_hz, 24.8)


def test_a_change_to_a_known_set_point_is_not_growth() -> None:
    # Two first windows at each set point; later the speed changes within a hop.
    found, _ = drive(160, set_points(22.3, (41.0, 81.0), (106.0, 126.4)))
    for levels in found:
        assert all((one.growth or 1.0) < 1.5 for one in levels)  # up to 150


def test_without_a_shaft_angle_no_growth_is_stated_while_the_speed_is_unknown() -> None:
    found, alarms = drive(165, set_points(20.5, (41.0, 81.0), (106.0, 126.4)), by_angle=False)
    assert not alarms
    told = [all(one.growth is not None for one in levels) for levels in found[16:]]  # once there is a reference
    unknown = [all(one.x1 is None for one in levels) for levels in found[16:]]
    assert any(unknown)
    assert not any(growth and lost for growth, lost in zip(told, unknown, strict=True))
    assert told.count(False) <= unknown.count(True) + 3  # until the hop in which a change ended is over


@pytest.mark.parametrize("by_angle", [True, False])
def test_a_line_stays_raised_while_the_set_point_changes(by_angle: bool) -> None:
    _, alarms = drive(230, set_points(20.0, (41.0, 81.0), (138.5, 183.5)), line=0.6, by_angle=by_angle)
    assert alarms == [(EventKind.RAISED, "level:DE-H"), (EventKind.RAISED, "level:NDE-V")]


def test_without_a_shaft_angle_a_stop_and_a_start_are_not_growth() -> None:
    def stopping(t: FloatArray) -> FloatArray:
        return np.asarray(np.interp(t, [250.0, 275.0, 330.0, 345.0], [24.8, 0.0, 0.0, 24.8]), dtype=np.float64)

    found, _ = drive(440, stopping, by_angle=False, length_s=60.0, power=2)
    beyond = {limit.measure for levels in found for one in levels for limit in one.limits if limit.text}
    assert beyond <= {"overall", "velocity"}  # fallen, as if the sensors had lost their supply
    assert all(one.growth is not None for levels in (found[48], *found[-4:]) for one in levels)


def test_growth_is_found_at_a_speed_that_always_varies() -> None:
    def varying(t: FloatArray) -> FloatArray:
        return np.asarray(23.55 + 1.25 * np.sin(2 * np.pi * t / 20.0), dtype=np.float64)

    found, _ = drive(140, varying, line=2.0)
    assert all(sure(one.growth) > 1.5 for one in found[-1])


def test_a_watched_machine_states_the_detectable_level_growth() -> None:
    monitor = MachineMonitor(install(FAN, None))
    run(monitor, blocks(1, 30))
    before = sure(latest(monitor).level_growth)
    assert before.growth is None
    assert "no limit yet" in before.text
    run(monitor, blocks(1, 70, first=60))
    now = latest(monitor)
    assert now.state == HealthState.WATCHING
    growth = sure(sure(now.level_growth).growth)
    assert 0.5 < growth < 0.9
    _, events = run(monitor, blocks(1, 40, growth=(0.0, 1.05 * (1 + growth)), first=200))
    assert [(kind, name) for kind, name, _ in events] == [(EventKind.RAISED, "level:DE-H")]
    assert latest(monitor).level_growth is None  # the alert replaces it
    assert monitor.health().state is HealthState.ALERT
    alarm = next(one for one in monitor.health().alarms if one.name == "level:DE-H")
    assert "alert limit" in alarm.note
    assert "the first windows" in alarm.note


def test_status_shows_the_detectable_growth_and_fits_narrow_terminals(monkeypatch: pytest.MonkeyPatch) -> None:
    growth = LevelGrowth.model_validate(example(LevelGrowth))
    report = Report.model_validate(example(Report)).model_copy(update={"level_growth": growth})
    health = Health.model_validate(example(Health)).model_copy(update={"report": report})
    monkeypatch.setattr(watching, "_fetch_healths", lambda *_: [health])
    said = CliRunner().invoke(app, ["status"]).stdout
    assert f"demo/lab: {growth.text}" in said
    health = Health.model_validate(example(Health)).model_copy(update={"site": "north", "machine": "feed-pump-7"})
    monkeypatch.setattr(watching, "_fetch_healths", lambda *_: [health])
    said = CliRunner().invoke(app, ["status"], env={"COLUMNS": "60"}).stdout
    assert "│ north/feed-pump- │ alert │" in said
    assert "│ 7                │       │" in said


def test_a_dead_sensor_anywhere_is_a_sensor_fault() -> None:
    monitor = MachineMonitor(install(FAN, None))
    _, events = run(monitor, held(blocks(5, 60), 1, 0.25))
    assert [(kind, name) for kind, name, _ in events] == [(EventKind.RAISED, "data-stuck")]
    (fault,) = latest(monitor).sensors
    assert (fault.states, fault.kind) == (("@NDE-V",), "stuck")
    assert fault.text.startswith("NDE-V: repeated the value 0.25 mm/s")
    assert monitor.health().state is HealthState.DATA_HEALTH


def test_a_faulty_probe_does_not_raise_s_max_of_the_other_probe() -> None:
    probe = {"quantity": "displacement", "location": "bearing", "unit": "um"}
    sensors = [{**probe, "name": f"DE-{one}", "direction": one, "angle_deg": at} for one, at in (("X", 45), ("Y", 135))]
    pump = MachineFile.model_validate(FAN.model_dump(include={"site", "name", "rate_hz"}) | {"sensors": sensors})
    jumping = []
    for block in blocks(5, 400):
        samples = 10 * block.samples
        if block.start_ns >= START_NS + 333_000_000_000:
            samples[:, 1] = -1270 + 0.01 * samples[:, 1]
        jumping.append(replace(block, samples=samples))
    monitor = MachineMonitor(install(pump, None))
    _, events = run(monitor, jumping[:720])
    assert "data-offset" in {name for _, name, _ in events}
    assert [one.s_max for one in latest(monitor).levels] == [None, None]
    _, later = run(monitor, jumping[720:])
    assert {name for _, name, _ in events + later} == {"data-offset", "level:DE-Y"}
    assert sure(latest(monitor).levels[0].s_max) < 100


MESH = 17.0
"""Times running speed; twice the band that the likelihood uses."""


def test_lines_unknown_to_the_theory_are_found_without_commissioning() -> None:
    monitor = MachineMonitor(install(LAB, "lab"))
    fast = [n for n, one in enumerate(LAB.sensors) if (one.quantity, one.location) == ("velocity", "bearing")]
    meshing: list[SampleBlock] = []
    for block in scenario_blocks(95.0):
        samples = block.samples.copy()
        if len(meshing) >= 650:
            turned = block.samples[:, [-1]]
            samples[:, fast] += 0.7 * samples[:, fast].std(axis=0) * np.cos(MESH * turned)
        meshing.append(replace(block, samples=samples))
    _, ((kind, name, _),) = run(monitor, meshing)
    assert (kind, name) == (EventKind.RAISED, "model")
    note = next(one for one in monitor.health().alarms if one.name == "model").note
    assert "a line within 3" in note
    assert "that no rotor of the machine file makes" in note
