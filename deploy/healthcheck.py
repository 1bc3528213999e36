"""Health checks of the containers: exit code 0 if all is well, 1 with the reason on standard error if not.

::

    healthcheck.py listening PORT    something accepts connections on this port here
    healthcheck.py linked PORT       a connection from here to this port of another container stands
    healthcheck.py http URL          this address answers with status 200
"""

import socket
import sys
import urllib.error
import urllib.request
from pathlib import Path

_ESTABLISHED = "01"  # as in include/net/tcp_states.h of Linux
_TIMEOUT_S = 3.0


def listening(port: str) -> str:
    """Why nothing accepts connections on a local port; empty if something does."""
    try:
        with socket.create_connection(("127.0.0.1", int(port)), timeout=_TIMEOUT_S):
            return ""
    except OSError as error:
        return f"port {port}: {error}"


def linked(port: str) -> str:
    """Why there is no established connection to a remote port; empty if there is one."""
    for table in (Path("/proc/net/tcp"), Path("/proc/net/tcp6")):
        rows = table.read_text(encoding="ascii").splitlines()[1:] if table.exists() else []
        for row in rows:
            _, _, remote, state, *_ = row.split()
            if state == _ESTABLISHED and int(remote.rpartition(":")[2], 16) == int(port):
                return ""
    return f"no connection to port {port}"


def http(url: str) -> str:
    """Why an address does not answer with status 200; empty if it does."""
    try:
        with urllib.request.urlopen(url, timeout=_TIMEOUT_S):  # noqa: S310  # the address is in docker-compose.yml
            return ""
    except (urllib.error.URLError, OSError) as error:
        return f"{url}: {error}"


def main(arguments: list[str]) -> int:
    """Run one check."""
    checks = {"listening": listening, "linked": linked, "http": http}
    match arguments:
        case [name, argument] if name in checks:
            reason = checks[name](argument)
        case _:
            reason = __doc__ or ""
    if reason:
        sys.stderr.write(f"{reason}\n")
    return 1 if reason else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
