"""The AsyncAPI document agrees with the models and with what a running service sends.

``python -m tests.service.stream.test_asyncapi`` writes it anew.
"""

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest

from models.machine import load_machine
from models.signals.keys import Key, MachineKeys
from models.signals.link import LinkSettings
from service.runtime.runtime import running
from service.stream.transport import route
from simulator.publisher import PublishSettings, publish
from simulator.scenario import load_scenario, parse_fault
from simulator.stream import TruthRecord, blocks
from tests.service.rig.live import (
    LAB,
    PATIENT,
    ROOT,
    START_NS,
    endpoint,
    machine_file,
    open_session,
    settings,
    until,
    worker_of,
)
from tests.service.stream.asyncapi import asyncapi
from tests.sure import sure

PAGE = ROOT / "docs" / "asyncapi.json"
DOCUMENT = asyncapi(TruthRecord)
KEYS = MachineKeys("demo", "lab")


def written() -> str:
    return json.dumps(DOCUMENT, indent=2, ensure_ascii=False) + "\n"


def resolved(reference: str) -> Any:
    """Target of a reference of the document; KeyError if there is none."""
    assert reference.startswith("#/")
    found: Any = DOCUMENT
    for part in reference[2:].split("/"):
        found = found[part]
    return resolved(found["$ref"]) if "$ref" in found else found


def references(part: Any) -> Iterator[str]:
    if isinstance(part, dict):
        for key, value in part.items():
            if key == "$ref":
                yield value
            yield from references(value)
    elif isinstance(part, list):
        for value in part:
            yield from references(value)


def checker(message: str) -> jsonschema_rs.Draft7Validator:
    """Validator of payloads of a message of the document."""
    payload = DOCUMENT["components"]["messages"][message]["payload"]
    return jsonschema_rs.Draft7Validator({**payload, "components": DOCUMENT["components"]})


def test_the_document_in_the_repository_is_up_to_date() -> None:
    assert PAGE.read_text(encoding="utf-8") == written(), "python -m tests.service.stream.test_asyncapi writes it anew"


def test_every_key_is_a_channel() -> None:
    names = {name for name, value in vars(MachineKeys).items() if isinstance(value, Key)}
    assert set(DOCUMENT["channels"]) == names | {"alarm_log"}
    for name in names:
        address = DOCUMENT["channels"][name]["address"]
        assert address.replace("{site}", "demo").replace("{machine}", "lab") == getattr(KEYS, name)


def test_the_structure_follows_the_asyncapi_specification() -> None:
    """Requirements of the specification that this document could break; the rest is checked by hand."""
    for reference in references(DOCUMENT):
        assert resolved(reference) is not None
    for name, channel in DOCUMENT["channels"].items():
        placeholders = {part.split("}")[0] for part in channel["address"].split("{")[1:]}
        assert placeholders == set(channel["parameters"]), name
    assert all(name.isidentifier() for name in DOCUMENT["operations"])
    for name, operation in DOCUMENT["operations"].items():
        assert operation["action"] in {"send", "receive"}
        for one in (operation, *([operation["reply"]] if "reply" in operation else [])):
            for message in one["messages"]:
                assert message["$ref"].startswith(one["channel"]["$ref"] + "/messages/"), name
    for schema in DOCUMENT["components"]["schemas"].values():
        jsonschema_rs.meta.validate({"$schema": "http://json-schema.org/draft-07/schema#", **schema})
    assert "prefixItems" not in written()
    assert not any("__" in name for name in DOCUMENT["components"]["schemas"])


def test_examples_are_valid() -> None:
    shown = {name for name, message in DOCUMENT["components"]["messages"].items() if "examples" in message}
    assert shown >= {"report", "health", "alarm_event", "alarm_state", "alarm_log"}
    for name in shown:
        for one in DOCUMENT["components"]["messages"][name]["examples"]:
            checker(name).validate(one["payload"])


@pytest.fixture(scope="module")
def heard(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Everything on the keys of a simulated machine with a fault, and replies to queries."""
    address, found, lock = endpoint(), dict[str, list[str]](), threading.Lock()
    file = machine_file(tmp_path_factory.mktemp("machine"), ("on_delay_s = 5.0", "on_delay_s = 0.0"), PATIENT)
    scenario, machine = load_scenario("healthy")
    scenario = scenario.overridden(duration_s=70.0, seed=3, faults=(parse_fault("k_by=-0.33@5"),))
    names = {getattr(KEYS, name): name for name in DOCUMENT["channels"] if name != "alarm_log"}

    def take(key: str, text: bytes) -> None:
        with lock:
            found.setdefault(names[key], []).append(text.decode() if names[key] != "stream" else "")

    link = LinkSettings(mode="client", connect=(address,))
    plant = settings(address, file, bundle="lab", when_full="wait", link=link)
    with route(LinkSettings(listen=(address,))), running(plant) as runtime, open_session(address, "client") as session:
        worker = worker_of(runtime)
        session.declare_subscriber(
            f"{LAB.keys.root}/**", lambda sample: take(str(sample.key_expr), sample.payload.to_bytes())
        )
        plan = PublishSettings(link=link, pace=None, wait_for_subscriber_s=20.0, linger_s=0.0, drain_s=20.0)
        publish(load_machine(file), blocks(scenario, machine, start_ns=START_NS, run=1), plan)
        until(lambda: worker.health().quality.accepted_blocks == 700, "all blocks")
        until(lambda: len(found.get("alarm_event", [])) == worker.alarms().sequence + 1 > 0, "alarm events")
        until(lambda: len(found.get("report", [])) == worker.tally.windows, "reports")
        for name, selector in (
            ("health", KEYS.health),
            ("alarm_state", KEYS.alarm_state),
            ("alarm_log", f"{KEYS.alarm_event}?after=-1;limit=1000"),
        ):
            (reply,) = session.get(selector, timeout=60.0)
            found.setdefault(name, []).append(sure(reply.ok).payload.to_string())
    return found


@pytest.mark.parametrize("name", ["descriptor", "truth", "report", "health", "alarm_event", "alarm_state", "alarm_log"])
def test_messages_match_the_schemas_of_the_document(heard: dict[str, list[str]], name: str) -> None:
    assert set(heard) == {name for name, channel in DOCUMENT["channels"].items() if channel["messages"]}
    assert set(heard) == set(DOCUMENT["components"]["messages"]) - {"question"}
    check = checker(name)
    for text in heard[name]:
        check.validate(json.loads(text))
    first = json.loads(heard[name][0])
    # The schema is not empty: a missing field, an extra field and a wrong type are noticed.
    for field in first:
        assert not check.is_valid({key: value for key, value in first.items() if key != field} | {"x": 1})
    assert not check.is_valid([first])


if __name__ == "__main__":
    Path(PAGE).write_text(written(), encoding="utf-8")
