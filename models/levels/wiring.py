"""All sensors of a place exchanged with those of another, or reversed: they agree with each other all the same.

What turns with the shaft tells it. No machine gives each of two places the 1x vector that the other had, or turns some
by half a turn, and leaves all the rest as they were.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
import numpy.typing as npt

from models.levels.gains import place_of
from models.signals.channels import Channel, state_name
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault

_NEWEST = (3, 6)  # hops, beside all of the window: so soon it is told
_FEWEST_PLACES = 3
_OFF = 0.15  # part of a healthy vector by which one may be off, beside `_SURE` standard errors
_SURE, _CLEARLY = 3.0, 2.0  # one that moved must have moved by so many times as much
_MOST_ERROR = 0.12  # part of a healthy vector
_MEDIAN_STEP = 1.1774  # from one hop to the next, in standard deviations of either

_ComplexArray = npt.NDArray[np.complex128]


def rewired(vectors: _ComplexArray, healthy: _ComplexArray, channels: Sequence[Channel]) -> SensorFault | None:
    """Which places show the healthy 1x vectors of each other, or reversed ones, while all others show their own.

    Parameters
    ----------
    vectors, healthy : ndarray, shape (n_hops, n) and (n,)
        Of the hops of a window, and of the healthy machine at the same speed.
    """
    if len(set(map(place_of, channels))) < _FEWEST_PLACES:
        return None
    sizes, scatter = np.abs(healthy), np.median(np.abs(np.diff(vectors, axis=0)), axis=0) / _MEDIAN_STEP
    for hops in (*(few for few in _NEWEST if few < len(vectors)), len(vectors)):
        error, now = scatter / np.sqrt(hops), vectors[-hops:].mean(axis=0)
        if not np.all(error < _MOST_ERROR * sizes):
            continue
        found = []
        for concerned, shown, sign in _mistakes(channels):
            expected = healthy.copy()
            expected[concerned] = sign * healthy[shown]
            within = _OFF * np.abs(expected) + _SURE * error
            off, moved = np.abs(now - expected) / within, np.abs(expected - healthy) / within
            if off.max() < 1 and moved[concerned].min() > _CLEARLY:
                found.append((float(off.max()), concerned, sign))
        if found:
            _, concerned, sign = min(found)
            return _fault([channels[column] for column in concerned], swapped=sign > 0)
    return None


def _mistakes(channels: Sequence[Channel]) -> Iterator[tuple[list[int], list[int], int]]:
    """Columns concerned, those whose vectors they show then, and with which sign."""
    places: dict[str, list[int]] = {}
    for column, channel in enumerate(channels):
        places.setdefault(place_of(channel), []).append(column)
    for count in range(1, len(places)):
        for some in combinations(places.values(), count):
            rest = [place for place in places.values() if place not in some]
            columns = [column for place in some for column in place]
            ways = [{channels[column].direction for place in part for column in place} for part in (some, rest)]
            if ways[0] & ways[1]:  # a plane whose stiffness falls far enough turns by half a turn, too
                yield columns, columns, -1
    for one, other in combinations(places.values(), 2):
        if [channels[column].quantity for column in one] == [channels[column].quantity for column in other]:
            yield one + other, other + one, 1


def _fault(channels: Sequence[Channel], *, swapped: bool) -> SensorFault:
    states, names = tuple(map(state_name, channels)), [channel.name for channel in channels]
    if swapped:
        half = len(names) // 2
        one, other = (" and ".join(some) for some in (names[:half], names[half:]))
        text = (
            f"{one} swapped with {other}: each shows the 1× vector that the other had on the healthy machine, and all "
            "others show their own"
        )
        return SensorFault(states=states, kind=FaultKind.SWAPPED, text=text, value=None)
    text = (
        f"{' and '.join(names)} reversed: their 1× vectors have turned by 180° and kept their lengths, those of all "
        "others are as on the healthy machine"
    )
    return SensorFault(states=states, kind=FaultKind.GAIN, text=text, value=-2.0)
