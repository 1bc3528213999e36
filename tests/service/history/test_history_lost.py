"""A history that is locked at the end, deleted, replaced or damaged: it is reported, and monitoring goes on."""

import sqlite3
import stat
from dataclasses import asdict
from pathlib import Path

import pytest
from typer.testing import CliRunner

from models.alarm_names import FAULT
from service.commands.rotorwatch import app
from service.history.records import StoreError, TokenRecord
from service.runtime.runtime import running as running_here
from tests.service.history.test_store import AUDIT, T0, alarm_event
from tests.service.monitor.test_alarm_trouble import Bench, bench, block
from tests.service.rig.live import PATIENT, endpoint, kept_in, machine_file, settings, until
from tests.service.rig.monitored import client
from tests.service.rig.postgres import executed, opened, opened_and_closed
from tests.service.runtime.test_survives import do, running

TOKEN = TokenRecord("aaaa", "control room", ("read",), b"hash", T0, None, None)


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Check more often than every two seconds whether the file is still there."""
    monkeypatch.setattr("service.history.writer._LOOK_S", 0.2)


def test_a_monitor_that_cannot_write_its_last_state_exits_1_and_says_what_is_lost(tmp_path: Path) -> None:
    with running(tmp_path, endpoint(), machine_file(tmp_path, PATIENT)) as at:
        at.url()
        blocker = sqlite3.connect(tmp_path / "history.sqlite", isolation_level=None)  # keeps the file locked
        blocker.execute("BEGIN IMMEDIATE")
        assert at.stop() == 1
        blocker.close()
        (said,) = [line for line in at.errors().splitlines() if line.startswith("could not be written")]
        assert "demo/lab: the state to go on from" in said
        assert "database is locked" in said


def test_a_monitor_whose_last_step_was_refused_exits_1_and_names_the_machine(tmp_path: Path) -> None:
    with running(tmp_path, endpoint(), machine_file(tmp_path, PATIENT)) as at:
        at.url()
        event = asdict(alarm_event(0))  # another program took the number of the next event
        columns, values = ", ".join(event), ", ".join(f":{name}" for name in event)
        took = f"INSERT INTO alarm_events (machine_id, {columns}) SELECT machine_id, {values} FROM machines"  # noqa: S608
        in_file(tmp_path, took, **event)
        do(at, "shelve", "model", "normal", duration_s=3600)
        assert at.stop() == 1
        (said,) = [line for line in at.errors().splitlines() if line.startswith("the history refused the latest step")]
        assert "demo/lab" in said


def history_of(folder: Path) -> Path:
    return folder / "history.sqlite"


def in_file(folder: Path, query: str, **values: object) -> list[tuple[object, ...]]:
    """Query the file at the path from outside the monitor."""
    return executed(f"sqlite:///{history_of(folder)}", query, **values)


def ticked(at: Bench) -> bool:
    """Let time pass for the monitor, as the supervisor does."""
    at.tick()
    return True


@pytest.mark.parametrize("moved", [False, True], ids=["deleted", "moved"])
def test_a_deleted_or_moved_history_is_written_again_in_full(tmp_path: Path, moved: bool) -> None:
    folder = tmp_path / "kept"
    with bench(folder) as at:
        at.put(*map(block, range(12)), block(40, run=2, sequence=0))
        at.store.tokens.add(TOKEN)
        at.store.audit.append(**AUDIT)
        before = at.log()
        assert before
        if moved:
            folder.rename(tmp_path / "moved")
        else:
            history_of(folder).unlink()
        assert "the file was deleted" in at.store.unreachable()
        writer = at.store.writer
        until(lambda: history_of(folder).exists() and at.store.unreachable() == writer.trouble == "", "a new file")
        until(lambda: ticked(at) and len(at.log()) > len(before), "the alarm")
        at.put(*(block(40 + n, run=2, sequence=n) for n in range(1, 15)))
        log = at.log()
        assert log[: len(before) + 1] == [*before, (len(before), "raised", FAULT)]
        assert (at.store.database.lost, at.history.claim.steps) == ("", 0)
    assert in_file(folder, "SELECT sequence, kind, alarm FROM alarm_events ORDER BY sequence")[: len(log)] == log
    assert in_file(folder, "SELECT token_id FROM tokens") == [("aaaa",)]
    assert in_file(folder, "SELECT count(*) FROM audit_log") == [(1,)]
    with bench(folder) as at:
        assert at.worker.restart.startswith("resumed")
        assert at.log()[: len(log)] == log


@pytest.mark.parametrize("damaged", [False, True], ids=["another", "damaged"])
def test_a_replaced_history_continues_the_alarm_sequence_numbers(tmp_path: Path, damaged: bool) -> None:
    other = tmp_path / "other"
    if damaged:
        other.write_bytes(b"\xff no database " * 1000)
    else:
        opened_and_closed(f"sqlite:///{other}")
    with bench(tmp_path) as at:
        at.put(*map(block, range(12)), block(40, run=2, sequence=0))
        at.put(*(block(40 + n, run=2, sequence=n) for n in range(1, 35)))
        last = at.history.last_sequence
        state = in_file(tmp_path, "SELECT count(*) FROM checkpoints")
        assert last >= 0
        other.rename(history_of(tmp_path))
        until(lambda: at.store.database.lost != "", "the notice")
        until(lambda: ticked(at) and at.history.last_sequence > last, "the alarm")
        until(lambda: at.history.claim.steps == 0, "the state in the new file")
        assert at.log() == [(last + 1, "raised", FAULT)]
        assert in_file(tmp_path, "SELECT count(*) FROM checkpoints") == state == [(1,)]
        # No other monitor can take the machine meanwhile.
        with (
            opened(f"sqlite:///{history_of(tmp_path)}") as second,
            pytest.raises(StoreError, match="another monitor writes the history of demo/lab"),
        ):
            second.machine("demo", "lab")
    assert len(list(tmp_path.glob("history.sqlite.damaged-*"))) == damaged
    with bench(tmp_path) as at:
        assert at.worker.restart.startswith("resumed")
        at.put(block(90, run=3, sequence=0))
        assert [number for number, _, _ in at.log()][:2] == [last + 1, last + 2]


def test_sequence_numbers_continue_when_the_file_has_lost_its_alarm_events(tmp_path: Path) -> None:
    with bench(tmp_path) as at:
        at.put(*map(block, range(12)), block(40, run=2, sequence=0))
        last = at.history.last_sequence
    for statement in ("DROP TRIGGER alarm_events_no_delete", "DELETE FROM alarm_events"):
        in_file(tmp_path, statement)
    with bench(tmp_path) as at:
        assert at.history.last_sequence == last
        at.put(block(90, run=3, sequence=0))
        assert at.log()[0][0] == last + 1


@pytest.mark.parametrize("where", ["head", "tables"])
def test_a_monitor_starts_with_a_damaged_history_and_sets_it_aside(tmp_path: Path, where: str) -> None:
    file = history_of(tmp_path)
    plan = settings(endpoint(), machine_file(tmp_path, PATIENT), history=kept_in(tmp_path))
    with running_here(plan):
        pass
    data = bytearray(file.read_bytes())
    start = 0 if where == "head" else 8192
    data[start:] = b"\xa5" * (len(data) - start)
    file.write_bytes(data)
    with running_here(plan) as runtime, client(runtime) as http:
        (kept,) = tmp_path.glob("history.sqlite.damaged-*Z")
        assert kept.read_bytes() == data
        answer = http.get("/readyz")
        assert answer.status_code == 503
        (reason,) = answer.json()["reasons"]
        assert str(kept) in reason
        worker = runtime.machines()[0]
        until(lambda: FAULT in {alarm.name for alarm in worker.alarms().alarms}, "the alarm")
        assert runtime.store.unreachable() == ""
    with running_here(plan) as runtime:
        assert runtime.readiness().ready


def history(folder: Path, *arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(
        app, ["history", *arguments], env={"ROTORWATCH_HISTORY__URL": f"sqlite:///{history_of(folder)}"}
    )
    return done.exit_code, done.output


def test_a_backup_is_taken_from_a_running_monitor_and_restored_to_a_stopped_one(tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    with bench(tmp_path) as at:
        at.put(*map(block, range(12)), block(40, run=2, sequence=0))
        before = at.log()
        assert history(tmp_path, "check")[0] == history(tmp_path, "backup", str(copy))[0] == 0
        assert stat.S_IMODE(copy.stat().st_mode) == 0o600
        assert list(tmp_path.glob("copy*")) == [copy]
        code, said = history(tmp_path, "backup", str(copy))
        assert (code, "expected a new file" in said) == (1, True)
        at.put(block(90, run=3, sequence=0))
        assert len(at.log()) > len(before)
        code, said = history(tmp_path, "restore", str(copy))
        assert (code, "history.sqlite.demo.lab.lock is locked" in said) == (1, True)
    data = bytearray(copy.read_bytes())
    data[8192:] = b"\xa5" * (len(data) - 8192)
    (tmp_path / "damaged").write_bytes(data)
    assert history(tmp_path, "restore", str(tmp_path / "damaged"))[0] == 1
    code, said = history(tmp_path, "restore", str(copy))
    (kept,) = tmp_path.glob("history.sqlite.replaced-*Z")
    assert (code, str(kept) in said) == (0, True)
    assert not list(tmp_path.glob("*.restored*"))
    with bench(tmp_path) as at:
        assert at.log()[: len(before)] == before
    assert history(tmp_path / "another" / "computer", "restore", str(copy))[0] == 0
    history_of(tmp_path).write_bytes(data)
    for end in ("-wal", "-shm"):
        Path(f"{history_of(tmp_path)}{end}").unlink(missing_ok=True)
    assert history(tmp_path, "check")[0] == 1


def test_history_check_on_postgresql_refers_to_pg_dump() -> None:
    address = {"ROTORWATCH_HISTORY__URL": "postgresql://anna:secret@host/db"}
    done = CliRunner().invoke(app, ["history", "check"], env=address)
    assert (done.exit_code, "pg_dump" in done.output, "secret" in done.output) == (2, True, False)
