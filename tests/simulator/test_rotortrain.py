"""`rotortrain` as a program: training, evaluation, messages, and what start-up imports."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from models.diagnosis.bundle import load_bundle
from models.machine import load_machine
from simulator.evaluation import Rate, threshold_for


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "simulator.rotortrain", *arguments], capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_train_writes_a_bundle_that_fits_the_machine_and_evaluate_reads_it(tmp_path: Path) -> None:
    out = tmp_path / "bundle"
    size = ("--windows", "20", "--draws", "2000")
    done = run("train", "--machine", "lab", "--out", str(out), *size, "--seed", "4", "--processes", "2")
    assert done.returncode == 0, done.stderr
    assert "(28) bearing" in done.stdout
    assert "written to" in done.stdout
    bundle = load_bundle(out, load_machine("lab"))
    assert bundle.manifest.training.training_windows == 20
    results = tmp_path / "results.json"
    done = run("evaluate", "-m", "lab", "-b", str(out), "--windows", "2", "--fault", "0.25", "--out", str(results))
    assert done.returncode == 0, done.stderr
    document = json.loads(results.read_text())
    assert document["bundle"] == bundle.identity
    assert len(document["cells"]) == 14
    cell = next(cell for cell in document["cells"] if cell["faults"] == {"k_by": -0.25})
    read = {(reading["by"], reading["parameter"]): reading["median"] for reading in cell["readings"]}
    assert read["likelihood", "k_by"] == pytest.approx(-0.25, abs=0.05)
    assert abs(read["likelihood", "k_bz"]) < 0.05


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("train", "--machine", "none.toml", "--out", "x"), "none.toml: no such machine file"),
        (("evaluate", "--machine", "lab", "--bundle", "nowhere"), "nowhere: not a bundle"),
        (("evaluate", "--machine", "heavy", "--bundle", "lab"), "trained for another machine"),
        (("train", "--machine", "lab"), "Missing option '--out'"),
    ],
)
def test_wrong_arguments_exit_with_2_and_a_sentence(arguments: tuple[str, ...], message: str) -> None:
    done = run(*arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_help_needs_neither_torch_nor_scipy_nor_numpy() -> None:
    code = (
        "import sys, typer.testing, simulator.rotortrain as t\n"
        "result = typer.testing.CliRunner().invoke(t.app, ['train', '--help'])\n"
        "assert result.exit_code == 0 and 'rotortrain train --machine lab' in result.output, result.output\n"
        "print([name for name in ('torch', 'scipy', 'numpy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_rates_have_clopper_pearson_intervals() -> None:
    nothing, some, everything = Rate.of_counts(0, 100), Rate.of_counts(5, 100), Rate.of_counts(100, 100)
    assert (nothing.low, nothing.high) == pytest.approx((0.0, 0.0362), abs=1e-4)
    assert (some.low, some.high) == pytest.approx((0.0164, 0.1128), abs=1e-4)
    assert (everything.low, everything.high) == pytest.approx((0.9638, 1.0), abs=1e-4)
    assert threshold_for(0.01) == pytest.approx(3.144, abs=1e-3)
