"""A folder of snapshot files is imported as one recording, in the order of the files' times."""

from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import nptdms
import numpy as np
import pytest

from service.interchange.importing import summary_lines
from service.interchange.source import SourceError
from tests.interchange.material import CHANNELS, RATE_HZ, START_NS, imported, machine, signals, stretches, summary

ON_S, EVERY_S, FILES = 2.0, 20.0, 12
COUNT = round(ON_S * RATE_HZ)
KIT = machine(schedule={"on_s": ON_S, "every_s": EVERY_S}, window={}, ingest={})
BEGIN = datetime(2026, 1, 31, 12, tzinfo=UTC)
NAMED = f"\n[time]\nrate_hz = 2000.0\n{CHANNELS}"
START = 'start = "2026-01-31T12:00:00Z"\nrate_hz'
NUMBERED = NAMED.replace("rate_hz", START)
DATED = NAMED.replace("rate_hz = 2000.0", 'column = "t"\nunit = "ns"\nstart = "unix"')
KEYPHASOR = f"{NAMED}\n[keyphasor]\n".replace("theta =", "# =")
PULSE_TIMES = f'{KEYPHASOR}pulse_times = "p"\nunit = "s"\n'
PULSES = f'{KEYPHASOR}column = "k"\nthreshold = 0.5\n'
_COLUMNS = signals(COUNT * FILES)[1:]


def by_date(number: int) -> str:
    return f"pump {BEGIN + timedelta(seconds=number * EVERY_S):%Y-%m-%d %H.%M.%S}.npz"


def by_number(number: int) -> str:
    return f"acc_{number + 1}.npz"  # acc_10 comes before acc_2 in the alphabet


def write(folder: Path, name: Callable[[int], str], numbers: range = range(FILES), every_s: float = EVERY_S) -> Path:
    """Snapshots of one motion, the newest written first."""
    folder.mkdir()
    (folder / "notes.docx").write_bytes(b"not a measurement")
    for number in reversed(numbers):
        rows = slice(number * COUNT, (number + 1) * COUNT)
        x, v, a = (column[rows] for column in _COLUMNS)
        t = START_NS + round(number * every_s * 1e9) + np.arange(COUNT) * 500_000
        passed = np.flatnonzero(np.diff(a) < 0)
        share = (2 * np.pi - a[passed]) / (a[passed + 1] + 2 * np.pi - a[passed])
        # A pulse signal that crosses one half where the angle passes zero.
        k = np.where(a < np.pi, np.minimum(a, 0.5), np.maximum(a - 2 * np.pi, -0.5)) + 0.5
        p = (passed + share) / RATE_HZ
        np.savez(folder / name(number), x=x, v=v, a=a, t=t, k=k, p=p, q=t[0] + np.rint(p * 1e9).astype(np.int64))
    return folder


def times(numbers: Iterable[int]) -> list[int]:
    return [START_NS + round(number * EVERY_S * 1e9) for number in sorted(numbers)]


def begun(recording: Path) -> list[int]:
    return [one.start_ns for one in stretches(recording, KIT)]


@pytest.mark.parametrize(("name", "mapping"), [(by_date, NAMED), (by_number, NUMBERED), (by_number, DATED)])
def test_all_snapshots_are_imported_with_their_times(tmp_path: Path, name: Callable[[int], str], mapping: str) -> None:
    done, recording = imported(tmp_path, write(tmp_path / "files", name), mapping, KIT)
    found = stretches(recording, KIT)
    assert [one.start_ns for one in found] == times(range(FILES))
    np.testing.assert_allclose(np.concatenate([one.samples[:, 0] for one in found]), _COLUMNS[0], atol=1e-9)
    assert (done.read.files, done.read.rows) == (FILES, FILES * COUNT)
    told = "\n".join(summary_lines(done))
    assert f"files: {FILES} files, {FILES * COUNT} rows at 2000 Hz" in told
    assert "\nnot read in the folder, as no files of a known format: notes.docx\n" in told
    assert "gaps: none" in told


@pytest.mark.parametrize("mapping", [PULSE_TIMES, PULSES])
@pytest.mark.parametrize("every_s", [EVERY_S, ON_S])
def test_pulses_of_a_keyphasor_give_the_angle_in_every_file(tmp_path: Path, mapping: str, every_s: float) -> None:
    kit = KIT if every_s == EVERY_S else None
    if kit is None:
        mapping = mapping.replace("rate_hz = 2000.0", 'column = "t"\nunit = "ns"\nstart = "unix"')
        mapping = mapping.replace('pulse_times = "p"', 'pulse_times = "q"').replace('unit = "s"\n', 'unit = "ns"\n')
    name = by_date if every_s == EVERY_S else by_number
    done, recording = imported(tmp_path, write(tmp_path / "files", name, every_s=every_s), mapping, kit)
    found = stretches(recording, kit)
    assert len(found) == (FILES if every_s == EVERY_S else 1)
    angle = np.concatenate([one.samples[:, 2] for one in found])
    assert len(angle) == FILES * COUNT
    apart = np.abs(np.angle(np.exp(1j * (angle - _COLUMNS[2]))))
    assert apart.max() < 0.01
    assert done.angle.unknown == 0


@pytest.mark.parametrize(
    ("names", "mapping"),
    [("dcba", DATED), (("after 100 s", "after 119 s", "after 140 s", "after 160 s"), NUMBERED)],
    ids=["times in the files", "numbers that are no count"],
)
def test_files_are_joined_in_the_order_of_their_times_or_else_of_their_numbers(
    tmp_path: Path, names: Sequence[str], mapping: str
) -> None:
    folder = write(tmp_path / "files", lambda number: f"{names[number]}.npz", range(4))
    _, recording = imported(tmp_path, folder, mapping, KIT)
    assert begun(recording) == times(range(4))


@pytest.mark.parametrize("dated", [True, False])
def test_the_time_in_a_waveform_overrides_that_in_the_file_name(tmp_path: Path, dated: bool) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    for number in range(3):  # names in local time, an hour ahead
        start = np.datetime64(BEGIN.replace(tzinfo=None), "us") + np.timedelta64(round(number * EVERY_S), "s")
        told = {"wf_increment": 1 / RATE_HZ} | ({"wf_start_time": start} if dated else {})
        columns = zip("xva", _COLUMNS, strict=True)
        with nptdms.TdmsWriter(
            folder / f"{BEGIN + timedelta(hours=1, seconds=number * EVERY_S):%Y%m%d_%H%M%S}.tdms"
        ) as writer:
            writer.write_segment([nptdms.ChannelObject("g", name, x[:COUNT], told) for name, x in columns])
    _, recording = imported(tmp_path, folder, CHANNELS, KIT)
    begin_ns = START_NS + (0 if dated else 3600 * 10**9)
    assert begun(recording) == [begin_ns + round(number * EVERY_S * 1e9) for number in range(3)]


@pytest.mark.parametrize(
    ("name", "mapping"),
    [
        (by_date, NAMED),
        (by_number, NUMBERED),
        (lambda number: f"run2_{10 * number:04d}.npz", NUMBERED),
        (lambda number: f"acc_{BEGIN + timedelta(minutes=number + 58):%H%M}.npz", NUMBERED),  # 1258, 1259, 1300
        (lambda number: f"{BEGIN + timedelta(days=number):%Y%m%d}.npz", NUMBERED),  # 20260131, 20260201
    ],
)
def test_a_missing_snapshot_is_reported_and_the_others_keep_their_times(
    tmp_path: Path, name: Callable[[int], str], mapping: str
) -> None:
    folder = write(tmp_path / "files", name)
    (folder / name(5)).unlink()
    done, recording = imported(tmp_path, folder, mapping, KIT)
    told = "\n".join(summary_lines(done))
    assert "gaps: 1, 38 s in all" in told
    assert f"\n  before row 1 of {name(6)}: 38 s from " in told
    assert begun(recording) == times(set(range(FILES)) - {5})


@pytest.mark.parametrize(("rate_hz", "short"), [(RATE_HZ, False), (1000.0, True)])
def test_snapshots_that_filters_leave_too_short_are_reported(tmp_path: Path, rate_hz: float, short: bool) -> None:
    kit = machine(schedule={"on_s": ON_S, "every_s": EVERY_S}, window={}, ingest={}, rate_hz=rate_hz)
    mapping = NAMED.replace("rate_hz", "resample = true\nrate_hz")
    told = summary(tmp_path, write(tmp_path / "files", by_date), mapping, kit)
    note = f"note: {FILES} of {FILES} snapshots are shorter than [schedule] on_s = 2 in the machine file"
    assert (note in told) == short
    assert ("the shortest has 1.978 s, the longest of them 1.978 s" in told) == short


@pytest.mark.parametrize(("name", "mapping"), [(by_date, NAMED), (by_number, NUMBERED), (by_number, DATED)])
@pytest.mark.parametrize("number", [0, 5])
def test_an_unreadable_file_is_named_and_the_others_keep_their_times(
    tmp_path: Path, name: Callable[[int], str], mapping: str, number: int
) -> None:
    folder = write(tmp_path / "files", name)
    whole = dict(np.load(folder / name(8)))
    np.savez(folder / name(8), **whole | {"v": np.where(np.arange(COUNT) == 3000, np.nan, whole["v"])})
    (folder / name(number)).write_bytes(b"disk full")
    done, recording = imported(tmp_path, folder, mapping, KIT)
    told = {str(fault).removeprefix(f"{folder}/").partition(":")[0]: str(fault) for fault in done.unusable}
    assert set(told) == {name(number), name(8)}
    assert "damaged, or no NumPy .npz file" in told[name(number)]
    assert "row 3001, column v: found nan" in told[name(8)]
    assert begun(recording) == times(set(range(FILES)) - {number, 8})
    assert done.left_out == ["notes.docx"]


@pytest.mark.parametrize(("zone", "ahead_h"), [("Europe/Berlin", 1.0), ("+05:30", 5.5), ("UTC", 0.0), (None, 0.0)])
def test_times_in_file_names_are_in_the_time_zone_of_the_mapping(
    tmp_path: Path, zone: str | None, ahead_h: float
) -> None:
    mapping = NAMED if zone is None else NAMED.replace("rate_hz", f'zone = "{zone}"\nrate_hz')
    done, recording = imported(tmp_path, write(tmp_path / "files", by_date, range(3)), mapping, KIT)
    assert stretches(recording, KIT)[0].start_ns == START_NS - round(ahead_h * 3600e9)
    (told,) = [line for line in summary_lines(done) if line.startswith("times: ")]
    assert (zone or "UTC (if they are local time, say time.zone in the mapping)") in told


def test_a_serial_number_in_a_file_name_is_no_time(tmp_path: Path) -> None:
    def since_1970(number: int) -> str:
        return f"SN1402155779_{START_NS // 10**9 + round(number * EVERY_S)}.npz"

    _, recording = imported(tmp_path, write(tmp_path / "files", since_1970), NAMED, KIT)
    assert begun(recording) == times(range(FILES))
    with pytest.raises(SourceError, match="the time of the first row is not known"):
        imported(tmp_path, write(tmp_path / "more", lambda number: f"SN1402155779_{number}.npz", range(3)), NAMED, KIT)


@pytest.mark.parametrize("name", [by_date, by_number])
@pytest.mark.parametrize("runs_on", [True, False])
def test_time_columns_may_run_on_across_files_or_start_anew(
    tmp_path: Path, name: Callable[[int], str], runs_on: bool
) -> None:
    folder = write(tmp_path / "files", name)
    for number in range(FILES):
        arrays = dict(np.load(folder / name(number)))
        arrays["t"] = arrays["t"] - (START_NS if runs_on else arrays["t"][0])
        np.savez(folder / name(number), **arrays)
    mapping = NAMED if name is by_date else NUMBERED
    _, recording = imported(tmp_path, folder, mapping.replace("rate_hz = 2000.0", 'column = "t"\nunit = "ns"'), KIT)
    assert begun(recording) == times(range(FILES))


def test_a_start_alone_is_enough_where_the_time_column_runs_on(tmp_path: Path) -> None:
    folder = write(tmp_path / "files", by_number, range(4), ON_S)
    mapping = NUMBERED.replace("rate_hz = 2000.0", 'column = "t"\nunit = "ns"')
    for number in range(4):
        arrays = dict(np.load(folder / by_number(number)))
        np.savez(folder / f"{'dbca'[number]}.npz", **arrays | {"t": arrays["t"] - START_NS})
        (folder / by_number(number)).unlink()
    _, recording = imported(tmp_path, folder, mapping)
    (found,) = stretches(recording)
    assert found.start_ns == START_NS
    np.testing.assert_allclose(found.samples[:, 0], _COLUMNS[0][: 4 * COUNT], atol=1e-9)


def test_different_file_lengths_are_reported(tmp_path: Path) -> None:
    folder = write(tmp_path / "files", by_date, range(3))
    told = summary(tmp_path, folder, NAMED)
    assert f"files: 3 files, {3 * COUNT} rows" in told
    arrays = dict(np.load(folder / by_date(1)))
    np.savez(folder / by_date(1), **{name: column[:3000] for name, column in arrays.items()})
    told = summary(tmp_path, folder, NAMED)
    assert f"files: 3 files of 3000 to {COUNT} rows, {2 * COUNT + 3000} rows" in told


@pytest.mark.parametrize("rate", ["rate_hz = 2000.0", 'column = "t"\nunit = "ns"'])
def test_a_start_in_addition_to_times_in_file_names_is_refused(tmp_path: Path, rate: str) -> None:
    folder = write(tmp_path / "files", by_date, range(3))
    for number in range(3):
        arrays = dict(np.load(folder / by_date(number)))
        np.savez(folder / by_date(number), **arrays | {"t": arrays["t"] - arrays["t"][0]})
    with pytest.raises(SourceError, match=r"; or leave out time\.start, and the times in their names count"):
        imported(tmp_path, folder, NUMBERED.replace("rate_hz = 2000.0", rate))


@pytest.mark.parametrize(
    ("mapping", "every_s", "says"),
    [
        (NAMED, EVERY_S, "acc_1.npz: the time of the first row is not known.* in their names, such as 20260131T120000"),
        (DATED, 1.0, "acc_2.npz: begins 1 s before the end of acc_1.npz"),
        (f'format = "tdms"\n{NAMED}', EVERY_S, "damaged, or no TDMS file"),
    ],
)
def test_mistakes_in_a_folder_are_named(tmp_path: Path, mapping: str, every_s: float, says: str) -> None:
    folder = write(tmp_path / "files", by_number, range(3), every_s)
    with pytest.raises(SourceError, match=says):
        imported(tmp_path, folder, mapping, KIT)


def test_a_start_alone_needs_a_schedule_and_only_numbered_files(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"time\.start is that of the first file; expected \[schedule\] every_s"):
        imported(tmp_path, write(tmp_path / "files", by_number, range(3)), NUMBERED)
    (tmp_path / "empty").mkdir()
    with pytest.raises(SourceError, match="empty: no file of a known format in it"):
        imported(tmp_path, tmp_path / "empty", NAMED)
    folder = tmp_path / "files"
    (folder / "Calibration.npz").write_bytes(b"")
    with pytest.raises(SourceError, match=r"Calibration\.npz: .*move it out of the folder"):
        imported(tmp_path, folder, NUMBERED, KIT)
