"""Selection of a snapshot's channels: those requested by name, or a default choice; units and rounding of values."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from models.errors import RotorwatchError
from models.machine import MachineFile
from models.signals.block import ComplexArray, FloatArray
from models.signals.channels import Channel, Quantity, parts_seen, state_name
from rotorwatch.records.snapshots import Units

MOST_PAIRS = 8
"""Most pairs in a snapshot if none is requested."""
_DIGITS = 6
_Array = TypeVar("_Array", FloatArray, ComplexArray)


class SnapshotError(RotorwatchError):
    """The machine's channels do not allow the requested snapshot; the message lists what is available."""


def chosen_channels(machine: MachineFile, names: Sequence[str], field: str = "channel") -> tuple[Channel, ...]:
    """Channels by name; without names, all of the first quantity measured (displacements before velocities).

    Raises
    ------
    SnapshotError
        If a channel does not exist or is the shaft angle.
    """
    there = {channel.name: channel for channel in machine.sensors if state_name(channel) != "theta"}
    for name in names:
        if name not in there:
            known = {channel.name for channel in machine.sensors}
            what = "is the shaft angle" if name in known else "is not a channel of it"
            raise SnapshotError(
                f"{machine.title}: {field} is {name!r}, which {what}; expected one of {', '.join(there)}"
            )
    if names:
        return tuple(there[name] for name in dict.fromkeys(names))
    first = min((channel.quantity for channel in there.values()), key=list(Quantity).index, default=None)
    return tuple(channel for channel in there.values() if channel.quantity is first)


def chosen_pairs(
    machine: MachineFile, first: Sequence[str] = (), second: Sequence[str] = ()
) -> tuple[tuple[Channel, Channel], ...]:
    """Pairs of channels by name; without `second`, each channel with itself; without names, a default choice.

    By default, each channel of the first quantity measured (usually displacement) is paired with itself, then with
    those in the same direction, then with those at the same location, up to `MOST_PAIRS`.

    Raises
    ------
    SnapshotError
        If there is no such channel, or `first` and `second` differ in number.
    """
    if first or second:
        if second and len(second) != len(first):
            raise SnapshotError(
                f"{machine.title}: {len(first)} values of first and {len(second)} of second, expected as "
                "many of one as of the other, or none of second"
            )
        by_name = {
            channel.name: channel
            for names, field in ((first, "first"), (second, "second"))
            if names
            for channel in chosen_channels(machine, names, field)
        }
        return tuple((by_name[one], by_name[other]) for one, other in zip(first, second or first, strict=True))
    channels = chosen_channels(machine, ())
    alone = [(channel, channel) for channel in channels]
    several = [(one, other) for number, one in enumerate(channels) for other in channels[number + 1 :]]
    in_plane = [pair for pair in several if pair[0].direction == pair[1].direction]
    at_place = [pair for pair in several if pair[0].location == pair[1].location and pair not in in_plane]
    return tuple([*alone, *in_plane, *at_place][:MOST_PAIRS])


def check_held(machine: MachineFile, channels: Sequence[Channel], states: Sequence[str]) -> None:
    """Refuse channels that are not among the states of a window: at their locations only levels are watched.

    Raises
    ------
    SnapshotError
        If a channel is not among the window's states.
    """
    without = [channel.name for channel in channels if state_name(channel) not in states]
    if without:
        raise SnapshotError(
            f"{machine.title}: of {', '.join(without)} only levels are watched, and no spectra are held"
        )


def seen_by(channels: Sequence[Channel]) -> tuple[tuple[str, ...], FloatArray | None]:
    """States that channels measure, and each channel's coefficients of these states, shape (n_channels, n_states).

    The coefficients are None if each channel measures a single state; states are then in the order of channels.
    """
    parts = [parts_seen(channel) for channel in channels]
    states = tuple(dict.fromkeys(state for each in parts for state in each))
    if all(len(each) == 1 for each in parts):
        return states, None
    return states, np.array([[each.get(state, 0.0) for state in states] for each in parts])


def product_unit(first: Channel, second: Channel, units: Units) -> tuple[str, float]:
    """Unit of a product of two channels' samples, and the factor from SI to it.

    Examples
    --------
    >>> probe = Channel(name="XE-1", quantity="displacement", location="bearing", direction="y", unit="um")
    >>> product_unit(probe, probe, "channel")[0], product_unit(probe, probe, "SI")
    ('um^2', ('m^2', 1.0))
    """
    one, other = (channel.unit if units == "channel" else channel.si_unit for channel in (first, second))
    factor = 1.0 if units == "SI" else 1 / (first.to_si * second.to_si)
    if one == other:
        return (f"({one})^2" if "/" in one else f"{one}^2"), factor
    return f"{one}*{other}", factor


def figures(values: npt.ArrayLike) -> tuple[float | None, ...]:
    """Numbers for JSON, rounded to six significant digits; None if not finite.

    Examples
    --------
    >>> figures([0.123456789, float("nan"), -3e9])
    (0.123457, None, -3000000000.0)
    """
    array = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(array)
    solid = np.where(finite & (array != 0), array, 1.0)
    # Powers of ten up to 22 are exact in double precision: the quotient is then the shortest decimal.
    power = np.clip(_DIGITS - 1 - np.floor(np.log10(np.abs(solid))), -22, 22)
    up, down = 10.0 ** np.maximum(power, 0), 10.0 ** np.maximum(-power, 0)
    rounded = np.where(array == 0, 0.0, np.round(solid * up / down) * down / up)
    return tuple(value if known else None for value, known in zip(rounded.tolist(), finite.tolist(), strict=True))


def averaged(values: _Array, group: int) -> _Array:
    """Means of `group` adjacent values along the first axis; an incomplete last group is dropped."""
    if group == 1:
        return values
    whole = values[: values.shape[0] // group * group]
    return np.asarray(whole.reshape(-1, group, *values.shape[1:]).mean(axis=1), dtype=values.dtype)


def known_figures(values: npt.ArrayLike) -> tuple[float, ...]:
    """As `figures`, leaving out values that are not finite."""
    return tuple(one for one in figures(values) if one is not None)
