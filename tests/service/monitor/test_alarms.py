"""Alarm scenarios in compact notation: one character per window of five seconds.

``.`` nothing, ``x`` beyond the limit, ``X`` beyond danger, ``o`` between the limits, ``?`` as large as ``x`` and ``!``
as large as ``X`` but not found to have changed, ``_`` not evaluated.
Events: ``^`` raised, ``!`` escalated, ``v`` cleared.
"""

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import cast

import pytest

from models.alarm_names import MODEL, STREAM_LOST
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import AlarmSettings, load_machine
from rotorwatch.records.alarms import Severity
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import Candidate, Finding, Parameter, SensorFault, Verdict
from service.monitor.alarms.alarm import AlarmEvent
from service.monitor.alarms.book import AlarmBook
from service.monitor.alarms.data_path import DataPathAlarms

CHANGES = {".": 0.01, "o": 0.08, "x": -0.2, "?": -0.2, "X": 0.6, "!": 0.6}
MARKS = {"raised": "^", "escalated": "!", "cleared": "v"}
SETTINGS = AlarmSettings(on_delay_s=10, off_delay_s=15)


def play(story: str, settings: AlarmSettings = SETTINGS) -> tuple[str, AlarmBook, list[AlarmEvent]]:
    book, marks = AlarmBook(settings), ""
    events: list[AlarmEvent] = []
    for number, character in enumerate(story):
        heard: tuple[AlarmEvent, ...] = ()
        if character != "_":
            heard = book.update("k_by", CHANGES[character], 0.01, number * 5_000_000_000, named=character in "oxX")
        marks += MARKS[heard[0].kind] if heard else " "
        events += heard
    return marks, book, events


@pytest.mark.parametrize(
    ("story", "expected"),
    [
        ("..xx......", "          "),  # shorter than the on-delay
        ("..xxx.....", "    ^   v "),
        ("..xx.xxx..", "       ^  "),  # interrupted: the delay starts again
        ("..xxxxx.....", "    ^     v "),
        ("..xxx.x.....", "    ^     v "),  # chattering while clearing does not raise again
        ("..xxxoooooo", "    ^      "),  # between the limits: neither clears nor raises
        ("oooooooo", "        "),
        ("..xxxXX....", "    ^!    v"),
        ("..xxx!X....", "    ^ !   v"),  # only a named change escalates
        ("XXX.....", "  ^   v "),  # straight to danger: one event
        ("..xxx____....", "    ^       v"),  # missing data do not clear an alarm
        ("..x____xx", "       ^ "),  # and does not stop a pending delay, which is data time
        ("..xxx....xxx", "    ^   v  ^"),
        ("????????", "        "),  # a change must have been named
        ("..xxx???...", "    ^      "),  # a large reading that is not named does not clear
    ],
)
def test_delays_limits_and_deadband_of_an_alarm(story: str, expected: str) -> None:
    assert play(story)[0] == expected


def test_outside_the_model_has_its_own_alarm() -> None:
    book = AlarmBook(SETTINGS)
    told = [event for n in range(4) for event in book.update_state(MODEL, True, n * 5_000_000_000)]
    assert [(event.kind, event.alarm.name) for event in told] == [("raised", "model")]
    assert told[0].text.startswith("ALERT: outside the model: something has changed that no parameter describes")
    assert not book.update("e", 0.3, 0.01, 0, named=True, low_confidence=True)
    (event,) = book.update("e", 0.3, 0.01, 10**10, named=True, low_confidence=True)
    assert event.text.endswith("changed by +30.0% ± 2.0% (low confidence: another cause is possible)")
    told = [event for n in range(4, 9) for event in book.update_state(MODEL, False, n * 5_000_000_000)]
    assert [event.text for event in told] == ["cleared: the model describes the machine again"]


@pytest.mark.parametrize("error", [0.05, 0.15, 0.0, float("inf"), float("nan")])
def test_a_large_change_does_not_clear_an_alarm_however_uncertain(error: float) -> None:
    _, book, _ = play("xxx")
    for number in range(3, 10):
        assert not book.update("k_by", -0.2, error, number * 5_000_000_000, named=False)
    assert book.alarms[0].raised


@pytest.mark.parametrize(
    ("error", "said"), [(0.0003, "-20.0% ± 0.1%"), (0.0002, "-19.999% ± 0.039%"), (0.00001234, "-19.9990% ± 0.0024%")]
)
def test_a_narrow_interval_has_two_significant_digits(error: float, said: str) -> None:
    book = AlarmBook(SETTINGS)
    told = [event for n in range(3) for event in book.update("k_by", -0.19999, error, n * 5_000_000_000, named=True)]
    assert [event.text for event in told] == [f"ALERT: bearing stiffness, horizontal (k_by) changed by {said}"]


def test_events_have_occurrence_sequence_severity_and_text() -> None:
    _, book, events = play("xxx....xxxX....")
    assert [event.sequence for event in events] == [0, 1, 2, 3, 4]
    assert [event.alarm.occurrence for event in events] == [1, 1, 2, 2, 2]
    assert events[0].text == "ALERT: bearing stiffness, horizontal (k_by) changed by -20.0% ± 2.0%"
    assert events[3].text.startswith("DANGER: bearing stiffness, horizontal (k_by) changed further, now +60.0%")
    assert events[4].text.startswith("cleared: ")
    assert book.severity is None
    _, both, _ = play("xxx")
    for number in range(4):
        both.update("e", 0.9, 0.01, number * 5_000_000_000, named=True)
    # The highest of the raised alarms.
    assert [one.severity for one in (play("xxx")[1], both)] == [Severity.ALERT, Severity.DANGER]


def test_a_parameter_can_have_its_own_limits() -> None:
    settings = AlarmSettings.model_validate({"on_delay_s": 0, "parameters": {"k_by": {"raise_above": 0.3}}})
    assert "^" not in play("xxx", settings)[0]
    assert "^" in play("X", settings)[0]


def test_a_stepped_clock_restarts_the_delays() -> None:
    book = AlarmBook(SETTINGS)
    assert not book.update("k_by", -0.2, 0.01, 10**18, named=True)
    book.clock_stepped(10**9, 10**9 - 10**18)
    assert not book.update("k_by", -0.2, 0.01, 2 * 10**9, named=True)
    assert book.update("k_by", -0.2, 0.01, 12 * 10**9, named=True)[0].kind == "raised"


def test_stream_and_data_alarms_do_not_affect_machine_severity() -> None:
    _, book, _ = play("xxx")
    (event,) = book.update_state(STREAM_LOST, True, 10**11, "no data for 5 s", at_once=True)
    assert event.text == "ALERT: stream lost: no data for 5 s"
    assert book.present("k_by")
    assert not book.update_state(STREAM_LOST, True, 2 * 10**11, at_once=True)
    (event,) = book.update_state(STREAM_LOST, False, 3 * 10**11, at_once=True)
    assert event.text == "cleared: data are arriving again"
    empty = AlarmBook(SETTINGS)
    assert not empty.update_state("data-gap", False, 0)  # clearing an unknown alarm creates none
    assert [*empty.alarms] == []
    empty.update_state("data-stuck", True, 0, "y1 stands still", at_once=True)
    assert empty.severity is None
    assert empty.alarms[0].raised


@pytest.mark.parametrize("kind", FaultKind)
def test_every_kind_of_sensor_fault_raises_its_alarm(kind: FaultKind) -> None:
    """Otherwise the machine would be not evaluable without an alarm."""
    machine = load_machine("lab").model_copy(update={"alarms": AlarmSettings(on_delay_s=0)})
    book = AlarmBook(machine.alarms)
    fault = SensorFault(states=("y1",), kind=kind, text="y1 is at fault", value=1.0)
    statistics = cast("WindowStatistics", SimpleNamespace(start_ns=0, end_ns=10**9))
    DataPathAlarms(book, machine).sensors((fault,), statistics, standing=False)
    (event,) = book.take()
    assert event.text == f"ALERT: data health, {kind.text}: y1 is at fault"
    assert book.severity is None


def judged(hops: Sequence[Mapping[str, float]], **more: bool) -> list[str]:
    """Alarm events for hops given as probabilities of parameters; those above 0.5 have changed."""
    return [f"{event.kind} {event.alarm.name}" for event in happened(hops, **more)]


def verdict(
    probability: Mapping[str, float], *, settled: bool = True, outside: bool = False, change: float = 0.2
) -> Verdict:
    changed = [name for name in probability if probability[name] > 0.5]
    return Verdict(
        changed=tuple(Finding(name=name, text=name, since_ns=0, found_ns=0, stretch_s=60) for name in changed),
        text="", detected=bool(changed), confidence=0.5,
        candidates=tuple(Candidate(name=name, text=name, probability=p) for name, p in probability.items()),
        low_confidence=False, outside_model=outside, outside_confidence=None, decided_s=60.0, settled=settled,
        current=tuple(
            Parameter(name=name, text=name, by="", relative_change=change, standard_error=0.03) for name in probability
        ),
    )  # fmt: skip


def happened(
    hops: Sequence[Mapping[str, float]], *, settled: bool = True, outside: bool = False, hidden: bool = False
) -> tuple[AlarmEvent, ...]:
    book = AlarmBook(SETTINGS)
    for number, probability in enumerate(hops):
        found = verdict(probability, settled=settled, outside=outside)
        book.found(found, "", "", number * 5_000_000_000, hidden=hidden)
    return book.take()


NOT_SURE, SURE = {"c_by": 0.4, "c_bz": 0.6}, {"c_by": 0.03, "c_bz": 0.97}


def test_a_parameter_is_named_only_if_nearly_certain() -> None:
    assert judged([SURE] * 3) == ["raised c_bz"]
    assert judged([NOT_SURE] * 3) == ["raised changed"]
    assert judged([SURE, NOT_SURE] * 3) == []  # neither lasts for the on-delay
    assert judged([NOT_SURE] * 3, outside=True) == ["raised model"]
    assert judged([SURE | {"c_by": 0.6}] * 3) == ["raised c_bz"]  # one is named: the other is waited for
    assert judged([SURE] * 3 + [NOT_SURE] * 6) == ["raised c_bz"]  # a parameter with an alarm raises no second one
    assert judged([NOT_SURE] * 3 + [SURE] * 6) == ["raised changed", "raised c_bz", "cleared changed"]


def test_no_name_if_outside_the_model_with_most_changed_or_a_line_hiding_the_machine() -> None:
    most = dict.fromkeys(("k_by", "c_by", "k_bz", "c_bz"), 0.99)
    assert judged([most] * 3) == [f"raised {name}" for name in most]
    assert judged([most] * 3, outside=True) == ["raised model"]
    assert judged([SURE] * 3 + [most] * 9, outside=True, settled=False) == ["raised c_bz", "raised model"]
    assert judged([SURE] * 3 + [most] * 9, outside=True)[-1] == "cleared c_bz"
    half = ["raised c_by", "raised k_bz", "raised c_bz", "raised model"]
    assert judged([most | {"k_by": 0.1}] * 3, outside=True) == half
    assert judged([SURE] * 3, outside=True) == ["raised c_bz", "raised model"]
    assert judged([SURE] * 9, outside=True, hidden=True) == ["raised model"]
    nothing = {"c_by": 0.02, "c_bz": 0.04}
    assert judged([nothing] * 9, outside=True, hidden=True) == ["raised model"]


@pytest.mark.parametrize("change", [-0.08, 0.2, -0.6])  # below and above all limits
def test_an_equally_likely_wrong_gain_is_named_beside_the_parameters(change: float) -> None:
    book = AlarmBook(SETTINGS)
    for number in range(3):
        book.found(verdict(SURE, change=change), "", "gain of z1: 1.16 times", number * 5_000_000_000, hidden=True)
    (event,) = book.take()
    assert (event.alarm.name, event.alarm.severity) == ("changed", Severity.ALERT)
    assert event.alarm.note == "c_by (c_by) or c_bz (c_bz) or gain of z1: 1.16 times"
    assert judged([SURE] * 3, outside=True, hidden=True) == ["raised model"]


def lasting(said: Verdict, *, by_angle: bool = True, present: str = "") -> list[AlarmEvent]:
    """Events of three hops with the same verdict, beside an alarm that is present."""
    book = AlarmBook(SETTINGS, by_angle=by_angle)
    book.update_state(present, bool(present), 0, at_once=True)
    book.take()
    for number in range(3):
        book.found(said, "", "", number * 5_000_000_000)
    return list(book.take())


def test_a_stiffer_shaft_has_low_confidence_and_a_smaller_unbalance_is_no_danger() -> None:
    (event,) = lasting(verdict({"EI": 0.99}, change=0.2))
    assert event.alarm.low_confidence
    assert "locked coupling" in event.text
    for change, severity in ((0.9, Severity.DANGER), (-0.9, Severity.ALERT)):
        (event,) = lasting(verdict({"e": 0.99}, change=change))
        assert (event.alarm.severity, event.alarm.low_confidence) == (severity, False)


def test_an_unbalance_that_has_vanished_has_low_confidence() -> None:
    """As where noise has taken the place of every signal."""
    (event,) = lasting(verdict({"e": 0.99}, change=-0.95))
    assert event.alarm.low_confidence
    assert "no longer see this shaft" in event.text
    assert lasting(verdict({"e": 0.99}, change=-0.95), present="data-incoherent") == []
    assert lasting(verdict({"e": 0.99}, change=-0.95, settled=False)) == []
    for change, present in ((-0.5, "data-incoherent"), (-0.95, "data-gain")):
        assert [event.alarm.name for event in lasting(verdict({"e": 0.99}, change=change), present=present)] == ["e"]


@pytest.mark.parametrize(("change", "by_angle"), [(-0.4, False), (0.4, False), (-0.4, True)])
def test_without_a_shaft_angle_a_smaller_unbalance_has_low_confidence(change: float, by_angle: bool) -> None:
    (event,) = lasting(verdict({"e": 0.99}, change=change), by_angle=by_angle)
    doubted = change < 0 and not by_angle
    assert (event.alarm.low_confidence, "a speed that hunts" in event.text) == (doubted, doubted)


def test_stiffening_or_small_changes_explain_no_levels_and_a_repaired_shaft_clears() -> None:
    book = AlarmBook(SETTINGS)
    changes = ({"EI": 0.99}, 0.2), ({"EI": 0.99}, -0.2), ({"EI": 0.99, "e": 0.99}, 0.2)
    assert [book.found(verdict(of, change=change), "", "", 0) for of, change in changes] == [False, True, True]
    # A change below its limit raises no alarm, so it must not suppress level alarms.
    assert [AlarmBook(SETTINGS).found(verdict({"e": 0.99}, change=size), "", "", 0) for size in (0.01, 0.2)] == [
        False,
        True,
    ]
    crack = AlarmBook(SETTINGS)
    for number in range(15):
        crack.found(
            verdict({"EI": 0.99 if number < 3 else 0.0}, change=-0.2 if number < 3 else 0.01),
            "",
            "",
            number * 5_000_000_000,
        )
    assert [(event.kind, event.alarm.note, event.alarm.low_confidence) for event in crack.take()] == [
        ("raised", "", False), ("cleared", "", False),
    ]  # fmt: skip


@pytest.mark.parametrize(("outside", "unsettled"), [(False, True), (True, False)])
def test_a_repaired_parameter_explains_levels_while_the_window_holds_data_from_before(
    *, outside: bool, unsettled: bool
) -> None:
    book = AlarmBook(SETTINGS)
    found = verdict({"k_by": 0.99}, change=-0.3)
    repaired = verdict({"k_by": 0.0}, change=-0.3).model_copy(update={"outside_model": outside})
    told = [book.found(found, "", "", number * 5_000_000_000) for number in range(4)]
    for number, settled in enumerate((False, False, True, True), start=4):
        one = repaired.model_copy(update={"settled": settled})
        told.append(book.found(one, "", "", number * 5_000_000_000))
    assert told == [True] * 4 + [unsettled] * 2 + [False] * 2


@pytest.mark.parametrize(
    ("others", "by", "settled", "reserve"),
    [
        (("k_by",), "baseline", True, False),
        (("k_by", "k_bz"), "baseline", True, True),
        (("k_by", "k_bz"), "likelihood", True, False),
        (("c_bz",), "baseline", False, True),
        (("c_bz",), "likelihood", False, False),
        ((), "baseline", False, False),
    ],
)
def test_a_baseline_unbalance_beside_bearing_changes_has_low_confidence(
    others: tuple[str, ...], by: str, settled: bool, reserve: bool
) -> None:
    """The foundation may have changed, or a bearing in this window; then the unbalance is misread."""
    found = verdict(dict.fromkeys((*others, "e"), 1.0), settled=settled)
    current = tuple(one.model_copy(update={"by": by}) for one in found.current)
    told = lasting(found.model_copy(update={"current": current}))
    named = {event.alarm.name: event.alarm.low_confidence for event in told}
    assert named == dict.fromkeys(others, False) | {"e": reserve}


@pytest.mark.parametrize(
    ("vertical", "by", "reserve"),
    [(-0.14, "baseline", True), (-0.03, "baseline", False), (0.2, "baseline", False), (-0.14, "likelihood", False)],
)
def test_an_unbalance_has_low_confidence_while_both_stiffnesses_read_softer(
    vertical: float, by: str, *, reserve: bool
) -> None:
    """As of a softened foundation, where an unbalance happened to explain the window better."""
    found = verdict({"e": 1.0, "k_by": 0.1, "k_bz": 0.1})
    changes = {"e": 0.17, "k_by": -0.3, "k_bz": vertical}
    current = tuple(one.model_copy(update={"by": by, "relative_change": changes[one.name]}) for one in found.current)
    told = lasting(found.model_copy(update={"current": current}))
    assert {event.alarm.name: event.alarm.low_confidence for event in told} == {"e": reserve}


def test_a_name_has_low_confidence_while_a_cause_outside_the_model_explains_the_data_as_well() -> None:
    book, named = AlarmBook(SETTINGS), verdict({"e": 0.97, "c_by": 0.0}, change=0.9)
    unnamed = named.model_copy(update={"changed": ()})
    said = (named, ""), (named, "the disc's mass"), (named, "the disc's mass"), (unnamed, None), (named, "")
    explains = [book.found(one, "", "", n * 5_000_000_000, rival=rival) for n, (one, rival) in enumerate(said)]
    raised, escalated = book.take()
    assert raised.alarm.low_confidence
    assert raised.text.endswith("(low confidence: a change of the disc's mass explains the data as well)")
    assert [raised.alarm.severity, escalated.alarm.severity] == [Severity.ALERT, Severity.DANGER]
    assert explains == [True, False, False, False, True]
    assert not escalated.alarm.low_confidence
    # While nobody looks, what was found last holds.
    (event,) = lasting(named.model_copy(update={"current": named.current[:1]}))
    assert not event.alarm.low_confidence


def test_a_named_alarm_gets_low_confidence_while_nothing_explains_the_machine() -> None:
    book, named = AlarmBook(SETTINGS), verdict({"c_bz": 0.97})
    unexplained = named.model_copy(update={"current": (), "candidates": (), "outside_model": True})
    reserves = []
    for number, said in enumerate((named, named, named, unexplained, unexplained, named)):
        book.found(said, "it makes no sense" if said is unexplained else "", "", number * 5_000_000_000)
        (alarm,) = (one for one in book.alarms if one.name == "c_bz")
        reserves.append((alarm.present, alarm.low_confidence))
    assert reserves == [(False, False)] * 2 + [(True, False), (True, True), (True, True), (True, False)]


@pytest.mark.parametrize(
    ("suspect", "astride_s", "said"),
    [
        ("a line at 65 Hz", 0.0, "best explained by: a line at 65 Hz"),
        ("", 60.0, "if a parameter has just changed, it can be named in 60 s"),
    ],
)
def test_an_alarm_outside_the_model_states_its_suspect_or_wait(suspect: str, astride_s: float, said: str) -> None:
    book, outside = AlarmBook(SETTINGS), verdict({}, outside=True, settled=False)
    for number in range(3):
        left_s = max(0.0, astride_s - 5.0 * number)
        book.found(outside, "", suspect, number * 5_000_000_000, astride_s=left_s)
    (event,) = book.take()
    assert event.text == f"ALERT: outside the model: {said}"


def test_a_withdrawn_name_clears_its_alarm_however_large_its_reading() -> None:
    nothing = {"c_by": 0.02, "c_bz": 0.04}
    assert judged([SURE] * 3 + [nothing] * 3) == ["raised c_bz"]
    assert judged([SURE] * 3 + [nothing] * 4) == ["raised c_bz", "cleared c_bz"]
    text = happened([SURE] * 3 + [nothing] * 4)[-1].text
    assert text == "cleared: bearing damping, vertical (c_bz) is no longer named as changed; it reads +20.0% ± 5.9%"
    assert judged([SURE] * 3 + [nothing] * 9, settled=False) == ["raised c_bz"]  # too little data to withdraw the name
