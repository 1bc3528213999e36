"""The container set-up: the compose file, its command lines as processes on loopback, and who may be reached.

No container engine is needed: the same commands run in the same topology, with host names and ports rewritten.
"""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
import pytest
import typer.main
import yaml

from models.errors import MachineFileError
from models.signals.link import LinkSettings
from service.commands.rotorwatch import app as rotorwatch
from service.settings.service import load_settings
from simulator.rotorsim import app as rotorsim
from tests.service.rig.live import ROOT, endpoint, program, until

COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
MODULES = {"rotorwatch": "service", "rotorsim": "simulator.rotorsim"}
PROGRAMS = {"rotorwatch": rotorwatch, "rotorsim": rotorsim}


def test_services_start_in_order_and_ports_are_published_only_on_loopback() -> None:
    assert set(SERVICES) == {"router", "monitor", "simulator"}
    assert SERVICES["monitor"]["depends_on"] == {"router": {"condition": "service_healthy"}}
    assert SERVICES["simulator"]["depends_on"] == {"monitor": {"condition": "service_healthy"}}
    published = {name: service["ports"] for name, service in SERVICES.items() if "ports" in service}
    assert published == {"monitor": ["127.0.0.1:8080:8080"]}
    assert COMPOSE["networks"]["streams"]["internal"] is True
    for name in ("router", "simulator"):
        assert SERVICES[name]["networks"] == ["streams"]


@pytest.mark.parametrize("name", SERVICES)
def test_services_have_minimal_rights_and_existing_commands_and_health_checks(name: str) -> None:
    service = SERVICES[name]
    user, group = service["user"].split(":")
    assert int(user) > 0
    assert int(group) > 0
    assert (service["read_only"], service["cap_drop"]) == (True, ["ALL"])
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert "privileged" not in service
    assert "cap_add" not in service
    assert service.get("network_mode") is None
    for mount in service.get("volumes", []):
        source, target, mode = mount.split(":")
        if source in COMPOSE["volumes"]:  # the history, in a folder of the image that is the user's own
            assert (target, mode) == ("/var/lib/rotorwatch", "rw")
            assert f"install -d -o {user} -g {group} -m 0700 {target}" in (ROOT / "Dockerfile").read_text()
        else:
            assert mode == "ro"
            assert (ROOT / source).is_file()
    check = SERVICES[name]["healthcheck"]
    assert check["test"][:3] == ["CMD", "python", "/opt/healthcheck.py"]
    assert {"interval", "timeout", "retries", "start_period"} <= set(check)
    assert "COPY deploy/healthcheck.py /opt/healthcheck.py" in (ROOT / "Dockerfile").read_text(encoding="utf-8")
    words = [str(word) for word in SERVICES[name]["command"]]
    group = typer.main.get_command(PROGRAMS[words[0]])
    command = group.commands[words[1]]  # type: ignore[attr-defined]  # the program has several commands
    known = {option for parameter in command.params for option in parameter.opts}
    assert {word for word in words if word.startswith("--")} <= known


def test_the_image_is_pinned_unprivileged_and_copies_only_unignored_files() -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    bases = re.findall(r"^FROM (\S+)", text, flags=re.MULTILINE)
    assert bases
    assert all(re.fullmatch(r"python:3\.11\.\d+-slim-bookworm", base) for base in bases)
    (user,) = re.findall(r"^USER (\S+)", text, flags=re.MULTILINE)
    assert {service["user"] for service in SERVICES.values()} == {user}
    assert re.search(r"useradd .*--uid 10001", text)
    assert text.count("--constraint constraints.txt") == text.count("pip install")
    let_in = {line[1:] for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines() if line[0] == "!"}
    copied = re.findall(r"^COPY (?!--from)(.+) \S+$", text, flags=re.MULTILINE)
    sources = {source for line in copied for source in line.split()}
    assert sources == let_in
    assert all((ROOT / source).exists() for source in sources)


def check_health(name: str, *rewrites: tuple[str, str]) -> subprocess.CompletedProcess[str]:
    words = [str(word) for word in SERVICES[name]["healthcheck"]["test"][3:]]
    for old, new in rewrites:
        words = [word.replace(old, new) for word in words]
    command = [sys.executable, str(ROOT / "deploy/healthcheck.py"), *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=180, check=False)


def test_the_services_commands_work_together(tmp_path: Path) -> None:
    address = endpoint()
    router_port, api_port = address.rsplit(":", 1)[1], endpoint().rsplit(":", 1)[1]
    settings = tmp_path / "monitor.toml"
    text = (ROOT / "deploy/monitor.toml").read_text(encoding="utf-8")
    for old, new in (("tcp/router:7447", address), ('host = "0.0.0.0"', 'host = "127.0.0.1"'), ("8080", api_port)):
        assert old in text
        text = text.replace(old, new)
    settings.write_text(text, encoding="utf-8")
    assert load_settings(settings).link.connect == (address,)

    def command(name: str) -> tuple[str, ...]:
        words = [str(word) for word in SERVICES[name]["command"]]
        rewrites = {
            "tcp/0.0.0.0:7447": address,
            "tcp/router:7447": address,
            "/etc/rotorwatch/monitor.toml": str(settings),
        }
        return (MODULES[words[0]], *(rewrites.get(word, word) for word in words[1:]))

    api = ("8080", api_port)
    streams = ("7447", router_port)
    for name in SERVICES:
        found = check_health(name, api, streams)
        assert found.returncode == 1, f"{name} is healthy before it runs"
        assert found.stderr
    with program(tmp_path, *command("router")) as router:
        until(lambda: check_health("router", streams).returncode == 0, "healthy router")
        with program(tmp_path, *command("monitor")) as monitor:
            monitor.wait_for(f"Zenoh connecting to {address}")
            until(lambda: check_health("monitor", api).returncode == 0, "healthy monitor")
            with program(tmp_path, *command("simulator")) as simulator:
                until(lambda: monitor.health().filled > 0, "a first hop of data through the router")
                assert check_health("simulator", streams).returncode == 0
                health = monitor.health()
                assert health.state == "warming"
                assert health.quality.accepted_blocks > 50
                assert health.quality.refused_blocks == {}
                assert health.stream.publisher_alive
                assert health.stream.descriptor_mismatch == ()
                assert simulator.stop() == 0
            until(lambda: not monitor.health().stream.publisher_alive, "end of the simulator noticed")
            assert httpx.get(f"{monitor.url()}/readyz", trust_env=False, timeout=180.0).status_code == 200
            assert monitor.stop() == 0
        assert router.stop() == 0


EVERYWHERE = "0.0.0.0"  # noqa: S104  # refused, or a free port for the length of a test


@pytest.mark.parametrize(
    "far",
    [
        "tcp/0.0.0.0:7447", "tcp/[::]:7447", "udp/10.0.0.5:7447", "tcp/monitor:7447", "tcp/0.0.0.0:7447#iface=lo",
        "vsock/1:2",
    ],
)  # fmt: skip
def test_listening_beyond_this_computer_needs_grants_or_without_grants(far: str) -> None:
    link = LinkSettings(listen=("tcp/127.0.0.1:7447", far))
    with pytest.raises(MachineFileError) as refused:
        link.check_reach("plant.toml")
    assert all(word in str(refused.value) for word in ("plant.toml", far, "grants", "without_grants = true"))
    link.model_copy(update={"without_grants": True}).check_reach("plant.toml")
    LinkSettings(connect=(far,)).check_reach("plant.toml")  # the other side decides who may connect


def test_grants_with_users_are_enough_and_loopback_needs_none(tmp_path: Path) -> None:
    for near in (
        "tcp/127.0.0.1:7447",
        "tcp/127.8.0.1:7447",
        "tcp/localhost:7447",
        "tcp/[::1]:7447",
        "unixsock-stream//s",
    ):
        LinkSettings(listen=(near,)).check_reach("settings")
    (tmp_path / "p").write_text("a:b\n")
    grants = ({"who": ("a",), "publishes": ("demo/lab",)},)
    link = {"listen": ("tcp/0.0.0.0:7447",), "passwords_file": tmp_path / "p"}
    LinkSettings.model_validate({**link, "grants": grants}).check_reach("settings")
    with pytest.raises(MachineFileError):  # anybody with a password could do everything
        LinkSettings.model_validate(link).check_reach("settings")
    with pytest.raises(ValueError, match="without_grants"):
        LinkSettings.model_validate({**link, "grants": grants, "without_grants": True})


OPEN_LINK = '[link]\nlisten = ["tcp/{}:{}"]'
OPEN_API = '[http]\nhost = "{}"\nport = {}\n[access]\nopen_on_loopback = true'


@pytest.mark.parametrize(
    ("name", "text", "cure"),
    [
        ("run", OPEN_LINK, "without_grants = true"), ("run", OPEN_API, "rotorwatch token create"),
        ("run", "", "without"), ("router", "", "without"),
    ],
    ids=["settings of the link", "settings of the API", "run", "router"],
)  # fmt: skip
def test_programs_open_to_other_computers_do_not_start(tmp_path: Path, name: str, text: str, cure: str) -> None:
    port, file = endpoint().rpartition(":")[2], tmp_path / "plant.toml"
    file.write_text(text.format(EVERYWHERE, port), encoding="utf-8")
    options = ("--config", str(file)) if text else ("--listen", f"tcp/{EVERYWHERE}:{port}")
    with program(tmp_path, "service", name, *options) as started:
        assert started.process.wait(180) == 2
        (said,) = started.errors().splitlines()
        assert cure in said
        assert EVERYWHERE in said


@pytest.mark.slow
def test_without_grants_lets_programs_listen_everywhere(tmp_path: Path) -> None:
    where = endpoint().replace("127.0.0.1", EVERYWHERE)
    with program(tmp_path, "service", "router", "--listen", where, "--without-grants") as router:
        router.wait_for("listening")
        assert router.stop() == 0
    file = tmp_path / "plant.toml"
    file.write_text(f'[link]\nlisten = ["{where}"]\nwithout_grants = true\n', encoding="utf-8")
    with program(tmp_path, "service", "run", "--config", str(file), "--http-port", "0") as monitor:
        monitor.url()
        assert monitor.health().quality.accepted_blocks == 0  # it runs
        assert monitor.stop() == 0
