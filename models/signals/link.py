"""How a program connects to Zenoh: settings and the configuration they stand for. Opens nothing itself."""

import json
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["NAMESPACE_PATTERN", "LinkSettings"]

NAMESPACE_PATTERN = r"^([A-Za-z0-9][A-Za-z0-9_.-]*(/[A-Za-z0-9][A-Za-z0-9_.-]*)*)?$"
"""Key segments that could begin any key: no wildcards, no empty ones."""


class LinkSettings(BaseModel):
    """Endpoints and mode of a Zenoh session; the defaults stay on loopback and start no discovery.

    Multicast and gossip discovery are always off: a program talks to the endpoints it was given and no other.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    mode: Literal["peer", "client", "router"] = Field(default="peer", description="role in the Zenoh network")
    listen: tuple[str, ...] = Field(default=(), description='endpoints to listen on, as "tcp/127.0.0.1:7447"')
    connect: tuple[str, ...] = Field(default=(), description='endpoints to connect to, as "tcp/127.0.0.1:7447"')
    shared_memory: bool = Field(default=False, description="let Zenoh move payloads through shared memory")
    namespace: str = Field(
        default="",
        pattern=NAMESPACE_PATTERN,
        description='what goes before every key, as "replay/monday"; the program then hears nothing from outside it, '
        "and nobody outside hears the program",
    )

    def zenoh_items(self) -> dict[str, str]:
        """Configuration paths and their JSON5 values, to be inserted one by one into a Zenoh configuration."""
        items = {
            "mode": json.dumps(self.mode),
            "listen/endpoints": json.dumps(list(self.listen)),
            "connect/endpoints": json.dumps(list(self.connect)),
            "scouting/multicast/enabled": "false",
            "scouting/gossip/enabled": "false",
            "timestamping/enabled": "true",
            "transport/shared_memory/enabled": json.dumps(self.shared_memory),
        }
        if self.namespace:
            items["namespace"] = json.dumps(self.namespace)
        return items
