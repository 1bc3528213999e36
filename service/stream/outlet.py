"""Where a worker publishes."""

from typing import Protocol


class Outlet(Protocol):
    """Where a worker publishes; `service.stream.transport.MachineLink` is one."""

    def publish_report(self, text: str) -> None:
        """Publish a window report."""

    def publish_alarm_event(self, text: str) -> None:
        """Publish an alarm event."""

    def publish_alarm_state(self, text: str) -> None:
        """Publish the alarms as they are now."""
