"""Settings of webhooks, their secrets and commands; the meaning of responses; pauses between attempts."""

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from models.errors import MachineFileError
from service.commands.rotorwatch import app
from service.delivery.webhooks.receiver import Answer, Meaning, Receiver, answer_of, pause_s
from service.delivery.webhooks.signature import new_secret, parse_secret, signing_keys
from service.runtime.runtime import Runtime
from service.settings.service import load_settings
from service.settings.webhooks import WebhookSettings
from tests.service.delivery.hooked import hook, settings_for
from tests.service.rig.live import IN_ORDER, Feed, endpoint, machine_file, open_session, program, settings, until

GOOD = """
[[webhooks]]
name = "pager"
url = "https://pager.example/v1/rotor?key=hush-hush"
secret_file = "pager.secret"
machines = ["demo/*"]
kinds = ["raised", "escalated"]
severities = ["danger"]

[[webhooks]]
name = "here"
url = "http://127.0.0.1:9000/"
secret_variable = "HOOK_SECRET"
"""


def written(folder: Path, text: str) -> Path:
    file = folder / "plant.toml"
    file.write_text(text, encoding="utf-8")
    return file


def test_paths_are_relative_to_the_settings_file_and_plain_http_needs_insecure(tmp_path: Path) -> None:
    pager, here = load_settings(written(tmp_path, GOOD)).webhooks
    assert pager.secret_file == tmp_path / "pager.secret"
    assert (pager.machines, pager.kinds, pager.severities) == (("demo/*",), ("raised", "escalated"), ("danger",))
    assert (pager.on_this_computer, here.on_this_computer) == (False, True)
    assert (here.machines, here.kinds, here.severities) == (("*/*",), (), ())
    fields = {"name": "a", "url": "http://pager.example/", "secret_variable": "S", "insecure": True}
    assert WebhookSettings.model_validate(fields).target == "http://pager.example"


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ('name = "here"', 'name = "pager"', "webhooks: two are called pager"),
        ('name = "here"', 'name = "a b"', "webhooks.1.name: "),
        ("https://pager", "http://pager", "webhooks.0: url is http and not on this computer"),
        ("https://pager", "ftp://pager", "webhooks.0: url is not a web address"),
        ("https://pager.example/", "https:///", "webhooks.0: url is not a web address"),
        ("https://pager.example/", "https://pager.example:70000/", "webhooks.0: url cannot be read: Port out of range"),
        ("https://pager", "https://me:hush@pager", "webhooks.0: url contains a user name"),
        ('secret_file = "pager.secret"', 'secret = "whsec_hush-hush"', "webhooks.0: secret does not belong in"),
        ('secret_file = "pager.secret"', "", "webhooks.0: expected the secret in one of secret_file and"),
        ('"HOOK_SECRET"', '"HOOK_SECRET"\nsecret_file = "x"', "webhooks.1: expected the secret in one of"),
        ('"HOOK_SECRET"', '"HOOK_SECRET"\nca_file = "ca.pem"', "webhooks.1: ca_file is for https, and url is http"),
        ('"demo/*"', '"demo"', "webhooks.0: machines: 'demo' is not site/machine"),
        ('"demo/*"', '"demo/"', "webhooks.0: machines: 'demo/' is not site/machine"),
        ('"demo/*"', "", "webhooks.0.machines: "),
        ('"raised"', '"risen"', "webhooks.0.kinds: "),
        ('"danger"', '"warning"', "webhooks.0.severities: "),
        ('["danger"]', '["danger"]\ntimeout_s = 0', "webhooks.0.timeout_s: "),
        ('["danger"]', '["danger"]\nretry = true', "webhooks.0.retry: unknown"),
    ],
)
def test_mistakes_are_named_and_show_no_secret(tmp_path: Path, old: str, new: str, named: str) -> None:
    assert GOOD.count(old) == 1
    file = written(tmp_path, GOOD.replace(old, new))
    with pytest.raises(MachineFileError) as caught:
        load_settings(file)
    without_names = re.sub(r" \((pager|here|a b)\):", ":", str(caught.value))
    assert f"plant.toml: {named}" in without_names
    assert "hush" not in str(caught.value)


def with_secret(folder: Path, text: str, mode: int = 0o600) -> WebhookSettings:
    file = folder / "secret"
    file.write_text(text, encoding="utf-8")
    file.chmod(mode)
    return WebhookSettings(name="pager", url="https://pager.example/", secret_file=file)


@pytest.mark.parametrize(
    "text",
    ["", "\n", "whsec_", "whsec_c2hvcnQ=", "whsec_" + 4 * "!" * 12, new_secret().removeprefix("whsec_"), "tooth"],
    ids=["empty", "a line end", "nothing after the mark", "too short", "no base64", "no mark", "a word"],
)
def test_malformed_secrets_are_refused_without_being_shown(tmp_path: Path, text: str) -> None:
    with pytest.raises(
        MachineFileError, match=r"webhooks\.pager: secret_file .*expected whsec_ and 24 to 64 bytes"
    ) as e:
        signing_keys(with_secret(tmp_path, text))
    assert not text.strip() or len(text.strip()) < 7 or text.strip() not in str(e.value)


def test_a_missing_or_world_readable_secret_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MachineFileError, match=r"readable by every user of this computer: chmod 600"):
        signing_keys(with_secret(tmp_path, new_secret(), 0o644))
    missing = WebhookSettings(name="pager", url="https://p.example/", secret_file=tmp_path / "none")
    with pytest.raises(MachineFileError, match=r"none cannot be read: No such file"):
        signing_keys(missing)
    with pytest.raises(MachineFileError, match=r"webhooks\.pager: secret_file"):  # not without the webhook
        Runtime(settings(endpoint(), webhooks=(missing,)))
    variable = WebhookSettings.model_validate(
        {"name": "pager", "url": "https://p.example/", "secret_variable": "HOOK_SECRET"}
    )
    monkeypatch.delenv("HOOK_SECRET", raising=False)
    with pytest.raises(MachineFileError, match=r"environment variable HOOK_SECRET has 0 secrets"):
        signing_keys(variable)
    secret = new_secret()
    monkeypatch.setenv("HOOK_SECRET", secret)
    assert signing_keys(variable) == (parse_secret(secret),)


def test_an_unusable_authority_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "ca.pem").write_text("tooth", encoding="utf-8")
    for file, said in (("ca.pem", "holds no certificate"), ("none.pem", "cannot be read: No such file")):
        with pytest.raises(MachineFileError, match=said):
            Receiver(settings_for("https://pager.example/", tmp_path, ca_file=tmp_path / file))


def test_commands_make_secrets_and_send_a_test_event(tmp_path: Path) -> None:
    secret = new_secret()
    with hook() as receiver:
        settings_for(receiver, tmp_path, secret)
        file = written(
            tmp_path, f'[[webhooks]]\nname = "pager"\nurl = "{receiver.url}?key=hush"\nsecret_file = "hook.secret"\n'
        )
        arguments = ["webhook", "test", "pager", "--config", str(file)]
        done = CliRunner().invoke(app, arguments)
        assert done.exit_code == 0, done.output
        assert "accepted the test event" in done.output
        (got,) = receiver.got
        event = got.verified(secret)
        assert (event["type"], event["id"]) == ("org.rotorwatch.webhook.test", got.id)
        assert "no machine" in event["data"]["text"]
        receiver.answer = lambda _: (404, {})
        refused = CliRunner().invoke(app, arguments)
        assert (refused.exit_code, len(receiver.got)) == (1, 2)
        assert "did not accept the test event: 404 Not Found" in refused.output
        assert "hush" not in done.output + refused.output
        unknown = CliRunner().invoke(app, ["webhook", "test", "lamp", "--config", str(file)])
        assert unknown.exit_code == 2
        assert "no webhook lamp; there are: pager" in unknown.output
    made = [CliRunner().invoke(app, ["webhook", "secret"]).output.strip() for _ in range(2)]
    assert all(len(parse_secret(one)) == 32 for one in made)
    assert made[0] != made[1]


@pytest.mark.parametrize(
    ("status", "meaning"),
    [
        (200, Meaning.DELIVERED), (202, Meaning.DELIVERED), (204, Meaning.DELIVERED), (301, Meaning.REFUSED),
        (308, Meaning.REFUSED), (400, Meaning.REFUSED), (404, Meaning.REFUSED), (408, Meaning.TROUBLE),
        (410, Meaning.GONE), (413, Meaning.REFUSED), (425, Meaning.TROUBLE), (429, Meaning.TROUBLE),
        (499, Meaning.REFUSED), (500, Meaning.TROUBLE), (599, Meaning.TROUBLE),
    ],
)  # fmt: skip
def test_meaning_of_response_statuses(status: int, meaning: Meaning) -> None:
    answer = answer_of(status, {}, 0.0)
    assert answer.meaning is meaning
    assert (answer.text == "") == (meaning is Meaning.DELIVERED)


@pytest.mark.parametrize(
    ("text", "wished_s"),
    [
        ("30", 30.0), (" 7 ", 7.0), ("999999999999", 3600.0), ("-5", 0.0), ("soon", 0.0), ("", 0.0), ("²", 0.0),
        ("Thu, 01 Jan 2026 00:02:00 GMT", 120.0), ("Thu, 01 Jan 2026 00:02:00", 120.0),
        ("Wed, 31 Dec 2025 00:00:00 GMT", 0.0), ("Fri, 01 Jan 2100 00:00:00 GMT", 3600.0),
    ],
)  # fmt: skip
def test_retry_after_sets_the_pause(text: str, wished_s: float) -> None:
    answer = answer_of(503, {"retry-after": text}, 1_767_225_600.0)
    assert answer.retry_after_s == wished_s
    assert pause_s(answer, 1, 300.0, 1.0) == max(1.0, wished_s)


def test_pauses_have_jitter_and_are_bounded() -> None:
    refused = Answer(Meaning.REFUSED, "404 Not Found")
    assert pause_s(Answer(Meaning.TROUBLE), 3, 300.0, 0.0) == 2.0
    assert pause_s(Answer(Meaning.TROUBLE), 3, 300.0, 0.5) == 3.0
    assert pause_s(Answer(Meaning.TROUBLE), 10_000, 300.0, 1.0) == 300.0
    assert pause_s(refused, 1, 300.0, 1.0) == 60.0
    assert pause_s(refused, 4, 300.0, 1.0) == 300.0
    assert pause_s(refused, 1, 5.0, 1.0) == 5.0


def test_a_monitor_logs_failed_deliveries_without_secrets(tmp_path: Path) -> None:
    secret, path, address = new_secret(), "hush-hush-path", endpoint()
    machine_file(tmp_path, IN_ORDER)
    with hook(lambda _: (503, {})) as receiver:
        settings_for(receiver, tmp_path, secret)
        written(
            tmp_path,
            '[[machines]]\nfile = "machine.toml"\n\n[log]\nlevel = "debug"\n\n[[webhooks]]\nname = "pager"\n'
            f'url = "{receiver.url}/{path}"\nsecret_file = "hook.secret"\nlongest_pause_s = 1.0\n',
        )
        plan = ("--config", str(tmp_path / "plant.toml"), "--listen", address, "--http-port", "0")
        with program(tmp_path, "service", "run", *plan) as monitor:
            monitor.url()
            with open_session(address) as session:
                feed = Feed(session)
                feed.gap()
            until(lambda: len(receiver.got) >= 2, "another attempt")
            assert monitor.stop() == 0
    assert {got.path for got in receiver.got} == {f"/hook/{path}"}
    said = monitor.errors() + monitor.output()
    assert "not delivered" in said  # the log is where failures are reported
    assert path not in said
    assert secret.removeprefix("whsec_") not in said
