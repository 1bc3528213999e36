"""Mistakes in a mapping, a file or a command are named; acceleration is integrated exactly above its limit."""

import re
from pathlib import Path

import nptdms
import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from scipy.io import wavfile

from models.errors import MachineFileError
from models.machine import load_machine_file
from models.signals.block import integrated, lowest_valid_hz, settling_s
from models.signals.channels import unit_factor
from service.interchange.importing import summary_lines
from tests.interchange.material import (
    CHANNELS,
    GOOD,
    HEADER,
    SAMPLED,
    START,
    START_NS,
    TEXT,
    TIME,
    archive,
    fault,
    good_rows,
    imported,
    machine,
    signals,
    stretches,
    summary,
    table,
    with_cell,
)
from tests.service.rig.preloaded import rotorwatch as run

IN_ORDER = CHANNELS.replace('"x"', "1").replace('"v"', "2").replace('"a"', "3")
"""Channels by column number, for files without names."""
GERMAN = [row.replace(",", ";").replace(".", ",") for row in GOOD]


@pytest.mark.parametrize(("start", "day"), [("datenum", 740013.5), ("1899-12-30T00:00:00Z", 46053.5)])
def test_day_numbers_of_matlab_and_spreadsheets_are_times(tmp_path: Path, start: str, day: float) -> None:
    rows = [f"{day + number / 2000 / 86_400:.12f},{row.partition(',')[2]}" for number, row in enumerate(GOOD)]
    mapping = TEXT.replace(START, start).replace("[time]", '[time]\nunit = "d"')
    done, _ = imported(tmp_path, table(tmp_path / "run.csv", rows), mapping)
    assert abs(done.written.start_ns - START_NS) < 20_000  # 740013.5 has no more digits as a float
    assert done.written.samples == 1000
    assert done.clock.rate_hz == pytest.approx(2000, rel=1e-4)


@pytest.mark.parametrize(
    ("rows", "mapping", "header", "said"),
    [
        (GOOD, TEXT, "t,x,speed,a", ("run.csv: no column 'v'; there are t, x, speed, a",)),
        (GOOD, TEXT.replace('"t"', '"t"\nzone = "CET+1"'), HEADER, ("time: zone 'CET+1' is not known, expected",)),
        (GOOD, TEXT, "t,x,V [mm/s],a", ("there are t, x, V [mm/s], a; did you mean 'V [mm/s]'?",)),
        (GOOD, TEXT.replace('"v"', '"velocty"'), "t,x,velocity,a", ("did you mean velocity?",)),
        (GOOD, re.sub("y1_dot = .*", "", TEXT), HEADER, (
            "channels.y1_dot: expected [channels.y1_dot] or [acceleration.channels.y1_dot], found nothing",
        )),
        *((with_cell(cell), TEXT, HEADER, (
            f"row 737, column 'v': found {cell!r}, expected a number, or csv.missing in the mapping",
        )) for cell in ("OVERLOAD", "1.2.3", "--")),
        (with_cell('"1,899.62"'), TEXT, HEADER, ("found '1,899.62', expected a number without separators of thou",)),
        (["s,um,mm/s,rad", *GOOD], TEXT, HEADER, ("row 1, column 't': found 's'", "csv.skip_lines_after_header in",)),
        (GOOD, "[csv]\nheader = false\n" + TIME.replace('"t"', '"1"') + IN_ORDER, HEADER, (
            "row 1, column '1': found 't', expected a number", "or names with csv.header = true",
        )),
        (GOOD[1:], TEXT, GOOD[0], ("no column 't'", "the first line has numbers", "header = false in [csv]")),
        (GERMAN, '[csv]\ndelimiter = ";"\n' + TEXT, "t;x;v;a", (
            "row 1, column 't': found '0,0'", "or decimal commas with csv.decimal in the mapping",
        )),
        (
            [*GERMAN[:736], GERMAN[736].replace(",", "."), *GERMAN[737:]],
            '[csv]\ndelimiter = ";"\ndecimal = ","\n' + TEXT, "t;x;v;a",
            ("run.csv: row 737, column 't': found '0.368', expected a number",),
        ),
        ([*GOOD[:500], "0.25,1.0", *GOOD[501:]], TEXT, HEADER, (
            "run.csv: ", "row 501: Expected 4 columns, got 2: 0.25,1.0; delete this line if it is no whole row",
        )),
        ([*GOOD, "End of data"], TEXT, HEADER, ("row 1001: Expected 4 columns, got 1: End of data; delete this line",)),
        # Bytes that are no text are not sent to the terminal.
        ([*GOOD[:5], "\x1b[2J\x07", *GOOD[5:]], TEXT, HEADER, (
            "row 6: Expected 4 columns, got 1: \N{REPLACEMENT CHARACTER}[2J\N{REPLACEMENT CHARACTER};",
        )),
        ([f"{row},0" for row in GOOD], TEXT, f"{HEADER},v", (
            "run.csv: there are several columns named 'v', expected a name of its own for each: change them",
        )),
        (GERMAN, TEXT, "t;x;v;a", (
            "run.csv: damaged, or no CSV file",
            "taken as utf-8 with ',' between cells and 0 lines before the table: [csv] in the mapping says otherwise",
        )),
        ([*GOOD[:600], GOOD[601], GOOD[600], *GOOD[602:]], TEXT, HEADER, (
            "row 602, column t: goes back by 0.0005 s",
        )),
        *(([*GOOD[:at], "7e306,1.0,2.0,3.0", *GOOD[at + 1:]], TEXT, HEADER, (
            f"row {at + 1}, column t: found 7e+306, expected a time",
        )) for at in (1, 600)),
        ([*GOOD[:500], *GOOD[500::2]], TEXT, HEADER, (
            "run.csv: from row 502 on, rows are isolated at 2000 Hz", "time.resample", "time.fill_gaps_up_to_s",
        )),
        # Times with too few decimals.
        ([f"{number // 2 * 0.001:.3f},1.0,2.0,3.0" for number in range(1000)], TEXT, HEADER, (
            "row 2, column t: repeats the time of the row before", "time.rate_hz",
        )),
        (good_rows(5000, 5000.0), TEXT, HEADER, (
            "run.csv: has 5000 samples per second, the machine file says rate_hz = 2000", "time.resample = true",
        )),
        (GOOD, TIME + "rate_hz = 1000.0\n" + CHANNELS, HEADER, (
            "column t has 2000 rows per second, but 1000 are declared",
        )),
        ([f"{number / 1980.2:.5f},1.0,2.0,3.0" for number in range(1000)], TEXT, HEADER, (
            "run.csv: has 1980.22 samples per second",
        )),
        (["01/31/2026 12:00:00,1.0,2.0,3.0"], TEXT.replace(f'start = "{START}"', 'unit = "datetime"'), HEADER, (
            "found '01/31/2026 12:00:00', expected an ISO 8601 time, or no time column but time.start and time.rate_hz",
        )),
        ([f"2026-01-31T12:00:{number / 2000:09.6f},1.0,2.0,3.0" for number in range(1000)], TEXT, HEADER, (
            "row 1, column 't': found '2026-01-31T12:00:00.000000', expected a number", 'time.unit = "datetime"',
        )),
        *((good_rows(count), TEXT, HEADER, (f"run.csv: has {count} rows, expected at least two",)) for count in (0, 1)),
        (["0,1,2,3", "1,1,2,3", "11,1,2,3"], TEXT, HEADER, ("run.csv: has 1 samples per second, the",)),
        (GOOD, TEXT.replace(f'start = "{START}"', ""), HEADER, ("give time.start in the mapping",)),
        *((GOOD, TEXT.replace(START, f"{year}-01-01T00:00:00Z"), HEADER, (
            f"run.csv: the first row is of about the year {year}, expected 1970 to 2261",
        )) for year in (1900, 2300, 9999)),
    ],
    ids=[
        *("missing column", "zone", "unit in the name", "misspelt", "unmapped channel", "text", "two dots"),
        *("no number", "thousands", "unit line", "names", "no names", "comma", "decimal point", "short row"),
        *("last line", "no text", "same name", "other signs"),
        *("time goes back", "no second time", "no time", "half the rate", "few decimals"),
        *("other rate", "rate contradicts times", "five decimals", "slashes", "dates"),
        *("no row", "one row", "uneven", "no start", "1900", "2300", "9999"),
    ],
)  # fmt: skip
def test_mistakes_in_a_table_are_named(
    tmp_path: Path, rows: list[str], mapping: str, header: str, said: tuple[str, ...]
) -> None:
    text = fault(tmp_path, rows, mapping, header)
    assert all(part in text for part in said), text


def test_a_file_of_another_rate_is_refused_before_its_gaps_fill_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.interchange.samples._MANY_ALONE", 50)
    rows = good_rows(4000)
    assert "from row 3602 on, rows are isolated at 2000 Hz, 99 of them" in fault(
        tmp_path, rows[:3600] + rows[3600::2], TEXT
    )


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"um"', '"mm/s"', r"channels.y1.unit: unit 'mm/s' is a unit of velocity, not of displacement"),
        ('"um"', '"mil pp"', "is that of an overall value (pp)"),
        ('"mm/s"', '"mm/s rms"', "is that of an overall value (rms)"),
        ("12:00:00Z", "12:00:00", "has no time zone, expected UTC such as 2026-01-31 12:00:00Z, or local time with"),
        (f'"{START}"', '"1899-12-30T00:00:00"\nzone = "Europe/Berlin"', "1899-12-30T00:00:00 has no time zone"),
        ('"um"', '"mV"', "of a sensor's voltage, give unit and scale in the mapping"),
        (
            '"rad"',
            '"rpm"',
            "a speed is no angle: leave the channel out, and give speed_rpm in [operation] of the machine",
        ),
        ('{ column = "x", unit = "um" }', '{ column = "x", unit = "um", scale = 0 }', "scale is 0"),
        ("[channels]", '[keyphasor]\npulse_times = "k"\n[channels]', "channels.theta: expected [channels.theta], or a"),
        ('"v"', '"x"', "channels.y1_dot: column 'x' is that of channel y1 already; expected that of another sensor"),
        ("[channels]", "[keyphasor]\n[channels]", "keyphasor: expected either pulse_times or column"),
    ],
)
def test_a_wrong_mapping_is_named_by_field(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in TEXT
    text = fault(tmp_path, GOOD, TEXT.replace(old, new, 1))
    assert "mapping.toml: " in text
    assert said in text


@pytest.mark.parametrize("number", [np.float32, np.int16])
def test_a_truncated_wav_file_is_refused_with_its_sample_counts(tmp_path: Path, number: type) -> None:
    samples: np.ndarray = np.random.default_rng(60161).uniform(-100, 100, (1000, 3)).astype(number)
    wavfile.write(tmp_path / "run.wav", 2000, samples)
    mapping = f'[time]\nstart = "{START}"\n' + IN_ORDER
    done, _ = imported(tmp_path, tmp_path / "run.wav", mapping)
    assert done.written.samples == 1000
    whole = (tmp_path / "run.wav").read_bytes()
    (tmp_path / "run.wav").write_bytes(whole[: -400 * samples[0].nbytes])
    said = "is truncated: 600 samples of each channel are there, expected the 1000"
    with pytest.raises(MachineFileError, match=said):
        imported(tmp_path, tmp_path / "run.wav", mapping)
    # Its writer was killed before it knew the length.
    size_at = whole.index(b"data") + 4
    (tmp_path / "run.wav").write_bytes(whole[:size_at] + bytes(4) + whole[size_at + 4 :])
    with pytest.raises(MachineFileError, match="was not finished: its header says 0 samples, but 1000 of each channel"):
        imported(tmp_path, tmp_path / "run.wav", mapping)


def test_a_unit_that_contradicts_the_file_is_refused(tmp_path: Path) -> None:
    content = pa.table(dict(zip("txva", signals(1000), strict=True)))
    in_mil = content.schema.set(1, pa.field("x", pa.float64(), metadata={"unit": "mil"}))
    pa.parquet.write_table(content.cast(in_mil), tmp_path / "run.parquet")
    with pytest.raises(MachineFileError, match="column x is in 'mil' according to the file, but in 'um'"):
        imported(tmp_path, tmp_path / "run.parquet", TEXT)


@pytest.mark.parametrize("cell", ["", "NaN", "inf"])
def test_a_number_that_is_not_finite_is_refused_or_a_gap(tmp_path: Path, cell: str) -> None:
    assert "row 737, column v: found" in fault(tmp_path, with_cell(cell))
    mapping = TIME + 'not_finite = "gap"\n' + CHANNELS
    done, _ = imported(tmp_path, table(tmp_path / "run.csv", with_cell(cell)), mapping)
    assert done.read.left_out == 1
    assert [gap.row for gap in done.read.gaps] == [737]
    assert done.written.samples == 999


@pytest.mark.parametrize(
    ("rate_hz", "wish", "said"),
    [
        (48000, "rate_hz = 2000.0", "the file says 48000 samples per second, the mapping 2000"),
        (19997, "resample = true", "19997 and 2000 samples per second are not in a ratio of whole numbers"),
    ],
)
def test_a_contradictory_or_unusable_header_rate_is_refused(tmp_path: Path, rate_hz: int, wish: str, said: str) -> None:
    wavfile.write(tmp_path / "run.wav", rate_hz, np.zeros((1000, 3), dtype=np.float32))
    with pytest.raises(MachineFileError, match=said):
        imported(tmp_path, tmp_path / "run.wav", f'[time]\n{wish}\nstart = "{START}"\n{IN_ORDER}')


@pytest.mark.parametrize("rate_hz", [51200 / 3, 1024.5])
def test_a_rate_rounded_in_the_header_is_taken_from_the_mapping(tmp_path: Path, rate_hz: float) -> None:
    wavfile.write(tmp_path / "run.wav", round(rate_hz), np.zeros((20_000, 3), dtype=np.float32))
    mapping = f'[time]\nrate_hz = {rate_hz!r}\nstart = "{START}"\n{IN_ORDER}'
    done, _ = imported(tmp_path, tmp_path / "run.wav", mapping, machine(rate_hz=rate_hz, window={}))
    assert done.clock.rate_hz == rate_hz


def test_times_that_are_still_to_come_are_pointed_out(tmp_path: Path) -> None:
    assert "still to come" not in summary(tmp_path, table(tmp_path / "run.csv", GOOD), TEXT)
    since_1970 = [f"{1767225600 + number / 2000:.6f},{row.partition(',')[2]}" for number, row in enumerate(GOOD)]
    said = summary(tmp_path, table(tmp_path / "epoch.csv", since_1970), TEXT)
    assert 'still to come; where a time column counts from 1970, give time.start = "unix"' in said


def test_an_index_outside_the_table_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", x=np.zeros((1000, 3)))
    mapping = SAMPLED + CHANNELS.replace('"x"', '"x", index = 3')
    mapping = mapping.replace('"v"', '"x", index = 1').replace('"a"', '"x", index = 2')
    with pytest.raises(MachineFileError, match=r"x has 3 columns of 1000 samples, expected index = 0 to 2 \(found 3\)"):
        imported(tmp_path, tmp_path / "run.npz", mapping)


def test_blanks_around_csv_column_names_are_ignored(tmp_path: Path) -> None:
    done, _ = imported(tmp_path, table(tmp_path / "run.csv", GOOD, "t, x, v , a"), TEXT)
    assert done.written.samples == 1000


def test_a_header_in_another_encoding_is_refused_naming_the_setting(tmp_path: Path) -> None:
    source = tmp_path / "run.csv"
    source.write_bytes("\n".join(["t,x,v,a,µ", *(f"{row},0" for row in GOOD), ""]).encode("latin-1"))
    with pytest.raises(MachineFileError, match=r"run.csv: .*taken as utf-8 .*\[csv\] in the mapping .* encoding"):
        imported(tmp_path, source, TEXT)
    done, _ = imported(tmp_path, source, '[csv]\nencoding = "latin-1"\n' + TEXT)
    assert done.written.samples == 1000


def test_a_table_in_utf_16_is_named(tmp_path: Path) -> None:
    source = table(tmp_path / "run.csv", GOOD)
    source.write_text(source.read_text(encoding="utf-8"), encoding="utf-16")
    with pytest.raises(MachineFileError, match=r"run\.csv: is in UTF-16; write encoding = \"utf-16\" in \[csv\]"):
        imported(tmp_path, source, TEXT)
    assert imported(tmp_path, source, f'[csv]\nencoding = "utf-16"\n{TEXT}')[0].written.samples == 1000


def test_a_number_that_the_samples_of_the_machine_cannot_hold_is_refused(tmp_path: Path) -> None:
    source = table(tmp_path / "run.csv", with_cell("-1e39"))
    with pytest.raises(MachineFileError, match=r"row 737, column v: found -1e\+39, .* up to 3.4e\+38"):
        imported(tmp_path, source, TEXT, machine(dtype="float32"))
    done, _ = imported(tmp_path, source, TEXT)
    assert done.written.samples == 1000


def test_a_wav_file_without_a_rate_in_its_header_needs_one_in_the_mapping(tmp_path: Path) -> None:
    source = tmp_path / "run.wav"
    wavfile.write(source, 2000, np.zeros((1000, 3), dtype=np.float32))
    source.write_bytes(source.read_bytes()[:24] + bytes(4) + source.read_bytes()[28:])
    mapping = f'[time]\nstart = "{START}"\n' + IN_ORDER
    with pytest.raises(MachineFileError, match=r"the rate is not known; give time.column or time.rate_hz"):
        imported(tmp_path, source, mapping)
    done, _ = imported(tmp_path, source, mapping.replace("[time]", "[time]\nrate_hz = 2000.0"))
    assert done.written.samples == 1000


def test_unusable_rate_and_time_texts_of_a_tdms_file_are_left_to_the_mapping(tmp_path: Path) -> None:
    source = tmp_path / "run.tdms"
    told = {"wf_increment": "0,0005", "wf_start_time": "31.01.2026 12:00"}
    with nptdms.TdmsWriter(source) as writer:
        columns = zip("xva", signals(1000)[1:], strict=True)
        writer.write_segment([nptdms.ChannelObject("run", name, column, told) for name, column in columns])
    with pytest.raises(MachineFileError, match=r"the rate is not known"):
        imported(tmp_path, source, CHANNELS)
    with pytest.raises(MachineFileError, match=r"give time.start in the mapping"):
        imported(tmp_path, source, f"[time]\nrate_hz = 2000.0\n{CHANNELS}")
    done, _ = imported(tmp_path, source, SAMPLED + CHANNELS)
    assert done.written.samples == 1000


def test_a_single_number_is_no_channel_and_a_single_array_no_archive(tmp_path: Path) -> None:
    mapping = SAMPLED + CHANNELS
    np.savez(tmp_path / "run.npz", x=3.0, v=np.zeros(1000), a=np.zeros(1000))
    with pytest.raises(MachineFileError, match=r"run.npz: x has shape \(\), expected one column"):
        imported(tmp_path, tmp_path / "run.npz", mapping)
    with (tmp_path / "run.npz").open("wb") as file:
        np.save(file, np.zeros((1000, 3)))
    with pytest.raises(MachineFileError, match="a single array, expected an archive of named arrays"):
        imported(tmp_path, tmp_path / "run.npz", mapping)


def test_measurements_are_not_overwritten_by_their_own_recording(tmp_path: Path) -> None:
    source = table(tmp_path / "imported.mcap", GOOD)
    before = source.read_bytes()
    with pytest.raises(MachineFileError, match=r"imported.mcap: is what is imported, expected another name"):
        imported(tmp_path, source, 'format = "csv"\n' + TEXT)
    assert source.read_bytes() == before


ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "docs" / "examples" / "fe_rotor"


def sample(path: Path) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Write a file as the example's mapping expects it; return its samples in µm and mm/s."""
    time = np.arange(20_000) / 2000.0
    angle = 2 * np.pi * 1773 / 60 * time
    motion = np.column_stack(
        [4e-5 * np.cos(angle + k) for k in range(4)] + [5e-3 * np.sin(angle + k) for k in range(4)]
    )
    scale = np.abs(motion).max(axis=0) / 32000
    q = np.rint(motion / scale).astype(np.int16)
    pulses = np.arange(0, 10, 60 / 1773)
    np.savez(path, q=q, scale=scale, fs=2000.0, key_pulse_s=pulses, speed_rpm=1773.0, channels=np.array(["y1"]))
    return np.asarray(q * scale * np.r_[np.full(4, 1e6), np.full(4, 1e3)])


def test_the_documented_example_is_imported_and_exported(tmp_path: Path) -> None:
    expected = sample(tmp_path / "healthy.npz")
    recording, machine = tmp_path / "healthy.mcap", EXAMPLE / "machine.toml"
    found = run(
        *("import", tmp_path / "healthy.npz", "--mapping", EXAMPLE / "mapping.toml", "--machine", machine),
        *("--out", recording),
    )
    assert found.returncode == 0, found.stderr
    assert "20000 samples in 100 blocks, 2026-01-01T00:00:00.000000Z to 2026-01-01T00:00:10.000000Z" in found.stdout
    assert "gaps: none" in found.stdout
    assert "keyphasor: 296 pulses, 1773 rpm on average" in found.stdout
    (stretch,) = stretches(recording, load_machine_file(machine))
    np.testing.assert_allclose(stretch.samples[:, :8], expected, rtol=1e-6, atol=1e-6)
    out = tmp_path / "healthy.parquet"
    found = run("export", recording, "--to", "parquet", "--out", out, "--to-time", "2026-01-01T00:00:02Z")
    assert found.returncode == 0, found.stderr
    assert f"{out}: 4000 rows, 10 columns" in found.stdout
    assert pyarrow.parquet.read_metadata(out).num_rows == 4000
    second = ("--from", "0.5", "--to-time", "1.5", "--key", "example/fe-rotor", "--overwrite")
    assert f"{out}: 2000 rows" in run("export", recording, "--to", "parquet", "--out", out, *second).stdout
    refused = run("export", recording, "--to", "parquet", "--out", tmp_path / "none", "--from", "yesterday")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert "--from is 'yesterday', expected seconds after the start of the data, such as 90" in refused.stderr


def test_importing_a_folder_with_a_bad_file_exits_1(tmp_path: Path) -> None:
    folder, mapping, recording = tmp_path / "files", tmp_path / "mapping.toml", tmp_path / "run.mcap"
    folder.mkdir()
    sample(folder / "20260101T000000.npz")
    (folder / "20260101T000100.npz").write_bytes(b"")
    mapping.write_text(
        re.sub("start = .*", "", (EXAMPLE / "mapping.toml").read_text(encoding="utf-8")), encoding="utf-8"
    )
    machine = EXAMPLE / "machine.toml"
    found = run("import", folder, "--mapping", mapping, "--machine", machine, "--out", recording)
    assert found.returncode == 1
    assert f"{recording}: 20000 samples in 100 blocks" in found.stdout
    assert found.stderr.startswith(f"left out: {folder}/20260101T000100.npz: damaged, or no NumPy .npz file")
    assert found.stderr.count("\n") == 1
    again = run("import", folder, "--mapping", mapping, "--machine", machine, "--out", recording)
    assert (again.returncode, again.stderr) == (2, f"{recording}: already exists; --overwrite replaces it\n")


@pytest.mark.parametrize("command", ["import", "export"])
def test_help_has_an_example(command: str) -> None:
    assert "Example" in run(command, "--help").stdout


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


def test_motion_far_below_the_limit_is_integrated_to_zero() -> None:
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
    acc = acceleration / unit_factor("acceleration", "g") + 0.02
    done, recording = imported(tmp_path, archive(tmp_path, acc=acc, a=np.mod(one * time, 2 * np.pi)), MAPPING)
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


def test_an_integration_limit_within_the_machines_band_is_noted(tmp_path: Path) -> None:
    source = archive(tmp_path, acc=np.sin(np.arange(40_000) * 0.1), a=np.zeros(40_000))
    told = summary(tmp_path, source, MAPPING.replace("= 1.5", "= 5.0"))
    assert "window.band_hz = 3 Hz on, which is below 10 Hz" in told


def test_a_record_shorter_than_the_filter_settles_and_a_velocity_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", acc=np.sin(np.arange(10_000) * 0.1), a=np.zeros(10_000))
    for mapping, said in (
        (MAPPING, "10000 of them at the ends where filters settle"),
        (MAPPING.replace('"g"', '"mm/s"', 1), "'mm/s' is a unit of velocity, not of acceleration"),
    ):
        with pytest.raises(MachineFileError, match=said):
            imported(tmp_path, tmp_path / "run.npz", mapping)
