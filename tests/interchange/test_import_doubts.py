"""Doubtful contents of a readable file are reported: units, dates, turns, cells without a number."""

import re
import wave
from pathlib import Path

import h5py
import nptdms
import numpy as np
import pytest

from models.errors import MachineFileError
from models.ingest import Gate
from models.signals.recording import read_recording
from models.signals.wire import decode_block
from tests.interchange.material import (
    CHANNELS,
    GOOD,
    PULSES,
    SAMPLED,
    START,
    START_NS,
    TEXT,
    archive,
    fault,
    imported,
    machine,
    signals,
    stretches,
    summary,
    table,
    with_cell,
)
from tests.sure import sure


def test_numbers_in_place_of_dates_are_named(tmp_path: Path) -> None:
    time, x, v, a = signals(1000)
    source = archive(tmp_path, t=time + 3.0, x=x, v=v, a=a)
    mapping = f'[time]\ncolumn = "t"\nunit = "datetime"\n{CHANNELS}'
    with pytest.raises(MachineFileError, match=r"column t holds numbers \(float64\) such as 3\.0, expected dates"):
        imported(tmp_path, source, mapping)


def test_tdms_channels_with_differing_times_are_named(tmp_path: Path) -> None:
    columns = dict(zip("xva", signals(1000)[1:], strict=True))
    told = {"wf_increment": 1 / 2000, "wf_start_time": np.datetime64("2026-01-31T12:00:00")}
    with nptdms.TdmsWriter(tmp_path / "run.tdms") as writer:
        for name, column in columns.items():
            writer.write_segment([nptdms.ChannelObject("g", name, column, {} if name == "a" else told)])
    says = (
        "run.tdms: channel a has no rate from no time on, "
        "channel x has 2000 samples per second from 2026-01-31T12:00:00.000000Z on; expected the same "
        "(wf_increment, wf_start_time, wf_start_offset): write the file with one rate, or leave one of them out of the "
        "mapping and of the machine file"
    )
    with pytest.raises(MachineFileError, match=re.escape(says)):
        imported(tmp_path, tmp_path / "run.tdms", CHANNELS)


def test_columns_of_different_lengths_are_told_with_what_helps(tmp_path: Path) -> None:
    time, x, v, a = signals(1000)
    with pytest.raises(MachineFileError, match=r"column v has 250 rows, column x has 1000; .* write the file with one"):
        imported(tmp_path, archive(tmp_path, t=time, x=x, v=v[::4], a=a), SAMPLED + CHANNELS)


@pytest.mark.parametrize("cell", ["OVL", "---"])
def test_texts_for_missing_numbers_count_as_empty_cells(tmp_path: Path, cell: str) -> None:
    told = fault(tmp_path, with_cell(cell), f'[csv]\nmissing = ["OVL", "---"]\n{TEXT}')
    assert "row 737, column v: found nan, expected a finite number (time.not_finite" in told


@pytest.mark.parametrize(
    ("unit", "says"), [("rad", "shaft angle: 1320 rpm on average"), ("deg", "shaft angle: 23.0383 rpm on average")]
)
def test_the_mean_speed_of_an_angle_column_is_reported(tmp_path: Path, unit: str, says: str) -> None:
    mapping = TEXT.replace('column = "a", unit = "rad"', f'column = "a", unit = "{unit}"')
    time, x, v, _ = signals(1000)
    rows = zip(time, x, v, 2 * np.pi * 22.0 * time, strict=True)
    source = table(tmp_path / "run.csv", [",".join(repr(float(one)) for one in row) for row in rows])
    told = summary(tmp_path, source, mapping)
    assert says in told
    assert ("\nnote: the machine file says speed_rpm = 1320" in told) == (unit == "deg")


@pytest.mark.parametrize(("marks", "doubted"), [(16, False), (60, True)])
def test_pulses_too_fast_for_the_sampling_rate_are_doubted(tmp_path: Path, marks: int, doubted: bool) -> None:
    time, x, v, _ = signals(4000)
    source = archive(tmp_path, x=x, v=v, k=np.mod(22.0 * marks * time, 1.0) < 0.5)
    mapping = f'{PULSES}column = "k"\nthreshold = 0.5\npulses_per_revolution = {marks}\n'
    told = summary(tmp_path, source, mapping)
    assert ("samples for each pulse; pulses that come faster than half" in told) == doubted
    speed = sure(re.search(r"pulses, ([\d.]+) rpm on average", told))
    assert (float(speed[1]) == pytest.approx(1320, rel=1e-3)) != doubted


@pytest.mark.parametrize(("unit", "doubted"), [("ms", False), ("s", True)])
def test_pulses_outside_of_the_rows_are_doubted(tmp_path: Path, unit: str, doubted: bool) -> None:
    x, v = signals(4000)[1:3]
    source = archive(tmp_path, x=x, v=v, p=np.arange(45) / 22.0 * 1e3)
    mapping = f'{PULSES}pulse_times = "p"\nunit = "{unit}"\n'
    told = summary(tmp_path, source, mapping)
    assert ("note: 44 of 45 pulses are outside of the 2 s of the rows" in told) == doubted


@pytest.mark.parametrize(
    ("header", "refused"),
    [
        ("x (mil)", "mil"), ("x [mil]", "mil"), ("x (mil pp)", "mil pp"), ("x (um)", ""), ("x (1)", ""),
        ("x (um pp)", ""),
    ],
)  # fmt: skip
def test_a_unit_in_a_header_that_is_not_the_mappings_is_refused(tmp_path: Path, header: str, refused: str) -> None:
    mapping = TEXT.replace('"x"', f'"{header}"')
    if refused:
        says = f"is in '{refused}' according to the file, but in 'um' according to the mapping of channel y1"
        assert says in fault(tmp_path, GOOD, mapping, f"t,{header},v,a")
    else:
        imported(tmp_path, table(tmp_path / "run.csv", GOOD, f"t,{header},v,a"), mapping)


def test_a_unit_in_round_brackets_may_be_left_out_of_the_mapping(tmp_path: Path) -> None:
    mapping = TEXT.replace('{ column = "x", unit = "um" }', '{ column = "x (mil)" }')
    source = table(tmp_path / "run.csv", GOOD, "t,x (mil),v,a")
    _, recording = imported(tmp_path, source, mapping)
    np.testing.assert_allclose(stretches(recording)[0].samples[:, 0], signals(1000)[1] * 25.4, rtol=1e-9)


def test_a_column_of_volts_without_a_unit_in_the_mapping_is_refused_with_advice(tmp_path: Path) -> None:
    mapping = TEXT.replace('{ column = "x", unit = "um" }', '{ column = "x (V)" }')
    assert "give unit and scale in the mapping" in fault(tmp_path, GOOD, mapping, "t,x (V),v,a")


@pytest.mark.parametrize(
    ("header", "wish", "noted"),
    [("Volts", "", True), ("um pp", "", True), ("Volts", ", scale = 5", False), ("um", "", False)],
)
def test_a_unit_in_the_file_that_does_not_suit_samples_is_noted(
    tmp_path: Path, header: str, wish: str, noted: bool
) -> None:
    source = table(tmp_path / "run.csv", GOOD, f"t,x ({header}),v,a")
    mapping = TEXT.replace('column = "x", unit = "um"', f'column = "x ({header})", unit = "um"{wish}')
    told = summary(tmp_path, source, mapping)
    says = f"note: column x ({header}): the file says {header!r}, channel y1 takes its numbers as um"
    assert (says in told) == noted


def test_integers_of_a_wav_file_without_a_scale_are_noted(tmp_path: Path) -> None:
    with wave.open(str(tmp_path / "run.wav"), "wb") as file:
        file.setnchannels(3)
        file.setsampwidth(3)
        file.setframerate(2000)
        file.writeframes(bytes(9 * 1000))
    mapping = f'[time]\nstart = "{START}"\n{CHANNELS}'
    for number, name in enumerate("xva"):
        mapping = mapping.replace(f'"{name}"', f'"{number + 1}"')
    told = summary(tmp_path, tmp_path / "run.wav", mapping)
    assert "note: column 1: the file says 'of full scale', channel y1 takes its numbers as um" in told


def test_a_time_column_in_another_unit_than_the_mappings_is_refused(tmp_path: Path) -> None:
    mapping = TEXT.replace('"t"', '"t (ms)"\nresample = true')
    assert "column t (ms) is in 'ms' according to the file, but time.unit in the mapping is 's'" in fault(
        tmp_path, GOOD, mapping, "t (ms),x,v,a"
    )
    imported(tmp_path, table(tmp_path / "run.csv", GOOD, "t (UTC),x,v,a"), TEXT.replace('"t"', '"t (UTC)"'))


@pytest.mark.parametrize(
    ("attribute", "refused"), [("mil", True), (np.bytes_(b"um"), False), (h5py.Empty("S1"), False)]
)
def test_rates_and_units_of_an_hdf5_file_are_read(tmp_path: Path, attribute: object, refused: bool) -> None:
    with h5py.File(tmp_path / "run.h5", "w") as file:
        for name, column in zip("xva", signals(1000)[1:], strict=True):
            file[name] = column
        file["x"].attrs["units"] = attribute
        file["comment"] = h5py.Empty("f8")  # a data set without any value, which is none of the columns
        file["fs"] = 2000.0
    mapping = TEXT.replace('column = "t"', 'rate_from = "fs"')
    if refused:
        with pytest.raises(MachineFileError, match="column x is in 'mil' according to the file, but in 'um'"):
            imported(tmp_path, tmp_path / "run.h5", mapping)
    else:
        assert imported(tmp_path, tmp_path / "run.h5", mapping)[0].clock.rate_hz == 2000.0


@pytest.mark.parametrize("marks", [1, 15])
@pytest.mark.parametrize(("faster_hz", "says"), [(20.3, ", 0 missing"), (40.0, ", mostly 1200 to 2400, 0 missing")])
def test_a_speed_range_is_reported_beside_the_mean(tmp_path: Path, faster_hz: float, says: str, marks: int) -> None:
    time, x, v, _ = signals(8000)
    turns = np.where(time < 2, 20.0, faster_hz) * (time - 2) + 0.253
    source = archive(tmp_path, x=x, v=v, k=np.mod(marks * turns, 1.0) < 0.5)
    mapping = f'{PULSES}column = "k"\nthreshold = 0.5\npulses_per_revolution = {marks}\n'
    told = summary(tmp_path, source, mapping)
    assert f"rpm on average{says}" in told


def test_a_run_up_through_the_speed_of_the_machine_file_is_not_doubted(tmp_path: Path) -> None:
    time, x, v, _ = signals(8000)
    for greatest_hz, doubted in ((15.0, True), (24.0, False)):
        turns = 10.0 * time + (greatest_hz - 10.0) * time**2 / 8
        source = archive(tmp_path, x=x, v=v, k=np.mod(turns, 1.0) < 0.5)
        told = summary(tmp_path, source, f'{PULSES}column = "k"\nthreshold = 0.5\n')
        assert ("note: the machine file says speed_rpm = 1320" in told) == doubted


@pytest.mark.parametrize(("edge", "threshold"), [("rising", 1.5), ("falling", -0.5)])
def test_a_signal_without_pulses_is_refused_with_its_range(tmp_path: Path, edge: str, threshold: float) -> None:
    time, x, v, _ = signals(4000)
    source = archive(tmp_path, x=x, v=v, k=np.mod(22.0 * time, 1.0) < 0.5)
    mapping = f'{PULSES}column = "k"\nthreshold = {threshold}\nhysteresis = 0.2\nedge = "{edge}"\n'
    says = f"the signal goes from 0 to 1, threshold = {threshold}, hysteresis = 0.2"
    with pytest.raises(MachineFileError, match=f"keyphasor column k: 0 pulses, expected at least two .*; {says}"):
        imported(tmp_path, source, mapping)


@pytest.mark.parametrize("mode", ["missing", "gap"])
def test_a_keyphasor_signal_without_numbers_is_refused(tmp_path: Path, mode: str) -> None:
    _, x, v, _ = signals(1000)
    source = archive(tmp_path, x=x, v=v, k=np.full(1000, np.nan))
    mapping = PULSES.replace("[time]\n", f'[time]\nnot_finite = "{mode}"\n') + 'column = "k"\nthreshold = 0.5\n'
    with pytest.raises(MachineFileError, match=r"keyphasor column k: 0 pulses, .*; the signal holds no numbers"):
        imported(tmp_path, source, mapping)


@pytest.mark.parametrize("marks", [1, 4])
def test_lost_pulses_are_reported_with_what_they_cost(tmp_path: Path, marks: int) -> None:
    time, x, v, _ = signals(8000)
    stands = (time > 2.0) & (time < 2.6)
    source = archive(tmp_path, x=x, v=v, k=(np.mod(22.0 * marks * time, 1.0) < 0.5) & ~stands)
    mapping = f'{PULSES}column = "k"\nthreshold = 0.5\npulses_per_revolution = {marks}\n'
    told = summary(tmp_path, source, mapping)
    assert '; where the shaft stands still, time.not_finite = "missing" keeps the rest' in told
    assert ("another of the 4 pulses may count as angle 0: phases before and after it cannot" in told) == (marks > 1)
    told = summary(tmp_path, source, mapping.replace("[time]", '[time]\nnot_finite = "missing"'))
    assert "1 interruptions" in told
    assert "where the shaft stands still" not in told


@pytest.mark.parametrize(("unit", "factor"), [("um", 1), ("mm", 1000)])
def test_the_size_of_samples_is_reported_and_doubted(tmp_path: Path, unit: str, factor: int) -> None:
    _, _, v, a = signals(2000)  # 22 revolutions
    source = archive(tmp_path, x=20 * np.cos(a) - 12, v=v * 0, a=a)
    told = summary(tmp_path, source, (SAMPLED + CHANNELS).replace('"um"', f'"{unit}"'))
    size = f"y1: {14.142 * factor:g} µm rms about {-12.0 * factor:.4g}, from {-32 * factor} to {8 * factor}"
    doubt = "; note: expected 0.001 to 5000 rms, are column, unit and scale right?" if factor > 1 else ""
    assert f"\n{size}{doubt}\n" in told
    assert "\ny1_dot: 0 mm/s rms about 0, from 0 to 0; note: expected 0.0001 to 1000 rms, are column" in told


@pytest.mark.parametrize(("later_s", "step_s"), [(0.5, 0.0), (86_400.0, 86_399.5)])
def test_files_imported_one_by_one_are_not_taken_for_a_clock_that_was_set(
    tmp_path: Path, later_s: float, step_s: float
) -> None:
    time, x, v, a = signals(4000)
    gate, verdicts = Gate(machine()), []
    for start_ns in (START_NS, START_NS + round(later_s * 1e9)):
        rows = slice(1000) if start_ns == START_NS else slice(1000, None)
        source = archive(tmp_path, t=time[rows] - time[rows][0], x=x[rows], v=v[rows], a=a[rows])
        out = imported(tmp_path, source, TEXT.replace(START, f"{np.datetime64(start_ns, 'ns')}Z"))[1]
        for message in read_recording(out, keys={machine().keys.stream}):
            verdicts.append(gate.judge(decode_block(message.payload, message.attachment, message.encoding)))
    assert all(one.accepted for one in verdicts) == (step_s == 0)
    assert sum(one.gap_s for one in verdicts) == 0
    stepped = [one for one in verdicts if one.clock_step_s]
    assert [one.new_run for one in stepped] == [True] * (step_s > 0)
    assert sum(one.clock_step_s for one in stepped) == pytest.approx(step_s, abs=1.0)


@pytest.mark.parametrize(("rate_hz", "doubted"), [(320, True), (400, False), (4000, False)])
def test_a_file_sampled_too_slowly_for_the_band_is_doubted(tmp_path: Path, rate_hz: int, doubted: bool) -> None:
    _, x, v, a = signals(4 * rate_hz, rate_hz)
    mapping = SAMPLED.replace("2000.0", f"{rate_hz}\nresample = true") + CHANNELS
    told = summary(tmp_path, archive(tmp_path, x=x, v=v, a=a), mapping)
    says = "note: the machine file evaluates up to window.band_hz = 150 Hz, and the file holds nothing above 134.4 Hz"
    assert (says in told) == doubted
    assert ("evaluates up to" in told) == doubted


@pytest.mark.parametrize(("hours", "hinted"), [(1, True), (2, False)])
def test_local_times_across_the_end_of_summer_time_are_refused_with_a_hint(
    tmp_path: Path, hours: int, hinted: bool
) -> None:
    begin = np.datetime64("2026-10-25T02:59:59.500", "ns")
    times = begin + np.arange(2000) * np.timedelta64(500, "us")
    times[1000:] -= np.timedelta64(hours, "h")
    source = archive(tmp_path, **dict(zip("txva", (times, *signals(2000)[1:]), strict=True)))
    with pytest.raises(MachineFileError, match=f"row 1001, column t: goes back by {hours * 3600} s") as raised:
        imported(tmp_path, source, f'[time]\ncolumn = "t"\nunit = "datetime"\nzone = "Europe/Berlin"\n{CHANNELS}')
    assert ("the end of summer time? Leave the column out and give time.start" in str(raised.value)) == hinted


def test_dates_in_a_column_beside_a_start_are_refused(tmp_path: Path) -> None:
    _, x, v, a = signals(1000)
    dates = np.datetime64("2026-01-31T12:00:00", "us") + 500 * np.arange(1000)
    with pytest.raises(
        MachineFileError, match=r"column t holds dates such as 2026-01-31T12:.*, expected no time.start"
    ):
        imported(tmp_path, archive(tmp_path, t=dates, x=x, v=v, a=a), TEXT)


def test_a_packed_hdf5_column_without_a_scale_is_noted(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "run.h5", "w") as file:
        for name, column in zip("xva", signals(1000)[1:], strict=True):
            file[name] = column
        file["x"].attrs.update({"units": "um", "scale_factor": 0.01})
    told = summary(tmp_path, tmp_path / "run.h5", SAMPLED + CHANNELS)
    assert "note: column x: the file says 'um after scale_factor', channel y1 takes its numbers as um" in told
    scaled = CHANNELS.replace('"um"', '"um", scale = 0.01')
    assert "note: column" not in summary(tmp_path, tmp_path / "run.h5", SAMPLED + scaled)
