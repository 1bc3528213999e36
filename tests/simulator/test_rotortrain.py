"""`rotortrain` as a program: training, messages, and what start-up imports."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from models.diagnosis.networks.bundle import load_bundle
from models.machine import load_machine
from tests.service.rig.live import machine_file

ROOT = Path(__file__).parents[2]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "simulator.rotortrain", *arguments], capture_output=True, text=True, check=False
    )


@pytest.mark.slow
@pytest.mark.long
def test_train_writes_a_bundle_that_fits_the_machine(tmp_path: Path) -> None:
    """With windows of a third of the usual length: most of the time goes into simulating them."""
    out, file = tmp_path / "bundle", machine_file(tmp_path, ("length_s = 60.0", "length_s = 20.0"))
    size = ("--windows", "20", "--draws", "2000")
    done = run("train", "--machine", file, "--out", str(out), *size, "--seed", "4", "--processes", "2")
    assert done.returncode == 0, done.stderr
    assert "(28) bearing" in done.stdout
    assert "written to" in done.stdout
    bundle = load_bundle(out, load_machine(file))
    assert bundle.manifest.training.training_windows == 20
    assert bundle.amortised is not None


@pytest.mark.parametrize(
    "command",
    [
        ("train", "--machine", "lab", "--out", "bundle"),
        ("commission", "--machine", "lab", "--healthy", "healthy.mcap", "--out", "bundle"),
    ],
)
def test_what_needs_training_says_what_to_install(command: tuple[str, ...], tmp_path: Path) -> None:
    """As after an installation without extras, where there is no torch."""
    (tmp_path / "healthy.mcap").touch()
    code = (
        "import sys\n"
        "class Absent:\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name.partition('.')[0] in {'torch', 'matplotlib', 'jinja2'}:\n"
        "            raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Absent())\n"
        "from simulator.rotortrain import app\napp(sys.argv[1:])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *command],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "pip install 'rotorwatch[train]'" in done.stderr
    assert len(done.stderr.splitlines()) < 4
