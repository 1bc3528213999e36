"""The pages on topics and HTTP list everything there is, and their examples are what the programs send."""

import json
import re
from typing import Any

import pytest
from pydantic import BaseModel

from models.signals.channels import ChannelDescriptor
from models.signals.keys import MachineKeys
from service.api import AlarmEventList, Alive, MachineList, ReportList, create_app
from service.config import ServiceSettings, load_settings
from service.recordings_api import RecordingDetail, RecordingList
from service.replay.schemas import ReplayJob, ReplayRequest, ReplaySeek
from service.replays_api import ReplayAlarmList, ReplayList, ReplayReportList
from service.runtime import Runtime
from service.schemas import (
    AlarmCloudEvent,
    AlarmStates,
    DetectableChanges,
    Health,
    MachineDescription,
    Problem,
    Readiness,
    Report,
)
from simulator.truth import TruthRecord
from tests.service.live import LAB, ROOT, settings

KEYS = MachineKeys("demo", "lab")
NAMES = [name for name, value in vars(MachineKeys).items() if isinstance(value, property) and name != "root"]
WITHOUT_JSON = {"stream", "publisher_alive", "monitor_alive", "replay_alive"}
TOPICS: dict[str, type[BaseModel]] = {
    "descriptor": ChannelDescriptor,
    "truth": TruthRecord,
    "report": Report,
    "health": Health,
    "alarm_state": AlarmStates,
    "alarm_event": AlarmCloudEvent,
}
ROUTES: dict[str, type[BaseModel]] = {
    "/api/v1/machines": MachineList,
    "/api/v1/machines/{site}/{machine}": MachineDescription,
    "/api/v1/machines/{site}/{machine}/health": Health,
    "/api/v1/machines/{site}/{machine}/reports": ReportList,
    "/api/v1/machines/{site}/{machine}/alarms": AlarmStates,
    "/api/v1/machines/{site}/{machine}/detectable": DetectableChanges,
    "/api/v1/machines/{site}/{machine}/alarms/events": AlarmEventList,
    "/api/v1/recordings": RecordingList,
    "/api/v1/recordings/{site}/{machine}/{name}": RecordingDetail,
    "/api/v1/replays": ReplayList,
    "/api/v1/replays/{replay_id}": ReplayJob,
    "/api/v1/replays/{replay_id}/reports": ReplayReportList,
    "/api/v1/replays/{replay_id}/alarms": ReplayAlarmList,
    "/healthz": Alive,
    "/readyz": Readiness,
}
CHANGES: dict[str, type[BaseModel] | None] = {
    "POST /api/v1/replays": ReplayRequest,
    "POST /api/v1/replays/{replay_id}/seek": ReplaySeek,
    "POST /api/v1/replays/{replay_id}/pause": None,
    "POST /api/v1/replays/{replay_id}/resume": None,
    "DELETE /api/v1/replays/{replay_id}": None,
}
WITHOUT_EXAMPLE = {
    "GET /api/v1/recordings/{site}/{machine}/{name}/download",
    "GET /api/v1/replays/{replay_id}/events",
}


def sections(page: str) -> dict[str, str]:
    """Text under each second-level heading."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    parts = re.split(r"^## (.+)$", text, flags=re.MULTILINE)
    return {title.strip("`"): body for title, body in zip(parts[1::2], parts[2::2], strict=True)}


def json_blocks(text: str) -> list[Any]:
    return [json.loads(block) for block in re.findall(r"```json\n(.*?)```", text, flags=re.DOTALL)]


def test_every_key_has_its_section() -> None:
    assert set(NAMES) == set(TOPICS) | WITHOUT_JSON
    assert set(sections("topics.md")) == {getattr(KEYS, name) for name in NAMES}


def test_every_key_is_in_the_table() -> None:
    page = (ROOT / "docs" / "topics.md").read_text(encoding="utf-8")
    for name in NAMES:
        assert f"\n| `{getattr(KEYS, name).removeprefix(KEYS.root + '/')}` |" in page


@pytest.mark.parametrize("name", TOPICS)
def test_example_on_a_topic_is_valid_and_complete(name: str) -> None:
    model = TOPICS[name]
    (shown,) = json_blocks(sections("topics.md")[getattr(KEYS, name)])
    model.model_validate(shown)
    # Fields with a default would pass unseen if they were missing in the page.
    assert set(shown) == set(model.model_fields)
    if name == "descriptor":
        assert ChannelDescriptor.model_validate(shown) == LAB.descriptor


def test_every_state_is_explained() -> None:
    text = sections("topics.md")[KEYS.health]
    for state in (
        "warming",
        "healthy",
        "alert",
        "danger",
        "outside-model",
        "no-data",
        "not-evaluable",
        "unchanged",
        "data-health",
    ):
        assert f"`{state}`" in text


def test_every_route_of_the_application_has_its_section() -> None:
    app = create_app(Runtime(settings("tcp/127.0.0.1:0")))
    paths = app.openapi()["paths"]
    served = {f"{method.upper()} {path}" for path, methods in paths.items() for method in methods}
    assert served == {f"GET {path}" for path in ROUTES} | set(CHANGES) | WITHOUT_EXAMPLE
    assert set(sections("api.md")) == served | {"Errors", "Who may change anything"}


@pytest.mark.parametrize("route", ROUTES)
def test_example_of_a_route_is_valid(route: str) -> None:
    (shown,) = json_blocks(sections("api.md")[f"GET {route}"])
    ROUTES[route].model_validate(shown)
    assert set(shown) == set(ROUTES[route].model_fields)


@pytest.mark.parametrize("route", [route for route, model in CHANGES.items() if model is not None])
def test_example_of_a_request_is_valid(route: str) -> None:
    model = CHANGES[route]
    assert model is not None
    (shown,) = json_blocks(sections("api.md")[route])
    model.model_validate(shown)


def test_example_of_a_problem_is_valid() -> None:
    (shown,) = json_blocks(sections("api.md")["Errors"])
    Problem.model_validate(shown)


def test_every_query_argument_is_explained() -> None:
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    paths = create_app(Runtime(settings("tcp/127.0.0.1:0"))).openapi()["paths"]
    routes = [route for path in paths.values() for route in path.values()]
    arguments = {p["name"] for route in routes for p in route.get("parameters", []) if p["in"] == "query"}
    assert arguments == {"since_ns", "until_ns", "limit", "all", "change", "site", "machine", "offset"}
    for name in arguments - {"all"}:
        assert f"| `{name}` |" in page
    assert "?all=true" in page


def test_settings_in_the_page_are_read(tmp_path: Any) -> None:
    text = (ROOT / "docs" / "service.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"```toml\n(.*?)```", text, flags=re.DOTALL)
    (tmp_path / "plant.toml").write_text(shown, encoding="utf-8")
    (tmp_path / "pump-7-networks").mkdir()
    pump = (ROOT / "models/machines/lab.toml").read_text(encoding="utf-8").replace('name = "lab"', 'name = "pump-7"')
    (tmp_path / "pump-7.toml").write_text(pump, encoding="utf-8")
    read = load_settings(tmp_path / "plant.toml")
    assert [entry.load().name for entry in read.machines] == ["pump-7", "lab"]
    assert read.machines[0].bundle == str(tmp_path / "pump-7-networks")
    defaults = ServiceSettings()
    for name, value in (("reports", defaults.history.reports), ("blocks", defaults.queue.blocks)):
        assert f"| `{name}` | {value} |" in text
