"""The window of a restarted monitor: restored from caches and recordings, refilled, or with a gap; real processes."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import zenoh
import zenoh.ext

from models.commissioning.commissioned import install
from models.machine import Machine, load_machine
from models.signals.block import SampleBlock
from models.signals.link import LinkSettings
from models.signals.wire import encode_block
from rotorwatch.records.alarms import Alarm
from service.monitor.monitor import MachineMonitor
from service.monitor.reports import identity_of
from service.stream.checkpoints import stored_event, stored_report
from simulator.scenario import parse_fault
from tests.loopback import session_of
from tests.service.rig.live import (
    LAB,
    QUICK,
    START_NS,
    Program,
    advanced_publisher,
    endpoint,
    machine_file,
    program,
    until,
    until_subscribed,
)
from tests.service.rig.postgres import opened
from tests.windows import healthy_blocks

BLOCK_S = 0.5
FIRST, ALL = 78, 124
"""Blocks until the monitor ends, in mid-hop, and in all: one alarm is raised before, another one after."""


@cache
def stream() -> tuple[SampleBlock, ...]:
    faults = (parse_fault("c_bz=0.5@0"), parse_fault("k_by=-0.33@30"))
    return healthy_blocks(LAB, ALL * BLOCK_S, 7_700_031, *faults, block_s=BLOCK_S)


class Plant:
    """A monitor that can be restarted, and a publisher that keeps `kept` blocks."""

    def __init__(self, folder: Path, session: zenoh.Session, address: str, recording: bool, kept: int) -> None:
        self.folder, self.session, self.address = folder, session, address
        file = machine_file(folder, *QUICK)
        self.machine: Machine = load_machine(file)
        self.url = f"sqlite:///{folder / 'history.sqlite'}"
        self._settings = folder / "monitor.toml"
        text = f'[link]\nlisten = ["{address}"]\n[http]\nport = 0\n[[machines]]\nfile = "{file}"\n'
        if recording:
            text += f'[recording]\ndirectory = "{folder / "recordings"}"\n'
        self._settings.write_text(text, encoding="utf-8")
        self._publisher = advanced_publisher(session, self.machine.keys.stream, kept)
        self.raised: list[Alarm] = []

    @contextmanager
    def monitor(self) -> Iterator[Program]:
        command = ("service", "run", "--config", str(self._settings))
        with program(self.folder, *command, ROTORWATCH_HISTORY__URL=self.url) as running:
            running.wait_for("HTTP API")
            until_subscribed(self.session, self.machine.keys.stream)
            yield running

    def put(self, some: tuple[SampleBlock, ...]) -> None:
        for block in some:
            payload, attachment, encoding = encode_block(block, self.machine.descriptor.schema_hash)
            self._publisher.put(payload, attachment=attachment, encoding=encoding)

    def said(self) -> tuple[list[str], list[str]]:
        """Alarm events and reports of the history, to the byte."""
        with opened(self.url) as store:
            lab = store.machine("demo", "lab")
            return [one.text for one in lab.events(limit=1000)], [one.text for _, one in lab.reports(limit=1000)][::-1]


@cache
def offline() -> tuple[list[str], list[str]]:
    """The same of one uninterrupted run without a network."""
    with TemporaryDirectory() as folder:
        installed = install(load_machine(machine_file(Path(folder), *QUICK)), None)
    identity = identity_of(installed)
    monitor = MachineMonitor(installed)
    said = [one for block in stream() for one in monitor.step_payload(*encode_block(block, ""))]
    events = [stored_event(identity, event, 0).text for one in said for event in one.events]
    return events, [stored_report(window).text for one in said for window in one.windows]


def until_accepted(at: Program, count: int) -> None:
    until(lambda: at.health().quality.accepted_blocks >= count, f"{count} blocks")


@contextmanager
def restarted(folder: Path, *, recording: bool, kept: int, killed: bool = True) -> Iterator[tuple[Plant, Program]]:
    """A monitor that ends after the first blocks, and its successor."""
    address = endpoint()
    # On a busy computer a queue may be full for longer than Zenoh keeps the link.
    patience = {"transport/link/tx/queue/congestion_control/block/wait_before_close": json.dumps(60_000_000)}
    with session_of(LinkSettings(connect=(address,)), **patience) as session:
        here = Plant(folder, session, address, recording, kept)
        with here.monitor() as first:
            for begin in range(0, FIRST, 13):  # no more on their way than an inbox takes
                here.put(stream()[begin : begin + 13])
                until_accepted(first, begin + 13)
            here.raised = [one for one in first.health().alarms if one.raised]
            if killed:
                first.kill()
            else:
                assert first.stop() == 0
        with here.monitor() as second:
            yield here, second


def until_evaluated(at: Program) -> None:
    last_ns = START_NS + 57_500_000_000  # of the last hop, or a little later where hops started again

    def evaluated() -> bool:
        report = at.health().report
        return report is not None and report.end_ns >= last_ns

    until(evaluated, "the last window")


def raised(events: list[str]) -> list[str]:
    told: list[dict[str, Any]] = [json.loads(event)["data"] for event in events]
    assert [one["sequence"] for one in told] == list(range(len(told)))
    return [one["name"] for one in told if one["kind"] == "raised"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recording", "kept"),
    [
        pytest.param(True, 10, id="recording and a short cache"),
        pytest.param(False, 300, id="a cache longer than the window"),
    ],
)
def test_after_a_kill_a_recoverable_window_gives_the_same_events_and_reports(
    tmp_path: Path, recording: bool, kept: int
) -> None:
    with restarted(tmp_path, recording=recording, kept=kept) as (here, second):
        until(lambda: second.health().filled == 1.0, "full window")
        assert second.health().restart == "resumed at 2026-01-01T00:00:37.500000Z"
        here.put(stream()[FIRST:])
        until_evaluated(second)
        assert second.health().quality.gaps == 0
    assert here.said() == (expected := offline())
    assert raised(expected[0]) == ["c_bz", "k_by"]


@pytest.mark.slow
def test_after_a_kill_recordings_restore_the_window_and_unrecorded_blocks_are_a_gap(tmp_path: Path) -> None:
    with restarted(tmp_path, recording=True, kept=0) as (here, second):
        until(lambda: second.health().filled == 1.0, "full window")
        here.put(stream()[FIRST + 4 :])
        until_evaluated(second)
        assert (second.health().quality.gaps, second.stop()) == (1, 0)
    assert raised(here.said()[0]) == ["c_bz", "data-gap", "k_by"]


@pytest.mark.slow
@pytest.mark.parametrize("kept", [pytest.param(0, marks=pytest.mark.long), 12])
def test_after_a_kill_an_unrecoverable_window_refills_and_alarms_stay_raised(tmp_path: Path, kept: int) -> None:
    with restarted(tmp_path, recording=False, kept=kept) as (here, second):
        health = second.health()
        assert health.filled < 1.0
        assert [one for one in health.alarms if one.raised] == here.raised != []
        assert health.state in {"alert", "danger"}
        here.put(stream()[FIRST:])
        until_evaluated(second)
        told = second.health().restart
        assert "hops of the window were not received again, and it is filling anew" in told
        assert second.stop() == 0
    events, reports = here.said()
    assert raised(events)[0] == "c_bz"
    assert len(set(raised(events))) == len(raised(events))  # nothing is raised twice
    assert len(reports) >= len(offline()[1]) - 2  # hops that the kill interrupted


@pytest.mark.slow
@pytest.mark.parametrize("kept", [pytest.param(0, marks=pytest.mark.long), 20])
def test_after_a_clean_stop_the_window_is_kept(tmp_path: Path, kept: int) -> None:
    with restarted(tmp_path, recording=False, kept=kept, killed=False) as (here, second):
        health = second.health()
        assert (health.filled, health.restart) == (1.0, "resumed at 2026-01-01T00:00:39.000000Z")
        assert health.report is not None  # with what it says of the machine, before the next hop
        assert health.report.end_ns == START_NS + 37_500_000_000
        here.put(stream()[FIRST:])
        until_evaluated(second)
        assert second.health().quality.refused_blocks == {}  # the resent blocks had been requested
        assert second.stop() == 0
    assert here.said() == offline()
