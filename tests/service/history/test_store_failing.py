"""The database fails and comes back: nothing is lost, nothing is there twice, the order is kept."""

import os
import select as sockets
import signal
import socket
import socketserver
import sqlite3
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import psycopg
import pytest
from sqlalchemy import Select, func, literal, select, text

from service.history.database import Database
from service.history.machine import MachineStore
from service.history.records import Step, StoreError
from service.history.store import Store
from service.history.tables import MIGRATING
from tests.service.history.test_store import T0, alarm_event, head, hop_step
from tests.service.rig.live import until
from tests.service.rig.postgres import KINDS, USER, PostgresServer, database_url, executed, postgres_server
from tests.service.rig.postgres import opened as history_opened
from tests.sure import sure

QUICK_S = 1.0


Parts = tuple[str, Callable[[], object], Callable[[], object]]


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    """A server of this module alone, which its tests may stop."""
    with postgres_server() as made:
        yield made


@pytest.fixture(params=KINDS)
def parts(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Parts]:
    """A database, what makes it fail, and what brings it back."""
    if request.param == "postgresql":
        server: PostgresServer = request.getfixturevalue("server")
        yield server.new_database(), server.stop, server.start
        return
    file = tmp_path / "history.sqlite"
    blocker = sqlite3.connect(file, isolation_level=None)  # another program that keeps the file locked
    try:
        yield f"sqlite:///{file}", lambda: blocker.execute("BEGIN IMMEDIATE"), lambda: blocker.execute("ROLLBACK")
    finally:
        blocker.close()


opened = partial(history_opened, timeout_s=QUICK_S, retry_s=0.05)


def written(machine: MachineStore, step: Step) -> None:
    """Commit a step; on a busy computer the first try may take longer than this store waits."""
    machine.commit(step)
    until(lambda: machine.claim.steps == 0, "step in the database")


def test_nothing_is_lost_while_the_database_is_unreachable(parts: Parts) -> None:
    url, fail, mend = parts
    with opened(url) as store:
        lab, pump = store.machine("demo", "lab"), store.machine("demo", "pump")
        for number in range(3):
            written(lab, hop_step(number, events=(alarm_event(number),)))
        assert store.unreachable() == store.writer.trouble == ""
        fail()
        assert store.unreachable() != ""  # it shows before anything is written
        assert store.writer.trouble == ""
        for number in range(3, 40):
            assert not lab.commit(hop_step(number, events=(alarm_event(number),)))
            assert not pump.commit(hop_step(number, events=(alarm_event(number - 3),)))
        assert store.writer.trouble != ""
        assert (lab.claim.steps, lab.last_sequence) == (37, 39)
        mend()
        until(lambda: lab.claim.steps == pump.claim.steps == 0, "recovery")
        until(lambda: store.unreachable() == "", "answer of the database")
        assert store.writer.trouble == ""
        with opened(url) as other, pytest.raises(StoreError, match="another monitor writes the history of demo/lab"):
            other.machine("demo", "lab")  # its locks are taken again
        written(lab, hop_step(40, events=(alarm_event(40),)))
        assert [event.sequence for event in lab.events()] == list(range(41))
        assert [event.sequence for event in pump.events()] == list(range(37))
        assert [report.text for _, report in lab.reports()] == [f'{{"number": {n}}}' for n in range(40, -1, -1)]
        assert [round(each.value / 0.1) for each in lab.readings(quantity="parameter", name="k_by")] == list(range(41))
        restored = sure(lab.restore())
        assert restored.head == head(T0 + 40 * 5_000_000_000)
        assert [part for _, part in restored.parts] == [b"part 38", b"part 39", b"part 40"]


def test_waiting_reports_are_bounded_and_events_are_never_dropped(parts: Parts) -> None:
    url, fail, mend = parts
    with opened(url, waiting_reports=5) as store:
        lab = store.machine("demo", "lab")
        written(lab, hop_step(0, events=(alarm_event(0),)))
        fail()
        for number in range(1, 60):
            assert not lab.commit(hop_step(number, events=(alarm_event(number),)))
        mend()
        until(lambda: lab.claim.steps == 0, "recovery")
        assert [event.sequence for event in lab.events()] == list(range(60))
        # The step that was tried first is kept as it was; then the newest five.
        assert [report.text for _, report in lab.reports()] == [
            f'{{"number": {n}}}' for n in (59, 58, 57, 56, 55, 1, 0)
        ]  # fmt: skip
        kept = [round(each.value / 0.1) for each in lab.readings(quantity="parameter", name="k_by")]
        assert kept == [0, 1, 55, 56, 57, 58, 59]
        restored = sure(lab.restore())
        assert [part for _, part in restored.parts] == [b"part 57", b"part 58", b"part 59"]


def test_waiting_steps_are_written_on_close(parts: Parts) -> None:
    url, fail, mend = parts
    with history_opened(url, timeout_s=QUICK_S, retry_s=3600.0) as store:
        lab = store.machine("demo", "lab")
        fail()
        assert not lab.commit(Step(events=(alarm_event(0),)))
        assert not lab.commit(Step(events=(alarm_event(1),)))
        mend()
    with opened(url) as store:
        assert store.machine("demo", "lab").last_sequence == 1


def test_a_failing_step_of_one_machine_does_not_hold_up_the_others(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/history.sqlite"
    with opened(url) as store:
        lab, pump = store.machine("demo", "lab"), store.machine("demo", "pump")
        # A fault that only the database notices: a number of reports that is not a number any more.
        executed(url, "UPDATE machines SET reports = 'many' WHERE name = 'lab'")
        assert not lab.commit(hop_step(0, events=(alarm_event(0),)))
        pump.commit(hop_step(0, events=(alarm_event(0),)))
        until(lambda: pump.claim.steps == 0, "the other machine's step")
        assert len(pump.events()) == 1
        assert store.writer.trouble == ""  # the database works
        assert (lab.claim.steps, lab.claim.trouble != "", pump.claim.trouble) == (1, True, "")
        assert pump.commit(hop_step(1, events=(alarm_event(1),)))  # at once, whatever becomes of the other
        assert not lab.commit(hop_step(1, events=(alarm_event(1),)))
        executed(url, "UPDATE machines SET reports = 0 WHERE name = 'lab'")
        until(lambda: lab.claim.steps == 0, "the step")
        assert lab.claim.trouble == ""
        assert len(lab.events()) == len(lab.reports()) == 2


class LosingProxy(socketserver.ThreadingUnixStreamServer):
    """Proxy for a server's socket that, when armed, drops the reply to a commit and hangs up."""

    def __init__(self, server: PostgresServer, folder: Path) -> None:
        super().__init__(str(folder / ".s.PGSQL.5432"), _Relay)
        self.target = str(server.folder / ".s.PGSQL.5432")
        self.armed = threading.Event()
        self.swallowed = 0


class _Relay(socketserver.BaseRequestHandler):
    server: LosingProxy

    def handle(self) -> None:
        client: socket.socket = self.request
        losing = False
        with socket.socket(socket.AF_UNIX) as target:
            target.connect(self.server.target)
            while True:
                for source in sockets.select([client, target], [], [])[0]:
                    data = source.recv(65536)
                    if source is target and losing:
                        assert b"COMMIT" in data  # the server has committed
                        self.server.armed.clear()
                        self.server.swallowed += 1
                        return
                    if not data:
                        return
                    losing |= source is client and b"COMMIT" in data and self.server.armed.is_set()
                    (target if source is client else client).sendall(data)


@contextmanager
def losing_proxy(server: PostgresServer) -> Iterator[tuple[LosingProxy, str]]:
    # Not below pytest's folders: the path of a socket is limited to about a hundred characters.
    with tempfile.TemporaryDirectory(prefix="pg-") as folder, LosingProxy(server, Path(folder)) as proxy:
        thread = threading.Thread(target=proxy.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield proxy, folder
        finally:
            proxy.shutdown()
            thread.join()


def test_a_step_whose_commit_reply_was_lost_is_stored_once(server: PostgresServer) -> None:
    url = server.new_database()
    with losing_proxy(server) as (proxy, folder), opened(url.replace(str(server.folder), folder)) as store:
        lab = store.machine("demo", "lab")
        for number in range(20):
            if number % 3 == 1:
                proxy.armed.set()
            lab.commit(hop_step(number, events=(alarm_event(number),)))
            until(lambda: lab.claim.steps == 0, "the step")
        assert proxy.swallowed == 7
        assert [event.sequence for event in lab.events()] == list(range(20))
        assert [report.text for _, report in lab.reports()] == [f'{{"number": {n}}}' for n in range(19, -1, -1)]
        assert len(lab.readings(quantity="misfit", name="z")) == 20


@contextmanager
def hanging(store: Store) -> Iterator[None]:
    """Suspend the server's process for the writer's connection."""
    ((pid,),) = store.database.rows(
        select(text("pid")).select_from(text("pg_locks")).where(text("locktype = 'advisory' AND objid = 1"))
    )
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


@pytest.mark.parametrize("encoding", ["SQL_ASCII", "LATIN1"])
def test_a_database_without_utf8_encoding_is_refused(server: PostgresServer, encoding: str) -> None:
    name = f"history_{encoding.lower()}"
    place = ("-h", str(server.folder), "-U", USER)
    server.run("createdb", *place, "-T", "template0", "-E", encoding, "--locale=C", name)
    database = Database(server.url(name), QUICK_S)
    with pytest.raises(StoreError, match=f"{name}.*: the encoding of the database is {encoding}, expected UTF8"):
        database.start()


def test_the_writer_uses_another_connection_when_the_server_hangs(server: PostgresServer) -> None:
    with opened(server.new_database()) as store:
        lab = store.machine("demo", "lab")
        written(lab, hop_step(0, events=(alarm_event(0),)))
        with hanging(store):
            assert not lab.commit(hop_step(1, events=(alarm_event(1),)))
            until(lambda: lab.claim.steps == 0, "the step over another connection")
            assert len(lab.events()) == 2


def test_a_reader_gets_an_error_when_the_server_hangs_and_then_a_new_connection(server: PostgresServer) -> None:
    database = Database(server.new_database(), QUICK_S)
    database.start()
    ((pid,),) = database.rows(select(func.pg_backend_pid()))  # of the one connection in the pool
    database.answer_s = 0.5
    answers: list[str] = []

    def ask() -> None:
        try:
            database.rows(select(literal(1)))
        except StoreError as error:
            answers.append(str(error))

    asking = threading.Thread(target=ask, daemon=True)
    os.kill(pid, signal.SIGSTOP)
    try:
        asking.start()
        asking.join(60.0)
        assert ["no answer in time" in answer for answer in answers] == [True]
        assert [tuple(row) for row in database.rows(select(literal(1)))] == [(1,)]
    finally:
        os.kill(pid, signal.SIGCONT)
        database.stop()


def test_a_connection_closed_by_the_server_is_replaced_silently(server: PostgresServer) -> None:
    url = server.new_database()
    database, other = Database(url, QUICK_S), Database(url, QUICK_S)
    database.start()
    other.start()
    ((pid,),) = database.rows(select(func.pg_backend_pid()))
    assert [tuple(row) for row in other.rows(select(func.pg_terminate_backend(pid, 60_000)))] == [(True,)]
    assert [tuple(row) for row in database.rows(select(literal(1)))] == [(1,)]
    database.stop()
    other.stop()


def test_a_start_waits_for_a_migration_as_long_as_it_takes(server: PostgresServer) -> None:
    url = server.new_database()
    with psycopg.connect(url) as migrating:
        migrating.execute("SELECT pg_advisory_lock(%s, %s)", MIGRATING)
        database = Database(url, QUICK_S)
        database.answer_s = 0.5
        starting = threading.Thread(target=database.start, daemon=True)
        starting.start()
        starting.join(2.0)  # longer than any other question may take
        assert starting.is_alive()
    starting.join(60.0)
    assert not starting.is_alive()
    database.stop()


def test_close_does_not_wait_for_a_hung_server(server: PostgresServer) -> None:
    with opened(server.new_database()) as store:
        written(store.machine("demo", "lab"), hop_step(0))
        ending = threading.Thread(target=store.close, daemon=True)
        with hanging(store):
            ending.start()
            ending.join(60.0)
            assert not ending.is_alive()


def test_commits_return_while_the_disk_hangs_and_are_written_later(tmp_path: Path) -> None:
    with opened(f"sqlite:///{tmp_path}/history.sqlite") as store:
        lab = store.machine("demo", "lab")
        with store.writer._turn:  # the writer's thread comes no further than this
            assert not lab.commit(hop_step(0, events=(alarm_event(0),)))
            assert "no answer in time" in store.writer.trouble
            assert not lab.commit(hop_step(1, events=(alarm_event(1),)))
            assert lab.claim.steps == 2
        until(lambda: lab.claim.steps == 0, "recovery")
        assert store.writer.trouble == ""
        assert [event.sequence for event in lab.events()] == [0, 1]
        written(lab, hop_step(2))


ONES = select(literal(1).label("n")).cte("ones", recursive=True)
ENDLESS = select(func.count()).select_from(ONES.union_all(select(ONES.c.n)))
"""A query that never ends by itself."""


@pytest.mark.parametrize("kind", KINDS)
def test_queries_running_at_close_end_with_an_error(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.history.database._FINISH_S", 0.05)
    database = Database(database_url(kind, tmp_path), QUICK_S)
    database.answer_s = 5.0  # as long as PostgreSQL continues a query that no client waits for
    database.start()
    database.answer_s = 60.0
    answers: list[str] = []

    def ask(query: Select[int]) -> None:
        try:
            while True:
                database.rows(query)
        except StoreError as error:
            answers.append(str(error))

    threads = [threading.Thread(target=ask, args=(one,), daemon=True) for one in (ENDLESS, *[select(literal(1))] * 4)]
    for thread in threads:
        thread.start()
    until(lambda: len(database._uses) == len(threads), "all who ask")
    database.stop()
    for thread in threads:
        thread.join(60.0)
    assert len(answers) == 5
    assert all("closed" in answer for answer in answers)
    assert not database._uses


@pytest.mark.parametrize("kind", [*KINDS, "memory"])
def test_a_query_that_takes_too_long_is_cancelled(kind: str, tmp_path: Path) -> None:
    database = Database("sqlite:///:memory:" if kind == "memory" else database_url(kind, tmp_path), QUICK_S)
    database.answer_s = 5.0  # after which a PostgreSQL server ends a query by itself
    database.start()
    database.answer_s = 0.1
    try:
        with pytest.raises(StoreError, match="no answer in time"):
            database.rows(ENDLESS)
        assert [tuple(row) for row in database.rows(select(literal(1)))] == [(1,)]
    finally:
        database.stop()
