"""The HTTP API of a running service that has seen a fault: real server, real session, real evaluation."""

import re
from collections.abc import Iterator
from typing import Any, TypeVar

import httpx
import pytest
from pydantic import BaseModel

from models.machine import load_machine
from models.physics.parameters import PARAMETERS
from service.api import AlarmEventList, Alive, MachineList, ReportList, create_app
from service.runtime import Runtime
from service.schemas import AlarmStates, DetectableChanges, Health, MachineDescription, Problem, Readiness
from service.worker import MachineWorker
from simulator.scenario import parse_fault
from tests.service.live import START_NS, endpoint, machine_file, scenario_blocks, send, service, until

M = TypeVar("M", bound=BaseModel)

PLACE = "/api/v1/machines/demo/lab"
HOP_NS = 5_000_000_000
MODELS: dict[str, type[BaseModel]] = {
    "/api/v1/machines": MachineList,
    "/api/v1/machines/{site}/{machine}": MachineDescription,
    "/api/v1/machines/{site}/{machine}/health": Health,
    "/api/v1/machines/{site}/{machine}/reports": ReportList,
    "/api/v1/machines/{site}/{machine}/alarms": AlarmStates,
    "/api/v1/machines/{site}/{machine}/detectable": DetectableChanges,
    "/api/v1/machines/{site}/{machine}/alarms/events": AlarmEventList,
    "/healthz": Alive,
    "/readyz": Readiness,
}


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Runtime, MachineWorker]]:
    """The lab machine without a third of its horizontal bearing stiffness, 92 s of data, alarms after 10 s."""
    address = endpoint()
    file = machine_file(
        tmp_path_factory.mktemp("machine"),
        ("on_delay_s = 5.0", "on_delay_s = 10.0"),
        ("[operation]", "[ingest]\nno_data_after_s = 3600.0\n\n[operation]"),
    )
    with service(address, file, bundle="lab", when_full="wait") as (runtime, worker):
        send(address, scenario_blocks(92.0, parse_fault("k_by=-0.33@0")), load_machine(file))
        until(lambda: worker.health().quality.accepted_blocks == 920, "all blocks")
        yield runtime, worker


@pytest.fixture(scope="module")
def client(seen: tuple[Runtime, MachineWorker]) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=seen[0].http_url, trust_env=False) as client:
        yield client


def get(client: httpx.Client, path: str, model: type[M]) -> M:
    answer = client.get(path)
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/json"
    return model.model_validate_json(answer.content)


def problem(answer: httpx.Response, status: int) -> Problem:
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    found = Problem.model_validate_json(answer.content)
    assert found.status == status
    assert found.instance == answer.request.url.path
    return found


def test_machines_are_listed(client: httpx.Client, seen: tuple[Runtime, MachineWorker]) -> None:
    (machine,) = get(client, "/api/v1/machines", MachineList).machines
    assert machine == get(client, PLACE, MachineDescription)
    assert (machine.site, machine.machine, machine.state) == ("demo", "lab", "alert")
    assert machine.keys["health"] == "rotorwatch/demo/lab/health"
    assert len(machine.channels) == 9
    assert machine.bundle == seen[1].identity.bundle is not None


def test_health_names_the_fault_with_its_interval(client: httpx.Client) -> None:
    health = get(client, f"{PLACE}/health", Health)
    assert health.state == "alert"
    assert health.filled == 1.0
    assert health.window_end_ns is not None
    assert health.window_start_ns == health.window_end_ns - 12 * HOP_NS
    assert [parameter.name for parameter in health.parameters] == list(PARAMETERS)
    k_by = health.parameters[0]
    assert k_by.text == "bearing stiffness, horizontal"
    assert k_by.interval_95 is not None
    assert k_by.interval_95[0] < -0.33 < k_by.interval_95[1] + 0.02
    assert [equation.equation for equation in health.equations] == ["28", "29", "30", "31"]
    for equation in health.equations:
        assert equation.evaluable == (equation.msd is not None)
        assert equation.evaluable != bool(equation.reason)
    assert any(equation.evaluable for equation in health.equations)
    assert [alarm.parameter for alarm in health.alarms if alarm.raised] == ["k_by"]
    assert health.quality.accepted_blocks == 920
    assert health.quality.gaps == health.quality.queue_dropped_blocks == health.quality.link_missed_blocks == 0
    assert health.stream.descriptor_mismatch == ()


def test_reports_are_cut_by_time_and_number(client: httpx.Client) -> None:
    every = get(client, f"{PLACE}/reports", ReportList)
    ends = [report.end_ns for report in every.reports]
    assert ends == sorted(ends, reverse=True)
    # The first hop ends after its own history (half a segment) and its own five seconds.
    assert ends[-1] == START_NS + 7_500_000_000
    assert len(ends) == 17
    assert every.next_until_ns is None
    assert [report.state for report in reversed(every.reports)] == ["warming"] * 11 + ["healthy"] * 2 + ["alert"] * 4
    some = get(client, f"{PLACE}/reports?since_ns={ends[10]}&until_ns={ends[3]}", ReportList)
    assert [report.end_ns for report in some.reports] == ends[4:11]
    first = get(client, f"{PLACE}/reports?limit=10", ReportList)
    assert [report.end_ns for report in first.reports] == ends[:10]
    assert first.next_until_ns == ends[9]
    second = get(client, f"{PLACE}/reports?limit=10&until_ns={first.next_until_ns}", ReportList)
    assert [report.end_ns for report in second.reports] == ends[10:]
    assert second.next_until_ns is None


def test_alarms_and_their_events(client: httpx.Client) -> None:
    (active,) = get(client, f"{PLACE}/alarms", AlarmStates).alarms
    assert (active.parameter, active.state, active.severity, active.occurrence) == ("k_by", "active", "alert", 1)
    everything = get(client, f"{PLACE}/alarms?all=true", AlarmStates).alarms
    assert {alarm.parameter for alarm in everything} == {*PARAMETERS, "model", "sensor"}
    assert [alarm.parameter for alarm in everything if alarm.state != "normal"] == ["k_by"]
    (event,) = get(client, f"{PLACE}/alarms/events", AlarmEventList).events
    assert event.type == "org.rotorwatch.alarm.raised"
    assert event.source == "/rotorwatch/demo/lab"
    assert event.subject == event.data.parameter == "k_by"
    assert event.id == f"demo/lab/k_by/1/raised/{event.data.time_ns}"
    assert int(event.sequence) == event.data.sequence == 0
    assert event.data.time_ns == active.raised_ns == START_NS + 72_500_000_000
    assert event.time == "2026-01-01T00:01:12.500000Z"
    assert event.data.text.startswith("ALERT: bearing stiffness, horizontal (k_by) changed by -3")
    later = get(client, f"{PLACE}/alarms/events?since_ns={event.data.time_ns + 1}", AlarmEventList)
    assert later.events == ()


def test_health_says_what_changed_since_when_and_who_agrees(client: httpx.Client) -> None:
    health = get(client, f"{PLACE}/health", Health)
    verdict = health.verdict
    assert verdict is not None
    (found,) = verdict.changed
    assert (found.name, found.text) == ("k_by", "bearing stiffness, horizontal")
    assert found.since_ns < found.found_ns
    assert verdict.detected
    assert not verdict.outside_model
    assert verdict.confidence > 0.99
    assert verdict.text.startswith("changed: bearing stiffness, horizontal (k_by) since 00:00:")
    assert health.opinions
    for opinion in health.opinions:
        k_by = next(one for one in opinion.agreement if one.name == "k_by")
        assert k_by.between == ("likelihood", opinion.by)
        assert k_by.verdict == "agree"
        assert abs(k_by.difference_z or 9.0) < 4


def test_detectable_changes(client: httpx.Client) -> None:
    plain = get(client, f"{PLACE}/detectable", DetectableChanges)
    assert [parameter.name for parameter in plain.parameters] == list(PARAMETERS)
    assert {parameter.length_s for parameter in plain.parameters} == {None}
    sizes = {parameter.name: parameter.gain for parameter in plain.parameters}
    assert 0.01 < sizes["k_by"] < 0.1 < sizes["c_by"] + 0.05 < 0.3
    asked = get(client, f"{PLACE}/detectable?change=-0.1", DetectableChanges)
    assert asked.change == -0.1
    for parameter in asked.parameters:
        assert parameter.length_s is not None
        assert (parameter.length_s < 60.0) == (parameter.loss > -0.1)


def test_service_routes(client: httpx.Client) -> None:
    assert get(client, "/healthz", Alive).alive
    readiness = get(client, "/readyz", Readiness)
    assert readiness.ready
    assert [(machine.machine, machine.worker_alive) for machine in readiness.machines] == [("lab", True)]


def test_page_for_people_needs_nothing_from_elsewhere(client: httpx.Client) -> None:
    answer = client.get("/")
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    assert "demo/lab" in answer.text
    assert 'class="alert">alert</span>' in answer.text
    assert re.search(
        r'class="raised"><td>bearing stiffness, horizontal \(k_by\)<td class="number">-3\d\.\d%', answer.text
    )
    assert "bearing damping, vertical (c_bz)" in answer.text
    assert 'href="/openapi.json"' in answer.text
    assert "//" not in answer.text
    for path in ("/docs", "/redoc"):
        problem(client.get(path), 404)


@pytest.mark.parametrize("route", ["", "/health", "/reports", "/alarms", "/alarms/events", "/detectable"])
def test_unknown_machine_is_a_problem_that_names_the_known_ones(client: httpx.Client, route: str) -> None:
    found = problem(client.get(f"/api/v1/machines/demo/pump{route}"), 404)
    assert found.title == "Not Found"
    assert found.detail == "no machine demo/pump; there are: demo/lab"


def test_unknown_path_and_wrong_method_are_problems(client: httpx.Client) -> None:
    problem(client.get("/api/v2/machines"), 404)
    answer = client.post("/api/v1/machines")
    problem(answer, 405)
    assert answer.headers["allow"] == "GET"


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("reports?limit=0", "limit"),
        ("reports?limit=1001", "limit"),
        ("reports?since_ns=yesterday", "since_ns"),
        ("alarms?all=perhaps", "all"),
        ("detectable?change=-1", "change"),
        ("alarms/events?until_ns=-1", "until_ns"),
    ],
)
def test_wrong_argument_is_a_problem_that_names_it(client: httpx.Client, query: str, field: str) -> None:
    found = problem(client.get(f"{PLACE}/{query}"), 422)
    assert found.detail.startswith(f"{field}: Input should be")


def test_error_inside_is_a_problem_that_tells_nothing(
    seen: tuple[Runtime, MachineWorker], client: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("secret of the inside")

    monkeypatch.setattr(seen[1], "reports", fail)
    answer = client.get(f"{PLACE}/reports")
    assert "secret" not in problem(answer, 500).model_dump_json()
    monkeypatch.undo()
    assert client.get(f"{PLACE}/reports").status_code == 200


def test_openapi_has_an_example_for_every_route_and_problem(client: httpx.Client) -> None:
    paths: dict[str, Any] = client.get("/openapi.json").json()["paths"]
    assert {path for path in paths if "/recordings" not in path and "/replays" not in path} == set(MODELS)
    for path, model in MODELS.items():
        responses = paths[path]["get"]["responses"]
        model.model_validate(responses["200"]["content"]["application/json"]["example"])
        assert "500" in responses
        assert ("404" in responses) == ("{site}" in path)
        for status, response in responses.items():
            if status != "200":
                content = response["content"]
                assert list(content) == ["application/problem+json"]
                assert Problem.model_validate(content["application/problem+json"]["example"]).status == int(status)


def test_not_ready_without_a_session(tmp_path_factory: pytest.TempPathFactory) -> None:
    address = endpoint()
    with service(address) as (runtime, _):
        app = create_app(runtime)
        assert {route.path for route in app.routes if hasattr(route, "path")} >= set(MODELS)
        with httpx.Client(base_url=runtime.http_url, trust_env=False) as client:
            assert client.get("/readyz").status_code == 200
            runtime.machines()[0].stop()
            answer = client.get("/readyz")
            found = problem(answer, 503)
            assert "worker has stopped" in found.detail
            assert answer.json()["machines"][0]["worker_alive"] is False
