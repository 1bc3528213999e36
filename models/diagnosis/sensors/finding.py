"""What is said about a sensor, and whose data must not be used because of it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

from models.signals.channels import Channel, state_name

__all__ = ["FAULT_KINDS", "FaultKind", "Naming", "SensorFinding", "implicated"]

FaultKind = Literal["stuck", "clipped", "offset", "gain", "delay", "swapped", "incoherent", "noise"]

FAULT_KINDS: tuple[FaultKind, ...] = get_args(FaultKind)
"""All kinds of fault."""


@dataclass(frozen=True, slots=True)
class SensorFinding:
    """One fault of a sensor, or of one of two sensors that contradict each other.

    Attributes
    ----------
    states : tuple of str
        What the channels measure whose data must not be used: one, or all among which the fault could not be told.
    kind : str
        ``stuck``, ``clipped``, ``offset``, ``gain``, ``delay``, ``swapped``, ``noise``: it shows more than it did of
        what is not the machine's, or ``incoherent``: two sensors of one motion show different things, and none of the
        other kinds explains it.
    text : str
        One sentence: the channels, the value found, what was expected.
    value : float
        ``stuck``: how long it stood still, s. ``clipped``: part of the samples at the limit. ``offset``: the change of
        the mean, SI. ``gain``: relative change. ``delay``: s. ``swapped``, ``incoherent``: how much of the motion the
        two sensors share, 0 to 1. ``noise``: rms of the noise over that of the channel.
    z : float or None
        Standard errors by which it exceeds what a healthy sensor shows; None where no chance is involved.
    """

    states: tuple[str, ...]
    kind: FaultKind
    text: str
    value: float
    z: float | None = None


def implicated(findings: Iterable[SensorFinding]) -> set[str]:
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
