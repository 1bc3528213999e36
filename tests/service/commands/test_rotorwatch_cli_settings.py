"""Settings: the file, the environment that overrides it, and messages about mistakes."""

from pathlib import Path

import pytest

from models.errors import MachineFileError
from service.settings.service import DEFAULT_LISTEN, load_settings
from tests.service.rig.live import machine_file
from tests.service.rig.preloaded import rotorwatch as run

GOOD = """
[link]
listen = ["tcp/127.0.0.1:7001"]

[http]
port = 9000

[[machines]]
file = "machine.toml"
bundle = "lab"

[queue]
blocks = 10
when_full = "wait"
"""


def written(folder: Path, text: str) -> Path:
    machine_file(folder)
    path = folder / "service.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_defaults_watch_the_shipped_machine_on_loopback() -> None:
    settings = load_settings()
    assert [(entry.file, entry.bundle) for entry in settings.machines] == [("lab", "lab")]
    assert (settings.link.listen, settings.http.host) == ((DEFAULT_LISTEN,), "127.0.0.1")
    assert settings.queue.when_full == "drop"


def test_paths_are_relative_to_the_file_and_the_environment_overrides_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = load_settings(written(tmp_path, GOOD))
    assert (settings.http.port, settings.queue.blocks) == (9000, 10)
    assert (settings.machines[0].file, settings.machines[0].bundle) == (str(tmp_path / "machine.toml"), "lab")
    assert settings.machines[0].load().name == "lab"
    (tmp_path / "lab").mkdir()
    assert load_settings(tmp_path / "service.toml").machines[0].bundle == str(tmp_path / "lab")
    monkeypatch.setenv("ROTORWATCH_HTTP__PORT", "9001")
    monkeypatch.setenv("ROTORWATCH_MACHINES", '[{"file": "heavy"}]')
    settings = load_settings(tmp_path / "service.toml")
    assert (settings.http.port, settings.queue.blocks) == (9001, 10)
    assert [(entry.file, entry.bundle) for entry in settings.machines] == [("heavy", None)]


@pytest.mark.parametrize(
    "text",
    [
        '[history]\nurll = "postgresql://plant:bolt@db/rotorwatch"\n',
        '[history]\nurl = ["postgresql://plant:bolt@db/rotorwatch"]\n',
        'history = "postgresql://plant:bolt@db/rotorwatch"\n',
        '[[webhooks]]\nname = "pager"\nulr = "https://pager.example/?key=bolt"\n',
    ],
)
def test_an_error_in_settings_shows_no_password(tmp_path: Path, text: str) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(MachineFileError, match=r"plant.toml: (history|webhooks)") as caught:
        load_settings(path)
    assert "bolt" not in str(caught.value)


def test_check_config_reports_valid_and_invalid_files(tmp_path: Path) -> None:
    good = written(tmp_path, GOOD)
    wrong_machine = tmp_path / "wrong.toml"
    wrong_machine.write_text(
        (tmp_path / "machine.toml").read_text(encoding="utf-8").replace("rate_hz = 2000.0", "rate_hz = -1.0"),
        encoding="utf-8",
    )
    wrong_bundle = tmp_path / "bundle.toml"
    wrong_bundle.write_text('[[machines]]\nfile = "heavy"\nbundle = "lab"\n', encoding="utf-8")
    forgotten = tmp_path / "forgotten.toml"  # a missing field is not an error
    lines = (tmp_path / "machine.toml").read_text(encoding="utf-8").splitlines()
    forgotten.write_text("\n".join(one for one in lines if "I2p_kg_m2" not in one), encoding="utf-8")
    fine = run("check-config", str(good), str(tmp_path / "machine.toml"), str(forgotten))
    assert (fine.returncode, fine.stderr) == (0, "")
    assert f"{good}: ok, settings for demo/lab" in fine.stdout
    found = "9 channels at 2000 Hz; windows of 60 s every 5 s, segments of 5 s, 3 to 150 Hz; knowledge level full"
    assert f"{tmp_path / 'machine.toml'}: ok, machine demo/lab, {found}" in fine.stdout
    assert "knowledge level none: [rotor] lacks I2p_kg_m2" in fine.stdout
    compared = "levels are compared with the first 5 windows, 300 s, until it is commissioned"
    assert [compared in line for line in fine.stdout.splitlines()] == [False, False, True]
    elsewhere = tmp_path / "elsewhere.toml"
    elsewhere.write_text('[http]\nhost = "192.0.2.1"\n', encoding="utf-8")  # of documentation: no computer's
    there = run("check-config", str(elsewhere))
    assert (there.returncode, there.stderr) == (0, "")
    assert "demo/lab; this computer cannot listen on http.host 192.0.2.1 (Cannot assign requested" in there.stdout
    mixed = run("check-config", str(good), str(wrong_machine), str(wrong_bundle))
    assert mixed.returncode == 2
    assert f"{good}: ok" in mixed.stdout
    assert f"{wrong_machine}: rate_hz: expected above 0 and at most 1000000 (found -1.0)" in mixed.stderr
    assert str(wrong_bundle) in mixed.stderr
