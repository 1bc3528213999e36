"""The page on topics lists every key, and its examples and recipes agree with the programs.

``python -m tests.service.stream.test_topics_doc`` writes the examples of what a monitor sends anew.
"""

import json
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from models.signals.channels import ChannelDescriptor
from models.signals.keys import Key, MachineKeys
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmLogPage, AlarmStates, EventKind
from rotorwatch.records.example import example
from rotorwatch.records.health import Health, HealthState, Report
from service.settings.service import ServiceSettings, load_settings
from simulator.stream import TruthRecord
from tests.service.rig.live import LAB, ROOT, Feed, endpoint, open_session, service, until

PAGE = ROOT / "docs" / "topics.md"
KEYS = MachineKeys("demo", "lab")
NAMES = [name for name, value in vars(MachineKeys).items() if isinstance(value, Key)]
WITHOUT_JSON = {"stream", "publisher_alive", "monitor_alive", "replay_alive"}
TAKEN: dict[str, type[BaseModel]] = {"descriptor": ChannelDescriptor, "truth": TruthRecord}
SENT: dict[str, type[BaseModel]] = {
    "report": Report, "health": Health, "alarm_state": AlarmStates, "alarm_event": AlarmCloudEvent,
}  # fmt: skip
JSON_BLOCK = re.compile(r"```json\n(.*?)```", flags=re.DOTALL)


def sections() -> dict[str, str]:
    """Text under each second-level heading that is a key."""
    parts = re.split(r"^## (.+)$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    found = {title.strip("`"): body for title, body in zip(parts[1::2], parts[2::2], strict=True)}
    return {title: body for title, body in found.items() if title.startswith("rotorwatch/")}


def shown(name: str) -> dict[str, Any]:
    (text,) = JSON_BLOCK.findall(sections()[getattr(KEYS, name)])
    found: dict[str, Any] = json.loads(text)
    return found


def test_every_key_has_a_section_and_a_row() -> None:
    assert set(NAMES) == set(TAKEN) | set(SENT) | WITHOUT_JSON
    assert set(sections()) == {getattr(KEYS, name) for name in NAMES}
    page = PAGE.read_text(encoding="utf-8")
    for name in NAMES:
        assert f"\n| `{getattr(KEYS, name).removeprefix(KEYS.root + '/')}` |" in page


@pytest.mark.parametrize("name", TAKEN)
def test_examples_of_received_messages_are_valid_and_complete(name: str) -> None:
    TAKEN[name].model_validate(shown(name))
    # A field with a default could be missing in the page unnoticed.
    assert set(shown(name)) == set(TAKEN[name].model_fields)
    if name == "descriptor":
        assert ChannelDescriptor.model_validate(shown(name)) == LAB.descriptor


@pytest.mark.parametrize("name", SENT)
def test_examples_of_sent_messages_are_those_of_the_models(name: str) -> None:
    assert shown(name) == example(SENT[name]), "python -m tests.service.stream.test_topics_doc writes it anew"
    SENT[name].model_validate(shown(name))


def test_every_health_state_and_kind_of_event_is_explained() -> None:
    for state in HealthState:
        assert f"`{state.value}`" in sections()[KEYS.health]
    for kind in EventKind:
        assert f"`{kind.value}`" in sections()[KEYS.alarm_event]
    for field in ("events", "latest"):
        assert field in AlarmLogPage.model_fields
        assert f"`{field}`" in sections()[KEYS.alarm_event]


def test_the_follower_recipe_gets_each_event_once_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The program in the page, unchanged except for its address and end, against a service with alarms."""
    (recipe,) = re.findall(r"```python\n(.*?)```", sections()[KEYS.alarm_event], flags=re.DOTALL)
    address = endpoint()
    rounds: list[Callable[[], object]] = []

    genuine = time.sleep

    def sleep(duration_s: float) -> None:
        if duration_s < 0.5:  # not of the program: a test waits for a condition
            genuine(duration_s)
            return
        if not rounds:
            raise KeyboardInterrupt
        rounds.pop(0)()

    monkeypatch.setattr("time.sleep", sleep)
    monkeypatch.chdir(tmp_path)
    with service(address) as (_, worker), open_session(address) as session:
        feed = Feed(session)

        def gap() -> None:
            latest = worker.alarms().sequence
            feed.skip(60)
            feed.put_good(60)  # the first ones wait for the missing ones
            until(lambda: worker.alarms().sequence > latest, "an alarm event")

        feed.put_good()
        gap()
        for _ in range(2):  # the second run continues where the first stopped
            rounds += [lambda: None, gap]
            with pytest.raises(KeyboardInterrupt):
                exec(compile(recipe.replace("tcp/127.0.0.1:7447", address), str(PAGE), "exec"), {})  # noqa: S102
        log = [json.loads(event.text) for event in worker.history.events(limit=1000)]
    kept = [json.loads(line) for line in (tmp_path / "alarms.jsonl").read_text(encoding="utf-8").splitlines()]
    assert kept == log[: len(kept)]
    assert len(kept) >= 2


def test_settings_in_the_page_can_be_loaded(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "service.md").read_text(encoding="utf-8")
    (toml,) = re.findall(r"```toml\n(.*?)```", text, flags=re.DOTALL)
    (tmp_path / "plant.toml").write_text(toml, encoding="utf-8")
    (tmp_path / "pump-7-networks").mkdir()
    pump = (ROOT / "models/machines/lab.toml").read_text(encoding="utf-8").replace('name = "lab"', 'name = "pump-7"')
    (tmp_path / "pump-7.toml").write_text(pump, encoding="utf-8")
    read = load_settings(tmp_path / "plant.toml")
    assert [entry.load().name for entry in read.machines] == ["pump-7", "lab"]
    assert read.machines[0].bundle == str(tmp_path / "pump-7-networks")
    assert f"| `blocks` | {ServiceSettings().queue.blocks} |" in text


def write() -> None:
    """Put the examples of the models into the page."""
    page = PAGE.read_text(encoding="utf-8")
    for name, model in SENT.items():
        body = sections()[getattr(KEYS, name)]
        text = json.dumps(example(model), indent=2, ensure_ascii=False)
        page = page.replace(body, JSON_BLOCK.sub(lambda _, text=text: f"```json\n{text}\n```", body))  # type: ignore[misc]  # its default is no argument of sub
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    write()
