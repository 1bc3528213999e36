"""What is said about a sensor, and whose data must not be used because of it."""

from collections.abc import Iterable, Mapping

from models.signals.channels import Channel, state_name
from rotorwatch.records.windows import SensorFault

__all__ = ["Naming", "implicated"]


def implicated(findings: Iterable[SensorFault]) -> set[str]:
    """Channels whose data must not be used, by what they measure (``theta`` is the shaft angle)."""
    return {state for finding in findings for state in finding.states}


class Naming:
    """Names of channels and values in their units, for sentences.

    Parameters
    ----------
    channels : iterable of Channel
        Those of the machine; what is not among them is called by its state and given in SI units.
    """

    def __init__(self, channels: Iterable[Channel] = ()) -> None:
        self._channels: Mapping[str, Channel] = {state_name(channel): channel for channel in channels}

    def name(self, state: str) -> str:
        """Name of the channel."""
        return self._channels[state].name if state in self._channels else state

    def names(self, states: Iterable[str]) -> str:
        """Names of several channels, with "and" before the last."""
        *first, last = [self.name(state) for state in states]
        return f"{', '.join(first)} and {last}" if first else last

    def value(self, state: str, value_SI: float) -> str:
        """Text of a value in the channel's unit."""
        if state not in self._channels:
            return f"{value_SI:.3g} (SI)"
        channel = self._channels[state]
        return f"{value_SI / channel.to_si:.3g} {channel.unit}"
