"""The data path of one machine, fed by the simulator's blocks without any transport."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from models.alarm_names import MODEL
from models.commissioning.commissioned import Installed, install
from models.diagnosis.readings import Diagnosis
from models.machine import Machine
from models.physics.rotor import PARAMETERS
from models.signals.block import SampleBlock
from models.signals.wire import encode_block
from rotorwatch.records.health import HealthState
from service.monitor.evaluation import Evaluation
from service.monitor.monitor import MachineMonitor
from simulator.scenario import Event
from simulator.stream import blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition
from tests.commissioning import rotor_kit
from tests.commissioning.rotor_kit import LAB, with_lines, with_samples
from tests.service.rig.watching import at_once, feed, named, resumed
from tests.sure import sure
from tests.windows import healthy_blocks

SEED = 7_700_002
KIT = install(at_once(LAB), "lab")


def monitor() -> MachineMonitor:
    return MachineMonitor(KIT)


def stream(duration_s: float, *events: Event) -> Sequence[SampleBlock]:
    return rotor_kit.stream(duration_s, SEED, *events)


def healthy(duration_s: float) -> Sequence[SampleBlock]:
    """The first blocks of one shared stream, read-only."""
    return stream(180.0)[: round(10 * duration_s)]


@cache
def _watching() -> MachineMonitor:
    target = monitor()
    assert feed(target, healthy(65.0))[0][-1].state is HealthState.HEALTHY
    return target


def watching() -> MachineMonitor:
    """A monitor that has seen the first 65 s."""
    return deepcopy(_watching())


@pytest.mark.slow
def test_reports_do_not_depend_on_the_block_length() -> None:
    """Tenths of a second, uneven lengths, and encoded bytes: the same reports to the last bit."""
    fine = healthy(63.0)
    expected, _ = feed(monitor(), fine)
    assert [report.state for report in expected[:11]] == [HealthState.WARMING] * 11
    assert [report.state for report in expected[11:]] == [HealthState.HEALTHY]
    samples = np.concatenate([block.samples for block in fine])
    cuts = np.cumsum(np.random.default_rng(0).integers(10, 3900, 200))
    cuts = np.array([0, *cuts[cuts < samples.shape[0]], samples.shape[0]])
    others = [
        SampleBlock(fine[0].start_ns + int(begin) * 500_000, number, 1, 2000.0, samples[begin:end])
        for number, (begin, end) in enumerate(pairwise(cuts))
    ]
    assert feed(monitor(), others)[0] == expected
    target = monitor()
    decoded = [target.step_payload(*encode_block(block, target.machine.descriptor.schema_hash)) for block in fine]
    assert [window for reports in decoded for report in reports for window in report.windows] == expected


def test_every_parameter_and_equation_is_accounted_for() -> None:
    window = feed(monitor(), healthy(63.0))[0][-1]
    assert [reading.name for reading in window.parameters] == list(PARAMETERS)
    for reading in window.parameters:
        assert reading.by == "likelihood"
        assert reading.interval_95 is not None
        assert abs(sure(reading.z)) < 4.5
    verdicts = {equation.equation: equation for equation in window.equations}
    assert (list(verdicts), verdicts["30"].reason) == (["28", "29", "30", "31"], "not measured: psi_dot, psi, phi_dot")
    assert verdicts["30"].parameters == ()
    for number in ("28", "29", "31"):
        assert verdicts[number].evaluable
        assert sure(verdicts[number].msd) > 0
        assert all(abs(sure(reading.z)) < 4.5 for reading in verdicts[number].parameters)
    assert [found.name for found in window.detectable] == list(PARAMETERS)
    for found in window.detectable:
        reading = next(one for one in window.parameters if one.name == found.name)
        assert found.loss < 0 < found.gain
        assert found.gain > 6 * (reading.standard_error or 1.0)  # threshold and power together
    verdict = sure(window.verdict)
    assert (verdict.changed, verdict.detected, verdict.settled) == ((), False, True)
    assert verdict.confidence > 0.99
    (relation,) = (opinion for opinion in window.opinions if opinion.by == "relation")
    assert {one.verdict for one in relation.agreement if one.name != "EI"} == {"agree"}
    assert {one.verdict for one in relation.agreement if one.name == "EI"} == {"only-one"}


def test_after_a_gap_the_window_refills_before_the_machine_is_healthy() -> None:
    everything = healthy(180.0)
    target = watching()
    after, events = feed(target, everything[1050:])  # 40 s are lost: too much for the window's span
    quality = target.health().quality
    assert (quality.gaps, quality.accepted_blocks) == (1, 650 + len(everything[1050:]))
    assert quality.missing_s == pytest.approx(40.0)
    assert "40 s of data are missing" in quality.last_gap
    begin_ns = everything[0].start_ns
    assert [(event.kind, event.alarm.name, (event.time_ns - begin_ns) / 1e9) for event in events] == [
        ("raised", "stream-lost", 70.0),  # 5 s after the last data, as live
        ("cleared", "stream-lost", 105.0),
        ("raised", "data-gap", 105.0),
        ("cleared", "data-gap", 172.5),  # after the first whole hop and the off-delay
    ]
    states = [report.state for report in after]
    refilled = states.index(HealthState.HEALTHY)
    assert states[:refilled] == [HealthState.WARMING] * refilled
    assert refilled >= 5
    assert set(states[refilled:]) == {HealthState.HEALTHY}


@pytest.mark.parametrize(
    ("step_s", "run", "told"),
    [
        pytest.param(-40, 1, ["data-clock"], id="clock set back"),
        pytest.param(40_000, 1, ["data-clock"], id="clock set far later", marks=pytest.mark.long),
        pytest.param(-40, 2, [], id="started anew earlier", marks=pytest.mark.long),
        pytest.param(40_000, 2, [], id="started anew far later"),
    ],
)
def test_a_restarted_publisher_is_not_a_stepped_clock(step_s: int, run: int, told: list[str]) -> None:
    """Whatever its time, a restart is stated as one, and the window fills again."""
    everything = healthy(129.0)
    target = watching()
    later = [
        replace(one, start_ns=one.start_ns + step_s * 10**9, run=run, sequence=number if run == 2 else one.sequence)
        for number, one in enumerate(everything[650:])
    ]
    windows, events = feed(target, later)
    assert [event.alarm.name for event in events if event.kind == "raised"] == told
    quality = target.health().quality
    assert (quality.gaps, quality.missing_s) == (1, 0.0)
    assert ("publisher restarted" in quality.last_gap) is (run == 2)
    assert [one.state for one in windows[:5]] == [HealthState.WARMING] * 5
    assert windows[-1].state is HealthState.HEALTHY
    ends = [one.end_ns for one in windows]
    assert ends == sorted(set(ends))
    assert windows[-1].start_ns >= later[9].start_ns


def test_a_publisher_restarted_while_the_monitor_was_down_is_no_stepped_clock() -> None:
    """Its state does not fit, so it knows no runs: sequence 0 begins one."""
    everything = healthy(20.0)
    for first, told in ((0, []), (3, ["data-clock"])):
        target = monitor()
        before = monitor()
        feed(before, everything[:5])
        target.restore_alarms(before.state().alarms, end_ns=everything[0].start_ns + 7200 * 10**9)
        _, events = feed(target, everything[first:])
        assert [event.alarm.name for event in events if event.kind == "raised"] == told


def test_refused_blocks_are_named_while_they_leave_no_hop_complete() -> None:
    """As they arrive live, where those after a refused one wait for it."""
    target = watching()
    sent = [
        one if at % 7 else replace(one, samples=one.samples * np.nan) for at, one in enumerate(healthy(100.0)[650:])
    ]
    events = [
        event for one in sent for report in target.step_payload(*encode_block(one, "")) for event in report.events
    ]
    assert named(events) == [("raised", "data-gap")]
    assert "nothing is evaluated: blocks are refused, for example: demo/lab: block" in events[0].alarm.note
    assert "blocks are refused, for example: demo/lab: block" in target.health().reason


@pytest.mark.parametrize("torn", ["times that are not counted in samples", "lost blocks"])
def test_the_state_is_not_evaluable_while_no_hop_is_complete(torn: str) -> None:
    target, after = watching(), healthy(170.0)[650:]
    spoilt = after[:400]
    if torn == "lost blocks":
        spoilt = [block for number, block in enumerate(spoilt) if number % 20]
    else:
        spoilt = [replace(block, start_ns=block.start_ns + 10**6 * (number % 3)) for number, block in enumerate(spoilt)]
    windows, events = feed(target, spoilt)
    assert not [window for window in windows if window.end_ns > spoilt[60].start_ns]
    assert named(events) == [("raised", "data-gap")]
    assert "no 5 s without a gap for 2" in events[0].alarm.note
    assert target.health().state is HealthState.NOT_EVALUABLE
    assert "nothing is evaluated: blocks are lost, or their times" in target.health().reason
    stopped = watching()  # a restart meanwhile causes no delay
    feed(stopped, spoilt[:100])
    assert feed(resumed(stopped, KIT), spoilt[100:])[1] == events
    windows, events = feed(target, after[400:])
    assert windows
    assert (target.health().state, target.health().reason) == (HealthState.HEALTHY, "")


def test_a_jump_of_the_phase_reference_is_never_an_unbalance() -> None:
    """Nor after a restart."""
    target, turned = watching(), rotor_kit.samples_of(healthy(180.0)[650:])
    turned[:, -1] = np.mod(turned[:, -1] + np.pi / 2, 2 * np.pi)
    after = with_samples(healthy(180.0)[650:], turned)
    windows, events = feed(target, after[:650])
    assert windows[-1].state is HealthState.HEALTHY
    target = resumed(target, KIT)
    windows, more = feed(target, after[650:])
    assert named([*events, *more]) == [("raised", "data-phase-reference")]
    e = next(one for one in windows[-1].parameters if one.name == "e")
    assert sure(e.vector).turned_deg == pytest.approx(-90, abs=10)
    assert target.health().state is HealthState.HEALTHY


def test_just_after_a_change_a_machine_is_not_called_healthy() -> None:
    windows, _ = feed(watching(), stream(90.0, Event(at_s=65.0, parameter="k_by", relative_change=-0.25))[650:])
    states = [one.state for one in windows]
    assert states == [HealthState.HEALTHY, HealthState.WARMING, HealthState.WARMING, *[HealthState.ALERT] * 2]
    assert {one.reason for one in windows[1:3]} == {
        "something changed within the window, and data since then are too few to say what"
    }
    assert {one.reason for one in windows[3:]} == {""}
    assert {(sure(one.verdict).detected, sure(one.verdict).current) for one in windows[1:3]} == {(True, ())}


@pytest.mark.long  # in short, a stepping load is read from the segments of a window
def test_a_step_of_the_load_is_inside_the_model() -> None:
    windows, events = feed(monitor(), stream(95.0, Event(at_s=65.0, excitation_level=3.0)))
    assert events == []
    assert {one.verdict.outside_model for one in windows if one.verdict is not None} == {False}


def test_mains_hum_is_tolerated_and_another_line_is_named_with_its_frequency() -> None:
    windows, events = feed(monitor(), with_lines(healthy(63.0), {50.02: 0.1, 150.06: 0.03}))
    assert {one.state for one in windows if one.filled == 1.0} == {HealthState.HEALTHY}
    assert events == []
    assert not [each for one in windows[-1].opinions for each in one.agreement if each.verdict == "disagree"]
    (last,) = feed(monitor(), with_lines(healthy(63.0), {37.3: 0.3}))[0][-1:]
    assert "most of it at 37" in sure(last.parameters[0].reason)
    assert last.reason.endswith("if this is its healthy state, commission it")


def test_a_run_down_raises_no_alarm() -> None:
    """With one source, where any residual of the rotation would be a misfit; also when it hardly turns."""
    draw = Draw(LAB, SEED, Purpose.EVALUATION, 0, layout=Layout.ONE_SOURCE)
    scenario = draw_condition(draw, 1)
    stop = Event(at_s=63.0, ramp_s=30.0, speed_rpm=0.1)
    scenario = scenario.model_copy(update={"duration_s": 110.0, "events": (*scenario.events, stop)})
    windows, events = feed(monitor(), [block for block, _ in blocks(scenario, LAB)])
    assert events == []
    assert windows[-1].state is HealthState.NOT_EVALUABLE


def test_a_shaft_angle_that_falls_is_named_with_a_remedy() -> None:
    samples = rotor_kit.samples_of(healthy(63.0))
    samples[:, 8] = 2 * np.pi - samples[:, 8]
    (last,) = feed(monitor(), with_samples(healthy(63.0), samples))[0][-1:]
    assert last.reason.endswith("evaluation limit 20 %; the shaft angle falls: send 2π minus the angle")


# The tests of sensor checks show how each fault is found.
def test_a_clipped_channel_raises_a_data_alarm_and_no_machine_alarm() -> None:
    healthy_ = healthy(63.0)
    samples = rotor_kit.samples_of(healthy_)
    samples[:, 4] = np.clip(samples[:, 4], -1e-3, 1e-3)
    seen, events = feed(monitor(), with_samples(healthy_, samples))
    assert len(seen) == 12
    assert all(event.alarm.name.startswith("data-") for event in events)
    assert {window.state for window in seen[11:]} <= {HealthState.NOT_EVALUABLE, HealthState.DATA_HEALTH}
    assert all(window.reason or "diagnosed without it" in window.sensors[0].text for window in seen[11:])


def test_one_wild_sample_does_not_blind_the_monitor() -> None:
    everything = healthy(68.0)
    wild = everything[0].samples.copy()
    wild[50, 0] = 1e30
    patient = MachineMonitor(install(LAB, "lab"))  # the first window still holds what the sample left
    windows, events = feed(patient, [replace(everything[0], samples=wild), *everything[1:]])
    assert windows[-1].state is HealthState.HEALTHY
    assert not events


def test_occasional_clipping_names_the_measuring_range_as_suspect() -> None:
    """Too few samples to be called clipped, but enough to distort the spectra."""
    blocks = healthy(63.0)
    samples = rotor_kit.samples_of(blocks)
    measured = samples[:, [channel.quantity != "shaft_angle" for channel in LAB.sensors]]
    low, high = np.quantile(measured, [0.0015, 0.9985], axis=0)
    samples[:, : measured.shape[1]] = np.clip(measured, low, high)
    target = monitor()
    windows, _ = feed(target, with_samples(blocks, samples))
    assert not windows[-1].sensors
    for misfit_z, told in ((9.0, "y2 is at exactly"), (0.0, "a mass")):
        evaluation = Evaluation(Diagnosis("", misfit_z=misfit_z, suspect="a mass"), {}, (), (), None)
        found = evaluation.named(target.machine.sensors, sure(target.window)(), "").deciding.suspect
        assert told in found


def test_a_1x_that_no_unbalance_can_cause_is_outside_the_model() -> None:
    blocks_, names = healthy(63.0), [channel.name for channel in LAB.sensors]
    samples = rotor_kit.samples_of(blocks_)
    turning = np.exp(1j * samples[:, names.index("theta")])
    for place, side in (("y1", 1.0), ("z1", -1j)):  # at the bearing alone, which no force on the disc does
        at, rate = names.index(place), names.index(f"{place}_dot")
        wave = 1.4 * samples[:, at].std() * side * turning
        samples[:, at] += wave.real
        samples[:, rate] += (1j * LAB.operation.speed_rad_s * 1e-3 * wave).real
    windows, events = feed(MachineMonitor(Installed(at_once(LAB))), with_samples(blocks_, samples))
    assert "the 1× vibration is not what an unbalance causes" in windows[-1].suspect
    assert [event.alarm.name for event in events if event.alarm.name in {MODEL, *PARAMETERS}] == [MODEL]


def test_a_healthy_verdict_names_the_parameters_not_read() -> None:
    """Sensors in one plane only: the bearing has lost stiffness in the other."""
    softer = stream(63.0, Event(at_s=0.0, parameter="k_bz", relative_change=-0.3))
    file, seen = rotor_kit.with_sensors(LAB, softer, lambda sensor: sensor.name[0] in "yt")
    windows, events = feed(MachineMonitor(install(file, None)), seen)
    assert not events
    verdict = sure(windows[-1].verdict)
    assert (windows[-1].state, verdict.text) == (HealthState.HEALTHY, "nothing has changed; not read: k_bz, c_bz")
    readings = {one.name: one for one in windows[-1].parameters}
    assert readings["k_bz"].relative_change is None
    assert readings["k_bz"].reason == "no displacement or velocity measured in z"
    assert abs(readings["k_by"].relative_change or 1.0) < 0.1
    (*_, whole), _ = feed(MachineMonitor(install(LAB, None)), healthy(65.0))
    assert sure(whole.verdict).text == "nothing has changed"
    assert {equation.reason for equation in whole.equations} == {"no trained network"}


def damped() -> Machine:
    """A damped rotor with displacements of its disc alone, where other causes look like changes of parameters."""
    fields = LAB.model_dump(exclude_unset=True)
    fields["sensors"] = [one for one in fields["sensors"] if one["name"] in {"y2", "z2", "theta"}]
    for name in ("c_by_N_s_per_m", "c_bz_N_s_per_m"):
        fields["rotor"][name] *= 2
    return Machine.model_validate(fields)


@pytest.mark.parametrize(
    ("event", "told"),
    [
        (Event(at_s=60.0, anomaly="added_mass", size=0.2), True),
        (Event(at_s=60.0, parameter="k_by", relative_change=-0.2), False),
    ],
)
def test_a_name_has_low_confidence_only_if_a_heavier_disc_explains_the_data_as_well(
    event: Event, *, told: bool
) -> None:
    _, events = feed(MachineMonitor(Installed(damped())), healthy_blocks(damped(), 135.0, 3, event, block_s=1.0))
    raised = {one.alarm.name: one for one in events if one.kind == "raised" and one.alarm.name in PARAMETERS}
    assert raised
    assert told or set(raised) == {event.parameter}
    assert {one.alarm.low_confidence for one in raised.values()} == {told}
    assert all("the disc's mass" in one.text for one in raised.values()) or not told
