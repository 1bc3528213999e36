"""Scopes of access, and who is calling."""

from dataclasses import dataclass, field
from enum import StrEnum


class Scope(StrEnum):
    """What a caller may do; each is granted by itself, none includes another.

    ``read`` looks, ``operate`` acknowledges, shelves and resets alarms and starts replays, ``configure`` takes alarms
    out of service and changes what is monitored.
    """

    READ = "read"
    OPERATE = "operate"
    CONFIGURE = "configure"


@dataclass(frozen=True, slots=True)
class Caller:
    """Who sent a request."""

    name: str  # name of the token; ``anonymous`` where the API is open on loopback, empty for nobody in particular
    scopes: frozenset[Scope] = field(default_factory=frozenset)
    address: str = ""
    token_id: str = ""  # public part of the token, empty without one


ANONYMOUS = "anonymous"
"""Name of every caller where the API is open on loopback."""

NOBODY = ""
"""Name of a caller without a token."""
