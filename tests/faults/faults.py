"""Faults caused on purpose and repaired; docs/reliability.md states what each may cost and what must be reported."""

import os
import resource
import signal
import sqlite3
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from models.alarm_names import CLOCK, CONFLICT, FAULT, STREAM_LOST
from rotorwatch.records.health import HealthState
from service.history.records import Retention
from service.history.store import Store
from tests.faults.rig import Plant, Seen, locked, pause
from tests.service.delivery.hooked import Got, hook, settings_for
from tests.service.rig.live import Feed, endpoint, open_session, program, scenario_blocks, until
from tests.sure import sure

_PAGE = 8192
_FED_S = 0.1  # length of the blocks of `scenario_blocks`


def _silent(seen: Seen) -> bool:
    return seen.raised(STREAM_LOST) and seen.health.state is HealthState.NO_DATA


def publisher_killed(plant: Plant) -> None:
    first = plant.at_work()
    first.kill()
    plant.broken()
    plant.stated(_silent, "stream lost")
    plant.publish(run=2)
    plant.over()
    plant.away_s = 60.0  # no data in the meantime


def publisher_paused(plant: Plant) -> None:
    publisher = plant.at_work()
    pause(publisher)
    plant.broken()
    plant.stated(_silent, "stream lost")
    os.kill(publisher.process.pid, signal.SIGCONT)
    plant.over()


def restarted_at(offset_s: float) -> Callable[[Plant], None]:
    def run(plant: Plant) -> None:
        start = "2026-01-01T12:00:00Z"
        first = plant.at_work("--start", start)
        first.stop()
        hour = 12 + round(offset_s / 3600)
        plant.publish("--start", f"2026-01-01T{hour:02}:00:00Z", run=2)
        plant.broken()
        plant.stated(lambda seen: "publisher restarted" in seen.health.quality.last_gap, "restart of the publisher")
        plant.over(lambda seen: seen.well and not seen.raised(CLOCK))
        plant.away_s = abs(offset_s) + 60.0

    return run


def clock_set(offset_s: float) -> Callable[[Plant], None]:
    def run(plant: Plant) -> None:
        stop = threading.Event()
        offset_ns = [0]
        with open_session(plant.address) as session:
            feed = Feed(session)

            def publish() -> None:
                begin_s = time.monotonic()
                for number, block in enumerate(scenario_blocks(120.0)):
                    if stop.wait(max(0.0, begin_s + number * _FED_S - time.monotonic())):
                        return
                    feed.put(type(block)(
                        block.start_ns + offset_ns[0], block.sequence, block.run, block.rate_hz, block.samples
                    ))  # fmt: skip

            publisher = threading.Thread(target=publish)
            publisher.start()
            try:
                plant.flowing()
                plant.rest(0.5, 2.0)
                offset_ns[0] = round(offset_s * 1e9)
                plant.broken()
                plant.stated(lambda seen: any(one.name == CLOCK for one in seen.health.alarms), "clock that was set")
                plant.over(lambda seen: seen.well and seen.raised(CLOCK))
                seen = sure(plant.look())
                plant.missing_s += sum(seen.health.quality.refused_blocks.values()) * _FED_S
            finally:
                stop.set()
                publisher.join()
        plant.away_s = 10 * _FED_S  # until the clock is accepted

    return run


def two_publishers(plant: Plant) -> None:
    plant.pace = 10.0
    plant.publish("--start", "2026-01-01T00:00:00Z")
    plant.flowing()
    second = plant.publish("--start", "2026-01-01T00:00:00Z", run=2)
    plant.broken()
    plant.stated(lambda seen: seen.raised(CONFLICT), "two publishers")
    plant.rest(2.0, 4.0)
    second.stop()
    plant.over(lambda seen: seen.flowing and not seen.raised(CONFLICT))
    plant.away_s = 1e6


def through_router(plant: Plant) -> None:
    plant.connects = True
    plant.start_router()


def link_cut(plant: Plant) -> None:
    plant.at_work()
    sure(plant.router).kill()
    plant.broken()
    plant.stated(_silent, "stream lost")
    plant.start_router()
    plant.over()


def start_again(plant: Plant) -> None:
    plant.start()
    plant.stated(lambda seen: seen.health.restart.startswith("resumed"), "restart")
    plant.recovered()


def monitor_killed(plant: Plant) -> None:
    plant.publish()
    for _ in range(3):
        plant.flowing(5)
        plant.wait_for_orders()
        plant.rest(0.5, 4.0)
        plant.end()
        plant.broken()
        start_again(plant)


def monitor_stopped(plant: Plant) -> None:
    plant.at_work()
    plant.broken()
    assert plant.end(signal.SIGTERM) == 0
    start_again(plant)


def monitor_paused(plant: Plant) -> None:
    plant.publish()
    plant.flowing()
    pause(plant.running)
    plant.rest(6.0, 8.0)
    os.kill(plant.running.process.pid, signal.SIGCONT)
    plant.over()
    plant.rest(1.0, 1.5)


def second_monitor(plant: Plant) -> None:
    plant.publish()
    plant.flowing()
    plant.broken()
    with program(
        plant.folder, "service", "run", "--machine", "lab", "--listen", endpoint(), "--http-port", "0",
        ROTORWATCH_HISTORY__URL=f"sqlite:///{plant.history}",
    ) as second:  # fmt: skip
        assert second.process.wait(180) == 1
        assert "another monitor writes the history of demo/lab" in second.errors()
    plant.stated_now()
    plant.over()


def _unwritable(seen: Seen) -> bool:
    return not seen.ready and "the history cannot be written" in seen.why_not


def history_locked(plant: Plant) -> None:
    plant.at_work()
    with locked(plant.history):
        plant.broken()
        plant.stated(_unwritable, "history that cannot be written")
        plant.rest(1.0, 3.0)
    plant.over()


def locked_to_the_end(plant: Plant) -> None:
    plant.publish()
    plant.flowing()
    with locked(plant.history):
        plant.broken()
        plant.stated(_unwritable, "history that cannot be written")
        ended = plant.running
        assert plant.end(signal.SIGTERM) == 1
        assert "could not be written before the end, and is lost: demo/lab" in ended.errors()
    plant.orders_may_be_lost = True
    plant.mended()
    plant.start()
    plant.recovered()


def small_disk(plant: Plant) -> None:
    plant.disk = "40m"  # the history and the log beside it need ten


def disk_full(plant: Plant) -> None:
    plant.at_work()
    filler = plant.history.with_name("filler")
    with filler.open("wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(bytes(4096))
    plant.broken()
    plant.stated(_unwritable, "full disk")
    plant.rest(2.0, 4.0)
    filler.unlink()
    plant.over()


def torn_write(plant: Plant) -> None:
    plant.under_orders()
    pid = plant.running.process.pid
    log = Path(f"{plant.history}-wal")
    limit = log.stat().st_size + int(plant.rng.integers(100, 3 * _PAGE))
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    plant.broken()
    plant.stated(_unwritable, "failing write")
    plant.end()
    plant.orders_may_be_lost = True
    plant.mended()
    plant.start()
    plant.recovered()


def deleted(plant: Plant) -> None:
    plant.under_orders()
    plant.history.unlink()
    plant.broken()
    plant.stated(lambda seen: any(one.name == FAULT for one in seen.health.alarms), "deleted history")
    plant.over(lambda seen: _goes_on(seen) and seen.ready)
    plant.wait_for_orders()
    assert plant.history.exists()


def replaced(plant: Plant) -> None:
    plant.under_orders()
    other = plant.folder / "other"
    store = Store(f"sqlite:///{other}", Retention())
    store.open()
    store.close()
    other.rename(plant.history)
    plant.broken()
    plant.stated(lambda seen: "another file was put in its place" in seen.why_not, "replaced history")
    plant.orders_may_be_lost = True
    plant.over(_goes_on)
    plant.wait_for_orders()


def _goes_on(seen: Seen) -> bool:
    """Data are monitored and written; the loss is reported until the monitor is restarted."""
    return seen.flowing and not seen.readiness.history_trouble


def _overwrite(file: Path, begin: int) -> None:
    with file.open("r+b") as data:
        size = data.seek(0, os.SEEK_END)
        data.seek(begin)
        data.write(b"\xa5" * max(0, size - begin))


def damaged_in_use(plant: Plant) -> None:
    plant.under_orders()
    _overwrite(plant.history, 0)
    _overwrite(Path(f"{plant.history}-wal"), 0)
    plant.broken()
    plant.stated(lambda seen: "damaged" in seen.why_not, "damaged history")
    plant.orders_may_be_lost = True
    plant.over(_goes_on)
    plant.wait_for_orders()
    assert len(list(plant.history.parent.glob("h.sqlite.damaged-*"))) >= 1


def damaged_at_start(plant: Plant) -> None:
    plant.under_orders()
    assert plant.end(signal.SIGTERM) == 0
    with sqlite3.connect(plant.history) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")  # then the overwritten file holds everything
    connection.close()
    _overwrite(plant.history, _PAGE)
    plant.broken()
    plant.start()
    plant.stated(lambda seen: "damaged" in seen.why_not, "damaged history")
    plant.orders_may_be_lost = True
    plant.over(_goes_on)
    plant.away_s = 60.0
    assert len(list(plant.history.parent.glob("h.sqlite.damaged-*"))) >= 1


def refused_step(plant: Plant) -> None:
    def reports(value: str) -> None:
        with sqlite3.connect(plant.history, timeout=60.0) as connection:
            connection.execute(f"UPDATE machines SET reports = {value} WHERE name = 'lab'")  # noqa: S608  # ours
        connection.close()

    plant.publish()
    plant.flowing(60)
    reports("'many'")
    plant.broken()
    plant.stated(lambda seen: "the history does not accept what happens" in seen.why_not, "refused step")
    plant.rest(1.0, 3.0)
    reports("1000")
    plant.over()


def receiver(plant: Plant) -> None:
    plant.receiver = plant.undo.enter_context(hook())
    settings = settings_for(plant.receiver, plant.folder)
    plant.settings = (
        f'[[webhooks]]\nname = "pager"\nurl = "{settings.url}"\nsecret_file = "hook.secret"\nlongest_pause_s = 1.0\n'
    )


def receiver_away(plant: Plant) -> None:
    receiver, taken = sure(plant.receiver), list[str]()

    def take(got: Got) -> tuple[int, Mapping[str, str]]:
        taken.append(got.id)
        return 204, {}

    receiver.answer = take
    plant.under_orders()
    receiver.answer = lambda _: (503, {})
    plant.broken()
    plant.stated(lambda seen: any("503" in one for one in seen.readiness.failing_webhooks), "failing webhook")
    plant.wait_for_orders(4)
    receiver.answer = take
    plant.over(lambda seen: seen.well and not seen.readiness.failing_webhooks)
    told = [one[0] for one in plant.log()]
    until(lambda: len(taken) >= len(told), "every event")
    assert taken[: len(told)] == told


def flood(plant: Plant) -> None:
    plant.publish()
    plant.flowing()
    with open_session(plant.address) as session:
        feed = Feed(session)
        plant.broken()
        until_s = time.monotonic() + plant.rng.uniform(8.0, 10.0)
        while time.monotonic() < until_s:
            for _ in range(100):
                feed.put_raw(plant.rng.bytes(200), b"", "application/octet-stream")
            if not plant.stated_s and (seen := plant.look()) and sum(seen.health.quality.refused_blocks.values()):
                plant.stated_now()
        plant.over(lambda seen: seen.well and sum(seen.health.quality.refused_blocks.values()) > 1000)


@dataclass(frozen=True, slots=True)
class Row:
    """One fault: its name on the page, what causes and repairs it, and what precedes the start of the monitor."""

    name: str
    run: Callable[[Plant], None]
    prepare: Callable[[Plant], None] = lambda plant: None


ROWS = (
    Row("The publisher is killed and restarted", publisher_killed),
    Row("The publisher is paused", publisher_paused),
    Row("The publisher is restarted an hour later by its clock", restarted_at(3600.0)),
    Row("The publisher is restarted an hour earlier by its clock", restarted_at(-3600.0)),
    Row("The publisher's clock is set forward", clock_set(3600.0)),
    Row("The publisher's clock is set back", clock_set(-3600.0)),
    Row("Two publishers send on one machine's key", two_publishers),
    Row("The network link is cut", link_cut, through_router),
    Row("The monitor is killed, three times", monitor_killed),
    Row("The monitor is shut down cleanly", monitor_stopped),
    Row("The monitor is paused", monitor_paused),
    Row("A second monitor is started with the same machine and history", second_monitor),
    Row("The history is locked by another program", history_locked),
    Row("The history stays locked until the monitor has stopped", locked_to_the_end),
    Row("The disk is full", disk_full, small_disk),
    Row("A write fails in the middle of a commit, and the monitor is killed", torn_write),
    Row("The history is deleted", deleted),
    Row("The history is replaced by another file", replaced),
    Row("The history is damaged while it is in use", damaged_in_use),
    Row("The history is damaged before the monitor starts", damaged_at_start),
    Row("The history refuses the entries of one machine", refused_step),
    Row("A webhook's receiver is unavailable", receiver_away, receiver),
    Row("A flood of bad messages", flood),
)
