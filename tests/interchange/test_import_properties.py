"""Whatever the gaps, units and keyphasor pulses of a file, nothing is invented, shifted or lost."""

import itertools
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.machine import Machine
from models.signals.block import FloatArray
from models.signals.channels import unit_factor
from models.signals.keyphasor import EdgeDetector, pulse_train, shaft_angle
from service.interchange.importing import summary_lines
from service.interchange.source import SourceError
from tests.interchange.material import (
    CHANNELS,
    PULSES,
    RATE_HZ,
    SPEED_HZ,
    START,
    START_NS,
    archive,
    imported,
    machine,
    signals,
    stretches,
)
from tests.sure import sure

STEP_NS = 500_000
NANOSECONDS = '[time]\ncolumn = "t"\nunit = "ns"\nstart = "unix"\n'

samples_and_steps_without = st.tuples(st.integers(2, 900), st.integers(2, 40_000))
runs = st.lists(samples_and_steps_without, min_size=1, max_size=6)


def write(
    path: Path, time: np.ndarray[tuple[int], np.dtype[np.int64]], rows: int
) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """A Parquet file with these times; the samples are numbered by their rows."""
    _, x, v, a = signals(rows)
    pa.parquet.write_table(pa.table({"t": time, "x": x, "v": v, "a": a}), path, row_group_size=311)
    return np.column_stack([x, v, a])


@settings(max_examples=25)
@given(content=runs, shift_ns=st.integers(0, STEP_NS))
def test_gaps_stay_gaps_and_every_sample_keeps_its_time(
    tmp_path_factory: pytest.TempPathFactory, content: list[tuple[int, int]], shift_ns: int
) -> None:
    folder = tmp_path_factory.mktemp("gaps")
    pieces, at = [], START_NS + shift_ns
    for samples, pause in content:
        pieces.append(at + STEP_NS * np.arange(samples, dtype=np.int64))
        at += STEP_NS * (samples + pause - 1)
    time = np.concatenate(pieces)
    expected = write(folder / "run.parquet", time, time.size)
    done, recording = imported(folder, folder / "run.parquet", NANOSECONDS + CHANNELS)
    found = stretches(recording)
    assert [stretch.start_ns for stretch in found] == [int(piece[0]) for piece in pieces]
    assert [stretch.samples.shape[0] for stretch in found] == [piece.size for piece in pieces]
    np.testing.assert_array_equal(np.concatenate([stretch.samples for stretch in found]), expected)
    assert len(done.read.gaps) == len(content) - 1
    for gap, (_, pause) in zip(done.read.gaps, content, strict=False):
        assert gap.to_ns - gap.from_ns == pytest.approx((pause - 1) * STEP_NS)


@settings(max_examples=30)
@given(rows=st.integers(3, 2000), data=st.data())
def test_a_duplicated_time_is_named(tmp_path_factory: pytest.TempPathFactory, rows: int, data: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("duplicates")
    twice = data.draw(st.integers(1, rows - 1))
    time = START_NS + STEP_NS * np.arange(rows, dtype=np.int64)
    time[twice:] -= STEP_NS
    write(folder / "run.parquet", time, rows)
    with pytest.raises(SourceError, match=f"row {twice + 1}, column t: repeats the time of the row before"):
        imported(folder, folder / "run.parquet", NANOSECONDS + CHANNELS)


@settings(max_examples=25)
@given(
    displacement=st.sampled_from(["m", "mm", "um", "µm", "\u03bcm", "mil", "in"]),
    velocity=st.sampled_from(["m/s", "mm/s", "in/s", "ips"]), angle=st.sampled_from(["rad", "deg", "rev"]),
    kept=st.tuples(st.sampled_from(["m", "mm", "um", "mil"]), st.sampled_from(["m/s", "mm/s", "in/s"])),
    scale=st.floats(1e-3, 1e3), offset=st.floats(-50, 50), sign=st.sampled_from([1, -1]),
)  # fmt: skip
def test_any_mix_of_units_gives_the_same_motion(
    tmp_path_factory: pytest.TempPathFactory, displacement: str, velocity: str, angle: str, kept: tuple[str, str],
    scale: float, offset: float, sign: int,
) -> None:  # fmt: skip
    folder = tmp_path_factory.mktemp("units")
    _, x, v, a = signals(400)
    x_SI, v_SI = x * 1e-6, v * 1e-3
    sensors = [channel.model_dump() for channel in machine().sensors]
    sensors[0]["unit"], sensors[1]["unit"] = kept
    described: Machine = machine(sensors=sensors)
    numbers = (sign * x_SI / unit_factor("displacement", displacement) - offset) / scale
    pa.parquet.write_table(
        pa.table({
            "x": numbers, "v": v_SI / unit_factor("velocity", velocity),
            "a": a / unit_factor("shaft_angle", angle) + (1.0 if angle == "rev" else 0.0),
        }),
        folder / "run.parquet",
    )  # fmt: skip
    mapping = (
        f'[time]\nrate_hz = 2000.0\nstart = "{START}"\n[channels]\n'
        f'y1 = {{ column = "x", unit = "{displacement}", scale = {scale!r}, offset = {offset!r}, sign = {sign} }}\n'
        f'y1_dot = {{ column = "v", unit = "{velocity}" }}\ntheta = {{ column = "a", unit = "{angle}" }}\n'
    )
    _, recording = imported(folder, folder / "run.parquet", mapping, described)
    (found,) = stretches(recording, described)
    si = found.samples * [channel.to_si for channel in described.sensors]
    resolution = 1e-13 * abs(offset) * unit_factor("displacement", displacement)
    np.testing.assert_allclose(si[:, 0], x_SI, rtol=1e-9, atol=1e-15 + resolution)
    np.testing.assert_allclose(si[:, 1], v_SI, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(np.exp(1j * si[:, 2]), np.exp(1j * a), atol=1e-9)
    assert ((si[:, 2] >= 0) & (si[:, 2] < 2 * np.pi)).all()


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), drift=st.floats(-5e-5, 5e-5))
def test_jitter_and_drift_make_no_gaps(tmp_path_factory: pytest.TempPathFactory, seed: int, drift: float) -> None:
    folder = tmp_path_factory.mktemp("jitter")
    rng = np.random.default_rng(seed)
    rows = 20_000
    ideal = np.arange(rows) * STEP_NS * (1 + drift)
    time = START_NS + np.rint(ideal + rng.uniform(-0.15, 0.15, rows) * STEP_NS).astype(np.int64)
    expected = write(folder / "run.parquet", time, rows)
    done, recording = imported(folder, folder / "run.parquet", NANOSECONDS + CHANNELS)
    (found,) = stretches(recording)
    assert not done.read.gaps
    np.testing.assert_array_equal(found.samples, expected)
    assert abs(found.start_ns - START_NS) < 0.1 * STEP_NS
    assert abs(done.written.end_ns - START_NS - rows * STEP_NS * (1 + drift)) < 0.2 * STEP_NS


@pytest.mark.parametrize("missing", [1, 3, 9])
def test_gaps_up_to_the_declared_limit_are_bridged_and_counted(tmp_path: Path, missing: int) -> None:
    rows = 3000
    time, x, v, a = signals(rows)
    present = np.r_[0:1500, 1500 + missing : 2000, 2300:rows]
    content = {"t": time[present], "x": x[present], "v": v[present], "a": a[present]}
    pa.parquet.write_table(pa.table(content), tmp_path / "run.parquet")
    mapping = f'[time]\ncolumn = "t"\nstart = "{START}"\nfill_gaps_up_to_s = 0.0045\n' + CHANNELS
    done, recording = imported(tmp_path, tmp_path / "run.parquet", mapping)
    assert done.read.filled == missing
    assert [round((gap.to_ns - gap.from_ns) / STEP_NS) for gap in done.read.gaps] == [300]
    first, second = stretches(recording)
    assert first.samples.shape[0] == 2000
    assert second.start_ns == START_NS + 2300 * STEP_NS
    filled = first.samples[1500 : 1500 + missing]
    ends = first.samples[[1499, 1500 + missing]]
    part = np.arange(1, missing + 1) / (missing + 1)
    np.testing.assert_allclose(filled[:, 0], ends[0, 0] + part * (ends[1, 0] - ends[0, 0]), rtol=1e-9)
    np.testing.assert_allclose(np.exp(1j * filled[:, 2]), np.exp(1j * a[1500 : 1500 + missing]), atol=1e-6)


@pytest.mark.parametrize(("rate_hz", "ratio"), [(5000.0, "2/5"), (1600.0, "5/4"), (2560.0, "25/32")])
def test_a_file_at_another_rate_is_resampled_to_the_machines_rate(tmp_path: Path, rate_hz: float, ratio: str) -> None:
    rows = int(rate_hz * 45)
    _, x, v, a = signals(rows, rate_hz)
    pa.parquet.write_table(pa.table({"x": x + 5000, "v": v, "a": a}), tmp_path / "run.parquet")
    mapping = f'[time]\nrate_hz = {rate_hz}\nresample = true\nstart = "{START}"\n' + CHANNELS
    done, recording = imported(tmp_path, tmp_path / "run.parquet", mapping)
    assert str(done.clock.ratio) == ratio
    (found,) = stretches(recording)
    first_s = (found.start_ns - START_NS) / 1e9
    assert 0 < first_s < 0.05
    at = first_s + np.arange(found.samples.shape[0]) / RATE_HZ
    omega = 2 * np.pi * 22.0
    exact = 40 * np.cos(omega * at) + 3 * np.sin(170.0 * at) - 12
    assert np.abs(found.samples[:, 0] - 5000 - exact).max() < 0.005 * 43
    assert np.abs(np.angle(np.exp(1j * (found.samples[:, 2] - omega * at)))).max() < 0.005
    assert done.cut_rows == rows - round(found.samples.shape[0] * rate_hz / RATE_HZ)
    assert found.samples.shape[0] > 0.99 * 45 * RATE_HZ


def off_by(angle: FloatArray, expected: FloatArray) -> FloatArray:
    """Difference of angles the short way round, rad."""
    return np.asarray(np.abs(np.angle(np.exp(1j * (angle - expected)))))


@pytest.mark.parametrize("per_turn", [1, 24])
@pytest.mark.parametrize("reverse", [False, True])
def test_uniform_rotation_is_recovered(per_turn: int, reverse: bool) -> None:
    pulses = np.arange(0, 5, 1 / (SPEED_HZ * per_turn))
    at = np.arange(0, 4.99, 1 / RATE_HZ)
    angle = shaft_angle(pulse_train(pulses, per_turn), at, reverse=reverse)
    assert off_by(angle, (-1 if reverse else 1) * 2 * np.pi * SPEED_HZ * at).max() < 1e-6
    assert ((angle >= 0) & (angle < 2 * np.pi)).all()


@settings(max_examples=50)
@given(
    seed=st.integers(0, 2**32 - 1),
    marks=st.lists(st.sampled_from(["good", "missing", "extra"]), min_size=12, max_size=12),
    run_up=st.floats(-0.2, 0.2),
)
def test_jitter_missing_and_extra_pulses_are_repaired(seed: int, marks: list[str], run_up: float) -> None:
    missing = [6 + 8 * place for place, mark in enumerate(marks) if mark == "missing"]
    extra = [6 + 8 * place for place, mark in enumerate(marks) if mark == "extra"]
    rng = np.random.default_rng(seed)
    number = np.arange(100.0)
    # number = f t + r t² / 2 solved for t: the speed rises or falls by a fifth.
    f, end = SPEED_HZ, 100 / SPEED_HZ
    r = run_up * f / end
    exact = number / f if abs(r) < 1e-9 else (-f + np.sqrt(f**2 + 2 * r * number)) / r
    jitter = rng.uniform(-0.01, 0.01, 100) / f
    pulses = np.delete(exact + jitter, missing)
    doubled = [exact[place] + jitter[place] + 0.2 / f for place in extra]
    train = pulse_train(np.sort(np.concatenate([pulses, doubled])))
    assert (train.missing, train.extra, train.interruptions) == (len(missing), len(extra), 0)
    at = np.linspace(exact[1], exact[98], 5000)
    turned = f * at + r * at**2 / 2
    assert off_by(shaft_angle(train, at), 2 * np.pi * turned).max() < 2 * np.pi * 0.03


def test_a_stop_leaves_the_angle_unknown() -> None:
    pulses = np.concatenate([np.arange(0, 1, 0.05), np.arange(3.01, 4, 0.05)])
    train = pulse_train(pulses)
    assert train.interruptions == 1
    at = np.array([0.975, 0.999, 1.01, 2.0, 2.95, 2.97, 3.035])
    angle = shaft_angle(train, at)
    assert np.isnan(angle).tolist() == [False, False, True, True, True, False, False]
    assert off_by(angle[[0, 6]], np.pi * np.ones(2)).max() < 1e-6


@pytest.mark.parametrize(
    ("times", "said"),
    [([], "0 pulses"), ([1.0], "1 pulses"), ([0.0, 1.0, 1.0], "pulse 3 at 1"), ([0, np.nan, 2], "pulse 2 has no")],
)
def test_unusable_pulses_are_named(times: list[float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        pulse_train(np.array(times))


@settings(max_examples=50)
@given(cuts=st.lists(st.integers(1, 3999), max_size=8, unique=True), rising=st.booleans())
def test_edges_do_not_depend_on_how_the_signal_is_split(cuts: list[int], rising: bool) -> None:
    time = np.arange(4000) / RATE_HZ
    noise = 0.3 * np.random.default_rng(2).standard_normal(4000)
    signal = (1 if rising else -1) * (4 * (np.mod(SPEED_HZ * time, 1) > 0.8) + noise)
    level = 2.0 if rising else -2.0
    detector = EdgeDetector(level, 1.5, rising=rising)
    bounds = [0, *sorted(cuts), 4000]
    found = np.concatenate([detector.feed(time[a:b], signal[a:b]) for a, b in itertools.pairwise(bounds)])
    expected = (np.arange(44) + 0.8) / SPEED_HZ
    assert found.size == 44
    assert np.abs(found - expected).max() < 1.01 / RATE_HZ


def test_a_chattering_edge_counts_once_with_hysteresis_and_often_without() -> None:
    time = np.arange(12, dtype=np.float64)
    signal = np.array([0.0, 0, 3, 1.8, 3, 1.9, 3, 0, 0, 3, 3, 0])
    assert EdgeDetector(2.0, 1.0, rising=True).feed(time, signal).size == 2
    assert EdgeDetector(2.0, 0.0, rising=True).feed(time, signal).size == 4


def test_pulse_times_of_a_file_become_its_shaft_angle(tmp_path: Path) -> None:
    _, x, v, angle = signals(20_000)
    pulses = np.arange(0, 10, 1 / SPEED_HZ)
    source = archive(tmp_path, x=x, v=v, k=np.delete(pulses, 50) * 1e3)
    mapping = PULSES + 'pulse_times = "k"\nunit = "ms"\n'
    done, recording = imported(tmp_path, source, mapping)
    (found,) = stretches(recording)
    assert sure(done.angle.pulses).missing == 1
    assert found.samples.shape == (20_000, 3)
    assert off_by(found.samples[:, 2], angle).max() < 1e-6


def test_pulse_times_share_the_zero_of_the_time_column(tmp_path: Path) -> None:
    time, x, v, angle = signals(20_000)
    source = archive(tmp_path, t=time + 77, x=x, v=v, k=np.arange(0, 10, 1 / SPEED_HZ) + 77)
    mapping = PULSES.replace("rate_hz = 2000.0", 'column = "t"') + 'pulse_times = "k"\n'
    _, recording = imported(tmp_path, source, mapping)
    assert off_by(stretches(recording)[0].samples[:, 2], angle).max() < 1e-6


def test_a_sampled_tachometer_becomes_the_shaft_angle(tmp_path: Path) -> None:
    time, x, v, angle = signals(140_000)
    teeth = np.sin(8 * 2 * np.pi * SPEED_HZ * time)
    source = archive(tmp_path, x=x, v=v, tacho=2 + teeth)
    keyphasor = 'column = "tacho"\nthreshold = 2.0\nhysteresis = 0.5\npulses_per_revolution = 8\n'
    _, recording = imported(tmp_path, source, PULSES + keyphasor)
    (found,) = stretches(recording)
    # Which of the eight teeth is the first is not known: the angle is right except for constant eighths.
    difference = np.angle(np.exp(1j * (found.samples[:, 2] - angle[-found.samples.shape[0] :])))
    assert np.ptp(difference) < 0.01
    assert found.samples.shape[0] >= 140_000 - RATE_HZ / SPEED_HZ / 8


def test_a_stopped_shaft_leaves_a_gap(tmp_path: Path) -> None:
    _, x, v, _ = signals(20_000)
    pulses = np.arange(0, 10, 1 / SPEED_HZ)
    source = archive(tmp_path, x=x, v=v, k=pulses[(pulses < 4) | (pulses > 6)])
    mapping = PULSES + 'pulse_times = "k"\n'
    done, recording = imported(tmp_path, source, mapping)
    first, second = stretches(recording)
    assert first.samples.shape[0] + second.samples.shape[0] + done.angle.unknown == 20_000
    assert 2 * RATE_HZ - 2.1 * RATE_HZ / SPEED_HZ < done.angle.unknown < 2 * RATE_HZ
    assert "note: that is 20% of the file, in which the keyphasor gives no pulses" in "\n".join(summary_lines(done))


def test_pulses_that_do_not_ascend_are_named(tmp_path: Path) -> None:
    _, x, v, _ = signals(2000)
    source = archive(tmp_path, x=x, v=v, k=np.array([0.0, 0.1, 0.05]))
    with pytest.raises(SourceError, match="keyphasor k: pulse 3 at 50000000 is not later"):
        imported(tmp_path, source, PULSES + 'pulse_times = "k"\n')
