"""Free addresses on loopback for tests that run in parallel, and Zenoh sessions there."""

import os
import socket

import zenoh

from models.signals.link import LinkSettings

_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")) % 8
_used_ports: set[int] = set()


def endpoint() -> str:
    """A free address, below the range from which the system takes ports for outgoing connections."""
    while True:
        # Not from the seeded generators: two test runs beside each other must not try the same ports. Workers of one
        # run never do: each has every eighth port.
        port = 10_000 + int.from_bytes(os.urandom(2), "little") % 2_500 * 8 + _WORKER
        if port in _used_ports:
            continue
        _used_ports.add(port)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
        return f"tcp/127.0.0.1:{port}"


def session_of(link: LinkSettings, **more: str) -> zenoh.Session:
    """A session with these settings and more of Zenoh's own."""
    config = zenoh.Config()
    for path, value in (link.zenoh_items() | more).items():
        config.insert_json5(path, value)
    return zenoh.open(config)
