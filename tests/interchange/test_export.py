"""Exports are read by each format's own library with units and times, and can be imported again."""

import csv
import json
import os
from itertools import count
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from scipy.io import loadmat

from models.errors import MachineFileError, RecordingError
from models.machine import Machine, load_machine
from models.signals.block import FloatArray, SampleBlock
from models.signals.recording import RecordedMessage, RecordingWriter
from models.signals.wire import encode_arrow, encode_block
from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.example import example
from rotorwatch.records.health import MEASURES, Report
from service.interchange.exported import report_table, stream_table
from service.interchange.exporting import ExportFormat, export
from tests.interchange.material import START_NS, imported, selected, stretches

LAB = load_machine("lab")
STEP_NS = 500_000


def recording(
    path: Path, described: Machine = LAB, blocks: int = 400, gap_after: int = 150, lost: int = 37, after_ns: int = 0
) -> FloatArray:
    """A live recording with a gap, blocks in both encodings, reports and alarms; its samples."""
    rng = np.random.default_rng(5)
    samples = rng.standard_normal((blocks * 200, len(described.sensors))).astype(described.dtype)
    keys, schema_hash = described.keys, described.descriptor.schema_hash
    clock = count(START_NS + after_ns)
    with RecordingWriter(path) as writer:

        def put(key: str, payload: bytes, attachment: bytes, encoding: str) -> None:
            now_ns = next(clock)
            writer.write(RecordedMessage(key, payload, attachment, encoding, now_ns, now_ns))

        put(keys.descriptor, described.descriptor.model_dump_json().encode(), b"", "application/json")
        for number in range(blocks):
            sequence = number + (lost if number >= gap_after else 0)
            rows = samples[number * 200 : (number + 1) * 200]
            block = SampleBlock(START_NS + sequence * 200 * STEP_NS, sequence, 1, described.rate_hz, rows)
            encode = encode_arrow if number % 50 == 3 else encode_block
            put(keys.stream, *encode(block, schema_hash))
            if number == 7:
                put(keys.stream, *encode_block(block, schema_hash))  # delivered twice
                put(keys.stream, b"abc", b"", "application/x-rotorwatch-block")
        for number in range(3):
            report = {**example(Report), "site": "demo", "machine": "lab", "end_ns": START_NS + number * 5_000_000_000}
            put(keys.report, json.dumps(report).encode(), b"", "application/json")
        put(keys.report, b'{"half": ', b"", "application/json")
        put(keys.alarm_event, json.dumps(example(AlarmCloudEvent)).encode(), b"", "application/json")
    return samples.astype(np.float64)


def times(blocks: int = 400, gap_after: int = 150, lost: int = 37) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    row = np.arange(blocks * 200)
    return START_NS + STEP_NS * (row + np.where(row >= gap_after * 200, lost * 200, 0))


def mapping(machine: Machine, names: dict[str, tuple[str, str]], time: str) -> str:
    lines = [f'[time]\ncolumn = "{time}"\nunit = "ns"\nstart = "unix"\n[channels]']
    for channel in machine.sensors:
        column, unit = names[channel.name]
        lines.append(f'{channel.name} = {{ column = "{column}", unit = "{unit}" }}')
    return "\n".join(lines)


SI = {"um": "m", "mm/s": "m/s", "rad": "rad"}


@pytest.mark.parametrize(("kind", "si"), [("parquet", False), ("csv", True), ("mat", False)])
def test_exports_open_in_other_libraries_and_import_unchanged(tmp_path: Path, kind: ExportFormat, si: bool) -> None:
    samples = recording(tmp_path / "run.mcap")
    out = tmp_path / f"run.{kind}"
    table = export(selected(tmp_path / "run.mcap", si=si), "stream", kind, out)
    assert table.rows == samples.shape[0]
    assert len(table.skipped) == 2  # the repeated block and the invalid one
    units = {channel.name: SI[channel.unit] if si else channel.unit for channel in LAB.sensors}
    factors = np.array([channel.to_si if si else 1.0 for channel in LAB.sensors])
    expected = samples * factors
    names = {name: (name, unit) for name, unit in units.items()}
    if kind == "parquet":
        read = pa.parquet.read_table(out)
        assert {field.name: field.metadata[b"unit"].decode() for field in read.schema} == {"time_ns": "ns", **units}
        time_ns = read.column("time_ns").to_numpy()
        found = np.column_stack([read.column(name).to_numpy() for name in units])
        assert json.loads(read.schema.metadata[b"descriptor"])["machine"] == "lab"
        time = "time_ns"
    elif kind == "csv":
        with out.open(newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(file))
        assert header == ["time_ns", *(f"{name} [{unit}]" for name, unit in units.items())]
        time_ns = np.array([int(row[0]) for row in rows])
        found = np.array([[float(cell) for cell in row[1:]] for row in rows])
        names = {name: (f"{name} [{unit}]", unit) for name, unit in units.items()}
        time = "time_ns"
    else:
        content = loadmat(out, simplify_cells=True)["data"]
        assert {name: content[name]["unit"] for name in units} == units
        time_ns = content["time_ns"]["samples"]
        found = np.column_stack([content[name]["samples"] for name in units])
        names = {name: (f"data.{name}.samples", unit) for name, unit in units.items()}
        time = "data.time_ns.samples"
    np.testing.assert_array_equal(time_ns, times())
    np.testing.assert_array_equal(found.astype(np.float32), expected.astype(np.float32))
    wrapped = samples.copy()
    wrapped[:, 8] = np.mod(samples[:, 8], 2 * np.pi)
    done, back = imported(tmp_path, out, mapping(LAB, names, time), LAB)
    first, second = stretches(back, LAB)
    again = np.concatenate([first.samples, second.samples])
    np.testing.assert_array_equal(again[:, :8], samples[:, :8])
    np.testing.assert_allclose(again[:, 8], wrapped[:, 8], atol=1e-6)
    assert (first.start_ns, first.samples.shape[0]) == (START_NS, 150 * 200)
    assert second.start_ns == START_NS + 187 * 200 * STEP_NS
    assert len(done.read.gaps) == 1


def test_a_selected_part_is_cut_to_the_sample(tmp_path: Path) -> None:
    whole = recording(tmp_path / "b.mcap")
    selection = selected(tmp_path / "b.mcap", from_ns=START_NS + 1001 * STEP_NS - 7, to_ns=START_NS + 1700 * STEP_NS)
    export(selection, "stream", "parquet", tmp_path / "part.parquet")
    read = pa.parquet.read_table(tmp_path / "part.parquet")
    np.testing.assert_array_equal(read.column("time_ns").to_numpy(), times()[1001:1700])
    np.testing.assert_array_equal(read.column("y1").to_numpy(), whole[1001:1700, 0].astype(np.float32))


def test_reports_and_alarms_are_exported_as_tables(tmp_path: Path) -> None:
    recording(tmp_path / "run.mcap", blocks=2)
    selection = selected(tmp_path / "run.mcap", to_ns=START_NS + 6_000_000_000)
    table = export(selection, "reports", "parquet", tmp_path / "reports.parquet")
    assert len(table.skipped) == 1  # the truncated message
    read = pa.parquet.read_table(tmp_path / "reports.parquet")
    assert read.column("end_ns").to_pylist() == [START_NS, START_NS + 5_000_000_000]
    report = Report.model_validate(example(Report))
    for field, measure in MEASURES.values():
        assert read.column(field).to_pylist() == [getattr(report, field)] * 2
        assert read.schema.field(field).metadata[b"unit"] == measure.unit.encode()
    (reading,) = report.parameters
    assert read.column(f"{reading.name}.relative_change").to_pylist() == [reading.relative_change] * 2
    assert read.column("e.relative_change").null_count == 2
    (levels,) = report.levels
    units = {"overall": "m/s2 rms", "velocity": "mm/s rms", "x1_phase_lag_deg": "deg", "crest": "1"}
    for column, unit in units.items():
        assert read.column(f"{levels.channel}.{column}").to_pylist() == [getattr(levels, column)] * 2
        assert read.schema.field(f"{levels.channel}.{column}").metadata[b"unit"] == unit.encode()
    export(selected(tmp_path / "run.mcap"), "alarms", "csv", tmp_path / "alarms.csv")
    with (tmp_path / "alarms.csv").open(newline="", encoding="utf-8") as file:
        (event,) = list(csv.DictReader(file))
    said = AlarmCloudEvent.model_validate(example(AlarmCloudEvent))
    assert (event["name"], event["kind"], int(event["time_ns"])) == (said.data.name, said.data.kind, said.data.time_ns)
    assert event["text"] == said.data.text
    (tmp_path / "capture.mcap").write_bytes((tmp_path / "run.mcap").read_bytes())  # around an alarm: the same messages
    twice = selected(tmp_path / "run.mcap", tmp_path / "capture.mcap")
    assert export(twice, "alarms", "csv", tmp_path / "alarms.csv", overwrite=True).rows == 1
    export(selected(tmp_path / "run.mcap"), "reports", "mat", tmp_path / "reports.mat")
    content = loadmat(tmp_path / "reports.mat", simplify_cells=True)["data"]
    assert content["state"]["samples"].tolist() == [report.state] * 3
    assert np.isnan(content["e_relative_change"]["samples"]).all()


def test_reports_in_another_unit_are_exported_by_themselves(tmp_path: Path) -> None:
    recording(tmp_path / "run.mcap", blocks=2)
    report = Report.model_validate(example(Report))
    later_ns = START_NS + 12_000_000_000
    levels = [one.model_copy(update={"unit": "g"}) for one in report.levels]
    later = report.model_copy(update={"end_ns": later_ns, "levels": tuple(levels)})
    with RecordingWriter(tmp_path / "later.mcap") as writer:
        payload = later.model_dump_json().encode()
        writer.write(RecordedMessage(LAB.keys.report, payload, b"", "application/json", later_ns, later_ns))
    both = tmp_path / "run.mcap", tmp_path / "later.mcap"
    with pytest.raises(
        RecordingError, match=r"DE-H\.overall has changed from m/s2 rms to g rms at 2026-01-31T12:00:12"
    ):
        export(selected(*both), "reports", "csv", tmp_path / "out.csv")
    table = report_table(selected(*both, from_ns=later_ns))
    assert table.schema.field("DE-H.overall").metadata[b"unit"] == b"g rms"
    (rows,) = table.batches
    assert rows.column("machine_hash").to_pylist() == [report.machine_hash]


def test_channels_that_change_are_exported_by_themselves(tmp_path: Path) -> None:
    recording(tmp_path / "a.mcap", blocks=2)
    sensors = [channel.model_dump() for channel in LAB.sensors]
    sensors[0]["unit"] = "mil"
    changed = Machine.model_validate({**LAB.model_dump(), "sensors": sensors})
    recording(tmp_path / "b.mcap", changed, blocks=2, gap_after=0, lost=2, after_ns=10**8)
    both, change_ns = (tmp_path / "a.mcap", tmp_path / "b.mcap"), START_NS + 400 * STEP_NS
    said = "the channels on rotorwatch/demo/lab/descriptor have changed at 2026-01-31T12:00:00.200000Z; export"
    with pytest.raises(RecordingError, match=said):
        export(selected(*both), "stream", "csv", tmp_path / "out.csv")
    assert not (tmp_path / "out.csv").exists()
    for part, unit in ((selected(*both, to_ns=change_ns), "um"), (selected(*both, from_ns=change_ns), "mil")):
        table = stream_table(part)
        assert table.schema.field(1).metadata[b"unit"] == unit.encode()
        assert (sum(batch.num_rows for batch in table.batches), table.skipped) == (400, [])


def test_a_recording_without_reports_says_what_makes_them(tmp_path: Path) -> None:
    described = LAB.descriptor.model_dump_json().encode()
    with RecordingWriter(tmp_path / "bare.mcap") as writer:
        writer.write(RecordedMessage(LAB.keys.descriptor, described, b"", "application/json", START_NS, START_NS))
        writer.write(
            RecordedMessage(LAB.keys.stream, b"abc", b"", "application/x-rotorwatch-block", START_NS, START_NS)
        )
    with pytest.raises(RecordingError, match=r"bare.mcap: no reports: only a monitor records them; rotorwatch replay"):
        export(selected(tmp_path / "bare.mcap"), "reports", "csv", tmp_path / "out.csv")


def test_one_of_several_machines_must_be_chosen(tmp_path: Path) -> None:
    heavy = load_machine("heavy")
    recording(tmp_path / "a.mcap", blocks=2)
    recording(tmp_path / "b.mcap", heavy, blocks=3)
    both = (tmp_path / "a.mcap", tmp_path / "b.mcap")
    with pytest.raises(MachineFileError, match="demo/heavy, demo/lab; name one, as --key SITE/MACHINE"):
        export(selected(*both), "stream", "csv", tmp_path / "out.csv")
    with pytest.raises(MachineFileError, match=r"of demo/light; machines with .*: demo/heavy, demo/lab"):
        export(selected(*both, key="demo/light"), "stream", "csv", tmp_path / "out.csv")
    assert export(selected(*both, key="demo/heavy"), "stream", "csv", tmp_path / "out.csv").rows == 600


def test_missing_data_and_unusable_output_files_are_named(tmp_path: Path) -> None:
    recording(tmp_path / "run.mcap", blocks=2)
    selection = selected(tmp_path / "run.mcap", from_ns=START_NS + 10**12)
    spanned = r" in the time that is wanted; the data are of 2026-01-31 12:00:00\.0 to 2026-01-31 12:00:00\.2 UTC$"
    for what in ("stream", "alarms"):  # alarms without a hint at a replay: a monitor has recorded them
        with pytest.raises(RecordingError, match=what + spanned):
            export(selection, what, "parquet", tmp_path / "out.parquet")
    reversed_ = selected(tmp_path / "run.mcap", from_ns=START_NS + 10**8, to_ns=START_NS)
    with pytest.raises(MachineFileError, match=r"--from is 2026-.*\.1, not before --to-time 2026-.*\.0 UTC"):
        export(reversed_, "stream", "parquet", tmp_path / "out.parquet")
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
    with pytest.raises(MachineFileError, match=r"out\.xlsx: expected a name that ends in \.csv"):
        export(selected(tmp_path / "run.mcap"), "stream", "csv", tmp_path / "out.xlsx")
    with pytest.raises(MachineFileError, match=r"run\.mcap: already exists; --overwrite replaces it"):
        export(selected(tmp_path / "run.mcap"), "stream", "parquet", tmp_path / "run.mcap")
    with pytest.raises(RecordingError, match=r"run\.mcap: is one of the recordings"):
        export(selected(tmp_path / "run.mcap"), "stream", "parquet", tmp_path / "run.mcap", overwrite=True)
    with pytest.raises(RecordingError, match=r"none/a\.csv: cannot be written \(No such file or directory\)"):
        export(selected(tmp_path / "run.mcap"), "stream", "csv", tmp_path / "none" / "a.csv")
    with RecordingWriter(tmp_path / "nothing.mcap"):
        pass
    with pytest.raises(RecordingError, match=r"nothing\.mcap: contains no messages"):
        export(selected(tmp_path / "nothing.mcap"), "stream", "csv", tmp_path / "a.csv")
    with pytest.raises(RecordingError, match="is a folder, expected the name of a file"):
        export(selected(tmp_path / "run.mcap"), "stream", "csv", Path(), overwrite=True)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(RecordingError, match="pipe: is a device or pipe, expected the name of a file"):
        export(selected(tmp_path / "run.mcap"), "stream", "csv", tmp_path / "pipe", overwrite=True)
    assert (tmp_path / "pipe").is_fifo()
