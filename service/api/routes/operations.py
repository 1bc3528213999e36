"""Alarms over HTTP: their current state, and operators' actions."""

import re
from typing import Annotated, Any

from fastapi import FastAPI, Header, HTTPException, Path, Query, Request, Response

from models.errors import RotorwatchError
from models.mistakes import form
from rotorwatch.records.alarms import Alarm, AlarmState, AlarmStates
from rotorwatch.records.example import example
from rotorwatch.records.operations import (
    NOT_BLANK,
    PRINTABLE,
    OperationDone,
    OperationKind,
    OperationOrder,
    ReasonedOrder,
    ShelveOrder,
)
from service.access.audit import AuditNote
from service.access.guard import Guard
from service.access.problems import responses, shown_body
from service.access.scopes import Caller
from service.api.views import PLACE, AlarmName, InPath, MachineName, ServiceView, SiteName, check_alarm, found_machine
from service.monitor.alarms.alarm import Alarm as AlarmRecord
from service.monitor.alarms.alarm import NotInTime, OperationConflict, OperationRefused, OperatorAction, UnknownAlarm
from service.monitor.conversion import alarm_entries
from service.stream.monitored import Monitored

_IF_MATCH = form(r'^(\*|(W/)?"-?[0-9]{1,18}")$', 'an ETag such as "17", or *')
form(PRINTABLE, "one line of text")
form(NOT_BLANK, "one line of text that says something")
_ETAG = {
    "ETag": {
        "description": "version of the alarm in quotation marks, for If-Match",
        "schema": {"type": "string"},
        "example": '"17"',
    }
}
_STATUS: dict[type[RotorwatchError], int] = {
    UnknownAlarm: 404,
    OperationConflict: 409,
    OperationRefused: 409,
    NotInTime: 503,
}
_TEXTS: dict[OperationKind, str] = {
    "acknowledge": "State that an alarm has been seen.",
    "reset": "Release a latched alarm, once its condition has cleared.",
    "shelve": "Silence an alarm for a time, at most as long as the machine file allows.",
    "unshelve": "End the shelving of an alarm.",
    "remove-from-service": "Take an alarm out of service, until it is returned.",
    "return-to-service": "Return an alarm to service.",
}
_Order = OperationOrder | ReasonedOrder | ShelveOrder
_ORDERS: dict[OperationKind, type[_Order]] = {"shelve": ShelveOrder, "remove-from-service": ReasonedOrder}

_Alarm = Annotated[str, Path(description="name of the alarm", examples=["k_by"])]
_IfMatch = Annotated[
    str | None,
    Header(
        alias="If-Match",
        pattern=_IF_MATCH,
        description="ETag of the alarm as you saw it, or * for any state; needed without `expected_state`",
        examples=['"17"'],
    ),
]


def add_operation_routes(app: FastAPI, service: ServiceView, guard: Guard) -> None:
    """Add the routes; those of alarm events must be added before, or ``events`` would be taken for an alarm's name."""
    common: dict[str, Any] = {"tags": ["alarms"], "dependencies": [guard.read]}

    @app.get(f"{PLACE}/alarms", responses=responses(AlarmStates, 404, 422), **common)
    def alarms(
        view: InPath,
        state: Annotated[list[AlarmState], Query(description="only in this state; may be repeated")] = [],  # noqa: B006  # never changed
        name: Annotated[list[AlarmName], Query(description="only this alarm; may be repeated")] = [],  # noqa: B006
        raised: Annotated[bool, Query(description="only those that are raised")] = False,
        all_: Annotated[bool, Query(alias="all", description="include normal alarms")] = False,
    ) -> AlarmStates:
        """Alarms that are not normal, or those requested."""
        for one in name:
            check_alarm(view, one, 422)
        states = view.alarms(include_normal=all_ or bool(state or name))
        chosen = (
            one
            for one in states.alarms
            if (not state or one.state in state) and (not name or one.name in name) and (one.raised or not raised)
        )
        return states.model_copy(update={"alarms": tuple(chosen)})

    @app.get(f"{PLACE}/alarms/{{name}}", responses=responses(Alarm, 404, 422, headers=_ETAG), **common)
    def alarm(site: SiteName, machine: MachineName, name: _Alarm, response: Response) -> Alarm:
        """One alarm; the header ETag has its version."""
        return _marked(_present(found_machine(service, site, machine), name), response)

    for kind in _TEXTS:
        _add_operation(app, service, guard, kind)


def _add_operation(app: FastAPI, service: ServiceView, guard: Guard, kind: OperationKind) -> None:
    configures = kind in ("remove-from-service", "return-to-service")
    model: Any = _ORDERS.get(kind, OperationOrder)

    @app.post(
        f"{PLACE}/alarms/{{name}}/{kind}",
        tags=["alarms"],
        name=kind,
        operation_id=kind.replace("-", "_"),
        summary=kind.replace("-", " ").capitalize(),
        description=f"{_TEXTS[kind]} It is done only if the alarm is still as the caller saw it.",
        responses=responses(OperationDone, 400, 404, 409, 413, 415, 422, 428, headers=_ETAG),
    )
    def operate(
        request: Request,
        response: Response,
        site: SiteName,
        machine: MachineName,
        name: _Alarm,
        caller: Annotated[Caller, guard.configure if configures else guard.operate],
        posted: Annotated[model, shown_body("as seen in the control room", example(model))],
        if_match: _IfMatch = None,
    ) -> OperationDone:
        order: _Order = posted
        request.state.audit = AuditNote(kind, f"{site}/{machine}", name, order.reason)
        view = found_machine(service, site, machine)
        if if_match is None and order.expected_state is None:
            raise HTTPException(
                428, "state how you saw the alarm: header If-Match with its ETag, or expected_state in the body"
            )
        version = re.search(r"-?[0-9]+", if_match or "")  # a compressing proxy may have made a weak ETag of it
        operation = OperatorAction(
            kind=kind,
            alarm=name,
            actor=caller.name,
            reason=order.reason.strip(),
            duration_s=order.duration_s if isinstance(order, ShelveOrder) else None,
            one_shot=order.one_shot if isinstance(order, ShelveOrder) else False,
            expected_state=None if order.expected_state is None else order.expected_state.value,
            expected_version=None if version is None else int(version[0]),
        )
        _ = _present(view, name)  # the monitor does not know the channels: it would shelve a level that nothing has
        try:
            events = view.operate(operation)
        except (UnknownAlarm, OperationConflict, OperationRefused, NotInTime) as error:
            raise HTTPException(_STATUS[type(error)], str(error)) from error
        return OperationDone(alarm=_marked(_present(view, name), response), events=events)


def _present(view: Monitored, name: str) -> Alarm:
    """The current state of an alarm; an alarm of the machine that never occurred is normal."""
    for one in view.alarms(include_normal=True).alarms:
        if one.name == name:
            return one
    check_alarm(view, name, 404)
    (normal,) = alarm_entries((AlarmRecord(name),), include_normal=True)
    return normal


def _marked(alarm: Alarm, response: Response) -> Alarm:
    response.headers["ETag"] = f'"{alarm.version}"'
    return alarm
