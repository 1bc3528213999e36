"""Repetitions, reordering and restarts within bounds do not change the alarm log."""

import sqlite3
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from models.commissioning.commissioned import Installed, install
from models.machine import Machine
from models.signals.block import SampleBlock
from models.signals.wire import encode_block
from service.history.records import Retention
from service.history.store import Store
from service.monitor.alarms.alarm import AlarmEvent
from service.monitor.monitor import MachineMonitor
from service.stream.checkpoints import stored_event
from service.stream.inbox import RawBlock
from simulator.scenario import Scenario, load_scenario
from simulator.stream import blocks
from tests.service.monitor.test_alarm_trouble import Bench, Outlet
from tests.service.rig.live import START_NS, until
from tests.sure import sure

SEED = 7_700_501
# In short, test_arrivals has late and repeated blocks, test_window_again a monitor that is killed and goes on.
pytestmark = pytest.mark.long
REORDERED = 8
"""How far blocks are out of order, and how many of them the monitor waits for."""
CACHED = 120
"""Blocks that a publisher resends to a restarted monitor; more than a window, the gap and the reordering."""
BEHIND = 20
"""How far a monitor may be behind when it is killed; with a hop and the reordering, the cache covers it."""
MISSING = range(136, 158)
"""Blocks that are lost for good: 11 s, longer than a silence may last."""


@cache
def installed() -> Installed:
    """The rotor kit with short windows, so that a story takes a second."""
    machine = load_scenario("healthy")[1].model_dump()
    machine["window"] |= {"length_s": 24.0, "hop_s": 6.0, "max_span_s": 60.0, "segment_s": 2.0}
    machine["alarms"] |= {"on_delay_s": 0.0, "off_delay_s": 12.0}
    machine["ingest"] |= {"reorder_blocks": REORDERED}
    return install(Machine.model_validate(machine), None)


@cache
def stream() -> tuple[SampleBlock, ...]:
    """Two minutes in blocks of half a second: a bearing loses stiffness and regains it; a probe gets stuck."""
    scenario, _ = load_scenario("healthy")
    events = [
        {"at_s": 27.0, "parameter": "k_by", "relative_change": -0.5},
        {"at_s": 42.0, "parameter": "k_by", "relative_change": 0.0},
    ]
    fields = scenario.model_dump() | {"duration_s": 126.0, "seed": SEED, "events": events}
    machine = sure(installed().known)
    made = [one for one, _ in blocks(Scenario.model_validate(fields), machine, 0.5, START_NS)]
    for block in made[208:226]:
        block.samples[:, 0] = 7.0
    return tuple(block for number, block in enumerate(made) if number not in MISSING)


@cache
def expected() -> tuple[AlarmEvent, ...]:
    """The log of an undisturbed run."""
    monitor = MachineMonitor(installed())
    return tuple(event for block in stream() for event in monitor.step(block).events)


def test_the_undisturbed_log_has_all_kinds_of_events() -> None:
    told = [(event.kind.value, event.alarm.name) for event in expected()]
    assert {("raised", "k_by"), ("cleared", "k_by"), ("raised", "stream-lost"), ("raised", "data-gap")} <= set(told)
    assert ("raised", "data-stuck") in told
    assert len(told) == 7


class Plant:
    """A monitor that can be killed, and the database that it leaves."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._number = 0
        self.heard = Outlet()
        self._start()

    def _start(self) -> None:
        store = Store(f"sqlite:///{self._folder / str(self._number)}", Retention())
        store.open()
        self.at = Bench(store, installed(), outlet=self.heard)

    def put(self, block: SampleBlock) -> None:
        inbox = self.at.worker.inbox
        until(lambda: len(inbox) <= BEHIND, "monitor that keeps up")
        inbox.put(RawBlock(*encode_block(block, installed().machine.descriptor.schema_hash)))

    def strike(self) -> None:
        """Restart from a copy of the database as it is now, whatever the monitor is doing."""
        before = self._folder / str(self._number)
        self._number += 1
        with sqlite3.connect(before) as source, sqlite3.connect(self._folder / str(self._number)) as image:
            source.backup(image)
        source.close()
        image.close()
        self.stop()
        self._start()

    def stop(self) -> None:
        self.at.worker.stop()
        self.at.store.close()


@pytest.mark.parametrize("seed", range(3, 10))
def test_repetitions_reordering_and_restarts_change_nothing(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    strikes, repeated = int(rng.integers(1, 4)), rng.uniform(0.0, 0.5)
    sent = stream()
    jitter = rng.uniform(0, REORDERED, len(sent))
    jitter[-2 * REORDERED :] = 0.0  # the last blocks must not wait for ever
    jitter[:1] = 0.0
    order = np.argsort(np.arange(len(sent)) + jitter, kind="stable").tolist()
    struck = set(rng.integers(1, len(sent), strikes).tolist())
    plant = Plant(tmp_path)
    try:
        newest = 0
        for place, at in enumerate(order):
            plant.put(sent[at])
            newest = max(newest, at)
            if rng.random() < repeated:
                plant.put(sent[int(rng.integers(max(0, newest - CACHED), newest + 1))])
            if place in struck:
                plant.strike()
                for block in sent[max(0, newest + 1 - CACHED) : newest + 1]:
                    plant.put(block)
        plant.at.settle()
        log = plant.at.history.events(limit=1000)
    finally:
        plant.stop()
    identity = plant.at.worker.identity
    assert [one.text for one in log] == [stored_event(identity, event, 0).text for event in expected()]
    # A subscriber received every event in order, some perhaps twice with the same id.
    assert list(dict.fromkeys(plant.heard.events)) == [one.text for one in log]
