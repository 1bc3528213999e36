"""Certificate and key of the HTTP server, checked before anything listens."""

import ssl
import time
from pathlib import Path
from typing import Any

from models.errors import MachineFileError
from service.settings.access import AccessSettings, HttpTlsSettings
from service.settings.service import ServiceSettings

_READABLE_BY_OTHERS = 0o004
_SOON_S = 30 * 86_400.0


def server_arguments(access: AccessSettings) -> dict[str, Any]:
    """Keyword arguments of ``uvicorn.Config`` that belong to access; raises as `tls_context` does."""
    arguments: dict[str, Any] = {
        # Only named proxies: anybody else could write any address into the audit log.
        "proxy_headers": bool(access.proxies),
        "forwarded_allow_ips": list(access.proxies),
        "server_header": False,
    }
    if access.tls is not None:
        context = tls_context(access.tls)
        arguments["ssl_context_factory"] = lambda config, default: context  # noqa: ARG005  # uvicorn names them
    return arguments


def tls_context(tls: HttpTlsSettings) -> ssl.SSLContext:
    """Load certificate and key; TLS 1.2 or newer, and a certificate from clients where `client_ca` is set.

    Raises
    ------
    MachineFileError
        Naming the file that is missing, unreadable, damaged, readable by others, or does not fit the other one.
    """
    for name, path in (("certificate", tls.certificate), ("key", tls.key), ("client_ca", tls.client_ca)):
        try:
            if path is not None:
                with path.open("rb") as file:
                    file.read(1)
        except OSError as error:
            raise MachineFileError(f"{path}: tls.{name} cannot be read: {error.strerror or error}") from error
    if tls.key.stat().st_mode & _READABLE_BY_OTHERS:
        raise MachineFileError(
            f"{tls.key}: tls.key is readable by every user of this computer: chmod 600 {tls.key}, and have "
            "the certificate reissued if others may have read it"
        )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        # A password that is never right, or the library would ask for one on the terminal.
        context.load_cert_chain(tls.certificate, tls.key, password=lambda: b"")
    except (ssl.SSLError, ValueError) as error:
        raise MachineFileError(_pair_text(tls, error)) from error
    if tls.client_ca is not None:
        try:
            context.load_verify_locations(tls.client_ca)
        except ssl.SSLError as error:
            raise MachineFileError(f"{tls.client_ca}: tls.client_ca holds no certificate (PEM)") from error
        context.verify_mode = ssl.CERT_REQUIRED
    return context


def lapses(settings: ServiceSettings) -> list[str]:
    """Certificates of a monitor that have expired, or do so within a month: clients refuse them then."""
    given = (settings.access.tls, settings.link.tls, None if settings.fleet is None else settings.fleet.tls)
    files = {one.certificate: None for one in given if one is not None and one.certificate is not None}
    return [*filter(None, map(_expiry_warning, files))]


def _expiry_warning(certificate: Path) -> str:
    try:
        # No public function reads a certificate that is not an authority's. Without this one, say nothing.
        decoded = ssl._ssl._test_decode_cert(str(certificate))  # type: ignore[attr-defined]
        end_s = ssl.cert_time_to_seconds(decoded["notAfter"])
    except (OSError, ValueError, AttributeError):
        return ""
    left_s, day = end_s - time.time(), time.strftime("%Y-%m-%d", time.gmtime(end_s))
    return "" if left_s > _SOON_S else f"{certificate} {'expired' if left_s < 0 else 'expires'} on {day}"


def _pair_text(tls: HttpTlsSettings, error: ssl.SSLError | ValueError) -> str:
    if isinstance(error, ssl.SSLError) and error.reason == "KEY_VALUES_MISMATCH":
        return f"{tls.key}: tls.key is not the key of tls.certificate {tls.certificate}"
    if b"ENCRYPTED" in tls.key.read_bytes():
        return f"{tls.key}: tls.key is protected by a password, expected a key without one"
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(tls.certificate)
    except ssl.SSLError:
        return f"{tls.certificate}: tls.certificate holds no certificate (PEM)"
    return f"{tls.key}: tls.key holds no private key (PEM)"
