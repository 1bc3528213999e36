"""Evidence of an alarm is kept: from before it, when it was raised, and once the window holds only changed data."""

import time
from pathlib import Path
from unittest.mock import Mock

import pytest
from structlog.testing import capture_logs

from rotorwatch.records.example import example
from rotorwatch.records.health import Health, HealthState
from rotorwatch.records.history import AlarmEvidence, Picture
from service.history.records import StoreError
from service.runtime.runtime import running
from service.stream.evidence import EvidenceCollector
from simulator.scenario import parse_fault
from tests.service.rig.live import SHORT, endpoint, feeding, kept_in, machine_file, scenario_blocks, settings, until
from tests.service.rig.monitored import PLACE, client, problem
from tests.service.rig.postgres import opened
from tests.sure import sure

FAULT_S = 40.0
CHANGED = -0.33
HOP = 50
"""Blocks of a hop."""


def test_evidence_from_before_at_and_after_an_alarm_survives_a_restart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.runtime.machines._TICK_S", 0.1)
    plan = settings(endpoint(), machine_file(tmp_path, *SHORT), when_full="wait", history=kept_in(tmp_path))
    blocks = scenario_blocks(100.0, parse_fault(f"k_by={CHANGED}@{FAULT_S:g}"))
    with feeding(plan) as (runtime, feed), client(runtime) as http:
        worker, sent = runtime.machines()[0], 0

        def kept() -> AlarmEvidence | None:
            text = worker.history.evidence("k_by")
            return None if text is None else AlarmEvidence.model_validate_json(text)

        def feed_on(count: int) -> None:
            nonlocal sent
            feed.put(*blocks[sent : sent + count])
            sent += count
            until(lambda: worker.health().quality.accepted_blocks == sent, f"{sent} blocks")
            time.sleep(0.3)  # windows are looked at every 0.1 s here

        def until_settled() -> bool:
            feed_on(HOP)
            found = kept()
            return found is not None and found.settled is not None

        feed_on(round(10 * FAULT_S))
        until(lambda: worker.history.evidence("") is not None, "picture of the healthy machine")
        assert problem(http.get(f"{PLACE}/alarms/k_by/evidence"), 404).detail.startswith("nothing was kept of k_by")
        until(until_settled, "evidence of the whole change")
        answer = http.get(f"{PLACE}/alarms/k_by/evidence")
        found = AlarmEvidence.model_validate_json(answer.content)
        problem(http.get(f"{PLACE}/alarms/k_by/evidence?occurrence=2"), 404)
        assert http.get(f"{PLACE}/alarms/k_by/evidence?occurrence=1").content == answer.content
    begin_ns = blocks[0].start_ns
    before, raised, settled = sure(found.before), found.raised, sure(found.settled)
    assert before.report.state is HealthState.HEALTHY
    assert before.report.end_ns <= begin_ns + FAULT_S * 1e9 < raised.report.end_ns <= settled.report.end_ns
    assert settled.report.start_ns >= begin_ns + (FAULT_S - 5.0) * 1e9
    for picture in (before, settled):
        assert {one.location for one in picture.orbits.orbits} == {"bearing", "disc"}
        assert picture.correlations is not None
        assert {len(one.measured) for one in picture.correlations.pairs} == {len(picture.correlations.lags_s)}
        assert picture.correlations.pairs[0].nominal is None
        assert len(picture.spectra.frequencies_hz) == len(picture.spectra.densities[0].measured) > 10
    read = sure({one.name: one.relative_change for one in settled.report.parameters}["k_by"])
    assert abs(read - CHANGED) < 0.1
    verdict = sure(raised.report.verdict)
    best, *others = verdict.alternatives
    assert best.names == ("k_by",)
    assert best.probability == pytest.approx(verdict.confidence)
    assert best.explained > 0.9
    assert {one.names for one in others} >= {(), ("c_by",), ("k_bz",), ("c_bz",), ("e",)}
    assert all(one.probability <= best.probability for one in others)
    # A restarted monitor still has it.
    with running(plan) as runtime:
        assert runtime.machines()[0].history.evidence("k_by", 1) == answer.text


def test_an_unreachable_database_is_logged_once() -> None:
    away = Mock()
    away.history.evidence.side_effect = StoreError("the database is away")
    collector = EvidenceCollector(away)
    with capture_logs() as logged:
        for _ in range(40):  # a look every ten seconds
            collector.look(Health.model_validate(example(Health)))
    assert [one["why"] for one in logged] == ["the database is away"]


def test_a_new_history_gets_the_evidence_once_the_change_has_settled() -> None:
    """And a new picture of the healthy machine."""
    kept: dict[tuple[str, int], str] = {}
    worker = Mock()
    worker.history.evidence.side_effect = lambda name, occurrence=0: kept.get((name, occurrence))
    worker.history.keep_evidence.side_effect = lambda name, occurrence, text: kept.update({(name, occurrence): text})
    worker.history.claim.generation = 0
    collector, picture = EvidenceCollector(worker), Picture.model_validate(example(Picture))
    alarming = Health.model_validate(example(Health))
    report, (alarm, *_) = sure(alarming.report), alarming.alarms
    collector._picture = lambda report: picture.model_copy(update={"report": report})  # type: ignore[method-assign]  # of the window alone

    def look(end_s: int, *, calm: bool = False, settled: bool = False) -> None:
        verdict = sure(report.verdict).model_copy(update={"settled": settled})
        state = HealthState.HEALTHY if calm else report.state
        now = report.model_copy(update={"end_ns": end_s * 10**9, "state": state, "verdict": None if calm else verdict})
        alarms = () if calm else (alarm.model_copy(update={"raised": True}),)
        collector.look(alarming.model_copy(update={"report": now, "alarms": alarms}))

    look(10, calm=True)
    look(20)
    kept.clear()
    worker.history.claim.generation = 1
    look(30)
    assert kept == {}
    look(40, settled=True)
    found = AlarmEvidence.model_validate_json(kept[alarm.name, alarm.occurrence])
    ends = [sure(one).report.end_ns for one in (found.before, found.raised, found.settled)]
    assert ends == [10 * 10**9, 20 * 10**9, 40 * 10**9]
    look(50, calm=True)
    assert Picture.model_validate_json(kept["", 0]).report.end_ns == 50 * 10**9


def test_only_the_newest_evidence_of_an_alarm_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.history.machine._MOST_EVIDENCE", 3)
    clock = iter(range(1, 100))
    with opened("sqlite:///:memory:", now_ns=lambda: next(clock)) as store:
        lab, other = store.machine("demo", "lab"), store.machine("demo", "other")
        other.keep_evidence("e", 1, "other")
        for occurrence in range(1, 8):
            lab.keep_evidence("e", occurrence, f"{occurrence}")
        lab.keep_evidence("e", 7, "seven")
        assert [lab.evidence("e", occurrence) for occurrence in range(4, 8)] == [None, "5", "6", "seven"]
        assert lab.evidence("e") == "seven"
        assert other.evidence("e") == "other"
