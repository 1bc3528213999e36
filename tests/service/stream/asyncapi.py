"""The topics as an AsyncAPI 3.0 document, generated from the published models; kept in ``docs/asyncapi.json``.

The document describes the monitor: it *sends* what it publishes and *receives* samples and queries. How keys, late
joiners and queries work on Zenoh is explained in ``docs/topics.md``.
"""

import json
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from models.signals.channels import ChannelDescriptor
from models.signals.keys import PREFIX, MachineKeys
from rotorwatch import __version__
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmLogPage, AlarmStates
from rotorwatch.records.example import example
from rotorwatch.records.health import Health, Report
from service.stream.transport import MOST_EVENTS

_JSON = "application/json"
_DESCRIPTION = """Which parameter of a rotating machine changed, by how much, how sure: what a rotorwatch monitor
receives and publishes over Zenoh. JSON is UTF-8; numbers are finite or null and carry their unit in their name;
`..._ns` are nanoseconds since 1970-01-01 UTC, data time. Replayed data have the same keys after the prefix of the
replay."""


@dataclass(frozen=True, slots=True)
class _Topic:
    """A key: what the monitor does with it, and the messages on it."""

    text: str
    action: Literal["send", "receive"] | None = None
    model: type[BaseModel] | None = None
    encoding: str = _JSON
    answered: bool = False


_TOPICS: dict[str, _Topic] = {
    "stream": _Topic("Sample blocks; docs/wire.md has the format.", "receive", None, "application/x-rotorwatch-block"),
    "descriptor": _Topic("Description of the stream's columns; also by query.", "receive", ChannelDescriptor),
    "truth": _Topic("What a simulator did to the machine; real machines send none, and no monitor listens."),
    "report": _Topic("One evaluated window. Dropped when the network is congested.", "send", Report),
    "health": _Topic(
        "Current health of the machine, whenever it changes; also by query.", "send", Health, answered=True
    ),
    "alarm_event": _Topic(
        "An alarm event: a CloudEvent with its sequence number in the machine's log, committed before it is sent. It "
        "may be received more than once, with the same number and id.",
        "send",
        AlarmCloudEvent,
        "application/cloudevents+json",
    ),
    "alarm_state": _Topic("Alarms that are not normal; also by query.", "send", AlarmStates, answered=True),
    "publisher_alive": _Topic("Liveliness token of the publisher of the stream; no payload."),
    "monitor_alive": _Topic("Liveliness token of the monitor; no payload."),
    "replay_alive": _Topic("Liveliness token of a replay on the machine's own keys; no payload."),
}


def asyncapi(truth: type[BaseModel]) -> dict[str, Any]:
    topics: dict[str, tuple[_Topic, type[BaseModel] | None]]
    topics = {name: (topic, truth if name == "truth" else topic.model) for name, topic in _TOPICS.items()}
    models = [model for _, model in topics.values() if model is not None]
    models.append(AlarmLogPage)
    sent: list[tuple[type[BaseModel], Literal["serialization"]]] = [(model, "serialization") for model in models]
    _, schemas = models_json_schema(sent, ref_template="#/components/schemas/{model}")
    document: dict[str, Any] = {
        "asyncapi": "3.0.0", "info": {"title": "rotorwatch", "version": __version__, "description": _DESCRIPTION},
        "defaultContentType": _JSON,
        "servers": {"monitor": {
            "host": "127.0.0.1:7447", "protocol": "zenoh",
            "description": "where a monitor listens unless its settings say otherwise",
        }},
        "channels": {}, "operations": {},
        "components": {
            "schemas": _draft_7(_named_apart(schemas["$defs"])), "messages": {},
            "parameters": {
                "site": {"description": "site of the machine", "examples": ["demo"]},
                "machine": {"description": "name of the machine", "examples": ["lab"]},
                "after": {"description": "only events after this sequence number; -1 for all", "default": "-1"},
                "limit": {"description": f"at most this many events, 1 to {MOST_EVENTS}", "default": "100"},
            },
        },
    }  # fmt: skip
    keys = MachineKeys("SITE", "MACHINE")
    for name, (topic, model) in topics.items():
        address = getattr(keys, name).replace(keys.root, f"{PREFIX}/{{site}}/{{machine}}")
        _add_topic(document, name, address, topic, model)
    _add_log(document)
    return document


def _add_topic(document: dict[str, Any], name: str, address: str, topic: _Topic, model: type[BaseModel] | None) -> None:
    channel = document["channels"][name] = _channel(address, topic.text)
    if name == "stream" or model is not None:
        message: dict[str, Any] = {"name": name, "contentType": topic.encoding, "payload": {}}
        if model is None:
            message["payload"] = {"type": "string", "format": "binary"}
        else:
            message["payload"] = _reference("schemas", model.__name__)
            if (shown := _shown(model)) is not None:
                message["examples"] = [{"payload": shown}]
        document["components"]["messages"][name] = message
        channel["messages"] = {name: _reference("messages", name)}
    if topic.action is not None:
        document["operations"][f"{topic.action}_{name}"] = {
            "action": topic.action,
            "summary": topic.text,
            "channel": {"$ref": f"#/channels/{name}"},
            "messages": [{"$ref": f"#/channels/{name}/messages/{name}"}],
        }
    if topic.answered:
        _add_question(document, name, name, f"A query is answered with the present {name}.")


def _add_log(document: dict[str, Any]) -> None:
    address = f"{document['channels']['alarm_event']['address']}?after={{after}};limit={{limit}}"
    channel = document["channels"]["alarm_log"] = _channel(address, "The alarm log from any event on, by query.")
    channel["parameters"] |= {name: _reference("parameters", name) for name in ("after", "limit")}
    channel["messages"] = {"alarm_log": _reference("messages", "alarm_log")}
    document["components"]["messages"]["alarm_log"] = {
        "name": "alarm_log",
        "contentType": _JSON,
        "payload": _reference("schemas", AlarmLogPage.__name__),
        "examples": [{"payload": example(AlarmLogPage)}],
    }
    _add_question(document, "alarm_log", "alarm_log", "A query is answered with the events after the given one.")


def _add_question(document: dict[str, Any], channel: str, message: str, text: str) -> None:
    """A query has no payload: the question is in the key and its parameters."""
    document["components"]["messages"]["question"] = {
        "name": "question",
        "summary": "A Zenoh query without payload.",
        "payload": {"type": "null"},
    }
    document["channels"][channel]["messages"]["question"] = _reference("messages", "question")
    document["operations"][f"answer_{channel}"] = {
        "action": "receive",
        "summary": text,
        "channel": {"$ref": f"#/channels/{channel}"},
        "messages": [{"$ref": f"#/channels/{channel}/messages/question"}],
        "reply": {
            "channel": {"$ref": f"#/channels/{channel}"},
            "messages": [{"$ref": f"#/channels/{channel}/messages/{message}"}],
        },
    }


def _channel(address: str, text: str) -> dict[str, Any]:
    parameters = {name: _reference("parameters", name) for name in ("site", "machine")}
    return {"address": address, "description": text, "parameters": parameters, "messages": {}}


def _reference(kind: str, name: str) -> dict[str, str]:
    return {"$ref": f"#/components/{kind}/{name}"}


def _shown(model: type[BaseModel]) -> dict[str, object] | None:
    """An example, where the model has examples of its fields."""
    try:
        return example(model)
    except TypeError:
        return None


def _named_apart(schemas: dict[str, Any]) -> dict[str, Any]:
    """Replace the names of modules that pydantic puts before models of the same name."""
    text = json.dumps(schemas)
    for name in schemas:
        *modules, last = name.split("__")
        if modules:
            shorter = last if modules[0] == "service" else f"{modules[-1].title()}{last}"
            text = text.replace(f'/{name}"', f'/{shorter}"').replace(f'"{name}":', f'"{shorter}":')
    found: dict[str, Any] = json.loads(text)
    return found


def _draft_7(schema: Any) -> Any:
    """Convert pydantic's schemas of tuples from JSON Schema 2020-12 to draft 7."""
    if isinstance(schema, list):
        return [_draft_7(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    renamed = {("items" if key == "prefixItems" else key): _draft_7(value) for key, value in schema.items()}
    if "prefixItems" in schema:
        renamed["additionalItems"] = False
    return renamed
