"""Orbits of a live machine."""

import numpy as np
import pytest

from models.machine import Machine
from service.analysis.snapshots.machine import LatestData
from service.analysis.snapshots.orbit import orbit_snapshot
from service.analysis.snapshots.window import correlation_snapshot
from tests.commissioning.rotor_kit import LAB, NOTHING, elsewhere, stream
from tests.service.analysis.snapshotting import (
    SECONDS,
    SEED,
    latest,
    numbers,
    quiet,
    snapshots_of,
    synthetic,
    unbalance_um,
    window_of,
)
from tests.sure import sure


def test_the_orbit_of_a_known_unbalance_follows_the_equations_of_motion() -> None:
    data = LatestData(window_of(LAB, quiet()), 1.0, (), "not asked", quiet()[-20:])
    snapshot = orbit_snapshot(snapshots_of(LAB), data, 8)
    assert (snapshot.reason, snapshot.path_reason, snapshot.revolutions) == ("", "", 8)
    assert snapshot.speed_source == "phase reference"
    W, q_um = LAB.operation.speed_rad_s, unbalance_um()
    circle = np.exp(1j * np.linspace(0, 2 * np.pi, 20_000))
    assert [orbit.location for orbit in snapshot.orbits] == ["bearing", "disc"]
    for orbit, q_y, q_z in zip(snapshot.orbits, q_um[[0, 1]], q_um[[3, 4]], strict=True):
        assert orbit.unit == "um"
        assert orbit.y is not None
        assert orbit.y.amplitude == pytest.approx(abs(q_y), rel=1e-3)
        assert orbit.y.phase_lag_deg == pytest.approx(np.degrees(-np.angle(q_y)) % 360, abs=0.1)
        assert orbit.z is not None
        assert orbit.z.amplitude == pytest.approx(abs(q_z), rel=1e-3)
        assert orbit.z.phase_lag_deg == pytest.approx(np.degrees(-np.angle(q_z)) % 360, abs=0.1)
        y, z = np.real(q_y * circle), np.real(q_z * circle)
        radius = np.hypot(y, z)
        far = int(radius.argmax())
        for ellipse in (orbit.ellipse, orbit.nominal):
            assert ellipse is not None
            assert ellipse.semi_major == pytest.approx(radius.max(), rel=1e-3)
            assert ellipse.semi_minor == pytest.approx(radius.min(), rel=1e-3)
            apart = ellipse.tilt_deg - np.degrees(np.arctan2(z[far], y[far]))
            assert (apart + 90) % 180 - 90 == pytest.approx(0, abs=0.5)
            assert (ellipse.sense, ellipse.precession) == ("y to z", "forward")
        assert orbit.estimated is None
        assert orbit.path is not None
        path = numbers(orbit.path.y) + 1j * numbers(orbit.path.z)
        turn = np.exp(1j * W * (np.array(orbit.path.times_s) - snapshot.pulses_s[0]))
        on_ellipse = np.real(q_y * turn) + 1j * np.real(q_z * turn)
        assert np.abs(path - on_ellipse).max() < 0.01 * radius.max()
    assert snapshot.theory.estimated_reason == "not asked"
    assert np.diff(snapshot.pulses_s) == pytest.approx(2 * np.pi / W, rel=1e-4)
    assert quiet()[-1].end_ns - sure(snapshot.path_start_ns) < 9.1 * 2e9 * np.pi / W


def test_stated_errors_of_an_orbit_are_the_scatter_of_hops() -> None:
    """Scatter of twelve healthy hops against the stated errors; the estimated orbit has the nominal size."""
    data = latest()
    assert data.window is not None
    snapshot = orbit_snapshot(snapshots_of(LAB), data)
    for orbit in snapshot.orbits:
        assert orbit.estimated is not None
        for vector in (orbit.y, orbit.z):
            assert vector is not None
            hops = 1e6 * np.abs(sure(data.window.hop_synchronous)[:, data.window.states.index(vector.channel)])
            assert vector.amplitude_error == pytest.approx(hops.std(ddof=1) / np.sqrt(12), rel=0.2)
        assert sure(orbit.ellipse).semi_major == pytest.approx(sure(orbit.nominal).semi_major, rel=0.1)
    assert (snapshot.revolutions, snapshot.path_reason) == (0, "none were asked for")
    assert all(orbit.path is None for orbit in snapshot.orbits)


def test_a_backward_orbit_of_a_shaft_that_turns_the_other_way() -> None:
    """The angle decreases and the orbit is backward; z is in another unit than y."""
    t = np.arange(round(71 * LAB.rate_hz)) / LAB.rate_hz
    turn = 2 * np.pi * 25.0 * t
    rng = np.random.default_rng(2)
    stream_ = synthetic(
        {
            "theta": (1.0 - turn) % (2 * np.pi),
            "y1": 30 * np.cos(turn - 1.0 - np.pi / 2) + 400 + rng.standard_normal(t.size),
            "z1": (10 * np.sin(turn - 1.0 - np.pi / 2) - 300 + rng.standard_normal(t.size)) / 25.4,
        }
    )
    channels = {channel.name: channel for channel in LAB.sensors}
    channels["z1"] = channels["z1"].model_copy(update={"unit": "mil"})
    machine = NOTHING.model_copy(update={"sensors": tuple(channels.values())})
    data = LatestData(window_of(machine, stream_), 1.0, (), "", tuple(stream_[-10:]))
    snapshot = orbit_snapshot(snapshots_of(machine), data, 3)
    assert snapshot.speed_rad_s == pytest.approx(-2 * np.pi * 25, rel=1e-3)
    orbit = snapshot.orbits[0]
    assert orbit.ellipse is not None
    assert (orbit.ellipse.sense, orbit.ellipse.precession) == ("y to z", "backward")
    assert orbit.ellipse.semi_major == pytest.approx(30, rel=2e-3)
    assert orbit.ellipse.semi_minor == pytest.approx(10, rel=5e-3)
    assert orbit.ellipse.tilt_deg == pytest.approx(0, abs=0.2)
    assert sure(orbit.y).phase_lag_deg == pytest.approx(90, abs=0.2)
    assert np.ptp(numbers(sure(orbit.path).z)) == pytest.approx(20, rel=0.5)


def test_without_a_phase_reference_orbits_keep_size_and_sense() -> None:
    machine = Machine.model_validate(LAB.model_dump() | {"sensors": [c for c in LAB.sensors if c.name != "theta"]})
    data = LatestData(window_of(machine, stream(SECONDS, SEED)), 1.0, (), "", stream(SECONDS, SEED)[-20:])
    blind, seeing = orbit_snapshot(snapshots_of(machine), data, 4), orbit_snapshot(snapshots_of(LAB), latest())
    assert blind.speed_source == "estimated"
    assert blind.speed_rad_s == pytest.approx(LAB.operation.speed_rad_s, rel=1e-3)
    for one, other in zip(blind.orbits, seeing.orbits, strict=True):
        assert one.y is not None
        assert (one.y.phase_lag_deg, one.y.phase_error_deg) == (None, None)
        assert one.ellipse is not None
        assert (one.ellipse.sense, one.ellipse.precession) == ("y to z", None)
        assert one.ellipse.semi_major == pytest.approx(sure(other.ellipse).semi_major, rel=0.15)
        turns_s = 4 * 2 * np.pi / LAB.operation.speed_rad_s
        assert sure(one.path).times_s[-1] == pytest.approx(turns_s, abs=2 / LAB.rate_hz)
    assert (blind.revolutions, blind.pulses_s) == (4, ())
    assert blind.path_reason.startswith("the shaft angle is not measured")
    snapshot = correlation_snapshot(snapshots_of(machine), data)
    assert all(pair.nominal_z is not None and pair.nominal_z < 2.5 for pair in snapshot.pairs)


def test_places_outside_the_model_have_orbits_of_the_newest_revolutions() -> None:
    data = LatestData(None, 0.0, (), "not asked", quiet()[-20:])
    casing = elsewhere(LAB)
    moved = [one.model_copy(update={"location": "NDE"}) if one.name in {"y2", "z2"} else one for one in casing.sensors]
    snapshot = orbit_snapshot(snapshots_of(casing.model_copy(update={"sensors": tuple(moved)})), data, 8)
    there = orbit_snapshot(
        snapshots_of(LAB), LatestData(window_of(LAB, quiet()), 1.0, (), "not asked", quiet()[-20:]), 8
    )
    assert [one.location for one in snapshot.orbits] == ["casing", "NDE"]
    assert (snapshot.reason, snapshot.path_reason, snapshot.revolutions) == ("", "", 8)
    for found, known in zip(snapshot.orbits, there.orbits, strict=True):
        assert found.path == known.path
        ellipse, expected = sure(found.ellipse), sure(known.ellipse)
        assert ellipse.semi_major == pytest.approx(expected.semi_major, rel=0.01)
        assert ellipse.semi_minor == pytest.approx(expected.semi_minor, rel=0.01)
        assert (ellipse.sense, ellipse.precession) == ("y to z", "forward")
    assert not orbit_snapshot(snapshots_of(casing), data).orbits  # without samples there is nothing to be shown
