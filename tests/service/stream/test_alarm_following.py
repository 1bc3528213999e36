"""Following an alarm log: any order of arrival gives the log; other logs are refused; read-only access."""

import json
import threading
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import hypothesis.strategies as st
import pytest
from hypothesis import given

from models.signals.keys import MachineKeys
from models.signals.link import LinkSettings
from rotorwatch.client.alarm_log import follow_alarms
from rotorwatch.client.errors import ClientError, LogReplaced
from rotorwatch.client.log_order import LogOrder
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmLogPage, AlarmStates
from rotorwatch.records.example import example
from service.history.records import Step, StoreError
from service.history.shared import committed_events
from service.history.store import Store
from service.stream.transport import Link, MachineCallbacks, MachineLink, route
from tests.service.access.plant import plant
from tests.service.history.test_store import alarm_event
from tests.service.rig.live import endpoint, ignore, until

PLACE = "demo/lab"


SHOWN = AlarmCloudEvent.model_validate(example(AlarmCloudEvent))


def event(sequence: int, text: str = "", place: str = PLACE) -> AlarmCloudEvent:
    site, _, machine = place.partition("/")
    data = SHOWN.data.model_copy(update={"sequence": sequence, "text": text, "site": site, "machine": machine})
    return SHOWN.model_copy(update={"data": data, "sequence": f"{sequence:020d}", "id": f"{place}/{sequence}"})


def page(events: list[AlarmCloudEvent], latest: int, place: str = PLACE) -> AlarmLogPage:
    site, _, machine = place.partition("/")
    return AlarmLogPage(site=site, machine=machine, events=tuple(events), latest=latest)


LOG = [event(number) for number in range(30)]


def take_all(order: LogOrder) -> list[AlarmCloudEvent]:
    taken = []
    while (found := order.next()) is not None:
        taken.append(found)
        order.taken()
    return taken


@given(
    st.integers(-1, 29),
    st.lists(
        st.one_of(
            st.tuples(st.just("hear"), st.integers(0, 29)),
            st.tuples(st.just("announce"), st.integers(-1, 29)),
            st.tuples(st.just("ask"), st.integers(1, 10)),
        ),
        max_size=60,
    ),
)
def test_any_order_of_arrival_gives_the_log_from_an_event_on(after: int, happenings: list[tuple[str, int]]) -> None:
    order = LogOrder(PLACE, after)
    taken: list[AlarmCloudEvent] = []

    def ask(limit: int) -> None:
        begin = order.ask_after + 1
        order.read(page(LOG[begin : begin + limit], len(LOG) - 1))

    for what, number in happenings:
        if what == "hear":
            order.hear(LOG[number])
        elif what == "announce":
            order.announce(number)
        else:
            ask(number)
        taken += take_all(order)
    ask(1)
    taken += take_all(order)
    while order.incomplete:
        ask(2)
        taken += take_all(order)
    assert taken == LOG[after + 1 :]


def test_the_log_overrides_received_events_and_a_replaced_log_is_noticed() -> None:
    with pytest.raises(LogReplaced) as caught:
        LogOrder(PLACE, 17).read(page([], 12))
    assert "demo/lab: event 17 was taken from the alarm log, which now ends at 12" in str(caught.value)
    order = LogOrder(PLACE, -1)
    order.read(page([event(0), event(1, "one")], 1))
    take_all(order)
    assert order.ask_after == 0
    order.read(page([event(1, "one")], 1))
    with pytest.raises(LogReplaced) as caught:
        order.read(page([event(1, "another"), event(2)], 2))
    assert "event 1 of the alarm log is not the one that was taken" in str(caught.value)
    order = LogOrder(PLACE, 3)
    order.hear(event(5, "heard, and lost in a crash"))
    order.read(page([event(4), event(5, "of the log")], 5))
    assert [one.data.text for one in take_all(order)] == ["", "of the log"]


def test_events_far_ahead_are_left_to_the_log() -> None:
    order = LogOrder(PLACE, -1)
    for number in range(10_000, 10_100):
        order.hear(event(number))
    assert order.incomplete
    assert not order._waiting  # memory is bounded


class Monitor:
    """A machine's link with a log of its own; publishing or reading it can be made to fail."""

    def __init__(self, link: Link, place: str = PLACE, log: Iterable[AlarmCloudEvent] = ()) -> None:
        self.place = place
        self.log = [*log]
        self.asked: list[tuple[int, int]] = []
        self.broken = ""

        callbacks = MachineCallbacks(ignore, ignore, ignore, ignore, lambda: "{}", self.state, self._answer)
        self.link = MachineLink(link, MachineKeys(*place.split("/")), callbacks, wait_when_full=False)

    def happen(self, *, published: bool = True, text: str = "") -> None:
        self.log.append(event(len(self.log), text, self.place))
        if published:
            self.link.publish("alarm_event", self.log[-1].model_dump_json())

    def state(self) -> str:
        shown = AlarmStates.model_validate(example(AlarmStates))
        return shown.model_copy(update={"sequence": len(self.log) - 1}).model_dump_json()

    def _answer(self, after: int, limit: int) -> str:
        self.asked.append((after, limit))
        if self.broken == "history":
            raise StoreError("history: the disk is full")
        if self.broken:
            return self.broken
        return page(self.log[after + 1 : after + 1 + limit], len(self.log) - 1, self.place).model_dump_json()


@contextmanager
def monitor(address: str, *places: str, log: Iterable[AlarmCloudEvent] = ()) -> Iterator[list[Monitor]]:
    link = Link(LinkSettings(listen=(address,)))
    found = [Monitor(link, place, log) for place in places or (PLACE,)]
    try:
        yield found
    finally:
        for one in found:
            one.link.close()
        link.close()


class Following:
    def __init__(
        self,
        where: str | LinkSettings,
        machines: str = PLACE,
        after: int = -1,
        every_s: float = 30.0,
        fail_at: int | None = None,
    ) -> None:
        self.taken: list[AlarmCloudEvent] = []
        self.error: Exception | None = None
        self._stop = threading.Event()

        def take(one: AlarmCloudEvent) -> None:
            if one.data.sequence == fail_at:
                raise OSError("no space left")
            self.taken.append(one)

        def run() -> None:
            link = Link(where if isinstance(where, LinkSettings) else LinkSettings(connect=(where,)))
            try:
                follow_alarms(link.session, [machines], {PLACE: after}, take, stop=self._stop, ask_every_s=every_s)
            except (ClientError, OSError) as error:
                self.error = error
            finally:
                link.close()

        self._thread = threading.Thread(target=run)
        self._thread.start()

    def __enter__(self) -> "Following":
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(180.0)
        assert not self._thread.is_alive()

    def sequences(self) -> list[int]:
        return [one.data.sequence for one in self.taken]

    def reaches(self, sequence: int) -> None:
        until(lambda: self.error is not None or sequence in self.sequences(), f"event {sequence}")
        assert self.error is None


def test_a_follower_queries_past_events_and_receives_new_ones() -> None:
    address = endpoint()
    with monitor(address) as (machine,):
        for _ in range(1234):
            machine.happen(published=False)
        with Following(address, after=17) as following:
            following.reaches(1233)
            for _ in range(5):
                machine.happen()
            following.reaches(1238)
    assert (following.sequences(), following.taken) == (list(range(18, 1239)), machine.log[18:])


def test_missed_events_are_queried_on_a_later_event_or_alarm_state(caplog: pytest.LogCaptureFixture) -> None:
    address = endpoint()
    with monitor(address) as (machine,), Following(address) as following:
        machine.happen()
        following.reaches(0)
        machine.happen(published=False)
        machine.happen(published=False)
        machine.happen()
        following.reaches(3)  # long before the next regular query
        machine.happen(published=False)
        machine.link.publish("alarm_state", machine.state())
        following.reaches(4)
        machine.link.publish("alarm_event", '{"specversion": "1.0"}')  # an invalid event is replaced by a query
        machine.happen(published=False)
        machine.happen()
        following.reaches(6)
    assert following.sequences() == list(range(7))
    assert "do not match this version" in caplog.text


def test_a_follower_waits_for_a_monitor_and_for_its_restart() -> None:
    address = endpoint()
    with Following(address) as following:
        with monitor(address) as (first,):
            first.happen()
            following.reaches(0)
        with monitor(address, log=first.log) as (second,):  # complete before the follower can ask for it
            second.happen(published=False)
            second.happen()
            following.reaches(2)
    assert following.sequences() == [0, 1, 2]


def test_a_follower_finds_machines_by_a_pattern() -> None:
    address = endpoint()
    with monitor(address, PLACE, "demo/pump", "other/fan") as (lab, pump, fan):
        for machine, count in ((lab, 3), (pump, 2), (fan, 4)):
            for _ in range(count):
                machine.happen(published=False)
        with Following(address, machines="demo/*", after=0) as following:
            until(lambda: len(following.taken) == 4, "events of two machines")
            pump.happen()
            fan.happen()
            until(lambda: len(following.taken) == 5, "a later event")
    assert [one for one in following.taken if one.data.machine == "lab"] == lab.log[1:]
    assert [one for one in following.taken if one.data.machine == "pump"] == pump.log


def test_an_unreadable_log_is_queried_again_and_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    address = endpoint()
    with monitor(address) as (machine,):
        machine.happen(published=False)
        machine.broken = "history"
        with Following(address, every_s=0.1) as following:
            until(lambda: len(machine.asked) > 2, "questions")
            machine.broken = ""
            following.reaches(0)
            machine.happen(published=False)  # not announced: found by the regular query
            following.reaches(1)
    assert "demo/lab: the alarm log cannot be read at present: rotorwatch/demo/lab/alarm/event: history" in caplog.text
    assert caplog.text.count("cannot be read at present") == 1


def test_a_replaced_log_or_another_version_ends_the_following() -> None:
    address = endpoint()
    with monitor(address) as (machine,):
        machine.happen()
        with Following(address, after=5) as following:
            until(lambda: following.error is not None, "an error")
        assert isinstance(following.error, LogReplaced)
        machine.broken = json.dumps({"events": []})
        with Following(address) as following:
            until(lambda: following.error is not None, "an error")
        assert "do versions differ?" in str(following.error)
        assert not following.taken


def test_an_event_whose_handler_fails_is_not_taken() -> None:
    address = endpoint()
    with monitor(address) as (machine,):
        for _ in range(4):
            machine.happen(published=False)
        with Following(address, fail_at=2) as following:
            until(lambda: following.error is not None, "an error")
        assert isinstance(following.error, OSError)
        assert following.sequences() == [0, 1]


def test_a_viewer_can_follow_only_granted_machines(tmp_path: Path) -> None:
    """Through a router that lets a viewer read this machine and nothing else."""
    with plant(tmp_path) as router:
        link, viewer = Link(router.link("monitor")), router.link("one")
        lab, pump = Monitor(link), Monitor(link, "demo/pump")
        for machine in (lab, pump):
            machine.happen(published=False)
        with Following(viewer) as following, Following(viewer, machines="demo/pump") as refused:
            following.reaches(0)
            for machine in (lab, pump):
                machine.happen(published=False)
                machine.happen()
            following.reaches(2)
        for machine in (lab, pump):
            machine.link.close()
        link.close()
    assert following.sequences() == [0, 1, 2]
    assert refused.taken == []


@pytest.mark.slow
def test_a_follower_reconnects_and_misses_no_event() -> None:
    """The router between monitor and follower is restarted; events missed meanwhile are queried."""
    address = endpoint()
    through = LinkSettings(mode="client", connect=(address,))
    with ExitStack() as stack:
        with route(LinkSettings(listen=(address,))):
            link = Link(through)
            stack.callback(link.close)
            machine = Monitor(link)
            stack.callback(machine.link.close)
            following = stack.enter_context(Following(through, every_s=0.5))
            machine.happen()
            following.reaches(0)
        machine.happen()
        machine.happen()
        with route(LinkSettings(listen=(address,))):
            following.reaches(2)
            machine.happen()
            following.reaches(3)
            stack.close()
    assert following.taken == machine.log


def test_read_only_access_sees_committed_events_and_creates_no_file(store: Store, url: str, tmp_path: Path) -> None:
    lab, pump = store.machine("demo", "lab"), store.machine("demo", "pump")
    events = tuple(alarm_event(number) for number in range(4))
    lab.commit(Step(events=events))
    pump.commit(Step(events=events[:1]))
    for read in (store.alarms_since, partial(committed_events, url)):
        assert (read("demo", "lab", events[1].recorded_ns), read("demo", "pump", 0)) == (events[1:], events[:1])
        assert read("demo", "fan", 0) == ()
    file = tmp_path / "none.sqlite"
    with pytest.raises(StoreError, match="unable to open"):
        committed_events(f"sqlite:///{file}", "demo", "lab", 0)
    assert not file.exists()
