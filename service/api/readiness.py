"""Whether the service can do its work, and if not, why."""

from collections.abc import Sequence

from rotorwatch.records.monitor import MachineReadiness, Readiness
from service.stream.liveness import STUCK_S


def readiness_of(
    *,
    session_open: bool,
    machines: Sequence[MachineReadiness],
    history_open: bool,
    history_trouble: str,
    history_lost: str,
    failing_webhooks: Sequence[str],
) -> Readiness:
    """Judge.

    Recordings and webhooks are stated and no reason: machines are monitored, and alarms kept, all the same.

    Parameters
    ----------
    history_open : bool
        The database is connected and its tables are up to date.
    history_trouble : str
        Why it cannot be written; empty if it can.
    history_lost : str
        Why something of it is gone; empty if nothing is.
    failing_webhooks : sequence of str
        Name, and what is wrong.
    """
    reasons = []
    if not session_open:
        reasons.append("the Zenoh session is closed: nothing arrives and nothing is published")
    if not history_open:
        reasons.append("the history is not open, or its tables are not up to date")
    if history_trouble:
        reasons.append(f"the history cannot be written, what happens waits in memory: {history_trouble}")
    if history_lost:
        reasons.append(f"{history_lost}; see docs/history.md, and start the monitor again when it is seen to")
    for machine in machines:
        place = f"{machine.site}/{machine.machine}"
        if not machine.worker_alive:
            reasons.append(f"{place}: the thread that evaluates its blocks has stopped")
        elif machine.worker_busy_s > STUCK_S:
            reasons.append(f"{place}: one block has been in the monitor for {machine.worker_busy_s:.0f} s")
        if machine.trouble:
            reasons.append(f"{place}: {machine.trouble}")
    return Readiness(
        ready=not reasons,
        reasons=tuple(reasons),
        session_open=session_open,
        history_open=history_open,
        history_trouble=history_trouble,
        failing_webhooks=tuple(failing_webhooks),
        machines=tuple(machines),
    )
