"""HTTPS: a real server, real certificates, and what is said about those that cannot be used."""

import ssl
from pathlib import Path

import httpx
import pytest
import trustme

from models.errors import MachineFileError
from service.access.scopes import Scope
from service.access.tls import server_arguments, tls_context
from service.settings.access import AccessSettings, TlsSettings
from tests.service.guarded import guarded


@pytest.fixture
def authority() -> trustme.CA:
    return trustme.CA(key_type=trustme.KeyType.ECDSA)


def files(folder: Path, authority: trustme.CA, *, client_ca: bool = False) -> TlsSettings:
    issued = authority.issue_cert("127.0.0.1", key_type=trustme.KeyType.ECDSA)
    certificate, key, ca = folder / "certificate.pem", folder / "key.pem", folder / "ca.pem"
    certificate.write_bytes(b"".join(part.bytes() for part in issued.cert_chain_pems))
    key.write_bytes(issued.private_key_pem.bytes())
    key.chmod(0o600)
    authority.cert_pem.write_to_path(str(ca))
    return TlsSettings(certificate=certificate, key=key, client_ca=ca if client_ca else None)


def trusting(authority: trustme.CA) -> ssl.SSLContext:
    context = ssl.create_default_context()
    authority.configure_trust(context)
    return context


def test_https_is_served_and_nothing_older_than_tls_1_2(tmp_path: Path, authority: trustme.CA) -> None:
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


def test_a_client_without_a_certificate_is_refused_where_one_is_asked_for(
    tmp_path: Path, authority: trustme.CA
) -> None:
    with guarded(tmp_path, AccessSettings(tls=files(tmp_path, authority, client_ca=True))) as monitor:
        token = monitor.token(Scope.READ)
        known, stranger = trusting(authority), trusting(authority)
        authority.issue_cert("operator@plant.example").configure_cert(known)
        trustme.CA().issue_cert("operator@plant.example").configure_cert(stranger)
        with monitor.client(token, verify=known) as client:
            assert client.get("/health").status_code == 200
        for context in (stranger, trusting(authority)):
            with monitor.client(token, verify=context) as client, pytest.raises(httpx.TransportError):
                client.get("/health")


def test_without_tls_plain_http_and_no_proxy_is_believed() -> None:
    assert server_arguments(AccessSettings()) == {
        "proxy_headers": False, "forwarded_allow_ips": [], "server_header": False
    }  # fmt: skip


def refused(tls: TlsSettings) -> str:
    with pytest.raises(MachineFileError) as caught:
        server_arguments(AccessSettings(tls=tls))
    return str(caught.value)


@pytest.mark.parametrize("name", ["certificate", "key", "client_ca"])
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, authority: trustme.CA, name: str) -> None:
    tls = files(tmp_path, authority, client_ca=True)
    path: Path = getattr(tls, name)
    path.unlink()
    assert refused(tls) == f"{path}: tls.{name} cannot be read: No such file or directory"
    path.mkdir()
    assert refused(tls) == f"{path}: tls.{name} cannot be read: Is a directory"


@pytest.mark.parametrize("name", ["certificate", "key", "client_ca"])
@pytest.mark.parametrize("content", [b"", b"nonsense\n", b"\0\xff"])
def test_a_file_that_is_none_is_named(tmp_path: Path, authority: trustme.CA, name: str, content: bytes) -> None:
    tls = files(tmp_path, authority, client_ca=True)
    path: Path = getattr(tls, name)
    path.write_bytes(content)
    assert refused(tls).startswith(f"{path}: tls.{name} holds no ")


def test_a_key_of_another_certificate_is_refused(tmp_path: Path, authority: trustme.CA) -> None:
    tls = files(tmp_path, authority)
    tls.key.write_bytes(authority.issue_cert("x", key_type=trustme.KeyType.ECDSA).private_key_pem.bytes())
    assert refused(tls) == f"{tls.key}: tls.key is not the key of tls.certificate {tls.certificate}"


def test_a_key_that_everybody_can_read_is_refused(tmp_path: Path, authority: trustme.CA) -> None:
    tls = files(tmp_path, authority)
    tls.key.chmod(0o644)
    assert "readable by every user" in refused(tls)
    tls.key.chmod(0o640)
    server_arguments(AccessSettings(tls=tls))


def test_a_key_with_a_password_is_refused_without_asking_for_it(tmp_path: Path, authority: trustme.CA) -> None:
    from cryptography.hazmat.primitives import serialization  # noqa: PLC0415  # comes with trustme, used here alone

    tls = files(tmp_path, authority)
    key = serialization.load_pem_private_key(tls.key.read_bytes(), None)
    tls.key.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.BestAvailableEncryption(b"secret"),
        )
    )
    assert "protected by a password" in refused(tls)
