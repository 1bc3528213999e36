"""Names of the Zenoh keys of one machine; ``docs/topics.md`` lists them with example payloads."""

import re
from dataclasses import dataclass

from models.errors import MachineFileError

__all__ = ["PREFIX", "MachineKeys"]

PREFIX = "rotorwatch"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


@dataclass(frozen=True, slots=True)
class MachineKeys:
    """Keys under ``rotorwatch/<site>/<machine>/``.

    Examples
    --------
    >>> MachineKeys("lab", "rig1").stream
    'rotorwatch/lab/rig1/stream'
    """

    site: str
    machine: str

    def __post_init__(self) -> None:
        for field, value in (("site", self.site), ("machine", self.machine)):
            if not _NAME.fullmatch(value):
                raise MachineFileError(
                    f"{field} name {value!r} cannot be part of a key: use 1 to 64 letters, digits, '_' or '-'"
                )

    @property
    def root(self) -> str:
        """What all keys of the machine start with."""
        return f"{PREFIX}/{self.site}/{self.machine}"

    @property
    def stream(self) -> str:
        """Sample blocks."""
        return f"{self.root}/stream"

    @property
    def descriptor(self) -> str:
        """Channel descriptor (JSON), also by query."""
        return f"{self.root}/descriptor"

    @property
    def truth(self) -> str:
        """What the simulator did to the machine (JSON); real machines have none."""
        return f"{self.root}/truth"

    @property
    def report(self) -> str:
        """One monitor report per evaluated window (JSON)."""
        return f"{self.root}/report"

    @property
    def health(self) -> str:
        """Current health (JSON), also by query."""
        return f"{self.root}/health"

    @property
    def alarm_event(self) -> str:
        """Alarm transitions (CloudEvents JSON)."""
        return f"{self.root}/alarm/event"

    @property
    def alarm_state(self) -> str:
        """All alarms that are not normal (JSON), also by query."""
        return f"{self.root}/alarm/state"

    @property
    def publisher_alive(self) -> str:
        """Liveliness token of whoever publishes the stream."""
        return f"{self.root}/alive/publisher"

    @property
    def monitor_alive(self) -> str:
        """Liveliness token of the monitor that watches the machine."""
        return f"{self.root}/alive/monitor"

    @property
    def replay_alive(self) -> str:
        """Liveliness token of a replay on the machine's own keys, which monitors state and do not evaluate."""
        return f"{self.root}/alive/replay"
