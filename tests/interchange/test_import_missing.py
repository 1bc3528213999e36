"""Channels that lack numbers in a file are reported as missing, and the others imported."""

import re
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

from models.errors import MachineFileError
from models.signals.block import FloatArray, SampleBlock
from models.signals.recording import read_recording
from models.signals.wire import decode_block
from service.interchange.exporting import export
from service.interchange.importing import summary_lines
from tests.interchange.material import (
    CHANNELS,
    PULSES,
    SPEED_HZ,
    START,
    TEXT,
    archive,
    fault,
    good_rows,
    imported,
    machine,
    selected,
    signals,
    table,
    with_cell,
)

MISSING = '[time]\nnot_finite = "missing"'
MAPPING = TEXT.replace("[time]", MISSING)


def blocks_of(recording: Path) -> list[SampleBlock]:
    messages = read_recording(recording, keys={machine().keys.stream})
    return [decode_block(one.payload, one.attachment, one.encoding) for one in messages]


def samples_of(recording: Path) -> FloatArray:
    return np.concatenate([block.samples for block in blocks_of(recording)]).astype(np.float64)


def test_a_temporarily_dead_probe_is_missing_in_whole_blocks(tmp_path: Path) -> None:
    """The tests of a monitor's missing channels show what becomes of it."""
    time, x, v, a = signals(40_000)
    lost = (time >= 11.0) & (time < 15.025)
    pa.parquet.write_table(pa.table({"t": time, "x": pa.array(x, mask=lost), "v": v, "a": a}), tmp_path / "run.parquet")
    done, recording = imported(tmp_path, tmp_path / "run.parquet", MAPPING)
    assert (done.read.gaps, done.written.samples) == ([], 40_000)
    told = "missing, in whole blocks: y1, 4.1 s from 2026-01-31T12:00:11.000000Z to 2026-01-31T12:00:15.100000Z"
    assert told in "\n".join(summary_lines(done))
    expected = np.column_stack([x, v, a])
    expected[22_000:30_200, 0] = np.nan
    np.testing.assert_array_equal(samples_of(recording), expected)


@pytest.mark.parametrize("cell", ["", "NaN", "inf"])
def test_an_empty_cell_takes_its_channel_out_of_one_block(tmp_path: Path, cell: str) -> None:
    source = table(tmp_path / "run.csv", with_cell(cell))
    done, recording = imported(tmp_path, source, MAPPING)
    assert (done.read.left_out, done.read.gaps, done.written.samples) == (0, [], 1000)
    expected = np.column_stack(signals(1000)[1:])
    expected[600:800, 1] = np.nan
    np.testing.assert_array_equal(samples_of(recording), expected)
    # An export of the recording imports identically.
    export(selected(recording), "stream", "csv", tmp_path / "again.csv")
    again = MAPPING.replace(f'start = "{START}"', 'unit = "ns"\nstart = "unix"')
    for name, column in {"t": "time_ns", "x": "y1 [um]", "v": "y1_dot [mm/s]", "a": "theta [rad]"}.items():
        again = again.replace(f'column = "{name}"', f'column = "{column}"')
    _, recording = imported(tmp_path, tmp_path / "again.csv", again)
    np.testing.assert_array_equal(samples_of(recording), expected)


def test_where_every_channel_is_missing_there_is_a_gap(tmp_path: Path) -> None:
    rows = good_rows()
    for row in range(250, 260):
        rows[row] = rows[row].split(",")[0] + ",,,"
    for row, lacking in {700: "{t},,{v},{a}", 701: "{t},{x},,{a}", 702: "{t},{x},{v},"}.items():
        rows[row] = lacking.format(**dict(zip("txva", rows[row].split(","), strict=True)))
    done, recording = imported(tmp_path, table(tmp_path / "run.csv", rows), MAPPING)
    told = "\n".join(summary_lines(done))
    assert "gaps: 1, 0.005 s in all" in told
    assert "beyond the dtype in every channel: 10" in told
    assert "samples left out in blocks in which every channel lacks numbers: 200" in told
    assert "shaft angle: 1320 rpm on average" in told
    assert done.written.lengths == [250, 400, 140]
    assert np.diff([block.sequence for block in blocks_of(recording)]).tolist() == [1, 2, 1, 2]
    assert np.isfinite(samples_of(recording)).all()


@pytest.mark.parametrize("handling", ["missing", "gap"])
def test_a_file_without_any_numbers_is_refused(tmp_path: Path, handling: str) -> None:
    mapping = TEXT.replace("[time]", MISSING.replace("missing", handling))
    told = fault(tmp_path, [f"{row.split(',')[0]},,," for row in good_rows()], mapping)
    assert "1000 rows, 1000 of them without numbers, 0 gaps: no stretch is long enough" in told


def test_a_file_with_numbers_missing_in_every_channel_of_every_block_is_refused(tmp_path: Path) -> None:
    rows = [row.split(",") for row in good_rows()]
    for number, row in enumerate(rows):
        row[1 + number % 3] = ""
    told = fault(tmp_path, [",".join(row) for row in rows], MAPPING)
    assert "1000 rows, 1000 samples in blocks in which every channel lacks numbers, 0 gaps: no stretch" in told


def test_a_column_of_a_lower_rate_is_told_not_to_be_usable(tmp_path: Path) -> None:
    rows = [row.split(",") for row in good_rows()]
    slow = [",".join([t, x, "" if number % 4 else v, a]) for number, (t, x, v, a) in enumerate(rows)]
    dead = [",".join([t, x, "" if number < 700 else v, a]) for number, (t, x, v, a) in enumerate(rows)]
    told = []
    for one in (slow, dead):
        done, _ = imported(tmp_path, table(tmp_path / "run.csv", one), MAPPING)
        told.append("note: no block without missing numbers: y1_dot;" in "\n".join(summary_lines(done)))
    assert told == [True, False]


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_channel_with_no_data_in_the_file_is_missing_throughout(tmp_path: Path, kind: str) -> None:
    rows = [",".join([t, x, "", a]) for t, x, _, a in (row.split(",") for row in good_rows())]
    source = table(tmp_path / "run.csv", rows)
    if kind == "parquet":  # in which such a column has no type
        content, source = pa.csv.read_csv(source), tmp_path / "run.parquet"
        pa.parquet.write_table(content, source)
    done, recording = imported(tmp_path, source, MAPPING)
    assert "missing, in whole blocks: y1_dot, 0.5 s from" in "\n".join(summary_lines(done))
    assert np.isnan(samples_of(recording)).all(axis=0).tolist() == [False, True, False]


def test_missing_keyphasor_pulses_make_only_the_angle_missing(tmp_path: Path) -> None:
    time, x, v, a = signals(8000)
    pulse = np.where((a < 0.8) & ~((time > 1.5) & (time < 2.5)), 5.0, 0.0)
    pulse[5000:5100] = np.nan
    mapping = f'{PULSES}column = "k"\nthreshold = 2.5\n'.replace("[time]", MISSING)
    done, recording = imported(tmp_path, archive(tmp_path, x=x, v=v, k=pulse), mapping)
    assert done.read.gaps == []
    assert f"rows without it because the shaft angle is not known: {done.angle.unknown}" in summary_lines(done)
    samples = samples_of(recording)
    assert samples.shape == (8000, 3)
    np.testing.assert_array_equal(samples[:, :2], np.column_stack([x, v]))
    lost = np.isnan(samples[:, 2])
    assert lost[3400:4800].all()
    assert not lost[:3000].any()
    assert not lost[5400:].any()
    assert done.angle.unknown > 1600


@pytest.mark.parametrize("rate_hz", [2000.0, 5000.0])
def test_only_what_filters_derive_from_missing_numbers_is_missing(tmp_path: Path, rate_hz: float) -> None:
    count = int(120 * rate_hz)
    time, x, _, a = signals(count, rate_hz)
    omega = 2 * np.pi * SPEED_HZ
    mapping = (
        f'[time]\nrate_hz = {rate_hz}\nresample = true\nstart = "{START}"\n[channels]\n'
        'y1 = { column = "x", unit = "um" }\ntheta = { column = "a", unit = "rad" }\n[acceleration]\n'
        'high_pass_hz = 2.0\n[acceleration.channels]\ny1_dot = { column = "g", unit = "m/s^2" }\n'
    ).replace("[time]", MISSING)
    gravity = 40e-6 * omega**2 * np.cos(omega * time)
    _, recording = imported(tmp_path, archive(tmp_path, x=x, a=a, g=gravity), mapping)
    whole = samples_of(recording)
    dead = slice(int(50 * rate_hz), int(51 * rate_hz))  # seen by two of the filter's windows at the higher rate
    gravity[dead], x[dead.start + 7] = np.nan, np.nan
    gravity[: int(rate_hz)] = np.nan
    done, recording = imported(tmp_path, archive(tmp_path, x=x, a=a, g=gravity), mapping)
    assert re.search("missing, in whole blocks: y1_dot, .* s in 2 stretches from", "\n".join(summary_lines(done)))
    samples = samples_of(recording)
    lost = np.isnan(samples)
    assert lost.any(axis=0).tolist() == [True, True, False]
    assert lost[:, 0].sum() <= 2 * 200
    # The dead second, 2.5 s of filter settling on either side, and the rest of the blocks.
    settling = lost[:, 1] & (np.arange(len(lost)) > 20_000)
    assert settling.sum() / 2000 == pytest.approx(6.0, abs=0.25)
    np.testing.assert_allclose(samples[~lost], whole[~lost], atol=0.02)


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # asammdf's own
def test_samples_that_an_mf4_file_marks_as_invalid_are_missing(tmp_path: Path) -> None:
    import asammdf  # noqa: PLC0415  # it takes seconds, and every worker reads this module

    described, path = machine(), tmp_path / "run.mf4"
    time, *columns = signals(4000)
    invalid = (time >= 0.5) & (time < 1.0)
    signal = partial(asammdf.Signal, timestamps=time)
    with asammdf.MDF() as file:
        file.start_time = datetime(2026, 1, 31, 12, tzinfo=UTC)
        file.append([signal(columns[0], name="x", invalidation_bits=invalid)])
        file.append([signal(columns[1], name="v"), signal(columns[2], name="a")])
        file.save(path)
    with pytest.raises(MachineFileError, match="row 1001, column x: found nan, expected a finite number"):
        imported(tmp_path, path, CHANNELS, described)
    _, recording = imported(tmp_path, path, f"{MISSING}\n{CHANNELS}", described)
    found = samples_of(recording)
    np.testing.assert_array_equal(found[:, 0], np.where(invalid, np.nan, columns[0]))
    np.testing.assert_array_equal(found[:, 1:], np.column_stack(columns[1:]))
