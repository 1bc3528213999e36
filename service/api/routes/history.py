"""The history over HTTP: alarm events, window reports, readings over time, and the audit log."""

import math
from collections.abc import Sequence
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Path, Query
from fastapi.responses import Response
from pydantic import AfterValidator
from pydantic_core import PydanticCustomError

from models.alarm_names import ALARMS
from models.diagnosis.networks.equations import EQUATIONS
from models.mistakes import form
from models.physics.rotor import PARAMETERS
from models.signals.keys import NAME_PATTERN
from rotorwatch.records.alarms import EventKind, Severity
from rotorwatch.records.health import MEASURES
from rotorwatch.records.history import (
    AlarmEventList,
    AlarmEvidence,
    AuditList,
    AuditRecord,
    ReadingList,
    ReportList,
    Trend,
    TrendList,
)
from rotorwatch.records.levels import LEVEL_MEASURES
from rotorwatch.records.monitor import HistoryStatus
from rotorwatch.records.operations import PRINTABLE
from service.access.guard import Guard
from service.access.problems import responses, written
from service.api.views import (
    PLACE,
    AlarmName,
    InPath,
    Limit,
    MachineName,
    ServiceView,
    SinceNs,
    SiteName,
    UntilNs,
    check_alarm,
    found_machine,
)
from service.stream.monitored import Monitored

_LARGEST = 2**63 - 1
_QUANTITIES = ("parameter", "equation", "level", *MEASURES)

_After = Annotated[
    int | None,
    Query(ge=-1, le=_LARGEST, description="only greater sequences (readings: numbers), oldest first; -1 for all"),
]
_Before = Annotated[int | None, Query(ge=0, le=_LARGEST, description="`next_before` of the previous answer")]


def _known_quantity(name: str) -> str:
    if name not in _QUANTITIES:
        raise PydanticCustomError("enum", "expected {expected}", {"expected": ", ".join(_QUANTITIES)})
    return name


_Quantity = Annotated[
    str,
    AfterValidator(_known_quantity),
    Query(description="quantity read in each window", json_schema_extra={"enum": list(_QUANTITIES)}),
]
_ReadingName = Annotated[str, Query(pattern=form("^[A-Za-z0-9_.:-]{1,80}$", "letters, digits and _ . : -, at most 80"))]
_Names = Annotated[
    list[_ReadingName],
    Query(
        max_length=64,
        description="which parameter, equation or level (CHANNEL:MEASURE); with `points` it may be repeated, and all "
        "is the default. Not needed for measures of a window",
    ),
]
_Points = Annotated[
    int | None,
    Query(ge=1, le=5000, description="reduce each to at most this many equal buckets instead of single readings"),
]
_OF = form(
    rf"^{NAME_PATTERN}/{NAME_PATTERN}/({'|'.join(_QUANTITIES)})/[A-Za-z0-9_.:-]{{1,80}}$",
    f"site/machine/quantity/name, where the quantity is one of {', '.join(_QUANTITIES)}",
)
_Of = Annotated[str, Query(pattern=_OF)]
_Plain = Annotated[str | None, Query(max_length=200, pattern=PRINTABLE)]


def add_history_routes(app: FastAPI, service: ServiceView, guard: Guard) -> None:
    """Add the routes."""
    common: dict[str, Any] = {"tags": ["history"], "dependencies": [guard.read]}

    @app.get(f"{PLACE}/alarms/events", **written(AlarmEventList, 404, 422), **common)
    def alarm_events(
        view: InPath,
        after: _After = None,
        before: _Before = None,
        since_ns: SinceNs = None,
        until_ns: UntilNs = None,
        name: Annotated[AlarmName | None, Query(description="only of this alarm")] = None,
        kind: Annotated[EventKind | None, Query(description="only of this kind")] = None,
        severity: Annotated[Severity | None, Query(description="only of this severity")] = None,
        limit: Limit = 100,
    ) -> Response:
        """Alarm events as CloudEvents: newest first, or with `after` oldest first, as followers need them."""
        _check_logged(view, name)
        found = view.history.events(
            after=after,
            before=before,
            since_ns=since_ns,
            until_ns=until_ns,
            alarm=name,
            kind=None if kind is None else kind.value,
            severity=None if severity is None else severity.value,
            limit=limit,
            newest_first=after is None,
        )
        last = found[-1].sequence if found else after
        more = len(found) == limit and last is not None and last > 0
        return _listed(
            "events",
            [one.text for one in found],
            next_before=last if after is None and more else None,
            next_after=None if after is None else last,
        )

    @app.get(f"{PLACE}/alarms/{{name}}/evidence", **written(AlarmEvidence, 404, 422), **common)
    def evidence(
        site: SiteName,
        machine: MachineName,
        name: Annotated[AlarmName, Path(description="name of the alarm", examples=["k_by"])],
        occurrence: Annotated[
            int | None, Query(ge=1, le=_LARGEST, description="which occurrence; the latest if left out")
        ] = None,
    ) -> Response:
        """Evidence of an alarm: report and pictures from before it, when it was raised, and after the change."""
        view = found_machine(service, site, machine)
        text = view.history.evidence(name, occurrence)
        if text is None:
            check_alarm(view, name, 404)
            which = "" if occurrence is None else f"occurrence {occurrence} of "
            raise HTTPException(404, f"nothing was kept of {which}{name}: it was not raised on a window, or long ago")
        return Response(text, media_type="application/json")

    @app.get(f"{PLACE}/reports", **written(ReportList, 404, 422), **common)
    def reports(
        view: InPath, before: _Before = None, since_ns: SinceNs = None, until_ns: UntilNs = None, limit: Limit = 100
    ) -> Response:
        """Window reports, the latest to arrive first; since_ns and until_ns refer to the end of the window."""
        found = view.history.reports(since_ns=since_ns, until_ns=until_ns, before=before, limit=limit)
        return _listed(
            "reports", [one.text for _, one in found], next_before=found[-1][0] if len(found) == limit else None
        )

    @app.get(f"{PLACE}/readings", **written(ReadingList, 404, 422), **common)
    def readings(
        view: InPath,
        quantity: _Quantity = "parameter",
        name: _Names = [],  # noqa: B006  # never changed
        since_ns: SinceNs = None,
        until_ns: UntilNs = None,
        points: _Points = None,
        after: _After = None,
        limit: Limit = 1000,
    ) -> ReadingList | Response:
        """Readings and measures over time: one by one, or with `points` reduced for a plot of any length."""
        history = view.history
        names = name or [quantity] if quantity in MEASURES else name
        _check_read(view, quantity, names, "name")
        if points is not None:
            if after is not None:
                raise HTTPException(422, "after: goes with single readings, not with points")
            buckets: Any = history.downsampled(
                quantity=quantity, names=names or None, since_ns=since_ns, until_ns=until_ns, points=points
            )
            # Without validation: validating twenty thousand fresh buckets takes longer than creating them.
            told = ReadingList.model_construct(quantity=quantity, readings=(), buckets=buckets, next_after=None)
            return Response(told.model_dump_json(warnings=False), media_type="application/json")
        if len(names) != 1:
            raise HTTPException(422, f"name: {len(names)} are given, expected one; several go with points")
        found = history.readings(
            quantity=quantity, name=names[0], since_ns=since_ns, until_ns=until_ns, after=after, limit=limit
        )
        following = found[-1].number if len(found) == limit else None
        return ReadingList(quantity=quantity, readings=found, buckets=(), next_after=following)

    @app.get("/api/v1/trends", responses=responses(TrendList, 404, 422), **common)
    def trends(
        of: Annotated[list[_Of], Query(min_length=1, max_length=64, description="site/machine/quantity/name")],
        hours: Annotated[int, Query(ge=1, le=87_600, description="up to the end of the machine's newest window")] = 24,
        points: Annotated[int, Query(ge=1, le=500, description="at most this many buckets for each")] = 48,
    ) -> TrendList:
        """Recent readings of many machines at once, for an overview of the plant."""
        return TrendList(trends=tuple(_trend(service, each, hours, points) for each in of))

    @app.get(
        "/api/v1/audit", tags=["service"], dependencies=[guard.configure], responses=responses(AuditList, 404, 422)
    )
    def audit(
        before: _Before = None,
        machine: Annotated[_Plain, Query(description="only about this machine, as site/machine")] = None,
        actor: Annotated[_Plain, Query(description="only requests with a token of this name")] = None,
        limit: Limit = 100,
    ) -> AuditList:
        """Who requested what, and the outcome, newest first; kept for ever."""
        found = service.store.audit.entries(before, limit, machine=machine, actor=actor)
        _check_audited(service, machine, found)
        return AuditList(entries=found, next_before=found[-1].number if len(found) == limit else None)

    @app.get("/api/v1/history", tags=["service"], dependencies=[guard.configure], responses=responses(HistoryStatus))
    def history() -> HistoryStatus:
        """How large the history is, how far back it goes, and how long records are kept."""
        return service.store.status()


def _trend(service: ServiceView, of: str, hours: int, points: int) -> Trend:
    site, machine, quantity, name = of.split("/")
    span_ns = hours * 3_600_000_000_000
    view = found_machine(service, site, machine)
    _check_read(view, quantity, [name], "of")
    found = view.history.latest(quantity, name, span_ns=span_ns, points=points)
    buckets = [one for one in found if math.isfinite(one.mean)]
    return Trend(
        site=site,
        machine=machine,
        quantity=quantity,
        name=name,
        length_ns=buckets[0].length_ns if buckets else None,
        starts_ns=tuple(one.start_ns for one in buckets),
        means=tuple(one.mean for one in buckets),
    )


def _check_audited(service: ServiceView, place: str | None, found: Sequence[AuditRecord]) -> None:
    """Refuse a machine that neither exists nor has an entry in the audit log."""
    if place is not None and not found and not service.store.audit.entries(None, 1, machine=place):
        found_machine(service, *place.rpartition("/")[::2])


def _check_logged(view: Monitored, name: str | None) -> None:
    """Refuse an alarm that the machine cannot have and has no events of."""
    if name is not None and name not in ALARMS and not view.history.events(alarm=name, limit=1):
        check_alarm(view, name, 422)


def _check_read(view: Monitored, quantity: str, names: Sequence[str], field: str) -> None:
    """Refuse a name for which the machine has no readings, neither now nor in the history (of another machine file)."""
    channels = [one.name for one in view.machine.sensors if one.quantity != "shaft_angle"]
    known: Sequence[str] = (quantity,)
    if quantity == "parameter":
        known = PARAMETERS
    elif quantity == "equation":
        known = [one.number for one in EQUATIONS]
    elif quantity == "level":
        known = [f"{channel}:{measure}" for channel in channels for measure in LEVEL_MEASURES]
    unknown = set(names).difference(known)
    if not unknown or not (unknown := unknown - view.history.names_of(quantity)):
        return
    expected = f"one of {', '.join(known)}"
    if quantity == "level":
        expected = f"CHANNEL:MEASURE of the channels {', '.join(channels)} and measures {', '.join(LEVEL_MEASURES)}"
    asked = f"{field} is {min(unknown)!r}, but it has no such {quantity}"
    raise HTTPException(422, f"{view.machine.title}: {asked}; expected {expected}")


def _listed(name: str, texts: Sequence[str], **cursors: int | None) -> Response:
    """Answer with stored texts, byte for byte as published, whichever version of the program wrote them."""
    tail = "".join(f',"{cursor}":{"null" if value is None else value}' for cursor, value in cursors.items())
    return Response(f'{{"{name}":[{",".join(texts)}]{tail}}}', media_type="application/json")
