"""``rotortrain``: commissioning and what replaces it, training, messages, and what start-up imports."""

import contextlib
import json
import os
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from models.commissioning.commissioned import KnowledgeLevel, install, load_commissioned
from models.commissioning.levels import HealthyPiece, Learned, Progress, learn
from models.diagnosis.networks.bundle import load_bundle
from models.machine import MachineFile, load_machine, load_machine_file
from simulator.rotortrain import app
from simulator.stream import record
from tests.commissioning.rotor_kit import LAB, stream
from tests.service.rig.live import machine_file

ROOT = Path(__file__).parents[2]
SHIPPED = (ROOT / "models" / "machines" / "lab.toml").read_text(encoding="utf-8")
NOTHING_KNOWN = re.sub(r"\[(rotor|operation|condition)\].*?(?=\n\[)", "", SHIPPED, flags=re.DOTALL)


def run(folder: Path, *arguments: str | Path) -> Result:
    with contextlib.chdir(folder):
        return CliRunner(env={"COLUMNS": "200"}).invoke(app, ["commission", *map(str, arguments)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("commission")
    (place / "machine.toml").write_text(NOTHING_KNOWN, encoding="utf-8")
    for name, duration_s, seed in (("monday", 70.0, 81), ("friday", 40.0, 82), ("short", 20.0, 83)):
        record(LAB, ((block, ()) for block in stream(duration_s, seed)), place / f"{name}.mcap")
    return place


@pytest.fixture(scope="module", autouse=True)
def _learned_once() -> Iterator[None]:
    """What is learned from the same recordings is the same; these tests look at what the command makes of it."""
    known = dict[object, Learned]()

    def learn_once(
        level: KnowledgeLevel, machine: MachineFile, pieces: Sequence[HealthyPiece], progress: Progress
    ) -> Learned:
        key = machine.model_dump_json(), *(piece.window.spectrum.tobytes() for piece in pieces)
        if key not in known:
            known[key] = learn(level, machine, pieces, progress)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("models.commissioning.commission.learn", learn_once)
        yield


def test_a_machine_is_commissioned_again_only_with_a_reason(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ("--machine", "machine.toml", "--healthy", "monday.mcap", "friday.mcap", "--out", "kit")
    monkeypatch.setattr("simulator.commission.page.pictures_of", lambda *_: ())  # they take long
    found = run(folder, *arguments)
    assert found.exit_code == 0, found.stderr
    assert "bundle: kit" in found.stdout
    machine = load_machine_file(folder / "machine.toml")
    first = load_commissioned(folder / "kit", machine)
    assert (first.version, first.replaces, first.level) == (1, None, "none")
    assert [one.name for one in first.recordings] == ["monday.mcap", "friday.mcap"]
    assert [one.used_s for one in first.recordings] == [65.0, 35.0]
    assert len({one.sha256 for one in first.recordings}) == 2
    report = json.loads((folder / "kit" / "report.json").read_text(encoding="utf-8"))
    assert report["identity"] == first.identity
    assert "<html" in (folder / "kit" / "report.html").read_text(encoding="utf-8")

    again = run(folder, *arguments)
    assert again.exit_code == 2
    assert "kit holds version 1 of the commissioning of demo/lab: say why it is replaced" in again.stderr
    assert load_commissioned(folder / "kit", machine) == first

    most, size = resource.getrlimit(resource.RLIMIT_FSIZE), (folder / "kit" / "commissioned.json").stat().st_size
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, most[1]))  # a disk that is full at the end of the next one
    try:
        full = run(folder, *arguments, "--why", 200 * "x")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, most)
    assert "kit: cannot be written (File too large)" in full.stderr
    assert load_commissioned(folder / "kit", machine) == first

    again = run(folder, *arguments, "--why", "bearing exchanged")
    assert again.exit_code == 0, again.stderr
    second = load_commissioned(folder / "kit", machine)
    assert (second.version, second.replaces, second.why) == (2, first.identity, "bearing exchanged")
    assert json.loads((folder / "kit" / "commissioned-1.json").read_text(encoding="utf-8"))["version"] == 1


@pytest.mark.parametrize(
    ("of", "damaged", "why"),
    [
        ("heavy", False, "trained for another machine"),
        ("lab", False, ""),
        pytest.param("lab", True, "weights.safetensors", marks=pytest.mark.long),
    ],
)
def test_unusable_networks_are_removed_by_a_new_commissioning(
    folder: Path, of: str, damaged: bool, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("simulator.commission.page.pictures_of", lambda *_: ())
    out, stays = f"with-{of}-{damaged}", not why
    shutil.copytree(ROOT / "models" / "bundles" / of, folder / out)
    if damaged:
        (folder / out / "weights.safetensors").write_bytes(b"")
    found = run(folder, "--machine", "lab", "--healthy", "monday.mcap", "--out", out, "--no-networks")
    assert found.exit_code == 0, found.stderr
    told = " ".join(found.stdout.split())
    assert ("the networks that were there cannot be used and were removed" in told) is not stays
    assert why in told
    assert ("another machine" in told) is (of == "heavy")
    assert (install(LAB, folder / out).bundle is not None) is stays  # a monitor starts, whatever was there


def test_networks_that_cannot_be_read_stay_and_nothing_is_written(folder: Path) -> None:
    out = folder / "unreadable"
    shutil.copytree(ROOT / "models" / "bundles" / "lab", out)
    (out / "weights.safetensors").unlink()
    (out / "weights.safetensors").mkdir()
    found = run(folder, "--machine", "lab", "--healthy", "monday.mcap", "--out", out, "--no-networks")
    assert found.exit_code == 2
    assert "unreadable/weights.safetensors: cannot be read (Is a directory)" in " ".join(found.stderr.split())
    assert (out / "manifest.json").exists()
    assert not (out / "commissioned.json").exists()


def test_an_unfit_recording_is_refused_with_what_to_record(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simulator.commission.page.pictures_of", lambda *_: ())
    found = run(folder, "--machine", "machine.toml", "--healthy", "short.mcap", "--out", "never")
    assert found.exit_code == 3
    assert "too short: 15 s of usable data" in " ".join(found.stdout.split())
    assert not (folder / "never" / "commissioned.json").exists()
    report = json.loads((folder / "never" / "report.json").read_text(encoding="utf-8"))
    assert report["verdict"] == "refused"
    assert report["identity"] is None


def test_unusable_recordings_and_machine_files_are_refused(folder: Path) -> None:
    (folder / "other.toml").write_text(NOTHING_KNOWN.replace('name = "lab"', 'name = "pump"', 1), encoding="utf-8")
    found = run(folder, "--machine", "other.toml", "--healthy", "monday.mcap", "--out", "never")
    assert found.exit_code == 2
    assert "no hop of 5 s of demo/pump in it; it holds rotorwatch/demo/lab/stream; expected the site" in found.stderr
    moved = NOTHING_KNOWN.replace('location = "disc"', 'location = "DE"')
    (folder / "moved.toml").write_text(moved, encoding="utf-8")
    found = run(folder, "--machine", "moved.toml", "--healthy", "short.mcap", "--out", "never")
    assert "channels.4.location (y2) is 'disc', expected 'DE'" in " ".join(found.stdout.split())
    (folder / "broken.toml").write_text(NOTHING_KNOWN + "\nnonsense = 1\n", encoding="utf-8")
    found = run(folder, "--machine", "broken.toml", "--healthy", "monday.mcap", "--out", "never")
    assert found.exit_code == 2
    assert "nonsense" in found.stderr
    assert "Traceback" not in found.stderr


def trained(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "simulator.rotortrain", *arguments], capture_output=True, text=True, check=False
    )


@pytest.mark.slow
@pytest.mark.long
def test_train_writes_a_bundle_that_fits_the_machine(tmp_path: Path) -> None:
    """With windows of a third of the usual length: most of the time goes into simulating them."""
    out, file = tmp_path / "bundle", machine_file(tmp_path, ("length_s = 60.0", "length_s = 20.0"))
    size = ("--windows", "20", "--draws", "2000")
    done = trained("train", "--machine", file, "--out", str(out), *size, "--seed", "4", "--processes", "2")
    assert done.returncode == 0, done.stderr
    assert "(28) bearing" in done.stdout
    assert "written to" in done.stdout
    bundle = load_bundle(out, load_machine(file))
    assert bundle.manifest.training.training_windows == 20
    assert bundle.amortised is not None


def test_commands_with_missing_packages_say_what_to_install(tmp_path: Path) -> None:
    """As after an installation without extras, where there is no torch."""
    (tmp_path / "healthy.mcap").touch()
    code = (
        "import sys\n"
        "class Absent:\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name.partition('.')[0] in {'torch', 'matplotlib', 'jinja2'}:\n"
        "            raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Absent())\n"
        "from simulator.rotortrain import app\n"
        "for command in ('train', 'commission --healthy healthy.mcap'):\n"
        "    try:\n        app([*command.split(), '--machine', 'lab', '--out', 'bundle'])\n"
        "    except SystemExit as end:\n        print(end.code, file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    of_train, of_commission, rest = done.stderr.split("2\n")
    assert rest == ""
    for said in (of_train, of_commission):
        assert "pip install 'rotorwatch[train]'" in said
        assert len(said.splitlines()) < 4
