"""Metrics of a running service agree with what happened, and their page in the documentation lists all of them."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import prometheus_client
import pytest
from prometheus_client.parser import text_string_to_metric_families

from service.access.scopes import Scope
from service.delivery.metrics import Observed, machine_families
from service.history.records import StoreError
from service.monitor.reports import Tally
from service.runtime.runtime import Runtime, running
from service.settings.service import RecordingSettings
from tests.service.delivery.hooked import hook, settings_for
from tests.service.rig.live import IN_ORDER, ROOT, endpoint, feeding, kept_in, machine_file, settings, until
from tests.service.rig.monitored import GUARDED, PLACE, client, token
from tests.sure import sure

LAB = {"site": "demo", "machine": "lab"}


@dataclass(frozen=True)
class Read:
    samples: Mapping[tuple[str, frozenset[tuple[str, str]]], float]
    kinds: Mapping[str, str]

    def __call__(self, name: str, **labels: str) -> float:
        return self.samples[f"rotorwatch_{name}", frozenset(labels.items())]

    def of_lab(self, name: str, **labels: str) -> float:
        return self(name, **LAB, **labels)

    def labels(self, name: str) -> set[str]:
        return {label for sample, labels in self.samples for label, _ in labels if base(sample) == base(name)}

    def series(self, **labels: str) -> int:
        return sum(labels.items() <= set(there) for _, there in self.samples)


def base(name: str) -> str:
    return re.sub(r"_(count|sum)$", "", name)


def parsed(text: str) -> Read:
    families = list(text_string_to_metric_families(text))
    samples = [sample for family in families for sample in family.samples]
    found = {(sample.name, frozenset(sample.labels.items())): sample.value for sample in samples}
    assert len(found) == len(samples)
    kinds = {f"{one.name}_total" if one.type == "counter" else one.name: one.type for one in families}
    return Read(found, kinds)


def scraped(runtime: Runtime, text: str) -> Read:
    with client(runtime, text) as http:
        answer = http.get("/metrics")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "text/plain; version=1.0.0; charset=utf-8"
    return parsed(answer.text)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("measured")


@pytest.fixture(scope="module")
def served(folder: Path) -> Iterator[tuple[Runtime, str, Read]]:
    """12 good blocks, one repeated, one with a NaN, 3 s missing, 2 good blocks; recorded."""
    (folder / "recordings").mkdir()
    with hook() as receiver:
        plan = settings(
            endpoint(), machine_file(folder, IN_ORDER), when_full="wait", access=GUARDED, history=kept_in(folder),
            recording=RecordingSettings(directory=str(folder / "recordings")),
            webhooks=(settings_for(receiver, folder),),
        )  # fmt: skip
        with feeding(plan) as (runtime, feed):
            worker = runtime.machines()[0]
            feed.put_good(12)
            twice = feed.block(sequence=feed.sequence - 1, start_ns=feed.start_ns - 300_000_000)
            feed.put(twice)
            samples = feed.samples()
            samples[3, 1] = np.nan
            feed.put(feed.block(samples=samples))
            feed.skip()
            feed.put_good()
            feed.put_good()
            until(lambda: worker.health().quality.accepted_blocks == 14, "the last block")
            until(lambda: worker.history.last_sequence >= 0, "the alarm on the gap")
            until(lambda: runtime.webhooks.statuses().webhooks[0].delivered == 1, "delivery")
            scraped(runtime, token(runtime, Scope.READ, name="before"))  # which is a request itself
            yield runtime, token(runtime, Scope.READ), scraped(runtime, token(runtime, Scope.READ, name="first"))


@pytest.fixture(scope="module")
def read(served: tuple[Runtime, str, Read]) -> Read:
    return served[2]


def test_data_and_alarms_are_counted(read: Read, served: tuple[Runtime, str, Read]) -> None:
    worker = served[0].machines()[0]
    quality = worker.health().quality
    assert read.of_lab("blocks_accepted_total") == 14
    assert {reason: read.of_lab("blocks_refused_total", reason=reason) for reason in quality.refused_blocks} == {
        reason: float(count) for reason, count in quality.refused_blocks.items()
    }
    assert sum(quality.refused_blocks.values()) == 2
    assert "not-finite" in quality.refused_blocks
    assert read.of_lab("data_seconds_total") == pytest.approx(1.4)
    assert read.of_lab("gaps_total") == quality.gaps == 1
    assert read.of_lab("missing_seconds_total") == pytest.approx(3.0)
    assert read.of_lab("step_seconds_count") == 16
    assert 0.0 < read.of_lab("step_seconds_sum") == pytest.approx(worker.status().tally.step_s)
    assert read.of_lab("commit_seconds_total") == pytest.approx(worker.status().tally.commit_s) != 0.0
    assert read.of_lab("windows_total") == worker.status().tally.windows
    assert read.of_lab("window_filled_ratio") == worker.health().filled
    assert read.of_lab("data_age_seconds") >= 0.0
    for name in ("queue_blocks", "queue_dropped_blocks_total", "link_missed_blocks_total", "publisher_alive",
                 "worker_errors_total", "history_waiting_steps", "lag_seconds", "restored_at_start"):  # fmt: skip
        assert read.of_lab(name) == 0.0, name
    assert read.of_lab("worker_alive") == read.of_lab("alarms", state="unacknowledged", severity="alert") == 1.0
    assert read.of_lab("alarms", state="acknowledged", severity="alert") == read.of_lab("alarm_sequence") == 0.0
    assert read.of_lab("alarm_events_total", kind="raised") == 1.0
    assert read.of_lab("alarm_events_total", kind="shelved") == 0.0
    states = {state: value for (name, labels), value in read.samples.items() for label, state in labels
              if name == "rotorwatch_machine_state" and label == "state"}  # fmt: skip
    assert (states.pop(worker.health().state.value), set(states.values())) == (1.0, {0.0})
    identity = worker.identity
    assert read.of_lab("machine_info", bundle="", machine_hash=identity["machine_hash"]) == 1.0


def test_waiting_blocks_are_exported_as_a_lag_in_seconds(served: tuple[Runtime, str, Read]) -> None:
    worker = served[0].machines()[0]
    waiting = replace(worker.status(), queue_blocks=40, tally=Tally(blocks=16, data_s=1.4))  # two of them refused
    health = worker.health()
    quality = health.quality.model_copy(update={"accepted_blocks": 14})
    seen = Observed(worker, health.model_copy(update={"quality": quality}), waiting, {})
    families = {one.name: one for one in machine_families([seen])}
    assert [one.value for one in families["rotorwatch_lag_seconds"].samples] == [pytest.approx(4.0)]


def test_recorder_webhook_and_process_metrics(read: Read, served: tuple[Runtime, str, Read]) -> None:
    recorder = sure(served[0].machines()[0].status().recorder)
    assert (read.of_lab("recorder_state", state="recording"), read.of_lab("recorder_state", state="off")) == (1.0, 0.0)
    assert 16 <= read.of_lab("recorder_received_messages_total") <= recorder.received
    assert read("ready") == read("session_open") == 1.0
    assert (read("history_failing"), read("webhook_delivered_events_total", webhook="pager")) == (0.0, 1.0)
    assert read("webhook_pending_events", webhook="pager") == 0.0
    assert read("webhook_failed_attempts_total", webhook="pager") == 0.0
    assert read("webhook_state", webhook="pager", state="working") == 1.0
    assert read("webhook_state", webhook="pager", state="disabled") == 0.0
    latest_ns = served[0].webhooks.statuses().webhooks[0].last_delivered_ns
    assert read("webhook_delivery_timestamp_seconds", webhook="pager") == pytest.approx((latest_ns or 0) / 1e9)
    assert ("process_resident_memory_bytes", frozenset()) in read.samples
    assert not any("rotorwatch" in name for name in prometheus_client.REGISTRY._names_to_collectors)


def test_requests_and_refusals_are_counted_by_route(served: tuple[Runtime, str, Read]) -> None:
    runtime, text, _ = served
    operator = token(runtime, Scope.OPERATE, name="operator")
    before = scraped(runtime, text)
    with client(runtime, text) as http, client(runtime, operator) as other, client(runtime) as stranger:
        for _ in range(3):
            assert http.get(f"{PLACE}/health").status_code == 200
        assert http.get("/api/v1/machines/demo/pump/health").status_code == 404
        assert (http.get("/nothing/here").status_code, http.request("BREW", "/metrics").status_code) == (404, 405)
        assert other.get(f"{PLACE}/health").status_code == 403
        assert stranger.get(f"{PLACE}/health").status_code == 401
        assert http.post("/metrics", json={}, headers={"origin": "https://elsewhere.example"}).status_code == 403
    after = scraped(runtime, text)
    more = {key: value - before.samples.get(key, 0.0) for key, value in after.samples.items() if "_http_" in key[0]}
    route = "/api/v1/machines/{site}/{machine}/health"
    expected = {
        ("GET", route, "200"): 3, ("GET", route, "404"): 1, ("GET", route, "403"): 1, ("GET", "-", "404"): 1,
        ("other", "/metrics", "405"): 1, ("GET", "-", "401"): 1, ("POST", "-", "403"): 1,
        ("GET", "/metrics", "200"): 1,  # the scrape before
    }  # fmt: skip
    found = {
        (labels["method"], labels["route"], labels["status"]): count
        for (name, pairs), count in more.items()
        if count and "status" in (labels := dict(pairs))
    }
    assert found == expected
    refused = {dict(pairs)["reason"]: count for (name, pairs), count in more.items() if "refused" in name}
    assert refused == {"token": 1, "scope": 1, "origin": 1, "rate": 0}


def test_the_page_lists_every_metric_with_its_labels_and_type_and_no_other(read: Read) -> None:
    page = (ROOT / "docs/metrics.md").read_text(encoding="utf-8")
    listed = {}
    for name, labels, kind in re.findall(r"^\| `(rotorwatch_\w+)` \| ([^|]*)\| (\w+) \|", page, re.MULTILINE):
        named = set(re.findall(r"`(\w+)`", labels)) | (set(LAB) if "machine" in labels.split(",")[0] else set())
        listed[name] = (named, kind)
    real = {}
    for name, kind in read.kinds.items():
        if name.startswith("rotorwatch_"):
            real[name] = (read.labels(name), kind)
    assert real["rotorwatch_blocks_refused_total"][0]  # or the comparison would be empty
    del listed["rotorwatch_level"], real["rotorwatch_level"]  # without a hop there are none: test_installation_cli
    assert listed == real
    for name in re.findall(r"rotorwatch_\w+", page):
        assert name in read.kinds, name
    (stated,) = re.findall(r"about (\d+) series", page)
    assert abs(read.series(**LAB) - int(stated)) <= 5


def test_webhook_status_over_http_hides_the_path_and_needs_read(served: tuple[Runtime, str, Read]) -> None:
    runtime, text, _ = served
    with client(runtime, text) as http:
        (webhook,) = http.get("/api/v1/webhooks").raise_for_status().json()["webhooks"]
        described = http.get("/openapi.json").raise_for_status().json()["paths"]
    assert (webhook["name"], webhook["state"], webhook["delivered"]) == ("pager", "working", 1)
    assert "/hook" not in webhook["target"]
    assert {"/metrics", "/api/v1/webhooks"} <= set(described)
    with client(runtime, token(runtime, Scope.OPERATE, name="another operator")) as http:
        assert http.get("/api/v1/webhooks").status_code == http.get("/metrics").status_code == 403


def test_settings_over_http_are_those_in_use_without_secrets(served: tuple[Runtime, str, Read]) -> None:
    runtime, text, _ = served
    with client(runtime, token(runtime, Scope.CONFIGURE, name="who sets it up")) as http:
        answer = http.get("/api/v1/settings").raise_for_status()
    found = answer.json()["settings"]
    assert set(found) == {"http", "queue", "shards", "recording", "replay", "log"}
    assert found["queue"] == runtime.settings.queue.model_dump()
    assert "/hook" not in answer.text
    assert runtime.settings.history.database not in answer.text
    with client(runtime, text) as http:
        assert http.get("/api/v1/settings").status_code == 403


def test_counters_start_at_0_after_a_restart_and_alarms_are_restored(tmp_path: Path) -> None:
    plan = settings(endpoint(), machine_file(tmp_path, IN_ORDER), when_full="wait", history=kept_in(tmp_path))
    with feeding(plan) as (runtime, feed):
        feed.gap()
        until(lambda: runtime.machines()[0].history.last_sequence == 0, "the alarm on the gap")
        until(lambda: parsed(runtime.metrics.text().decode()).of_lab("alarm_events_total", kind="raised") == 1, "count")
        assert parsed(runtime.metrics.text().decode()).of_lab("restored_at_start") == 0.0
    with running(plan) as runtime:
        read = parsed(runtime.metrics.text().decode())
        assert (read.of_lab("restored_at_start"), read.of_lab("alarm_sequence")) == (1.0, 0.0)
        assert read.of_lab("alarm_events_total", kind="raised") == 0.0
        assert read.of_lab("alarms", state="unacknowledged", severity="alert") == 1.0
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(runtime.machines()[0].history, "last_sequence", 5)  # more than can be read
            patch.setattr(type(runtime.machines()[0].history), "events", failing)
            assert parsed(runtime.metrics.text().decode()).of_lab("alarm_events_total", kind="raised") == 0.0


def failing(*_: object, **__: object) -> None:
    raise StoreError("the database is gone")
