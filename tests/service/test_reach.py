"""What other computers reach is refused at the start, unless grants or the settings say who may do what there."""

from pathlib import Path

import pytest

from models.errors import MachineFileError
from models.signals.link import LinkSettings
from tests.service.live import endpoint, program, until

EVERYWHERE = "0.0.0.0"  # noqa: S104  # refused, or a free port for the length of a test


@pytest.mark.parametrize(
    "near",
    ["tcp/127.0.0.1:7447", "tcp/127.8.0.1:7447", "tcp/localhost:7447", "tcp/[::1]:7447", "unixsock-stream//tmp/s"],
)
def test_this_computer_needs_no_grants(near: str) -> None:
    LinkSettings(listen=(near,)).check_reach("settings")


@pytest.mark.parametrize(
    "far",
    [
        "tcp/0.0.0.0:7447",
        "tcp/[::]:7447",
        "udp/10.0.0.5:7447",
        "tcp/monitor:7447",
        "tcp/0.0.0.0:7447#iface=lo",
        "vsock/1:2",
    ],
)
def test_others_reach_nothing_without_grants(far: str) -> None:
    link = LinkSettings(listen=("tcp/127.0.0.1:7447", far))
    with pytest.raises(MachineFileError) as refused:
        link.check_reach("plant.toml")
    assert all(word in str(refused.value) for word in ("plant.toml", far, "grants", "without_grants = true"))
    link.model_copy(update={"without_grants": True}).check_reach("plant.toml")
    LinkSettings(connect=(far,)).check_reach("plant.toml")  # who may connect there is for others to say


def test_the_shipped_grants_are_enough(tmp_path: Path) -> None:
    (tmp_path / "p").write_text("a:b\n")
    grants = ({"who": ("a",), "publishes": ("demo/lab",)},)
    link = {"listen": ("tcp/0.0.0.0:7447",), "passwords_file": tmp_path / "p"}
    LinkSettings.model_validate({**link, "grants": grants}).check_reach("settings")
    with pytest.raises(MachineFileError):  # whoever has a password could do everything
        LinkSettings.model_validate(link).check_reach("settings")
    with pytest.raises(ValueError, match="without_grants"):
        LinkSettings.model_validate({**link, "grants": grants, "without_grants": True})


OPEN_LINK = '[link]\nlisten = ["tcp/{}:{}"]'
OPEN_API = '[http]\nhost = "{}"\nport = {}\n[access]\nopen_on_loopback = true'


@pytest.mark.parametrize(
    ("text", "cure"),
    [(OPEN_LINK, "without_grants = true"), (OPEN_API, "rotorwatch token create")],
    ids=["zenoh", "http"],
)
def test_a_monitor_open_to_others_does_not_start(tmp_path: Path, text: str, cure: str) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(text.format(EVERYWHERE, endpoint().rpartition(":")[2]), encoding="utf-8")
    with program(tmp_path, "service.rotorwatch", "run", "--config", str(file)) as started:
        assert started.process.wait(180) == 2
        (said,) = started.errors().splitlines()
        assert cure in said
        assert EVERYWHERE in said


@pytest.mark.parametrize("name", ["run", "router"])
def test_what_the_command_line_opens_is_refused_as_well(tmp_path: Path, name: str) -> None:
    where = endpoint().replace("127.0.0.1", EVERYWHERE)
    with program(tmp_path, "service.rotorwatch", name, "--listen", where) as started:
        assert started.process.wait(180) == 2
        (said,) = started.errors().splitlines()
        assert where in said
        assert "without" in said


@pytest.mark.slow
def test_settings_that_say_so_in_so_many_words_are_obeyed(tmp_path: Path) -> None:
    where = endpoint().replace("127.0.0.1", EVERYWHERE)
    with program(tmp_path, "service.rotorwatch", "router", "--listen", where, "--without-grants") as router:
        router.wait_for("listening")
        assert router.stop() == 0
    file = tmp_path / "plant.toml"
    file.write_text(f'[link]\nlisten = ["{where}"]\nwithout_grants = true\n', encoding="utf-8")
    with program(tmp_path, "service.rotorwatch", "run", "--config", str(file), "--http-port", "0") as monitor:
        monitor.url()
        until(lambda: monitor.health().state == "no-data", "a monitor that runs")
        assert monitor.stop() == 0
