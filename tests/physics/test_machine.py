"""The machine file: shipped ones, bounds, unknown keys, messages."""

import math
from pathlib import Path

import numpy as np
import pytest

from models.diagnosis.window.moments import plan_for
from models.errors import MachineFileError
from models.machine import Machine, MachineFile, load_machine, load_machine_file
from models.physics.response import synchronous_response
from models.physics.rotor import PARAMETERS, changed, system_A
from models.stream_settings import LONGEST_LAG_STEP_S, WindowSettings, time_scale

LAB = (Path(__file__).parents[2] / "models" / "machines" / "lab.toml").read_text(encoding="utf-8")


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "machine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_shipped_machines_have_the_documented_modes() -> None:
    for name, expected_hz in (
        ("lab", (28.2, 30.3, 90.1, 94.3, 472, 507)),
        ("heavy", (17.1, 18.4, 75.6, 92.6, 242, 254)),
        ("light", (23.4, 27.4, 74.3, 97.5, 182.7, 227.8)),
    ):
        machine = load_machine(name)
        values = np.linalg.eigvals(system_A(machine.rotor, machine.operation.speed_rad_s))
        modes_hz = np.sort(np.abs(values[values.imag > 0])) / (2 * np.pi)
        np.testing.assert_allclose(modes_hz, expected_hz, rtol=0.005)


def test_the_light_machine_is_damped_as_its_file_says() -> None:
    machine = load_machine("light")
    assert machine.rotor.EI_N_m2 == pytest.approx(1649, rel=1e-3)
    values = np.linalg.eigvals(system_A(machine.rotor, machine.operation.speed_rad_s))
    values = values[values.imag > 0]
    values = values[np.argsort(np.abs(values))]
    np.testing.assert_allclose(
        -values.real / np.abs(values), np.array([0.67, 1.2, 8.1, 9.2, 2.5, 0.84]) / 100, rtol=0.03
    )
    q1, q2 = synchronous_response(machine.rotor, machine.operation.speed_rad_s)
    np.testing.assert_allclose(np.hypot(q1, q2)[[0, 1]], [2.04e-6, 12.4e-6], rtol=0.01)


def test_parameters_are_changed_by_a_relative_amount() -> None:
    rotor = load_machine("lab").rotor
    for name in PARAMETERS:
        assert changed(rotor, {name: 0.1}) != rotor
    assert changed(rotor, {"EI": 0.25}).EI_N_m2 == pytest.approx(1.25 * rotor.EI_N_m2)
    assert rotor.EI_N_m2 == pytest.approx(2.1e11 * math.pi * 0.01**4 / 64)
    with pytest.raises(ValueError, match="'k11' is not one of"):
        changed(rotor, {"k11": 0.1})
    with pytest.raises(ValueError, match="expected above -1"):
        changed(rotor, {"k_by": -1.0})


SENSORS_ALONE = """site = "plant"
name = "fan"
rate_hz = 2000.0

[[sensors]]
name = "DE"
quantity = "acceleration"
location = "DE"
direction = "horizontal"
unit = "g"
"""


def fan(folder: Path, *more: object, rate_hz: float = 25600.0) -> MachineFile:
    """A machine of which only the sensors are known, and what else its file says."""
    text = SENSORS_ALONE.replace("2000.0", repr(rate_hz))
    return load_machine_file(write(folder, "\n".join([text, *map(str, more)]) + "\n"))


@pytest.mark.parametrize("rate_hz", [50.0, 200.0, 256.0, 1666.67, 6400.5, 51200 / 7, 51200 / 3, 102400.0])
def test_a_machine_file_with_only_sensors_works_at_any_rate(tmp_path: Path, rate_hz: float) -> None:
    window = fan(tmp_path, rate_hz=rate_hz).window
    assert (window.segment_s, window.hop_s, window.length_s) == pytest.approx((2, 5, 60), rel=0.01)
    assert window.band_hz[0] == 3.0
    assert window.band_hz[1] < rate_hz / 2


@pytest.mark.parametrize("rpm", [1500, 4783, 6000])
def test_default_lags_are_close_enough_for_every_rate_that_allows_it(tmp_path: Path, rpm: int) -> None:
    for rate_hz in (1024.0, 1536.0, 1587.0, 2048.0, 2450.0, 2500.0, 4096.0):
        machine = fan(tmp_path, f"[operation]\nspeed_rpm = {rpm}", rate_hz=rate_hz)
        longest_s = LONGEST_LAG_STEP_S * machine.time_scale
        assert machine.window.lag_step_s <= longest_s or longest_s * rate_hz < 1


@pytest.mark.parametrize(
    ("table", "text"),
    [("ingest.reorder_blocks = -1", "expected 0 to 1000"), ("alarms.false_alarms_per_month = 0", "expected above 0")],
)
def test_bounds_that_no_computation_checks_again(tmp_path: Path, table: str, text: str) -> None:
    with pytest.raises(MachineFileError, match=text):
        load_machine_file(write(tmp_path, f"{table}\n{SENSORS_ALONE}"))


def test_a_byte_order_mark_is_accepted(tmp_path: Path) -> None:
    assert load_machine_file(write(tmp_path, "\ufeff" + SENSORS_ALONE)).name == "fan"


def in_time(times: float, rate_hz: float, *more: str) -> str:
    """The file of the rotor kit as a machine that moves `times` as fast, without a window."""
    text = LAB[: LAB.index("[window]")] + LAB[LAB.index("[alarms]") :]
    factors = {"k_by_N_per_m": times**2, "k_bz_N_per_m": times**2, "c_by_N_s_per_m": times, "c_bz_N_s_per_m": times}
    for name, factor in (factors | {"shaft_diameter_m": times**0.5, "speed_rpm": times}).items():
        line = next(one for one in text.splitlines() if one.startswith(f"{name} ="))
        text = text.replace(line, f"{name} = {factor * float(line.split()[2])}")
    text = text.replace("rate_hz = 2000.0", f"rate_hz = {rate_hz}").replace(
        "[25.0, 200.0]", str([25 * times, 200 * times])
    )
    return "\n".join([text, *more])


def kit(folder: Path, times: float, rate_hz: float, *more: str) -> Machine:
    return load_machine(write(folder, in_time(times, rate_hz, *more)))


def test_the_default_window_follows_from_the_natural_frequencies(tmp_path: Path) -> None:
    usual = kit(tmp_path, 1, 2000.0)
    assert (usual.window, usual.time_scale) == (WindowSettings(), 1)

    fast = kit(tmp_path, 15, 20000.0)
    low_hz, high_hz = fast.window.band_hz
    assert low_hz < 0.1 * fast.rotor.modes_hz[0] < 1.2 * fast.rotor.modes_hz[3] < high_hz < 8000
    assert (fast.window.length_s, fast.window.hop_s, fast.window.segment_s) == (60, 5, 2)
    assert fast.window.lag_to_s == pytest.approx(0.125 * fast.time_scale)
    assert fast.window.lag_step_s * fast.rate_hz == 2

    slow = kit(tmp_path, 0.05, 200.0)
    assert slow.time_scale == pytest.approx(6 / slow.rotor.modes_hz[0], rel=0.05)
    low_hz, high_hz = slow.window.band_hz
    assert low_hz <= slow.rotor.modes_hz[0] / 2
    assert 1.25 * slow.rotor.modes_hz[3] <= high_hz < 50
    assert slow.window.hop_s == pytest.approx(5 * slow.time_scale)
    assert slow.window.length_s == 12 * slow.window.hop_s
    assert slow.window.hop_s % (slow.window.segment_s / 2) == pytest.approx(0)


@pytest.mark.parametrize(
    ("c_N_s_per_m", "times", "rate_hz", "more", "segment_s"),
    [
        (60.0, 1, 2000.0, (), 2),
        (6.0, 1, 2000.0, (), 5),
        (6.0, 1, 51200 / 3, (), 5),
        (2.0, 1, 2000.0, (), 10),
        (6.0, 15, 20000.0, (), 2),  # decays fifteen times as fast
        (2.0, 0.05, 200.0, (), 43),
        (2.0, 1, 2000.0, ("[window]", "hop_s = 2.0"), 2),
        (2.0, 1, 2000.0, ("[schedule]", "on_s = 12.0", "every_s = 60.0"), 3),
    ],
)
def test_narrow_modes_have_segments_that_resolve_them(
    tmp_path: Path, c_N_s_per_m: float, times: float, rate_hz: float, more: tuple[str, ...], segment_s: float
) -> None:
    text = in_time(times, rate_hz, *more)
    for name in ("c_by", "c_bz"):
        text = text.replace(f"{name}_N_s_per_m = {60.0 * times}", f"{name}_N_s_per_m = {c_N_s_per_m * times}")
    machine = load_machine(write(tmp_path, text))
    window = machine.window
    assert machine.rotor.c_by_N_s_per_m == pytest.approx(c_N_s_per_m * times)
    assert window.segment_s == pytest.approx(segment_s, rel=1e-4)
    if machine.schedule is None:
        assert 2 * window.hop_s / window.segment_s == pytest.approx(round(2 * window.hop_s / window.segment_s))


def test_a_given_window_is_used(tmp_path: Path) -> None:
    lengths = ("hop_s = 10.0", "length_s = 120.0", "max_span_s = 200.0", "lag_to_s = 0.05")
    given = kit(tmp_path, 15, 20000.0, "[window]", *lengths)
    assert (given.window.hop_s, given.window.length_s, given.window.segment_s) == (10, 120, 2)
    assert (given.window.lag_from_s, given.window.lag_to_s) == (0.01, 0.05)
    assert given.window.band_hz[1] > 1000


@pytest.mark.parametrize("given", ["hop_s = 1.0", "segment_s = 1.0", "max_span_s = 120.0"])
def test_a_slow_machine_with_one_given_length_has_the_usual_others(tmp_path: Path, given: str) -> None:
    """Longer lags would not fit into a given hop, nor a longer window into a given span."""
    window = kit(tmp_path, 0.01, 200.0, "[window]", given).window
    usual = WindowSettings()
    assert (window.length_s, window.lag_to_s) == (usual.length_s, usual.lag_to_s)


@pytest.mark.parametrize("lag_to_s", [0.1, 0.125])
def test_a_fast_machine_with_the_usual_lags_given_has_time_scale_one(tmp_path: Path, lag_to_s: float) -> None:
    """Earlier commissionings with such a file keep their evaluation."""
    speed = "[operation]\nspeed_rpm = 6000"
    assert fan(tmp_path, speed).time_scale == 0.5
    assert fan(tmp_path, speed, "[window]\nlag_from_s = 0.01", f"lag_to_s = {lag_to_s}").time_scale == 1


def test_machines_slightly_out_of_the_usual_range_keep_time_scale_one() -> None:
    assert [time_scale((), rpm / 60) for rpm in (3600, 3750, 4200)] == [1, 1, 0.71]
    assert [time_scale((low, low, 80.0, 80.0), None) for low in (6.0, 5.0, 4.0)] == [1, 1, 1.5]
    # As slow as the slowest motion needs, as far as the fastest allows.
    assert [time_scale((0.5, 0.5, high, high), None) for high in (8.0, 40.0, 100.0, 120.0)] == [12, 3, 1, 1]


def test_the_longest_segments_are_whole_numbers_of_samples_at_any_rate(tmp_path: Path) -> None:
    assert 117 < kit(tmp_path, 0.0035, 33.345).window.segment_s < 120


def test_a_rotor_without_natural_frequencies_is_refused(tmp_path: Path) -> None:
    text = LAB.replace("shaft_length_m = 0.15", "shaft_length_m = 1e-200")
    with pytest.raises(MachineFileError, match=r"\[rotor\] has no natural frequencies"):
        load_machine(write(tmp_path, text))


def test_an_unbalance_of_zero_is_refused_because_changes_are_relative_to_it(tmp_path: Path) -> None:
    path = write(tmp_path, LAB.replace("e_m = 20e-6", "e_m = 0.0"))
    with pytest.raises(MachineFileError, match=r"rotor\.e_m: expected above 0 and at most 0\.1 \(found 0\.0\)"):
        load_machine_file(path)


def test_the_mean_is_no_part_of_the_band(tmp_path: Path) -> None:
    """Snapshots of a slow machine may be too short for segments that resolve its slowest motion."""
    machine = kit(tmp_path, 0.05, 200.0, "[schedule]", "on_s = 2.0", "every_s = 60.0")
    assert round(machine.window.band_hz[0] * machine.window.segment_s) == 0
    assert plan_for(machine).bins[0] == 1


def test_without_a_known_rotor_only_a_fast_speed_changes_the_time_scale(tmp_path: Path) -> None:
    windows = {rpm: fan(tmp_path, f"[operation]\nspeed_rpm = {rpm}") for rpm in (60, 1500, 3000, 15000)}
    assert [one.time_scale for one in windows.values()] == [1, 1, 1, 0.2]
    assert (windows[60].window, windows[15000].window.band_hz) == (windows[3000].window, (15, 750))
    assert windows[15000].window.lag_to_s == pytest.approx(0.025)


def test_snapshots_of_a_fast_machine_have_its_band_and_lags(tmp_path: Path) -> None:
    window = fan(tmp_path, "[operation]\nspeed_rpm = 15000", "[schedule]\non_s = 4.0\nevery_s = 60.0").window
    assert (window.hop_s, window.length_s, window.segment_s) == (60, 720, 1)
    assert window.band_hz == (15, 750)
    assert (window.lag_from_s, window.lag_to_s) == pytest.approx((0.002, 0.025))


@pytest.mark.parametrize("rate_hz", [6400 / 3, 51200 / 3, 2000.5])
def test_snapshots_at_rates_that_do_not_divide_have_whole_segments(tmp_path: Path, rate_hz: float) -> None:
    window = fan(tmp_path, "[schedule]\non_s = 12.0\nevery_s = 60.0", rate_hz=rate_hz).window
    assert window.segment_s == pytest.approx(2, rel=1e-3)


@pytest.mark.parametrize(("rpm", "rate_hz"), [(15000, 60.0), (60000, 100.0), (60000, 50.0)])
def test_a_rate_too_low_for_a_fast_machine_leaves_the_usual_window(tmp_path: Path, rpm: int, rate_hz: float) -> None:
    machine, usual = (fan(tmp_path, f"[operation]\nspeed_rpm = {one}", rate_hz=rate_hz) for one in (rpm, 1500))
    assert (machine.window, machine.time_scale) == (usual.window, 1)
