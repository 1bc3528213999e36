"""Running services that the tests of the API talk to: one that has seen a fault, and one that is fed by hand."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import httpx
from pydantic import BaseModel

from models.machine import load_machine
from rotorwatch.records.monitor import Problem
from service.access.scopes import Scope
from service.access.tokens import new_token
from service.runtime.runtime import Runtime, running
from service.settings.access import AccessSettings, LimitSettings
from service.settings.service import RecordingSettings
from service.stream.worker import MachineWorker
from simulator.scenario import parse_fault
from tests.service.rig.live import (
    IN_ORDER,
    OPEN,
    PATIENT,
    Feed,
    endpoint,
    feeding,
    machine_file,
    scenario_blocks,
    send,
    settings,
    until,
    worker_of,
)

PLACE = "/api/v1/machines/demo/lab"
GUARDED = AccessSettings(
    limits=LimitSettings(requests_per_minute=1_000_000, failures_per_minute=100_000, refusals_recorded_per_minute=1000)
)

M = TypeVar("M", bound=BaseModel)


@contextmanager
def faulty(folder: Path, access: AccessSettings = OPEN) -> Iterator[tuple[Runtime, MachineWorker]]:
    """The lab machine without a third of its horizontal bearing stiffness, 78 s of data, alarms after 10 s."""
    address = endpoint()
    file = machine_file(folder, ("on_delay_s = 5.0", "on_delay_s = 10.0"), PATIENT)
    (folder / "recordings").mkdir(exist_ok=True)
    kept = RecordingSettings(directory=str(folder / "recordings"))
    with running(settings(address, file, bundle="lab", when_full="wait", access=access, recording=kept)) as runtime:
        worker = worker_of(runtime)
        send(address, scenario_blocks(78.0, parse_fault("k_by=-0.33@0")), load_machine(file))
        until(lambda: worker.health().quality.accepted_blocks == 780, "all blocks")
        until(lambda: worker.history.evidence("k_by") is not None, "evidence of the alarm, which another thread keeps")
        yield runtime, worker


@contextmanager
def fed(folder: Path, access: AccessSettings = OPEN, *lines: tuple[str, str]) -> Iterator[tuple[Runtime, Feed]]:
    """The lab machine, fed by the test; a gap of a second raises an alarm at once."""
    with feeding(
        settings(endpoint(), machine_file(folder, IN_ORDER, *lines), when_full="wait", access=access)
    ) as found:
        yield found


def token(runtime: Runtime, *scopes: Scope, name: str = "anna") -> str:
    record, text = new_token(name, scopes or Scope, now_ns=time.time_ns())
    runtime.store.tokens.add(record)
    return text


def client(runtime: Runtime, text: str = "") -> httpx.Client:
    headers = {"authorization": f"Bearer {text}"} if text else {}
    return httpx.Client(base_url=runtime.http_url, trust_env=False, headers=headers, timeout=180.0)


def answered(answer: httpx.Response, model: type[M]) -> M:
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/json"
    return model.model_validate_json(answer.content)


def problem(answer: httpx.Response, status: int) -> Problem:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    found = Problem.model_validate_json(answer.content)
    assert (found.status, found.instance) == (status, answer.request.url.path)
    return found
