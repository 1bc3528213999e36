"""What is kept in memory, and what becomes of it in JSON."""

import json
import threading

import pytest

from models.diagnosis.readings import EquationReading, ParameterReading
from service import conversion
from service.alarms.alarm import Alarm, AlarmEvent
from service.alarms.life_cycle import AlarmState
from service.history import History
from service.reports import DataQuality, HealthState, MachineHealth, WindowReport
from service.schemas import AlarmCloudEvent, AlarmStates, Health, MachineDescription, Report, StreamStatus, example
from tests.service.live import LAB

IDENTITY = Identity("demo", "lab", None, conversion.machine_hash(LAB))


def window(end_ns: int) -> WindowReport:
    return WindowReport(end_ns - 60, end_ns, HealthState.HEALTHY, 1.0)


def event(time_ns: int) -> AlarmEvent:
    return AlarmEvent("raised", time_ns, 0, Alarm("k_by"))


def ends(history: History, since_ns: int | None = None, until_ns: int | None = None, limit: int = 100) -> list[int]:
    return [report.end_ns for report in history.reports(since_ns, until_ns, limit)]


def test_range_is_half_open_and_newest_come_first() -> None:
    history = History(10, 10)
    history.add([window(end) for end in (100, 105, 110, 115)], [event(107), event(112)])
    assert ends(history) == [115, 110, 105, 100]
    assert ends(history, since_ns=105) == [115, 110, 105]
    assert ends(history, until_ns=110) == [105, 100]
    assert ends(history, 105, 115) == [110, 105]
    assert ends(history, limit=2) == [115, 110]
    assert ends(history, until_ns=115, limit=1) == [110]
    assert [entry.time_ns for entry in history.alarm_events(until_ns=112)] == [107]


def test_oldest_are_forgotten() -> None:
    history = History(3, 1)
    history.add([window(end) for end in range(5)], [event(1), event(2)])
    assert ends(history) == [4, 3, 2]
    assert [entry.time_ns for entry in history.alarm_events()] == [2]


def test_a_clock_that_was_set_back_hides_nothing() -> None:
    history = History(10, 10)
    history.add([window(end) for end in (100, 200, 50, 60)], [])
    assert ends(history, since_ns=55, until_ns=150) == [60, 100]


def test_readers_and_the_writer_do_not_disturb_each_other() -> None:
    history = History(50, 50)
    done = threading.Event()
    seen: list[list[int]] = []

    def read() -> None:
        while not done.is_set():
            seen.append(ends(history))

    reader = threading.Thread(target=read)
    reader.start()
    for end in range(5000):
        history.add([window(end)], [])
    done.set()
    reader.join()
    assert all(found == sorted(found, reverse=True) for found in seen)
    assert ends(history, limit=1) == [4999]


@pytest.mark.parametrize("model", [AlarmCloudEvent, AlarmStates, Health, MachineDescription, Report])
def test_every_field_is_described_and_has_an_example(
    model: type[AlarmCloudEvent] | type[AlarmStates] | type[Health] | type[MachineDescription] | type[Report],
) -> None:
    for name, field in model.model_fields.items():
        assert field.description, f"{model.__name__}.{name} has no description"
    assert model.model_validate(example(model)).model_dump(mode="json") == example(model)


def test_infinite_and_undefined_numbers_become_null() -> None:
    readings = (
        ParameterReading("k_by", "likelihood", float("nan"), 0.1),
        ParameterReading("c_by", "likelihood", 0.1, float("inf")),
        ParameterReading("e", "likelihood", 0.1, 0.0),
        ParameterReading("EI", "likelihood", reason="no phase reference"),
    )
    equation = EquationReading("28", "bearing", float("inf"), float("nan"), readings)
    latest = WindowReport(0, 1, HealthState.HEALTHY, 1.0, float("nan"), readings, (equation,), misfit_z=float("inf"))
    health = conversion.health(
        IDENTITY,
        MachineHealth(HealthState.HEALTHY, 1.0, latest, (Alarm("k_by", AlarmState.PENDING),), DataQuality()),
        StreamStatus(publisher_alive=False, data_age_s=None, descriptor_mismatch=()),
    )
    text = health.model_dump_json()

    def refuse(constant: str) -> None:
        pytest.fail(f"{constant} in JSON")

    fields = json.loads(text, parse_constant=refuse)
    assert fields["speed_rad_s"] is None
    assert fields["misfit_z"] is None
    assert fields["equations"][0]["msd"] is None
    assert fields["alarms"][0]["standard_error"] is None
    assert [entry["interval_95"] for entry in fields["parameters"]] == [None, None, [0.1, 0.1], None]
    assert [entry["z"] for entry in fields["parameters"]] == [None, None, None, None]
    assert Health.model_validate_json(text) == health


def test_no_data_outranks_a_raised_alarm_and_hides_it_not() -> None:
    alarm = Alarm("k_by", AlarmState.ACTIVE, raised_ns=5, occurrence=1, change=-0.3, standard_error=0.01)
    record = MachineHealth(HealthState.ALERT, 1.0, window(7), (alarm, Alarm("e")), DataQuality())
    stream = StreamStatus(publisher_alive=True, data_age_s=9.0, descriptor_mismatch=())
    health = conversion.health(IDENTITY, record, stream, no_data_reason="silence")
    assert health.state == "no-data"
    assert health.reason == "silence"
    assert [(entry.parameter, entry.raised) for entry in health.alarms] == [("k_by", True)]
    assert conversion.health(IDENTITY, record, stream).state == "alert"


def test_event_identity_is_stable_and_differs_between_kinds_and_occurrences() -> None:
    alarm = Alarm("k_by", AlarmState.ACTIVE, occurrence=2)
    same = [alarm_cloud_event(IDENTITY, AlarmEvent("raised", 77, 3, alarm)).id for _ in range(2)]
    other = alarm_cloud_event(IDENTITY, AlarmEvent("escalated", 77, 4, alarm))
    assert same == ["demo/lab/k_by/2/raised/77"] * 2
    assert other.id != same[0]
    assert other.sequence > "00000000000000000003"
    assert other.time == "1970-01-01T00:00:00.000000Z"


def test_machine_hash_follows_the_content() -> None:
    changed = LAB.model_copy(update={"description": "another"})
    assert conversion.machine_hash(LAB) == IDENTITY.machine_hash
    assert conversion.machine_hash(changed) != IDENTITY.machine_hash
    assert len(IDENTITY.machine_hash) == 12
