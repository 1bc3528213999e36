"""Scenario files: what is shipped, what is refused and how, their page (``docs/scenario.md``); events by sample."""

import re
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from pydantic import BaseModel

from models.errors import MachineFileError
from models.machine import Machine, load_machine
from models.physics.response import stochastic_covariance, synchronous_response
from models.physics.rotor import PARAMETERS, STATE_INDEX
from simulator.scenario import (
    ANOMALIES,
    ChannelSettings,
    Event,
    NamedSource,
    Rub,
    Scenario,
    SensorFault,
    SensorSettings,
    load_scenario,
    parse_fault,
    shipped_scenarios,
)
from simulator.stream import TruthRecord
from simulator.timeline import Condition, Timeline, compile_timeline
from tests.sure import sure

PAGE = (Path(__file__).parents[2] / "docs" / "scenario.md").read_text(encoding="utf-8")

MINIMAL = """
machine = "lab"
seed = 1
duration_s = 10.0
[[sources]]
name = "disc y"
cutoff_hz = 90.0
direction = [0, 1, 0, 0, 0, 0]
force_rms_N = 1.0
"""
FAULT = 'at_s = 1.0\nsensor = "y1"\nsensor_fault = '


def _file(folder: Path, text: str, name: str = "mine.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_shapes_and_anomalies_survive_the_file(tmp_path: Path) -> None:
    text = MINIMAL + "order = 1\nhump_share = 0.5\nhump_hz = 60.0\nhump_damping = 0.3\n[rub]\nclearance_m = 5e-5\n"
    text += '[[events]]\nat_s = 1.0\nanomaly = "rub"\nsize = 0.2\n[[events]]\nat_s = 2.0\nexcitation_level = 2.0\n'
    scenario, _ = load_scenario(_file(tmp_path, text))
    (source,) = scenario.sources
    assert (source.order, source.hump_share, source.hump_hz, source.hump_damping) == (1, 0.5, 60.0, 0.3)
    assert scenario.rub == Rub(clearance_m=5e-5, friction=0.1)
    assert [(e.anomaly, e.size, e.excitation_level) for e in scenario.events] == [("rub", 0.2, None), (None, None, 2.0)]
    assert Scenario.model_validate_json(scenario.model_dump_json()) == scenario


def test_the_shipped_scenarios_contain_the_fault_in_their_name() -> None:
    faults = {"k_by": -0.25, "c_by": -0.3, "k_bz": -0.25, "c_bz": -0.3, "e": 0.3}
    assert set(shipped_scenarios()) == {"healthy", *faults}
    healthy, _ = load_scenario("healthy")
    assert (healthy.name, healthy.duration_s, healthy.events) == ("healthy", 3600.0, ())
    seeds = {healthy.seed}
    for name, change in faults.items():
        scenario, machine = load_scenario(name)
        assert machine.name == "lab"
        assert (scenario.name, scenario.duration_s) == (name, 300.0)
        (event,) = scenario.events
        assert (event.parameter, event.relative_change, event.at_s, event.ramp_s) == (name, change, 140.0, 0.0)
        assert (scenario.sources, scenario.sensors) == (healthy.sources, healthy.sensors)
        seeds.add(scenario.seed)
    assert len(seeds) == 6  # independent realisations


def test_the_shipped_disc_moves_twice_its_1x_amplitude() -> None:
    scenario, machine = load_scenario("healthy")
    speed = machine.operation.speed_rad_s
    q1, q2 = synchronous_response(machine.rotor, speed)
    variance = np.diag(stochastic_covariance(machine.rotor, speed, scenario.sources))
    disc = [STATE_INDEX["y2"], STATE_INDEX["z2"]]
    ratio = np.sqrt(variance[disc].sum() / ((q1**2 + q2**2) / 2)[disc].sum())
    assert ratio == pytest.approx(2.0, rel=0.05)
    assert len(scenario.sources) == 4


def test_a_file_extends_another_table_by_table(tmp_path: Path) -> None:
    base = _file(tmp_path, MINIMAL + "[sensors]\nnoise_relative = 0.02\nnoise_corner_hz = 300.0\n", "base.toml")
    mine = _file(tmp_path, f'extends = "{base.name}"\nseed = 9\n[sensors]\nnoise_relative = 0.5\n')
    scenario, _ = load_scenario(mine)
    assert (scenario.name, scenario.seed, scenario.duration_s) == ("mine", 9, 10.0)
    assert (scenario.sensors.noise_relative, scenario.sensors.noise_corner_hz) == (0.5, 300.0)
    assert [source.name for source in scenario.sources] == ["disc y"]


def test_a_machine_file_is_found_beside_the_scenario(tmp_path: Path) -> None:
    shipped = Path(__file__).parents[2] / "models" / "machines" / "lab.toml"
    _file(tmp_path, shipped.read_text(encoding="utf-8").replace('name = "lab"', 'name = "twin"'), "twin.toml")
    _, machine = load_scenario(_file(tmp_path, MINIMAL.replace('"lab"', '"twin.toml"')))
    assert machine.name == "twin"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("machine = 3 =", "line 1: .*machine = 3 ="),
        (MINIMAL.replace("seed = 1\n", ""), r"mine\.toml: seed: missing"),
        (MINIMAL.replace("duration_s = 10.0", "duration_s = inf"), "duration_s: .* finite"),
        (MINIMAL.replace("cutoff_hz = 90.0", "cutoff_hz = 0.0"), r"sources\.0\.cutoff_hz.*: .* \(found 0\.0\)"),
        (MINIMAL.replace("[0, 1, 0, 0, 0, 0]", "[0, 1]"), r"sources\.0\.direction"),
        (MINIMAL + MINIMAL[MINIMAL.index("[[") :], "source name occurs twice: disc y"),
        (MINIMAL + "[sensors]\nnoise = 0.1", r"sensors\.noise: unknown"),
        (MINIMAL + "[sensors.channels.y9]\ngain = 2.0", r"mine\.toml: .*'y9' is not a channel of machine lab \(y1, z1"),
        ('extends = "mine.toml"', "extends itself"),
        ("extends = 3", r"extends: expected the name or path of a scenario \(found 3\)"),
    ],
)
def test_unusable_files_are_refused_with_file_field_and_value(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(MachineFileError, match=message):
        load_scenario(_file(tmp_path, text))


@pytest.mark.parametrize(
    ("event", "message"),
    [
        ("speed_rpm = 900.0", r"events\.0\.at_s: missing"),
        ("at_s = 1.0", "one of parameter, speed_rpm, source, sensor, excitation_level, anomaly; found none"),
        ('at_s = 1.0\nanomaly = "looseness"\nsize = 0.1', "'looseness' is not one of crack, rub, added_mass"),
        ('at_s = 1.0\nanomaly = "crack"', "anomaly crack without size"),
        ('at_s = 1.0\nanomaly = "rub"\nsize = 0.2', r"events\.0\.anomaly: a rub needs the table \[rub\]"),
        ("at_s = 1.0\nexcitation_level = 2.0\nsize = 0.2", "size belongs to an event with anomaly"),
        ("at_s = 1.0\nexcitation_level = -2.0", "excitation_level: expected 0 to 1000"),
        ('at_s = 1.0\nspeed_rpm = 900.0\nparameter = "e"\nrelative_change = 0.1', "found parameter and speed_rpm"),
        ('at_s = 1.0\nparameter = "e"\nrelative_change = 0.1\ncutoff_hz = 3.0', "cutoff_hz belongs to an event with"),
        ("at_s = 1.0\nspeed_rpm = 0.0", r"speed_rpm: .* \(found 0\.0\)"),
        ("at_s = 9.0\nramp_s = 2.0\nspeed_rpm = 900.0", r"events\.0: ends at 11 s, after duration_s 10"),
        ('at_s = 1.0\nsource = "disc y"', "expected exactly one of cutoff_hz, force_rms_N, direction; found none"),
        ('at_s = 1.0\nsource = "disc y"\ncutoff_hz = 3.0\nforce_rms_N = 1.0', "found cutoff_hz and force_rms_N"),
        ('at_s = 1.0\nsensor = "y1"', "sensor 'y1' without sensor_fault"),
        ('at_s = 1.0\nsensor = "y1"\nsensor_fault = "gain"', "sensor_fault 'gain' needs value_SI"),
        ('at_s = 1.0\nsensor = "y1"\nsensor_fault = "stuck"\nvalue_SI = 1.0', "sensor_fault 'stuck' has no value_SI"),
        ('at_s = 1.0\nsensor = "y1"\nsensor_fault = "clip"\nvalue_SI = -1.0', "'clip' is -1.0, expected 0 or more"),
        ('at_s = 1.0\nramp_s = 1.0\nsensor = "y1"\nsensor_fault = "stuck"', "'stuck' cannot ramp"),
        (f'{FAULT}"swapped"', "'swapped' needs swapped_with"),
        (f'{FAULT}"stuck"\nswapped_with = "z1"', "'stuck' has no swapped_with"),
        (f'{FAULT}"swapped"\nswapped_with = "y1"', "expected another channel than 'y1'"),
        (f'{FAULT}"swapped"\nswapped_with = "y1_dot"', "is a velocity in mm/s, expected"),
        (f'{FAULT}"swapped"\nswapped_with = "q"', "'q' is not a channel"),
        (f'{FAULT}"delay"\nvalue_SI = -0.1', "-0.1, expected 0 to 1 s"),
        (f'{FAULT}"delay"', "'delay' needs value_SI"),
        (f'{FAULT}"delay"\nvalue_SI = 0.1\nramp_s = 1.0', "cannot ramp"),
    ],
)
def test_unusable_events_are_refused(tmp_path: Path, event: str, message: str) -> None:
    with pytest.raises(MachineFileError, match=message):
        load_scenario(_file(tmp_path, f"{MINIMAL}[[events]]\n{event}"))


def test_overrides_are_checked_again() -> None:
    scenario, _ = load_scenario("k_by")
    other = scenario.overridden(seed=77, duration_s=200.0, faults=[parse_fault("e=3e-1@150.5")])
    assert (other.seed, other.duration_s, len(other.events)) == (77, 200.0, 2)
    assert (other.events[1].parameter, other.events[1].relative_change, other.events[1].at_s) == ("e", 0.3, 150.5)
    assert other.sources == scenario.sources
    with pytest.raises(MachineFileError, match="ends at 140 s, after duration_s 100"):
        scenario.overridden(duration_s=100.0)


def test_common_sensor_settings_leave_the_shaft_angle_alone(tmp_path: Path) -> None:
    text = MINIMAL + "[sensors]\nnoise_relative = 0.1\ngain = 1.5\n[sensors.channels.y1]\ngain = 2.0\n"
    scenario, machine = load_scenario(_file(tmp_path, text))
    settings = {channel.name: scenario.sensors.settings(channel) for channel in machine.sensors}
    assert (settings["y1"].gain, settings["y1"].noise_relative) == (2.0, 0.1)
    assert (settings["z1"].gain, settings["z1"].noise_relative) == (1.5, 0.1)
    assert settings["theta"] == SensorSettings()


def test_the_page_example_loads(tmp_path: Path) -> None:
    (text,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    scenario, machine = load_scenario(_file(tmp_path, text))
    assert isinstance(machine, Machine)
    assert [event.at_s for event in scenario.events] == [60.0, 60.0, 130.0, 140.0, 150.0, 200.0]
    assert scenario.sensors.noise_relative == 0.02


@pytest.mark.parametrize("model", [Scenario, NamedSource, Rub, SensorSettings, ChannelSettings, Event, TruthRecord])
def test_the_page_explains_every_field(model: type[BaseModel]) -> None:
    cells = " ".join(re.findall(r"^\| ([^|]+) \|", PAGE, re.MULTILINE))
    missing = [field for field in model.model_fields if f"`{field}`" not in cells]
    if model is Event:  # a source's settings are explained where the source is
        assert all(f"`{field}`" in PAGE for field in missing)
        missing = [field for field in missing if field not in NamedSource.model_fields]
    assert missing == []


def test_the_page_names_every_scenario_fault_and_parameter() -> None:
    names: list[Any] = [*shipped_scenarios(), *get_args(SensorFault), *PARAMETERS, *ANOMALIES]
    assert [name for name in names if f"`{name}`" not in PAGE] == []


def test_the_page_says_what_the_shipped_scenarios_do() -> None:
    for name in shipped_scenarios():
        scenario, _ = load_scenario(name)
        row = sure(re.search(rf"^\| `{name}` \| (\d+) s \| (.*) \|$", PAGE, re.MULTILINE))
        assert float(row[1]) == scenario.duration_s
        for event in scenario.events:
            assert f"{event.relative_change:+.0%}".replace("%", " %").replace("-", "−") in row[2]
            assert f"at {event.at_s:g} s" in row[2]


LAB = load_machine("lab")
SOURCE = NamedSource(name="disc y", cutoff_hz=90.0, direction=(0, 1, 0, 0, 0, 0), force_rms_N=1.0)


def _compiled(*events: Event) -> Timeline:
    scenario = Scenario(machine="lab", seed=1, duration_s=100.0, sources=(SOURCE,), events=events)
    return compile_timeline(scenario, LAB)


def _at(timeline: Timeline, sample: int) -> Condition:
    return [condition for first, condition in timeline.conditions if first <= sample][-1]


def test_a_step_acts_at_the_nearest_sample_relative_to_the_original_machine() -> None:
    timeline = _compiled(Event(at_s=10.0003, parameter="k_by", relative_change=-0.25))
    assert [first for first, _ in timeline.conditions] == [0, 20001]
    assert _at(timeline, 20000).relative_changes["k_by"] == 0.0
    assert _at(timeline, 20001).relative_changes["k_by"] == -0.25
    assert timeline.truth == ((0, ()), (20001, ()))
    timeline = _compiled(Event(at_s=0.0, speed_rpm=900.0))
    assert [(first, c.speed_rpm) for first, c in timeline.conditions] == [(0, 900.0)]
    timeline = _compiled(
        Event(at_s=1.0, parameter="c_by", relative_change=-0.2), Event(at_s=2.0, parameter="c_by", relative_change=-0.3)
    )
    assert _at(timeline, 4000).relative_changes["c_by"] == -0.3


def test_a_ramp_is_a_staircase_through_the_line() -> None:
    timeline = _compiled(Event(at_s=10.0, ramp_s=2.5, parameter="e", relative_change=0.5))
    stairs = [(first, c.relative_changes["e"]) for first, c in timeline.conditions[1:]]
    assert [first for first, _ in stairs] == [20000 + 200 * n for n in range(26)]
    assert stairs[-1][1] == 0.5
    for first, value in stairs[:-1]:
        middle_s = (first + 100) / 2000 - 10.0
        assert value == pytest.approx(0.5 * middle_s / 2.5, rel=1e-9)
    assert timeline.truth == ((0, ()), (20000, ("e",)), (22000, ("e",)), (24000, ("e",)), (25000, ()))


def test_a_ramp_that_is_no_multiple_of_the_step_ends_in_time() -> None:
    timeline = _compiled(Event(at_s=1.0, ramp_s=0.25, speed_rpm=1420.0))
    assert [(first, c.speed_rpm) for first, c in timeline.conditions[1:]] == [
        (2000, pytest.approx(1340.0)), (2200, pytest.approx(1380.0)), (2400, pytest.approx(1410.0)), (2500, 1420.0),
    ]  # fmt: skip


def test_a_later_event_takes_over_from_where_a_ramp_stands() -> None:
    timeline = _compiled(
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


def test_a_source_changes_one_thing_at_a_time() -> None:
    timeline = _compiled(
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


def test_sources_stay_as_many_in_the_same_order_even_without_force() -> None:
    """The state of the plant holds that of every source: it would not fit another number of them."""
    sources = SOURCE, SOURCE.model_copy(update={"name": "bearing z", "direction": (0, 0, 0, 1, 0, 0)})
    events = (
        Event(at_s=1.0, source="disc y", force_rms_N=0.0),
        Event(at_s=2.0, excitation_level=0.0),
        Event(at_s=3.0, ramp_s=1.0, source="bearing z", cutoff_hz=40.0),
    )
    scenario = Scenario(machine="lab", seed=1, duration_s=100.0, sources=sources, events=events)
    found = {
        tuple(one.name for one in condition.sources) for _, condition in compile_timeline(scenario, LAB).conditions
    }
    assert found == {("disc y", "bearing z")}


def test_sensor_faults_add_up_until_none() -> None:
    timeline = _compiled(
        Event(at_s=1.0, sensor="y1", sensor_fault="offset", value_SI=1e-4),
        Event(at_s=2.0, sensor="y1", sensor_fault="stuck"),
        Event(at_s=2.0, sensor="z1", sensor_fault="dropout"),
        Event(at_s=3.0, sensor="y1", sensor_fault="none"),
        Event(at_s=4.0, sensor="y1", sensor_fault="gain", value_SI=1.1),
        Event(at_s=1.0, sensor="z2", sensor_fault="delay", value_SI=0.002),
        Event(at_s=2.0, sensor="z2", sensor_fault="swapped", swapped_with="y2"),
        Event(at_s=3.0, sensor="z2", sensor_fault="none"),
    )
    assert [first for first, _ in timeline.conditions] == [0]  # sensors do not cut the plant's pieces
    assert timeline.sensor_faults["y1"] == (
        (2000, {"offset": 1e-4}), (4000, {"offset": 1e-4, "stuck": None}), (6000, {}), (8000, {"gain": 1.1}),
    )  # fmt: skip
    assert timeline.sensor_faults["z1"] == ((4000, {"dropout": None}),)
    assert timeline.sensor_faults["z2"] == (
        (2000, {"delay": 0.002}), (4000, {"delay": 0.002, "swapped with y2": None}), (6000, {}),
    )  # fmt: skip


def test_sensor_ramps_start_at_neutral_and_may_overlap() -> None:
    timeline = _compiled(
        Event(at_s=1.0, ramp_s=1.0, sensor="y1", sensor_fault="gain", value_SI=2.0),
        Event(at_s=1.5, ramp_s=1.0, sensor="y1", sensor_fault="offset", value_SI=1e-3),
    )
    states = dict(timeline.sensor_faults["y1"])
    assert states[2000] == {"gain": pytest.approx(1.05)}
    assert states[3000] == {"gain": pytest.approx(1.55), "offset": pytest.approx(5e-5)}
    assert states[4000] == {"gain": 2.0, "offset": pytest.approx(5.5e-4)}
    assert states[5000] == {"gain": 2.0, "offset": 1e-3}


def test_level_and_anomalies_ramp_and_end() -> None:
    timeline = _compiled(
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
