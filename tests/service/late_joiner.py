"""Programs of `tests.service.test_late_joiner`: a busy monitor, and a follower that can be killed at any moment.

::

    python -m tests.service.late_joiner monitor LISTEN HISTORY      alarm events without end; a line on stdin ends them
    python -m tests.service.late_joiner followers CONNECT FILE      stdin: start (fork a follower) or wait (for its end)
"""

import os
import sys
import threading
from pathlib import Path

from models.signals.link import LinkSettings
from rotorwatch.client.alarm_log import follow_alarms
from rotorwatch.records.alarms import AlarmCloudEvent
from service.stream.transport import Link

PLACE = "demo/lab"
ALARM = "data-gap"
_PAUSE_S = 0.02


def say(what: object) -> None:
    """Tell the test."""
    sys.stdout.write(f"{what}\n")
    sys.stdout.flush()


def followers(connect: str, path: str) -> None:
    """Start followers on request; forked, because so many fresh interpreters would take minutes."""
    children: list[int] = []
    for line in sys.stdin:
        if line.strip() == "start":
            child = os.fork()
            if not child:
                follow(connect, Path(path))
                os._exit(1)
            children.append(child)
            say(child)
        else:
            say(os.waitpid(children.pop(), 0)[1])


def follow(connect: str, path: Path) -> None:
    """Append every event to a file; go on after the last complete line of it."""
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


def monitor(listen: str, history: str) -> None:
    """Run the service; its alarm is taken out of service and put back again and again."""
    from rotorwatch.records.operations import OperationKind  # noqa: PLC0415  # followers need none of this
    from service.monitor.alarms.operation import OperatorAction  # noqa: PLC0415  # followers need none of this
    from service.runtime import running  # noqa: PLC0415
    from service.settings.service import HistorySettings, HttpSettings, LogSettings, MachineEntry, ServiceSettings  # noqa: PLC0415
    from service.terminal.logs import configure_logging  # noqa: PLC0415
    from tests.service.live import OPEN, Feed, open_session, until  # noqa: PLC0415

    settings = ServiceSettings(
        link=LinkSettings(listen=(listen,)),
        http=HttpSettings(port=0),
        history=HistorySettings(url=f"sqlite:///{history}"),
        access=OPEN,
        machines=(MachineEntry(file="lab"),),
    )
    configure_logging(LogSettings(level="error"))
    with running(settings) as runtime:
        worker = runtime.machines()[0]

        def state() -> str:
            return next((a.state for a in worker.alarms(include_normal=True).alarms if a.name == ALARM), "")

        if not state():
            with open_session(listen) as session:
                feed = Feed(session)
                feed.put_good()
                feed.sequence += 600
                feed.start_ns += 60_000_000_000
                for _ in range(60):  # the first ones wait for those that are missing
                    feed.put_good()
                until(lambda: bool(state()), "an alarm")
        say("busy")
        enough = threading.Event()

        def wait_for_line() -> None:
            sys.stdin.readline()
            enough.set()

        threading.Thread(target=wait_for_line, daemon=True).start()
        while not enough.wait(_PAUSE_S):
            kind: OperationKind = "return-to-service" if state() == "out-of-service" else "remove-from-service"
            worker.operate(OperatorAction(kind, ALARM, "test", "as often as it goes"))
        say(f"idle after {worker.alarms().sequence}")
        sys.stdin.readline()


if __name__ == "__main__":
    {"monitor": monitor, "followers": followers}[sys.argv[1]](*sys.argv[2:])
