"""Mistakes in files and arguments, and their error messages: ``mistakes/*.toml`` is the table.

A message names the file or argument, the field, the value and what was expected, in a user's words, without
internals of libraries. To read all of them: ``pytest tests/test_mistakes.py -rA``.
"""

import os
import re
import shlex
import socket
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from models.errors import MachineFileError
from models.machine import load_machine, load_machine_file
from service.commands.rotorwatch import app as rotorwatch
from service.settings.service import load_settings
from simulator.rotorsim import app as rotorsim
from simulator.rotortrain import app as rotortrain
from tests.service.rig.live import ROOT, endpoint

TABLES = Path(__file__).parent / "mistakes"
PROGRAMS = {"rotorwatch": rotorwatch, "rotorsim": rotorsim, "rotortrain": rotortrain}
OF_THE_INSIDE = re.compile(
    r"pydantic|Traceback|\.rs\b|validation error|type=|Extra inputs|Field required|Input should|sqlalchemy|zenoh::"
    r"|json5|click|typer|Errno|tomllib|Value error|greater than|less than|object at 0x|\\n",
    re.IGNORECASE,
)

SETTINGS = """
[link]
listen = ["tcp/127.0.0.1:7001"]

[http]
port = 9000

[queue]
blocks = 10
when_full = "drop"

[history]
url = "sqlite:///history.sqlite"

[log]
level = "info"

[[machines]]
file = "machine.toml"
"""
MAPPING = """
[time]
column = "Time"
unit = "s"
start = "2026-01-31T12:00:00Z"

[channels]
y1 = { column = "Brg Y", unit = "um" }
""" + "".join(f'{one.name} = {{ column = "{one.name}" }}\n' for one in load_machine("lab").sensors[1:])

GOOD = {
    "machine": ("rotorwatch check-config machine.toml", (ROOT / "models/machines/lab.toml").read_text("utf-8")),
    "settings": ("rotorwatch check-config service.toml", SETTINGS),
    "scenario": ("rotorsim record mine.toml run.mcap", (ROOT / "simulator/scenarios/k_by.toml").read_text("utf-8")),
    "mapping": ("rotorwatch import run.csv --mapping mapping.toml --machine machine.toml --out run.mcap", MAPPING),
}
NAMES = {"machine": "machine.toml", "settings": "service.toml", "scenario": "mine.toml", "mapping": "mapping.toml"}
MISTAKES = [
    pytest.param(table.stem, one, id=f"{table.stem}-{number}")
    for table in sorted(TABLES.glob("*.toml"))
    for number, one in enumerate(tomllib.loads(table.read_text("utf-8"))["mistake"], start=1)
]


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[dict[str, str]]:
    """A folder with good files, and the ports for the placeholders in the table."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    for kind, (_, text) in GOOD.items():
        (tmp_path / NAMES[kind]).write_text(text, "utf-8")
    (tmp_path / "run.csv").write_text("Time\n0\n", "utf-8")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        yield {"OCCUPIED": str(taken.getsockname()[1]), "NOBODY": endpoint().rpartition(":")[2]}


@pytest.mark.parametrize(("kind", "mistake"), MISTAKES)
def test_an_error_states_the_facts_without_library_internals(
    kind: str, mistake: dict[str, Any], ports: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = mistake.get("command") or GOOD[kind][0]
    if "change" in mistake:
        before, after = (text.replace("\\n", "\n") for text in mistake["change"])
        path, text = Path(NAMES[kind]), GOOD[kind][1]
        assert before in text
        path.write_text(text.replace(before, after, 1), mistake.get("encoding", "utf-8"))
    for name, value in mistake.get("environment", {}).items():
        monkeypatch.setenv(name, value)

    def ported(text: str) -> str:
        return re.sub("|".join(ports), lambda found: ports[found[0]], text)

    program, *arguments = shlex.split(ported(command))
    result = CliRunner().invoke(PROGRAMS[program], arguments, prog_name=program)
    told = result.output
    sys.stdout.write(f"$ {command}  {mistake.get('change', mistake.get('environment', ''))}\n{told}")
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code == mistake.get("exit", 2)
    for fact in mistake["says"]:
        assert ported(fact) in told
    if "change" in mistake and result.exit_code:
        assert NAMES[kind] in told
    assert not OF_THE_INSIDE.search(told)
    assert len(told.splitlines()) < 12


def test_files_without_mistakes_are_accepted(ports: dict[str, str]) -> None:
    for kind in ("machine", "settings"):
        assert CliRunner().invoke(rotorwatch, shlex.split(GOOD[kind][0])[1:]).exit_code == 0


@pytest.mark.parametrize(
    ("number", "told"), [("9" * 5000, "too many digits"), (f"0x{'f' * 5000}", "rate_hz: expected")]
)
def test_a_number_of_thousands_of_digits_is_refused(number: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "machine.toml").write_text(f"rate_hz = {number}\n", encoding="utf-8")
    with pytest.raises(MachineFileError, match=told):
        load_machine_file(tmp_path / "machine.toml")


def test_a_named_pipe_without_a_writer_does_not_block(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "service.toml")
    with pytest.raises(MachineFileError, match="is empty"):
        load_settings(tmp_path / "service.toml")
