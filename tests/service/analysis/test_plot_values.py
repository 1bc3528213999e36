"""Values of plots from the newest samples against closed forms; `test_api` has them over HTTP."""

import numpy as np
import pytest

from models.errors import RotorwatchError
from models.signals.channels import Quantity
from service.analysis.recorded import Held, Sampled
from service.analysis.snapshots.plots import (
    centreline_series,
    full_spectrum_snapshot,
    vector_series,
    waterfall_snapshot,
    waveform_snapshot,
)
from tests.service.analysis.snapshotting import numbers
from tests.service.rig.live import LAB, START_NS
from tests.service.rig.replaying import S
from tests.service.rig.run_up import BLOCKS, CHANNELS, FROM_HZ, LAG, RUNOUT_UM, SECONDS, SHAFT_UM, TO_HZ, angle
from tests.sure import sure


@pytest.fixture(scope="module")
def data() -> Sampled:
    return Held(LAB, BLOCKS)


def test_a_waveform_is_of_the_newest_revolutions_with_their_pulses(data: Sampled) -> None:
    found = waveform_snapshot(data, CHANNELS, 6, None)
    assert (found.revolutions, len(found.pulses_s), found.reason) == (6, 7, "")
    assert found.start_ns is not None
    t = (found.start_ns - START_NS) / S + np.array(found.times_s)
    for one, expected in zip(found.waveforms, (np.cos(angle(t) - LAG), np.sin(angle(t) - LAG)), strict=True):
        assert np.abs(numbers(one.values) - SHAFT_UM * expected).max() < 0.6  # without its mean and drift
    at_pulses = angle((found.start_ns - START_NS) / S + np.array(found.pulses_s)) / (2 * np.pi)
    assert at_pulses == pytest.approx(np.round(at_pulses), abs=2e-3)
    assert found.waveforms[0].mean == pytest.approx(RUNOUT_UM, rel=1e-2)
    assert found.speed_rad_s == pytest.approx(2 * np.pi * TO_HZ, rel=0.02)


def test_without_displacements_velocities_are_the_default_channels() -> None:
    kinds = (Quantity.SHAFT_ANGLE, Quantity.VELOCITY)
    sensors = tuple(one for one in LAB.sensors if one.quantity in kinds)
    machine = LAB.model_copy(update={"sensors": sensors})
    assert {one.name for one in Held(machine, BLOCKS).chosen(())} == {"y1_dot", "y2_dot", "z1_dot", "z2_dot"}
    assert {one.name for one in Held(LAB, BLOCKS).chosen(())} == {"y1", "y2", "z1", "z2"}


def test_a_waveform_without_speed_is_of_the_newest_half_second_with_a_reason() -> None:
    plain = LAB.model_copy(update={"sensors": CHANNELS})
    columns = [LAB.sensors.index(one) for one in CHANNELS]
    blocks = [type(one)(one.start_ns, one.sequence, one.run, one.rate_hz, one.samples[:, columns]) for one in BLOCKS]
    found = waveform_snapshot(Held(plain, blocks), CHANNELS, 6, None)
    assert found.revolutions == 0
    assert "neither the shaft angle nor the speed is known" in found.reason
    assert len(found.times_s) == round(0.5 * LAB.rate_hz)
    assert found.speed_rad_s is None


def test_a_forward_orbit_is_on_the_forward_side_of_the_full_spectrum(data: Sampled) -> None:
    found = full_spectrum_snapshot(data)
    (bearing, _) = found.places
    assert (bearing.location, bearing.channels) == ("bearing", ("y1", "z1"))
    lines, values = np.array(found.frequencies_hz), numbers(bearing.values)
    run = (np.abs(lines) > FROM_HZ) & (np.abs(lines) < TO_HZ)
    forward, reverse = (float(np.nansum(values[run & (sign * lines > 0)] ** 2)) for sign in (1, -1))
    assert reverse < 1e-3 * forward
    assert np.isnan(values[np.abs(lines) < 1]).all()


def test_a_waterfall_follows_the_run_up(data: Sampled) -> None:
    found = waterfall_snapshot(data, CHANNELS[0], "time")
    assert (found.unit, found.channel) == ("µm pp", "y1")
    assert len(found.rows) == 40
    frequencies = np.array(found.frequencies_hz)
    for row in found.rows:
        highest = frequencies[np.argmax(numbers(row.values))]
        middle_hz = FROM_HZ + (TO_HZ - FROM_HZ) / SECONDS * ((sure(row.start_ns) - START_NS) / S + 0.25)
        assert highest == pytest.approx(middle_hz, abs=2.1)
        assert row.speed_rad_s == pytest.approx(2 * np.pi * middle_hz, rel=0.02)
    by_speed = waterfall_snapshot(data, CHANNELS[0], "speed").rows
    speeds = np.array([row.speed_rad_s or np.nan for row in by_speed]) / (2 * np.pi)
    assert (np.diff(speeds) > 0).all()
    tops = np.array([frequencies[np.argmax(numbers(row.values))] for row in by_speed])
    assert np.abs(tops - speeds).max() < 2.6


def test_vectors_of_a_run_up_have_its_amplitude_and_lag(data: Sampled) -> None:
    found = vector_series(data, CHANNELS, 1, 5, None)
    assert (found.source, found.steady, found.revolutions) == ("newest samples", "", 5)
    speed = numbers(found.speeds_rad_s) / (2 * np.pi)
    at_s = (np.array(found.times_ns) - START_NS) / S
    assert speed == pytest.approx(FROM_HZ + (TO_HZ - FROM_HZ) / SECONDS * at_s, rel=5e-3)
    for one, lag in zip(found.channels, (40.0, 130.0), strict=True):
        assert one.unit == "µm pp"
        assert numbers(one.amplitude) == pytest.approx(2 * SHAFT_UM, rel=0.02)
        assert numbers(one.phase_lag_deg) == pytest.approx(lag, abs=2)
    bare = vector_series(data, CHANNELS, 1, 5, 1000.0)
    assert np.median(numbers(bare.channels[0].amplitude)) < 1  # the slow-roll vector was all of it


def test_the_centreline_moves_with_the_mean(data: Sampled) -> None:
    found = centreline_series(data)
    bearing = found.places[0]
    at_s = (np.array(found.times_ns) - START_NS) / S
    assert numbers(bearing.y_um) == pytest.approx(RUNOUT_UM, abs=1)
    assert numbers(bearing.z_um) == pytest.approx(-4 * at_s, abs=1)


def test_a_full_spectrum_of_too_few_samples_is_refused() -> None:
    short = Held(LAB, BLOCKS[:2])
    with pytest.raises(RotorwatchError, match="needs 1 s without a gap"):
        full_spectrum_snapshot(short)
