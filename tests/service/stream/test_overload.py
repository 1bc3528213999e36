"""A computer too small for its machines: windows are skipped, but no samples and no loud vibration."""

import json
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from models.alarm_names import FAULT, LEVEL, OVERLOADED
from models.commissioning.commissioned import Installed, install
from models.errors import RecordingError
from models.levels.settings import LevelSettings
from models.machine import load_machine
from models.physics.rotor import PARAMETERS
from models.signals.block import SampleBlock
from models.signals.recording import RecordedMessage, RecordingWriter
from models.signals.wire import encode_block
from rotorwatch.records.health import HealthState, Report
from service.monitor.monitor import MachineMonitor
from service.recordings.replay.offline import OfflineReplay
from service.recordings.replay.source import RecordingSource
from service.settings.service import RecordingSettings
from service.stream import shedding
from service.stream.inbox import Inbox, RawBlock
from service.stream.shedding import LoadShedding, in_turn
from service.stream.worker import MachineWorker
from simulator.scenario import parse_fault
from tests.service.rig.live import QUICK, START_NS, Feed, fed_service, machine_file, scenario_blocks, until
from tests.service.rig.monitored import client
from tests.service.rig.replaying import lines_of
from tests.service.rig.watching import feed, named, raised, resumed

S = 10**9
LOUD_FROM_S, LOUD_TO_S = 60, 90
LENGTH_S = 235.0  # long enough for the alarm to clear after the backlog
LIMIT = '\n[[levels.limits]]\nchannel = "y1"\nmeasure = "overall"\nalert = 220.0\ndanger = 1000.0\n'


def short_machine(folder: Path) -> str:
    """The rotor kit with windows of 20 s and a limit on the level of channel y1."""
    file = Path(machine_file(folder, *QUICK))
    file.write_text(file.read_text(encoding="utf-8") + LIMIT, encoding="utf-8")
    return str(file)


def loud_in_between(seconds: float, from_s: float = LOUD_FROM_S, to_s: float = LOUD_TO_S) -> list[SampleBlock]:
    """The rotor kit, with twice the vibration between two times."""
    gain = np.array([2.0] * 8 + [1.0], np.float32)
    return [
        replace(one, samples=one.samples * gain) if from_s <= (one.start_ns - START_NS) / S < to_s else one
        for one in scenario_blocks(seconds)
    ]


def queue_of(
    arrivals_s: Sequence[float], evaluated_s: float, skipped_s: float, held: Callable[[float], float] = lambda at: at
) -> list[tuple[float, float, bool]]:
    """For each hop of 50 blocks: when its last block came, when it is done, whether it is skipped."""
    rule, now_s, found = LoadShedding(), 0.0, []
    ends = arrivals_s[49::50]
    for number, came_s in enumerate(ends):
        now_s = held(max(now_s, came_s))
        waiting = sum(one <= now_s for one in arrivals_s[50 * (number + 1) :])
        skips = rule.skips(waiting, 50, now_s)
        now_s += skipped_s if skips else evaluated_s
        found.append((came_s, now_s, skips))
    return found


def steadily(seconds: float, begin_s: float = 0.0) -> list[float]:
    return [begin_s + 0.1 * number for number in range(1, round(10 * seconds) + 1)]


@pytest.mark.parametrize("load", [0.5, 0.8, 0.95])
def test_no_window_is_skipped_after_a_stall(load: float) -> None:
    stood_still = queue_of(steadily(600), 5 * load, 1.0, lambda at: 70.0 if 60.0 < at < 70.0 else at)
    assert max(done_s - came_s for came_s, done_s, _ in stood_still) > 7.0  # it was behind
    assert not any(skipped for _, _, skipped in stood_still)


@pytest.mark.parametrize("load", [0.5, 0.8])
def test_no_window_is_skipped_after_a_restart(load: float) -> None:
    backlog = [0.0] * 1200  # a publisher's cache, all at once
    restarted = queue_of(backlog + steadily(900), 5 * load, 1.0)
    assert max(done_s - came_s for came_s, done_s, _ in restarted) > 50.0
    assert not any(skipped for _, _, skipped in restarted)


def test_under_lasting_overload_every_second_window_is_skipped_and_delay_is_bounded() -> None:
    overloaded = queue_of(steadily(1200), 7.5, 2.5)
    began_s = next(done_s for _, done_s, skipped in overloaded if skipped)
    assert 30.0 < began_s < 120.0
    later = [one for one in overloaded if one[0] > 300.0]
    assert max(done_s - came_s for came_s, done_s, _ in later) < 1.25 + 7.5 + 2.5
    # 7.5 s for an evaluated window and 2.5 s for a skipped one are 5 s a hop if every second one is skipped.
    assert np.mean([not skipped for *_, skipped in later]) == pytest.approx(0.5, abs=0.05)


def test_after_an_overload_a_short_delay_skips_no_window() -> None:
    rule = LoadShedding()
    for number in range(20):
        rule.skips(60 + number, 50, 5.0 * number)
    assert rule.skips(90, 50, 100.0)
    assert not rule.skips(12, 50, 105.0)
    assert rule.skips(13, 50, 110.0)  # it was behind until a moment ago
    assert not rule.skips(3, 50, 125.0)
    assert not rule.skips(49, 50, 140.0)
    assert not rule.skips(60, 50, 145.0)
    assert not rule.skips(49, 50, 200.0)


@pytest.fixture(scope="module")
def kit(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    return install(load_machine(short_machine(tmp_path_factory.mktemp("kit"))), None)


def test_a_skipped_window_is_not_evaluable_and_an_alarm_says_why(kit: Installed) -> None:
    skipped = {START_NS + round(end_s * 1e9) for end_s in (42.5, 47.5)}
    monitor, stream = MachineMonitor(kit, skipped.__contains__), scenario_blocks(80.0)
    windows, events = feed(monitor, stream[:480])
    for window in windows[-2:]:
        assert (window.skipped, window.state) == (True, HealthState.NOT_EVALUABLE)
        assert (window.verdict, window.parameters, window.opinions, window.equations) == (None, (), (), ())
        assert "cannot keep up" in window.reason
        assert window.levels[0].overall
    (alarm,) = (one for one in monitor.health().alarms if one.raised)
    assert alarm.note.endswith("windows skipped: 2")
    assert monitor.health().quality.skipped_windows == 2
    later, more = feed(monitor, stream[480:])
    assert {(one.skipped, one.state) for one in later} == {(False, HealthState.HEALTHY)}
    assert named([*events, *more]) == [("raised", OVERLOADED), ("cleared", OVERLOADED)]


def test_a_skipped_window_does_not_clear_the_alarm_on_a_defect(kit: Installed) -> None:
    monitor = MachineMonitor(kit, lambda _: True)
    feed(monitor, scenario_blocks(30.0))
    monitor.fault("a defect", START_NS + 30 * S)
    feed(monitor, scenario_blocks(60.0)[300:])
    assert FAULT in raised(monitor)


def test_level_alarms_come_as_soon_in_skipped_windows_as_in_others(kit: Installed) -> None:
    def alarms(skips: Callable[[int], bool]) -> list[tuple[str, float]]:
        monitor = MachineMonitor(kit, skips)
        _, events = feed(monitor, loud_in_between(90.0, 30.0, 45.0))
        told = [(f"{event.kind.value} {event.alarm.name}", (event.time_ns - START_NS) / S) for event in events]
        return [one for one in told if LEVEL in one[0]]

    skipped, evaluated = alarms(lambda _: True), alarms(lambda _: False)
    assert [name for name, _ in skipped] == [f"raised {LEVEL}y1", f"cleared {LEVEL}y1"]
    assert skipped == evaluated
    assert 30.0 < skipped[0][1] < 30.0 + 20


def test_a_change_is_named_even_if_every_other_window_is_skipped(kit: Installed) -> None:
    stream = scenario_blocks(80.0, parse_fault("k_by=-0.33@50"))
    hop_ns = round(kit.machine.window.hop_s * 1e9)
    monitor = MachineMonitor(kit, lambda end_ns: (end_ns - START_NS) // hop_ns % 2 == 0)
    _, events = feed(monitor, stream)
    assert [one for one in named(events) if one[1] in PARAMETERS] == [("raised", "k_by")]


def test_a_monitor_resumed_between_skipped_windows_gives_the_same_output(kit: Installed) -> None:
    stream = scenario_blocks(75.0, parse_fault("k_by=-0.33@50"))
    hop_ns = round(kit.machine.window.hop_s * 1e9)

    def every_third(end_ns: int) -> bool:
        return (end_ns - START_NS) // hop_ns % 3 == 0

    first, at = MachineMonitor(kit, every_third), 637
    feed(first, stream[:at])
    second = resumed(first, kit, skips=every_third)
    assert feed(second, stream[at:]) == feed(first, stream[at:]) != ([], [])


def test_level_growth_beside_a_named_change_is_found_in_skipped_windows(kit: Installed) -> None:
    """A skipped window cannot tell whether the change still explains the growth."""
    levels = LevelSettings(reference="first windows", reference_windows=2)
    monitor = MachineMonitor(
        install(kit.machine.model_copy(update={"levels": levels}), None), lambda end_ns: end_ns > START_NS + 70 * S
    )
    gain = np.array([1.7] * 8 + [1.0], np.float32)
    told = {}
    for block in scenario_blocks(92.0, parse_fault("k_by=-0.15@40")):
        louder = replace(block, samples=block.samples * gain) if block.start_ns >= START_NS + 75 * S else block
        for event in monitor.step(louder).events:
            told[f"{event.kind.value} {event.alarm.name}"] = (event.time_ns - START_NS) / S
    assert told["raised k_by"] < 70
    assert told[f"raised {LEVEL}y1"] > 75


def message(number: int, source: str) -> RawBlock:
    return RawBlock(*encode_block(scenario_blocks(10.0)[number], ""), source=source)


def test_other_publishers_and_bursts_to_an_idle_worker_count_as_no_delay() -> None:
    inbox = Inbox(1000, "drop")
    inbox.put(message(0, "own"))
    first = inbox.get()
    assert isinstance(first, RawBlock)
    inbox.follow(first)
    for number in range(1, 41):
        inbox.put(message(number, "other"))
    assert inbox.behind == 0
    for number in range(1, 41):
        inbox.put(message(number, "own"))
    assert inbox.behind == 40
    while len(inbox):
        inbox.get()

    def send() -> None:
        for number in range(41, 81):
            inbox.put(message(number, "own"))

    burst = threading.Timer(0.1, send)
    burst.start()
    inbox.get(40)  # waits for 40
    burst.join()
    assert inbox.behind == 0
    assert inbox.behind == 39  # until all have been taken once


def test_the_last_block_of_a_hop_waits_for_its_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shedding, "_LONGEST_TURN_S", 60.0)
    with fed_service(short_machine(tmp_path)) as (_, worker, feed):
        first, *others = scenario_blocks(10.0)
        feed.put(first)  # the blocks in a hop are not known yet
        until(lambda: worker.tally.blocks == 1, "the first block")
        with in_turn(completes_hop=True):  # another machine's
            feed.put(*others)
            until(lambda: worker.tally.blocks >= 74, "the blocks before the last one of the first hop, of 7.5 s")
            time.sleep(0.3)
            assert worker.tally.blocks == 74
        until(lambda: worker.tally.blocks == 100, "all blocks")


def test_turns_are_taken_one_at_a_time_in_order_of_request(monkeypatch: pytest.MonkeyPatch) -> None:
    """However long they take together; a turn that never ends is waited for only once."""
    asked, began, beside, ends = list[int](), list[int](), list[int](), threading.Event()

    class Turns(deque[threading.Event]):
        def append(self, turn: threading.Event) -> None:
            asked.append(threading.get_ident())
            super().append(turn)

    def take(first: bool = False) -> None:
        with in_turn(completes_hop=True):
            began.append(threading.get_ident())
            if first:
                ends.wait(60.0)
                return
            beside.append(1)
            time.sleep(0.08)
            assert beside.pop() == 1
            assert not beside

    monkeypatch.setattr(shedding, "_LONGEST_TURN_S", 2.0)
    monkeypatch.setattr(shedding, "_turns", Turns())
    with ThreadPoolExecutor(31) as threads:
        endless = threads.submit(take, True)
        until(lambda: len(began) == 1, "the turn that never ends")
        others = [threads.submit(take) for _ in range(30)]  # 2.4 s in all
        for turn in others:
            turn.result()
        assert began == asked
        assert not endless.done()
        ends.set()
        endless.result()
    assert not shedding._turns


def hurry(feed: Feed, worker: MachineWorker, stream: list[SampleBlock], until_sent: int, ahead: int) -> None:
    """Put blocks so that `ahead` of them are always on their way or wait, until `until_sent` are sent."""
    while feed.sequence < until_sent:
        if feed.sequence - worker.tally.blocks < ahead:
            feed.put(*stream[feed.sequence : feed.sequence + 50])
            feed.sequence += 50
        time.sleep(0.002)  # a loop that never rests takes the processor from the worker


def test_an_overloaded_service_loses_no_sample_and_replays_identically(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shedding, "_LASTING_S", 0.1)  # data come a hundred times as fast as from a machine
    stream, file = loud_in_between(LENGTH_S), short_machine(tmp_path)
    recording = RecordingSettings(directory=str(tmp_path / "recordings"))
    with fed_service(file, bound=1500, recording=recording) as (runtime, worker, feed):
        hurry(feed, worker, stream, 10 * (LOUD_TO_S + 50), 200)
        # From now on each hop is sent when the previous one is done.
        for end in (*range(feed.sequence + 25, len(stream), 50), len(stream)):
            # nothing waits, and at most what follows the latest hop is in flight
            known = feed.sequence - (0 if feed.sequence % 50 else 40)
            until(
                lambda known=known: len(worker.inbox) == 0 and worker.health().quality.accepted_blocks >= known,  # type: ignore[misc]  # bound now
                "an idle worker",
            )
            feed.put(*stream[feed.sequence : end])
            feed.sequence = end
        until(lambda: worker.health().quality.accepted_blocks == len(stream), "all blocks")
        with client(runtime) as http:
            metrics = http.get("/metrics").text
        said, quality = lines_of(worker), worker.health().quality
        assert (quality.gaps, quality.queue_dropped_blocks, quality.refused_blocks) == (0, 0, {})
        assert quality.skipped_windows >= 5
        assert f'windows_skipped_total{{machine="lab",site="demo"}} {quality.skipped_windows}.0' in metrics
        windows = [Report.model_validate_json(one.text) for _, one in worker.history.reports(limit=1000)]
        skipped = {one.end_ns for one in windows if one.skipped}
        assert len(skipped) == quality.skipped_windows
        assert len(windows) == math.floor((LENGTH_S - 2.5) / 5)
        assert worker.tally.windows == len(windows) - len(skipped)
        events = worker.history.events()
        told = [f"{one.kind} {one.alarm}" for one in events]
        assert told.count(f"raised {OVERLOADED}") == told.count(f"cleared {OVERLOADED}") == 1
        (loud,) = (one for one in events if (one.kind, one.alarm) == ("raised", f"{LEVEL}y1"))
        assert LOUD_FROM_S < (loud.time_ns - START_NS) / S < LOUD_FROM_S + 20
        assert loud.time_ns in skipped
        assert worker.health().state is HealthState.HEALTHY
    machine, found = load_machine(file), list[str]()
    source = RecordingSource(sorted((tmp_path / "recordings" / machine.site / machine.name).glob("*.mcap")))
    OfflineReplay(source, machine.keys, install(machine, None), found.append).run()
    assert found == said
    assert sum(json.loads(one)["message"].get("skipped", False) for one in found) >= 5


def test_a_damaged_recording_is_replayed_up_to_the_damage(tmp_path: Path) -> None:
    machine, blocks, files = load_machine(short_machine(tmp_path)), scenario_blocks(60.0), []
    keys, installed = machine.keys, install(machine, None)
    for number, part in enumerate((blocks[:300], blocks[300:])):
        files.append(tmp_path / f"{number}.mcap")
        with RecordingWriter(files[-1]) as writer:
            for block in part:
                at_ns = block.start_ns
                writer.write(RecordedMessage(keys.stream, *encode_block(block, ""), at_ns, at_ns))
            writer.write(RecordedMessage(keys.report, b"{}", b"", "application/json", at_ns, at_ns))
    data = files[1].read_bytes()
    half = len(data) // 2
    files[1].write_bytes(data[:half] + bytes(50) + data[half + 50 :])
    found: list[str] = []
    with pytest.raises(RecordingError):
        OfflineReplay(RecordingSource(files), keys, installed, found.append).run()
    assert len(found) > 5
    first = OfflineReplay(RecordingSource(files), keys, installed, found.append, to_ns=START_NS + 25 * S)
    assert first.run().blocks == 250
