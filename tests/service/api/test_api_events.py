"""The event stream over HTTP: complete, in order, each event once, however often the reader reconnects."""

import asyncio
import itertools
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import httpx_sse
import numpy as np
import pytest

from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.example import example
from rotorwatch.records.health import Health
from service.access.scopes import Scope
from service.delivery import event_feed
from service.delivery.event_feed import CursorError, EventFeed, cursor_text, parsed_cursor
from service.history.records import StoreError
from service.monitor.alarms.alarm import OperatorAction
from service.runtime.runtime import Runtime, running
from service.settings.access import AccessSettings, LimitSettings
from service.settings.service import MachineEntry
from service.stream.monitored import Monitored
from tests.service.rig.live import OPEN, endpoint, settings, until
from tests.service.rig.monitored import client, fed, problem, token

EVENTS = "/api/v1/events"
LAB, HEAVY = "demo/lab", "demo/heavy"


@contextmanager
def monitor(access: AccessSettings = OPEN) -> Iterator[Runtime]:
    """Two machines without data."""
    machines = (MachineEntry(file="lab"), MachineEntry(file="heavy"))
    with running(settings(endpoint(), access=access, machines=machines)) as runtime:
        yield runtime


@pytest.fixture(scope="module")
def shared() -> Iterator[Runtime]:
    with monitor() as runtime:
        yield runtime


def happen(worker: Monitored, count: int = 1) -> None:
    for _ in range(count):
        kind: Any = "unshelve" if worker.history.last_sequence % 2 == 0 else "shelve"
        worker.operate(OperatorAction(kind, "k_by", actor="anna", reason="x"))


@dataclass(slots=True)
class Reader:
    events: Iterator[httpx_sse.ServerSentEvent]

    def next(self, kind: str = "alarm") -> httpx_sse.ServerSentEvent:
        return next(event for event in self.events if event.event == kind)

    def alarms(self, count: int) -> list[AlarmCloudEvent]:
        return [AlarmCloudEvent.model_validate_json(self.next().data) for _ in range(count)]


@contextmanager
def reading(runtime: Runtime, query: str = "", text: str = "", **headers: str) -> Iterator[Reader]:
    with client(runtime, text) as http, httpx_sse.connect_sse(http, "GET", EVENTS + query, headers=headers) as source:
        assert source.response.status_code == 200
        yield Reader(source.iter_sse())


def is_shelved(health: Health) -> bool:
    return any(one.name == "k_by" and one.state == "shelved" for one in health.alarms)


def log(worker: Monitored) -> list[str]:
    return [one.text for one in worker.history.events(after=-1, limit=10_000)]


def test_events_arrive_with_an_id_to_resume_from(shared: Runtime) -> None:
    lab, heavy = shared.machines()
    before = lab.history.last_sequence, heavy.history.last_sequence
    with reading(shared) as reader:
        start = reader.next("start")
        assert (start.id, start.retry) == (f"{LAB}={before[0]},{HEAVY}={before[1]}", 2000)
        assert json.loads(start.data) == {}
        happen(lab)
        first = reader.next()
        assert (first.id, first.data) == (f"{LAB}={before[0] + 1},{HEAVY}={before[1]}", log(lab)[-1])
        happen(heavy)
        second = reader.next()
        assert (second.id, second.data) == (f"{LAB}={before[0] + 1},{HEAVY}={before[1] + 1}", log(heavy)[-1])


@pytest.mark.parametrize(
    ("query", "by_header"), [("", True), ("?last_event_id=LAST", False), (f"?last_event_id={LAB}=0", True)]
)
def test_a_stream_resumes_after_the_last_event_id(shared: Runtime, query: str, by_header: bool) -> None:
    """The header takes precedence if both are given."""
    lab, _ = shared.machines()
    with reading(shared) as reader:
        last = reader.next("start").id
        happen(lab)
        assert reader.next().id != last
    happen(lab, 4)
    missed = log(lab)[-5:]
    headers = {"last-event-id": last} if by_header else {}
    with reading(shared, query.replace("LAST", last), **headers) as reader:
        assert reader.next("start").id == last
        assert [reader.next().data for _ in missed] == missed
        happen(lab)
        assert reader.next().data == log(lab)[-1]


def test_the_whole_log_can_be_read_also_of_a_machine_not_in_the_cursor(shared: Runtime) -> None:
    lab, heavy = shared.machines()
    happen(lab, 230)  # more than two pages
    happen(heavy, 3)
    expected = {LAB: log(lab), HEAVY: log(heavy)}
    with reading(shared, "?from=beginning") as reader:
        found: dict[str, list[str]] = {LAB: [], HEAVY: []}
        for _ in range(sum(map(len, expected.values()))):
            event = reader.next()
            data = AlarmCloudEvent.model_validate_json(event.data).data
            found[f"{data.site}/{data.machine}"].append(event.data)
        assert found == expected
    with reading(shared, f"?from=beginning&machine={HEAVY}") as reader:
        assert [reader.next().data for _ in expected[HEAVY]] == expected[HEAVY]
    with reading(shared, **{"last-event-id": f"{LAB}={lab.history.last_sequence},old/pump=7"}) as reader:
        assert [reader.next().data for _ in range(2)] == log(heavy)[:2]


def test_a_reader_who_reconnects_repeatedly_gets_the_exact_log(shared: Runtime) -> None:
    """Cut off 25 times while events go on: none is missing, repeated or out of order."""
    lab, _ = shared.machines()
    rng = np.random.default_rng(11)
    done = threading.Event()

    def go_on() -> None:
        for _ in range(150):
            happen(lab)
        done.set()

    first = lab.history.last_sequence
    writer = threading.Thread(target=go_on)
    writer.start()
    found: list[str] = []
    last = f"{LAB}={first}"
    for _ in range(25):
        with reading(shared, f"?machine={LAB}", **{"last-event-id": last}) as reader:
            for _ in range(rng.integers(8)):
                event = reader.next()
                found.append(event.data)
                last = event.id
    writer.join()
    assert done.is_set()
    with reading(shared, f"?machine={LAB}", **{"last-event-id": last}) as reader:
        while len(found) < 150:
            found.append(reader.next().data)
    assert found == log(lab)[first + 1 :]


def test_a_stream_begins_with_the_current_health(tmp_path: Path) -> None:
    with fed(tmp_path) as (runtime, feed):
        (worker,) = runtime.machines()
        with reading(runtime) as reader:
            assert Health.model_validate_json(reader.next("health").data).quality.accepted_blocks == 0
            feed.put_good(3)  # too little for a report: nothing new is published
            until(lambda: worker.health().quality.accepted_blocks == 3, "blocks")
        with reading(runtime) as reader:
            assert Health.model_validate_json(reader.next("health").data).quality.accepted_blocks == 3


def test_health_is_sent_at_once_and_on_changes(shared: Runtime) -> None:
    lab, _ = shared.machines()
    with reading(shared, f"?machine={LAB}") as reader:

        def told_until(shelved: bool, told: httpx_sse.ServerSentEvent) -> None:
            while is_shelved(Health.model_validate_json(told.data)) != shelved:
                told = reader.next("health")

        begun = reader.next("health")
        assert Health.model_validate_json(begun.data).machine == "lab"
        # A health event does not change the id to resume from.
        assert begun.id == f"{LAB}={lab.history.last_sequence}"
        shelved = lab.history.last_sequence % 2 == 1
        told_until(not shelved, begun)  # the last change may not have been sent yet
        happen(lab)
        told_until(shelved, reader.next("health"))


def test_health_that_changed_and_changed_back_is_sent(shared: Runtime) -> None:
    """A reader who connects in between has received a state that is no longer true."""
    lab, _ = shared.machines()
    with reading(shared, f"?machine={LAB}") as reader:
        before = is_shelved(Health.model_validate_json(reader.next("health").data))
    time.sleep(0.6)  # until that is the health published last
    happen(lab)
    with reading(shared, f"?machine={LAB}") as reader:
        begun = is_shelved(Health.model_validate_json(reader.next("health").data))
        happen(lab)
        while begun != before:
            begun = is_shelved(Health.model_validate_json(reader.next("health").data))


def test_full_health_of_some_machines_and_overviews_of_others(shared: Runtime) -> None:
    """Each is serialised once, however many readers there are."""
    with reading(shared, f"?detail=overview&in_full={HEAVY}") as reader:
        told = {
            (event.event, Health.model_validate_json(event.data).machine)
            for event in itertools.islice(reader.events, 1, 3)
        }
        assert told == {("overview", "lab"), ("health", "heavy")}
    made: list[str] = []

    class Counted(Health):
        def model_dump_json(self, **options: Any) -> str:
            made.append(super().model_dump_json(**options))
            return made[-1]

    begun = Counted.model_validate(example(Health))
    later = begun.model_copy(update={"sequence": 7})
    feed = EventFeed()
    feed.health(begun)

    async def admitted() -> bool:
        return True

    async def listen() -> list[str]:
        logs = {LAB: shared.machines()[0].history}
        cursor = {LAB: logs[LAB].last_sequence}
        streams = [feed.follow(logs, cursor, admitted, lambda _: begun, whole) for whole in 5 * [None, set[str]()]]
        for stream in streams:
            assert [(await anext(stream))[:6] for _ in range(2)] == ["retry:", "event:"]
        made.clear()
        feed.health(later)
        return [await anext(stream) for stream in streams]

    heard = asyncio.run(listen())
    assert sorted(made) == sorted(one.split("data: ")[1].strip() for one in set(heard))
    assert heard == 5 * [f"event: health\ndata: {later.model_dump_json()}\n\n", heard[1]]


@pytest.mark.parametrize(
    ("query", "header", "status", "text"),
    [
        ("?detail=all", "", 422, "detail: expected one of whole, overview (found 'all')"),
        ("?machine=demo/pump", "", 404, "no machine demo/pump; there are: demo/lab, demo/heavy"),
        ("?last_event_id=17", "", 422, "Last-Event-ID: cursor: '17' is not site/machine=sequence"),
        ("?last_event_id=17", "demo/lab=0", 422, "Last-Event-ID: cursor: '17' is not site/machine=sequence"),
        ("", "demo/lab=1,demo/lab=2", 422, "Last-Event-ID: cursor: 'demo/lab=2' is not"),
        ("", "demo/lab=one", 422, "Last-Event-ID: cursor: 'demo/lab=one' is not"),
        ("", "demo/lab=1000000", 409, "Last-Event-ID: demo/lab=1000000, but the log of demo/lab ends at"),
        ("?from=tomorrow", "", 422, "from: expected one of now, beginning (found 'tomorrow')"),
    ],
)
def test_invalid_stream_arguments_are_refused(shared: Runtime, query: str, header: str, status: int, text: str) -> None:
    with client(shared) as http:
        answer = http.get(EVENTS + query, headers={"last-event-id": header} if header else {})
        assert problem(answer, status).detail.startswith(text)


def test_cursors_are_parsed_as_written_and_invalid_ones_refused() -> None:
    cursor = {"demo/lab": 17, "site-2/pump_7": -1}
    assert parsed_cursor(cursor_text(cursor)) == cursor
    for text in ("", ",", "demo/lab", "demo/lab=", "demo/lab=-2", "demo/lab=1,", "demo/lab=" + 19 * "9", "a/b/c=1"):
        with pytest.raises(CursorError):
            parsed_cursor(text)


def test_a_stalled_reader_does_not_hold_up_others(shared: Runtime) -> None:
    """It is left with a full pipe, while another reader gets everything."""
    lab, _ = shared.machines()
    first = lab.history.last_sequence
    with (
        client(shared) as http,
        http.stream("GET", f"{EVENTS}?machine={LAB}&from=beginning") as stuck,
        reading(shared, f"?machine={LAB}") as reader,
    ):
        reader.next("start")
        happen(lab, 200)
        assert len(reader.alarms(200)) == 200
        # Events that were not sent for lack of room arrive when the stuck one reads on.
        events = httpx_sse.EventSource(stuck).iter_sse()
        alarms = (event for event in events if event.event == "alarm")
        assert [event.data for event in itertools.islice(alarms, first + 201)] == log(lab)


def test_streams_are_limited_per_caller_and_in_total_and_freed_on_close() -> None:
    limits = LimitSettings(requests_per_minute=1_000_000, streams_per_caller=2, streams=3)
    with monitor(AccessSettings(limits=limits)) as runtime:
        one, other = (token(runtime, Scope.READ, name=name) for name in ("one", "other"))
        with client(runtime, one) as http, client(runtime, other) as late:

            def refused(by: httpx.Client, query: str = "") -> str:
                with by.stream("GET", EVENTS + query) as answer:
                    assert answer.status_code == 429  # or it would have no end
                    assert int(answer.headers["retry-after"]) > 0
                    answer.read()
                return problem(answer, 429).detail

            with reading(runtime, text=one), reading(runtime, text=one):
                assert "2 of your event streams are open" in refused(http)
                assert "2 of your event streams are open" in refused(http, "?machine=demo/pump")
                with reading(runtime, text=other):
                    assert "the most this service allows" in refused(late)

            def admitted() -> bool:
                with httpx_sse.connect_sse(http, "GET", EVENTS) as source:
                    return source.response.status_code == 200

            until(admitted, "seat")


def test_streams_end_when_the_service_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    """Events committed before are sent, however slow the history is."""
    with monitor() as runtime:
        lab, _ = runtime.machines()
        read = lab.history.events

        def late(**query: Any) -> Any:
            until(lambda: runtime.feed.closed, "end of the service")
            return read(**query)

        left: list[httpx_sse.ServerSentEvent] = []
        with reading(runtime) as reader, client(runtime) as http, http.stream("GET", EVENTS) as stuck:
            reader.next("start")
            assert stuck.status_code == 200
            monkeypatch.setattr(lab.history, "events", late)
            happen(lab, 250)  # more than two pages
            expected = [one.text for one in read(after=-1, limit=1000)]
            stopping = threading.Thread(target=runtime.stop)
            stopping.start()
            # A regular end: on a broken connection the reader would raise.
            left += reader.events
            stopping.join(180)
            assert not stopping.is_alive()
        assert [event.data for event in left if event.event == "alarm"] == expected


def test_a_stream_ends_when_its_token_is_revoked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_feed, "_KEEP_ALIVE_S", 0.05)
    access = AccessSettings(limits=LimitSettings(requests_per_minute=1_000_000))
    with monitor(access) as runtime:
        text = token(runtime, Scope.READ)
        with reading(runtime, text=text) as reader:
            reader.next("start")
            happen(runtime.machines()[0])
            reader.next()
            assert runtime.store.tokens.revoke(text.split("_")[1], time.time_ns())
            assert all(event.event == "health" for event in reader.events)
        with client(runtime, text) as http:
            problem(http.get(EVENTS), 401)


def test_idle_streams_get_keep_alive_comments(shared: Runtime, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_feed, "_KEEP_ALIVE_S", 0.05)
    with client(shared) as http, http.stream("GET", EVENTS) as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        assert answer.headers["cache-control"] == "no-store"
        comments = (line for line in answer.iter_lines() if "still there" in line)
        assert [next(comments) for _ in range(3)] == [": still there"] * 3


def test_a_stream_waits_while_the_history_cannot_be_read(shared: Runtime, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_feed, "_AGAIN_S", 0.05)
    lab, _ = shared.machines()
    asked = threading.Event()
    read = lab.history.events

    def fail(**_: object) -> Any:
        asked.set()
        raise StoreError("the disk is gone")

    with reading(shared, f"?machine={LAB}") as reader, client(shared) as http:
        reader.next("start")
        monkeypatch.setattr(lab.history, "events", fail)
        happen(lab, 2)
        assert asked.wait(180)
        found = problem(http.get(f"/api/v1/machines/{LAB}/alarms/events"), 503)
        assert found.detail == "the history cannot be used: the disk is gone"
        monkeypatch.setattr(lab.history, "events", read)
        assert [one.data.sequence for one in reader.alarms(2)] == [
            lab.history.last_sequence - 1,
            lab.history.last_sequence,
        ]
