"""What is broken on purpose; what that may cost, and what has to be said of it, stands in docs/reliability.md."""

from collections.abc import Callable
from dataclasses import dataclass

from tests.faults import faults
from tests.faults.rig import Plant


@dataclass(frozen=True, slots=True)
class Row:
    """One fault: its name in the page, what breaks and mends it, and what comes before the monitor is started."""

    name: str
    run: Callable[[Plant], None]
    prepare: Callable[[Plant], None] = lambda plant: None


ROWS = (
    Row("The publisher is killed and restarted", faults.publisher_killed),
    Row("The publisher is paused", faults.publisher_stands),
    Row("The publisher is restarted an hour later by its clock", faults.restarted_at(3600.0)),
    Row("The publisher is restarted an hour earlier by its clock", faults.restarted_at(-3600.0)),
    Row("The publisher's clock is set forward", faults.clock_set(3600.0)),
    Row("The publisher's clock is set back", faults.clock_set(-3600.0)),
    Row("Two publishers send on one machine's key", faults.two_publishers),
    Row("The network link is cut", faults.link_cut, faults.through_router),
    Row("The monitor is killed, three times", faults.monitor_killed),
    Row("The monitor is shut down cleanly", faults.monitor_stopped),
    Row("The monitor is paused", faults.monitor_stands),
    Row("A second monitor is started with the same machine and history", faults.second_monitor),
    Row("The history is locked by another program", faults.history_locked),
    Row("The history stays locked until the monitor has stopped", faults.locked_to_the_end),
    Row("The disk is full", faults.disk_full, faults.small_disk),
    Row("A write fails in the middle of a commit, and the monitor is killed", faults.torn_write),
    Row("The history is deleted", faults.deleted),
    Row("The history is replaced by another file", faults.replaced),
    Row("The history is damaged while it is in use", faults.damaged_in_use),
    Row("The history is damaged before the monitor starts", faults.damaged_at_start),
    Row("The history refuses the entries of one machine", faults.refused_step),
    Row("A webhook's receiver is unavailable", faults.receiver_away, faults.receiver),
    Row("A flood of bad messages", faults.flood),
)
