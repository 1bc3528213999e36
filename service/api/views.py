"""Interface of the HTTP API to the service and its machines, and arguments that several routes share."""

import re
from typing import Annotated, Any, Protocol

from fastapi import Depends, HTTPException, Path, Query, Request
from pydantic import AfterValidator

from models.alarm_names import ALARMS, LEVEL, is_alarm
from service.api.routes.replays import ReplayRequests
from service.delivery.event_feed import EventFeed
from service.delivery.metrics import MeasuredService, Metrics
from service.history.store import Store
from service.recordings.catalogue import Catalogue
from service.settings.service import ServiceSettings
from service.stream.monitored import Monitored

PLACE = "/api/v1/machines/{site}/{machine}"
_LATEST_NS = 2**63 - 1

SiteName = Annotated[str, Path(description="site of the machine", examples=["demo"])]
MachineName = Annotated[str, Path(description="name of the machine", examples=["lab"])]


def time_query(text: str) -> Any:
    """A query argument that is a time; `text` describes its purpose."""
    return Query(ge=0, le=_LATEST_NS, description=f"{text}, ns since 1970-01-01 UTC")


SinceNs = Annotated[int | None, time_query("from this time on")]
UntilNs = Annotated[int | None, time_query("before this time")]
Limit = Annotated[int, Query(ge=1, le=1000, description="at most this many")]


def _known_alarm(name: str) -> str:
    if not is_alarm(name):
        raise ValueError(f"no alarm {name[:64]!r}; there are: {', '.join(ALARMS)} and {LEVEL}CHANNEL for each channel")
    return name


_NAMES = "|".join(map(re.escape, ALARMS))
AlarmName = Annotated[
    str,
    AfterValidator(_known_alarm),
    Query(json_schema_extra={"pattern": f"^({_NAMES}|{LEVEL}[A-Za-z0-9_.:-]{{1,64}})$"}, examples=["k_by"]),
]


class ServiceView(MeasuredService, Protocol):
    """Parts of the service that the API uses; implemented by `service.runtime.runtime.Runtime`."""

    settings: ServiceSettings
    metrics: Metrics
    feed: EventFeed
    store: Store
    catalogue: Catalogue | None  # None if no directory for recordings is set
    replays: ReplayRequests


def found_machine(service: ServiceView, site: str, name: str) -> Monitored:
    """Find a machine; HTTPException 404, with a list of the machines, if there is none of this name."""
    machines = {one.machine.title: one for one in service.machines()}
    machine = machines.get(f"{site}/{name}")
    if machine is None:
        raise HTTPException(404, f"no machine {site[:64]}/{name[:64]}; there are: {', '.join(machines)}")
    return machine


def check_alarm(view: Monitored, name: str, status: int) -> None:
    """Refuse an alarm that a machine cannot have; HTTPException with this status, and a list of those it can have."""
    levels = [f"{LEVEL}{channel.name}" for channel in view.machine.sensors if channel.quantity != "shaft_angle"]
    if name not in ALARMS and name not in levels:
        there = ", ".join((*ALARMS, *levels))
        raise HTTPException(status, f"{view.machine.title}: no alarm {name[:80]}; there are: {there}")


async def _in_path(request: Request, site: SiteName, machine: MachineName) -> Monitored:
    return found_machine(request.app.state.service, site, machine)


InPath = Annotated[Monitored, Depends(_in_path)]
"""The machine named in the path of a request."""
