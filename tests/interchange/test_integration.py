"""Acceleration becomes velocity and displacement, right above the stated frequency and to nothing below."""

from pathlib import Path

import numpy as np
import pytest

from models.errors import MachineFileError
from models.signals.block import integrated, lowest_valid_hz, settling_s
from models.signals.channels import unit_factor
from service.interchange.summary import summary_lines
from tests.interchange.material import START, START_NS, imported, stretches

HIGH_PASS_HZ = 1.5
MAPPING = f"""
[time]
rate_hz = 2000.0
start = "{START}"
[channels]
theta = {{ column = "a", unit = "rad" }}
[acceleration]
high_pass_hz = {HIGH_PASS_HZ}
[acceleration.channels]
y1 = {{ column = "acc", unit = "g" }}
y1_dot = {{ column = "acc", unit = "g" }}
"""


@pytest.mark.parametrize("frequency_hz", [3.0, 22.0, 147.0, 600.0, 900.0])
@pytest.mark.parametrize("times", [1, 2])
def test_a_sine_is_integrated_exactly_above_the_limit(frequency_hz: float, times: int) -> None:
    rate_hz = 2000.0
    time = np.arange(int(20 * rate_hz)) / rate_hz
    omega = 2 * np.pi * frequency_hz
    acceleration = np.cos(omega * time) + 0.3  # an offset, as accelerometers have
    found = integrated(acceleration, rate_hz, times, HIGH_PASS_HZ)
    exact = np.sin(omega * time) / omega if times == 1 else -np.cos(omega * time) / omega**2
    edge = int(settling_s(HIGH_PASS_HZ) * rate_hz)
    assert frequency_hz >= lowest_valid_hz(HIGH_PASS_HZ)
    assert np.abs(found - exact)[edge:-edge].max() < 0.005 / omega**times


def test_what_is_slow_is_not_measured_and_comes_out_as_nothing() -> None:
    time = np.arange(80_000) / 2000.0
    drift = np.sin(2 * np.pi * 0.1 * time) + 0.01 * time
    found = integrated(drift, 2000.0, 2, HIGH_PASS_HZ)
    edge = int(settling_s(HIGH_PASS_HZ) * 2000)
    assert np.abs(found)[edge:-edge].max() < 1e-5  # the true displacement is metres


def test_a_file_of_accelerations_becomes_velocity_and_displacement(tmp_path: Path) -> None:
    rows = 220_000  # several windows
    time = np.arange(rows) / 2000.0
    one, two = 2 * np.pi * 22.0, 2 * np.pi * 140.0
    velocity = 20e-3 * np.sin(one * time) + 5e-3 * np.sin(two * time)
    acceleration = 20e-3 * one * np.cos(one * time) + 5e-3 * two * np.cos(two * time)
    displacement = -20e-3 / one * np.cos(one * time) - 5e-3 / two * np.cos(two * time)
    np.savez(
        tmp_path / "run.npz",
        acc=acceleration / unit_factor("acceleration", "g") + 0.02,
        a=np.mod(one * time, 2 * np.pi),
    )
    done, recording = imported(tmp_path, tmp_path / "run.npz", MAPPING)
    (found,) = stretches(recording)
    first = round((found.start_ns - START_NS) * 2000 / 1e9)
    assert first == round(settling_s(HIGH_PASS_HZ) * 2000)
    kept = slice(first, rows - first)
    assert found.samples.shape[0] == rows - 2 * first == rows - done.cut_rows
    assert np.abs(found.samples[:, 0] - displacement[kept] * 1e6).max() < 1e-3 * 145
    assert np.abs(found.samples[:, 1] - velocity[kept] * 1e3).max() < 1e-3 * 20
    np.testing.assert_allclose(found.samples[:, 2], np.mod(one * time, 2 * np.pi)[kept])
    text = "\n".join(summary_lines(done))
    assert "high-pass at 1.5 Hz, valid from 3 Hz, not below" in text
    assert "below 3 Hz" not in text  # the machine's band begins there


def test_a_limit_within_the_machines_band_is_said(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", acc=np.sin(np.arange(40_000) * 0.1), a=np.zeros(40_000))
    done, _ = imported(tmp_path, tmp_path / "run.npz", MAPPING.replace("= 1.5", "= 5.0"))
    assert "window.band_hz = 3 Hz on, which is below 10 Hz" in "\n".join(summary_lines(done))


def test_a_record_shorter_than_the_filter_settles_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", acc=np.sin(np.arange(10_000) * 0.1), a=np.zeros(10_000))
    with pytest.raises(MachineFileError, match="10000 of them at the ends where filters settle"):
        imported(tmp_path, tmp_path / "run.npz", MAPPING)


def test_velocity_is_no_acceleration(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", acc=np.zeros(10_000), a=np.zeros(10_000))
    with pytest.raises(MachineFileError, match="'mm/s' is a unit of velocity, not of acceleration"):
        imported(tmp_path, tmp_path / "run.npz", MAPPING.replace('"g"', '"mm/s"', 1))
