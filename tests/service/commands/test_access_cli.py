"""``rotorwatch token`` and ``rotorwatch audit`` beside a running service, on the same database."""

import os
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner, Result

from service.access.scopes import Scope
from service.commands import access as access_commands
from service.commands.rotorwatch import app
from service.settings.service import HistorySettings
from tests.service.rig.guarded import Guarded, guarded
from tests.service.rig.live import ROOT, endpoint, program
from tests.service.rig.preloaded import ran


@pytest.fixture(autouse=True)
def _wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "300")


@pytest.fixture
def config(tmp_path: Path) -> str:
    path = tmp_path / "plant.toml"
    path.write_text('[history]\nurl = "sqlite:///history.sqlite"\n', encoding="utf-8")
    return str(path)


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, arguments)


def status(monitor: Guarded, token: str, method: str = "GET", path: str = "/health") -> int:
    with monitor.client(token) as client:
        return client.request(method, path).status_code


def test_a_token_works_from_its_creation_until_its_revocation(tmp_path: Path, config: str) -> None:
    with guarded(tmp_path) as monitor:
        created = run("token", "create", "control room", "--scope", "read", "--days", "90", "--config", config)
        assert created.exit_code == 0, created.output
        token = created.stdout.strip()
        assert "shown this once" in created.stderr
        assert token not in created.stderr
        assert (status(monitor, token), status(monitor, token, "DELETE", "/machine")) == (200, 403)

        listed = run("token", "list", "--config", config).stdout
        token_id, secret = token.split("_")[1:]
        assert token_id in listed
        assert "control room" in listed
        assert "valid" in listed
        assert secret not in listed

        again = run("token", "create", "control room", "--scope", "read", "--config", config)
        assert again.exit_code == 2
        assert "already valid" in again.stderr

        revoked = run("token", "revoke", token_id, "--config", config)
        assert revoked.exit_code == 0
        assert status(monitor, token) == 401
        assert "was revoked at" in run("token", "revoke", token_id, "--config", config).stdout
        assert "revoked" in run("token", "list", "--config", config).stdout

        written = run("audit", "--config", config).stdout
        assert "create-token" in written
        assert "revoke-token" in written
        assert secret not in written


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("create", "x"), "scope: none is given, expected one or more of read, operate, configure"),
        (("create", "x", "--scope", "admin"), "--scope is admin, expected read, operate, configure"),
        (("create", "x", "--scope", "read", "--days", "0"), "days is 0, expected 1 to 3650"),
        (("create", " ", "--scope", "read"), "name is ' '"),
        (("create", "", "--scope", "read"), "name is ''"),
        (("create", 65 * "x", "--scope", "read"), "expected 1 to 64 printable characters"),
        (("revoke", "000000000000"), "there is no token '000000000000'"),
    ],
)
def test_wrong_arguments_exit_2_with_a_message(config: str, arguments: tuple[str, ...], expected: str) -> None:
    result = run("token", *arguments, "--config", config)
    assert result.exit_code == 2
    assert expected in result.stderr


def test_narrow_terminals_show_all_columns(config: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    scopes = [word for scope in Scope for word in ("--scope", scope)]
    token = run("token", "create", "a dashboard beside the door", *scopes, "--config", config).stdout
    token_id = token.split("_")[1]
    assert token_id in run("token", "list", "--config", config).stdout
    (line,) = run("audit", "--config", config).stdout.splitlines()
    assert line.endswith(f"create-token: {token_id}, a dashboard beside the door, {' '.join(Scope)}")


def test_token_commands_refuse_a_history_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROTORWATCH_HISTORY__URL", "sqlite:///:memory:")
    result = run("token", "list")
    assert result.exit_code == 2
    assert "in memory" in result.stderr


def test_the_audit_log_shows_each_action_once(tmp_path: Path, config: str) -> None:
    with guarded(tmp_path) as monitor:
        token = monitor.token(*Scope, name="control room")
        with monitor.client(token) as client:
            client.post("/alarms/k_by/shelve", json={"reason": "[bold]bolt[/bold] replaced"})
            client.delete("/machine")
        with monitor.client() as nobody:
            nobody.get("/health")
        visit = monitor.guard.trail.visit("10.0.0.1", "POST", "/cut/short")
        monitor.guard.trail.start(visit)
        lines = run("audit", "--config", config).stdout.splitlines()
        assert len(lines) == 4
        wanted = (
            "POST /cut/short", "GET /health", "DELETE /machine", "shelve demo/lab k_by: [bold]bolt[/bold] replaced",
        )  # fmt: skip
        for line, what in zip(lines, wanted, strict=True):
            assert what in line
        assert "not known" in lines[0]
        assert "control room" in lines[-1]
        chosen = run("audit", "--machine", "demo/lab", "--config", config).stdout
        assert "k_by" in chosen
        assert "DELETE" not in chosen
        assert run("audit", "--machine", "demo/lba", "--config", config).stderr == "no entries\n"
        refused = run("audit", "--machine", "lab", "--config", config)
        assert refused.exit_code == 2
        assert "--machine is 'lab', expected SITE/MACHINE" in refused.stderr
        assert "DELETE" not in run("audit", "--limit", "2", "--config", config).stdout
        assert "GET /health" not in run("audit", "--actor", "control room", "--config", config).stdout


def test_the_command_printed_by_a_monitor_creates_a_valid_token(tmp_path: Path) -> None:
    """The address of its history comes from its environment, which overrides the settings file."""
    folder = tmp_path / "a plant"
    folder.mkdir()
    (folder / "plant.toml").write_text('[history]\nurl = "sqlite:///other.sqlite"\n', encoding="utf-8")
    arguments = ["--listen", endpoint(), "--http-port", "0", "--config", "plant.toml"]
    plain = {name: value for name, value in os.environ.items() if not name.startswith(("ROTORWATCH_", "XDG_"))}
    plain |= {"PYTHONPATH": str(ROOT), "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    plain |= {"HOME": str(tmp_path)}
    alone = plain | {"ROTORWATCH_HISTORY__URL": "sqlite:///its own.sqlite"}
    with program(tmp_path, "service", "run", *arguments, cwd=folder, alone=alone) as monitor:
        url = monitor.url()
        monitor.wait_for("token create")
        hint = next(line for line in monitor.output().splitlines() if "token create" in line)
        command = hint.split(": ", 1)[1]
        # In another terminal: another folder, and nothing of the monitor's environment.
        created = subprocess.run(
            ["sh", "-c", command], cwd=tmp_path, env=plain, capture_output=True, text=True, check=True
        )
        headers = {"authorization": f"Bearer {created.stdout.strip()}"}
        assert httpx.get(f"{url}/api/v1/machines", headers=headers, trust_env=False, timeout=180.0).status_code == 200


def test_the_hint_names_the_history_without_a_password(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert f"ROTORWATCH_HISTORY__URL=sqlite:///{tmp_path}/" in access_commands.creation_hint(None, HistorySettings())
    url = "postgresql://watch:secret@db/plant"
    monkeypatch.setenv("ROTORWATCH_HISTORY__URL", url)
    told = access_commands.creation_hint(None, HistorySettings(url=url))
    assert "secret" not in told
    assert "ROTORWATCH_HISTORY__URL" in told
    in_memory = access_commands.creation_hint(None, HistorySettings(url="sqlite:///:memory:"))
    assert "token create" not in in_memory


def test_status_says_why_a_token_is_refused(tmp_path: Path) -> None:
    with guarded(tmp_path) as monitor, monitor.client() as client:
        wanted = client.get("/docs").json()["detail"]
        wrong = "rw_000000000000_" + 43 * "0"
        plain = {name: value for name, value in os.environ.items() if name != "ROTORWATCH_TOKEN"}
        without, mistaken = (
            ran("service", "status", "--url", monitor.url, environment=plain | more)
            for more in ({}, {"ROTORWATCH_TOKEN": wrong})
        )
    assert (without.returncode, mistaken.returncode) == (4, 4)
    assert wanted in without.stderr
    assert "not valid" in mistaken.stderr
