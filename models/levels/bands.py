"""Levels in narrow bands, compared with the reference: they show growth at any frequency, whatever the speed.

If the running speed is not known there are no orders, and a line that doubles is lost in the overall level; sidebands
and subharmonics are at no order at all. In 1/12-octave bands a line stands out of random vibration, and growth of any
kind shows in one of them. A line moves to a neighbouring band when the speed changes, so each band is compared with the
loudest of its neighbourhood.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field
from scipy.special import fdtri

from models.signals.block import FloatArray, IndexArray
from rotorwatch.records.levels import three_digits

BEYOND_RANGE, ERRORS = 1.25, 6.0
"""No limit is nearer than this many times the largest healthy level, or this many standard errors of a window."""
NYQUIST_PART = 0.8
"""Fraction of half the sampling rate up to which spectra are used: above it anti-aliasing filters fall off."""
_PER_OCTAVE = 12
_FIRST_BIN = 2
"""The taper spreads the mean over the bins before it."""
_LEAST_RMS = 0.01
"""Fraction of a channel's rms below which a band is ignored: it is mostly sensor noise."""
_CHANCE = 1e-9
NEIGHBOURHOOD = 2.0 ** (1 / _PER_OCTAVE) - 1
"""Relative change of the speed that moves a line by one band; a larger one moves it out of the neighbourhood."""
LINE = 0.2
"""Least share of its band's power that the strongest bin of a line has."""
OF_BIN = 1.5
"""Power of a line over that of its strongest bin, if the line is at the centre of the bin."""
_Level = Annotated[float, Field(ge=0, allow_inf_nan=False)]


@lru_cache(maxsize=8)
def band_edges(n_samples: int) -> IndexArray:
    """Bins of a Fourier transform at which bands begin, and the end of the last one."""
    last = int(NYQUIST_PART * (n_samples // 2))
    count = max(0, int(np.log2(max(1, last) / _FIRST_BIN) * _PER_OCTAVE))
    edges = np.unique(np.rint(_FIRST_BIN * 2.0 ** (np.arange(count + 1) / _PER_OCTAVE)).astype(np.intp))
    edges.flags.writeable = False
    return edges


@dataclass(frozen=True, slots=True)
class BandLevels:
    """Levels of a window in bands."""

    edges_hz: FloatArray  # (n_bands + 1,)
    rms: FloatArray  # (n_bands, n), SI units
    errors: FloatArray | None  # (n_bands, n), standard errors from the scatter of the hops, if asked for
    freedom: FloatArray  # (n_bands,), degrees of freedom of a mean square of Gaussian noise


class BandReference(BaseModel, extra="forbid", frozen=True, strict=True):
    """Healthy levels of one channel in bands, SI units."""

    edges_hz: tuple[_Level, ...]
    mean: tuple[_Level, ...]
    high: tuple[_Level, ...]  # largest of the windows
    low: tuple[_Level, ...] = Field(default=(), exclude_if=lambda found: not found)  # smallest of them
    error: tuple[_Level, ...]  # mean standard error of one window
    freedom: tuple[_Level, ...]  # degrees of freedom of `mean`


def learn_bands(windows: Sequence[BandLevels], column: int) -> BandReference:
    """Learn the reference of one channel from healthy windows."""
    rms = np.stack([one.rms[:, column] for one in windows])
    errors = np.stack([one.errors[:, column] for one in windows if one.errors is not None])
    edges_hz, freedom = _short(windows[0].edges_hz), _short(np.asarray(sum(one.freedom for one in windows)))
    mean, high, low = _short(rms.mean(axis=0)), _short(rms.max(axis=0)), _short(rms.min(axis=0))
    error = _short(errors.mean(axis=0))
    return BandReference(edges_hz=edges_hz, mean=mean, high=high, low=low, error=error, freedom=freedom)


def _short(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(f"{value:.4g}") for value in values.tolist())


@dataclass(frozen=True, slots=True)
class Growth:
    """The band that is nearest to its limit, or farthest beyond."""

    band_hz: tuple[float, float]
    ratio: float  # its level over that of the reference
    limit: float  # ratio from which on it is an alert


@dataclass(frozen=True, slots=True)
class BandLimits:
    """Limits of the bands of all channels for windows of one length; zero where there is no reference."""

    # All (n_bands, n).
    own: FloatArray  # mean healthy level
    mean: FloatArray  # mean healthy level of the loudest band of the neighbourhood
    limit: FloatArray


def band_limits(
    levels: BandLevels, references: Sequence[BandReference | None], ratio: float, shorter: float
) -> BandLimits:
    """Limits of the bands of all channels.

    The ratio of the mean squares of two stretches of Gaussian noise follows an F distribution (J. S. Bendat, A. G.
    Piersol, "Random Data", 4th ed., chapter 4): no limit is nearer than what chance exceeds once in 10⁹ bands.

    Levels are those of a window of the length in question, references are by column. `ratio` is the least limit over
    the mean of the reference; a level scatters `shorter` times as much as in the healthy windows while a window fills.
    """
    own, mean, limit = np.zeros((3, *levels.rms.shape))
    for column, reference in enumerate(references):
        if reference is None or levels.edges_hz.size != len(reference.edges_hz):
            continue
        if not np.allclose(levels.edges_hz, reference.edges_hz, rtol=1e-3):
            continue
        around, high, error = (widened(np.array(each)) for each in (reference.mean, reference.high, reference.error))
        chance = np.sqrt(fdtri(levels.freedom, np.array(reference.freedom), 1 - _CHANCE))
        relative = ERRORS * np.divide(error, around, out=np.zeros_like(around), where=around > 0)
        loudest = np.maximum(BEYOND_RANGE, 1 + relative * np.sqrt(shorter**2 - 1)) * high
        own[:, column], mean[:, column] = reference.mean, around
        least = [np.maximum(ratio, chance) * around, loudest, (1 + relative * shorter) * around]
        limit[:, column] = np.max(least, axis=0)
    return BandLimits(own, mean, limit)


def growth(levels: BandLevels, limits: BandLimits) -> list[Growth | None]:
    """Compare every channel's bands with its reference; None where there is nothing to compare."""
    now, columns = levels.rms, np.arange(levels.rms.shape[1])
    looked_at = (now > _LEAST_RMS * np.sqrt(np.sum(now**2, axis=0))) & (limits.own > 0)
    ratios = np.divide(now, limits.own, out=np.full(now.shape, np.inf), where=looked_at)
    count = looked_at.sum(axis=0)
    ratios.sort(axis=0)
    # Equal growth of all bands is growth of the excitation, which the limits of the overall level cover.
    median = (ratios[(count - 1) // 2, columns] + ratios[count // 2, columns]) / 2
    limit = limits.limit * np.maximum(1.0, np.where(count > 0, median, 1.0))
    at = np.divide(now, limit, out=np.zeros(now.shape), where=looked_at).argmax(axis=0)
    edges, mean = levels.edges_hz, limits.mean[at, columns]
    return [
        Growth(
            (float(edges[band]), float(edges[band + 1])), float(now[band, n] / mean[n]), float(limit[band, n] / mean[n])
        )
        if count[n]
        else None
        for n, band in enumerate(at.tolist())
    ]


def widened(values: FloatArray) -> FloatArray:
    """Largest value of each band and its two neighbours, to which a line moves when the speed changes."""
    padded = np.concatenate([values[:1], values, values[-1:]])
    return np.asarray(np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:]))


def band_in_words(band_hz: tuple[float, float]) -> str:
    """Edges of a band as text, without powers of ten.

    Examples
    --------
    >>> band_in_words((94.567, 5202.4))
    '94.6 to 5202 Hz'
    """
    return "{} to {} Hz".format(*map(three_digits, band_hz))
