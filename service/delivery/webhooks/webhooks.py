"""All webhooks of the monitor."""

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import closing

from models.errors import RotorwatchError
from rotorwatch.records.monitor import WebhookList
from service.delivery.webhooks.answer import Meaning
from service.delivery.webhooks.dispatcher import Dispatcher
from service.delivery.webhooks.receiver import Receiver
from service.history.machine import MachineStore
from service.history.shared import WebhookCursors
from service.monitor.conversion import rfc3339
from service.settings.webhooks import WebhookSettings


class Webhooks:
    """Starts and stops webhooks and reports their states.

    Raises
    ------
    MachineFileError
        If a secret or certificate cannot be used.
    """

    def __init__(self, webhooks: Sequence[WebhookSettings]) -> None:
        self._receivers = [(settings, Receiver(settings)) for settings in webhooks]
        self._dispatchers: tuple[Dispatcher, ...] = ()

    def start(self, logs: Mapping[str, MachineStore], cursors: WebhookCursors) -> None:
        """Begin to send from logs by ``site/machine``; webhooks without cursors get what comes after this moment."""
        self._dispatchers = tuple(
            Dispatcher(settings, receiver, logs, cursors) for settings, receiver in self._receivers
        )
        for dispatcher in self._dispatchers:
            dispatcher.start()

    def wake(self) -> None:
        """Say that alarm events were committed; for any thread."""
        for dispatcher in self._dispatchers:
            dispatcher.wake()

    def statuses(self) -> WebhookList:
        """State of every webhook."""
        return WebhookList(webhooks=tuple(dispatcher.status() for dispatcher in self._dispatchers))

    def failing(self) -> tuple[str, ...]:
        """Those that do not work, each with what is wrong."""
        return tuple(
            f"{status.name}: {status.last_error}" for status in self.statuses().webhooks if status.state != "working"
        )

    def close(self) -> None:
        """Give up what is under way; it is sent after the next start."""
        for dispatcher in self._dispatchers:
            dispatcher.stop()


def send_test(settings: WebhookSettings) -> float:
    """Send an event that is no alarm (type ``org.rotorwatch.webhook.test``) and return how long it took, in seconds.

    Raises
    ------
    MachineFileError
        If the secret or certificate cannot be used.
    RotorwatchError
        If the receiver did not take it.
    """
    now_ns = time.time_ns()
    event = {
        "specversion": "1.0",
        "id": f"test/{now_ns}",
        "source": "/rotorwatch",
        "type": "org.rotorwatch.webhook.test",
        "time": rfc3339(now_ns),
        "datacontenttype": "application/json",
        "data": {"webhook": settings.name, "text": "This is a test: no machine has raised an alarm."},
    }
    begin_s = time.monotonic()
    with closing(Receiver(settings)) as receiver:
        answer = receiver.post(f"test/{now_ns}", json.dumps(event).encode())
    if answer.meaning is not Meaning.DELIVERED:
        raise RotorwatchError(f"{settings.name}: {settings.target} did not accept the test event: {answer.text}")
    return time.monotonic() - begin_s
