"""Commits what the machines bring, as many at a time as wait, and tries again while the database fails."""

import asyncio
import fcntl
import os
import secrets
from contextlib import ExitStack, suppress
from pathlib import Path

import structlog
from sqlalchemy import select, text, update
from sqlalchemy.exc import DBAPIError, InterfaceError, InternalError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.ext.asyncio import AsyncConnection

from service.store.backlog import Backlog, PackedReport
from service.store.database import Database
from service.store.errors import StoreError
from service.store.group import Claim, SeriesNumbers, write_group
from service.store.records import Step
from service.store.tables import machines

__all__ = ["Writer", "lock_file"]

_LOCK = 0x726F746F  # first number of PostgreSQL's advisory locks; the second is the machine's
_LOOK_S = 2.0  # between looks whether the database is still where it should be
_PATIENCE = 4.0  # times the database's timeout: others may be before this step
_log = structlog.get_logger("rotorwatch", part="history")


class Writer:
    """One connection, over which all machines of this monitor are written.

    In PostgreSQL the same connection holds the locks on the machines, so that they are let go when it breaks; then
    the mark of the owner in the table says whether another monitor has come in between.

    Parameters
    ----------
    database : Database
        Where to.
    retry_s : float
        Time between attempts while the database fails, in seconds.
    most_reports : int
        Reports of one machine that wait meanwhile.
    bucket_ns : int
        Length of the buckets that readings are added to.
    """

    def __init__(self, database: Database, retry_s: float, most_reports: int, bucket_ns: int) -> None:
        self._database = database
        self._retry_s = retry_s
        self._most_reports = most_reports
        self._bucket_ns = bucket_ns
        self._claims: dict[int, Claim] = {}
        self._files = ExitStack()
        self._series: SeriesNumbers = {}
        self._connection: AsyncConnection | None = None
        self._turn = asyncio.Lock()
        self._wake = asyncio.Event()
        self._stopping = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self.trouble = ""

    async def start(self) -> None:
        """Begin to write what is submitted."""
        self._task = asyncio.create_task(self._run())

    async def stop(self) -> None:
        """Write what waits, if the database takes it, and let go of all machines.

        Raises
        ------
        StoreError
            Saying what is lost, if the database does not take it.
        """
        self._stopping.set()
        self._wake.set()
        if self._task is not None:
            await self._task
        await self._disconnect()
        self._files.close()
        claims = list(self._claims.values())
        self._claims.clear()
        lost = [
            f"{claim.title}: {claim.backlog.contents()} ({self.trouble or claim.trouble})"
            for claim in claims
            if claim.backlog.steps
        ]
        if lost:
            raise StoreError(f"could not be written before the end, and is lost: {'; '.join(lost)}")

    async def claim(self, site: str, name: str) -> Claim:
        """Register a machine and take the right to write it.

        Raises
        ------
        StoreError
            If another monitor, or this one already, writes it.
        """
        async with self._turn, self._database.alone():
            try:
                return await self._claim(await self._connected(), site, name)
            except (SQLAlchemyError, OSError):
                await self._disconnect(broken=True)
                raise

    async def _claim(self, connection: AsyncConnection, site: str, name: str) -> Claim:
        machine_id, owner, steps = await self._take(connection, site, name)
        backlog = Backlog(self._most_reports)
        claim = Claim(machine_id, f"{site}/{name}", owner, backlog, steps, generation=self._database.generation)
        self._claims[machine_id] = claim
        return claim

    async def _take(self, connection: AsyncConnection, site: str, name: str) -> tuple[int, str, int]:
        """Take the right to write a machine: its number, the mark left in the database, steps written so far."""
        machine_id = await self._register(connection, site, name)
        taken = StoreError(f"another monitor writes the history of {site}/{name}")
        if machine_id in self._claims:
            raise taken
        owner = secrets.token_hex(16)
        chosen = machines.c.machine_id == machine_id
        with ExitStack() as undo:
            if self._database.file is not None:
                descriptor = lock_file(self._database.file.with_name(f"{self._database.file.name}.{site}.{name}.lock"))
                if descriptor is None:
                    raise taken
                undo.callback(os.close, descriptor)
            elif not self._database.is_sqlite and not await _lock_row(connection, machine_id):
                raise taken
            async with connection.begin():
                await connection.execute(update(machines).where(chosen).values(owner=owner))
                steps: int | None = await connection.scalar(select(machines.c.steps).where(chosen))
            self._files.push(undo.pop_all())
        return machine_id, owner, steps or 0

    async def _register(self, connection: AsyncConnection, site: str, name: str) -> int:
        number = select(machines.c.machine_id).where(machines.c.site == site, machines.c.name == name)
        new = {"site": site, "name": name, "owner": "", "steps": 0, "reports": 0, "evaluations": 0}
        async with connection.begin():
            found: int | None = await connection.scalar(number)
            if found is not None:
                return found
            await connection.execute(self._database.insert(machines).values(new).on_conflict_do_nothing())
        async with connection.begin():
            made: int = (await connection.execute(number)).scalar_one()
        return made

    async def submit(self, claim: Claim, step: Step, packed: tuple[PackedReport, ...], recorded_ns: int) -> bool:
        """Put a step behind those that wait and say whether it has become durable.

        Raises
        ------
        StoreError
            If it is refused for good.
        """
        if claim.lost is not None:
            raise claim.lost
        if self._stopping.is_set():
            raise StoreError("the history is closed")
        claim.backlog.add(step, recorded_ns, packed)
        if self.trouble or claim.trouble:
            return False  # the machine's thread must not wait for a database that does not answer
        heard: asyncio.Future[bool] = asyncio.get_running_loop().create_future()
        claim.backlog.waiting.heard.append(heard)
        self._wake.set()
        try:
            return await asyncio.wait_for(heard, _PATIENCE * self._database.timeout_s)
        except TimeoutError:
            return False

    async def _run(self) -> None:
        while True:
            troubled = any(claim.trouble for claim in self._claims.values())
            with suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), self._retry_s if troubled else _LOOK_S)
            self._wake.clear()
            while await self._in_place() and (ready := [claim for claim in self._claims.values() if self._due(claim)]):
                if await self._write(ready):
                    continue
                if self._stopping.is_set():
                    return
                if self.trouble:
                    with suppress(TimeoutError):
                        await asyncio.wait_for(self._stopping.wait(), self._retry_s)
            if self._stopping.is_set():
                return

    async def _in_place(self) -> bool:
        """Whether the database is at its address; one that was deleted, replaced or damaged is begun anew."""
        if not self._claims or not (why := self._database.astray()):
            return True
        claims = list(self._claims.values())
        self._fail(claims, why)
        try:
            async with self._turn, self._database.alone():
                await self._begin_anew(why, claims)
        except Exception as error:
            # As in `_write`: this task must go on, and try again.
            self._claims = {claim.machine_id: claim for claim in claims}
            self._fail(claims, f"{why}; it could not be begun anew: {self._database.failure(error)}")
            return False
        _log.error("the history goes on in another file", why=self._database.news)
        self._recover()
        return True

    async def _begin_anew(self, why: str, claims: list[Claim]) -> None:
        """Go on in the file at the address, with the same machines."""
        rescued = await self._database.rescue(self._connection)
        await self._disconnect(broken=True)
        await self._database.reconnect(why, rescued)
        self._series.clear()
        self._claims.clear()
        self._files.close()
        connection = await self._connected()
        for claim in claims:
            site, _, name = claim.title.partition("/")
            try:
                claim.machine_id, claim.owner, steps = await self._take(connection, site, name)
            except StoreError as error:
                claim.lost = error
                continue
            claim.steps = claim.steps if rescued else steps
            claim.trouble = ""
            claim.generation = self._database.generation
            self._claims[claim.machine_id] = claim

    def _due(self, claim: Claim) -> bool:
        """Whether something of the machine is to be written now; what the database did not take has to wait."""
        waits = claim.trouble and not self._stopping.is_set() and asyncio.get_running_loop().time() < claim.retry_s
        return not waits and claim.backlog.take() is not None

    async def _write(self, ready: list[Claim]) -> bool:
        """Write one transaction; say whether the database has taken all of it."""
        try:
            refused = await self._commit(ready)
        except Exception as error:
            # Nothing narrower: whatever a driver raises, this task must go on, or no machine would be written again.
            await self._disconnect(broken=True)
            if self._database.found_damaged(error) or _is_operational(error):
                self._fail(ready, str(self._database.failure(error)))
            elif len(ready) > 1:
                # The database is well, one machine's step is not: the others shall not wait for it.
                return all([await self._write([claim]) for claim in ready])
            else:
                self._refuse(ready[0], str(self._database.failure(error)))
            return False
        self._recover()
        for claim in ready:
            bundle, error_text = claim.backlog.attempt, refused.get(claim)
            claim.backlog.done()
            claim.trouble = ""
            if bundle is None:
                continue
            if error_text is None:
                claim.steps += 1
            elif not bundle.heard:
                _log.error("a step was refused", why=str(error_text))
            bundle.settle(error_text, written=True)
        return True

    def _fail(self, ready: list[Claim], trouble: str) -> None:
        if trouble != self.trouble:
            _log.error("the history cannot be written; it waits in memory", why=trouble)
        self.trouble = trouble
        for claim in ready:
            _put_off(claim)

    def _refuse(self, claim: Claim, trouble: str) -> None:
        """The database does not take one machine's step: that machine's trouble, and tried again after a while."""
        if trouble != claim.trouble:
            _log.error("the history does not take what happens", machine=claim.title, why=trouble)
        claim.trouble = trouble
        claim.retry_s = asyncio.get_running_loop().time() + self._retry_s
        _put_off(claim)

    def _recover(self) -> None:
        if not self.trouble:
            return
        self.trouble = ""
        for claim in self._claims.values():
            backlog = claim.backlog
            if backlog.dropped_reports or backlog.dropped_readings:
                _log.error(
                    "reports and readings were dropped while the history could not be written",
                    machine=claim.title, reports=backlog.dropped_reports, readings=backlog.dropped_readings,
                )  # fmt: skip
                backlog.dropped_reports = backlog.dropped_readings = 0
        _log.info("the history is written again")

    async def _commit(self, ready: list[Claim]) -> dict[Claim, StoreError]:
        async with asyncio.timeout(2 * self._database.timeout_s), self._turn, self._database.alone():
            connection = await self._connected()
            async with connection.begin():
                refused, new_series = await write_group(
                    self._database, connection, ready, self._series, self._bucket_ns
                )
        self._series.update(new_series)
        return refused

    async def _connected(self) -> AsyncConnection:
        if self._connection is None:
            self._connection = await self._database.writers.connect()
            for claim in self._claims.values():
                claim.locked = False
        if not self._database.is_sqlite:
            for claim in self._claims.values():
                # Our own former connection may still hold it for a while; the owner's mark protects us meanwhile.
                if not claim.locked and claim.lost is None:
                    claim.locked = await _lock_row(self._connection, claim.machine_id)
        return self._connection

    async def _disconnect(self, broken: bool = False) -> None:
        connection, self._connection = self._connection, None
        if connection is None:
            return
        with suppress(SQLAlchemyError, OSError):
            if broken and not self._database.in_memory:
                await connection.invalidate()  # whatever state it is in: it is not used again
        with suppress(SQLAlchemyError, OSError):
            await connection.close()


def _put_off(claim: Claim) -> None:
    """Let nobody wait for what is not written yet."""
    for bundle in (claim.backlog.attempt, claim.backlog.waiting):
        if bundle is not None:
            bundle.settle(None, written=False)


def _is_operational(error: Exception) -> bool:
    """Whether the database is at fault, and not what was to be written."""
    if isinstance(error, DBAPIError) and error.connection_invalidated:
        return True
    return isinstance(error, (OperationalError, InterfaceError, InternalError, PoolTimeoutError, OSError))


async def _lock_row(connection: AsyncConnection, machine_id: int) -> bool:
    async with connection.begin():
        query = text("SELECT pg_try_advisory_lock(:high, :low)")
        return bool(await connection.scalar(query, {"high": _LOCK, "low": machine_id}))


def lock_file(path: Path) -> int | None:
    """Lock the file beside the database that stands for one machine; None if another has it.

    The system lets go of it when the process ends, however it ends.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor
