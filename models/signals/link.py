"""How a program connects to Zenoh: endpoints, settings and the configuration they stand for. Opens nothing itself.

Settings hold names of files and variables, never a password: secrets are read when a session is opened, never kept.
"""

import ipaddress
import json
import os
import re
import ssl
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, Field, model_validator

from models.errors import MachineFileError
from models.mistakes import checked, did_you_mean, in_folder, read_toml
from models.signals.keys import Grant, access_control

_HOST_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws")
_LOCAL_PROTOCOLS = ("unixsock-stream", "unixpipe")
_PORTLESS_PROTOCOLS = (*_LOCAL_PROTOCOLS, "serial", "vsock")
_HIGHEST_PORT = 65535


def is_address(name: str) -> bool:
    """Whether a host is given as an address."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_loopback(host: str) -> bool:
    """Whether nobody outside this computer reaches what listens on `host`."""
    return host == "localhost" or (is_address(host) and ipaddress.ip_address(host).is_loopback)


def is_local(endpoint: str) -> bool:
    """Whether nobody outside this computer reaches what listens on an endpoint.

    Examples
    --------
    >>> is_local("tcp/[::1]:7447"), is_local("tcp/10.0.0.5:7447")
    (True, False)
    """
    protocol, _, rest = endpoint.partition("/")
    host = re.split(r"[?#]", rest)[0].rpartition(":")[0].strip("[]")
    return protocol in _LOCAL_PROTOCOLS or (protocol in _HOST_PROTOCOLS and is_loopback(host))


def endpoint_fault(text: str) -> str | None:
    """What is wrong with an endpoint; None if it can be used.

    Examples
    --------
    >>> endpoint_fault("localhost:7447")
    "'localhost:7447': expected PROTOCOL/HOST:PORT; did you mean tcp/localhost:7447?"
    """
    protocol, slash, rest = text.partition("/")
    address = re.split(r"[?#]", rest)[0]
    if slash and protocol in _PORTLESS_PROTOCOLS and address:
        return None
    host = r"(\[[^][\s]+\]|[^][:/\s]+)"
    match = re.fullmatch(rf"{host}:(\d+)", address)
    if slash and protocol in _HOST_PROTOCOLS and match is not None:
        wrong = int(match[2]) > _HIGHEST_PORT
        return f"{text!r}: the port is {match[2]}, expected 0 to {_HIGHEST_PORT}" if wrong else None
    portless = re.fullmatch(rf"{host}(:[^:/]*)?", address)
    if slash and protocol in _HOST_PROTOCOLS and portless is not None:
        meant = f"{protocol}/{portless[1]}:7447"
        return f"{text!r}: expected a port, a number, after the host; did you mean {meant}?"
    known = [name for name in _HOST_PROTOCOLS if did_you_mean(protocol.rstrip(":"), [name])] or ["tcp"]
    place = re.fullmatch(rf"(?:[\w-]*:?/+)?(?:{host}:)?(\d+)", text)
    meant = "tcp/127.0.0.1:7447" if place is None else f"{known[0]}/{place[1] or '127.0.0.1'}:{place[2]}"
    if re.fullmatch(r"[A-Za-z][\w.-]*", text):
        meant = f"tcp/{text}:7447"
    return f"{text!r}: expected PROTOCOL/HOST:PORT; did you mean {meant}?"


def _user_names_in(path: Path) -> frozenset[str]:
    """Names of the users in a file with a line ``name:password`` for each."""
    place, names = f"link.passwords_file: {path}", list[str]()
    for number, line in enumerate(_secret("passwords_file", path).splitlines(), start=1):
        name, colon, password = line.partition(":")
        if not (name and colon and password) or line != line.strip() or " " in name:
            # Never the line itself: there is a password in it.
            form = "name:password, without spaces around them, comments or empty lines"
            raise MachineFileError(f"{place}: line {number}: expected {form}")
        if name in names:
            raise MachineFileError(f"{place}: line {number}: the user {name} already has a line")
        names.append(name)
    if not names:
        raise MachineFileError(f"{place}: no users, expected a line name:password for each")
    return frozenset(names)


def _check_certificate(field: str, path: Path) -> None:
    if "-----BEGIN CERTIFICATE-----" not in _text(field, path):
        raise MachineFileError(f"link.{field}: {path}: expected a certificate in PEM (-----BEGIN CERTIFICATE-----)")


def _check_key(certificate: Path, key: Path) -> None:
    """Check that a file holds a private key that others may not read, and that it belongs to the certificate."""
    text = _secret("tls.key", key)
    if "ENCRYPTED" in text:
        why = "the private key needs a passphrase, which cannot be entered here; expected none"
        raise MachineFileError(f"link.tls.key: {key}: {why}")
    if "PRIVATE KEY-----" not in text:
        raise MachineFileError(f"link.tls.key: {key}: expected a private key in PEM (-----BEGIN PRIVATE KEY-----)")
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)
    except ssl.SSLError as error:
        raise MachineFileError(f"link.tls.key: {key} is not the key of {certificate}, or one is damaged") from error


def _secret(field: str, path: Path) -> str:
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        raise MachineFileError(f"link.{field}: {path}: cannot be read ({error.strerror})") from error
    if os.name == "posix" and mode & stat.S_IRWXO:
        open_to = f"every user of this computer may read or change it (mode {mode:04o})"
        raise MachineFileError(f"link.{field}: {path}: {open_to}; protect it with: chmod 600 {path}")
    return _text(field, path)


def _text(field: str, path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise MachineFileError(f"link.{field}: {path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise MachineFileError(f"link.{field}: {path}: not a text file") from error


# Key segments that could begin any key: no wildcards, no empty ones.
NAMESPACE_PATTERN = r"^([A-Za-z0-9][A-Za-z0-9_.-]*(/[A-Za-z0-9][A-Za-z0-9_.-]*)*)?$"
_ENCRYPTED = ("tls/", "quic/")
_SECRETS = {"password": "password_file", "passwords": "passwords_file"}


class TlsSettings(BaseModel, extra="forbid", frozen=True):
    """Certificates of endpoints that begin with ``tls/``; all files are PEM.

    Examples
    --------
    >>> TlsSettings(root_certificate="ca.pem", certificate="pump-7.pem", key="pump-7.key", mutual=True).mutual
    True
    """

    root_certificate: Path | None = Field(
        default=None, description="certificate of the authority that must have issued the other side's certificate"
    )
    certificate: Path | None = Field(default=None, description="this program's own certificate")
    key: Path | None = Field(default=None, description="private key of the certificate, without a passphrase, mode 600")
    mutual: bool = Field(
        default=False, description="clients present a certificate too: listening asks for it, connecting presents it"
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together, found only one of them")
        if self.mutual and (self.certificate is None or self.root_certificate is None):
            raise ValueError("mutual needs root_certificate, certificate and key")
        return self


class LinkSettings(BaseModel, extra="forbid", frozen=True, hide_input_in_errors=True):
    """Endpoints and mode of a Zenoh session; the defaults stay on loopback and start no discovery.

    Multicast and gossip discovery are always off: a program talks to the endpoints it was given and no other.
    """

    mode: Literal["peer", "client", "router"] = Field(default="peer", description="role in the Zenoh network")
    listen: tuple[str, ...] = Field(default=(), description='endpoints to listen on, as "tcp/127.0.0.1:7447"')
    connect: tuple[str, ...] = Field(default=(), description='endpoints to connect to, as "tcp/127.0.0.1:7447"')
    shared_memory: bool = Field(default=False, description="let Zenoh move payloads through shared memory")
    max_message_mb: float = Field(
        default=16.0, gt=0, le=1000, description="most megabytes of a message; larger ones are dropped unread"
    )
    namespace: str = Field(
        default="",
        pattern=NAMESPACE_PATTERN,
        description='prefix of every key, such as "replay/monday"; the program then receives nothing from outside '
        "it, and nothing outside receives from the program",
    )
    user: str | None = Field(
        default=None,
        pattern=r"^[^\s:]+$",
        description="name under which this program connects to others, without spaces and colons",
    )
    password_file: Path | None = Field(default=None, description="file of mode 600 with the password of user")
    password_variable: str | None = Field(
        default=None,
        pattern=r"^[A-Za-z_][A-Za-z0-9_]*$",
        description="environment variable with the password of user, instead of a file",
    )
    passwords_file: Path | None = Field(
        default=None,
        description="file of mode 600 with a line name:password for each user who may connect to this program",
    )
    tls: TlsSettings | None = Field(default=None, description='certificates of endpoints that begin with "tls/"')
    grants: tuple[Grant, ...] = Field(
        default=(), description="who may do what; with any grant, everything that none allows is refused"
    )
    without_grants: bool = Field(
        default=False,
        description="anyone who can connect from other computers may do everything; without grants, monitor "
        "and router listen only on this computer's own endpoints unless this is true",
    )

    @model_validator(mode="before")
    @classmethod
    def _no_secrets(cls, fields: Any) -> Any:  # whatever the file has; checked field by field afterwards
        for name in _SECRETS.keys() & fields.keys() if isinstance(fields, dict) else ():
            # Raised here, so that the value is in no message.
            instead = f"put it into a file of mode 600 and name that in {_SECRETS[name]}"
            raise ValueError(f"{name} does not belong in settings, which many may read: {instead}")
        return fields

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for fault in self._faults():
            raise ValueError(fault)
        return self

    def check_reach(self, place: str) -> None:
        """Check that there are grants, or `without_grants` is set, if other computers can reach an endpoint.

        Raises
        ------
        MachineFileError
            Naming the endpoints that they can reach.
        """
        far = [end for end in self.listen if endpoint_fault(end) is None and not is_local(end)]
        if far and not self.grants and not self.without_grants:
            raise MachineFileError(
                f"{place}: link.listen is {', '.join(far)}, which other computers can reach, and there are "
                "no grants: anyone who connects could send false data and alarms; expected [[link.grants]], an "
                "endpoint on 127.0.0.1 or without_grants = true in [link] (of a router also --without-grants)"
            )

    def zenoh_items(self) -> dict[str, str]:
        """Configuration paths and their JSON5 values, to be inserted one by one into a Zenoh configuration.

        The password is among them: they go to Zenoh and nowhere else, not into a message and not into a log.

        Raises
        ------
        MachineFileError
            If a password, certificate or key cannot be used, or the settings contradict each other.
        """
        for fault in self._faults():  # again: a command line may have replaced the endpoints that were checked
            raise MachineFileError(f"link: {fault}")
        items = {
            "mode": json.dumps(self.mode),
            "listen/endpoints": json.dumps(list(self.listen)),
            "connect/endpoints": json.dumps(list(self.connect)),
            "scouting/multicast/enabled": "false",
            "scouting/gossip/enabled": "false",
            "timestamping/enabled": "true",
            "transport/shared_memory/enabled": json.dumps(self.shared_memory),
            # Zenoh sends heartbeats from the thread that serves its sockets. A heartbeat behind messages of the same
            # priority that wait for room in the socket blocks that thread until the link breaks: so theirs differs.
            "qos/publication": json.dumps([{"key_exprs": ["**/@adv/**"], "config": {"priority": "background"}}]),
            # Up to 256 messages wait in each of Zenoh's queues, each of up to a gigabyte by default.
            "transport/link/rx/max_message_size": str(round(self.max_message_mb * 1e6)),
        }
        if self.namespace:
            items["namespace"] = json.dumps(self.namespace)
        items |= self._tls_items() | self._password_items()
        if self.grants:
            rules = access_control(self.grants, "cert_common_names" if self.passwords_file is None else "usernames")
            items["access_control"] = json.dumps(rules)
        return items

    def explain(self, error: str) -> str:
        """Why a session could not be opened, in plain words.

        Zenoh does not tell a program why it was turned away, so the possible reasons with these settings are listed.
        """
        if "Address already in use" in error:
            return "address already in use: is another program listening there?"
        if "Timeout" in error or "Unable to connect" in error:
            return self.refusal()
        return re.sub(r"\s*\(?at \S+\.rs:\d+\)?\.?", "", error)

    def refusal(self) -> str:
        """Possible reasons why no endpoint accepted this program, in a sentence."""
        reasons = []
        if self.user is not None:
            where = self.password_file or f"environment variable {self.password_variable}"
            reasons.append(f"the other side does not accept the user {self.user} with the password in {where}")
        else:
            reasons.append("the other side requires a user name, and link.user has none")
        if self._encrypted(self.connect) and self.tls is not None:
            reasons.append(
                f"the other side's certificate was not issued by {self.tls.root_certificate}, has expired, or is for "
                "another name than the endpoint's"
            )
            if self.tls.mutual:
                reasons.append(f"{self.tls.certificate} was not issued by the authority trusted there, or has expired")
            else:
                reasons.append("the other side requires a client certificate, and link.tls.mutual is false")
        elif self.connect:
            reasons.append("the other side serves only tls/ endpoints")
        return f"nothing answers there; or {'; or '.join(reasons)}"

    def _faults(self) -> Iterator[str]:
        """Describe what cannot be an endpoint, and settings that contradict each other."""
        for role, ends in (("listen", self.listen), ("connect", self.connect)):
            for fault in filter(None, map(endpoint_fault, ends)):
                yield f"{role}: {fault}"
        if self.user is None and (self.password_file or self.password_variable):
            yield "a password is given, but no user"
        if self.user is not None and (self.password_file is None) == (self.password_variable is None):
            yield f"user is {self.user}: expected its password in one of password_file and password_variable"
        if self.passwords_file is not None and not self.listen:
            yield "passwords_file is for clients of this program, which has no listen endpoint"
        if self._encrypted(self.listen) and (self.tls is None or self.tls.certificate is None):
            yield f"listen is {', '.join(self.listen)}: expected [link.tls] with certificate and key"
        if self._encrypted(self.connect) and (self.tls is None or self.tls.root_certificate is None):
            yield f"connect is {', '.join(self.connect)}: expected [link.tls] with root_certificate"
        if self.grants:
            yield from self._faults_of_grants()
        if self.grants and self.without_grants:
            yield "without_grants is true and there are grants, expected one or the other"

    def _faults_of_grants(self) -> Iterator[str]:
        if not self.listen:
            yield "grants are for clients of this program, which has no listen endpoint"
        if self.connect:
            # The partner of an outgoing connection has shown no name, so everything it sends would be refused.
            yield "grants and connect endpoints do not go together: give the grants to the router that all connect to"
        if self.passwords_file is None:
            if self.tls is None or not self.tls.mutual:
                yield "grants go by names, expected passwords_file or tls.mutual: clients have none"
            for endpoint in self.listen:
                if not endpoint.startswith(_ENCRYPTED):
                    yield f"grants go by certificate, but clients show none to {endpoint}: expected tls/ endpoints only"

    @staticmethod
    def _encrypted(endpoints: tuple[str, ...]) -> bool:
        return any(endpoint.startswith(_ENCRYPTED) for endpoint in endpoints)

    def _tls_items(self) -> dict[str, str]:
        tls = self.tls
        if tls is None:
            return {}
        place = "transport/link/tls"
        items = {f"{place}/enable_mtls": json.dumps(tls.mutual), f"{place}/verify_name_on_connect": "true"}
        if tls.root_certificate is not None:
            _check_certificate("tls.root_certificate", tls.root_certificate)
            items[f"{place}/root_ca_certificate"] = json.dumps(str(tls.root_certificate))
        if tls.certificate is not None and tls.key is not None:
            _check_certificate("tls.certificate", tls.certificate)
            _check_key(tls.certificate, tls.key)
            for role, ends in (("listen", self.listen), ("connect", self.connect)):
                if self._encrypted(ends) and (role == "listen" or tls.mutual):
                    items[f"{place}/{role}_certificate"] = json.dumps(str(tls.certificate))
                    items[f"{place}/{role}_private_key"] = json.dumps(str(tls.key))
        return items

    def _password_items(self) -> dict[str, str]:
        place, items = "transport/auth/usrpwd", {}
        if self.user is not None:
            items[f"{place}/user"] = json.dumps(self.user)
            items[f"{place}/password"] = json.dumps(self._password())
        if self.passwords_file is not None:
            names = _user_names_in(self.passwords_file)
            items[f"{place}/dictionary_file"] = json.dumps(str(self.passwords_file))
            strangers = sorted({name for grant in self.grants for name in grant.who} - names)
            if strangers:
                raise MachineFileError(f"link.grants: who: {', '.join(strangers)} has no line in {self.passwords_file}")
        return items

    def _password(self) -> str:
        if self.password_file is not None:
            lines = _secret("password_file", self.password_file).splitlines()
            if len(lines) != 1 or not lines[0].strip():
                found = f"expected one line with the password, found {len(lines)} lines"
                raise MachineFileError(f"link.password_file: {self.password_file}: {found}")
            return lines[0].strip()
        password = os.environ.get(self.password_variable or "", "")
        if not password:
            raise MachineFileError(
                f"link.password_variable: the environment variable {self.password_variable} is empty or not set, "
                f"expected the password of user {self.user}"
            )
        return password


class _LinkFile(BaseModel, extra="forbid", frozen=True, hide_input_in_errors=True):
    link: LinkSettings


def load_link(path: Path) -> LinkSettings:
    """Load a link file; files named in it are taken from its folder.

    Raises
    ------
    MachineFileError
        Naming the file, the field and what was expected. Passwords, certificates and keys are read and checked when a
        session is opened.
    """
    link = checked(_LinkFile, read_toml(path), path).link
    if not link.listen and not link.connect:
        raise MachineFileError(f"{path}: link: expected endpoints in listen or connect, found neither")
    return in_folder(link, path.parent)
