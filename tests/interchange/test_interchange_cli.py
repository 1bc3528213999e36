"""The commands `import` and `export` as processes, with the example that the documents show."""

import subprocess
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest

from models.machine import load_machine_file
from service.interchange.mapping import Acceleration, Column, CsvFormat, Keyphasor, Mapping, TimeBase
from tests.interchange.material import stretches
from tests.service.preloaded import ran

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "docs" / "examples" / "fe_rotor"


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return ran("service.rotorwatch", *arguments, environment={"PATH": "/usr/bin:/bin", "COLUMNS": "200"})


def sample(path: Path) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """A file as the example's mapping expects it; its samples in um and mm/s."""
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


def test_the_example_goes_through_import_and_export(tmp_path: Path) -> None:
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


def test_the_examples_machine_file_is_accepted() -> None:
    found = run("check-config", EXAMPLE / "machine.toml")
    assert found.returncode == 0, found.stderr
    assert "9 channels at 2000 Hz" in found.stdout


def test_a_file_that_cannot_be_imported_is_exit_code_2(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("t,x\n0,1\n", encoding="utf-8")
    found = run(
        *("import", tmp_path / "run.csv", "--mapping", EXAMPLE / "mapping.toml"),
        *("--machine", EXAMPLE / "machine.toml", "--out", tmp_path / "run.mcap"),
    )
    assert found.returncode == 2
    assert "run.csv: no column" in found.stderr
    assert "Traceback" not in found.stderr
    assert not list(tmp_path.glob("*.mcap*"))


def test_a_recording_that_is_not_there_is_exit_code_1(tmp_path: Path) -> None:
    found = run("export", tmp_path / "none.mcap", "--to", "csv", "--out", tmp_path / "out.csv")
    assert found.returncode == 1
    assert "none.mcap: cannot be read" in found.stderr


@pytest.mark.parametrize("command", ["import", "export"])
def test_help_has_an_example(command: str) -> None:
    assert "Example" in run(command, "--help").stdout


def test_every_field_of_the_mapping_is_documented() -> None:
    page = (ROOT / "docs" / "interchange.md").read_text(encoding="utf-8")
    for model in (Mapping, CsvFormat, TimeBase, Column, Acceleration, Keyphasor):
        for name in model.model_fields:
            assert f"`{name}`" in page or f"[{name}" in page, f"docs/interchange.md does not mention {name}"
