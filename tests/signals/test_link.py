"""Settings of a link: contradictions, secrets and error messages; conflicts between publishers."""

import json
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trustme
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from models.arrivals import Senders
from models.errors import MachineFileError
from models.mistakes import in_folder
from models.signals.block import SampleBlock
from models.signals.keys import Grant, MachineKeys, access_control
from models.signals.link import LinkSettings, TlsSettings, load_link
from tests.sure import sure

ROOT = Path(__file__).parents[2]
ENDPOINT = ("tcp/127.0.0.1:7447",)
TLS_ENDPOINT = ("tls/127.0.0.1:7447",)
GRANT = {"who": ["lab"], "publishes": ["demo/lab"]}
BY_VARIABLE = {"connect": ENDPOINT, "user": "lab", "password_variable": "LAB_PASSWORD"}
HIDDEN = "correct-horse-battery"


def secret_file(path: Path, text: str, mode: int = 0o600) -> Path:
    path.write_text(text, encoding="utf-8")
    path.chmod(mode)
    return path


def certificate(folder: Path) -> TlsSettings:
    authority = trustme.CA()
    issued = authority.issue_cert("localhost", common_name="lab")
    authority.cert_pem.write_to_path(str(folder / "ca.pem"))
    issued.cert_chain_pems[0].write_to_path(str(folder / "lab.pem"))
    secret_file(folder / "lab.key", issued.private_key_pem.bytes().decode())
    return TlsSettings(
        root_certificate=folder / "ca.pem", certificate=folder / "lab.pem", key=folder / "lab.key", mutual=True
    )


def inserted(link: LinkSettings) -> zenoh.Config:
    """The configuration Zenoh makes of the settings; it refuses unknown paths and wrong types."""
    config = zenoh.Config()
    for path, value in link.zenoh_items().items():
        config.insert_json5(path, value)
    return config


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"user": "lab"}, "expected its password in one of password_file and password_variable"),
        ({"user": "lab", "password_file": "a", "password_variable": "B"}, "in one of password_file"),
        ({"password_file": "a"}, "a password is given, but no user"),
        ({"user": "a:b", "password_file": "a"}, "user"),
        ({"passwords_file": "a", "connect": ENDPOINT}, "no listen endpoint"),
        ({"listen": TLS_ENDPOINT}, r"expected \[link.tls\] with certificate and key"),
        ({"connect": TLS_ENDPOINT}, r"expected \[link.tls\] with root_certificate"),
        ({"connect": TLS_ENDPOINT, "tls": {"certificate": "a", "key": "b"}}, "with root_certificate"),
        ({"tls": {"certificate": "a"}}, "certificate and key belong together"),
        ({"tls": {"root_certificate": "a", "mutual": True}}, "mutual needs"),
        ({"grants": [GRANT], "connect": ENDPOINT}, "no listen endpoint"),
        ({"grants": [GRANT], "listen": ENDPOINT}, "expected passwords_file or tls.mutual"),
        ({"grants": [GRANT], "listen": ENDPOINT, "connect": ENDPOINT, "passwords_file": "a"}, "do not go together"),
        (
            {
                "grants": [GRANT],
                "listen": (*TLS_ENDPOINT, *ENDPOINT),
                "tls": {"root_certificate": "a", "certificate": "b", "key": "c", "mutual": True},
            },
            "clients show none to tcp/127.0.0.1:7447",
        ),
        ({"grants": [{"who": ["lab"]}]}, "the grant allows nothing"),
        ({"grants": [{"who": [], "views": ["demo/*"]}]}, "who"),
        ({"grants": [{"who": ["a b"], "views": ["demo/*"]}]}, "without spaces and colons"),
        ({"grants": [{"who": ["lab"], "views": ["demo"]}]}, 'expected "site/machine"'),
        ({"grants": [{"who": ["lab"], "views": ["demo/**"]}]}, 'expected "site/machine"'),
        ({"grants": [{"who": ["lab"], "views": ["demo/pump*"]}]}, 'expected "site/machine"'),
        ({"grants": [{"who": ["lab"], "reads": ["demo/*"]}]}, "Extra inputs"),
    ],
)
def test_contradictory_settings_are_named(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        LinkSettings.model_validate(fields)


def test_contradictions_from_the_command_line_are_found_on_opening(tmp_path: Path) -> None:
    link = LinkSettings(listen=ENDPOINT).model_copy(update={"listen": (), "connect": TLS_ENDPOINT})
    with pytest.raises(MachineFileError, match=r"^link: connect is tls/127.0.0.1:7447: expected \[link.tls\]"):
        link.zenoh_items()


@pytest.mark.parametrize("name", ["password", "passwords"])
def test_a_password_in_the_settings_is_refused_and_not_repeated(tmp_path: Path, name: str) -> None:
    path = tmp_path / "link.toml"
    path.write_text(f'[link]\nconnect = ["tcp/127.0.0.1:7447"]\nuser = "lab"\n{name} = "{HIDDEN}"\n', encoding="utf-8")
    with pytest.raises(MachineFileError, match=f"{name} does not belong in settings.*{name}_file") as caught:
        load_link(path)
    assert HIDDEN not in f"{caught.value} {caught.value.__cause__}"


def test_secrets_go_to_zenoh_and_nowhere_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LAB_PASSWORD", HIDDEN)
    by_variable = LinkSettings.model_validate(BY_VARIABLE)
    secret_file(tmp_path / "p", f"{HIDDEN}\n")
    by_file = in_folder(LinkSettings(connect=ENDPOINT, user="lab", password_file=Path("p")), tmp_path)
    for link in (by_variable, by_file):
        assert json.loads(inserted(link).get_json("transport/auth/usrpwd/password")) == HIDDEN
        for shown in (repr(link), str(link), repr(link.model_dump()), link.model_dump_json(), link.refusal()):
            assert HIDDEN not in shown
        assert LinkSettings.model_validate(link.model_dump()) == link


def test_a_missing_variable_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LAB_PASSWORD", raising=False)
    link = LinkSettings.model_validate(BY_VARIABLE)
    with pytest.raises(MachineFileError, match="LAB_PASSWORD is empty or not set, expected the password of user lab"):
        link.zenoh_items()


@pytest.mark.parametrize("mode", [0o604, 0o644, 0o602, 0o777])
def test_world_accessible_secrets_are_refused(tmp_path: Path, mode: int) -> None:
    password = secret_file(tmp_path / "p", HIDDEN, mode)
    passwords = secret_file(tmp_path / "all", f"lab:{HIDDEN}", mode)
    tls = certificate(tmp_path)
    assert tls.key is not None
    tls.key.chmod(mode)
    for link, path in (
        (LinkSettings(connect=ENDPOINT, user="lab", password_file=password), password),
        (LinkSettings(listen=ENDPOINT, passwords_file=passwords), passwords),
        (LinkSettings(listen=TLS_ENDPOINT, tls=tls), tls.key),
    ):
        with pytest.raises(MachineFileError, match=f"chmod 600 {path}") as caught:
            link.zenoh_items()
        assert HIDDEN not in str(caught.value)
        path.chmod(0o640)
        inserted(link)


PASSWORDS = {"listen": ENDPOINT, "grants": [GRANT], "passwords_file": "all"}
PASSWORD = {"connect": ENDPOINT, "user": "lab", "password_file": "all"}


@pytest.mark.parametrize(
    ("fields", "text", "said"),
    [
        (PASSWORDS, "", "no users"), (PASSWORDS, "lab", "line 1: expected name:password"),
        (PASSWORDS, f"lab:{HIDDEN}\n\npump:x", "line 2: expected name:password"),
        (PASSWORDS, f"lab:{HIDDEN}\n# pump:x", "line 2"), (PASSWORDS, f"lab:{HIDDEN}\n:x", "line 2"),
        (PASSWORDS, f"lab:{HIDDEN}\npump:", "line 2"),
        (PASSWORDS, f"lab:{HIDDEN}\nlab:{HIDDEN}", "line 2: the user lab already has a line"),
        (PASSWORDS, f"pump:{HIDDEN}", "who: lab has no line in"),
        (PASSWORD, "", "found 0 lines"), (PASSWORD, f"{HIDDEN}\n{HIDDEN}\n", "found 2 lines"),
    ],
)  # fmt: skip
def test_an_invalid_passwords_file_is_refused_without_showing_it(
    tmp_path: Path, fields: dict[str, Any], text: str, said: str
) -> None:
    passwords = secret_file(tmp_path / "all", text)
    link = in_folder(LinkSettings.model_validate(fields), tmp_path)
    with pytest.raises(MachineFileError, match=said) as caught:
        link.zenoh_items()
    assert HIDDEN not in str(caught.value)
    assert str(passwords) in str(caught.value)


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("ca.pem", None, "tls.root_certificate: .*ca.pem: cannot be read"),
        ("lab.key", None, "tls.key: .*lab.key: cannot be read"),
        ("lab.pem", "nonsense", "tls.certificate: .*lab.pem: expected a certificate in PEM"),
        ("lab.key", "nonsense", "tls.key: .*lab.key: expected a private key in PEM"),
        ("lab.key", "-----BEGIN ENCRYPTED PRIVATE KEY-----", "needs a passphrase"),
    ],
)
def test_certificates_that_cannot_be_used_are_named(tmp_path: Path, file: str, text: str | None, said: str) -> None:
    link = LinkSettings(listen=TLS_ENDPOINT, tls=certificate(tmp_path))
    inserted(link)
    (tmp_path / file).unlink()
    if text is not None:
        secret_file(tmp_path / file, text)
    with pytest.raises(MachineFileError, match=said):
        link.zenoh_items()


def test_a_key_of_another_certificate_is_refused(tmp_path: Path) -> None:
    link = LinkSettings(listen=TLS_ENDPOINT, tls=certificate(tmp_path))
    (tmp_path / "lab.key").write_bytes(trustme.CA().issue_cert("localhost").private_key_pem.bytes())
    with pytest.raises(MachineFileError, match=r"lab\.key is not the key of .*lab\.pem"):
        link.zenoh_items()


def test_a_certificate_serves_the_role_of_the_endpoint(tmp_path: Path) -> None:
    tls = certificate(tmp_path)
    one_sided = tls.model_copy(update={"mutual": False})
    for link, roles in (
        (LinkSettings(listen=TLS_ENDPOINT, tls=tls), {"listen"}),
        (LinkSettings(listen=TLS_ENDPOINT, tls=one_sided), {"listen"}),
        (LinkSettings(connect=TLS_ENDPOINT, tls=tls), {"connect"}),
        (LinkSettings(connect=TLS_ENDPOINT, tls=one_sided), set()),
        (LinkSettings(listen=TLS_ENDPOINT, connect=TLS_ENDPOINT, tls=tls), {"listen", "connect"}),
    ):
        found = json.loads(inserted(link).get_json("transport/link/tls"))
        assert {role for role in ("listen", "connect") if found[f"{role}_certificate"]} == roles
        assert {role for role in ("listen", "connect") if found[f"{role}_private_key"]} == roles
        assert found["enable_mtls"] is sure(link.tls).mutual
        assert found["verify_name_on_connect"] is True


def test_connection_errors_name_every_reason_that_the_settings_leave_open(tmp_path: Path) -> None:
    error = "Unable to connect to any of [tcp/127.0.0.1:7447]. Timeout! at /x/orchestrator.rs:388."
    plain = LinkSettings(connect=ENDPOINT).explain(error)
    assert plain.startswith("nothing answers there; or ")
    assert "requires a user name" in plain
    assert "only tls/" in plain
    user = LinkSettings(connect=ENDPOINT, user="lab", password_file=tmp_path / "p").explain(error)
    assert f"does not accept the user lab with the password in {tmp_path / 'p'}" in user
    tls = certificate(tmp_path)
    assert "lab.pem was not issued by" in LinkSettings(connect=TLS_ENDPOINT, tls=tls).explain(error)
    one_sided = tls.model_copy(update={"mutual": False})
    assert "mutual is false" in LinkSettings(connect=TLS_ENDPOINT, tls=one_sided).explain(error)
    assert "another program" in LinkSettings(listen=ENDPOINT).explain("Address already in use (os error 98)")
    assert LinkSettings().explain("Bad thing at /x/a.rs:3.") == "Bad thing"


def allowed(control: dict[str, Any], name: str, flow: str, message: str, key: str) -> bool:
    """Zenoh's decision, reproduced from the configuration: some rule of the subject includes the key."""
    policies = [policy for policy in control["policies"] if name in policy["subjects"]]
    names = {rule for policy in policies for rule in policy["rules"]}
    return any(
        zenoh.KeyExpr(pattern).includes(zenoh.KeyExpr(key))
        for rule in control["rules"]
        if rule["id"] in names and flow in rule["flows"] and message in rule["messages"]
        for pattern in rule["key_exprs"]
    )


MESSAGES = (
    "put", "delete", "reply", "query", "declare_subscriber", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
_PLACES = st.sampled_from(["demo/lab", "demo/pump", "demo/*", "plant/lab", "*/lab", "*/*"])


@settings(max_examples=30)
@given(publishes=st.lists(_PLACES), views=st.lists(_PLACES), monitors=st.lists(_PLACES))
def test_access_control_allows_only_granted_keys(publishes: list[str], views: list[str], monitors: list[str]) -> None:
    if not (publishes or views or monitors):
        return
    fields = {"who": ["lab"], "publishes": publishes, "views": views, "monitors": monitors}
    control: Any = access_control([Grant.model_validate(fields)], "usernames")
    for site, machine in product(("demo", "plant"), ("lab", "pump")):
        keys = MachineKeys(site, machine)

        def covers(places: list[str], site: str = site, machine: str = machine) -> bool:
            return any(s in {"*", site} and m in {"*", machine} for s, m in (place.split("/") for place in places))

        sent = (keys.stream, keys.descriptor, keys.truth)
        found = (keys.report, keys.health, keys.alarm_event, keys.alarm_state)
        for keys_of, send, read in (
            (sent, covers(publishes), covers(monitors)),
            (found, covers(monitors), covers(monitors) or covers(views)),
        ):
            for key in (*keys_of, *(f"{key}/@adv/pub/1a/2/_" for key in keys_of)):
                assert allowed(control, "lab", "ingress", "put", key) is send
                assert allowed(control, "lab", "ingress", "reply", key) is send
                assert allowed(control, "lab", "egress", "put", key) is read
                assert allowed(control, "lab", "ingress", "declare_subscriber", key) is read
                assert not allowed(control, "lab", "ingress", "delete", key)
        for token, may in ((keys.publisher_alive, covers(publishes)), (keys.monitor_alive, covers(monitors))):
            assert allowed(control, "lab", "ingress", "liveliness_token", token) is may
        assert not allowed(control, "lab", "ingress", "liveliness_token", keys.replay_alive)
    for flow, message in product(("ingress", "egress"), MESSAGES):
        assert not allowed(control, "lab", flow, message, "other/demo/lab/stream")
        assert not allowed(control, "stranger", flow, message, "rotorwatch/demo/lab/stream")


def test_grants_of_one_name_add_up(tmp_path: Path) -> None:
    grants = [Grant(who=("a", "b"), views=("demo/*",)), Grant(who=("b",), publishes=("demo/lab",))]
    control: Any = access_control(grants, "usernames")
    assert control["default_permission"] == "deny"
    assert [subject["usernames"] for subject in control["subjects"]] == [["a"], ["b"]]
    for name, may in (("a", False), ("b", True)):
        assert allowed(control, name, "ingress", "put", "rotorwatch/demo/lab/stream") is may
        assert allowed(control, name, "egress", "put", "rotorwatch/demo/pump/health")


def test_a_link_file_is_read_with_files_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "link.toml"
    path.write_text('[link]\nconnect = ["tcp/127.0.0.1:1"]\nuser = "lab"\npassword_file = "p"\n', encoding="utf-8")
    assert load_link(path).password_file == tmp_path / "p"
    for text, said in (
        ("", "link.toml: link: missing"),
        ("[link]\n", "link.toml: link: expected endpoints in listen or connect"),
        ('[link]\nlisten = "x"\n', "link.toml: link.listen: .*found 'x'"),
        ("[link]\n[http]\nport = 1\n", "link.toml: http: unknown"),
        ("link = ", "link.toml: .*TOML|link.toml: line 1"),
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(MachineFileError, match=said):
            load_link(path)


S = 10**9


def block(sequence: int, run: int = 1, start_s: float = 0.0, value: float = 0.0) -> SampleBlock:
    samples = np.full((10, 2), value, dtype=np.float32)
    return SampleBlock(round((start_s + sequence) * S), sequence, run, 10.0, samples)


def test_one_publisher_with_repetition_and_reordering_is_no_conflict() -> None:
    senders = Senders()
    rng = np.random.default_rng(1)
    order = np.argsort(np.arange(400) + rng.uniform(0, 8, 400))
    for number in (*order[:200], *order[150:400]):
        assert not senders.take(block(int(number)))
    assert senders.conflict == ""


def test_restarts_are_no_conflict() -> None:
    senders = Senders()
    for run in range(1, 30):
        late = [block(20 + n, run - 1, start_s=100 * (run - 1)) for n in range(4)] if run > 1 else []
        for n in range(20):
            assert not senders.take(block(n, run, start_s=100 * run))
            if late and n % 2:
                senders.take(late.pop(0))  # what was still on its way
    assert senders.conflict == ""


def test_restarted_sequence_numbers_are_no_conflict() -> None:
    senders = Senders()
    for start_s in (0.0, 50.0, 300.0):
        for n in range(20):
            assert not senders.take(block(n, run=0, start_s=start_s, value=start_s))
    assert senders.conflict == ""


@pytest.mark.parametrize(("runs", "first"), [((1, 2), 0), ((0, 0), 100_000)])
def test_two_publishers_are_named_as_long_as_both_send(runs: tuple[int, int], first: int) -> None:
    senders = Senders()
    a, b = runs
    for n in range(30):
        senders.take(block(n, a))
        senders.take(block(first + n, b, start_s=-first, value=1.0))
    assert f"runs {a} and {b} both send" in senders.conflict
    for n in range(30, 400):
        senders.take(block(n, a))
    assert senders.conflict == ""


def test_a_slow_second_publisher_is_noticed_too() -> None:
    senders = Senders()
    for n in range(200):
        senders.take(block(n, 1))
        if n % 20 == 0:
            senders.take(block(n // 20, 2))
    assert "both send" in senders.conflict


def test_neither_of_two_versions_of_a_block_is_accepted() -> None:
    senders = Senders()
    for n in range(10):
        assert not senders.take(block(n))
    forged = replace(block(12), samples=block(12).samples + 1)
    assert not senders.take(forged)  # not yet known
    assert not senders.take(block(10))
    assert not senders.take(block(11))
    assert senders.take(block(12))
    assert senders.take(forged)
    assert senders.take(block(12))
    assert not senders.take(block(13))
    assert "block 12 of run 1" in senders.conflict
