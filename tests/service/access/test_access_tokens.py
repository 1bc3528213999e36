"""Tokens: created, parsed, checked and masked; rate limits and settings of access; certificates for TLS."""

import ssl
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import pytest
import trustme
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from models.errors import MachineFileError
from models.mistakes import in_folder
from models.signals.link import LinkSettings, TlsSettings
from service.access.credentials import network_of
from service.access.rates import MovingWindow
from service.access.scopes import Scope
from service.access.tls import lapses, server_arguments, tls_context
from service.access.tokens import masked, new_token, parse_token, token_is_valid
from service.commands.rotorwatch import app
from service.history.records import TokenRecord
from service.settings.access import AccessSettings, HttpTlsSettings, check_access
from service.settings.service import ServiceSettings
from tests.service.rig.guarded import guarded
from tests.sure import sure

DAY_NS = 86_400 * 10**9
ALPHABET = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz"


def made(name: str = "ops", days: int | None = None) -> tuple[TokenRecord, str]:
    return new_token(name, [Scope.READ], now_ns=0, days=days)


def test_tokens_are_unique_have_256_bits_and_are_stored_as_a_hash() -> None:
    tokens = [made()[1] for _ in range(200)]
    secrets = {token.rpartition("_")[2] for token in tokens}
    assert len(secrets) == len({token[:15] for token in tokens}) == 200
    assert {len(secret) for secret in secrets} == {43}
    assert 62**42 < 2**256 <= 62**43
    # Every digit occurs in the last place; the first is small because 62**43 is more than 2**256.
    assert len({secret[-1] for secret in secrets}) > 50
    record, text = made()
    parsed = sure(parse_token(text))
    assert (parsed.token_id, len(record.secret_hash)) == (record.token_id, 32)
    for hidden in (text.rpartition("_")[2], repr(parsed.secret_hash)):
        assert hidden not in repr(parsed)
    assert text.rpartition("_")[2] not in repr(record)


@given(st.text())
def test_arbitrary_text_is_not_a_token(text: str) -> None:
    assert parse_token(text) is None
    assert not token_is_valid(made()[0], parse_token(text), 1)


@given(place=st.integers(0, 58), other=st.sampled_from([*ALPHABET, "_", "-", " ", "\n", "é", "\0"]))
def test_one_wrong_character_makes_a_token_invalid(place: int, other: str) -> None:
    record, text = made()
    assert len(text) == 59
    other = "!" if other == text[place] else other
    for wrong in (text[:place] + other + text[place + 1 :], text[:place], text + other, other + text):
        assert not token_is_valid(record, parse_token(wrong), 1)
    assert token_is_valid(record, parse_token(text), 1)
    assert not token_is_valid(None, parse_token(text), 1)


def test_expired_revoked_and_foreign_tokens_are_invalid() -> None:
    record, text = made(days=2)
    presented = parse_token(text)
    assert token_is_valid(record, presented, 2 * DAY_NS - 1)
    assert not token_is_valid(record, presented, 2 * DAY_NS)
    fields = {name: getattr(record, name) for name in TokenRecord.__dataclass_fields__}
    assert not token_is_valid(TokenRecord(**{**fields, "revoked_ns": 1}), presented, 1)
    # The right secret under another token's identifier.
    assert not token_is_valid(TokenRecord(**{**fields, "token_id": "0" * 12}), presented, 1)


@given(st.text(alphabet=" /?&=é\n"), st.text(alphabet=" /?&=é\n_"), st.integers(1, 43))
def test_secrets_are_masked_anywhere_in_a_text_even_if_truncated(before: str, after: str, length: int) -> None:
    text = made()[1]
    assert masked(f"{before}{text[: 16 + length]}{after}") == f"{before}{text[:16]}…{after}"


@given(st.integers(1, 5), st.lists(st.tuples(st.sampled_from("ab"), st.floats(0.0, 40.0)), max_size=60))
def test_the_limit_holds_in_any_minute(amount: int, hits: list[tuple[str, float]]) -> None:
    now_s = 0.0
    window = MovingWindow(amount, clock=lambda: now_s)
    admitted: dict[str, list[float]] = {"a": [], "b": []}
    for key, pause_s in hits:
        now_s += pause_s
        recent = [one for one in admitted[key] if one > now_s - 60.0]
        assert (window.wait(key) == 0.0) == (len(recent) < amount)
        wait_s = window.hit(key)
        if wait_s == 0.0:
            admitted[key].append(now_s)
        else:
            assert wait_s == recent[0] + 60.0 - now_s
        assert (wait_s == 0.0) == (len(recent) < amount)


def test_the_number_of_tracked_addresses_is_bounded() -> None:
    window = MovingWindow(1, clock=lambda: 0.0, keys=100)
    for number in range(1000):
        window.hit(str(number))
    assert (len(window), window.wait("999")) == (100, 60.0)
    now_s = 0.0
    window = MovingWindow(1, clock=lambda: now_s)
    window.hit("a")
    now_s = 60.0
    assert (window.wait("a"), len(window)) == (0.0, 0)


@pytest.mark.parametrize(
    ("address", "network"),
    [
        ("10.0.0.1", "10.0.0.1"), ("::ffff:10.0.0.1", "10.0.0.1"), ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("2001:db8:1:2::9", "2001:db8:1:2::/64"), ("fe80::1%eth0", "fe80::/64"), ("", ""), ("unix", "unix"),
    ],
)  # fmt: skip
def test_ipv6_addresses_count_by_their_64_bit_network(address: str, network: str) -> None:
    assert network_of(address) == network


def test_open_access_is_accepted_only_on_loopback() -> None:
    access = AccessSettings(open_on_loopback=True)
    for host in ("0.0.0.0", "::", "10.0.0.1", "monitor.plant", ""):  # noqa: S104  # refused
        with pytest.raises(MachineFileError, match=r"plant\.toml: access\.open_on_loopback is true, but http\.host"):
            check_access("plant.toml", access, host)
        check_access("plant.toml", AccessSettings(), host)
    for host in ("127.0.0.1", "127.1.2.3", "::1", "localhost"):
        check_access("plant.toml", access, host)
    with pytest.raises(MachineFileError, match=r"access\.proxies names 10\.0\.0\.1"):
        check_access("plant.toml", AccessSettings(open_on_loopback=True, proxies=("10.0.0.1",)), "127.0.0.1")


def test_invalid_access_settings_are_refused() -> None:
    for fields in ({"open": True}, {"proxies": ["proxy.plant"]}, {"limits": {"body_bytes": 1}}, {"tls": {"key": "k"}}):
        with pytest.raises(ValueError, match="validation error"):
            AccessSettings.model_validate(fields)


def test_certificate_paths_are_relative_to_the_settings_file() -> None:
    tls = HttpTlsSettings(certificate=Path("c.pem"), key=Path("/keys/k.pem"), client_ca=Path("ca.pem"))
    found = in_folder(AccessSettings(tls=tls), Path("/etc/rotorwatch")).tls
    assert found == HttpTlsSettings(
        certificate=Path("/etc/rotorwatch/c.pem"), key=Path("/keys/k.pem"), client_ca=Path("/etc/rotorwatch/ca.pem")
    )
    assert in_folder(AccessSettings(), Path("/x")) == AccessSettings()


@pytest.fixture
def authority() -> trustme.CA:
    return trustme.CA(key_type=trustme.KeyType.ECDSA)


def files(folder: Path, authority: trustme.CA, *, client_ca: bool = False) -> HttpTlsSettings:
    issued = authority.issue_cert("127.0.0.1", key_type=trustme.KeyType.ECDSA)
    certificate, key, ca = folder / "certificate.pem", folder / "key.pem", folder / "ca.pem"
    certificate.write_bytes(b"".join(part.bytes() for part in issued.cert_chain_pems))
    key.write_bytes(issued.private_key_pem.bytes())
    key.chmod(0o600)
    authority.cert_pem.write_to_path(str(ca))
    return HttpTlsSettings(certificate=certificate, key=key, client_ca=ca if client_ca else None)


def trusting(authority: trustme.CA) -> ssl.SSLContext:
    context = ssl.create_default_context()
    authority.configure_trust(context)
    return context


def test_https_is_served_with_tls_1_2_or_newer(tmp_path: Path, authority: trustme.CA) -> None:
    with guarded(tmp_path, AccessSettings(tls=files(tmp_path, authority))) as monitor:
        assert monitor.url.startswith("https://")
        token = monitor.token(Scope.READ)
        with monitor.client(token, verify=trusting(authority)) as client:
            assert client.get("/health").status_code == 200
        with monitor.client(token, verify=trusting(trustme.CA())) as client, pytest.raises(httpx.ConnectError):
            client.get("/health")
        with httpx.Client(trust_env=False, timeout=180.0) as client, pytest.raises(httpx.HTTPError):
            client.get(monitor.url.replace("https", "http"))
    assert tls_context(files(tmp_path, authority)).minimum_version == ssl.TLSVersion.TLSv1_2


def test_a_client_without_a_required_certificate_is_refused(tmp_path: Path, authority: trustme.CA) -> None:
    with guarded(tmp_path, AccessSettings(tls=files(tmp_path, authority, client_ca=True))) as monitor:
        token = monitor.token(Scope.READ)
        known, stranger = trusting(authority), trusting(authority)
        authority.issue_cert("operator@plant.example").configure_cert(known)
        trustme.CA().issue_cert("operator@plant.example").configure_cert(stranger)
        with monitor.client(token, verify=known) as client:
            assert client.get("/health").status_code == 200
        own, ca = authority.issue_cert("operator@plant.example"), tmp_path / "ca.pem"
        file, key = tmp_path / "own.pem", tmp_path / "own.key"
        file.write_bytes(own.cert_chain_pems[0].bytes())
        key.write_bytes(own.private_key_pem.bytes())
        status = ("status", "--url", monitor.url, "--token", token, "--ca", str(ca))
        found = CliRunner().invoke(app, [*status, "--certificate", str(file), str(key)])
        assert "answers 404" in found.stderr  # the application here has no machines
        found = CliRunner().invoke(app, status)
        assert (found.exit_code, "perhaps it requires a certificate" in found.stderr) == (4, True)
        for context in (stranger, trusting(authority)):
            with monitor.client(token, verify=context) as client, pytest.raises(httpx.TransportError):
                client.get("/health")


@pytest.mark.parametrize(("days", "said"), [(-1.0, ".pem expired on "), (20.0, "pem expires on "), (40.0, "")])
def test_a_certificate_that_has_expired_or_soon_will_is_reported(
    tmp_path: Path, authority: trustme.CA, monkeypatch: pytest.MonkeyPatch, days: float, said: str
) -> None:
    tls = files(tmp_path, authority)
    issued = authority.issue_cert("localhost", not_after=datetime.now(UTC) + timedelta(days=days))
    tls.certificate.write_bytes(issued.cert_chain_pems[0].bytes())
    link = LinkSettings(listen=("tls/127.0.0.1:7447",), tls=TlsSettings(certificate=tls.certificate, key=tls.key))
    both = ServiceSettings(access=AccessSettings(tls=tls), link=link)
    assert [said in one for one in lapses(both)] == [True] * bool(said)
    monkeypatch.delattr("ssl._ssl._test_decode_cert")  # without this function of Python there is no warning
    assert lapses(both) == []


def refused(tls: HttpTlsSettings) -> str:
    with pytest.raises(MachineFileError) as caught:
        server_arguments(AccessSettings(tls=tls))
    return str(caught.value)


@pytest.mark.parametrize("name", ["certificate", "key", "client_ca"])
def test_an_unreadable_or_invalid_tls_file_is_named(tmp_path: Path, authority: trustme.CA, name: str) -> None:
    tls = files(tmp_path, authority, client_ca=True)
    path: Path = getattr(tls, name)
    path.unlink()
    assert refused(tls) == f"{path}: tls.{name} cannot be read: No such file or directory"
    path.mkdir()
    assert refused(tls) == f"{path}: tls.{name} cannot be read: Is a directory"
    path.rmdir()
    path.touch(0o600)
    for content in (b"", b"nonsense\n", b"\0\xff"):
        path.write_bytes(content)
        assert refused(tls).startswith(f"{path}: tls.{name} holds no ")


def test_a_key_of_another_certificate_or_readable_by_all_is_refused(tmp_path: Path, authority: trustme.CA) -> None:
    tls = files(tmp_path, authority)
    tls.key.write_bytes(authority.issue_cert("x", key_type=trustme.KeyType.ECDSA).private_key_pem.bytes())
    assert refused(tls) == f"{tls.key}: tls.key is not the key of tls.certificate {tls.certificate}"
    tls = files(tmp_path, authority)
    tls.key.chmod(0o644)
    assert "readable by every user" in refused(tls)
    tls.key.chmod(0o640)
    server_arguments(AccessSettings(tls=tls))


def test_a_password_protected_key_is_refused(tmp_path: Path, authority: trustme.CA) -> None:
    from cryptography.hazmat.primitives import serialization  # noqa: PLC0415  # comes with trustme, used here alone

    tls = files(tmp_path, authority)
    key = serialization.load_pem_private_key(tls.key.read_bytes(), None)
    tls.key.write_bytes(key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.BestAvailableEncryption(b"secret"),
    ))  # fmt: skip
    assert "protected by a password" in refused(tls)
