"""Commits the steps of machines, all that wait at a time, and tries again while the database fails."""

import os
import secrets
import threading
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress

import structlog
from sqlalchemy import Connection, func, select, text, update
from sqlalchemy.exc import DBAPIError, InterfaceError, InternalError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from service.history.claim import Claim, PackedReport, StepBundle
from service.history.database import Database
from service.history.file import lock_file
from service.history.group import SeriesNumbers, write_group
from service.history.records import Step, StoreError
from service.history.tables import machines

_LOCK = 0x726F746F  # first number of PostgreSQL's advisory locks; the second is the machine's
_LOOK_S = 2.0  # between looks whether the database is still where it should be
_LETS_GO_S = 2.0  # within this time PostgreSQL notices that a killed monitor is gone
_ENDS_S = 6.0  # until a process that shares the machines ends after it has lost its monitor
_AGAIN_S = 0.05
_PATIENCE = 4.0  # times the database's timeout: others may be before this step
_log = structlog.get_logger("rotorwatch", part="history")


class Writer:
    """One thread and one connection, over which all machines of this monitor are written.

    In PostgreSQL the same connection holds the locks on the machines, so that they are released when it breaks; then
    the owner's mark in the table says whether another monitor has come in between.
    """

    def __init__(
        self, database: Database, retry_s: float, most_reports: int, bucket_ns: int, *, shared: bool = False
    ) -> None:
        self._database = database
        self._retry_s = retry_s
        self._most_reports = most_reports
        self.bucket_ns = bucket_ns
        self._shared = shared
        self._claims: list[Claim] = []
        self._files = ExitStack()
        self._series: SeriesNumbers = {}
        self._connection: Connection | None = None
        self._turn = threading.Lock()  # on the connection; taken before `_lock` if both are
        self._lock = threading.RLock()  # on waiting steps and their trouble; never held while the database works
        self._wake = threading.Event()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="history-writer", daemon=True)
        self.trouble = ""

    def start(self) -> None:
        """Begin to write what is submitted."""
        self._thread.start()

    def stop(self) -> None:
        """Write what waits, if the database takes it, and release all machines.

        Raises
        ------
        StoreError
            If the database does not take it, saying what is lost.
        """
        with self._lock:
            self._stopping.set()  # steps submitted before this are still written
        self._wake.set()
        self._thread.join(self._database.answer_s)
        if not self._thread.is_alive():
            self._let_go()
        self._files.close()
        left = [claim for claim in self._claims if claim.steps]
        if lost := [f"{claim.title}: {claim.contents()} ({self.trouble or claim.trouble})" for claim in left]:
            raise StoreError(f"could not be written before the end, and is lost: {'; '.join(lost)}")

    def claim(self, site: str, name: str) -> Claim:
        """Register a machine and take the right to write it.

        Raises
        ------
        StoreError
            If another monitor, or this one already, writes it.
        """
        claim = Claim(site, name, self._most_reports)
        with self._database.plainly(), self._connected() as connection:
            if any(other.title == claim.title for other in self._claims):
                raise _claimed_elsewhere(claim)
            self._take(connection, claim)
            self._claims.append(claim)
        return claim

    def submit(self, claim: Claim, step: Step, packed: Iterable[PackedReport], recorded_ns: int) -> bool:
        """Put a step behind those that wait and say whether it has become durable.

        Raises
        ------
        StoreError
            If it is refused for good.
        """
        with self._lock:
            if claim.lost is not None:
                raise claim.lost
            if self._stopping.is_set():
                raise StoreError("the history is closed")
            claim.add(step, recorded_ns, packed)
            if self.trouble or claim.trouble:
                return False  # the machine's thread must not wait for a database that does not answer
            heard: Future[bool] = Future()
            claim.waiting.heard.append(heard)
        self._wake.set()
        try:
            return heard.result(_PATIENCE * self._database.timeout_s)
        except TimeoutError as error:
            with self._lock:
                if heard.done():
                    return heard.result()  # written at the last moment
                self._fail([claim], str(self._database.failure(error)))
            return False

    def _run(self) -> None:
        stopping = False
        while not stopping:
            troubled = self.trouble or any(claim.trouble for claim in self._claims)
            self._wake.wait(self._retry_s if troubled else _LOOK_S)
            self._wake.clear()
            stopping = self._stopping.is_set()
            while self._in_place() and (ready := self._ready(stopping)) and self._write(ready):
                pass  # until nothing waits any more, or something goes wrong

    def _ready(self, at_once: bool) -> list[Claim]:
        """Machines with something to write now; those whose step the database did not take wait, unless `at_once`."""
        now_s = time.monotonic()
        with self._lock:
            due = [claim for claim in self._claims if at_once or not claim.trouble or claim.retry_s <= now_s]
            return [claim for claim in due if claim.take()]

    def _write(self, ready: list[Claim]) -> bool:
        """Write one transaction; say whether the database has taken all of it."""
        try:
            with self._connected() as connection, connection.begin():
                refused, series = write_group(self._database, connection, ready, self._series, self.bucket_ns)
        except Exception as error:
            # Nothing narrower: whatever a driver raises, this thread must go on, or no machine would be written again.
            why = str(self._database.failure(error))
            if self._database.found_damaged(error) or _is_operational(error):
                self._fail(ready, why)
            elif len(ready) > 1:
                # The database works, but one machine's step is at fault: the others must not wait for it.
                taken = [self._write([claim]) for claim in ready]
                return all(taken)
            else:
                self._refuse(ready[0], why)
            return False
        self._series.update(series)
        with self._lock:
            for claim in ready:
                bundle, claim.attempt, claim.trouble = claim.attempt, StepBundle(), ""
                refusal = refused.get(claim)
                if refusal is None:
                    claim.written += 1
                elif not bundle.heard:
                    _log.error("a step was refused", why=str(refusal))
                bundle.settle(refusal, written=True)
            self._recover()
        return True

    def _in_place(self) -> bool:
        """Whether the database is at its address; one that was deleted, replaced or damaged is begun anew."""
        why, generation = self._database.astray(), self._database.generation
        if not self._claims or not (why or any(claim.generation != generation for claim in self._claims)):
            return True
        if self._shared:
            self._fail(self._claims, f"{why}; start the monitor again")
            return False
        self._fail(self._claims, why or self.trouble)
        try:
            if why:
                with self._turn, self._database.alone():
                    self._database.begin_anew(why, self._connection)
                    self._disconnect(broken=True)
                    self._series.clear()
                    self._files.close()
            with self._connected() as connection:
                for claim in self._claims:
                    self._take_again(connection, claim)
        except Exception as error:
            # As in `_write`: this thread must go on, and try again.
            failure = f"a new one could not be begun: {self._database.failure(error)}"
            self._fail(self._claims, f"{why or self._database.news}; {failure}")
            return False
        _log.error("the history continues in another file", why=self._database.news)
        self._recover()
        return True

    def _take_again(self, connection: Connection, claim: Claim) -> None:
        """Take the right to write a machine in the file that is at the address now."""
        if claim.generation == self._database.generation:
            return
        steps = claim.written
        try:
            self._take(connection, claim)
        except StoreError as error:
            claim.lost, claim.generation = error, self._database.generation
            return
        claim.trouble = ""
        if not self._database.lost:
            claim.written = steps

    def _take(self, connection: Connection, claim: Claim) -> None:
        """Take the right to write a machine; StoreError if another monitor has it."""
        number = select(machines.c.machine_id).where(machines.c.site == claim.site, machines.c.name == claim.name)
        new = {"site": claim.site, "name": claim.name, "owner": "", "steps": 0, "reports": 0, "windows": 0}
        owner, file = secrets.token_hex(16), self._database.file
        patience = time.monotonic() + min(_LETS_GO_S, self._database.timeout_s)
        with ExitStack() as undo:
            if file is not None:
                path = file.path.with_name(f"{file.path.name}.{claim.site}.{claim.name}.lock")
                # A process that shares the machines may be ending, on its own, after its monitor was killed.
                while (descriptor := lock_file(path)) is None:
                    if not self._shared or time.monotonic() > patience + _ENDS_S:
                        raise _claimed_elsewhere(claim)
                    time.sleep(_AGAIN_S)
                undo.callback(os.close, descriptor)
            with connection.begin():
                if (found := connection.scalar(number)) is None:
                    connection.execute(self._database.insert(machines).values(new).on_conflict_do_nothing())
                    found = connection.execute(number).scalar_one()
                if not self._database.is_sqlite:
                    while not _lock_row(connection, found):
                        if time.monotonic() > patience:
                            raise _claimed_elsewhere(claim)
                        time.sleep(_AGAIN_S)
                chosen = machines.c.machine_id == found
                connection.execute(update(machines).where(chosen).values(owner=owner))
                steps = connection.execute(select(machines.c.steps).where(chosen)).scalar_one()
            self._files.push(undo.pop_all())
        claim.machine_id, claim.owner, claim.written, claim.generation = found, owner, steps, self._database.generation

    @contextmanager
    def _connected(self) -> Iterator[Connection]:
        """The connection, for one thread at a time; after an error a new one is made."""
        with self._turn, self._database.alone():
            try:
                if self._connection is None:
                    self._connection = self._database.engine.connect()
                    self._database.to_write(self._connection)
                    for claim in self._claims:
                        claim.locked = False
                with self._database.using(2 * self._database.timeout_s, self._connection) as connection:
                    self._lock_again(connection)
                    yield connection
            except StoreError:
                raise
            except Exception:  # of any kind: it leaves the connection in an unknown state
                self._disconnect(broken=True)
                raise

    def _lock_again(self, connection: Connection) -> None:
        """Take again the locks in PostgreSQL that were lost with a former connection."""
        unlocked = [claim for claim in self._claims if not claim.locked and claim.lost is None]
        if unlocked and not self._database.is_sqlite:
            with connection.begin():
                for claim in unlocked:
                    # That connection may still hold it for a while; the owner's mark protects us meanwhile.
                    claim.locked = _lock_row(connection, claim.machine_id)

    def _let_go(self) -> None:
        """Release the locks in PostgreSQL, as the server may notice the end of a connection late."""
        if self._connection is not None and not self._database.is_sqlite:
            with suppress(StoreError, SQLAlchemyError, OSError), self._connected() as connection:
                connection.execute(text("SELECT pg_advisory_unlock_all()"))
        self._disconnect()

    def _disconnect(self, broken: bool = False) -> None:
        connection, self._connection = self._connection, None
        if connection is None:
            return
        with suppress(SQLAlchemyError, OSError):
            if broken and not self._database.in_memory:
                connection.invalidate()  # whatever state it is in: it is not used again
        with suppress(SQLAlchemyError, OSError):
            connection.close()

    def _fail(self, claims: Iterable[Claim], trouble: str) -> None:
        with self._lock:
            if trouble != self.trouble:
                _log.error("the history cannot be written; events wait in memory", why=trouble)
            self.trouble = trouble
            for claim in claims:
                claim.put_off()

    def _refuse(self, claim: Claim, trouble: str) -> None:
        """Note that the database does not take one machine's step, which is tried again after a while."""
        with self._lock:
            if trouble != claim.trouble:
                _log.error("the history does not accept what happens", machine=claim.title, why=trouble)
            claim.trouble = trouble
            claim.retry_s = time.monotonic() + self._retry_s
            claim.put_off()

    def _recover(self) -> None:
        if not self.trouble:
            return
        with self._lock:
            self.trouble = ""
            for claim in self._claims:
                if claim.dropped_reports or claim.dropped_readings:
                    _log.error(
                        "reports and readings were dropped while the history could not be written",
                        machine=claim.title, reports=claim.dropped_reports, readings=claim.dropped_readings,
                    )  # fmt: skip
                    claim.dropped_reports = claim.dropped_readings = 0
        _log.info("the history is being written again")


def _claimed_elsewhere(claim: Claim) -> StoreError:
    return StoreError(
        f"another monitor writes the history of {claim.title}: stop it, or give this one its own [history] url"
    )


def _is_operational(error: Exception) -> bool:
    """Whether the database is at fault, and not what was to be written."""
    if isinstance(error, DBAPIError) and error.connection_invalidated:
        return True
    return isinstance(error, (OperationalError, InterfaceError, InternalError, PoolTimeoutError, OSError))


def _lock_row(connection: Connection, machine_id: int) -> bool:
    return bool(connection.scalar(select(func.pg_try_advisory_lock(_LOCK, machine_id))))
