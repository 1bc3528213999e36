"""The monitor of a machine commissioned without known parameters, from block to alarm."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.finite_elements.machines import rotor_named
from benchmarks.finite_elements.observed import WindowSizes, machine_of, sampled
from benchmarks.finite_elements.observed import blocks as observed_blocks
from benchmarks.finite_elements.scenes import SceneRange, SourceLayout, drawn_condition
from benchmarks.studies.subjects.watched import commissioned as commissioned_blocks
from models.alarm_names import LEVEL, MODEL
from models.commissioning.commissioned import Installed
from models.diagnosis.readings import Diagnosis
from models.levels.settings import LevelSettings
from models.machine import MachineFile
from models.physics.rotor import PARAMETERS
from models.signals.block import SampleBlock
from models.signals.channels import Sensor
from rotorwatch.records.alarms import Severity
from rotorwatch.records.example import example
from rotorwatch.records.health import HealthState, Report
from rotorwatch.records.windows import NaturalFrequency, Verdict
from service.monitor.evaluation import Evaluation
from service.monitor.monitor import MachineMonitor
from simulator.scenario import Event, Rub, load_scenario
from simulator.stream import blocks
from tests.commissioning.rotor_kit import (
    LAB,
    NOTHING,
    commissioned,
    factored,
    humming,
    mounted,
    no_velocity,
    recording,
    samples_of,
    stream,
    with_samples,
    with_sensors,
)
from tests.service.rig.watching import at_once, feed
from tests.sure import sure

SEED = 71
_FULL = 625
"""Blocks of a full window."""
MACHINE = at_once(NOTHING)
SHORT = LAB.model_copy(update={"window": LAB.window.model_copy(update={"length_s": 30.0, "max_span_s": 60.0})})


def before() -> Sequence[SampleBlock]:
    """The healthy machine: 150 s are enough to commission it where equations can be evaluated."""
    return stream(250.0, SEED)


@cache
def installed() -> Installed:
    made = commissioned(MACHINE, recording(MACHINE, before()[:1500]))
    return Installed(MACHINE, None, sure(made.commissioned))


def full(windows: Sequence[Report]) -> list[Report]:
    return [window for window in windows if window.filled == 1.0]


def watched(seen: Sequence[SampleBlock]) -> tuple[list[Report], set[str]]:
    """Reports on full windows, and the alarms apart from levels."""
    windows, events = feed(MachineMonitor(installed()), seen)
    return full(windows), {event.alarm.name for event in events if not event.alarm.name.startswith(LEVEL)}


def test_the_healthy_machine_stays_healthy() -> None:
    windows, events = feed(MachineMonitor(installed()), stream(85.0, SEED + 1))
    assert len(full(windows)) >= 5
    assert {window.state for window in full(windows)} == {HealthState.HEALTHY}
    assert not events
    readings = {reading.name: reading for reading in full(windows)[-1].parameters}
    assert readings["EI"].reason
    assert all(readings[name].relative_change is not None for name in ("k_by", "c_by", "k_bz", "c_bz", "e"))
    rows = {row.equation: row for row in full(windows)[-1].equations}
    assert [reading.name for reading in rows["28 + 29"].parameters] == ["k_by", "c_by"]


@pytest.mark.parametrize(
    ("name", "change"),
    [("c_bz", -0.4), *(pytest.param(*one, marks=pytest.mark.long) for one in (("k_by", -0.2), ("e", 0.5)))],
)
def test_a_change_is_named_alone(name: str, change: float) -> None:
    windows, alarms = watched(stream(65.0, SEED + 2, Event(at_s=0.0, parameter=name, relative_change=change)))
    verdict = sure(windows[-1].verdict)
    assert [finding.name for finding in verdict.changed] == [name]
    assert alarms == {name}
    (reading,) = (one for one in verdict.current if one.name == name)
    low, high = sure(reading.interval_95)
    assert low - 0.05 < change < high + 0.05


def test_exchanged_sensors_of_a_place_raise_a_data_alarm_and_no_parameter() -> None:
    """They agree with each other, and the machine is as it was."""
    names, healthy = [sensor.name for sensor in MACHINE.sensors], stream(65.0, SEED + 3)
    samples = samples_of(healthy)
    wired = samples.copy()
    for rate in ("", "_dot"):
        own, other = names.index(f"y1{rate}"), names.index(f"z1{rate}")
        wired[:, [own, other]] = samples[:, [other, own]]
    windows, alarms = watched(with_samples(healthy, wired))
    assert alarms == {"data-swapped"}
    assert not any(window.parameters for window in windows)


@pytest.mark.parametrize("change", [0.0, -0.35])
def test_a_gain_that_has_drifted_a_little_widens_the_readings_of_its_plane(change: float) -> None:
    """Which of the two sensors has drifted is not known: the reading of k_by is wrong by all of it or hardly at all."""
    event = Event(at_s=0.0, parameter="k_by", relative_change=change)
    ran = stream(65.0, SEED + 2, *([event] if change else []))
    (*_, plain), _ = watched(ran)
    (*_, last), alarms = watched(factored(MACHINE, ran, y2_dot=1.03))
    assert alarms == {"data-gain"} | ({"k_by"} if change else set())
    assert last.state is (HealthState.DANGER if change else HealthState.DATA_HEALTH)
    before, now = ({one.name: sure(one.standard_error) for one in of.parameters[:5]} for of in (plain, last))
    for name in ("k_by", "c_by", "e"):
        assert now[name] > 0.9 * np.hypot(before[name], 0.02 * (1 + change * (name == "k_by")))
    assert now["k_bz"] < 1.1 * before["k_bz"]


def test_a_drifted_gain_widens_a_reading_by_what_it_changes_there() -> None:
    """The relation was learned on so little data that a gain of y1 changes k_by by more than twice as much."""
    ran = stream(65.0, SEED + 2)
    plain, drifted = (
        {one.name: one for one in watched(seen)[0][-1].parameters} for seen in (ran, factored(MACHINE, ran, y1=0.95))
    )
    wrong = sure(drifted["k_by"].relative_change) - sure(plain["k_by"].relative_change)
    assert 0.08 < wrong < 1.5 * sure(drifted["k_by"].standard_error)


def test_a_drifted_gain_of_a_sensor_at_45_degrees_widens_both_planes() -> None:
    machine = MachineFile.model_validate(
        mounted(LAB, dict.fromkeys(("y1", "y1_dot", "y2", "y2_dot"), (45.0, 135.0))).model_dump(
            exclude={"rotor", "operation", "condition"}
        )
    )
    names = [sensor.name for sensor in MACHINE.sensors]

    def turned(seen: Sequence[SampleBlock], **factors: float) -> Sequence[SampleBlock]:
        samples = samples_of(seen)
        for first in ("y1", "y1_dot", "y2", "y2_dot"):
            own, other = names.index(first), names.index(first.replace("y", "z"))
            y, z = samples[:, own].copy(), samples[:, other].copy()
            samples[:, own], samples[:, other] = (y + z) / np.sqrt(2), (z - y) / np.sqrt(2)
        return factored(MACHINE, with_samples(seen, samples), **factors)

    made = Installed(machine, None, commissioned(machine, recording(machine, turned(before()[:1500]))).commissioned)
    ran = stream(65.0, SEED + 2)
    plain, drifted = (
        {one.name: one for one in full(feed(MachineMonitor(made), seen)[0])[-1].parameters[:5]}
        for seen in (turned(ran), turned(ran, y2_dot=1.04))
    )
    for name in ("k_by", "k_bz"):
        assert sure(drifted[name].standard_error) > 1.5 * sure(plain[name].standard_error)


def test_what_becomes_of_the_diagnosis_is_said_of_each_faulty_sensor() -> None:
    windows, _ = watched(factored(MACHINE, stream(65.0, SEED + 2), y1=np.nan, z2=1.04))
    dead, drifted = windows[-1].sensors
    assert dead.text.endswith("the machine is diagnosed without it")
    assert drifted.text.endswith("the machine is diagnosed with larger errors")


def test_a_gain_that_has_drifted_far_stops_the_diagnosis() -> None:
    windows, alarms = watched(factored(MACHINE, stream(65.0, SEED + 1), y2_dot=1.08))
    assert alarms == {"data-gain"}
    assert not any(window.parameters for window in windows)


def test_a_change_of_the_other_plane_is_named_without_a_dead_sensor() -> None:
    """The relation that was learned with the dead sensor is not read; the other still holds."""
    ran = stream(65.0, SEED + 2, Event(at_s=0.0, parameter="k_bz", relative_change=-0.35))
    (*_, last), alarms = watched(factored(MACHINE, ran, y1=np.nan))
    assert alarms == {"data-missing", "k_bz"}
    assert last.state is HealthState.ALERT
    readings = {one.name: one for one in last.parameters}
    assert readings["k_by"].relative_change is None
    assert "y1" in readings["k_by"].reason
    assert abs(sure(readings["k_bz"].relative_change) + 0.35) < 3 * sure(readings["k_bz"].standard_error) < 0.2
    assert readings["e"].relative_change is not None


def test_a_plane_is_diagnosed_without_any_sensor_of_the_other() -> None:
    ran = stream(65.0, SEED + 2, Event(at_s=0.0, parameter="k_bz", relative_change=-0.35))
    dead = dict.fromkeys(("y1", "y2", "y1_dot", "y2_dot"), np.nan)
    windows, alarms = watched(factored(MACHINE, ran, **dead))
    assert alarms == {"data-missing", "k_bz"}
    read = {one.name for one in windows[-1].parameters if one.relative_change is not None}
    assert read == {"k_bz", "c_bz", "e"}


def test_a_change_within_the_window_is_named_and_not_outside_the_model() -> None:
    """Windows across the change fit neither state of the machine; their latest data fit."""
    begins_s = 63.0
    change = Event(at_s=begins_s, parameter="k_by", relative_change=-0.35)
    blocks = stream(97.0, SEED + 5, change)
    _, events = feed(MachineMonitor(installed()), blocks)
    told = [event for event in events if not event.alarm.name.startswith(LEVEL)]
    assert [event.alarm.name for event in told] == ["k_by"]
    assert not told[0].alarm.low_confidence
    assert (told[0].time_ns - blocks[0].start_ns) / 1e9 < begins_s + 25.0


def test_an_unbalance_that_does_not_explain_the_latest_data_has_low_confidence() -> None:
    """As when a foundation softens: most of the window is from before, so that it still fits."""
    changes = {"e": 1.0, "k_by": -0.15, "k_bz": -0.15}
    at_once = [Event(at_s=63.0, parameter=name, relative_change=change) for name, change in changes.items()]
    _, events = feed(MachineMonitor(installed()), stream(82.0, SEED + 5, *at_once))
    told = {event.alarm.name: event.alarm for event in events if not event.alarm.name.startswith(LEVEL)}
    assert told.keys() == {"e", MODEL}
    assert told["e"].low_confidence


def test_a_speed_not_commissioned_is_not_evaluable_and_raises_only_levels() -> None:
    faster = Event(at_s=0.0, speed_rpm=1.15 * LAB.operation.speed_rpm)
    windows, events = feed(MachineMonitor(installed()), stream(65.0, SEED + 3, faster))
    assert {window.state for window in full(windows)} <= {HealthState.NOT_EVALUABLE, HealthState.ALERT}
    told = "not evaluable here: speed is 1518 rpm, commissioned at 1320 rpm"
    assert all(told in window.reason for window in full(windows))
    # Growth against the commissioned speed is reported with that caveat.
    assert all("commissioned at another speed" in event.alarm.note for event in events)


@pytest.mark.parametrize(
    ("clearance_m", "size", "duration_s", "of"),
    [
        pytest.param(4e-5, 2.0, 66.0, installed, id="heavy"),
        pytest.param(8e-5, 0.5, 56.0, lambda: Installed(at_once(SHORT)), id="light, not commissioned"),
    ],
)
def test_a_rub_is_suspected_and_names_uncertain(
    clearance_m: float, size: float, duration_s: float, of: Callable[[], Installed]
) -> None:
    scenario, machine = load_scenario("healthy")
    rubbing = scenario.model_copy(
        update={"rub": Rub(clearance_m=clearance_m), "events": (Event(at_s=0.0, anomaly="rub", size=size),)}
    ).overridden(duration_s=duration_s, seed=SEED + 7)
    windows, events = feed(MachineMonitor(of()), [block for block, _ in blocks(rubbing, machine)])
    assert "(disc) that is pushed back at large displacements, as by a rub" in full(windows)[-1].suspect
    raised = {event.alarm.name: event.alarm for event in events}
    assert "as by a rub" in raised[MODEL].note
    named = [alarm for name, alarm in raised.items() if name in PARAMETERS]
    assert all(alarm.low_confidence for alarm in named)
    # A real change of that size would be a danger.
    assert {alarm.severity for alarm in named} <= {Severity.ALERT}


def test_level_growth_that_a_named_change_does_not_explain_raises_its_alarm() -> None:
    """A 2x appears after an unbalance was named, and the machine is outside the model from then on."""
    begins = 700
    after = stream(110.0, SEED + 2, Event(at_s=0.0, parameter="e", relative_change=0.5))
    samples = samples_of(after)
    names = [channel.name for channel in LAB.sensors]
    theta, once = samples[:, names.index("theta")], len(samples) * begins // len(after)
    for state in ("y1", "y2", "z1", "z2"):
        line = 3.5 * np.cos(2 * theta[once:])
        samples[once:, names.index(state)] += line
        samples[once:, names.index(f"{state}_dot")] += 2 * LAB.operation.speed_rad_s * 1e-3 * line
    monitor = MachineMonitor(installed())
    _, first = feed(monitor, with_samples(after, samples)[:begins])
    assert {event.alarm.name for event in first} == {"e"}
    _, events = feed(monitor, with_samples(after, samples)[begins:])
    assert "y2 (disc y) 2x" in next(event.alarm.note for event in events if event.alarm.name == f"{LEVEL}y2")


def test_a_wrong_gain_at_a_place_is_suspected_and_no_parameter_named() -> None:
    windows, events = feed(MachineMonitor(installed()), factored(MACHINE, stream(63.0, SEED + 8), y2=0.8, y2_dot=0.8))
    raised = {event.alarm.name: event.alarm for event in events}
    assert "gain of y2 and y2_dot: 0.8" in raised[MODEL].note
    assert "gain of y2 and y2_dot: 0.8" in full(windows)[-1].suspect
    assert not raised.keys() & set(PARAMETERS)


@pytest.mark.parametrize(
    ("hz", "told"),
    [
        (37.0, ("a line at 37 Hz (1.68 times running speed, ", "% of the random vibration of ", ") that the healthy")),
        (
            22.1,
            ("a line at 22.1 Hz (1.00", " times running speed, ", ", beats with the 1x every 10 s) that the healthy"),
        ),
    ],
)
def test_a_line_that_the_healthy_machine_lacked_is_suspected(hz: float, told: tuple[str, ...]) -> None:
    windows, events = feed(MachineMonitor(installed()), humming(stream(63.0, SEED + 9), hz, 20e-6, 20e-6))
    raised = {event.alarm.name: event.alarm for event in events}
    assert all(part in raised[MODEL].note for part in told), raised[MODEL].note
    assert all(window.suspect for window in full(windows))
    assert all(alarm.low_confidence for name, alarm in raised.items() if name in PARAMETERS)


def test_nothing_is_named_where_a_line_dominates_the_vibration() -> None:
    """A 1x and a sine with random phases in every channel are no rotor's motion, whatever fits them."""
    healthy, rng = stream(63.0, SEED + 9), np.random.default_rng(1)
    samples = samples_of(healthy)
    names = [channel.name for channel in LAB.sensors]
    turned = np.unwrap(samples[:, names.index("theta")])
    for place in ("y1", "y2", "z1", "z2"):
        at, rate = names.index(place), names.index(f"{place}_dot")
        size = samples[:, at].std()
        samples[:, [at, rate]] = 0.0
        for order in (1.0, 1.7):
            wave = size * np.exp(1j * (order * turned + rng.uniform(0, 2 * np.pi)))
            samples[:, at] += wave.real
            samples[:, rate] += (1j * order * LAB.operation.speed_rad_s * 1e-3 * wave).real
    windows, events = feed(MachineMonitor(installed()), with_samples(healthy, samples))
    assert "(1.70 times running speed, 100% of the random vibration of" in full(windows)[-1].suspect
    raised = {event.alarm.name for event in events}
    assert MODEL in raised
    assert not raised & set(PARAMETERS)


def test_a_2x_beyond_a_configured_limit_raises_its_level_alarm_only() -> None:
    own = LevelSettings.model_validate({"limits": [{"channel": "y1", "measure": "x2", "alert": 1e-3, "danger": 1e3}]})
    machine = MACHINE.model_copy(update={"levels": own})
    monitor = MachineMonitor(Installed(machine, None, installed().commissioned))
    windows, events = feed(monitor, stream(85.0, SEED + 1)[:650])
    assert {event.alarm.name for event in events} == {f"{LEVEL}y1"}
    assert not any(window.suspect for window in windows)


# The tests of sensor checks show how other faults are found.
def test_a_drifting_gain_raises_a_data_alarm_and_no_machine_alarm() -> None:
    monitor, healthy = MachineMonitor(installed()), stream(83.0, SEED + 4)
    feed(monitor, healthy[:_FULL])
    samples = samples_of(healthy[_FULL:])
    y2 = [channel.name for channel in LAB.sensors].index("y2")
    samples[:, y2] *= np.linspace(1.0, 0.7, samples.shape[0])
    windows, events = feed(monitor, with_samples(healthy[_FULL:], samples))
    last = full(windows)[-1]
    assert last.state is HealthState.DATA_HEALTH
    assert last.sensors
    assert last.sensors[0].text in last.reason
    assert all(event.alarm.name.startswith("data-") for event in events)
    assert events[-1].alarm.name == "data-gain"


def installed_with(kept: Callable[[Sensor], bool], duration_s: float) -> Installed:
    machine, healthy = with_sensors(MACHINE, before()[: round(10 * duration_s)], kept)
    return Installed(machine, None, sure(commissioned(machine, recording(machine, healthy)).commissioned))


def at_bearing(sensor: Sensor) -> bool:
    return sensor.location != "disc"


def test_with_too_few_sensors_only_a_change_of_shape_and_levels_is_reported() -> None:
    few = installed_with(at_bearing, 250.0)
    windows, events = feed(MachineMonitor(few), with_sensors(MACHINE, stream(85.0, SEED + 1)[:650], at_bearing)[1])
    assert {window.state for window in full(windows)} == {HealthState.UNCHANGED}
    assert not events
    assert all("no equation can be evaluated" in window.reason for window in full(windows))
    softer = Event(at_s=0.0, parameter="k_by", relative_change=-0.4)
    windows, events = feed(MachineMonitor(few), with_sensors(MACHINE, stream(65.0, SEED + 5, softer), at_bearing)[1])
    assert {event.alarm.name for event in events} == {"shape", "level:y1", "level:y1_dot"}
    assert full(windows)[-1].state in {HealthState.ALERT, HealthState.DANGER}
    assert "has changed shape" in full(windows)[-1].reason.partition("; ")[0]
    assert all(reading.relative_change is None for reading in full(windows)[-1].parameters)


def test_where_no_equation_can_be_evaluated_a_natural_frequency_shows_a_softer_bearing() -> None:
    rotor, sizes, probes = rotor_named("overhung"), WindowSizes(length_s=30.0), ("y1", "z1")
    file = at_once(machine_of(rotor, sizes, probes))

    def recorded(number: int, duration_s: float, **changes: float) -> list[SampleBlock]:
        rng = np.random.default_rng([SEED, number])
        limits = replace(SceneRange(), speed_relative=(1.0, 1.0))
        drawn = drawn_condition(rotor, SourceLayout.INDEPENDENT, limits, changes, rng)
        return list(observed_blocks(sampled(rotor, drawn, duration_s, [SEED, number], probes), file.descriptor))

    made = commissioned_blocks(file, *(recorded(number, 150.0) for number in range(3)))
    assert isinstance(made, Installed)
    softer, monitor, again = recorded(3, 90.0, k_by=-0.3), MachineMonitor(made), MachineMonitor(made)
    windows, events = feed(monitor, softer[:90])
    state = monitor.state(whole=True)
    again.restore(state.state, [dict(state.new_parts)[name] for name in state.parts])
    later, told = feed(monitor, softer[90:])
    assert [one.natural_frequencies for one in feed(again, softer[90:])[0]] == [
        one.natural_frequencies for one in later
    ]
    windows, events = [*windows, *later], [*events, *told]
    assert full(windows)[0].state is HealthState.UNCHANGED
    assert not any(window.shapes for window in windows)  # another force changes them as well
    verdicts = [{one.verdict for one in window.natural_frequencies} for window in full(windows)]
    assert not any("changed" in found for found in verdicts[:5])  # these share data with the first window
    assert "changed" in verdicts[-1]
    assert "natural frequency" in full(windows)[-1].reason
    assert "shape" in {event.alarm.name for event in events}


def test_what_a_reading_makes_suspect_is_no_changed_natural_frequency() -> None:
    frequency = NaturalFrequency.model_validate(example(NaturalFrequency))
    suspicious = Diagnosis("baseline", (), suspect="gain of y1 or of y2")
    evaluation = Evaluation(suspicious, {}, (), (), None, modes=(frequency,))
    assert evaluation.unlike_healthy == ""
    moved = frequency.model_copy(update={"verdict": "changed"})
    assert replace(evaluation, modes=(moved,)).unlike_healthy == moved.text


def test_a_misfit_of_learned_relations_may_be_another_force() -> None:
    unfit = Verdict.model_validate(example(Verdict)).model_copy(update={"outside_model": True})
    evaluation = Evaluation(Diagnosis("baseline", ()), {}, (), (), None)
    assert "another force drives the machine than in commissioning" in evaluation.unfit(unfit)
    assert evaluation.unfit(unfit.model_copy(update={"outside_model": False})) == ""
    for other in (Diagnosis("likelihood", ()), Diagnosis("baseline", (), suspect="gain of y1 or of y2")):
        assert replace(evaluation, deciding=other).unfit(unfit) == ""


@pytest.mark.long  # in short, a wrong gain is no change of a parameter
def test_swapped_displacement_sensors_are_not_called_healthy() -> None:
    made = installed_with(no_velocity, 150.0)
    names = [channel.name for channel in made.machine.sensors]
    _, blocks = with_sensors(MACHINE, stream(65.0, SEED + 6), no_velocity)
    samples = samples_of(blocks)
    bearing, disc = names.index("y1"), names.index("y2")
    samples[:, [bearing, disc]] = samples[:, [disc, bearing]]
    windows, events = feed(MachineMonitor(made), with_samples(blocks, samples))
    assert HealthState.HEALTHY not in {window.state for window in full(windows)}
    assert "model" in {event.alarm.name for event in events}
    # Levels are of channels, whatever sensor these really are.
    assert all(event.alarm.low_confidence for event in events if not event.alarm.name.startswith(("model", LEVEL)))
