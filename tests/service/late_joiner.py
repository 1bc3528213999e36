"""Programs of `tests.service.test_late_joiner`: a busy monitor, and a follower that can be killed at any moment.

::

    python -m tests.service.late_joiner monitor LISTEN FILE      alarm events until there is such a file
    python -m tests.service.late_joiner follow CONNECT FILE      writes them to the file
"""

import os
import signal
import sys
import time
from pathlib import Path

from models.signals.link import LinkSettings
from rotorwatch.client.alarm_log import follow_alarms
from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.operations import OperationKind
from service.monitor.alarms.operation import OperatorAction
from service.settings.service import LogSettings
from service.stream.transport import Link
from service.terminal.logs import configure_logging
from tests.service.live import Feed, open_session, service, until

PLACE = "demo/lab"
ALARM = "data-gap"
_PAUSE_S = 0.02


def say(what: str) -> None:
    """Tell the test."""
    sys.stdout.write(f"{what}\n")
    sys.stdout.flush()


def follow(connect: str, file_name: str) -> None:
    """Append every event to a file; go on after the last complete line of it."""
    path = Path(file_name)
    kept = path.read_bytes() if path.exists() else b""
    whole = kept[: kept.rfind(b"\n") + 1]
    lines = whole.splitlines()
    last = AlarmCloudEvent.model_validate_json(lines[-1]).data.sequence if lines else -1
    file = os.open(path, os.O_WRONLY | os.O_CREAT)
    os.ftruncate(file, len(whole))
    os.lseek(file, 0, os.SEEK_END)

    def keep(event: AlarmCloudEvent) -> None:
        line = f"{event.model_dump_json()}\n".encode()
        os.write(file, line[:100])  # in two pieces, so that a kill may leave half a line
        os.fsync(file)
        os.write(file, line[100:])
        os.fsync(file)

    follow_alarms(Link(LinkSettings(connect=(connect,))).session, [PLACE], {PLACE: last}, keep, ask_every_s=0.5)


def monitor(listen: str, enough: str) -> None:
    """Run the service; its alarm is taken out of service and put back again and again."""
    configure_logging(LogSettings(level="error"))
    with service(listen) as (_, worker):

        def state() -> str:
            return next((a.state for a in worker.alarms(include_normal=True).alarms if a.name == ALARM), "")

        if not state():
            with open_session(listen) as session:
                feed = Feed(session)
                feed.put_good()
                feed.skip(60)
                for _ in range(60):  # the first ones wait for those that are missing
                    feed.put_good()
                until(lambda: bool(state()), "an alarm")
        say("busy")
        while not Path(enough).exists():
            time.sleep(_PAUSE_S)
            kind: OperationKind = "return-to-service" if state() == "out-of-service" else "remove-from-service"
            worker.operate(OperatorAction(kind, ALARM, "test", "as often as it goes"))
        say(f"idle after {worker.alarms().sequence}.")
        signal.pause()


if __name__ == "__main__":
    {"monitor": monitor, "follow": follow}[sys.argv[1]](*sys.argv[2:])
