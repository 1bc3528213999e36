"""What is broken on purpose, what that may cost, and what has to be said of it: one row for each fault."""

from collections.abc import Callable
from dataclasses import dataclass

from tests.faults import faults
from tests.faults.rig import Plant

_NOTHING = "nothing"


@dataclass(frozen=True, slots=True)
class Row:
    """One fault.

    Attributes
    ----------
    name, done, lost, stated, recovery : str
        In words, for users: what happens, how it is brought about, what it may cost, what the monitor says of it, and
        how one sees that it is over.
    run : callable
        Breaks and mends it.
    prepare : callable
        Sets the plant up before the monitor is started.
    """

    name: str
    done: str
    lost: str
    stated: str
    recovery: str
    run: Callable[[Plant], None]
    prepare: Callable[[Plant], None] = lambda plant: None


ROWS = (
    Row(
        "The publisher is killed and started again",
        "`kill -9` of the publisher; another one, with a new run number, once the stream counts as lost",
        "what nobody measured meanwhile",
        "alarm `stream-lost`, state `no-data`",
        "data come, the alarm has cleared",
        faults.publisher_killed,
    ),
    Row(
        "The publisher stands still",
        "it is stopped (`SIGSTOP`) until the stream counts as lost, and goes on",
        _NOTHING,
        "alarm `stream-lost`, state `no-data`",
        "data come, the alarm has cleared",
        faults.publisher_stands,
    ),
    Row(
        "The publisher is started again an hour later by its clock",
        "stopped and started with another run number, its data an hour later",
        "what nobody measured meanwhile, by the data's own clock",
        "`last_gap` in health: publisher restarted; no alarm on the clock",
        "data come, no alarm stands",
        faults.restarted_at(3600.0),
    ),
    Row(
        "The publisher is started again an hour earlier by its clock",
        "the same, its data an hour earlier",
        "what nobody measured meanwhile",
        "`last_gap` in health: publisher restarted; no alarm on the clock",
        "data come, no alarm stands",
        faults.restarted_at(-3600.0),
    ),
    Row(
        "The publisher's clock is set forward",
        "by an hour, between two blocks of one run",
        "nine blocks, until the new time is believed (`resync_blocks`)",
        "alarm `data-clock`",
        "data are evaluated at the new time",
        faults.clock_set(3600.0),
    ),
    Row(
        "The publisher's clock is set back",
        "by an hour, between two blocks of one run",
        "nine blocks, until the new time is believed (`resync_blocks`)",
        "alarm `data-clock`",
        "data are evaluated at the new time",
        faults.clock_set(-3600.0),
    ),
    Row(
        "Two publishers send on one machine's key",
        "a second publisher with another run number, at the same times; ten times faster than real time",
        "blocks of either, while both send; what is missing is then counted more than once",
        "alarm `data-conflict`, which names both runs",
        "the alarm has cleared, 300 s of data after the second one has stopped",
        faults.two_publishers,
    ),
    Row(
        "The network link is cut",
        "the router between publisher and monitor is killed, and started again once the stream counts as lost",
        "nothing, as long as the publisher's cache (1200 blocks, here 240 s) holds what was not sent",
        "alarm `stream-lost`, state `no-data`",
        "data come, the alarm has cleared",
        faults.link_cut,
        faults.through_router,
    ),
    Row(
        "The monitor is killed, three times",
        "`kill -9` at any moment, and started again",
        "nothing that the publisher's cache still holds; the window too is made again from "
        "[recordings or that cache](history.md#after-a-restart), or fills anew",
        "`restart` in health: went on where it stood",
        "data come, and what was sent meanwhile has come out of the publisher's cache",
        faults.monitor_killed,
    ),
    Row(
        "The monitor is stopped in order",
        "`SIGTERM`, and started again",
        "nothing that the publisher's cache still holds",
        "exit code 0; `restart` in health: went on where it stood",
        "data come, and what was sent meanwhile has come out of the publisher's cache",
        faults.monitor_stopped,
    ),
    Row(
        "The monitor stands still",
        "it is stopped by the system (`SIGSTOP`) for 6 to 8 s",
        _NOTHING,
        "nothing: no stream is called lost",
        "what was sent meanwhile is evaluated",
        faults.monitor_stands,
    ),
    Row(
        "A second monitor of the same machine and history is started",
        "`rotorwatch run` with the same history",
        _NOTHING,
        "the second one ends with exit code 1 and says why",
        "the first one has noticed nothing",
        faults.second_monitor,
    ),
    Row(
        "The history is locked by another program",
        "it holds SQLite's lock for writing",
        _NOTHING,
        "`/readyz` 503: the history cannot be written, what happens waits in memory",
        "`/readyz` 200",
        faults.history_locked,
    ),
    Row(
        "The history is locked until the monitor has stopped",
        "the same, and `SIGTERM`",
        "what happened since the lock was taken: operators' actions and reports",
        "`/readyz` 503; exit code 1, and what is lost in words",
        "started again, the monitor goes on from before",
        faults.locked_to_the_end,
    ),
    Row(
        "The disk is full",
        "the file system of the history is filled to the last byte, and room is made again",
        _NOTHING,
        "`/readyz` 503: the history cannot be written, what happens waits in memory",
        "`/readyz` 200",
        faults.disk_full,
        faults.small_disk,
    ),
    Row(
        "A write fails in the middle of a commit, and the monitor is killed",
        "the system lets the file grow no further than into a commit; then `kill -9`",
        "what happened since the write failed",
        "`/readyz` 503: the history cannot be written, what happens waits in memory",
        "started again, the monitor goes on from the last whole commit",
        faults.torn_write,
    ),
    Row(
        "The history is deleted",
        "the file is removed while the monitor runs",
        _NOTHING,
        "alarm `monitor-fault`, and in the log that the history goes on in a new file with all it held",
        "the file is there again, `/readyz` 200",
        faults.deleted,
    ),
    Row(
        "The history is replaced by another file",
        "an empty database is put in its place",
        "what was in the former file; numbers of alarm events go on",
        "alarm `monitor-fault`; `/readyz` 503 until the monitor is started again",
        "data are evaluated and written",
        faults.replaced,
    ),
    Row(
        "The history is damaged while it is in use",
        "the file and what SQLite keeps beside it are overwritten",
        "what was in the file, which is kept aside",
        "alarm `monitor-fault`; `/readyz` 503 until the monitor is started again",
        "data are evaluated and written",
        faults.damaged_in_use,
    ),
    Row(
        "The history is damaged at the start",
        "everything after the first page is overwritten while no monitor runs",
        "what was in the file, which is kept aside",
        "`/readyz` 503 until the monitor is started again; alarm `monitor-fault`",
        "data are evaluated and written",
        faults.damaged_at_start,
    ),
    Row(
        "The history refuses the steps of one machine",
        "a value in its row that no number can be added to, and then a good one",
        _NOTHING,
        "`/readyz` 503: the history does not take what happens",
        "`/readyz` 200",
        faults.refused_step,
    ),
    Row(
        "A webhook's receiver is away",
        "it answers with 503, and later as it should",
        _NOTHING,
        "`failing_webhooks` in `/readyz`, which stays 200",
        "every event has arrived, in order",
        faults.receiver_away,
        faults.receiver,
    ),
    Row(
        "A flood of bad messages",
        "as many as one process can send for 8 to 10 s, on the machine's key",
        _NOTHING,
        "`refused_blocks` in health",
        "all good blocks were evaluated",
        faults.flood,
    ),
)
