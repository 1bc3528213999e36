"""Probes at an angle are resolved into y and z for the diagnosis, and are taken as mounted everywhere else."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from models.commissioning.healthy import foreign_lines, healthy_from_blocks
from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.reference import learn_sensor_reference
from models.diagnosis.shape import learn_shape
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine, MachineFile, load_machine
from models.signals.block import SampleBlock
from models.signals.channels import ChannelDescriptor, Sensor, state_name, with_channel_names
from simulator.scenario import Event, load_scenario
from simulator.stream import blocks
from tests.commissioning.rotor_kit import mounted
from tests.sure import sure
from tests.windows import last_window

LAB = load_machine("lab").model_copy(update={"dtype": "float64"})
NAMES = [channel.name for channel in LAB.sensors]
SECONDS = 64.0


API_670 = mounted(LAB, {"y1": (45, 135), "y2": (45, 135)})
"""The displacements at 45° to the right and to the left of the vertical; velocities in y and z."""
ALL = mounted(LAB, dict.fromkeys(("y1", "y2", "y1_dot", "y2_dot"), (45, 135)))


def simulated(machine: Machine, *events: Event, noise: float = 0.0, seed: int = 8_113) -> tuple[SampleBlock, ...]:
    return _simulated(machine.model_dump_json(), events, noise, seed)


@cache
def _simulated(machine_json: str, events: tuple[Event, ...], noise: float, seed: int) -> tuple[SampleBlock, ...]:
    machine, (scenario, _) = Machine.model_validate_json(machine_json), load_scenario("healthy")
    scenario = scenario.overridden(duration_s=SECONDS, seed=seed, faults=events)
    sensors = scenario.sensors.model_copy(update={"noise_relative": noise})
    return tuple(one for one, _ in blocks(scenario.model_copy(update={"sensors": sensors}), machine, 1.0))


def window_of(machine: MachineFile, stream: Sequence[SampleBlock], *, lagged: bool = False) -> WindowStatistics:
    return last_window(plan_for(machine, lagged=lagged), stream)


def changed(stream: Sequence[SampleBlock], name: str, gain: float = 1.0, offset: float = 0.0) -> list[SampleBlock]:
    found = []
    for block in stream:
        samples = block.samples.copy()
        samples[:, NAMES.index(name)] = gain * samples[:, NAMES.index(name)] + offset
        found.append(replace(block, samples=samples))
    return found


def probe(name: str, **more: object) -> dict[str, object]:
    place = {"quantity": "displacement", "location": "bearing", "direction": name[-1], "unit": "um"}
    return {"name": name, **place, **more}


def test_the_simulator_projects_motion_onto_sensors_at_an_angle() -> None:
    plain = np.concatenate([block.samples for block in simulated(LAB)])
    turned = np.concatenate([block.samples for block in simulated(API_670)])
    y, z = (plain[:, NAMES.index(name)] for name in ("y1", "z1"))
    right, left = (turned[:, NAMES.index(name)] for name in ("y1", "z1"))
    assert right == pytest.approx((y + z) / np.sqrt(2), abs=1e-9)
    assert left == pytest.approx((z - y) / np.sqrt(2), abs=1e-9)
    assert np.array_equal(plain[:, NAMES.index("y1_dot")], turned[:, NAMES.index("y1_dot")])


def test_noise_of_a_sensor_at_an_angle_is_relative_to_its_own_signal() -> None:
    quiet, noisy = (
        np.concatenate([block.samples for block in simulated(API_670, noise=noise)])[:, NAMES.index("y1")]
        for noise in (0.0, 0.5)
    )
    assert (noisy - quiet).std() == pytest.approx(0.5 * quiet.std(), rel=0.2)


def tiny(*angles: float) -> MachineFile:
    sensors = [probe(name, angle_deg=angle) for name, angle in zip("XY", angles, strict=False)]
    sensors = sensors or [probe("y"), probe("z")]
    sensors += [probe("theta", quantity="shaft_angle", location="shaft", direction="rotation", unit="rad")]
    window = {"length_s": 4.0, "hop_s": 1.0, "segment_s": 1.0, "band_hz": (5.0, 60.0), "max_span_s": 6.0}
    return MachineFile.model_validate(
        {"site": "s", "name": "m", "rate_hz": 200.0, "dtype": "float64", "sensors": sensors, "window": window}
    )


@settings(max_examples=25, deadline=None)
@given(
    first=st.floats(-180, 180), apart=st.floats(30, 150), sign=st.sampled_from([-1, 1]), seed=st.integers(0, 2**20),
    slope=st.sampled_from([0.0, 4.0]),
)  # fmt: skip
def test_resolving_angled_probes_is_exact(first: float, apart: float, sign: int, seed: int, slope: float) -> None:
    """At any angles, and at a steady or changing speed, every statistic equals that of y and z themselves."""
    rng = np.random.default_rng(seed)
    t = np.arange(1000) / 200
    theta = 2 * np.pi * (11 * t + slope * t**2 / 20)
    y = 8 * np.cos(theta - 0.4) + rng.standard_normal(1000)
    z = 5 * np.sin(theta + 0.3) + 0.4 * y + rng.standard_normal(1000)
    angles = np.radians([first, first + sign * apart])
    seen = [y * np.cos(one) + z * np.sin(one) for one in angles]
    theta %= 2 * np.pi
    machine = tiny(first, first + sign * apart)
    plain = window_of(tiny(), [SampleBlock(0, 0, 1, 200.0, np.column_stack([y, z, theta]))], lagged=True)
    turned = window_of(machine, [SampleBlock(0, 0, 1, 200.0, np.column_stack([*seen, theta]))], lagged=True)
    assert turned.states == plain.states == ("y1", "z1")
    assert turned.removed_by_hop == plain.removed_by_hop == (slope > 0)
    for name in ("correlation", "hop_correlation", "spectrum", "synchronous", "hop_synchronous"):
        expected, found = getattr(plain, name), getattr(turned, name)
        exact = 1e-5 if name == "spectrum" else 1e-9  # Fourier coefficients are kept in single precision
        assert np.abs(found - expected).max() < exact * np.abs(expected).max(), name
    c, s = np.cos(angles), np.sin(angles)
    R = plain.correlation[0]
    power = c**2 * R[0, 0] + s**2 * R[1, 1] + 2 * c * s * R[0, 1]
    found = np.diag(turned.as_mounted.correlation[0])
    assert found[[turned_at(machine, 0), turned_at(machine, 1)]] == pytest.approx(power)


def turned_at(machine: MachineFile, sensor: int) -> int:
    """The column of a sensor in the statistics as mounted."""
    return int(np.flatnonzero(plan_for(machine).columns == sensor)[0])


def test_without_a_phase_reference_vectors_are_turned_hop_by_hop() -> None:
    fields = API_670.model_dump()
    fields["sensors"] = [one for one in fields["sensors"] if one["name"] != "theta"]
    columns = [number for number, name in enumerate(NAMES) if name != "theta"]
    machine = Machine.model_validate(fields)
    plain = Machine.model_validate(LAB.model_dump() | {"sensors": [LAB.sensors[number] for number in columns]})
    found, expected = (
        window_of(one, [replace(block, samples=block.samples[:, columns]) for block in simulated(of)])
        for one, of in ((machine, API_670), (plain, LAB))
    )
    turned, same = sure(found.relative_synchronous), sure(expected.relative_synchronous)
    # the channel at angle zero is the same
    assert np.abs(turned.imag).max(axis=0).argmin() == np.abs(same.imag).max(axis=0).argmin()
    assert np.abs(turned) == pytest.approx(np.abs(same), rel=0.01)


def test_machine_files_without_angles_keep_their_schema_and_statistics() -> None:
    assert plan_for(LAB).turn is None
    assert "angle_deg" not in LAB.descriptor.model_dump_json()
    assert load_machine("lab").descriptor.schema_hash == "9350127db1bf"
    window = window_of(LAB, simulated(LAB))
    assert window.as_mounted is window


def test_the_descriptor_holds_angles_and_those_along_y_and_z_need_no_turning() -> None:
    at_right_angles = mounted(LAB, {"y1": (0, 90), "y2": (360, -270)})
    assert plan_for(at_right_angles).turn is None
    assert at_right_angles.descriptor.states == LAB.descriptor.states
    assert at_right_angles.descriptor.schema_hash != LAB.descriptor.schema_hash
    announced = API_670.descriptor.model_dump_json()
    assert ChannelDescriptor.model_validate_json(announced) == API_670.descriptor
    assert (API_670.descriptor.channels[0].angle_deg, API_670.descriptor.states) == (45, LAB.descriptor.states)


@pytest.mark.parametrize(
    ("sensors", "says"),
    [
        ([probe("P-X", angle_deg=45)], "P-X: .*one alone cannot be resolved into y and z"),
        ([probe("P-X", angle_deg=45), probe("P-z")], "P-X: .*one alone.*P-z has no angle_deg"),
        ([probe("P-X", angle_deg=45), probe("P-Y", angle_deg=225)], "P-X and P-Y: .*0° apart, expected at least 30°"),
        ([probe("P-X", angle_deg=45), probe("P-Y", angle_deg=70)], "25° apart, expected at least 30°"),
        (
            [probe("P-X", angle_deg=45), probe("P-Y", angle_deg=135), probe("P-V", angle_deg=90)],
            "P-X, P-Y and P-V: .*three displacement sensors with angle_deg at bearing, expected two",
        ),
        ([probe("P-X", angle_deg=45), probe("P-Y", angle_deg=135), probe("P-y")], "P-y: .*beside P-X and P-Y"),
        (
            [probe("P-y", quantity="tilt", unit="rad", location="disc", angle_deg=45)],
            "P-y: angle_deg is 45, but a tilt sensor cannot be turned",
        ),
        (
            [probe("P-r", quantity="shaft_angle", unit="rad", location="shaft", direction="rotation", angle_deg=45)],
            "P-r: angle_deg is 45, but a shaft_angle sensor cannot be turned",
        ),
        ([probe("P-y", angle_deg=45), probe("P-z", angle_deg=135)], "P-y: direction 'y' and angle_deg 45 contradict"),
        ([probe("P-X", angle_deg=float("nan")), probe("P-Y", angle_deg=135)], "angle_deg"),
    ],
)  # fmt: skip
def test_angles_that_cannot_be_resolved_are_refused(sensors: list[dict[str, object]], says: str) -> None:
    fields = LAB.model_dump(exclude={"sensors"}) | {"sensors": sensors}
    with pytest.raises(ValidationError, match=says):
        MachineFile.model_validate(fields)


def test_angles_of_sensors_at_other_places_are_not_resolved() -> None:
    casing = probe("DE-X", location="DE", quantity="velocity", unit="mm/s", angle_deg=45)
    found = MachineFile.model_validate({"site": "s", "name": "m", "rate_hz": 2000.0, "sensors": [casing]})
    assert plan_for(found).turn is None
    assert found.descriptor.states == ("@DE-X",)


def test_a_faulty_sensor_at_an_angle_is_named_as_mounted() -> None:
    healthy = simulated(ALL, noise=0.02)
    reference = learn_sensor_reference([window_of(ALL, healthy)])
    assert sensor_findings(window_of(ALL, healthy), reference, ALL.sensors) == ()
    for name in ("y1", "z2"):
        (found,) = sensor_findings(window_of(ALL, changed(healthy, name, gain=0.8)), reference, ALL.sensors)
        state = state_name(ALL.sensors[NAMES.index(name)])
        assert (found.kind, found.states) == ("gain", (state,)), found.text
        assert found.text.startswith(f"{name}: its gain is off by -20")
    (found,) = sensor_findings(window_of(ALL, changed(healthy, "z1", gain=0.0)), reference, ALL.sensors)
    assert (found.kind, found.states) == ("stuck", ("bearing@135",))
    where = [number for number, block in enumerate(healthy) if number >= 30]
    stepped = [
        changed([block], "y1", offset=300.0 if number in where else 0.0)[0] for number, block in enumerate(healthy)
    ]
    (found,) = sensor_findings(window_of(ALL, stepped), reference, ALL.sensors)
    assert (found.kind, found.states) == ("offset", ("bearing@45",))


def test_a_shift_of_the_shaft_is_no_offset_of_angled_probes() -> None:
    healthy = simulated(API_670, noise=0.02)
    reference = learn_sensor_reference([window_of(API_670, healthy)])
    lifted = changed(changed(healthy, "y1", offset=400.0), "z1", offset=350.0)
    assert not [
        one for one in sensor_findings(window_of(API_670, lifted), reference, API_670.sensors) if one.kind == "offset"
    ]


def test_a_sentence_about_a_plane_names_both_probes() -> None:
    assert with_channel_names("gain of y1_dot (+10 %)", API_670.sensors) == "gain of y1 or z1 or y1_dot (+10 %)"
    assert with_channel_names("gain of y1_dot (+10 %)", LAB.sensors) == "gain of y1_dot (+10 %)"
    assert with_channel_names("y1_dot: changed", API_670.sensors) == "y1_dot: changed"
    sensors = [Sensor.model_validate(probe(f"XE-{way}", angle_deg=at)) for way, at in (("X", 45), ("Y", 135))]
    assert with_channel_names("z1: changed", sensors) == "XE-X or XE-Y: changed"
    assert with_channel_names("bearing@135: its shape", sensors) == "XE-Y: its shape"
    assert with_channel_names("gain of y2", sensors) == "gain of y2"


def test_shapes_are_learned_for_sensors_as_mounted() -> None:
    windows = [window_of(API_670, simulated(API_670, noise=0.02, seed=seed), lagged=True) for seed in (8_113, 1, 2, 3)]
    shape = learn_shape(windows)
    assert [one.channel for one in shape.channels][:2] == ["bearing@45", "disc@45"]
    assert {one.state for one in shape.judge(windows[0])} >= {"bearing@45", "bearing@135", "y1_dot"}


def test_a_line_in_healthy_data_is_attributed_to_the_sensor_as_mounted() -> None:
    def with_hum(block: SampleBlock) -> SampleBlock:
        samples = block.samples.copy()
        t = (block.start_ns - simulated(API_670)[0].start_ns) / 1e9 + np.arange(len(samples)) / block.rate_hz
        samples[:, NAMES.index("z1")] += 60 * np.sin(2 * np.pi * 50 * t)
        return replace(block, samples=samples)

    recording = healthy_from_blocks("r", API_670, map(with_hum, simulated(API_670)))
    assert foreign_lines(recording)[0].state == "bearing@135"
