"""Places whose sensors all have a wrong gain, are reversed or exchanged, so that they agree with each other as before.

A changed machine shows in other places, too, so places are compared. A gain multiplies the levels of its own place, and
of no other, by one factor at every frequency. Stiffness and damping move resonances, so they change some frequencies
more than others; unbalance changes one frequency everywhere. All places share the excitation, so the contrast of each
is used: the logarithm of its third-octave levels less the mean of the other places', compared with that in each
recording of the healthy machine. If the excitation is like that of none of them, no factor fits, and no gain is
reported.

The 1x vectors reveal reversed and exchanged sensors. No change of the machine gives two places each other's healthy 1x
vectors, or turns the vectors of some, not all, places of a plane by 180°, and leaves all others as they were.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from pydantic import BaseModel, Field

from models.levels.bands import BandLevels
from models.signals.block import BoolArray, ComplexArray, FloatArray
from models.signals.channels import Channel, state_name
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault

_PER_THIRD = 4
_LEAST_RMS = 0.01
"""Fraction of a channel's rms below which a third octave is ignored: it is mostly sensor noise."""
_FEWEST_PLACES, _FEWEST_THIRDS = 3, 4
_LEAST_LOG_GAIN = 0.08
"""Least change of a gain that is reported, as a natural logarithm; sensors differ by smaller ones anyway."""
_SCATTER = 0.005
_MOST_LEFT, _MOST_LEFT_PART = 4.0, 0.25
"""Mean square of the contrasts that a gain may leave, in variances of the healthy windows, and relative to that without
the gain. Healthy windows leave up to 2.4 variances; the change of stiffness and damping that looks most like a gain of
6 % leaves 0.3 of the mean square."""


class GainReference(BaseModel, extra="forbid", frozen=True, strict=True):
    """Third-octave levels of the places of a healthy machine."""

    places: tuple[str, ...] = Field(min_length=_FEWEST_PLACES)
    edges_hz: tuple[float, ...] = Field(min_length=_FEWEST_THIRDS)  # lower edges of the third octaves that are compared
    # (n_recordings, n_thirds, n_places), mean logarithm of the rms.
    levels: tuple[tuple[tuple[float, ...], ...], ...] = Field(min_length=1)
    # (n_thirds, n_places), standard deviation of one window's contrast within its recording.
    scatter: tuple[tuple[float, ...], ...]
    windows: int = Field(ge=1)  # number in the recording that has fewest


def place_of(channel: Channel) -> str:
    """Name of a place and direction, whose sensors may share a transducer or an amplifier."""
    angle = "" if channel.angle_deg is None else f" {channel.angle_deg:g}"
    return f"{channel.location} {channel.direction}{angle}"


def learn_gains(places: Sequence[str], recordings: Sequence[Sequence[BandLevels]]) -> GainReference | None:
    """Learn from healthy recordings of one steady condition each; None where there is too little to compare.

    `places` are those of the columns, see `place_of`; windows do not overlap.
    """
    names, windows = tuple(dict.fromkeys(places)), [one for recording in recordings for one in recording]
    freedom = len(windows) - len(recordings)
    if len(names) < _FEWEST_PLACES or freedom < 1:
        return None
    counts = np.all([_thirds(one.rms) > _LEAST_RMS * np.sqrt((one.rms**2).sum(axis=0)) for one in windows], axis=(0, 2))
    if counts.sum() < _FEWEST_THIRDS:
        return None
    every = [np.array([_levels(one, places)[counts] for one in recording]) for recording in recordings]
    within = np.concatenate([_contrast(own - own.mean(axis=0)) for own in every])
    scatter = np.sqrt((within**2).sum(axis=0) / freedom)
    levels = tuple(tuple(map(tuple, own.mean(axis=0).round(4).tolist())) for own in every)
    edges_hz, spread = tuple(_edges(windows[0])[counts].tolist()), tuple(map(tuple, scatter.round(5).tolist()))
    fewest = min(map(len, every))
    return GainReference(places=names, edges_hz=edges_hz, levels=levels, scatter=spread, windows=fewest)


def wrong_gain(levels: BandLevels, places: Sequence[str], reference: GainReference) -> tuple[str, float] | None:
    """Name the place with a wrong gain, and the factor; None if no gain explains the window."""
    low = _edges(levels)
    at = np.abs(low[:, None] - np.array(reference.edges_hz)).argmin(axis=0)
    if tuple(dict.fromkeys(places)) != reference.places or not np.allclose(low[at], reference.edges_hz, rtol=1e-3):
        return None
    now, scatter = _levels(levels, places)[at], np.array(reference.scatter)
    if not np.all(np.isfinite(now)):
        return None
    variance = np.maximum(np.maximum(scatter, np.median(scatter, axis=0)), _SCATTER) ** 2 * (1 + 1 / reference.windows)
    n = len(reference.places)
    found = []
    for healthy in reference.levels:
        contrast = _contrast(now - np.array(healthy))
        for number, place in enumerate(reference.places):
            of_gain = _contrast(np.eye(n)[number])
            factor = float(np.sum(contrast * of_gain / variance) / np.sum(of_gain**2 / variance))
            left = float(np.mean((contrast - factor * of_gain) ** 2 / variance))
            found.append((left, place, factor, float(np.mean(contrast**2 / variance))))
    left, place, factor, without = min(found)
    if not abs(factor) > _LEAST_LOG_GAIN or not left < min(_MOST_LEFT, _MOST_LEFT_PART * without):
        return None
    return place, float(np.exp(factor))


def left_of_1x(logs: FloatArray, errors: FloatArray, places: Sequence[str], place: str, factor: float) -> float:
    """Change of 1x that a wrong gain of a place leaves unexplained: chi-square less its degrees of freedom, 0 at least.

    A gain changes 1x at its own place only, by its factor. A factor common to all places is an unbalance, and is not
    counted. A changed bearing changes 1x at the other places too. For each channel, `logs` has the logarithm of 1x over
    that of the healthy machine, and `errors` its standard error.
    """
    names = tuple(dict.fromkeys(places))
    own = np.array([[one == name for one in places] for name in names]) / [[places.count(name)] for name in names]
    with np.errstate(divide="ignore", invalid="ignore"):  # a dead channel has no 1x
        left = own @ logs - math.log(factor) * np.array([name == place for name in names])
        weight = (own @ errors) ** -2.0
        squares = float(weight @ (left - weight @ left / weight.sum()) ** 2)
    return max(0.0, squares - len(names) + 1) if math.isfinite(squares) else 0.0


def _contrast(levels: FloatArray) -> FloatArray:
    """Each place's level less the mean of the others'."""
    n = levels.shape[-1]
    return np.asarray((n * levels - levels.sum(axis=-1, keepdims=True)) / (n - 1), dtype=np.float64)


def _edges(levels: BandLevels) -> FloatArray:
    return levels.edges_hz[:-1][: len(levels.rms) // _PER_THIRD * _PER_THIRD : _PER_THIRD]


def _thirds(rms: FloatArray) -> FloatArray:
    count = len(rms) // _PER_THIRD
    thirds = (rms[: count * _PER_THIRD] ** 2).reshape(count, _PER_THIRD, -1)
    return np.asarray(np.sqrt(thirds.sum(axis=1)), dtype=np.float64)


def _levels(levels: BandLevels, places: Sequence[str]) -> FloatArray:
    """Mean log rms of the channels of each place, shape (n_thirds, n_places); not finite if one of them is dead."""
    with np.errstate(divide="ignore"):
        rms = np.log(_thirds(levels.rms))
    columns = [[one == place for one in places] for place in dict.fromkeys(places)]
    return np.stack([rms[:, own].mean(axis=1) for own in columns], axis=1)


_NEWEST = (3, 6)  # numbers of newest hops that are compared before the whole window
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
