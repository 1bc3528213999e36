"""Operations on alarms over HTTP, and refusals: a real service with tokens."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from rotorwatch.records.alarms import Alarm, AlarmStates
from rotorwatch.records.history import AlarmEventList, AuditList
from rotorwatch.records.operations import OperationDone
from service.access.scopes import Scope
from service.runtime.runtime import Runtime
from tests.service.rig.live import Feed, until, worker_of
from tests.service.rig.monitored import GUARDED, PLACE, answered, client, fed, problem, token
from tests.sure import sure

READ, OPERATE, CONFIGURE = Scope
GAP = f"{PLACE}/alarms/data-gap"
ANY = {"If-Match": "*"}


@contextmanager
def gap(folder: Path) -> Iterator[tuple[Runtime, Feed, httpx.Client]]:
    """A gap in the stream has just raised an alarm that latches; Anna may do everything."""
    latching = ("[alarms]", '[alarms]\nlatching = ["data-gap"]\nlongest_shelf_s = 3600.0')
    with fed(folder, GUARDED, latching, ("off_delay_s = 60.0", "off_delay_s = 0.0")) as (runtime, feed):
        feed.gap()
        with client(runtime, token(runtime)) as http:
            until(lambda: state(http) == "unacknowledged", "alarm")
            yield runtime, feed, http


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[tuple[Runtime, Feed, httpx.Client]]:
    with gap(tmp_path) as found:
        yield found


@pytest.fixture(scope="module")
def untouched(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """The same, for requests that leave it unchanged."""
    with gap(tmp_path_factory.mktemp("machine")) as (_, _, http):
        yield http


def state(http: httpx.Client) -> str:
    return answered(http.get(GAP), Alarm).state.value


def test_an_alarm_is_acknowledged_with_its_etag(plant: tuple[Runtime, Feed, httpx.Client]) -> None:
    _, _, http = plant
    seen = http.get(GAP)
    assert seen.headers["etag"] == f'"{answered(seen, Alarm).version}"' == '"0"'
    answer = http.post(
        f"{GAP}/acknowledge", json={"reason": " cable was moved "}, headers={"If-Match": seen.headers["etag"]}
    )
    done = answered(answer, OperationDone)
    assert (done.alarm.state, done.alarm.version) == ("acknowledged", 1)
    assert answer.headers["etag"] == '"1"'
    (event,) = done.events
    assert (event.data.kind, event.data.before, event.data.state) == ("acknowledged", "unacknowledged", "acknowledged")
    assert (event.data.actor, event.data.reason) == ("anna", "cable was moved")
    # The event in the response is committed and is the one that others receive.
    assert answered(http.get(f"{PLACE}/alarms/events?limit=1"), AlarmEventList).events == (event,)
    assert http.get(GAP).headers["etag"] == '"1"'


@pytest.mark.parametrize(
    ("headers", "body"),
    [
        ({"If-Match": '"17"'}, {}),
        ({"If-Match": '"-1"'}, {}),
        ({}, {"expected_state": "normal"}),
        ({"If-Match": '"0"'}, {"expected_state": "shelved"}),
        ({"If-Match": '"17"'}, {"expected_state": "unacknowledged"}),
        (ANY, {"expected_state": "acknowledged"}),
    ],
)
def test_an_outdated_version_is_refused(untouched: httpx.Client, headers: dict[str, str], body: dict[str, str]) -> None:
    found = problem(untouched.post(f"{GAP}/acknowledge", json=body, headers=headers), 409)
    assert found.detail.startswith("data-gap is unacknowledged (version 0), no longer as it was seen (")
    assert found.detail.endswith("): look again")
    assert state(untouched) == "unacknowledged"


def test_the_alarms_version_or_state_can_be_given_in_several_ways(plant: tuple[Runtime, Feed, httpx.Client]) -> None:
    _, _, http = plant
    by_state = {"expected_state": "unacknowledged"}
    for match, body in (('"{}"', {}), ('W/"{}"', {}), ("*", {}), ("", by_state), ('"{}"', by_state)):
        seen = answered(http.get(GAP), Alarm)
        headers = {"If-Match": match.format(seen.version)} if match else {}
        done = answered(http.post(f"{GAP}/acknowledge", json=body, headers=headers), OperationDone)
        assert (seen.state, done.alarm.state, state(http)) == ("unacknowledged", "acknowledged", "acknowledged")
        for order in ("remove-from-service", "return-to-service"):  # which undoes the acknowledgement
            again = {"reason": "x", "expected_state": answered(http.get(GAP), Alarm).state}
            answered(http.post(f"{GAP}/{order}", json=again), OperationDone)


def test_one_of_several_concurrent_operators_succeeds_others_get_409(plant: tuple[Runtime, Feed, httpx.Client]) -> None:
    runtime, _, http = plant
    names = [f"operator {number}" for number in range(8)]
    both = threading.Barrier(len(names))
    statuses: list[int] = []

    def acknowledge(text: str) -> None:
        with client(runtime, text) as own:
            both.wait()
            statuses.append(own.post(f"{GAP}/acknowledge", json={}, headers={"If-Match": '"0"'}).status_code)

    threads = [threading.Thread(target=acknowledge, args=(token(runtime, READ, OPERATE, name=name),)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(statuses) == [200] + [409] * 7
    assert answered(http.get(f"{PLACE}/alarms"), AlarmStates).sequence == 1


def test_alarms_are_shelved_and_unshelved_even_if_never_raised(plant: tuple[Runtime, Feed, httpx.Client]) -> None:
    _, _, http = plant
    body = {"reason": "sensor is being replaced", "duration_s": 600, "one_shot": True}
    done = answered(http.post(f"{GAP}/shelve", json=body, headers={"If-Match": '"0"'}), OperationDone)
    assert done.alarm.state == "shelved"
    assert done.alarm.shelf is not None
    assert (done.alarm.shelf.by, done.alarm.shelf.reason, done.alarm.shelf.one_shot) == ("anna", body["reason"], True)
    assert done.alarm.shelf.until_ns - done.events[0].data.time_ns == 600e9
    refused = problem(http.post(f"{GAP}/acknowledge", json={"expected_state": "shelved"}), 409)
    assert refused.detail == "data-gap is shelved: acknowledge is not possible"
    done = answered(http.post(f"{GAP}/unshelve", json={"expected_state": "shelved"}), OperationDone)
    assert (done.alarm.state, done.alarm.shelf) == ("unacknowledged", None)
    seen = {"If-Match": http.get(f"{PLACE}/alarms/c_bz").headers["etag"]}
    done = answered(http.post(f"{PLACE}/alarms/c_bz/shelve", json={"reason": "x"}, headers=seen), OperationDone)
    assert sure(done.alarm.shelf).until_ns - done.events[0].data.time_ns == 3600e9


def test_latched_alarms_are_reset_and_removal_needs_configure(plant: tuple[Runtime, Feed, httpx.Client]) -> None:
    runtime, feed, http = plant
    feed.put_good(130)  # until a hop is complete, which ends the gap
    until(lambda: state(http) == "latched-unacknowledged", "end of the gap")
    answered(http.post(f"{GAP}/acknowledge", json={"expected_state": "latched-unacknowledged"}), OperationDone)
    done = answered(http.post(f"{GAP}/reset", json={"expected_state": "latched-acknowledged"}), OperationDone)
    assert done.alarm.state == "normal"
    body = {"reason": "no phase reference is fitted", "expected_state": "normal"}
    place = f"{PLACE}/alarms/data-phase-reference"
    with client(runtime, token(runtime, READ, OPERATE, name="ben")) as operator:
        for order in ("remove-from-service", "return-to-service"):
            assert "needs the scope configure" in problem(operator.post(f"{place}/{order}", json=body), 403).detail
    done = answered(http.post(f"{place}/remove-from-service", json=body), OperationDone)
    assert (done.alarm.state, done.alarm.out_of_service_by) == ("out-of-service", "anna")
    assert done.alarm.out_of_service_reason == body["reason"]
    done = answered(http.post(f"{place}/return-to-service", json={"expected_state": "out-of-service"}), OperationDone)
    assert done.alarm.state == "normal"


@pytest.mark.parametrize(
    ("path", "headers", "body", "status", "text"),
    [
        ("data-gap/acknowledge", {}, {}, 428, "state how you saw the alarm"),
        ("data-gap/acknowledge", {"If-Match": "0"}, {}, 422, 'If-Match: expected an ETag such as "17", or *'),
        ("data-gap/acknowledge", {"If-Match": '"0", "1"'}, {}, 422, 'If-Match: expected an ETag such as "17"'),
        ("data-gap/acknowledge", ANY, {"reason": "a\u0000b"}, 422, "reason: expected one line of text"),
        ("data-gap/acknowledge", ANY, {"duration_s": 5}, 422, "duration_s: unknown"),
        ("data-gap/acknowledge", ANY, {"reason": "x" * 501}, 422, "reason: expected at most 500"),
        ("data-gap/acknowledge", ANY, [], 422, "body: expected an object, {...}"),
        ("data-gap/shelve", ANY, {}, 422, "reason: missing"),
        ("data-gap/shelve", ANY, {"reason": "x", "duration_s": 0}, 422, "duration_s: expected above 0"),
        ("data-gap/shelve", ANY, {"reason": "  "}, 422, "reason: expected one line of text that"),
        (
            "data-gap/shelve", ANY, {"reason": "x", "duration_s": 3601}, 409,
            "shelve of data-gap: duration_s",
        ),
        ("data-gap/unshelve", ANY, {}, 409, "data-gap is unacknowledged: unshelve is not possible"),
        ("data-gap/reset", ANY, {}, 409, "data-gap is unacknowledged: reset is not possible"),
        ("k_by/acknowledge", ANY, {}, 409, "k_by is normal: acknowledge is not possible"),
        ("level:y9/acknowledge", ANY, {}, 404, "demo/lab: no alarm level:y9; there are: k_by, c_by"),
        ("level:y9/shelve", ANY, {"reason": "x", "duration_s": 60}, 404, "demo/lab: no alarm level:y9; there are:"),
        ("nose/acknowledge", ANY, {}, 404, "demo/lab: no alarm nose; there are: k_by, c_by"),
        ("events/acknowledge", ANY, {}, 404, "demo/lab: no alarm events; there are:"),
    ],
)  # fmt: skip
def test_impossible_operations_are_explained(
    untouched: httpx.Client, path: str, headers: dict[str, str], body: Any, status: int, text: str
) -> None:
    answer = untouched.post(f"{PLACE}/alarms/{path}", json=body, headers=headers)
    assert problem(answer, status).detail.startswith(text)
    assert answered(untouched.get(f"{PLACE}/alarms"), AlarmStates).sequence == 0


def test_malformed_bodies_are_refused(untouched: httpx.Client) -> None:
    kind = {"content-type": "application/json"}
    for content, headers, status in (
        (b"{", kind, 422), (b"\xff{}", kind, 400), (b"", kind, 422), (b'{"reason":"\\ud800"}', kind, 422),
        (b"{}", {}, 415), (b" " * 1_000_001, kind, 413),
    ):  # fmt: skip
        sent = untouched.post(f"{GAP}/acknowledge", content=content, headers={"if-match": "*"} | headers)
        problem(sent, status)
    assert state(untouched) == "unacknowledged"


def test_operations_and_refusals_are_in_the_audit_log(plant: tuple[Runtime, Feed, httpx.Client]) -> None:
    runtime, _, http = plant
    with client(runtime, token(runtime, READ, name="screen")) as screen:
        problem(screen.post(f"{GAP}/acknowledge", json={}, headers=ANY), 403)
    problem(http.post(f"{GAP}/acknowledge", json={"reason": "late"}, headers={"If-Match": '"9"'}), 409)
    answered(http.post(f"{GAP}/acknowledge", json={"reason": "seen"}, headers={"If-Match": '"0"'}), OperationDone)
    entries = answered(http.get("/api/v1/audit"), AuditList).entries
    assert [(one.actor, one.status, one.action, one.machine, one.alarm, one.reason) for one in entries] == [
        ("anna", 200, "acknowledge", "demo/lab", "data-gap", "seen"),
        ("anna", 0, "started", "", "", ""),
        ("anna", 409, "acknowledge", "demo/lab", "data-gap", "late"),
        ("anna", 0, "started", "", "", ""),
        ("screen", 403, "", "", "", "this needs the scope operate; screen has read"),
    ]


def test_a_stopping_monitor_answers_503(plant: tuple[Runtime, Feed, httpx.Client]) -> None:
    runtime, _, http = plant
    worker_of(runtime).stop()
    found = problem(http.post(f"{GAP}/acknowledge", json={}, headers=ANY), 503)
    assert found.detail == "demo/lab: the monitor is being stopped"
    found = problem(http.get("/readyz"), 503)
    assert (found.model_extra or {})["machines"][0]["worker_alive"] is False
