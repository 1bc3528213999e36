"""Files written by each format's own library are imported with their samples and times."""

import csv
import gc
import gzip
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import h5py
import nptdms
import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
import pyuff
import scipy.sparse
from scipy.io import savemat, wavfile

from models.signals.recording import read_recording
from service.interchange.importing import summary_lines
from service.interchange.source import Reference, SourceError
from service.interchange.tables import ParquetSource
from tests.interchange.material import (
    CHANNELS,
    RATE_HZ,
    SAMPLED,
    START,
    START_NS,
    TIME,
    imported,
    machine,
    signals,
    stretches,
)

COUNT = 70_001  # more than one chunk of rows

Columns = dict[str, np.ndarray[tuple[int], np.dtype[np.float64]]]


def write_csv(path: Path, columns: Columns) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


def write_packed_csv(path: Path, columns: Columns) -> None:
    write_csv(path.with_suffix(""), columns)
    path.write_bytes(gzip.compress(path.with_suffix("").read_bytes(), 1))


def write_german_csv(path: Path, columns: Columns) -> None:
    with path.open("w", encoding="latin-1") as file:
        file.write("Prüfstand 3\nt;x;v;a\ns;µm;mm/s;rad\n")
        for row in zip(*(column.tolist() for column in columns.values()), strict=True):
            file.write(";".join(repr(value).replace(".", ",") for value in row) + "\n")


def write_parquet(path: Path, columns: Columns) -> None:
    pa.parquet.write_table(pa.table(dict(columns)), path, row_group_size=9999)


def write_npz(path: Path, columns: Columns) -> None:
    np.savez_compressed(path, x=columns["x"], v=columns["v"], a=columns["a"], fs=np.array(RATE_HZ))


def write_npz_table(path: Path, columns: Columns) -> None:
    np.savez(path, table=np.vstack([columns["x"], columns["v"], columns["a"]]))


OF_STRUCTS = CHANNELS.replace('"x"', '"run.Y(1).Data"').replace('"v"', '"run.Y(2).Data"').replace('"a"', '"more{2}.a"')


def write_mat(path: Path, columns: Columns) -> None:
    savemat(path, {"run": {"x": columns["x"], "v": columns["v"]}, "a": columns["a"][:, None], "fs": RATE_HZ})


def write_mat_of_structs(path: Path, columns: Columns) -> None:
    """Structs such as Y(2).Data, as in public bearing data sets, and cells."""
    several = np.zeros((1, 2), dtype=[("Name", "O"), ("Data", "O")])
    for number, name in enumerate("xv"):
        several[0, number] = (name, columns[name])
    cells = np.empty((1, 2), dtype=object)
    cells[0, :] = ["angle", {"a": columns["a"]}]
    sparse = scipy.sparse.eye_array(3)  # which is not read
    savemat(path, {"run": {"Info": "bearing 3", "Y": several}, "more": cells, "fs": RATE_HZ, "sparse": sparse})


def write_mat73_of_structs(path: Path, columns: Columns) -> None:
    """The same as MATLAB stores it in HDF5: as references into a separate group."""
    with h5py.File(path, "w") as file:
        stored = file.create_group("#refs#")
        for name in "xv":
            stored[name] = columns[name][None, :]
        stored.create_group("s")["a"] = columns["a"][:, None]
        stored["s"].create_dataset("circle", data=[stored["s"].ref, h5py.Reference()], dtype=h5py.ref_dtype)
        stored["t"] = np.array([97], dtype=np.uint16)
        stored["t"].attrs["MATLAB_class"] = np.bytes_("char")
        data = file.create_dataset("run/Y/Data", (2, 1), dtype=h5py.ref_dtype)
        cells = file.create_dataset("more", (2, 1), dtype=h5py.ref_dtype)
        cells.attrs["MATLAB_class"] = np.bytes_("cell")
        data[:, 0] = [stored["x"].ref, stored["v"].ref]
        cells[:, 0] = [stored["t"].ref, stored["s"].ref]


def write_mat73(path: Path, columns: Columns) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name in ("x", "v"):
            data = file.create_dataset(f"run/{name}", data=columns[name][None, :], chunks=True, compression="gzip")
            data.attrs["MATLAB_class"] = np.bytes_(b"double")
        file.create_dataset("a", data=columns["a"][None, :]).attrs["MATLAB_class"] = np.bytes_(b"double")
        text = file.create_dataset("note", data=np.frombuffer(b"hello", dtype=np.uint8).astype(np.uint16)[None, :])
        text.attrs["MATLAB_class"] = np.bytes_(b"char")
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Sat Jan 31 12:00:00 2026 HDF5 schema 1.00 .")


def write_wav(path: Path, columns: Columns) -> None:
    wavfile.write(path, int(RATE_HZ), np.column_stack([columns["x"], columns["v"], columns["a"]]))


UNITS = (("x", "um"), ("v", "mm/s"), ("a", "rad"))


def write_uff(path: Path, columns: Columns) -> None:
    sets = [
        pyuff.prepare_58(
            binary=1, func_type=1, rsp_node=number, rsp_dir=2, ref_node=0, ref_dir=0, data=columns[name],
            x=columns["t"], id1=name, abscissa_spacing=1, abscissa_min=0.0, abscissa_inc=1 / RATE_HZ,
            num_pts=columns[name].size, ord_data_type=4, abscissa_spec_data_type=17, ordinate_spec_data_type=8,
            orddenom_spec_data_type=0, z_axis_value=0.0, ordinate_axis_units_lab=unit,
        )
        for number, (name, unit) in enumerate(UNITS)
    ]  # fmt: skip
    pyuff.UFF(str(path)).write_sets(sets, "add")


def write_tdms(path: Path, columns: Columns) -> None:
    known = {"wf_increment": 1 / RATE_HZ, "wf_start_time": np.datetime64(START[:-1]), "wf_start_offset": 0.0}
    with nptdms.TdmsWriter(str(path)) as writer:
        for first in range(0, COUNT, 30_000):
            part = slice(first, first + 30_000)
            writer.write_segment([
                nptdms.ChannelObject("run", name, columns[name][part], known | {"unit_string": unit})
                for name, unit in UNITS
            ])  # fmt: skip


def write_mf4(path: Path, columns: Columns) -> None:
    import asammdf  # noqa: PLC0415  # it takes seconds, and every worker reads this module

    with asammdf.MDF(version="4.10") as file:
        file.start_time = datetime(2026, 1, 31, 12, tzinfo=UTC)
        file.append([asammdf.Signal(columns[name], columns["t"], name=name, unit=unit) for name, unit in UNITS[:2]])
        file.append([asammdf.Signal(columns["a"], columns["t"], name="a", unit="rad")])
        file.append([asammdf.Signal(columns["a"][:10], columns["t"][:10], name="v", unit="mm/s")])
        file.save(path, overwrite=True)


def without_units(text: str) -> str:
    for _, unit in UNITS:
        text = text.replace(f', unit = "{unit}"', "")
    return text


def named(x: str, v: str, a: str = '"a"') -> str:
    """Channels from other columns."""
    return CHANNELS.replace('"x"', x).replace('"v"', v).replace('"a"', a)


BEGIN = f'[time]\nstart = "{START}"\n'
GERMAN = '[csv]\ndelimiter = ";"\ndecimal = ","\nskip_lines = 1\nskip_lines_after_header = 1\nencoding = "latin-1"\n'
TABLE = named('"table", index = 0', '"table", index = 1', '"table", index = 2')
CASES: dict[str, tuple[str, Callable[[Path, Columns], None], str]] = {
    "csv": ("run.csv", write_csv, TIME + CHANNELS),
    "csv-packed": ("run.csv.gz", write_packed_csv, TIME + CHANNELS),
    "csv-german": ("run.txt", write_german_csv, TIME + GERMAN + CHANNELS),
    "parquet": ("run.parquet", write_parquet, TIME + CHANNELS),
    "npz": ("run.npz", write_npz, f'{BEGIN}rate_from = "fs"\n{CHANNELS}'),
    "npz-table": ("run.npz", write_npz_table, SAMPLED + TABLE),
    "mat-5": ("run.mat", write_mat, f'{BEGIN}rate_from = "fs"\n' + named('"run.x"', '"run.v"')),
    "mat-5-structs": ("run.mat", write_mat_of_structs, SAMPLED + OF_STRUCTS),
    "mat-7.3-structs": ("run.mat", write_mat73_of_structs, SAMPLED + OF_STRUCTS),
    "hdf5": ("run.h5", write_mat73, SAMPLED + named('"run.x"', '"run.v"')),
    "mat-7.3": ("run.mat", write_mat73, SAMPLED + named('"run.x"', '"run.v"')),
    "wav": ("run.wav", write_wav, BEGIN + named("1", "2", "3")),
    "uff": ("run.uff", write_uff, BEGIN + without_units(CHANNELS)),
    "tdms": ("run.tdms", write_tdms, without_units(named('"x"', '"run/v"'))),
    "mf4": ("run.mf4", write_mf4, without_units(named('"x"', '"0/v"'))),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # pyuff's own
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_file_written_by_the_formats_own_library_is_imported_unchanged(case: str, tmp_path: Path) -> None:
    name, write, mapping = CASES[case]
    time, x, v, angle = signals(COUNT)
    write(tmp_path / name, {"t": time, "x": x, "v": v, "a": angle})
    done, recording = imported(tmp_path, tmp_path / name, mapping)
    (found,) = stretches(recording)
    assert found.start_ns == START_NS
    assert done.read.rows == done.written.samples == COUNT
    np.testing.assert_array_equal(found.samples, np.column_stack([x, v, angle]))
    first = next(read_recording(recording))
    assert (first.key, first.payload.decode()) == (machine().keys.descriptor, machine().descriptor.model_dump_json())


@pytest.mark.parametrize(
    ("dtype", "largest"), [(np.int16, 2.0**15), (np.int32, 2.0**31), (np.uint8, 2.0**7), (np.float32, 1.0)]
)
def test_wav_integers_are_fractions_of_full_scale(tmp_path: Path, dtype: type[np.generic], largest: float) -> None:
    fraction = np.sin(np.arange(4000) * 0.07) * 0.9
    offset = 128 if dtype is np.uint8 else 0
    whole = np.rint(fraction * largest) if largest > 1 else fraction
    wavfile.write(tmp_path / "run.wav", 2000, np.column_stack([(whole + offset).astype(dtype)] * 3))
    mapping = BEGIN + named("1", "2", "3").replace('"um"', '"um", scale = 250.0')
    _, recording = imported(tmp_path, tmp_path / "run.wav", mapping)
    exact = 1e-6 if dtype is np.float32 else 1e-12
    np.testing.assert_allclose(stretches(recording)[0].samples[:, 0], whole / largest * 250, rtol=exact)


@pytest.mark.parametrize(("of", "zone", "late_h"), [("Europe/Berlin", "", 0), (None, "America/New_York", 5)])
def test_dates_in_a_parquet_file_have_their_own_time_zone_or_the_mappings(
    tmp_path: Path, of: str | None, zone: str, late_h: int
) -> None:
    _, x, v, angle = signals(3000)
    time = pa.array(START_NS + 500_000 * np.arange(3000), type=pa.timestamp("ns", tz=of))
    pa.parquet.write_table(pa.table({"t": time, "x": x, "v": v, "a": angle}), tmp_path / "run.parquet")
    mapping = '[time]\ncolumn = "t"\nunit = "datetime"\n' + (f'zone = "{zone}"\n' if zone else "") + CHANNELS
    (found,) = stretches(imported(tmp_path, tmp_path / "run.parquet", mapping)[1])
    assert found.start_ns == START_NS + late_h * 3600 * 10**9
    np.testing.assert_array_equal(found.samples, np.column_stack([x, v, angle]))


def test_a_start_without_a_time_zone_is_in_that_of_the_mapping(tmp_path: Path) -> None:
    _, x, v, a = signals(3000)
    np.savez(tmp_path / "run.npz", x=x, v=v, a=a)
    mapping = f'{SAMPLED.replace(START, START[:-1])}zone = "America/New_York"\n{CHANNELS}'
    (found,) = stretches(imported(tmp_path, tmp_path / "run.npz", mapping)[1])
    assert found.start_ns == START_NS + 5 * 3600 * 10**9


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # asammdf's own
@pytest.mark.parametrize("form", ["npz", "mf4", "mdf"])
def test_dates_without_a_time_zone_are_in_that_of_the_mapping(tmp_path: Path, form: str) -> None:
    import asammdf  # noqa: PLC0415  # it takes seconds, and every worker reads this module

    t, x, v, a = signals(3000)
    path = tmp_path / f"run.{form}"
    if form == "npz":
        dates = np.datetime64("2026-01-31T12:00:00", "us") + 500 * np.arange(3000)
        np.savez(path, t=dates, x=x, v=v, a=a)
    else:
        with asammdf.MDF(version={"mf4": "4.10", "mdf": "2.14"}[form]) as file:
            file.start_time = datetime(2026, 1, 31, 12)  # the file says local time, without a zone
            columns = zip(UNITS, (x, v, a), strict=True)
            file.append([asammdf.Signal(column, t, name=name, unit=unit) for (name, unit), column in columns])
            file.save(path)
    rest = f'column = "t"\nunit = "datetime"\n{CHANNELS}' if form == "npz" else without_units(CHANNELS)
    mapping = f'[time]\nzone = "America/New_York"\n{rest}'
    (found,) = stretches(imported(tmp_path, path, mapping)[1])
    assert found.start_ns == START_NS + 5 * 3600 * 10**9
    np.testing.assert_array_equal(found.samples, np.column_stack([x, v, a]))


@pytest.mark.parametrize(
    "written", ["dates", "bare dates", "mixed dates", "local dates", "German dates", "nanoseconds", "milliseconds"]
)
def test_columns_of_a_text_table_without_names_are_numbered(tmp_path: Path, written: str) -> None:
    _, x, v, angle = signals(3000)
    with (tmp_path / "run.csv").open("w", encoding="utf-8") as file:
        for row in range(3000):
            time_ns = START_NS + 500_000 * row
            second, rest = divmod(time_ns, 1_000_000_000)
            date = f"{datetime.fromtimestamp(second, UTC):%Y-%m-%dT%H:%M:%S}.{rest:09d}"
            ahead = f"{datetime.fromtimestamp(second + 3600, UTC):%Y-%m-%d %H:%M:%S}.{rest:09d}+01:00"
            texts = {
                "dates": f"{date}Z",
                "bare dates": date.replace("T", " "),
                "mixed dates": (date, f"{date}Z", ahead)[row % 3],
                "local dates": (ahead.removesuffix("+01:00"), ahead, f"{date}Z")[row % 3],
                "German dates": f'"{datetime.fromtimestamp(second, UTC):%d.%m.%Y %H:%M:%S},{rest:09d}"',
                "nanoseconds": str(time_ns),
                "milliseconds": str(row / 2),
            }
            file.write(f"{texts[written]},{float(x[row])!r},{float(v[row])!r},{float(angle[row])!r}\n")
    times = {"nanoseconds": 'unit = "ns"\nstart = "unix"', "milliseconds": f'unit = "ms"\nstart = "{START}"'}
    times["local dates"] = 'unit = "datetime"\nzone = "Europe/Berlin"'
    told = times.get(written, 'unit = "datetime"')
    mapping = f"[time]\ncolumn = 1\n{told}\n[csv]\nheader = false\n" + CHANNELS.replace('"x"', "2")
    mapping = mapping.replace('"v"', "3").replace('"a"', "4")
    (found,) = stretches(imported(tmp_path, tmp_path / "run.csv", mapping)[1])
    assert found.start_ns == START_NS
    np.testing.assert_array_equal(found.samples, np.column_stack([x, v, angle]))


def test_a_long_parquet_file_is_not_kept_in_memory(tmp_path: Path) -> None:
    column = np.random.default_rng(1).standard_normal(2_000_000)
    pa.parquet.write_table(pa.table({"x": column}), tmp_path / "run.parquet", row_group_size=100_000)
    del column
    before = pa.total_allocated_bytes()
    rows, most = 0, 0
    for (chunk,) in ParquetSource(tmp_path / "run.parquet").chunks([Reference("x")]):
        rows += chunk.size
        most = max(most, pa.total_allocated_bytes() - before)
    assert rows == 2_000_000
    assert most < 8e6  # of 16 MB


def test_pickled_objects_are_not_loaded(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", x=np.array([{"a": 1}], dtype=object))
    with pytest.raises(SourceError, match="no column 'x'; there are none"):
        imported(tmp_path, tmp_path / "run.npz", SAMPLED + CHANNELS)


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # pyuff's own
@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda content: content[:-100], "no data set 'a'; there are set 1, set 2, x, v; the file is truncated"),
        (lambda content: content.replace(b"         4      1000", b"         4      1200"),
         "run.uff: is truncated: 1000 samples of x are there, expected the 1200"),
    ],
    ids=["cut off", "fewer samples than its header says"],
)  # fmt: skip
def test_a_truncated_data_set_is_named(tmp_path: Path, spoil: Callable[[bytes], bytes], said: str) -> None:
    t, x, v, a = signals(1000)
    write_uff(tmp_path / "run.uff", {"t": t, "x": x, "v": v, "a": a})
    whole = (tmp_path / "run.uff").read_bytes()
    (tmp_path / "run.uff").write_bytes(spoil(whole))
    assert spoil(whole) != whole
    with pytest.raises(SourceError, match=said):
        imported(tmp_path, tmp_path / "run.uff", BEGIN + without_units(CHANNELS))


@pytest.mark.parametrize("suffix", ["csv", "parquet", "npz", "mat", "wav", "uff", "tdms", "mf4"])
def test_a_file_that_is_not_of_its_format_is_named(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"broken.{suffix}"
    path.write_bytes(b"\x00\xff\x13 this is not it" * 30)
    with pytest.raises(SourceError, match=r"broken\."):
        imported(tmp_path, path, SAMPLED + CHANNELS)
    assert not list(tmp_path.glob("*.mcap*"))


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # asammdf's own
@pytest.mark.parametrize(
    ("name", "write", "told"),
    [
        ("run.mf4", write_mf4, r"run\.mf4: damaged, or no MF4 file: .*"),
        ("run.tdms", write_tdms, r"has \d+ rows, .*; the file ends within a segment: it is truncated"),
    ],
)
def test_a_truncated_file_is_named_without_library_warnings(
    tmp_path: Path, name: str, write: Callable[[Path, Columns], None], told: str
) -> None:
    write(tmp_path / name, dict(zip("txva", signals(1000), strict=True)))
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-2000])
    with pytest.raises(SourceError, match=told):
        imported(tmp_path, tmp_path / name, CHANNELS)
    gc.collect()  # unclosed files would warn now


def test_the_error_for_an_unknown_format_lists_the_known_ones(tmp_path: Path) -> None:
    (tmp_path / "run.xyz").write_text("1,2")
    with pytest.raises(SourceError, match=r"'\.xyz' is not known.*\.tdms"):
        imported(tmp_path, tmp_path / "run.xyz", SAMPLED + CHANNELS)


def test_a_tdms_file_whose_writer_was_killed_is_read_and_noted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    t, x, v, a = signals(1000)
    path = tmp_path / "run.tdms"
    write_tdms(path, {"t": t, "x": x, "v": v, "a": a})
    first = path.read_bytes()
    path.write_bytes(
        first[:12] + bytes(8 * [255]) + first[20 : first.index(b"TDSm", 28)]
    )  # its length is not known yet
    done, recording = imported(tmp_path, path, CHANNELS)
    (found,) = stretches(recording)
    np.testing.assert_array_equal(found.samples, np.column_stack([x, v, a]))
    assert "note: run.tdms was not finished by its writer, or is truncated" in "\n".join(summary_lines(done))
    assert not caplog.records  # no warning of the library besides


def test_measurements_that_were_appended_to_a_tdms_file_are_refused(tmp_path: Path) -> None:
    with nptdms.TdmsWriter(str(tmp_path / "run.tdms")) as writer:
        writer.write_segment([nptdms.RootObject({"title": "two runs"})])
        for start in ("2026-01-31T12:00:00", "2026-01-31T13:00:00"):
            known = {"wf_increment": 1 / RATE_HZ, "wf_start_time": np.datetime64(start, "us"), "wf_start_offset": 0.0}
            columns = zip("xva", signals(1000)[1:], strict=True)
            writer.write_segment([nptdms.ChannelObject("run", name, column, known) for name, column in columns])
    with pytest.raises(SourceError, match=r"channel x begins at 2026-01-31T12:00:00.* and anew at 2026-01-31T13:00:00"):
        imported(tmp_path, tmp_path / "run.tdms", CHANNELS)
