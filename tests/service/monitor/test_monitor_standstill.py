"""A machine that stops and starts raises no sensor alarm; a phase reference lost while it runs does."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from models.alarm_names import PHASE_REFERENCE
from models.commissioning.commissioned import Installed
from models.commissioning.healthy import healthy_from_blocks
from models.machine import MachineFile
from models.signals.block import SampleBlock
from models.signals.channels import Quantity
from rotorwatch.records.health import HealthState, Report
from service.monitor.alarms.alarm import AlarmEvent
from service.monitor.monitor import MachineMonitor
from tests.commissioning.rotor_kit import commissioned, recording
from tests.service.rig.live import LAB, scenario_blocks
from tests.service.rig.watching import feed, held, named, resumed

STOPS_S, STANDS_S, STARTS_S, RUNS_S, END_S = 40.0, 50.0, 95.0, 105.0, 150.0
NOISE = 0.01
KIT = LAB.model_copy(update={"window": LAB.window.model_copy(update={"length_s": 20.0})})
NEW = MachineFile.model_validate(
    KIT.model_dump(exclude={"rotor", "condition"}, exclude_none=True) | {"levels": {"reference_windows": 2}}
)
COMMISSIONED = NEW.model_copy(update={"levels": KIT.levels})
ON_CASING = COMMISSIONED.model_copy(
    update={
        "sensors": tuple(
            one.model_copy(update={"location": "DE" if one.location == "bearing" else one.location})
            for one in KIT.sensors
            if one.quantity is Quantity.SHAFT_ANGLE or (one.quantity is Quantity.VELOCITY and one.location == "bearing")
        )
    }
)
WITHOUT_ANGLE = NEW.model_copy(update={"sensors": NEW.sensors[:-1]})


def stopping(machine: MachineFile, what: str) -> Iterator[SampleBlock]:
    """A machine that runs, slows down, stands and runs again; or whose ``angle``, or ``signals``, stand for that time.

    The running machine's samples, with time scaled by speed; forces follow the square of speed.
    """
    stream = scenario_blocks(END_S)
    samples = np.concatenate([block.samples for block in stream]).astype(float)
    t = np.arange(len(samples)) / LAB.rate_hz
    speed = np.interp(t, [STOPS_S, STANDS_S, STARTS_S, RUNS_S], [1.0, 0.0, 0.0, 1.0])
    turned = np.cumsum(speed) / LAB.rate_hz
    rng = np.random.default_rng(93001)
    for column, channel in enumerate(LAB.sensors):
        own = samples[:, column].copy()
        if channel.quantity is Quantity.SHAFT_ANGLE:
            samples[:, column] = np.interp(t if what == "signals" else turned, t, np.unwrap(own)) % (2 * np.pi)
            continue
        if what == "machine":
            size = speed ** (3 if channel.quantity is Quantity.VELOCITY else 2)
            samples[:, column] = size * np.interp(turned, t, own) + NOISE * own.std() * rng.standard_normal(len(t))
        elif what == "signals":
            samples[(t > STOPS_S) & (t < RUNS_S), column] = 0.0
    first = 0
    for block in stream:
        last = first + len(block.samples)
        yield replace(block, samples=samples[first:last, : len(machine.sensors)].astype(np.float32))
        first = last


def monitor_of(machine: MachineFile) -> MachineMonitor:
    return MachineMonitor(Installed(machine))


@cache
def stopped() -> Sequence[SampleBlock]:
    """The rotor kit that stops and starts; read-only."""
    return tuple(stopping(KIT, "machine"))


@cache
def usual() -> tuple[list[Report], list[AlarmEvent]]:
    """Its reports and events; from halfway, while it stands, a monitor that was restored continues with the same."""
    monitor, half = monitor_of(KIT), len(stopped()) // 2
    reports, events = feed(monitor, stopped()[:half])
    again = resumed(monitor, Installed(KIT))
    rest = feed(monitor, stopped()[half:])
    assert feed(again, stopped()[half:]) == rest
    return reports + rest[0], events + rest[1]


def test_a_stop_and_start_raise_no_alarm_and_the_machine_is_healthy_again() -> None:
    stream, (reports, events) = stopped(), usual()
    assert events == []
    states = {round((one.end_ns - stream[0].start_ns) / 1e9): one.state for one in reports}
    assert states[38] is states[148] is HealthState.HEALTHY
    standing = [one for one in reports if "at a standstill" in one.reason]
    assert {one.state for one in standing} == {HealthState.NOT_EVALUABLE}
    assert standing[-1].end_ns - standing[0].end_ns >= (STARTS_S - STANDS_S) * 1e9
    assert not any(one.sensors for one in standing)
    ends_s = [(one.end_ns - stream[0].start_ns) / 1e9 for one in standing if "machine is at a standstill" in one.reason]
    assert STANDS_S < min(ends_s) < max(ends_s) < RUNS_S, "once it runs again, it *was* at a standstill"


@pytest.mark.parametrize(("what", "alarm"), [("angle", PHASE_REFERENCE), ("signals", "data-stuck")])
def test_signals_lost_while_the_machine_runs_raise_a_data_alarm(what: str, alarm: str) -> None:
    _, events = feed(monitor_of(KIT), stopping(KIT, what))
    assert named(events) == [("raised", alarm)]


@pytest.mark.parametrize("dead", [pytest.param(0, marks=pytest.mark.long), 3])
def test_a_stop_with_a_dead_channel_adds_no_other_sensor_fault(dead: int) -> None:
    name = KIT.sensors[dead].name
    for one, other in zip(feed(monitor_of(KIT), held(stopped(), dead, 0.0))[0], usual()[0], strict=True):
        found, known = ({fault.states for fault in each.sensors} for each in (one, other))
        assert found - {(name,)} == {states for states in known if name not in states}


def test_without_a_shaft_angle_a_stop_raises_only_level_alarms() -> None:
    reports, events = feed(monitor_of(WITHOUT_ANGLE), stopping(WITHOUT_ANGLE, "machine"))
    assert any("all its sensors have lost their supply" in one.reason for one in reports)
    assert {one.alarm.name for one in events} == {f"level:{one.name}" for one in WITHOUT_ANGLE.sensors}


def of(machine: MachineFile, stream: Sequence[SampleBlock], gain: float = 1.0) -> list[SampleBlock]:
    """The machine's own channels of the rotor kit, with all vibration times `gain`."""
    names = {one.name for one in machine.sensors}
    columns = [column for column, one in enumerate(KIT.sensors) if one.name in names]
    gains = [gain] * (len(columns) - 1) + [1.0]
    return [replace(one, samples=(one.samples[:, columns] * gains).astype(np.float32)) for one in stream]


@cache
def made_healthy(casing: bool) -> Installed:
    machine = ON_CASING if casing else COMMISSIONED
    made = commissioned(machine, recording(machine, of(machine, scenario_blocks(50.0))))
    return Installed(machine, None, made.commissioned)


@pytest.mark.parametrize(("casing", "turns"), [(False, False), (False, True), (True, False)])
def test_fallen_levels_in_the_first_window_raise_alarms_only_if_the_machine_turns(casing: bool, turns: bool) -> None:
    installed = made_healthy(casing)
    machine = installed.machine
    stream = scenario_blocks(18.0) if turns else list(stopped())[round(10 * STANDS_S) :][:180]
    first = of(machine, stream, NOISE if turns else 1.0)
    reports, events = feed(MachineMonitor(installed), first)
    assert {one.state for one in reports} <= {HealthState.WARMING, HealthState.ALERT}
    assert {one.alarm.name for one in events} == {f"level:{one.name}" for one in machine.sensors[:-1] if turns}


@pytest.mark.parametrize("machine", [NEW, WITHOUT_ANGLE])
def test_levels_at_standstill_are_no_reference_for_running(machine: MachineFile) -> None:
    monitor = monitor_of(machine)
    stream = list(stopping(machine, "machine"))[round(10 * STANDS_S) :]
    starts, found = round(10 * (STARTS_S - STANDS_S)), []
    for part in (stream[:starts], stream[starts:]):
        _, events = feed(monitor, part)
        reference = monitor._levels.reference
        states = () if reference is None else reference.states
        found.append(
            ([one.speed_rad_s is None for one in states], [name for _, name in named(events) if "level" in name])
        )
    if machine is NEW:
        assert found[0] == ([], [])
        assert not any(found[1][0])
        assert found[1][1] == []
    else:  # it alarms once that the machine has become louder
        assert found[0] == ([True], [])
        assert found[1][0] == [True, False]
        assert set(found[1][1]) == {f"level:{one.name}" for one in machine.sensors}


def test_a_stop_with_run_down_and_run_up_is_left_out_of_a_healthy_recording() -> None:
    stream = list(stopping(LAB, "machine"))
    recorded = healthy_from_blocks("healthy.mcap", LAB, stream)
    hop_s = LAB.window.hop_s
    usual = LAB.operation.speed_rad_s * hop_s
    assert len(recorded.stretches) == 2
    assert all(abs(hop.turned_rad) == pytest.approx(usual, rel=0.01) for hop in recorded.hops)
    assert (
        STARTS_S - STOPS_S < recorded.stopped_s < RUNS_S - STOPS_S + 4 * hop_s
    )  # an edge hop on either side, and the grid of hops
    assert recorded.duration_s + recorded.stopped_s == pytest.approx(END_S, abs=hop_s)
    standing = [one for one in stream if STANDS_S < (one.start_ns - stream[0].start_ns) / 1e9 < STARTS_S - 1]
    assert healthy_from_blocks("standing.mcap", LAB, standing).stopped_s == 0
