"""A wrong gain of all sensors of a place, told from a changed machine by what the places show side by side.

A gain multiplies what its place shows by one factor, at every frequency alike, and no other place. Stiffness and
damping move resonances, so they change some frequencies more than others; unbalance changes one frequency everywhere.
What shakes the machine is shared: the logarithm of each place's level in third octaves is taken less the mean of the
other places', and compared with that of each recording of the healthy machine. Where the excitation is like none of
these, no factor fits, and nothing is said.
"""

import math
from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel, Field

from models.levels.bands import BandLevels
from models.signals.block import FloatArray
from models.signals.channels import Channel

_BANDS = 4
_COUNTS = 0.01
"""Part of a channel's rms below which a third octave is not looked at: mostly the noise of the sensor."""
_FEWEST_PLACES, _FEWEST_THIRDS = 3, 4
_LEAST = 0.08
"""Change of a gain that is told; smaller ones are what sensors differ by."""
_SCATTER = 0.005
_FITS, _EXPLAINED = 4.0, 0.25
"""Mean square that a gain may leave, in variances of the healthy windows, and over what there is without it. Healthy
windows leave up to 2.4; of changed stiffness and damping, what looks most like a gain of 6 % leaves 0.3 of it."""


class GainReference(BaseModel, extra="forbid", frozen=True, strict=True):
    """Levels of the places of a healthy machine side by side."""

    places: tuple[str, ...] = Field(min_length=_FEWEST_PLACES)
    edges_hz: tuple[float, ...] = Field(min_length=_FEWEST_THIRDS)  # lower edges of the third octaves that are compared
    # (n_recordings, n_thirds, n_places), mean logarithm of the rms.
    levels: tuple[tuple[tuple[float, ...], ...], ...] = Field(min_length=1)
    # (n_thirds, n_places), standard deviation of one window's contrast within its recording.
    scatter: tuple[tuple[float, ...], ...]
    windows: int = Field(ge=1)  # fewest of a recording


def place_of(channel: Channel) -> str:
    """Sensors of one place and direction may share a transducer or an amplifier."""
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
    counts = np.all([_thirds(one.rms) > _COUNTS * np.sqrt((one.rms**2).sum(axis=0)) for one in windows], axis=(0, 2))
    if counts.sum() < _FEWEST_THIRDS:
        return None
    every = [np.array([_levels(one, places)[counts] for one in recording]) for recording in recordings]
    within = np.concatenate([_contrast(own - own.mean(axis=0)) for own in every])
    scatter = np.sqrt((within**2).sum(axis=0) / freedom)
    return GainReference(
        places=names,
        edges_hz=tuple(_edges(windows[0])[counts].tolist()),
        levels=tuple(tuple(map(tuple, own.mean(axis=0).round(4).tolist())) for own in every),
        scatter=tuple(map(tuple, scatter.round(5).tolist())),
        windows=min(map(len, every)),
    )


def wrong_gain(levels: BandLevels, places: Sequence[str], reference: GainReference) -> tuple[str, float] | None:
    """Place whose sensors show too much or too little, and by which factor; None where no gain explains the window."""
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
    if not abs(factor) > _LEAST or not left < min(_FITS, _EXPLAINED * without):
        return None
    return place, float(np.exp(factor))


def left_of_1x(logs: FloatArray, errors: FloatArray, places: Sequence[str], place: str, factor: float) -> float:
    """What a wrong gain of a place leaves of the change of 1x beyond what chance does, in squared standard errors.

    A gain changes 1x of its own place by its factor and that of no other, but for what they all share: an unbalance. A
    bearing that has changed moves the other places, too.

    Parameters
    ----------
    logs, errors : ndarray, shape (n_channels,)
        Logarithm of 1x over that of the healthy machine, and its standard error.
    """
    names = tuple(dict.fromkeys(places))
    own = np.array([[one == name for one in places] for name in names]) / [[places.count(name)] for name in names]
    with np.errstate(divide="ignore", invalid="ignore"):  # a dead channel has no 1x
        left = own @ logs - math.log(factor) * np.array([name == place for name in names])
        weight = (own @ errors) ** -2.0
        squares = float(weight @ (left - weight @ left / weight.sum()) ** 2)
    return max(0.0, squares - len(names) + 1) if math.isfinite(squares) else 0.0


def _contrast(levels: FloatArray) -> FloatArray:
    """Each place less the mean of the others."""
    n = levels.shape[-1]
    return np.asarray((n * levels - levels.sum(axis=-1, keepdims=True)) / (n - 1), dtype=np.float64)


def _edges(levels: BandLevels) -> FloatArray:
    return levels.edges_hz[:-1][: len(levels.rms) // _BANDS * _BANDS : _BANDS]


def _thirds(rms: FloatArray) -> FloatArray:
    count = len(rms) // _BANDS
    return np.asarray(np.sqrt((rms[: count * _BANDS] ** 2).reshape(count, _BANDS, -1).sum(axis=1)), dtype=np.float64)


def _levels(levels: BandLevels, places: Sequence[str]) -> FloatArray:
    """Mean logarithm of the channels of each place, shape (n_thirds, n_places); a channel that is dead has none."""
    with np.errstate(divide="ignore"):
        rms = np.log(_thirds(levels.rms))
    columns = [[one == place for one in places] for place in dict.fromkeys(places)]
    return np.stack([rms[:, own].mean(axis=1) for own in columns], axis=1)
