"""Readiness: a fault makes it 503 with the reason, and its repair 200 again."""

import sqlite3
import threading
from functools import partial
from pathlib import Path

import httpx
import pytest

from rotorwatch.records.health import HealthState
from rotorwatch.records.monitor import MachineReadiness, Readiness
from service.history.store import Store
from service.runtime.runtime import Runtime, readiness_of, running
from service.settings.service import ServiceSettings
from service.stream.liveness import Pulse
from tests.service.delivery.hooked import hook, settings_for
from tests.service.delivery.test_metrics import parsed
from tests.service.rig.live import IN_ORDER, endpoint, feeding, ignore, kept_in, machine_file, service, settings, until
from tests.service.rig.monitored import client


def asked(runtime: Runtime) -> tuple[int, Readiness]:
    with client(runtime) as http:
        answer = http.get("/readyz")
    fields = {name: value for name, value in answer.json().items() if name in Readiness.model_fields}
    return answer.status_code, Readiness.model_validate(fields)


def test_not_ready_while_the_history_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "history.sqlite"
    # As the runtime makes it, but with shorter timeouts of the database.
    monkeypatch.setattr("service.runtime.runtime.Store", partial(Store, timeout_s=2.0, retry_s=0.05))
    plan = settings(endpoint(), machine_file(tmp_path, IN_ORDER), when_full="wait", history=kept_in(tmp_path))
    with feeding(plan) as (runtime, feed):
        assert asked(runtime) == (200, runtime.readiness())  # no data have come yet, so nothing is in flight
        assert runtime.readiness().ready
        feed.put_good()
        until(lambda: runtime.machines()[0].health().quality.accepted_blocks == 1, "the first block")
        blocker = sqlite3.connect(file, isolation_level=None)  # another program that keeps the file locked
        blocker.execute("BEGIN IMMEDIATE")
        feed.skip()
        feed.put_good()  # an alarm on the gap, which must be written
        until(lambda: not runtime.readiness().ready, "trouble")
        status, found = asked(runtime)
        assert (status, found.history_open, found.session_open) == (503, True, True)
        assert str(file) in found.history_trouble
        assert found.reasons == (f"the history cannot be written; events wait in memory: {found.history_trouble}",)
        assert found.machines[0].history_waiting >= 1
        read = parsed(runtime.metrics.text().decode())
        assert (read("ready"), read("history_failing")) == (0.0, 1.0)
        assert read.of_lab("history_waiting_steps") >= 1.0
        assert read.of_lab("alarm_events_total", kind="raised") == 0.0  # it is not in the history yet
        blocker.execute("ROLLBACK")
        blocker.close()
        until(lambda: runtime.readiness().ready, "recovery")
        status, found = asked(runtime)
        assert (status, found.reasons, found.machines[0].history_waiting) == (200, (), 0)
        read = parsed(runtime.metrics.text().decode())
        assert (read("ready"), read.of_lab("alarm_events_total", kind="raised")) == (1.0, 1.0)


def test_not_ready_while_a_worker_is_stuck_or_after_it_has_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.runtime.runtime.STUCK_S", 0.5)
    release = threading.Event()
    with service(endpoint()) as (runtime, worker):
        until(lambda: worker.status().alive, "the thread")
        assert asked(runtime)[0] == 200
        worker.inbox.call(lambda: ignore(release.wait(600.0)))
        until(lambda: not runtime.readiness().ready, "the thread that does not answer")
        status, found = asked(runtime)
        assert status == 503
        assert found.machines[0].worker_alive
        assert found.machines[0].worker_busy_s > 0.5
        (reason,) = found.reasons
        assert reason.startswith("demo/lab: one block has been in the monitor for ")
        release.set()
        until(lambda: runtime.readiness().ready, "the thread that goes on")
        assert asked(runtime)[0] == 200
        worker.stop()
        assert runtime.readiness().reasons == ("demo/lab: the thread that evaluates its blocks has stopped",)
        assert asked(runtime)[0] == 503
        assert httpx.get(f"{runtime.http_url}/healthz", trust_env=False, timeout=180.0).json() == {"alive": True}


def test_failing_webhooks_do_not_affect_readiness(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.delivery.webhooks.dispatcher._QUIET_S", 1e6)  # only a wake-up ends their sleep
    machine = machine_file(tmp_path, IN_ORDER)
    with hook(lambda _: (503, {})) as receiver:
        plan = settings(endpoint(), machine, when_full="wait", webhooks=(settings_for(receiver, tmp_path),))
        with feeding(plan) as (runtime, feed):
            feed.gap()
            until(lambda: runtime.readiness().failing_webhooks != (), "the webhook that fails")
            status, found = asked(runtime)
            assert (status, found.failing_webhooks) == (200, ("pager: 503 Service Unavailable",))
            assert found.machines[0].recording == "off"


def test_no_webhook_is_sent_by_a_monitor_of_a_replay(tmp_path: Path) -> None:
    """A monitor in a namespace evaluates a recording, whose alarms are not current."""
    with hook() as receiver:
        plan = settings(endpoint(), webhooks=(settings_for(receiver, tmp_path),))
        assert started(plan) == ["pager"]
        link = plan.link.model_copy(update={"namespace": "replay/monday"})
        assert started(plan.model_copy(update={"link": link})) == []


def started(plan: ServiceSettings) -> list[str]:
    with running(plan) as runtime:
        return [status.name for status in runtime.webhooks.statuses().webhooks]


def machine(**changes: object) -> MachineReadiness:
    fields: dict[str, object] = {
        "site": "demo", "machine": "lab", "state": HealthState.NO_DATA, "worker_alive": True, "worker_errors": 3,
        "last_worker_error": "ValueError", "worker_busy_s": 59.9, "trouble": "", "history_waiting": 4,
        "recording": "failing: full",
    }  # fmt: skip
    return MachineReadiness.model_validate(fields | changes)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"machines": [machine(), machine(machine="pump", trouble="no window")]}, "demo/pump: no window"),
        ({"session_open": False}, "the Zenoh session is closed: nothing arrives and nothing is published"),
        ({"history_open": False}, "the history is not open, or its tables are not up to date"),
        ({"history_trouble": "disk full"}, "the history cannot be written; events wait in memory: disk full"),
    ],
)
def test_each_reason_for_not_being_ready_is_a_sentence(change: dict[str, object], reason: str) -> None:
    good: dict[str, object] = {
        "session_open": True, "history_open": True, "history_trouble": "", "history_lost": "",
        "failing_webhooks": ("pager: 404",), "machines": [machine()],
    }  # fmt: skip
    assert readiness_of(**good).ready  # type: ignore[arg-type]  # as below
    found = readiness_of(**(good | change))  # type: ignore[arg-type]  # fields of any kind
    assert (found.ready, found.reasons) == (False, (reason,))


def test_a_pulse_that_cannot_be_sent_does_not_count_as_busy() -> None:
    pulse = Pulse(lambda _: False, lambda: None, clock=iter([1.0, 100.0]).__next__)
    pulse.beat()
    assert pulse.busy_s == 0.0
