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
        "The publisher is killed and restarted",
        "`kill -9` of the publisher; a new one, with a new run number, once the stream counts as lost",
        "what was not measured in between",
        "alarm `stream-lost`, state `no-data`",
        "data arrive and the alarm has cleared",
        faults.publisher_killed,
    ),
    Row(
        "The publisher is paused",
        "paused (`SIGSTOP`) until the stream counts as lost, then resumed",
        _NOTHING,
        "alarm `stream-lost`, state `no-data`",
        "data arrive and the alarm has cleared",
        faults.publisher_stands,
    ),
    Row(
        "The publisher is restarted an hour later by its clock",
        "stopped and started with another run number, with its data an hour later",
        "what was not measured in between, by the data's own clock",
        "`last_gap` in health: publisher restarted; no alarm on the clock",
        "data arrive and no alarm is raised",
        faults.restarted_at(3600.0),
    ),
    Row(
        "The publisher is restarted an hour earlier by its clock",
        "the same, with its data an hour earlier",
        "what was not measured in between",
        "`last_gap` in health: publisher restarted; no alarm on the clock",
        "data arrive and no alarm is raised",
        faults.restarted_at(-3600.0),
    ),
    Row(
        "The publisher's clock is set forward",
        "by an hour, between two blocks of one run",
        "nine blocks, until the new time is accepted (`resync_blocks`)",
        "alarm `data-clock`",
        "data are evaluated at the new time",
        faults.clock_set(3600.0),
    ),
    Row(
        "The publisher's clock is set back",
        "by an hour, between two blocks of one run",
        "nine blocks, until the new time is accepted (`resync_blocks`)",
        "alarm `data-clock`",
        "data are evaluated at the new time",
        faults.clock_set(-3600.0),
    ),
    Row(
        "Two publishers send on one machine's key",
        "a second publisher sends the same times with another run number; ten times faster than real time",
        "blocks of either while both send; missing data are then counted more than once",
        "alarm `data-conflict`, which names both runs",
        "the alarm has cleared, 300 s of data after the second publisher stopped",
        faults.two_publishers,
    ),
    Row(
        "The network link is cut",
        "the router between publisher and monitor is killed, and restarted once the stream counts as lost",
        "nothing, as long as the publisher's cache (1200 blocks, here 240 s) holds what was not delivered",
        "alarm `stream-lost`, state `no-data`",
        "data arrive and the alarm has cleared",
        faults.link_cut,
        faults.through_router,
    ),
    Row(
        "The monitor is killed, three times",
        "`kill -9` at a random moment, then restarted",
        "nothing that the publisher's cache still holds; the window is also rebuilt from "
        "[recordings or that cache](history.md#after-a-restart), or fills anew",
        "`restart` in health: *went on where it stood*",
        "data arrive, and the publisher's cache has supplied what was sent in between",
        faults.monitor_killed,
    ),
    Row(
        "The monitor is shut down cleanly",
        "`SIGTERM`, then restarted",
        "nothing that the publisher's cache still holds",
        "exit code 0; `restart` in health: went on where it stood",
        "data arrive, and the publisher's cache has supplied what was sent in between",
        faults.monitor_stopped,
    ),
    Row(
        "The monitor is paused",
        "paused (`SIGSTOP`) for 6 to 8 s",
        _NOTHING,
        "nothing: no stream is reported as lost",
        "what was sent in between is evaluated",
        faults.monitor_stands,
    ),
    Row(
        "A second monitor is started with the same machine and history",
        "`rotorwatch run` with the same history",
        _NOTHING,
        "the second one ends with exit code 1 and says why",
        "the first one is not affected",
        faults.second_monitor,
    ),
    Row(
        "The history is locked by another program",
        "the program holds SQLite's write lock",
        _NOTHING,
        "`/readyz` 503: *the history cannot be written; events wait in memory*",
        "`/readyz` 200",
        faults.history_locked,
    ),
    Row(
        "The history stays locked until the monitor has stopped",
        "the same, then `SIGTERM`",
        "operators' actions and reports since the lock was taken",
        "`/readyz` 503; exit code 1 and a message that says what is lost",
        "after a restart the monitor resumes from the state before the lock",
        faults.locked_to_the_end,
    ),
    Row(
        "The disk is full",
        "the file system of the history is filled to the last byte, then space is freed",
        _NOTHING,
        "`/readyz` 503: *the history cannot be written; events wait in memory*",
        "`/readyz` 200",
        faults.disk_full,
        faults.small_disk,
    ),
    Row(
        "A write fails in the middle of a commit, and the monitor is killed",
        "a limit on the file size is reached within a commit; then `kill -9`",
        "what happened since the write failed",
        "`/readyz` 503: *the history cannot be written; events wait in memory*",
        "after a restart the monitor resumes from the last complete commit",
        faults.torn_write,
    ),
    Row(
        "The history is deleted",
        "the file is removed while the monitor runs",
        _NOTHING,
        "alarm `monitor-fault`; the log says that the history continues in a new file with everything it held",
        "the file is there again, `/readyz` 200",
        faults.deleted,
    ),
    Row(
        "The history is replaced by another file",
        "an empty database takes its place",
        "what was in the former file; alarm event numbers continue",
        "alarm `monitor-fault`; `/readyz` 503 until the monitor is restarted",
        "data are evaluated and written",
        faults.replaced,
    ),
    Row(
        "The history is damaged while it is in use",
        "the file and those that SQLite keeps beside it are overwritten",
        "what was in the file, which is set aside",
        "alarm `monitor-fault`; `/readyz` 503 until the monitor is restarted",
        "data are evaluated and written",
        faults.damaged_in_use,
    ),
    Row(
        "The history is damaged before the monitor starts",
        "everything after the first page is overwritten while no monitor runs",
        "what was in the file, which is set aside",
        "`/readyz` 503 until the monitor is restarted; alarm `monitor-fault`",
        "data are evaluated and written",
        faults.damaged_at_start,
    ),
    Row(
        "The history refuses the entries of one machine",
        "a value in its row is made one that cannot be added to, then corrected",
        _NOTHING,
        "`/readyz` 503: the history does not accept what happens",
        "`/readyz` 200",
        faults.refused_step,
    ),
    Row(
        "A webhook's receiver is unavailable",
        "it answers with 503, later correctly",
        _NOTHING,
        "`failing_webhooks` in `/readyz`, which stays 200",
        "every event has arrived, in order",
        faults.receiver_away,
        faults.receiver,
    ),
    Row(
        "A flood of bad messages",
        "as many as one process can send in 8 to 10 s, on the machine's key",
        _NOTHING,
        "`refused_blocks` in health",
        "all good blocks were evaluated",
        faults.flood,
    ),
)
