"""The shipped link files and the documented commands work, together and with the real programs."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from models.signals.link import load_link
from service.runtime import running
from service.settings.service import HttpSettings, MachineEntry, ServiceSettings
from service.stream.transport import Link, TopicMessage, follow
from tests.service.live import LAB, ROOT, endpoint, program, until
from tests.service.plant import kept

SHIPPED = ROOT / "deploy" / "zenoh"


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made with the commands of the documentation."""
    if shutil.which("openssl") is None:  # a fresh machine has Python, git and make alone
        pytest.skip("openssl is not installed: the documented commands cannot be tried")
    page = (ROOT / "docs" / "zenoh-security.md").read_text(encoding="utf-8")
    (commands,) = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    folder = tmp_path_factory.mktemp("certificates")
    text = "set -e\n" + commands.replace("router.plant.example", "localhost")
    subprocess.run(["sh", "-c", text], cwd=folder, check=True, capture_output=True)
    return folder


@pytest.mark.parametrize("level", sorted(path.name for path in SHIPPED.iterdir() if path.is_dir()))
def test_the_shipped_examples_work_together(tmp_path: Path, level: str, request: pytest.FixtureRequest) -> None:
    port = endpoint().rpartition(":")[2]
    folder = tmp_path / "link"
    shutil.copytree(SHIPPED / level, folder)
    if level == "mutual-tls":
        shutil.copytree(request.getfixturevalue("certificates"), folder, dirs_exist_ok=True)
    else:
        names = ("logger-lab", "monitor-1", "control-room")
        kept(folder / "passwords.txt", "".join(f"{name}:of-{name}\n" for name in names))
        for name in names:
            kept(folder / f"{name}.password", f"of-{name}\n")
    for path in folder.glob("*.toml"):
        text = path.read_text(encoding="utf-8").replace("0.0.0.0:7447", f"127.0.0.1:{port}")
        path.write_text(text.replace("router.plant.example:7447", f"localhost:{port}"), encoding="utf-8")
    assert {path.stem for path in folder.glob("*.toml")} == {"router", "monitor", "publisher", "viewer"}
    messages: list[TopicMessage] = []
    plan = ServiceSettings(
        link=load_link(folder / "monitor.toml"), http=HttpSettings(port=0), machines=(MachineEntry(file="lab"),)
    )
    load_link(SHIPPED / level / "router.toml").check_reach("shipped")  # as it is: on every network of the computer
    gate = Link(load_link(folder / "router.toml"))
    try:
        with (
            running(plan) as service,
            follow(load_link(folder / "viewer.toml"), "demo/*", ("health", "alarm_event"), messages.append),
            program(
                tmp_path, "simulator.rotorsim", "publish", "healthy", "--duration", "3", "--pace", "max",
                "--wait-for-subscriber", "30", "--linger", "0", "--link", str(folder / "publisher.toml"),
            ) as publisher,
        ):  # fmt: skip
            publisher.wait_for("published 30 blocks")
            until(lambda: service.machines()[0].health().stream.data_age_s is not None, "accepted blocks")
            until(lambda: any(message.key == LAB.keys.health for message in messages), "health at the viewer")
    finally:
        gate.close()


def test_rotorsim_says_what_it_cannot_use(tmp_path: Path) -> None:
    address = endpoint()
    (tmp_path / "link.toml").write_text(
        f'[link]\nmode = "client"\nconnect = ["{address}"]\nuser = "lab"\npassword_file = "p"\n', encoding="utf-8"
    )
    arguments = ("simulator.rotorsim", "publish", "--duration", "3", "--link", str(tmp_path / "link.toml"))
    for mode, code, said in ((0o644, 2, "chmod 600"), (0o600, 1, "does not know the user lab")):
        kept(tmp_path / "p", "word-of-lab").chmod(mode)
        with program(tmp_path, *arguments) as publisher:
            assert publisher.process.wait(180) == code
            assert said in publisher.errors()
            assert "Traceback" not in publisher.errors()
            assert "word-of-lab" not in publisher.errors() + publisher.output()
