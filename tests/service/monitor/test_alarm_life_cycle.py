"""The life cycle of alarms: the table, the documentation that shows it, and random walks through it."""

import re
from collections.abc import Iterable
from itertools import product
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.alarm_names import ALARMS
from models.machine import AlarmSettings
from rotorwatch.records.alarms import AlarmState, EventKind
from service.monitor.alarms.alarm import (
    KIND_OF_EVENT,
    OWED,
    REFUSED,
    STAYS,
    TABLE,
    Alarm,
    AlarmEvent,
    Cell,
    OperationRefused,
    OperatorAction,
    follow,
)
from service.monitor.alarms.book import AlarmBook

ROOT = Path(__file__).parents[3]
S = 10**9
HOUR_S = 3600.0
SETTINGS = AlarmSettings.model_validate({
    "on_delay_s": 10, "off_delay_s": 15, "latching": ["c_by"], "longest_shelf_s": 2 * HOUR_S,
    "suppress": [
        {"alarms": ["model", "k_by"], "while_alarm": "data-stuck", "because": "a sensor is stuck"},
        {"alarms": ["model"], "below_rpm": 600, "because": "the machine is coasting down"},
    ],
})  # fmt: skip


def written(cell: Cell) -> str:
    return " / ".join(cell) if isinstance(cell, tuple) else str(cell)


def test_the_documentation_lists_every_alarm() -> None:
    text = (ROOT / "docs/alarms.md").read_text(encoding="utf-8").partition("## Kinds")[2].partition("##")[0]
    first = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    assert {name for cell in first for name in re.findall("`(.*?)`", cell)} == set(ALARMS)


def test_the_table_in_the_documentation_is_up_to_date() -> None:
    text = (ROOT / "docs/alarms.md").read_text(encoding="utf-8")
    rows = [re.split(r"\s*\|\s*", line.strip("| \n")) for line in text.splitlines() if line.startswith("|")]
    head = next(row for row in rows if row[0] == "what happens")
    shown = {
        (AlarmState(state), EventKind(row[0].strip("`"))): cell.replace("`", "")
        for row in rows
        if row[0].strip("`") in set(EventKind)
        for state, cell in zip((name.strip("`") for name in head[1:]), row[1:], strict=True)
    }
    assert shown == {key: written(cell) for key, cell in TABLE.items()}


@pytest.mark.parametrize("kind", EventKind)
def test_every_cell_of_the_table_leads_to_its_state(kind: EventKind) -> None:
    for state, present, latching in product(AlarmState, (False, True), (False, True)):
        cell, owed = TABLE[state, kind], AlarmState.LATCHED_ACKNOWLEDGED
        found = follow(state, kind, present=present, latching=latching, owed=owed)
        if isinstance(cell, tuple):
            wanted = cell[latching if kind is EventKind.CLEARED else present]
            assert found == (owed if wanted == OWED else wanted), state
        else:
            assert found == {REFUSED: None, STAYS: state}.get(cell, cell), state


def test_only_operations_can_be_refused() -> None:
    """Only operations can be refused: a condition comes and goes in every state."""
    asked = set(KIND_OF_EVENT.values())
    assert {kind for (_, kind), cell in TABLE.items() if cell == REFUSED} <= asked
    assert set(EventKind) - asked == {
        EventKind.RAISED, EventKind.CLEARED, EventKind.ESCALATED, EventKind.SUPPRESSED, EventKind.UNSUPPRESSED
    }  # fmt: skip


def raised(name: str = "k_by", change: float = -0.2, at_s: int = 0) -> tuple[AlarmBook, int]:
    book = AlarmBook(SETTINGS)
    for time_s in range(at_s, at_s + 15, 5):
        book.update(name, change, 0.01, time_s * S, named=True)
    return book, at_s + 10


def cleared(book: AlarmBook, name: str, at_s: int) -> list[AlarmEvent]:
    return [
        event for time_s in range(at_s, at_s + 20, 5) for event in book.update(name, 0.0, 0.01, time_s * S, named=False)
    ]


def state_of(book: AlarmBook, name: str = "k_by") -> AlarmState:
    return next(alarm.state for alarm in book.alarms if alarm.name == name)


def act(kind: str, name: str = "k_by", **more: object) -> OperatorAction:
    return OperatorAction(kind, name, "anna", **{"reason": "told so", **more})  # type: ignore[arg-type]


def test_acknowledging_and_clearing_end_an_alarm_and_danger_reopens_it() -> None:
    book, now_s = raised()
    (event,) = book.operate(act("acknowledge"), now_s * S)
    assert (event.kind, event.actor, event.before, event.alarm.state) == (
        EventKind.ACKNOWLEDGED, "anna", AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED
    )  # fmt: skip
    cleared(book, "k_by", now_s + 5)
    assert state_of(book) is AlarmState.NORMAL
    book, now_s = raised()
    cleared(book, "k_by", now_s + 5)
    assert state_of(book) is AlarmState.RETURNED
    book.operate(act("acknowledge"), (now_s + 30) * S)
    assert state_of(book) is AlarmState.NORMAL
    book, now_s = raised()
    book.operate(act("acknowledge"), now_s * S)
    (event,) = book.update("k_by", -0.7, 0.01, (now_s + 5) * S, named=True)
    assert (event.kind, event.alarm.state, event.alarm.occurrence) == ("escalated", AlarmState.UNACKNOWLEDGED, 1)


def test_shelving_expires_and_a_present_alarm_is_unacknowledged_then() -> None:
    book, now_s = raised()
    book.operate(act("shelve", duration_s=600), now_s * S)
    assert not any(alarm.raised for alarm in book.alarms)
    assert book.severity is None
    assert book.passed((now_s + 599) * S) == ()
    (event,) = book.passed((now_s + 1000) * S)
    assert (event.kind, event.time_ns, event.reason) == ("unshelved", (now_s + 600) * S, "the shelf time has expired")
    assert state_of(book) is AlarmState.UNACKNOWLEDGED


def test_one_shot_shelving_ends_when_the_alarm_clears_other_shelving_goes_on() -> None:
    book, now_s = raised()
    book.operate(act("shelve", duration_s=HOUR_S), now_s * S)
    assert [event.kind for event in cleared(book, "k_by", now_s + 5)] == ["cleared"]
    told = [e for t in range(0, 15, 5) for e in book.update("k_by", 0.3, 0.01, (now_s + 100 + t) * S, named=True)]
    assert [(event.kind, event.alarm.occurrence, event.alarm.state) for event in told] == [
        ("raised", 2, AlarmState.SHELVED)
    ]
    assert "(shelved)" in told[0].text
    book, now_s = raised()
    book.operate(act("shelve", one_shot=True), now_s * S)
    events = cleared(book, "k_by", now_s + 5)
    assert [event.kind for event in events] == ["cleared", "unshelved"]
    assert not events[0].alarm.state.annunciated
    assert state_of(book) is AlarmState.NORMAL


def test_shelving_needs_a_reason_and_has_a_maximum_time() -> None:
    book, now_s = raised()
    with pytest.raises(OperationRefused, match="reason is empty"):
        book.operate(act("shelve", reason=" "), now_s * S)
    with pytest.raises(OperationRefused, match=r"duration_s is 7201, expected more than 0 and at most 7200"):
        book.operate(act("shelve", duration_s=7201), now_s * S)
    with pytest.raises(OperationRefused, match="remove-from-service of k_by: reason is empty"):
        book.operate(act("remove-from-service", reason=""), now_s * S)
    assert state_of(book) is AlarmState.UNACKNOWLEDGED


def test_rules_suppress_and_unsuppress_alarms() -> None:
    book, now_s = raised()
    book.update_state("data-stuck", True, now_s * S, "y1 stands still", at_once=True)
    told = book.suppress(1320.0, now_s * S)
    assert [(event.kind, event.alarm.name, event.reason) for event in told] == [
        ("suppressed", "model", "a sensor is stuck"),
        ("suppressed", "k_by", "a sensor is stuck"),
    ]
    assert book.suppress(500.0, now_s * S) == ()  # a second reason for the model, no new event
    book.update_state("data-stuck", False, (now_s + 5) * S, at_once=True)
    told = book.suppress(None, (now_s + 5) * S)  # an unknown speed changes no rule that depends on it
    assert [(event.kind, event.alarm.name) for event in told] == [("unsuppressed", "k_by")]
    assert (state_of(book), state_of(book, "model")) == (AlarmState.UNACKNOWLEDGED, AlarmState.SUPPRESSED)
    book.suppress(-1320.0, (now_s + 10) * S)  # turning the other way
    assert state_of(book, "model") is AlarmState.NORMAL
    assert [event.alarm.name for event in book.suppress(-500.0, (now_s + 15) * S)] == ["model"]


@pytest.mark.parametrize(
    ("name", "acknowledged", "owed"),
    [
        ("k_by", False, AlarmState.RETURNED),
        ("k_by", True, AlarmState.NORMAL),
        ("c_by", False, AlarmState.LATCHED_UNACKNOWLEDGED),
        ("c_by", True, AlarmState.LATCHED_ACKNOWLEDGED),
    ],
)
@pytest.mark.parametrize("cleared_before", [False, True])
def test_rules_keep_acknowledgements(name: str, acknowledged: bool, owed: AlarmState, cleared_before: bool) -> None:
    book, now_s = raised(name)
    if acknowledged:
        book.operate(act("acknowledge", name), now_s * S)
    if cleared_before:
        cleared(book, name, now_s + 5)
        assert state_of(book, name) is owed
    rules = {"suppress": [{"alarms": [name], "while_alarm": "data-stuck", "because": "stuck"}], "latching": ["c_by"]}
    page, book = book.checkpoint(), AlarmBook(AlarmSettings.model_validate({**rules, "off_delay_s": 15}))
    book.restore(page)
    book.update_state("data-stuck", True, (now_s + 40) * S, at_once=True)
    book.suppress(None, (now_s + 40) * S)
    assert state_of(book, name) is AlarmState.SUPPRESSED
    cleared(book, name, now_s + 45)
    book.update_state("data-stuck", False, (now_s + 70) * S, at_once=True)
    assert [event.kind for event in book.suppress(None, (now_s + 70) * S)] == ["unsuppressed"]
    assert state_of(book, name) is owed


def test_an_unshelved_alarm_that_a_rule_suppresses_becomes_suppressed() -> None:
    book, now_s = raised()
    book.operate(act("shelve"), now_s * S)
    book.update_state("data-stuck", True, now_s * S, at_once=True)
    assert [event.alarm.name for event in book.suppress(None, now_s * S)] == ["model"]
    told = book.operate(act("unshelve"), (now_s + 1) * S)
    assert [event.kind for event in told] == ["unshelved", "suppressed"]
    assert state_of(book) is AlarmState.SUPPRESSED


def test_a_stepped_clock_does_not_change_the_length_of_shelving() -> None:
    book, now_s = raised()
    book.operate(act("shelve", duration_s=600), now_s * S)
    book.clock_stepped((now_s + 10**6) * S, 10**6 * S)
    assert (book.passed((now_s + 10**6) * S), len(book.passed((now_s + 10**6 + 600) * S))) == ((), 1)


@pytest.mark.parametrize(
    ("field", "value", "match"),
    [
        ("latching", ["k_bx"], "latching: k_bx is not an alarm"),
        ("suppress", [{"alarms": ["e"], "because": "x"}], "expected exactly one of while_alarm"),
        ("suppress", [{"alarms": ["e"], "while_alarm": "e", "because": "x"}], "e would suppress itself"),
        ("suppress", [{"alarms": ["e"], "while_alarm": "y", "because": "x"}], "while_alarm: y is not an alarm"),
    ],
)
def test_invalid_alarm_settings_are_refused(field: str, value: object, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        AlarmSettings.model_validate({field: value})


NAMES = ("k_by", "c_by", "model", "data-stuck")
steps = st.one_of(
    st.tuples(st.just("read"), st.sampled_from(NAMES[:2]), st.sampled_from([0.0, 0.08, -0.2, 0.7])),
    st.tuples(st.just("say"), st.sampled_from(NAMES[2:]), st.booleans()),
    st.tuples(st.just("speed"), st.sampled_from([None, 300.0, 1320.0]), st.none()),
    st.tuples(st.just("wait"), st.sampled_from([1, 20, 4000]), st.none()),
    st.tuples(st.just("do"), st.sampled_from(NAMES), st.sampled_from(sorted(KIND_OF_EVENT))),
    st.tuples(st.just("shelve once"), st.sampled_from(NAMES), st.none()),
    st.tuples(st.just("restart"), st.none(), st.none()),
    st.tuples(st.just("clock"), st.sampled_from([-(10**5), 10**5]), st.none()),
)


def walk(stories: Iterable[tuple[str, object, object]], *, restarts: bool = True) -> tuple[AlarmBook, list[AlarmEvent]]:
    book, now_s, events = AlarmBook(SETTINGS), 10**6, list[AlarmEvent]()
    for what, which, how in stories:
        now_s += 5
        time_ns = now_s * S
        told: tuple[AlarmEvent, ...] = ()
        match what:
            case "read":
                told = book.update(str(which), float(how), 0.01, time_ns, named=True)  # type: ignore[arg-type]
            case "say":
                told = book.update_state(str(which), bool(how), time_ns)
            case "speed":
                told = book.suppress(which, time_ns)  # type: ignore[arg-type]
            case "wait":
                now_s += int(which)  # type: ignore[call-overload]
                told = book.passed(now_s * S)
            case "clock":
                now_s += int(which)  # type: ignore[call-overload]
                book.clock_stepped(now_s * S, int(which) * S)  # type: ignore[call-overload]
            case "restart":
                if restarts:
                    page, book = book.checkpoint(), AlarmBook(SETTINGS)
                    book.restore(page)
            case _:
                kind = "shelve" if what == "shelve once" else str(how)
                try:
                    told = book.operate(act(kind, str(which), one_shot=what == "shelve once"), time_ns)
                except OperationRefused:
                    told = ()
        events += told
    return book, events


@settings(max_examples=250)
@given(stories=st.lists(steps, max_size=60))
def test_invariants_hold_on_random_walks_and_restarts_change_nothing(stories: list[tuple[str, object, object]]) -> None:
    book, events = walk(stories)
    other, same = walk(stories, restarts=False)
    assert events == same
    assert sorted(map(repr, book.alarms)) == sorted(map(repr, other.alarms))
    assert [event.sequence for event in events] == list(range(len(events)))
    latest: dict[str, Alarm] = {}
    for event in events:
        before = latest.get(event.alarm.name)
        assert event.before is (AlarmState.NORMAL if before is None else before.state)
        assert event.alarm.version == event.sequence
        assert event.alarm.occurrence - (before.occurrence if before else 0) == (event.kind is EventKind.RAISED)
        latest[event.alarm.name] = event.alarm
    due: set[str] = set()
    for event in events:
        name, state = event.alarm.name, event.alarm.state
        if event.actor:
            due.discard(name)  # an operator has acted on it
        if state is AlarmState.UNACKNOWLEDGED:
            due.add(name)
        assert state is not AlarmState.NORMAL or name not in due, "nobody has acknowledged it"
    for alarm in book.alarms:
        known = latest.get(alarm.name)
        assert alarm.state is (AlarmState.NORMAL if known is None else known.state)
        assert (alarm.shelf is not None) == (alarm.state is AlarmState.SHELVED)
        assert bool(alarm.out_of_service_by) == (alarm.state is AlarmState.OUT_OF_SERVICE)
        assert alarm.present or alarm.state not in {AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED}
        assert not alarm.present or alarm.state in {
            AlarmState.UNACKNOWLEDGED, AlarmState.ACKNOWLEDGED,
            AlarmState.SHELVED, AlarmState.SUPPRESSED, AlarmState.OUT_OF_SERVICE,
        }  # fmt: skip
        assert not alarm.state.name.startswith("LATCHED") or alarm.name == "c_by"
        raisings = [e.kind for e in events if e.alarm.name == alarm.name and e.kind in {"raised", "cleared"}]
        assert raisings == (["raised", "cleared"] * len(raisings))[: len(raisings)]
        assert alarm.present == (len(raisings) % 2 == 1)
