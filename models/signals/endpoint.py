"""Zenoh endpoints as people write them, such as ``tcp/127.0.0.1:7447``."""

import ipaddress
import re

from models.mistakes import did_you_mean

__all__ = ["endpoint_fault", "is_address", "is_local", "is_loopback"]

_OF_HOSTS = ("tcp", "udp", "tls", "quic", "ws")
_WITHIN = ("unixsock-stream", "unixpipe")
_OTHERS = (*_WITHIN, "serial", "vsock")
_LOCAL = "127.0.0.1"
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
    return protocol in _WITHIN or (protocol in _OF_HOSTS and is_loopback(host))


def endpoint_fault(text: str) -> str | None:
    """What is wrong with an endpoint; None if it can be used.

    Examples
    --------
    >>> endpoint_fault("localhost:7447")
    "'localhost:7447': expected PROTOCOL/HOST:PORT; did you mean tcp/localhost:7447?"
    """
    protocol, slash, rest = text.partition("/")
    address = re.split(r"[?#]", rest)[0]
    if slash and protocol in _OTHERS and address:
        return None
    host = r"(\[[^][\s]+\]|[^][:/\s]+)"
    match = re.fullmatch(rf"{host}:(\d+)", address)
    if slash and protocol in _OF_HOSTS and match is not None:
        wrong = int(match[2]) > _HIGHEST_PORT
        return f"{text!r}: the port is {match[2]}, expected 0 to {_HIGHEST_PORT}" if wrong else None
    portless = re.fullmatch(rf"{host}(:[^:/]*)?", address)
    if slash and protocol in _OF_HOSTS and portless is not None:
        meant = f"{protocol}/{portless[1]}:7447"
        return f"{text!r}: expected a port, a number, after the host; did you mean {meant}?"
    known = [name for name in _OF_HOSTS if did_you_mean(protocol.rstrip(":"), [name])] or ["tcp"]
    place = re.fullmatch(rf"(?:[\w-]*:?/+)?(?:{host}:)?(\d+)", text)
    meant = "tcp/127.0.0.1:7447" if place is None else f"{known[0]}/{place[1] or _LOCAL}:{place[2]}"
    if re.fullmatch(r"[A-Za-z][\w.-]*", text):
        meant = f"tcp/{text}:7447"
    return f"{text!r}: expected PROTOCOL/HOST:PORT; did you mean {meant}?"
