"""Names of the Zenoh keys of one machine, and who may do what with them: grants, and the access control they stand for.

``docs/topics.md`` lists the keys with example payloads. Zenoh judges every message at the program that has the rules,
by its kind, its direction and its key. *Ingress* is what comes from the partner, *egress* what goes to it::

    partner          publisher              monitor                      viewer
    ingress   put, reply, token:     put, reply, token: report,   subscribe, query,
              stream, descriptor,    health, alarms;              liveliness: report,
              truth                  subscribe, query: all        health, alarms
    egress    who listens, who asks  put, reply, token: all       put, reply, token of these

A late joiner fetches what it missed below ``<key>/@adv/``: whoever may publish or read a key may do so there too. In
keys, ``**`` does not stand for a part that begins with ``@``, so both are written out.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, Field, model_validator

from models.errors import MachineFileError

PREFIX = "rotorwatch"
NAME_PATTERN = "[A-Za-z0-9][A-Za-z0-9_-]{0,63}"
"""Names of sites and machines."""

Topic = Literal["report", "alarm_event", "alarm_state", "health"]
"""What a monitor publishes, by the names of the fields of `MachineKeys`."""


class Key:
    """A key below the root of all keys of a machine."""

    def __init__(self, below: str) -> None:
        self._below = below

    def __get__(self, keys: "MachineKeys", _: type) -> str:
        return f"{keys.root}/{self._below}"


@dataclass(frozen=True, slots=True)
class MachineKeys:
    """Keys under ``rotorwatch/<site>/<machine>/``.

    Examples
    --------
    >>> MachineKeys("lab", "rig1").stream
    'rotorwatch/lab/rig1/stream'
    """

    site: str
    machine: str

    def __post_init__(self) -> None:
        for field, value in (("site", self.site), ("machine", self.machine)):
            if not re.fullmatch(NAME_PATTERN, value):
                why = "use 1 to 64 letters, digits, '_' or '-'"
                raise MachineFileError(f"{field} name {value!r} cannot be part of a key: {why}")

    @property
    def root(self) -> str:
        """What all keys of the machine start with."""
        return f"{PREFIX}/{self.site}/{self.machine}"

    stream = Key("stream")  # sample blocks
    descriptor = Key("descriptor")  # channel descriptor (JSON), also by query
    truth = Key("truth")  # what the simulator did to the machine (JSON); real machines have none
    report = Key("report")  # one monitor report per evaluated window (JSON)
    health = Key("health")  # current health (JSON), also by query
    alarm_event = Key("alarm/event")  # alarm transitions (CloudEvents JSON)
    alarm_state = Key("alarm/state")  # all alarms that are not normal (JSON), also by query
    publisher_alive = Key("alive/publisher")  # liveliness token of whoever publishes the stream
    monitor_alive = Key("alive/monitor")  # liveliness token of the monitor that watches the machine
    # Liveliness token of a replay on the machine's own keys, which monitors state and do not evaluate.
    replay_alive = Key("alive/replay")


_Flow = Literal["ingress", "egress"]
_USER = re.compile(r"[^\s:]+")
_PLACE = re.compile(rf"(\*|{NAME_PATTERN})/(\*|{NAME_PATTERN})")
_MODEL = MachineKeys("s", "m")


def _topics(*keys: str) -> tuple[str, ...]:
    return tuple(key.removeprefix(_MODEL.root) for key in keys)


_DATA = _topics(_MODEL.stream, _MODEL.descriptor, _MODEL.truth)
_RESULTS = _topics(_MODEL.report, _MODEL.health, _MODEL.alarm_event, _MODEL.alarm_state)
_HEALTH = _topics(_MODEL.health)
_PUBLISHER_ALIVE, _MONITOR_ALIVE = _topics(_MODEL.publisher_alive), _topics(_MODEL.monitor_alive)
_ALIVE = ("/alive/**",)
_ALL = ("/**", "/**/@adv/**")
_LISTENED = ("declare_subscriber", "query")
_LIVELINESS = ("declare_liveliness_subscriber", "liveliness_query")
# These tell a partner who listens and who asks. They neither read nor write data, and without them nothing is sent.
_INTERESTS = (*_LISTENED, "declare_queryable", *_LIVELINESS)


def _name(text: str) -> str:
    if not _USER.fullmatch(text):
        raise ValueError("expected a user name or the common name of a certificate, without spaces and colons")
    return text


def _place(text: str) -> str:
    if not _PLACE.fullmatch(text):
        raise ValueError('expected "site/machine", where * alone stands for any, such as "demo/lab" or "demo/*"')
    return text


_Places = tuple[Annotated[str, AfterValidator(_place)], ...]


class Grant(BaseModel, extra="forbid", frozen=True):
    """What some users, or owners of certificates, may do; everything else is refused to them."""

    who: tuple[Annotated[str, AfterValidator(_name)], ...] = Field(
        min_length=1, description="user names, where there are passwords; else common names of certificates"
    )
    publishes: _Places = Field(default=(), description="machines whose stream, descriptor and truth they may send")
    views: _Places = Field(default=(), description="machines whose reports, health and alarms they may read")
    monitors: _Places = Field(
        default=(), description="machines of which they may read everything and say how they are: for monitors"
    )

    @model_validator(mode="after")
    def _check_not_empty(self) -> Self:
        if not (self.publishes or self.views or self.monitors):
            raise ValueError("the grant allows nothing: expected publishes, views or monitors")
        return self


def access_control(grants: Sequence[Grant], known_by: Literal["usernames", "cert_common_names"]) -> dict[str, object]:
    """Zenoh's ``access_control`` for these grants: what none of them allows is dropped.

    `known_by` says what the names in `Grant.who` are.
    """
    rules: list[dict[str, object]] = []
    allowed: dict[str, list[str]] = {}
    for grant in grants:
        begin = len(rules)
        for flow, messages, keys in _rules(grant):
            allows = {"permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": list(keys)}
            rules.append({"id": f"rule {len(rules)}", **allows})
        for name in grant.who:
            allowed.setdefault(name, []).extend(f"rule {number}" for number in range(begin, len(rules)))
    # One subject for each name: if several fitted a partner, Zenoh would take only one.
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, known_by: [name]} for name in allowed],
        "policies": [{"subjects": [name], "rules": list(dict.fromkeys(ids))} for name, ids in allowed.items()],
    }


def _rules(grant: Grant) -> list[tuple[_Flow, tuple[str, ...], list[str]]]:
    placed = (grant.publishes, grant.views, grant.monitors)
    publishes, views, monitors = ([f"{PREFIX}/{place}" for place in places] for places in placed)
    rules: list[tuple[_Flow, tuple[str, ...], list[str]]] = []
    if publishes:
        rules += [
            ("ingress", ("put", "reply", "declare_queryable"), _with_recovery(publishes, _DATA)),
            ("ingress", ("liveliness_token",), _at(publishes, _PUBLISHER_ALIVE) + _recovery(publishes, _DATA, "pub")),
            # An answer to this says that a monitor has received what was sent before it.
            ("ingress", ("query",), _at(publishes, _HEALTH)),
            ("egress", ("reply",), _at(publishes, _HEALTH)),
        ]
    if views:
        rules += [
            ("ingress", _LISTENED, _with_recovery(views, _RESULTS)),
            ("egress", ("put", "reply", "declare_queryable"), _with_recovery(views, _RESULTS)),
            ("ingress", _LIVELINESS, _at(views, _ALIVE) + _recovery(views, _RESULTS)),
            ("egress", ("liveliness_token",), _at(views, _ALIVE) + _recovery(views, _RESULTS)),
            ("ingress", ("liveliness_token",), _recovery(views, _RESULTS, "sub")),
        ]
    if monitors:
        recovery = _recovery(monitors, _RESULTS, "pub") + _recovery(monitors, (*_DATA, *_RESULTS), "sub")
        rules += [
            ("ingress", (*_LISTENED, *_LIVELINESS), _at(monitors, _ALL)),
            ("egress", ("put", "reply", "liveliness_token"), _at(monitors, _ALL)),
            ("ingress", ("put", "reply", "declare_queryable"), _with_recovery(monitors, _RESULTS)),
            ("ingress", ("liveliness_token",), _at(monitors, _MONITOR_ALIVE) + recovery),
        ]
    if publishes or monitors:
        rules.append(("egress", _INTERESTS, _at([PREFIX], _ALL)))
    return rules


def _at(roots: Sequence[str], topics: Sequence[str]) -> list[str]:
    return [f"{root}{topic}" for root in roots for topic in topics]


def _recovery(roots: Sequence[str], topics: Sequence[str], side: Literal["", "pub", "sub"] = "") -> list[str]:
    """Keys of the caches and heartbeats beside the topics, or the tokens of one side."""
    below = f"@adv/{side}/**" if side else "@adv/**"
    return [f"{key}/{below}" for key in _at(roots, topics)]


def _with_recovery(roots: Sequence[str], topics: Sequence[str]) -> list[str]:
    return _at(roots, topics) + _recovery(roots, topics)
