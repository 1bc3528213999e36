"""What the tests of import and export share: a machine, its signals, and recordings read back."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models.errors import MachineFileError
from models.ingest import Gate
from models.machine import Machine, MachineFile, load_machine
from models.signals.block import FloatArray
from models.signals.recording import read_recording
from models.signals.wire import decode_block
from service.interchange.exported import Selection
from service.interchange.importing import Imported, import_file, summary_lines
from service.interchange.mapping import load_mapping
from service.recordings.replay.source import RecordingSource

START = "2026-01-31T12:00:00Z"
START_NS = 1769860800_000_000_000
RATE_HZ = 2000.0
SPEED_HZ = 22.0
CHANNELS = """
[channels]
y1 = { column = "x", unit = "um" }
y1_dot = { column = "v", unit = "mm/s" }
theta = { column = "a", unit = "rad" }
"""
TIME = f'[time]\ncolumn = "t"\nstart = "{START}"\n'
TEXT = TIME + CHANNELS
HEADER = "t,x,v,a"
SAMPLED = f'[time]\nrate_hz = 2000.0\nstart = "{START}"\n'
PULSES = SAMPLED + CHANNELS.replace("theta =", "# theta =") + "[keyphasor]\n"
"""Mapping of a file with pulses in place of an angle."""


@dataclass(frozen=True)
class Stretch:
    start_ns: int
    samples: FloatArray


def selected(*paths: Path, key: str | None = None, **more: Any) -> Selection:
    """Everything of a machine in recordings, or the part that is asked for."""
    source = RecordingSource(paths)
    return Selection(source, source.machine(key, reports=True), **more)


def machine(**changes: object) -> Machine:
    lab = load_machine("lab")
    kept = {"y1", "y1_dot", "theta"}
    sensors = tuple(channel for channel in lab.sensors if channel.name in kept)
    return Machine.model_validate({**lab.model_dump(), "dtype": "float64", "sensors": sensors, **changes})


def signals(count: int, rate_hz: float = RATE_HZ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Time, s; displacement, um; velocity, mm/s; shaft angle, rad."""
    time = np.arange(count) / rate_hz
    omega = 2 * np.pi * SPEED_HZ
    displacement = 40 * np.cos(omega * time) + 3 * np.sin(170.0 * time) - 12
    return time, displacement, -40e-3 * omega * np.sin(omega * time), np.mod(omega * time, 2 * np.pi)


def imported(folder: Path, source: Path, mapping: str, described: MachineFile | None = None) -> tuple[Imported, Path]:
    described = described or machine()
    file = folder / "mapping.toml"
    file.write_text(mapping, encoding="utf-8")
    out = folder / "imported.mcap"
    return import_file(source, load_mapping(file, described), described, out, overwrite=True), out


def archive(folder: Path, **columns: object) -> Path:
    np.savez(folder / "run.npz", **columns)  # type: ignore[arg-type]
    return folder / "run.npz"


def summary(folder: Path, source: Path, mapping: str, described: MachineFile | None = None) -> str:
    return "\n".join(summary_lines(imported(folder, source, mapping, described)[0]))


def stretches(recording: Path, described: MachineFile | None = None) -> list[Stretch]:
    """Stretches of a recording as a monitor sees them: no block may be refused; its gate decides on gaps."""
    described = described or machine()
    gate = Gate(described)
    found: list[tuple[int, list[FloatArray]]] = []
    for message in read_recording(recording, keys={described.keys.stream}):
        block = decode_block(message.payload, message.attachment, message.encoding)
        assert message.log_time_ns == block.end_ns
        verdict = gate.judge(block)
        assert verdict.accepted, verdict.text
        if not found or verdict.new_snapshot or not verdict.continuous:
            found.append((block.start_ns, []))
        found[-1][1].append(np.asarray(block.samples, dtype=np.float64))
    return [Stretch(start_ns, np.concatenate(blocks)) for start_ns, blocks in found]


def table(path: Path, rows: list[str], header: str = HEADER) -> Path:
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def good_rows(count: int = 1000, rate_hz: float = 2000.0) -> list[str]:
    return [",".join(repr(float(value)) for value in row) for row in zip(*signals(count, rate_hz), strict=True)]


GOOD = good_rows()


def with_cell(cell: str) -> list[str]:
    """Good rows, except for one cell of the velocity."""
    t, x, _, a = GOOD[736].split(",")
    return [*GOOD[:736], f"{t},{x},{cell},{a}", *GOOD[737:]]


def fault(folder: Path, rows: list[str], mapping: str = TEXT, header: str = HEADER) -> str:
    source = table(folder / "run.csv", rows, header)
    with pytest.raises(MachineFileError) as raised:
        imported(folder, source, mapping)
    assert not list(folder.glob("*.mcap*")), "a failed import leaves nothing behind"
    return str(raised.value)
