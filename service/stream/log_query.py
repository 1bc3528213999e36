"""Parameters of a query for an alarm log on the network: ``after=17;limit=500``."""

import re

from models.errors import RotorwatchError

MOST_EVENTS = 1000
_DEFAULT_EVENTS = 100
_LIMITS = {"after": (-1, 2**53), "limit": (1, MOST_EVENTS)}


def read_log_query(parameters: str) -> tuple[int, int]:
    """Read a query's parameters: after which sequence number (default -1), and at most how many events (default 100).

    `parameters` is the text behind the question mark; names that begin with an underscore are Zenoh's own.

    Raises
    ------
    RotorwatchError
        Naming what was found and what was expected.

    Examples
    --------
    >>> read_log_query("after=17")
    (17, 100)
    """
    found = {"after": -1, "limit": _DEFAULT_EVENTS}
    for part in filter(None, parameters.split(";")):
        name, _, value = part.partition("=")
        if name.startswith("_"):
            continue
        if name not in found:
            raise RotorwatchError(f"no parameter {name}, expected after or limit")
        least, most = _LIMITS[name]
        if not re.fullmatch(r"-?[0-9]{1,18}", value) or not least <= int(value) <= most:
            raise RotorwatchError(f"{name} is {value!r}, expected a whole number from {least} to {most}")
        found[name] = int(value)
    return found["after"], found["limit"]
