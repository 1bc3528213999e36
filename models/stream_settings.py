"""Settings of how a machine's samples come and of the windows made of them, with the defaults for what a file omits.

The usual window, lags and band suit machines whose motion lies between some 6 and 120 Hz. For a faster or slower one
all times are multiplied by one factor, unless it is near one: the factor follows from the natural frequencies, or from
the speed if these are not known. The usual segments suit modes that are not narrower than what a segment resolves:
for narrower ones they are longer.
"""

import math
from collections.abc import Collection, Sequence
from typing import Self

import numpy as np
from pydantic import BaseModel, Field, model_validator

from models.signals.block import FloatArray

_USABLE = 0.4
"""Fraction of the sampling rate up to which an anti-aliasing filter passes the signal."""
_SLOW_HZ, _FAST_HZ = 6.0, 120.0
"""Least first and largest fourth natural frequency (lateral, of bearing and disc) that the usual window suits, Hz."""
_FAST_SPEED_HZ = 50.0
_SLOWEST, _LONGEST_SEGMENT_S = 59.0, 120.0
NEAR = 0.8
"""Time scale, or its reciprocal, from which on the usual window is near enough."""
_SEGMENTS_S = (2.0, 5.0, 10.0)  # usual one, and longer ones that fit the usual hop
_RESOLVED = 1.5 * math.pi
"""Decay of a mode over a segment, in nepers, from which its half-power bandwidth is at least the noise bandwidth of a
Hann window (1.5 bins: F. J. Harris, Proc. IEEE 66 (1978), table 1)."""
LONGEST_LAG_STEP_S = 0.00126
"""Spacing of the lags at time scale 1 beyond which a kernel of level *none* has too few points."""
_LENGTHS = ("segment_s", "hop_s", "length_s", "max_span_s")


def whole(value: float) -> bool:
    """Whether a number is whole, except for rounding."""
    return abs(value - round(value)) < 1e-9 * max(1.0, abs(value))


class IngestSettings(BaseModel, extra="forbid", frozen=True):
    """When a block is refused, and when silence is called missing data."""

    block_from_s: float = Field(default=0.001, gt=0, le=1, description="shortest accepted block")
    block_to_s: float = Field(default=2.0, gt=0, le=630, description="longest accepted block")
    time_tolerance_s: float = Field(default=0.0002, gt=0, le=1, description="jitter of block times that is no gap")
    rate_tolerance: float = Field(default=1e-4, ge=0, lt=0.1, description="relative deviation of the sampling rate")
    max_jump_s: float = Field(default=3600.0, gt=0, description="a block further ahead than this is refused as future")
    resync_blocks: int = Field(default=10, ge=2, le=1000, description="blocks in a row that establish a stepped clock")
    reorder_blocks: int = Field(
        default=20, ge=0, le=1000, description="blocks that may wait for a missing one; 0 takes them as they arrive"
    )
    no_data_after_s: float = Field(default=5.0, gt=0, le=30 * 86400, description="silence that is called no data")

    @model_validator(mode="after")
    def _blocks_are_no_silence(self) -> Self:
        if self.no_data_after_s <= self.block_to_s:
            raise ValueError(
                f"no_data_after_s is {self.no_data_after_s:g}, expected more than block_to_s, {self.block_to_s:g}: "
                "between two blocks of that length nothing arrives for as long"
            )
        return self


class WindowSettings(BaseModel, extra="forbid", frozen=True):
    """The sliding window: its length, how often it is evaluated, and what is computed in it."""

    length_s: float = Field(default=60.0, gt=0, le=30 * 86400, description="window length")
    hop_s: float = Field(
        default=5.0, gt=0, le=86400, description="one report per hop; also the sub-block of the errors"
    )
    max_span_s: float = Field(
        default=90.0, gt=0, le=60 * 86400, description="oldest sample a window may hold, across gaps"
    )
    lag_from_s: float = Field(default=0.01, ge=0, le=10, description="shortest lag of the relation networks")
    lag_to_s: float = Field(default=0.125, gt=0, le=10, description="longest lag of the correlation functions")
    lag_step_s: float = Field(default=0.001, gt=0, le=1, description="lag spacing of the relation networks")
    segment_s: float = Field(
        default=2.0, gt=0, le=_LONGEST_SEGMENT_S, description="segment of the cross-spectra, half overlapped"
    )
    band_hz: tuple[float, float] = Field(default=(3.0, 150.0), description="band of the likelihood, from and to")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not whole(self.length_s / self.hop_s) or self.length_s < 4 * self.hop_s:
            raise ValueError(f"length_s {self.length_s} must be a multiple of hop_s {self.hop_s}, at least four hops")
        if self.lag_to_s >= self.hop_s:
            raise ValueError(f"lag_to_s {self.lag_to_s} must be below hop_s {self.hop_s}")
        if self.lag_from_s >= self.lag_to_s:
            raise ValueError(f"lag_from_s {self.lag_from_s} must be below lag_to_s {self.lag_to_s}")
        if not 0 < self.band_hz[0] < self.band_hz[1]:
            raise ValueError(f"band_hz {self.band_hz} must be 0 < from < to")
        if self.max_span_s < self.length_s:
            raise ValueError(f"max_span_s {self.max_span_s} must not be below length_s {self.length_s}")
        return self

    @property
    def hops(self) -> int:
        """Hops in a full window."""
        return round(self.length_s / self.hop_s)


class Schedule(BaseModel, extra="forbid", frozen=True):
    """Snapshots: a stretch of samples at regular intervals, with silence between them."""

    on_s: float = Field(gt=0, le=600, description="length of a snapshot")
    every_s: float = Field(gt=0, le=86400, description="from the start of a snapshot to that of the next one")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.on_s >= self.every_s:
            raise ValueError(f"on_s {self.on_s:g} must be below every_s {self.every_s:g}: there is silence between")
        return self

    @property
    def silence_s(self) -> float:
        """Silence after a snapshot."""
        return self.every_s - self.on_s

    def is_silence(self, silence_s: float) -> bool:
        """Whether a silence of this length leaves no snapshot missing: snapshots may come half a period late."""
        return self.silence_s / 2 <= silence_s <= self.silence_s + self.every_s / 2

    def window(self, rate_hz: float, usual: WindowSettings) -> dict[str, float]:
        """Defaults of the window, from the `usual` ones of an unbroken stream.

        A hop is a snapshot, a window twelve of them. Seven half-overlapping segments or more go into a snapshot, and
        the longest lag is at most a quarter of it.
        """
        halves = min(round(usual.segment_s / 2 * rate_hz), math.floor(self.on_s * rate_hz / 8))
        lag_to_s = min(usual.lag_to_s, math.floor(self.on_s * rate_hz / 4) / rate_hz)
        return {
            "length_s": 12 * self.every_s,
            "hop_s": self.every_s,
            "max_span_s": 18 * self.every_s,
            "segment_s": 2 * max(halves, 1) / rate_hz,
            "lag_to_s": max(lag_to_s, 2 / rate_hz),
            "lag_from_s": min(usual.lag_from_s, math.floor(lag_to_s * rate_hz / 8) / rate_hz),
        }

    def ingest(self) -> dict[str, float]:
        """Defaults of ingest: a block may be a whole snapshot, and two snapshots may fail to come."""
        defaults = IngestSettings()
        return {
            "block_to_s": max(defaults.block_to_s, 1.05 * self.on_s),
            "no_data_after_s": max(defaults.no_data_after_s, 2.5 * self.every_s),
            "max_jump_s": max(defaults.max_jump_s, 10 * self.every_s),
        }


def time_scale(modes_hz: Sequence[float], speed_hz: float | None) -> float:
    """How many times slower a machine moves than those that the usual window suits: 1 for these, less for faster ones.

    Parameters
    ----------
    modes_hz : sequence of float
        Natural frequencies, ascending; empty if they are not known. A machine with both slow and fast ones counts as 1.
    speed_hz : float, optional
        Nominal speed, used if they are not known. A slow shaft says nothing about how fast the machine vibrates.

    Examples
    --------
    >>> time_scale((28.1, 30.2, 91.6, 93.5, 489.0, 489.0), 22.0), time_scale((), 330.0)
    (1.0, 0.15)
    """
    scale = 1.0
    if not modes_hz:
        scale = min(1.0, _FAST_SPEED_HZ / speed_hz) if speed_hz else 1.0
    elif modes_hz[3] > _FAST_HZ and modes_hz[0] >= _SLOW_HZ:
        scale = _FAST_HZ / modes_hz[3]
    elif modes_hz[0] < _SLOW_HZ and modes_hz[3] <= _FAST_HZ:
        scale = min(_SLOWEST, _SLOW_HZ / modes_hz[0], _FAST_HZ / modes_hz[3])
    scale = float(f"{scale:.2g}")
    return 1.0 if NEAR <= scale <= 1 / NEAR else scale


def segment_for(modes_hz: FloatArray, damping: FloatArray, to_hz: float, longer: float) -> float:
    """Length of segments that resolve all modes of a turning rotor below `to_hz`, or the longest that fits, s.

    It is the usual length where that is enough. All are multiplied by `longer`, the time scale of a slow machine.

    Examples
    --------
    >>> segment_for(np.array([12.0, 40.0]), np.array([0.01, 0.05]), 150.0, 1.0)
    10.0
    """
    slowest = np.min(2 * np.pi * (modes_hz * damping)[modes_hz < to_hz], initial=np.inf)
    segments_s = [longer * one for one in _SEGMENTS_S if longer * one <= _LONGEST_SEGMENT_S]
    return next((one for one in segments_s if one * slowest >= _RESOLVED), segments_s[-1])


def default_window(
    rate_hz: float,
    given: Collection[str],
    schedule: Schedule | None,
    modes_hz: Sequence[float],
    speed_hz: float | None,
    turning: tuple[FloatArray, FloatArray] | None = None,
) -> dict[str, object]:
    """Settings of the window that are not given and are not the usual ones.

    Data acquisition often divides a clock by whole numbers (51 200 / 3 Hz), and slow machines are sampled slowly: the
    nearest settings that are whole numbers of samples are taken, and the band ends within what the rate allows. Fast
    and slow machines have their own, see `time_scale`; a slow one has the usual ones if one of the lengths is given,
    because the others have to fit it. Segments of a fast machine are not shortened: the same time gives more
    information about it, so the leakage from one frequency into the next has to be smaller too. They are longer where a
    mode in the band is narrower than they resolve; `turning` are natural frequencies (Hz) and damping ratios at nominal
    speed, where they are known.

    Examples
    --------
    >>> default_window(200.0, (), None, (), None)
    {'band_hz': (3.0, 80.0), 'lag_step_s': 0.005}
    >>> round(default_window(51200 / 3, (), None, (), None)["hop_s"] * 51200 / 3, 6)
    85335.0
    >>> default_window(20000.0, (), None, (), 330.0)["band_hz"]
    (20.0, 1000.0)
    """
    usual, scale = WindowSettings(), time_scale(modes_hz, speed_hz)
    if {*_LENGTHS} & {*given}:  # the others have to go with them, and longer lags might not
        scale = min(scale, 1.0)
    low_hz, high_hz = (edge / scale for edge in usual.band_hz)
    if modes_hz:
        low_hz, high_hz = min(low_hz, modes_hz[0] / 2), max(high_hz, 1.25 * modes_hz[3])
    low_hz, high_hz = float(f"{low_hz:.3g}"), float(f"{high_hz:.3g}")
    if 2 * low_hz > _USABLE * rate_hz:  # the rate is too low for that band: levels are left
        scale, (low_hz, high_hz) = 1.0, usual.band_hz
    if high_hz >= rate_hz / 2 and _USABLE * rate_hz > low_hz:
        high_hz = _USABLE * rate_hz
    found: dict[str, object] = {} if (low_hz, high_hz) == usual.band_hz else {"band_hz": (low_hz, high_hz)}
    step_s, longer = usual.lag_step_s * scale, max(scale, 1.0)
    lengths = {name: getattr(usual, name) * longer for name in _LENGTHS}
    if turning is not None:
        lengths["segment_s"] = segment_for(*turning, high_hz, longer)
    if scale != 1 and not {"lag_from_s", "lag_to_s"} & {*given}:
        found |= {name: getattr(usual, name) * scale for name in ("lag_from_s", "lag_to_s")}
    if scale != 1 or not whole(step_s * rate_hz):
        most = math.floor(LONGEST_LAG_STEP_S * scale * rate_hz)
        found["lag_step_s"] = max(1, min(round(step_s * rate_hz), most)) / rate_hz
    if schedule is not None:
        found |= schedule.window(rate_hz, usual.model_copy(update={"segment_s": lengths["segment_s"]} | found))
    elif {"segment_s", "hop_s", "length_s"} & {*given}:  # multiples of each other
        return found
    elif lengths["segment_s"] != usual.segment_s or not all(whole(each * rate_hz) for each in lengths.values()):
        half = max(1, round(lengths["segment_s"] / 2 * rate_hz))
        found |= {name: round(2 * each / lengths["segment_s"]) * half / rate_hz for name, each in lengths.items()}
    return found
