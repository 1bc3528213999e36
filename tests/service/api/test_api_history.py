"""The log of alarms page by page and for followers, records in JSON, and snapshots that follow the stream."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from models.commissioning.commissioned import Installed
from rotorwatch.records.alarms import AlarmState, EventKind
from rotorwatch.records.example import example
from rotorwatch.records.health import Health, HealthState, Quality, Report, StreamStatus
from rotorwatch.records.history import AlarmEventList, AuditList
from rotorwatch.records.snapshots import OrbitSnapshot
from rotorwatch.records.windows import Equation, Parameter
from service.monitor import conversion
from service.monitor.alarms.alarm import Alarm, AlarmEvent
from service.monitor.conversion import alarm_cloud_event
from service.monitor.reports import MachineHealth, identity_of, machine_hash
from service.runtime.runtime import Runtime
from tests.service.rig.live import LAB, START_NS, Feed, until
from tests.service.rig.monitored import PLACE, answered, client, fed, problem
from tests.sure import sure

IDENTITY = identity_of(Installed(LAB))
FLOWING = StreamStatus(
    publisher_alive=True, silent=False, silent_since_ns=None, data_age_s=9.0, replay_announced=False,
    descriptor_mismatch=(),
)  # fmt: skip
NAMES = ("k_by", "e", "model")


@pytest.fixture(scope="module")
def busy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Runtime, httpx.Client]]:
    """A service with twelve events: three alarms are shelved and unshelved, twice."""
    with fed(tmp_path_factory.mktemp("machine")) as (runtime, _), client(runtime) as http:
        for _ in range(2):
            for name in NAMES:
                for kind in ("shelve", "unshelve"):
                    body = {"reason": f"{kind} it", "expected_state": "normal" if kind == "shelve" else "shelved"}
                    assert http.post(f"{PLACE}/alarms/{name}/{kind}", json=body).status_code == 200
        yield runtime, http


def page(http: httpx.Client, query: str) -> AlarmEventList:
    return answered(http.get(f"{PLACE}/alarms/events?{query}"), AlarmEventList)


def sequences(found: AlarmEventList) -> list[int]:
    return [event.data.sequence for event in found.events]


def test_pages_back_and_forth_give_the_whole_log_once(busy: tuple[Runtime, httpx.Client]) -> None:
    back, before = [], ""
    for _ in range(3):
        one = page(busy[1], f"limit=5{before}")
        back += sequences(one)
        before = f"&before={one.next_before}"
    assert back == list(reversed(range(12)))
    assert (one.next_before, one.next_after) == (None, None)
    forth, after = [], -1
    while (one := page(busy[1], f"limit=5&after={after}")).events:
        forth += sequences(one)
        after = sure(one.next_after)
    assert forth == list(range(12))
    assert (one.next_before, one.next_after) == (None, 11)
    assert page(busy[1], "after=11") == one  # later events are queried with the same number
    assert sequences(page(busy[1], "after=3&before=6")) == [4, 5]


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("name=e", [9, 8, 3, 2]), ("kind=unshelved", [11, 9, 7, 5, 3, 1]),
        ("kind=shelved&name=model&after=-1", [4, 10]), ("severity=danger", []), ("severity=alert&limit=1", [11]),
    ],
)  # fmt: skip
def test_events_are_filtered(busy: tuple[Runtime, httpx.Client], query: str, expected: list[int]) -> None:
    assert sequences(page(busy[1], query)) == expected


def test_events_are_filtered_by_data_time_and_served_as_published(busy: tuple[Runtime, httpx.Client]) -> None:
    runtime, http = busy
    times = [event.data.time_ns for event in page(http, "after=-1").events]
    assert times == sorted(times)
    assert sequences(page(http, f"since_ns={times[3]}&until_ns={times[7]}")) == [6, 5, 4, 3]
    stored = runtime.machines()[0].history.events(after=-1)
    assert http.get(f"{PLACE}/alarms/events?after=-1").text == (
        f'{{"events":[{",".join(one.text for one in stored)}],"next_before":null,"next_after":11}}'
    )


def test_the_audit_log_shows_who_did_what(busy: tuple[Runtime, httpx.Client]) -> None:
    http = busy[1]
    newest = answered(http.get("/api/v1/audit?limit=2"), AuditList)
    done, begun = newest.entries
    assert (done.actor, done.method, done.status) == ("anonymous", "POST", 200)
    assert (done.action, done.machine, done.alarm, done.reason) == ("unshelve", "demo/lab", "model", "unshelve it")
    assert (begun.action, begun.status, begun.at_ns, begun.path) == ("started", 0, done.at_ns, done.path)
    older = answered(http.get(f"/api/v1/audit?limit=1000&before={newest.next_before}"), AuditList)
    assert len(older.entries) == 2 * 12 - 2
    assert older.next_before is None
    assert {one.alarm for one in older.entries} == {*NAMES, ""}
    assert len(answered(http.get("/api/v1/audit?machine=demo/lab"), AuditList).entries) == 12
    assert answered(http.get("/api/v1/audit?actor=nobody&machine=demo/lab"), AuditList).entries == ()
    assert "there are: demo/lab" in problem(http.get("/api/v1/audit?machine=lab"), 404).detail


def test_infinite_and_undefined_numbers_become_null() -> None:
    readings: list[dict[str, Any]] = [
        {"relative_change": float("nan"), "standard_error": 0.1},
        {"relative_change": 0.1, "standard_error": float("inf")},
        {"reason": "no phase reference"},
    ]
    read = tuple(Parameter(name="k_by", text="", by="likelihood", **one) for one in readings)
    equation = Equation(
        equation="28", title="", evaluable=True, msd=float("inf"), msd_healthy=float("nan"), parameters=read
    )
    odd = {"speed_rad_s": float("nan"), "misfit_z": float("inf"), "equations": (equation,), "parameters": read}
    latest = Report.model_validate({**example(Report), **odd})
    health = conversion.health(
        IDENTITY, MachineHealth(HealthState.HEALTHY, 1.0, latest, (Alarm("k_by", beyond_ns=1),), Quality(), -1), FLOWING
    )
    text = health.model_dump_json()

    def refuse(constant: str) -> None:
        pytest.fail(f"{constant} in JSON")

    fields = json.loads(text, parse_constant=refuse)
    report = fields["report"]
    assert report["speed_rad_s"] is None
    assert report["misfit_z"] is None
    assert report["equations"][0]["msd"] is None
    assert fields["alarms"][0]["standard_error"] is None
    assert [entry["relative_change"] for entry in report["parameters"]] == [None, 0.1, None]
    assert [entry["standard_error"] for entry in report["parameters"]] == [0.1, None, None]
    assert Health.model_validate_json(text) == health


def test_missing_data_do_not_hide_a_raised_alarm() -> None:
    state = AlarmState.UNACKNOWLEDGED
    alarm = Alarm("k_by", state, present=True, raised_ns=5, occurrence=1, change=-0.3, standard_error=0.01)
    latest = Report.model_validate(example(Report))
    record = MachineHealth(HealthState.ALERT, 1.0, latest, (alarm, Alarm("e")), Quality(), 0)
    lost = FLOWING.model_copy(update={"silent": True, "silent_since_ns": START_NS})
    health = conversion.health(IDENTITY, record, lost)
    assert (health.state, health.reason) == ("alert", "no data since 2026-01-01T00:00:00Z")
    assert [(entry.name, entry.raised) for entry in health.alarms] == [("k_by", True)]
    calm = replace(record, state=HealthState.HEALTHY, alarms=())
    assert conversion.health(IDENTITY, calm, lost).state == "no-data"
    assert conversion.health(IDENTITY, calm, FLOWING).state == "healthy"


def test_event_ids_are_stable_and_machine_hashes_follow_the_files_content() -> None:
    alarm = Alarm("k_by", AlarmState.UNACKNOWLEDGED, occurrence=2)
    same = {alarm_cloud_event(IDENTITY, AlarmEvent(EventKind.RAISED, 77, 3, alarm)).id for _ in range(2)}
    other = alarm_cloud_event(IDENTITY, AlarmEvent(EventKind.ESCALATED, 77, 4, alarm))
    assert len(same) == 1
    assert other.id not in same
    assert other.sequence > "00000000000000000003"
    assert (other.time, other.subject) == ("1970-01-01T00:00:00.000000Z", "k_by")
    assert (other.type, other.source) == ("org.rotorwatch.alarm.escalated", "/rotorwatch/demo/lab")
    changed = LAB.model_copy(update={"description": "another"})
    assert machine_hash(LAB) == IDENTITY["machine_hash"]
    assert machine_hash(changed) != IDENTITY["machine_hash"]
    assert len(IDENTITY["machine_hash"]) == 12


def feed_on(runtime: Runtime, feed: Feed, blocks: int) -> None:
    """Put blocks of 0.1 s in which the shaft turns at 22 Hz, and wait until they are accepted."""
    accepted = runtime.machines()[0].health().quality.accepted_blocks
    theta = [one.name for one in feed.machine.sensors].index("theta")
    for _ in range(blocks):
        block = feed.block()
        times_s = (block.start_ns - START_NS) / 1e9 + np.arange(len(block.samples)) / block.rate_hz
        block.samples[:, theta] = 2 * np.pi * (22.0 * times_s % 1.0)
        feed.put(block)
        feed.sequence += 1
        feed.start_ns = block.end_ns
    until(lambda: runtime.machines()[0].health().quality.accepted_blocks == accepted + blocks, "blocks")


def test_samples_are_held_for_a_bounded_time_and_not_joined_across_a_gap(tmp_path: Path) -> None:
    with fed(tmp_path) as (runtime, feed), client(runtime) as http:
        feed_on(runtime, feed, 20)
        before = answered(http.get(f"{PLACE}/orbits?revolutions=30"), OrbitSnapshot)
        assert (before.revolutions, before.path_reason) == (30, "")
        feed.skip()
        begin_ns = feed.start_ns
        feed_on(runtime, feed, 5)
        after = answered(http.get(f"{PLACE}/orbits?revolutions=30"), OrbitSnapshot)
        assert sure(after.path_start_ns) >= begin_ns
        assert 9 <= after.revolutions <= 11
        assert after.path_reason.startswith(f"{after.revolutions} of 30 revolutions: there are 0.5 s of samples")
        feed_on(runtime, feed, 130)
        held = runtime.machines()[0].latest.blocks
        assert sum(block.samples.shape[0] for block in held) == 20_000
        assert held[-1].end_ns == feed.start_ns
