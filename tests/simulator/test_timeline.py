"""Events as conditions by sample number."""

import pytest
from pydantic import ValidationError

from models.errors import MachineFileError
from models.machine import Machine, load_machine
from simulator.scenario import Event, NamedSource, Scenario
from simulator.timeline import Condition, Timeline, compile_timeline

SOURCE = NamedSource(name="disc y", cutoff_hz=90.0, direction=(0, 1, 0, 0, 0, 0), force_rms_N=1.0)


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_machine("lab")


def _compiled(machine: Machine, *events: Event) -> Timeline:
    scenario = Scenario(machine="lab", seed=1, duration_s=100.0, sources=(SOURCE,), events=events)
    return compile_timeline(scenario, machine)


def _at(timeline: Timeline, sample: int) -> Condition:
    return [condition for first, condition in timeline.conditions if first <= sample][-1]


def test_without_events_one_condition_holds(machine: Machine) -> None:
    timeline = _compiled(machine)
    ((first, condition),) = timeline.conditions
    assert (first, condition.speed_rpm, condition.sources) == (0, 1320.0, (SOURCE,))
    assert set(condition.relative_changes.values()) == {0.0}
    assert timeline.sensor_faults == {}
    assert timeline.truth == ((0, ()),)


def test_a_step_acts_at_the_nearest_sample(machine: Machine) -> None:
    timeline = _compiled(machine, Event(at_s=10.0003, parameter="k_by", relative_change=-0.25))
    assert [first for first, _ in timeline.conditions] == [0, 20001]
    assert _at(timeline, 20000).relative_changes["k_by"] == 0.0
    assert _at(timeline, 20001).relative_changes["k_by"] == -0.25
    assert timeline.truth == ((0, ()), (20001, ()))


def test_a_change_at_zero_is_there_from_the_first_sample(machine: Machine) -> None:
    timeline = _compiled(machine, Event(at_s=0.0, speed_rpm=900.0))
    assert [(first, c.speed_rpm) for first, c in timeline.conditions] == [(0, 900.0)]


def test_a_ramp_is_a_staircase_through_the_line(machine: Machine) -> None:
    timeline = _compiled(machine, Event(at_s=10.0, ramp_s=2.5, parameter="e", relative_change=0.5))
    stairs = [(first, c.relative_changes["e"]) for first, c in timeline.conditions[1:]]
    assert [first for first, _ in stairs] == [20000 + 200 * n for n in range(26)]
    assert stairs[-1][1] == 0.5
    for first, value in stairs[:-1]:
        middle_s = (first + 100) / 2000 - 10.0
        assert value == pytest.approx(0.5 * middle_s / 2.5, rel=1e-9)
    assert timeline.truth == ((0, ()), (20000, ("e",)), (22000, ("e",)), (24000, ("e",)), (25000, ()))


def test_a_ramp_that_is_no_multiple_of_the_step_ends_in_time(machine: Machine) -> None:
    timeline = _compiled(machine, Event(at_s=1.0, ramp_s=0.25, speed_rpm=1420.0))
    assert [(first, c.speed_rpm) for first, c in timeline.conditions[1:]] == [
        (2000, pytest.approx(1340.0)), (2200, pytest.approx(1380.0)), (2400, pytest.approx(1410.0)), (2500, 1420.0),
    ]  # fmt: skip


def test_a_later_event_takes_over_from_where_a_ramp_stands(machine: Machine) -> None:
    timeline = _compiled(
        machine,
        Event(at_s=20.0, ramp_s=10.0, parameter="k_by", relative_change=0.0),
        Event(at_s=10.0, ramp_s=20.0, parameter="k_by", relative_change=-0.4),
    )
    half = _at(timeline, 40000 - 1).relative_changes["k_by"]
    assert half == pytest.approx(-0.2, abs=0.4 / 200)
    values = [c.relative_changes["k_by"] for first, c in timeline.conditions if first >= 40000]
    assert values == sorted(values)
    assert values[0] == pytest.approx(half, abs=0.4 / 100)
    assert values[-1] == 0.0
    assert timeline.conditions[-1][0] == 60000


def test_changes_are_from_the_original_machine(machine: Machine) -> None:
    timeline = _compiled(
        machine,
        Event(at_s=1.0, parameter="c_by", relative_change=-0.2),
        Event(at_s=2.0, parameter="c_by", relative_change=-0.3),
    )
    assert _at(timeline, 4000).relative_changes["c_by"] == -0.3


def test_a_source_changes_one_thing_at_a_time(machine: Machine) -> None:
    timeline = _compiled(
        machine,
        Event(at_s=1.0, source="disc y", cutoff_hz=40.0),
        Event(at_s=2.0, source="disc y", force_rms_N=2.0),
        Event(at_s=3.0, ramp_s=1.0, source="disc y", direction=(0, 0, 0, 0, 1, 0)),
    )
    (source,) = _at(timeline, 2000).sources
    assert (source.cutoff_hz, source.force_rms_N) == (40.0, 1.0)
    (source,) = _at(timeline, 4000).sources
    assert (source.cutoff_hz, source.force_rms_N, source.direction) == (40.0, 2.0, SOURCE.direction)
    (source,) = _at(timeline, 6999).sources
    assert source.direction == pytest.approx((0, 0.5, 0, 0, 0.5, 0), abs=0.051)
    (source,) = _at(timeline, 8000).sources
    assert source.direction == (0, 0, 0, 0, 1, 0)


def test_sensor_faults_add_up_until_none(machine: Machine) -> None:
    timeline = _compiled(
        machine,
        Event(at_s=1.0, sensor="y1", sensor_fault="offset", value_SI=1e-4),
        Event(at_s=2.0, sensor="y1", sensor_fault="stuck"),
        Event(at_s=2.0, sensor="z1", sensor_fault="dropout"),
        Event(at_s=3.0, sensor="y1", sensor_fault="none"),
        Event(at_s=4.0, sensor="y1", sensor_fault="gain", value_SI=1.1),
    )
    assert [first for first, _ in timeline.conditions] == [0]  # sensors do not cut the plant's pieces
    assert timeline.sensor_faults["y1"] == (
        (2000, {"offset": 1e-4}), (4000, {"offset": 1e-4, "stuck": None}), (6000, {}), (8000, {"gain": 1.1}),
    )  # fmt: skip
    assert timeline.sensor_faults["z1"] == ((4000, {"dropout": None}),)


def test_sensor_ramps_start_at_neutral_and_may_overlap(machine: Machine) -> None:
    timeline = _compiled(
        machine,
        Event(at_s=1.0, ramp_s=1.0, sensor="y1", sensor_fault="gain", value_SI=2.0),
        Event(at_s=1.5, ramp_s=1.0, sensor="y1", sensor_fault="offset", value_SI=1e-3),
    )
    states = dict(timeline.sensor_faults["y1"])
    assert states[2000] == {"gain": pytest.approx(1.05)}
    assert states[3000] == {"gain": pytest.approx(1.55), "offset": pytest.approx(5e-5)}
    assert states[4000] == {"gain": 2.0, "offset": pytest.approx(5.5e-4)}
    assert states[5000] == {"gain": 2.0, "offset": 1e-3}


def test_level_and_anomalies_ramp_and_end(machine: Machine) -> None:
    timeline = _compiled(
        machine,
        Event(at_s=1, ramp_s=10, excitation_level=2.0),
        Event(at_s=2, anomaly="crack", size=0.3),
        Event(at_s=20, anomaly="crack", size=0),
    )
    assert (_at(timeline, 0).excitation_level, dict(_at(timeline, 0).anomalies)) == (1.0, {})
    middle = _at(timeline, 2000 * 6)
    assert middle.excitation_level == pytest.approx(1.505)
    assert dict(middle.anomalies) == {"crack": 0.3}
    assert (_at(timeline, 2000 * 30).excitation_level, dict(_at(timeline, 2000 * 30).anomalies)) == (2.0, {})
    assert ("excitation_level",) in [names for _, names in timeline.truth]


def test_delay_and_swap_begin_and_end(machine: Machine) -> None:
    timeline = _compiled(
        machine,
        Event(at_s=1.0, sensor="y1", sensor_fault="delay", value_SI=0.002),
        Event(at_s=2.0, sensor="y1", sensor_fault="swapped", swapped_with="z1"),
        Event(at_s=3.0, sensor="y1", sensor_fault="none"),
    )
    assert timeline.sensor_faults == {
        "y1": ((2000, {"delay": 0.002}), (4000, {"delay": 0.002, "swapped with z1": None}), (6000, {}))
    }


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"sensor_fault": "swapped"}, "'swapped' needs swapped_with"),
        ({"sensor_fault": "stuck", "swapped_with": "z1"}, "'stuck' has no swapped_with"),
        ({"sensor_fault": "swapped", "swapped_with": "y1"}, "expected another channel than 'y1'"),
        ({"sensor_fault": "delay", "value_SI": -0.1}, "-0.1, expected 0 to 1 s"),
        ({"sensor_fault": "delay"}, "'delay' needs value_SI"),
        ({"sensor_fault": "delay", "value_SI": 0.1, "ramp_s": 1.0}, "cannot ramp"),
    ],
)
def test_delays_and_swaps_that_cannot_be_are_refused(fields: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Event.model_validate({"at_s": 1.0, "sensor": "y1", **fields})


@pytest.mark.parametrize(("other", "message"), [("y1_dot", "is a velocity in mm/s, expected"), ("q", "not a channel")])
def test_only_channels_of_one_kind_can_be_swapped(machine: Machine, other: str, message: str) -> None:
    event = Event(at_s=1.0, sensor="y1", sensor_fault="swapped", swapped_with=other)
    scenario = Scenario(machine="lab", seed=1, duration_s=100.0, events=(event,))
    with pytest.raises(MachineFileError, match=message):
        scenario.check_channels(machine)
