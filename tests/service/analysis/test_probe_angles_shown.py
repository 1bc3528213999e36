"""Display of probes at an angle: channels as they are mounted, orbits turned to y and z."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from models.descriptor import descriptor_mismatch
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.machine import load_machine_file
from models.signals.block import SampleBlock
from rotorwatch.records.health import HealthState
from service.analysis.orbit import orbit_pairs, orbits_of
from service.analysis.revolutions import Excerpt
from service.analysis.snapshots.machine import LatestData
from service.analysis.snapshots.orbit import orbit_snapshot
from service.analysis.snapshots.window import correlation_snapshot, spectrum_snapshot
from service.commands.installation import init
from service.monitor.conversion import machine_description
from service.monitor.reports import Identity
from simulator.scenario import load_scenario
from simulator.stream import blocks
from tests.commissioning.rotor_kit import LAB, mounted
from tests.service.analysis.snapshotting import numbers, snapshots_of, window_of
from tests.sure import sure

TURNED = mounted(LAB, {"y1": (45, 135), "y2": (100, 160)})


@cache
def held(*, mounted: bool, lagged: bool = True) -> LatestData:
    machine = TURNED if mounted else LAB
    scenario, _ = load_scenario("healthy")
    sensors = scenario.sensors.model_copy(update={"noise_relative": 1e-6})
    scenario = scenario.model_copy(update={"sensors": sensors, "duration_s": 66.0, "seed": 5_120})
    stream = tuple(block for block, _ in blocks(scenario, machine))
    window = window_of(machine, stream, lagged=lagged)
    return LatestData(window, 1.0, LikelihoodFit(machine).diagnose(window).parameters, "", stream[-20:])


def samples(of: tuple[SampleBlock, ...]) -> np.ndarray:
    return np.concatenate([block.samples for block in of]).astype(float)


def test_orbits_are_turned_to_y_and_z_and_labelled_so() -> None:
    plain = orbit_snapshot(snapshots_of(LAB), held(mounted=False), 4)
    turned = orbit_snapshot(snapshots_of(TURNED), held(mounted=True), 4)
    assert [orbit.location for orbit in turned.orbits] == ["bearing", "disc"]
    for one, other in zip(plain.orbits, turned.orbits, strict=True):
        for name in ("ellipse", "nominal", "estimated"):
            expected, found = getattr(one, name).model_dump(), getattr(other, name).model_dump()
            sizes = ("semi_major", "semi_minor", "tilt_deg")
            assert [found[size] for size in sizes] == pytest.approx([expected[size] for size in sizes], rel=5e-3)
            assert (found["sense"], found["precession"]) == (expected["sense"], expected["precession"])
        assert one.y is not None
        assert other.y is not None
        assert other.y.amplitude == pytest.approx(one.y.amplitude, rel=1e-3)
        assert other.y.phase_lag_deg == pytest.approx(one.y.phase_lag_deg, abs=0.1)
        assert numbers(sure(other.path).z) == pytest.approx(numbers(sure(one.path).z), abs=1e-2)
    assert (sure(turned.orbits[0].y).channel, sure(turned.orbits[0].z).channel) == ("y of y1 and z1", "z of y1 and z1")


def test_spectra_correlations_and_theory_are_those_of_the_probes() -> None:
    data = held(mounted=True)
    spectrum = spectrum_snapshot(snapshots_of(TURNED), data, ["y1", "z2", "y2_dot"], ["y1"], ["y1_dot"])
    mounted = sure(data.window).as_mounted
    for density in spectrum.densities:
        column = {"y1": "bearing@45", "z2": "disc@160", "y2_dot": "y2_dot"}[density.channel]
        at = mounted.states.index(column)
        unit = 1e12 if density.quantity == "displacement" else 1e6
        assert numbers(density.measured) == pytest.approx(2 * unit * mounted.spectrum[:, at, at].real, rel=1e-5)
        for predicted in (density.nominal, density.estimated):
            ratio = numbers(density.measured) / numbers(predicted)
            assert np.nanmedian(ratio) == pytest.approx(1, abs=0.35)
    (cross,) = spectrum.cross
    assert numbers(cross.nominal_magnitude) == pytest.approx(numbers(cross.magnitude), rel=5)
    assert (cross.first, cross.second) == ("y1", "y1_dot")
    found = correlation_snapshot(snapshots_of(TURNED), data, ["y1", "y1"], ["y1", "z2"])
    for pair in found.pairs:
        assert sure(pair.nominal_z) < 4


def test_the_spectrum_of_a_probe_is_that_of_the_planes_at_its_angle() -> None:
    plain, turned = (
        spectrum_snapshot(snapshots_of(machine), held(mounted=mounted), ["y1"], ["y1"], ["z1"])
        for machine, mounted in ((LAB, False), (TURNED, True))
    )
    z = spectrum_snapshot(snapshots_of(LAB), held(mounted=False), ["z1"]).densities[0]
    cross = plain.cross[0]
    real = numbers(cross.magnitude) * np.cos(np.radians(numbers(cross.phase_deg)))
    expected = (numbers(plain.densities[0].measured) + numbers(z.measured)) / 2 + real
    assert numbers(turned.densities[0].measured) == pytest.approx(expected, rel=1e-2, abs=1e-3 * expected.max())


def test_a_recorded_orbit_is_turned_to_y_and_z() -> None:
    t = np.arange(4000) / 2000
    theta = 2 * np.pi * 22 * t
    y, z = 40 * np.cos(theta), 20 * np.sin(theta)
    (pair,) = [pair for pair in orbit_pairs(TURNED.sensors) if pair[0].location == "disc"]
    seen = [y * channel.axis[0] + z * channel.axis[1] for channel in pair]
    (orbit,) = orbits_of(Excerpt(0, 2000.0, np.column_stack(seen), theta % (2 * np.pi)), [pair], 8).orbits
    assert [orbit.ellipse.semi_major, orbit.ellipse.semi_minor] == pytest.approx([40, 20], rel=1e-3)
    assert orbit.ellipse.precession == "forward"
    assert np.ptp(orbit.z_um) == pytest.approx(40, rel=1e-3)
    assert orbit.names == ("y of z2 and y2", "z of z2 and y2")


def test_the_angle_is_in_descriptors_client_answers_and_files_by_init(tmp_path: Path) -> None:
    assert descriptor_mismatch(TURNED.descriptor.model_dump_json().encode(), TURNED) == ()
    fields = json.loads(TURNED.descriptor.model_dump_json())
    fields["channels"][0]["angle_deg"] = 50.0
    (found,) = descriptor_mismatch(json.dumps(fields).encode(), TURNED)
    assert found == "channels.0.angle_deg (y1) is '50.0', expected '45.0'"
    identity = Identity(site="demo", machine="lab", bundle=None, machine_hash="9a0c41d27be8")
    told = machine_description(identity, TURNED, HealthState.HEALTHY)
    angles = {channel.name: channel.angle_deg for channel in told.channels if channel.angle_deg is not None}
    assert angles == {"y1": 45.0, "z1": 135.0, "y2": 100.0, "z2": 160.0}
    sensors = ["VE-1X displacement um bearing X 45", "VE-1Y displacement um bearing Y 135"]
    init(folder=tmp_path, site="p", name="pump", rate_hz=2560.0, sensor=sensors, speed_rpm=None, zones=None)
    pump = load_machine_file(tmp_path / "pump.toml")
    assert [one.angle_deg for one in pump.sensors] == [45, 135]
    assert pump.descriptor.states == ("y1", "z1")
