"""What goes into the history comes out again, on SQLite and PostgreSQL alike."""

import stat
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import event, text
from sqlalchemy.exc import DBAPIError

from service.history.machine import MachineStore
from service.history.records import (
    Checkpoint,
    CheckpointHead,
    CheckpointStep,
    Retention,
    Step,
    StoredEvent,
    StoredReading,
    StoredReport,
    StoreError,
    TokenRecord,
)
from service.history.store import Store
from tests.service.rig.live import program
from tests.service.rig.postgres import KINDS, database_url, executed, opened
from tests.sure import sure

NS = 1_000_000_000
T0 = 1_767_225_600 * NS
NUMBERS = count()


@pytest.fixture(scope="module", params=KINDS)
def shared(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    with opened(database_url(request.param, tmp_path_factory.mktemp("shared"))) as made:
        yield made


@pytest.fixture
def lab(shared: Store) -> MachineStore:
    """A machine for one test alone, in the shared history."""
    return shared.machine("demo", f"lab-{next(NUMBERS)}")


def alarm_event(sequence: int, **changes: object) -> StoredEvent:
    fields: dict[str, object] = {
        "sequence": sequence, "id": f"event-{sequence}", "time_ns": T0 + sequence * NS,
        "recorded_ns": T0 + sequence * NS + 7, "kind": "raised", "alarm": "k_by", "severity": "alert",
        "state": "unacknowledged", "occurrence": sequence // 2, "actor": "",
        "text": f'{{"sequence": {sequence}, "note": "ü → ✓"}}',
    }  # fmt: skip
    return StoredEvent(**(fields | changes))  # type: ignore[arg-type]  # fields of any kind


def head(end_ns: int, **changes: object) -> CheckpointHead:
    fields: dict[str, object] = {
        "format": 1, "bundle": None, "machine_hash": "ab12", "code_version": "0.1.0", "end_ns": end_ns,
        "recorded_ns": end_ns + 1, "alarms": "{}", "state": bytes(range(256)),
    }  # fmt: skip
    return CheckpointHead(**(fields | changes))  # type: ignore[arg-type]  # fields of any kind


def hop_step(number: int, ring: int = 3, **parts: object) -> Step:
    """The step of a hop: a report, readings and a checkpoint of `ring` parts, one of which is new."""
    end_ns = T0 + number * 5 * NS
    keep = tuple(f"part {each:06}" for each in range(max(0, number - ring + 1), number))
    fields: dict[str, object] = {
        "reports": (StoredReport(end_ns - 60 * NS, end_ns, "healthy", 0.5, f'{{"number": {number}}}'),),
        "readings": (
            StoredReading(end_ns, "parameter", "k_by", 0.1 * number, 0.01),
            StoredReading(end_ns, "parameter", "e", -0.1 * number, None),
            StoredReading(end_ns, "misfit", "z", 1.5, None),
        ),
        "checkpoint": CheckpointStep(head(end_ns), ((f"part {number:06}", b"part %d" % number),), keep),
    }
    return Step(**(fields | parts))  # type: ignore[arg-type]  # fields of any kind


def test_everything_comes_back_as_it_went_in(store: Store, url: str) -> None:
    lab = store.machine("demo", "lab")
    steps = [hop_step(number, events=(alarm_event(number),)) for number in range(6)]
    for step in steps:
        assert lab.commit(step) is True
    store.close()

    with opened(url) as again:
        lab = again.machine("demo", "lab")
        assert (lab.last_sequence, lab.events()) == (5, tuple(step.events[0] for step in steps))
        assert [report for _, report in lab.reports()] == [step.reports[0] for step in reversed(steps)]
        for place, (quantity, name) in enumerate((("parameter", "k_by"), ("parameter", "e"), ("misfit", "z"))):
            found = [(one.end_ns, one.value, one.standard_error) for one in lab.readings(quantity=quantity, name=name)]
            kept = [step.readings[place] for step in steps]
            assert found == [(one.end_ns, one.value, one.standard_error) for one in kept]
        newest = [(f"part {number:06}", b"part %d" % number) for number in (3, 4, 5)]
        assert lab.restore() == Checkpoint(head(T0 + 25 * NS), tuple(newest))


def test_machines_do_not_see_each_other(store: Store) -> None:
    lab, pump = store.machine("demo", "lab"), store.machine("demo", "pump")
    lab.commit(hop_step(0, events=(alarm_event(0),)))
    assert (pump.last_sequence, pump.restore(), pump.claim.steps) == (-1, None, 0)
    found = pump.events(), pump.reports(), pump.readings(quantity="parameter", name="k_by")
    assert (*found, pump.downsampled(quantity="parameter")) == ((), (), (), ())
    pump.commit(Step(events=(alarm_event(0),)))  # the same id in another machine is another event
    assert pump.last_sequence == 0


def test_a_checkpoint_holds_its_new_parts_and_those_to_keep(lab: MachineStore) -> None:
    for number in range(4):
        lab.commit(hop_step(number))
    cleared = head(T0, bundle="lab", alarms='{"k_by": 1}', state=b"")
    lab.commit(Step(checkpoint=CheckpointStep(cleared, (), ())))
    assert lab.restore() == Checkpoint(cleared, ())
    lab.commit(Step(checkpoint=CheckpointStep(cleared, (("e", b"a"), ("c", b"b")), ())))
    lab.commit(Step(checkpoint=CheckpointStep(cleared, (("e", b"c"),), ("c",))))
    assert lab.restore() == Checkpoint(cleared, (("c", b"b"), ("e", b"c")))
    lab.commit(Step(events=(alarm_event(0),)))  # a step without a checkpoint leaves it alone
    assert lab.restore() == Checkpoint(cleared, (("c", b"b"), ("e", b"c")))


def test_a_step_written_twice_stores_its_events_once(lab: MachineStore) -> None:
    events = tuple(alarm_event(number) for number in range(3))
    assert lab.commit(Step(events=events[:2]))
    assert lab.commit(Step(events=events))
    assert lab.commit(Step(events=events[1:2]))
    assert (lab.events(), lab.last_sequence) == (events, 2)


def test_events_that_contradict_the_log_are_refused_with_their_step(lab: MachineStore) -> None:
    assert lab.commit(Step(events=(alarm_event(0), alarm_event(1))))
    for events, message in (
        ((alarm_event(1, id="other"),), "alarm event 1 has the id other, but the history has it with the id event-1"),
        ((alarm_event(2, id="event-0"),), "alarm event 2 has the id event-0, which alarm event 0 has already"),
        ((alarm_event(3),), r"demo/lab-\d+: alarm event 3 comes after 1, expected 2"),
        ((alarm_event(2), alarm_event(3, id="event-2")), "two alarm events of one step have the same id"),
    ):
        with pytest.raises(StoreError, match=message):
            lab.commit(hop_step(1, events=events))
        assert lab.last_sequence == 1
    assert lab.reports() == ()
    assert lab.restore() is None
    assert lab.commit(hop_step(1, events=(alarm_event(2),)))
    assert len(lab.events()) == 3


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (Step(events=(alarm_event(0, text="a\0b"),)), "alarm event 0: .* holds a NUL character"),
        (Step(events=(alarm_event(0, actor="\ud800"),)), "alarm event 0: .* is not valid text"),
        (Step(events=(alarm_event(0, time_ns=-1),)), "alarm event 0: time_ns is -1, expected 0 or more"),
        (Step(readings=(StoredReading(T0, "misfit", "z", float("nan"), None),)), "misfit z: value is nan"),
        (Step(readings=(StoredReading(2**63, "misfit", "z", 0.0, None),)), "end_ns is 9223372036854775808"),
        (Step(reports=(StoredReport(0, 0, "healthy", float("nan"), "{}"),)), "report: filled is nan"),
        (Step(checkpoint=CheckpointStep(head(-5), (), ())), "checkpoint: end_ns is -5"),
    ],
)
def test_values_no_database_can_store_are_refused_by_name(lab: MachineStore, step: Step, message: str) -> None:
    with pytest.raises(StoreError, match=rf"demo/lab-\d+: .*{message}"):
        lab.commit(step)
    assert lab.claim.steps == 0
    assert lab.commit(hop_step(1, events=(alarm_event(0),)))


def test_waiting_steps_are_committed_together(store: Store) -> None:
    machines = [store.machine("demo", f"m{number}") for number in range(12)]
    commits: list[int] = []
    event.listen(store.database.engine, "commit", lambda connection: commits.append(1))
    ready = threading.Barrier(len(machines))

    def feed(machine: MachineStore) -> None:
        ready.wait()
        for number in range(10):
            assert machine.commit(hop_step(number, events=(alarm_event(number),)))

    with ThreadPoolExecutor(len(machines)) as pool:
        list(pool.map(feed, machines))
    for machine in machines:
        assert [each.sequence for each in machine.events()] == list(range(10))
        assert [report.text for _, report in machine.reports()] == [f'{{"number": {n}}}' for n in range(9, -1, -1)]
    assert 10 <= len(commits) < 120 // 2  # 120 steps


def test_readers_do_not_block_writers(store: Store) -> None:
    lab = store.machine("demo", "lab")
    with store.database.reading() as connection:
        assert connection.scalar(text("SELECT count(*) FROM alarm_events")) == 0
        for number in range(3):
            assert lab.commit(hop_step(number, events=(alarm_event(number),)))
        store.audit.append(**AUDIT)
        assert len(lab.events()) == 3


@pytest.mark.parametrize("table", ["alarm_events", "audit_log"])
def test_append_only_tables_cannot_be_changed(store: Store, url: str, table: str) -> None:
    lab = store.machine("demo", "lab")
    lab.commit(Step(events=(alarm_event(0),)))
    store.audit.append(**AUDIT)
    before = lab.events(), store.audit.entries()
    changes = ["UPDATE {0} SET actor = 'nobody'", "DELETE FROM {0}"]
    if url.startswith("sqlite"):
        changes.append("INSERT OR REPLACE INTO {0} SELECT * FROM {0}")
    else:
        changes.append("TRUNCATE {0}")
    for change in changes:
        with pytest.raises(DBAPIError, match=f"{table} is append-only"):
            executed(url, change.format(table))
    assert (lab.events(), store.audit.entries()) == before


def test_only_one_monitor_can_write_a_machine(store: Store, url: str) -> None:
    store.machine("demo", "lab").commit(Step(events=(alarm_event(0),)))
    with pytest.raises(StoreError, match=r"another monitor writes the history of demo/lab: stop it, or"):
        store.machine("demo", "lab")
    with opened(url) as other:
        with pytest.raises(StoreError, match="another monitor writes the history of demo/lab"):
            other.machine("demo", "lab")
        other.machine("demo", "pump").commit(Step(events=(alarm_event(0),)))
        store.close()
        assert other.machine("demo", "lab").last_sequence == 0


@pytest.mark.parametrize("url", ["postgresql"], indirect=True)
def test_a_new_monitor_waits_until_the_server_releases_the_old_lock(store: Store, url: str) -> None:
    store.machine("demo", "lab").commit(Step(events=(alarm_event(0),)))
    with opened(url) as other:
        ending = threading.Timer(0.3, store.close)
        ending.start()
        assert other.machine("demo", "lab").last_sequence == 0
        ending.join()


def test_a_replaced_monitor_can_no_longer_write(store: Store, url: str) -> None:
    lab = store.machine("demo", "lab")
    assert lab.commit(hop_step(0))
    executed(url, "UPDATE machines SET owner = 'other'")
    for _ in range(2):
        with pytest.raises(StoreError, match="another monitor has taken over the history of demo/lab"):
            lab.commit(hop_step(1, events=(alarm_event(0),)))
    assert len(lab.reports()) == 1
    assert store.writer.trouble == ""


AUDIT: dict[str, Any] = {
    "at_ns": T0, "actor": "anna", "address": "127.0.0.1", "method": "POST", "path": "/api/v1/x", "status": 200,
    "action": "acknowledge", "machine": "demo/lab", "alarm": "k_by", "reason": "seen",
}  # fmt: skip


def test_audit_entries_are_numbered_paged_and_filtered(store: Store) -> None:
    numbers = [
        store.audit.append(
            **AUDIT | {"actor": f"actor {n % 2}", "machine": f"demo/m{n % 3}", "reason": f"{n} \0 \ud800"}
        )
        for n in range(7)
    ]
    assert numbers == sorted(set(numbers))
    found = store.audit.entries()
    assert [entry.number for entry in found] == numbers[::-1]
    assert found[-1].reason == "0 \\0 \\ud800"
    assert (store.audit.entries(limit=3), store.audit.entries(found[2].number, 2)) == (found[:3], found[3:5])
    assert {entry.machine for entry in store.audit.entries(machine="demo/m1")} == {"demo/m1"}
    assert {entry.actor for entry in store.audit.entries(actor="actor 0")} == {"actor 0"}


def test_tokens_are_revoked_once_and_webhook_cursors_are_kept(store: Store) -> None:
    first = TokenRecord("aaaa", "control room", ("read", "operate"), b"\0hash", T0, None, None)
    second = TokenRecord("bbbb", "script", (), b"other", T0 + 1, T0 + 5, None)
    store.tokens.add(second)
    store.tokens.add(first)
    assert (store.tokens.all(), store.tokens.find("bbbb")) == ((first, second), second)
    assert store.tokens.find("cccc") is None
    with pytest.raises(StoreError, match="aaaa: there is one with this identifier already"):
        store.tokens.add(first)
    assert store.tokens.revoke("aaaa", T0 + 9) is True
    assert store.tokens.revoke("aaaa", T0 + 10) is False
    assert store.tokens.revoke("cccc", T0) is False
    revoked = sure(store.tokens.find("aaaa"))
    assert revoked.revoked_ns == T0 + 9
    assert store.webhooks.get("mail", "demo/lab") == -1
    store.webhooks.set("mail", "demo/lab", 4)
    store.webhooks.set("mail", "demo/lab", 6)
    store.webhooks.set("pager", "demo/lab", 1)
    assert store.webhooks.get("mail", "demo/lab") == 6
    assert store.webhooks.get("pager", "demo/lab") == 1
    assert store.webhooks.get("mail", "demo/pump") == -1


def test_a_closed_history_says_so(url: str) -> None:
    store = Store(url, Retention())
    with pytest.raises(StoreError, match="the history is closed"):
        store.tokens.all()
    store.open()
    lab = store.machine("demo", "lab")
    with pytest.raises(StoreError, match="open already"):
        store.open()
    store.close()
    store.close()
    with pytest.raises(StoreError, match="the history is closed"):
        lab.commit(Step())
    with pytest.raises(StoreError, match="the history is closed"):
        lab.events()


def test_history_in_memory_serves_readers_and_writers_at_once() -> None:
    with opened("sqlite:///:memory:") as store:
        machines = [store.machine("demo", f"m{number}") for number in range(4)]

        def feed(machine: MachineStore) -> None:
            for number in range(30):
                assert machine.commit(hop_step(number, events=(alarm_event(number),)))
                assert len(machine.events(limit=1000)) == number + 1
                store.audit.append(**AUDIT)

        with ThreadPoolExecutor(len(machines)) as pool:
            list(pool.map(feed, machines))
        assert len(store.audit.entries(limit=1000)) == 120


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("postgresql://anna:secret@host", "names no database"),
        ("postgresql+asyncpg://anna:secret@host/db", "begins with postgresql.asyncpg"),
        ("postgresql://anna:secret@host:port/db", "the URL cannot be read"),
    ],
)
def test_invalid_database_urls_are_refused_without_showing_the_password(url: str, message: str) -> None:
    with pytest.raises(StoreError, match=message) as caught:
        Store(url, Retention())
    assert "secret" not in str(caught.value)


def test_an_unreachable_server_is_named_without_its_password(tmp_path: Path) -> None:
    store = Store(f"postgresql://anna:s%65cret@/db?host={tmp_path}", Retention(), timeout_s=1.0)
    with pytest.raises(StoreError, match=r"postgresql://anna:\*\*\*@/db") as caught:
        store.open()
    assert "secret" not in str(caught.value)
    assert "secret" not in store.database.shown
    store.close()


def test_a_file_that_is_not_a_history_is_named_and_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "history.sqlite"
    file.write_bytes(b"no database " * 100)
    store = Store(f"sqlite:///{file}", Retention())
    with pytest.raises(StoreError, match=r"history\.sqlite is not a history \(SQLite\), and is left as it is"):
        store.open(set_aside=True)
    assert [path.name for path in tmp_path.iterdir()] == ["history.sqlite"]
    file.write_bytes(bytes(4096))  # as a power failure may leave it
    with pytest.raises(StoreError, match=r"history\.sqlite: file is not a database"):
        store.open()
    (tmp_path / "file").touch()
    store = Store(f"sqlite:///{tmp_path}/file/history.sqlite", Retention())
    with pytest.raises(StoreError, match=r"file/history\.sqlite: "):
        store.open()


def test_sqlite_is_set_up_to_survive_a_power_failure(tmp_path: Path) -> None:
    file = tmp_path / "deep" / "history.sqlite"
    with opened(f"sqlite:///{file}") as store:
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        names = ("journal_mode", "synchronous", "foreign_keys", "busy_timeout", "page_size", "wal_autocheckpoint")
        with store.database.reading() as reader:
            found = [reader.scalar(text(f"PRAGMA {name}")) for name in names]
        assert found == ["wal", 2, 1, 5000, 512, 32000]
    assert executed(f"sqlite:///{file}", "PRAGMA integrity_check") == [("ok",)]


def test_a_killed_writer_leaves_whole_steps(url: str, tmp_path: Path) -> None:
    """No event twice, and everything printed as durable is there."""
    rng = np.random.default_rng(3)
    safe = -1
    for _ in range(4):
        with program(tmp_path, "tests.service.history.test_store", url) as writer:
            writer.wait_for(f"{safe + 3}\n")
            time.sleep(rng.uniform(0.0, 0.05))  # at any moment of a transaction
            writer.kill()
            safe = int(writer.output().rsplit("\n", 2)[-2])
        with opened(url) as store:
            lab = store.machine("demo", "lab")
            last = lab.last_sequence
            steps = (last + 1) // 2
            assert last % 2 == 1  # both events of a step or none
            assert steps - 2 <= safe < steps  # all steps printed as durable, and at most one more
            assert [event.id for event in lab.events(limit=10_000)] == [f"event-{n}" for n in range(last + 1)]
            texts = [report.text for _, report in lab.reports(limit=10_000)]
            assert texts == [f'{{"number": {n}}}' for n in range(steps - 1, -1, -1)]
            assert len(lab.readings(quantity="misfit", name="z", limit=10_000)) == steps
            restored = sure(lab.restore())
            assert [part for _, part in restored.parts] == [b"part %d" % n for n in range(steps - 3, steps)]
            safe = steps - 1


def write_for_ever(url: str) -> None:
    """Continue from what is there and print what has become durable; run by the test of a killed writer."""
    with opened(url) as store:
        lab = store.machine("demo", "lab")
        for number in count(lab.last_sequence // 2 + 1):
            assert lab.commit(hop_step(number, events=(alarm_event(2 * number), alarm_event(2 * number + 1))))
            print(number, flush=True)  # noqa: T201  # to the test


if __name__ == "__main__":
    write_for_ever(sys.argv[1])
