"""The audit log of the HTTP API: who did what, when and from where, and who was refused.

::

    request that may change something     started (status 0) --> the action --> outcome (its status)
    any request refused (401, 403, 429)                                         outcome, a few a minute and address

The first entry is written before the action, and without it there is no action. The second has the same time as the
first; if it is missing, the outcome is not known.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

from models.errors import RotorwatchError
from service.access.rates import MovingWindow
from service.access.tokens import masked
from service.history.shared import AuditLog
from service.terminal.logs import logger

STARTED = "started"
"""Action of an entry that was written before the action, whose status is 0."""

_LONGEST = 500
_SET_BACK_NS = 10**9
_REFUSALS_IN_ALL = 60
_log = logger(part="access")


@dataclass(frozen=True, slots=True)
class AuditNote:
    """What a route says about its action, in ``request.state.audit``."""

    action: str = ""  # in one word, such as ``acknowledge``
    # What it is done to: ``site/machine``, and the alarm's name.
    machine: str = ""
    alarm: str = ""
    reason: str = ""  # why, in the words of the caller


@dataclass(slots=True)
class Visit:
    """A request on its way, as far as the audit log is concerned."""

    at_ns: int
    address: str
    method: str
    path: str
    actor: str = ""
    started: bool = False


class AuditTrail:
    """Writes the audit log; of refused requests, per minute at most `refusals_per_minute` of an address, 60 in all."""

    def __init__(
        self, log: AuditLog, refusals_per_minute: int, *, monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        self._journal = log
        self._lock = threading.Lock()
        self._latest_ns = 0
        self._by_address = MovingWindow(refusals_per_minute, clock=monotonic)
        self._in_all = MovingWindow(_REFUSALS_IN_ALL, clock=monotonic)
        self._withheld = 0

    def visit(self, address: str, method: str, path: str) -> Visit:
        """Begin to follow a request; no two have the same time."""
        with self._lock:
            now_ns = time.time_ns()
            if now_ns <= self._latest_ns < now_ns + _SET_BACK_NS:
                now_ns = self._latest_ns + 1
            self._latest_ns = now_ns  # also where the clock was set back
            return Visit(self._latest_ns, address, method, path)

    def start(self, visit: Visit) -> None:
        """Write down that something is about to be done.

        Raises
        ------
        RotorwatchError
            If that is not possible; then it must not be done.
        """
        self._write(visit, 0, AuditNote(action=STARTED))
        visit.started = True

    def finish(self, visit: Visit, status: int, note: AuditNote) -> None:
        """Write down the outcome; if that fails, it is only logged, as the action cannot be undone."""
        try:
            self._write(visit, status, note)
        except RotorwatchError as error:
            _log.error(
                "outcome is missing from the audit log",
                actor=visit.actor,
                method=visit.method,
                path=_short(visit.path),
                status=status,
                why=str(error),
            )

    def admits_refusal(self, network: str) -> int | None:
        """How many refusals were left out before this one, or None if this one is to be left out as well."""
        if self._by_address.wait(network) or self._in_all.hit(""):
            self._withheld += 1
            return None
        self._by_address.hit(network)
        withheld, self._withheld = self._withheld, 0
        return withheld

    def _write(self, visit: Visit, status: int, note: AuditNote) -> None:
        texts = asdict(note) | {"method": visit.method, "path": visit.path}
        said = {name: _short(text) for name, text in texts.items()}
        self._journal.append(visit.at_ns, status, actor=visit.actor, address=visit.address, **said)


def _short(text: str) -> str:
    """At most 500 printable characters, and no token's secret."""
    text = masked(text)
    if not text.isprintable():
        text = "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
