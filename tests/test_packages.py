"""Contents of both wheels; running from a checkout that is not installed; help without heavy imports."""

import shutil
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Iterator
from email import message_from_bytes
from email.message import Message
from pathlib import Path

import pytest

import rotorwatch

ROOT = Path(__file__).parents[1]
PACKAGES = ("models", "rotorwatch", "service", "simulator")
SHIPPED = {".py", ".toml", ".json", ".safetensors", ".jinja", ".mako", ".typed", ".dictionary", ".js", ".css", ".html"}
PROGRAMS = {
    "rotorsim": "simulator.rotorsim",
    "rotortrain": "simulator.rotortrain",
    "rotorwatch": "service.commands.rotorwatch",
}
HEAVY = {"scipy", "torch", "zenoh", "fastapi", "pyarrow", "mcap"}


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Both wheels by their distribution's name, from a copy: setuptools builds in the tree, and keeps old files."""
    copy, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheels")
    for package in PACKAGES:
        left_out = shutil.ignore_patterns("__pycache__", "build", "*.egg-info")
        shutil.copytree(ROOT / package, copy / package, ignore=left_out)
    for name in ("pyproject.toml", "README.md", "LICENSE", "tests"):
        place = ROOT / name
        shutil.copytree(place, copy / name) if place.is_dir() else shutil.copy(place, copy)
    build = f"from setuptools.build_meta import build_wheel; build_wheel({str(out)!r})"  # as pip would call it
    for folder in (copy, copy / "rotorwatch"):
        done = subprocess.run([sys.executable, "-c", build], cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    return {path.name.split("-")[0]: path for path in out.glob("*.whl")}


@pytest.fixture(scope="module")
def others(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything that is installed here except rotorwatch."""
    folder = tmp_path_factory.mktemp("others")
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if "rotorwatch" not in entry.name and entry.suffix != ".pth":
            (folder / entry.name).symlink_to(entry)
    return folder


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The packages as they are here, without what an installation leaves beside them."""
    folder = tmp_path_factory.mktemp("checkout")
    for package in PACKAGES:
        (folder / package).symlink_to(ROOT / package)
    return folder


def in_new_process(code: str, *paths: Path, cwd: Path) -> str:
    """Run code with only the standard library and these folders on its path, and return what it printed."""
    begin = f"import sys; sys.path[:0] = {[str(path) for path in paths]}; "
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", begin + code], cwd=cwd, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def metadata(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return message_from_bytes(archive.read(name))


def requirements(wheel: Path) -> list[str]:
    return metadata(wheel).get_all("Requires-Dist", [])


def contents(wheel: Path) -> Iterator[str]:
    with zipfile.ZipFile(wheel) as archive:
        yield from (name for name in archive.namelist() if ".dist-info/" not in name)


def files_of(*packages: str) -> set[str]:
    return {
        str(path.relative_to(ROOT))
        for package in packages
        for path in (ROOT / package).rglob("*")
        if path.suffix in SHIPPED and path != ROOT / "rotorwatch" / "pyproject.toml" and "build" not in path.parts
    }


def test_one_wheel_holds_all_files_of_the_programs_and_another_the_client(wheels: dict[str, Path]) -> None:
    assert set(contents(wheels["rotorwatch"])) == files_of(*PACKAGES)
    assert set(contents(wheels["rotorwatch_client"])) == files_of("rotorwatch")
    needed = [line for line in requirements(wheels["rotorwatch_client"]) if "extra" not in line]
    assert {line.split("<")[0].split(">")[0] for line in needed} == {"httpx", "httpx-sse", "pydantic"}


def test_both_wheels_state_version_and_licence_and_agree_on_requirements(wheels: dict[str, Path]) -> None:
    for wheel in wheels.values():
        found = metadata(wheel)
        assert (found["Version"], found["License-Expression"]) == (rotorwatch.__version__, "Apache-2.0")
        with zipfile.ZipFile(wheel) as archive:
            (licence,) = (name for name in archive.namelist() if name.endswith("licenses/LICENSE"))
            assert archive.read(licence) == (ROOT / "LICENSE").read_bytes()
    client = {line.split(";")[0] for line in requirements(wheels["rotorwatch_client"])}
    assert client <= set(requirements(wheels["rotorwatch"]))


def test_the_installed_client_loads_no_server(wheels: dict[str, Path], others: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(wheels["rotorwatch_client"]) as archive:
        archive.extractall(tmp_path / "site")
    code = (
        "from rotorwatch import Client; Client().close(); print(*sorted(sys.modules)); print(Client.__module__); "
        "import rotorwatch.client.alarm_log; print('models' in sys.modules, 'service' in sys.modules)"
    )
    loaded, where, more = in_new_process(code, tmp_path / "site", others, cwd=tmp_path).splitlines()
    assert where == "rotorwatch.client.client"
    heavy = {"numpy", "scipy", "fastapi", "starlette", "uvicorn", "sqlalchemy", "zenoh", "models", "service"}
    assert not heavy & set(loaded.split())
    assert more == "False False"


def test_an_uninstalled_checkout_is_imported_without_torch(checkout: Path, others: Path, tmp_path: Path) -> None:
    code = (
        "import importlib.metadata as m, simulator.commission.command; print('torch' in sys.modules); "
        "import service.runtime.runtime; "
        "print([d.name for d in m.distributions() if d.name.startswith('rotorwatch')])"
    )
    assert in_new_process(code, checkout, others, cwd=tmp_path) == "False\n[]"


@pytest.mark.parametrize(
    ("program", "command", "heavy", "said"),
    [
        ("rotorwatch", [], HEAVY | {"numpy"}, ("run", "check-config", "watch", "status", "router")),
        ("rotorsim", ["publish"], HEAVY, ("back-pressure",)),
        ("rotortrain", ["train"], HEAVY | {"numpy"}, ("rotortrain train --machine lab",)),
    ],
)
def test_programs_of_an_uninstalled_checkout_state_their_version_and_help_without_heavy_imports(
    checkout: Path, others: Path, tmp_path: Path,
    program: str, command: list[str], heavy: set[str], said: tuple[str, ...],
) -> None:  # fmt: skip
    code = (
        f"from {PROGRAMS[program]} import app\n"
        f"for arguments in (['--version'], [*{command}, '--help']):\n"
        f"    try:\n        app(arguments, prog_name='{program}')\n    except SystemExit:\n        pass\n"
        f"print('loaded:', *{heavy} & set(sys.modules))"
    )
    version, *told, loaded = in_new_process(code, checkout, others, cwd=tmp_path).splitlines()
    assert version == f"{program} {rotorwatch.__version__}"
    assert loaded == "loaded:"
    assert all(word in "\n".join(told) for word in said)
