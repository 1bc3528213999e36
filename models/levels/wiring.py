"""Places whose sensors have all been reversed, or exchanged with those of another place, so that they agree as before.

The 1x vectors reveal it. No change of the machine gives two places each other's healthy 1x vectors, or turns the
vectors of some, not all, places of a plane by 180°, and leaves all others as they were.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from models.levels.gains import place_of
from models.signals.block import BoolArray, ComplexArray
from models.signals.channels import Channel, state_name
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault

_NEWEST = (3, 6)  # numbers of newest hops that are compared before the whole window
_FEWEST_PLACES = 3
_TOLERANCE_PART, _TOLERANCE_ERRORS = 0.15, 3.0  # this part of the expected vector plus so many standard errors
_LEAST_DISTANCE = 2.0  # least distance from the healthy vector, in tolerances, of a channel that is called wrong
_MOST_ERROR = 0.12  # largest standard error, as a part of the healthy vector
_MEDIAN_STEP = 1.1774  # median length of a hop-to-hop step over the standard deviation of a hop's vector


def rewired(vectors: ComplexArray, healthy: ComplexArray, channels: Sequence[Channel]) -> SensorFault | None:
    """Find places that show each other's healthy 1x vectors, or reversed ones, while all others show their own.

    `vectors`, shape (n_hops, n), are the 1x vectors of the channels in the hops of a window; `healthy`, shape (n,),
    those of the healthy machine at the same speed.
    """
    places: dict[str, list[int]] = {}
    for column, channel in enumerate(channels):
        places.setdefault(place_of(channel), []).append(column)
    if len(places) < _FEWEST_PLACES:
        return None
    scatter = np.median(np.abs(np.diff(vectors, axis=0)), axis=0) / _MEDIAN_STEP
    for hops in (*(few for few in _NEWEST if few < len(vectors)), len(vectors)):
        error, now = scatter / np.sqrt(hops), vectors[-hops:].mean(axis=0)
        if not np.all(error < _MOST_ERROR * np.abs(healthy)):
            continue
        turned = np.abs(now + healthy) < _TOLERANCE_PART * np.abs(healthy) + _TOLERANCE_ERRORS * error
        found = []
        for wrong, shown, sign in _mistakes(list(places.values()), turned, channels):
            expected = healthy.copy()
            expected[wrong] = sign * healthy[shown]
            tolerance = _TOLERANCE_PART * np.abs(expected) + _TOLERANCE_ERRORS * error
            off, moved = np.abs(now - expected) / tolerance, np.abs(expected - healthy) / tolerance
            if off.max() < 1 and moved[wrong].min() > _LEAST_DISTANCE:
                found.append((float(off.max()), wrong, sign))
        if found:
            _, wrong, sign = min(found)
            return _fault([channels[column] for column in wrong], swapped=sign > 0)
    return None


def _mistakes(
    places: list[list[int]], turned: BoolArray, channels: Sequence[Channel]
) -> Iterator[tuple[list[int], list[int], int]]:
    """Mistakes to test: columns that are wrong, the columns whose healthy vectors they show, and with which sign."""
    of_place = [bool(turned[place].all()) for place in places]
    wrong = [column for place, all_turned in zip(places, of_place, strict=True) for column in place if all_turned]
    directions = {channels[column].direction for column in wrong}
    # The stiffness of a plane may fall so far that all 1x vectors in it turn by 180°.
    if any(one.direction in directions for column, one in enumerate(channels) if column not in wrong):
        yield wrong, wrong, -1
    for one, other in combinations(places, 2):
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
