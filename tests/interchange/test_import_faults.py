"""What is wrong with a mapping or a file is named: file, field, row, column, and what was expected."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from scipy.io import wavfile

from models.errors import MachineFileError
from tests.interchange.material import START, imported, signals

TIME = f'[time]\ncolumn = "t"\nstart = "{START}"\n'
CHANNELS = """
[channels]
y1 = { column = "x", unit = "um" }
y1_dot = { column = "v", unit = "mm/s" }
theta = { column = "a", unit = "rad" }
"""


def table(path: Path, rows: list[str], header: str = "t,x,v,a") -> Path:
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def good_rows(count: int = 1000, rate_hz: float = 2000.0) -> list[str]:
    return [",".join(repr(float(value)) for value in row) for row in zip(*signals(count, rate_hz), strict=True)]


def fault(folder: Path, rows: list[str], mapping: str = TIME + CHANNELS, header: str = "t,x,v,a") -> str:
    source = table(folder / "run.csv", rows, header)
    with pytest.raises(MachineFileError) as raised:
        imported(folder, source, mapping)
    assert not list(folder.glob("*.mcap*")), "a failed import leaves nothing behind"
    return str(raised.value)


def test_a_good_file_is_the_reference(tmp_path: Path) -> None:
    done, _ = imported(tmp_path, table(tmp_path / "run.csv", good_rows()), TIME + CHANNELS)
    assert done.written.samples == 1000


def test_a_missing_column_is_named_with_those_that_there_are(tmp_path: Path) -> None:
    text = fault(tmp_path, good_rows(), header="t,x,speed,a")
    assert "run.csv: no column 'v'; there are t, x, speed, a" in text


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"um"', '"mm/s"', r"channels.y1.unit: unit 'mm/s' is a unit of velocity, not of displacement"),
        ('"um"', '"mil pp"', "is that of an overall value (pp)"),
        ('"mm/s"', '"mm/s rms"', "is that of an overall value (rms)"),
        ('"um"', '"furlong"', "unit 'furlong' is not known for displacement; expected one of m, cm"),
        ("y1_dot =", "y1_dots =", "channels.y1_dots: not a channel of the machine, which has y1, y1_dot, theta"),
        ('column = "x"', 'colum = "x"', "channels.y1.colum: unknown; did you mean column"),
        ('column = "t"', 'column = "t"\nunit = "fortnight"', "is not a unit of time"),
        ("12:00:00Z", "12:00:00", "has no time zone"),
        ('{ column = "x", unit = "um" }', '{ column = "x", unit = "um", scale = 0 }', "scale is 0"),
        ("[channels]", '[keyphasor]\npulse_times = "k"\n[channels]', "channels.theta: expected [channels.theta], or a"),
        ("[channels]", "[keyphasor]\n[channels]", "keyphasor: expected either pulse_times or column"),
    ],
)
def test_a_wrong_mapping_is_named_by_field(tmp_path: Path, old: str, new: str, said: str) -> None:
    mapping = TIME + CHANNELS
    assert old in mapping
    text = fault(tmp_path, good_rows(), mapping.replace(old, new, 1))
    assert "mapping.toml: " in text
    assert said in text


def test_a_channel_that_is_not_mapped_is_named(tmp_path: Path) -> None:
    lines = [line for line in (TIME + CHANNELS).splitlines() if not line.startswith("y1_dot")]
    text = fault(tmp_path, good_rows(), "\n".join(lines))
    assert "channels.y1_dot: expected [channels.y1_dot] or [acceleration.channels.y1_dot], found nothing" in text


def test_a_unit_that_contradicts_the_file_is_refused(tmp_path: Path) -> None:
    time, x, v, a = signals(1000)
    fields = [pa.field("t", pa.float64()), pa.field("x", pa.float64(), metadata={"unit": "mil"})]
    schema = pa.schema([*fields, pa.field("v", pa.float64()), pa.field("a", pa.float64())])
    pa.parquet.write_table(pa.table([time, x, v, a], schema=schema), tmp_path / "run.parquet")
    with pytest.raises(MachineFileError, match="column x is in 'mil' according to the file, but in 'um'"):
        imported(tmp_path, tmp_path / "run.parquet", TIME + CHANNELS)


@pytest.mark.parametrize("cell", ["OVERLOAD", "1.2.3", "--"])
def test_text_in_a_cell_is_named_by_row_and_column(tmp_path: Path, cell: str) -> None:
    rows = good_rows()
    t, x, _, a = rows[736].split(",")
    rows[736] = f"{t},{x},{cell},{a}"
    text = fault(tmp_path, rows)
    assert f"row 737, column 'v': found {cell!r}, expected a number" in text


@pytest.mark.parametrize("cell", ["", "NaN", "inf"])
def test_a_number_that_is_not_finite_is_refused_or_a_gap(tmp_path: Path, cell: str) -> None:
    rows = good_rows()
    t, x, _, a = rows[736].split(",")
    rows[736] = f"{t},{x},{cell},{a}"
    assert "row 737, column v: found" in fault(tmp_path, rows)
    mapping = TIME + 'not_finite = "gap"\n' + CHANNELS
    done, _ = imported(tmp_path, table(tmp_path / "run.csv", rows), mapping)
    assert done.read.left_out == 1
    assert [gap.row for gap in done.read.gaps] == [737]
    assert done.written.samples == 999


def test_a_row_that_is_too_short_is_named(tmp_path: Path) -> None:
    rows = good_rows()
    rows[500] = "0.25,1.0"
    text = fault(tmp_path, rows)
    assert "run.csv: " in text
    assert "Expected 4 columns, got 2" in text


def test_a_time_that_goes_back_is_named(tmp_path: Path) -> None:
    rows = good_rows()
    rows[600], rows[601] = rows[601], rows[600]
    assert "row 602, column t: goes back by 0.0005 s" in fault(tmp_path, rows)


def test_times_with_too_few_decimals_are_explained(tmp_path: Path) -> None:
    rows = [f"{number // 2 * 0.001:.3f},1.0,2.0,3.0" for number in range(1000)]
    text = fault(tmp_path, rows)
    assert "row 2, column t: repeats the time of the row before" in text
    assert "time.rate_hz" in text


def test_another_rate_is_refused_unless_it_is_resampled(tmp_path: Path) -> None:
    text = fault(tmp_path, good_rows(5000, 5000.0))
    assert "run.csv: has 5000 samples per second, the machine file says rate_hz = 2000" in text
    assert "time.resample = true" in text


def test_a_declared_rate_that_the_times_contradict_is_refused(tmp_path: Path) -> None:
    text = fault(tmp_path, good_rows(), TIME + "rate_hz = 1000.0\n" + CHANNELS)
    assert "column t has 2000 rows per second, but 1000 are declared" in text


def test_a_declared_rate_that_the_header_contradicts_is_refused(tmp_path: Path) -> None:
    wavfile.write(tmp_path / "run.wav", 48000, np.zeros((1000, 3), dtype=np.float32))
    mapping = f'[time]\nrate_hz = 2000.0\nstart = "{START}"\n' + CHANNELS.replace('"x"', "1")
    mapping = mapping.replace('"v"', "2").replace('"a"', "3")
    with pytest.raises(MachineFileError, match="the file says 48000 samples per second, the mapping 2000"):
        imported(tmp_path, tmp_path / "run.wav", mapping)


def test_rates_without_a_ratio_of_small_numbers_are_not_resampled(tmp_path: Path) -> None:
    wavfile.write(tmp_path / "run.wav", 19997, np.zeros((1000, 3), dtype=np.float32))
    mapping = f'[time]\nresample = true\nstart = "{START}"\n' + CHANNELS.replace('"x"', "1")
    mapping = mapping.replace('"v"', "2").replace('"a"', "3")
    with pytest.raises(MachineFileError, match="19997 and 2000 samples per second are not in a ratio of whole numbers"):
        imported(tmp_path, tmp_path / "run.wav", mapping)


@pytest.mark.parametrize("count", [0, 1])
def test_a_file_that_is_too_short_is_refused(tmp_path: Path, count: int) -> None:
    assert f"run.csv: has {count} rows, expected at least two" in fault(tmp_path, good_rows(count))


def test_nothing_tells_the_start(tmp_path: Path) -> None:
    text = fault(tmp_path, good_rows(), TIME.replace(f'start = "{START}"', "") + CHANNELS)
    assert "give time.start in the mapping" in text


def test_an_index_outside_the_table_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", x=np.zeros((1000, 3)))
    mapping = f'[time]\nrate_hz = 2000.0\nstart = "{START}"\n' + CHANNELS.replace('"x"', '"x", index = 3')
    mapping = mapping.replace('"v"', '"x", index = 1').replace('"a"', '"x", index = 2')
    with pytest.raises(MachineFileError, match=r"x has 3 columns of 1000 samples, expected index = 0 to 2 \(found 3\)"):
        imported(tmp_path, tmp_path / "run.npz", mapping)
