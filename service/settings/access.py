"""Settings of access to the HTTP API: who may, from where, how much, and under which certificate."""

import ipaddress
import re
from pathlib import Path

from pydantic import BaseModel, Field, field_validator

from models.errors import MachineFileError
from models.signals.link import is_address, is_loopback


class HttpTlsSettings(BaseModel, extra="forbid", frozen=True):
    """Certificate and key of the HTTP API, PEM files relative to the settings file; TLS 1.2 or newer."""

    certificate: Path = Field(description="certificate of the service, then those up to its authority")
    key: Path = Field(description="private key, without a password and not readable by others")
    client_ca: Path | None = Field(
        default=None, description="authorities of clients; if set, clients without a certificate of theirs are refused"
    )


class LimitSettings(BaseModel, extra="forbid", frozen=True):
    """How much one caller may ask for; a caller is a token, or an address where there is none."""

    body_bytes: int = Field(default=1_000_000, ge=1_000, le=1_000_000_000, description="largest request body, in bytes")
    requests_per_minute: int = Field(default=600, ge=1, le=1_000_000, description="most requests of one caller")
    failures_per_minute: int = Field(
        default=10, ge=1, le=100_000, description="most attempts with one wrong token, or with any from one address"
    )
    streams_per_caller: int = Field(default=5, ge=1, le=10_000, description="most open event streams of one caller")
    streams: int = Field(default=50, ge=1, le=100_000, description="most open event streams in all")
    refusals_recorded_per_minute: int = Field(
        default=5, ge=1, le=1_000, description="most refused requests of one address that are written to the audit log"
    )


class AccessSettings(BaseModel, extra="forbid", frozen=True):
    """Who may use the HTTP API; by default a token is needed for all but ``/healthz``, ``/`` and the page's files."""

    open_on_loopback: bool = Field(
        default=False, description="everybody on this computer may do everything without a token"
    )
    hosts: tuple[str, ...] = Field(
        default=(), description="names by which browsers reach the API, other than localhost, the host or an address"
    )
    proxies: tuple[str, ...] = Field(
        default=(), description="addresses or networks of proxies that are trusted to say who the caller is"
    )
    tls: HttpTlsSettings | None = Field(default=None, description="certificate; plain HTTP without it")
    limits: LimitSettings = Field(default=LimitSettings(), description="how much one caller may ask for")

    @field_validator("proxies")
    @classmethod
    def _addresses(cls, proxies: tuple[str, ...]) -> tuple[str, ...]:
        for proxy in proxies:
            try:
                ipaddress.ip_network(proxy)
            except ValueError as error:
                raise ValueError(f"{proxy!r} is neither an address nor a network such as 10.0.0.0/24") from error
        return proxies

    @field_validator("hosts")
    @classmethod
    def _lower_case(cls, hosts: tuple[str, ...]) -> tuple[str, ...]:
        for host in hosts:
            if not re.fullmatch(r"[\w.-]+(:\d+)?", host) and not is_address(re.sub(r"^\[(.*)\](:\d+)?$", r"\1", host)):
                raise ValueError(f"{host!r} is not a host name, expected one such as monitor.plant.example")
        return tuple(host.lower() for host in hosts)


def check_access(place: str, access: AccessSettings, host: str) -> None:
    """Check that the API is open to everybody only where everybody is on this computer.

    Raises
    ------
    MachineFileError
        If ``open_on_loopback`` is set although the API can be reached from elsewhere.
    """
    if not access.open_on_loopback:
        return
    if not is_loopback(host):
        raise MachineFileError(
            f"{place}: access.open_on_loopback is true, but http.host is {host!r}, expected a loopback address such as "
            "127.0.0.1: anyone who reaches this address could do everything; leave open_on_loopback out and create "
            "tokens (rotorwatch token create)"
        )
    if access.proxies:
        raise MachineFileError(
            f"{place}: access.open_on_loopback is true and access.proxies names {', '.join(access.proxies)}: anyone "
            "the proxy serves could do everything; leave open_on_loopback out and create tokens "
            "(rotorwatch token create)"
        )
