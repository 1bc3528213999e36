"""Levels of the healthy machine: their mean, range and error in each operating state."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, Field, model_validator

from models.checkpoint import checked, texts
from models.errors import CheckpointError
from models.levels.bands import NEIGHBOURHOOD, BandLevels, BandReference, learn_bands
from models.levels.kurtosis import HopReference, learn_hops
from models.levels.lines import expected_lines, learn_lines
from models.levels.measures import COMPARED, STANDS_RAD_S, WindowLevels
from models.levels.places import GainReference
from models.signals.block import FloatArray

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Level = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_SAME_SPEED = 0.03
"""Windows whose speeds differ by less, relative, are of one operating state."""
_BY_THEORY, _OF_MEANS = 1000, 0.6
"""Number of hops that theory counts as; and the error that the mean of twelve hops exceeds in one of thirty windows."""
_UNTOUCHED, _UNTOUCHED_SCATTER = 0.5, 1.1
"""Mean and scatter of contact statistics that theory allows a shaft that touches nothing. Where modes ring for seconds
or sensors are noisy, they reach 0.7 and 1.3 (random rotors of 0.5 to 200 kg, 12 to 15 minutes each)."""
QUIET = 0.25
"""Fraction of the running vibration below which a machine may be standing; what neighbours excite should be less."""


class ReferenceLevel(BaseModel, extra="forbid", frozen=True, strict=True):
    """One measure of one channel over the healthy windows of an operating state, SI units."""

    mean: _Level
    # Smallest and largest of the windows.
    low: _Level
    high: _Level
    error: _Level  # mean standard error of one window
    # Of 1x, with a phase reference: real and imaginary part of the mean of q.
    vector: tuple[_Finite, _Finite] | None = None
    turned: _Level = 0.0  # largest distance of a window's vector from `vector`


class OperatingState(BaseModel, extra="forbid", frozen=True, strict=True):
    """Levels at one speed."""

    windows: int = Field(ge=1)
    speed_rad_s: tuple[_Finite, _Finite] | None  # slowest and fastest window; None where the speed is not known
    levels: dict[str, dict[str, ReferenceLevel]]  # by channel and measure
    hops: float = Field(ge=1)  # mean number of hops in a window
    # Whether the speed moved lines to other bands within a window.
    varied: bool = Field(default=False, exclude_if=lambda found: not found)
    # By channel.
    bands: dict[str, BandReference] = {}
    # Largest share of each band's power that the strongest bin of a hop had, see `models.levels.lines`.
    lines: dict[str, tuple[_Level, ...]] = Field(default={}, exclude_if=lambda found: not found)
    kurtosis: dict[str, HopReference] = Field(default={}, exclude_if=lambda found: not found)
    contact: dict[str, HopReference] = Field(default={}, exclude_if=lambda found: not found)


class LevelReference(BaseModel, extra="forbid", frozen=True, strict=True):
    """Healthy levels, state by state."""

    source: str  # where they are from, as operators will read it
    states: tuple[OperatingState, ...] = Field(min_length=1)
    # Levels of the places for comparison with each other, see `models.levels.places`.
    gains: GainReference | None = Field(default=None, exclude_if=lambda found: found is None)
    # Frequency, Hz, and order of each line; None if lines were not looked for.
    lines: tuple[tuple[_Level, _Level], ...] | None = Field(default=None, exclude_if=lambda found: found is None)
    # Whether they were looked for next to multiples of the speed as well.
    beside: bool = Field(default=False, exclude_if=lambda found: not found)
    # Whether lines were kept that are too faint to be certain of in one window.
    faint: bool = Field(default=False, exclude_if=lambda found: not found)

    @model_validator(mode="after")
    def _known(self) -> Self:
        unknown = {name for state in self.states for one in state.levels.values() for name in one} - set(COMPARED)
        if unknown:
            raise ValueError(f"levels: {', '.join(sorted(unknown))} is not one of {', '.join(COMPARED)}")
        return self

    def at(self, speed_rad_s: float | None) -> tuple[OperatingState, bool]:
        """The state nearest in speed, and whether the machine ran at such a speed when it was learned."""
        turning = speed_rad_s is not None and math.isfinite(speed_rad_s)
        # A machine that stands is compared with itself while it stood, and one that runs with itself while it ran.
        alike = [state for state in self.states if (state.speed_rad_s is not None) == turning] or self.states
        if speed_rad_s is None or not turning:
            return max(alike, key=lambda state: state.windows), True

        def distance(state: OperatingState) -> float:
            if state.speed_rad_s is None:
                return 0.0
            slowest, fastest = sorted(abs(edge) for edge in state.speed_rad_s)
            now = abs(speed_rad_s)
            return max(slowest - now, now - fastest, 0.0) / max(fastest, 1e-9)

        nearest = min(alike, key=distance)
        return nearest, distance(nearest) <= _SAME_SPEED

    def passed(self, levels: WindowLevels) -> tuple[tuple[OperatingState, bool], ...]:
        """The states at whose speeds the machine turned in the window, each as by `at`; empty if it was one only."""
        if levels.speeds_rad_s is None or len(self.states) < 2:
            return ()
        found = [self.at(speed) for speed in levels.speeds_rad_s.tolist() if abs(speed) > STANDS_RAD_S]
        several = len({id(state) for state, _ in found}) > 1
        return tuple({(id(one[0]), one[1]): one for one in found}.values()) if several else ()


def learn_levels(
    source: str,
    channels: Sequence[str],
    windows: Sequence[WindowLevels],
    gains: GainReference | None = None,
    lines: tuple[tuple[float, float], ...] | None = None,
) -> LevelReference:
    """Learn from one healthy window or more that do not overlap."""
    groups: list[list[WindowLevels]] = []
    for levels in sorted(windows, key=_speed):
        if groups and _speed(levels) - _speed(groups[-1][-1]) <= _SAME_SPEED * _speed(levels):
            groups[-1].append(levels)
        else:
            groups.append([levels])
    states = tuple(_state(channels, group) for group in groups)
    looked = lines is not None
    return LevelReference(source=source, states=states, gains=gains, lines=lines, beside=looked, faint=looked)


def expected_levels(
    channels: Sequence[str],
    levels: WindowLevels,
    speeds_rad_s: tuple[float, float],
    modes: Sequence[tuple[float, float]],
) -> LevelReference:
    """Reference by theory for a machine under random excitation: no levels, because they depend on the force.

    The shaft, running between these speeds, touches nothing, and its bands hold no lines but those of narrow modes
    (natural frequency, Hz, and damping ratio). `levels` are those of any window of the machine.
    """
    bands, parts = {}, {}
    nothing = HopReference(mean=_UNTOUCHED, scatter=_UNTOUCHED_SCATTER, hops=_BY_THEORY, range=_OF_MEANS)
    if levels.lines is not None:
        edges_hz, none = tuple(levels.bands.edges_hz.tolist()), (0.0,) * len(levels.bands.freedom)
        freedom = tuple(levels.bands.freedom.tolist())
        silent = BandReference(edges_hz=edges_hz, mean=none, high=none, low=none, error=none, freedom=freedom)
        found = tuple(expected_lines(levels.bands, levels.hops, modes).round(3).tolist())
        bands, parts = dict.fromkeys(channels, silent), dict.fromkeys(channels, found)
    contact = {} if levels.contact is None else dict.fromkeys(channels, nothing)
    state = OperatingState(
        windows=1, speed_rad_s=speeds_rad_s, levels={}, hops=levels.hops, bands=bands, lines=parts, contact=contact
    )
    return LevelReference(source="the machine file", states=(state,))


def _speed(levels: WindowLevels) -> float:
    return abs(levels.speed_rad_s or 0.0)


def _state(channels: Sequence[str], group: Sequence[WindowLevels]) -> OperatingState:
    speeds = [one.speed_rad_s for one in group if one.speed_rad_s is not None]
    looked, lines = [parts for one in group if (parts := one.line_parts) is not None], np.empty((0, 0))
    if len(looked) == len(group):
        lines = learn_lines(looked, group[0].bands, group[0].hops, max(one.unsteady for one in group))
    return OperatingState(
        windows=len(group),
        speed_rad_s=(min(speeds), max(speeds)) if speeds else None,
        levels={
            channel: {name: found for name in COMPARED if (found := _reference(name, column, group)) is not None}
            for column, channel in enumerate(channels)
        },
        hops=float(np.mean([one.hops for one in group])),
        varied=any(NEIGHBOURHOOD < one.unsteady < math.inf for one in group),
        bands={
            channel: learn_bands(own, column)
            for column, channel in enumerate(channels)
            if (own := [one.bands for one in group if np.isfinite(one.bands.rms[:, column]).all()])
        },
        lines=dict(zip(channels, map(tuple, lines.T.round(3).tolist()), strict=False)),  # of all channels, or none
        kurtosis=_hops(channels, [one.random_kurtosis for one in group], [one.random_share for one in group]),
        contact={
            # A scatter as in theory at least; and a push outwards, which has another cause, must not hide one inwards.
            name: one.model_copy(update={"mean": max(0.0, one.mean), "scatter": max(1.0, one.scatter)})
            for name, one in _hops(channels, [one.contact for one in group]).items()
        },
    )


def _hops(
    channels: Sequence[str], windows: Sequence[FloatArray | None], shares: Sequence[FloatArray | None] = ()
) -> dict[str, HopReference]:
    """Hop references of the channels that have values in all windows; empty if a window has none at all."""
    known, parts = ([one for one in values if one is not None] for values in (windows, shares))
    if len(known) < len(windows):
        return {}
    columns = range(len(channels))
    learned = [learn_hops([one[:, at] for one in known], [one[:, at] for one in parts]) for at in columns]
    return {channel: one for channel, one in zip(channels, learned, strict=True) if one is not None}


def _reference(name: str, column: int, levels: Sequence[WindowLevels]) -> ReferenceLevel | None:
    # Without the windows in which the sensor, or its partner of a pair, was not connected.
    levels = [one for one in levels if np.isfinite(one.bands.rms[:, column]).all()]
    if name == "s_max":
        levels = [one for one in levels if np.isfinite(one.values[name][column])]
    values = np.array([one.values[name][column] for one in levels])
    errors = np.array([one.errors[name][column] for one in levels])
    if not levels or not np.all(np.isfinite(values)):
        return None
    vector, turned = None, 0.0
    if name == "x1" and all(one.vectors is not None for one in levels):
        of_windows = np.array([one.vectors[1, column] for one in levels if one.vectors is not None])
        centre = complex(of_windows.mean())
        vector, turned = (centre.real, centre.imag), float(np.abs(of_windows - centre).max())
    mean, low, high = float(values.mean()), float(values.min()), float(values.max())
    error = float(np.nanmean(errors)) if np.any(np.isfinite(errors)) else 0.0
    return ReferenceLevel(mean=mean, low=low, high=high, error=error, vector=vector, turned=turned)


class FirstWindows:
    """Learns a reference from the first windows, if nothing was commissioned.

    A channel whose values are NaN in some of them is learned from the others.

    If the machine was not seen to turn in them, and every channel vibrates four times as much once it is, it stood
    still: the first windows in which it turns become a second reference. It `turns` if rotation can be detected, by a
    shaft angle or near a nominal speed.

    The `count` windows do not overlap. `since` says from when they are, as operators will read it; it is empty if they
    are from the beginning. `of` identifies what the levels depend on: a reference of another machine, or other
    settings, is not restored.
    """

    def __init__(
        self, channels: Sequence[str], count: int, *, turns: bool = False, since: str = "", of: str = ""
    ) -> None:
        self._channels = tuple(channels)
        self._count = count
        self._turns = turns
        self._source = f"the first windows since {since}" if since else "the first windows"
        self._of = of
        self._seen: list[WindowLevels] = []
        self._end_ns = 0
        self.reference: LevelReference | None = None

    @property
    def learning(self) -> bool:
        """Whether windows are still taken."""
        states = () if self.reference is None else self.reference.states
        return not states or (self._turns and all(state.speed_rad_s is None for state in states))

    @property
    def progress(self) -> str:
        """What the reference rests on so far, in words."""
        if self.reference is None:
            return f"{len(self._seen)} of {self._count} first windows, so no limit is relative to this machine yet"
        return f"levels are compared with {self._source}, until {np.datetime64(self._end_ns, 'ns').astype('M8[s]')}Z"

    def take(self, start_ns: int, end_ns: int, levels: WindowLevels) -> None:
        """Learn from a full window, if it is still needed and does not overlap the last one."""
        before = self.reference
        if not self.learning or start_ns < self._end_ns or (before is not None and not self._started(before, levels)):
            return
        self._end_ns = end_ns
        # Only diagnosis needs a healthy kurtosis or contact, and a machine that is diagnosed is commissioned.
        self._seen.append(replace(levels, moments=None, contact=None, lines=None))
        if len(self._seen) == self._count:
            learned, self._seen = learn_levels(self._source, self._channels, self._seen), []
            states = (*(() if before is None else before.states), *learned.states)
            self.reference = learned.model_copy(update={"states": states})

    def _started(self, reference: LevelReference, levels: WindowLevels) -> bool:
        """Whether the machine turns now, and stood still in the reference."""
        stood, _ = reference.at(None)
        quiet = [stood.levels[name].get("overall") for name in self._channels]
        means = np.array([np.nan if one is None else one.mean for one in quiet])
        # False for channels that had no numbers then, or have none now.
        still = QUIET * levels.values["overall"] <= means
        return levels.speed_rad_s is not None and not still.any()

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything as named arrays."""
        seen = self._seen
        speeds = [math.nan if one.speed_rad_s is None else one.speed_rad_s for one in seen]
        shape = (len(seen), len(COMPARED), len(self._channels))
        none = np.zeros((0, 0), dtype=np.complex128)
        return {
            "of": np.array([self._of]),
            "reference": np.array(["" if self.reference is None else self.reference.model_dump_json()]),
            "end_ns": np.array(self._end_ns, dtype=np.int64),
            "speeds": np.array(speeds, dtype=np.float64),
            "hops": np.array([one.hops for one in seen], dtype=np.int64),
            "values": np.array([[one.values[name] for name in COMPARED] for one in seen]).reshape(shape),
            "errors": np.array([[one.errors[name] for name in COMPARED] for one in seen]).reshape(shape),
            **{
                f"{name}_{number}": getattr(one.bands, name)
                for number, one in enumerate(seen)
                for name in ("edges_hz", "rms", "errors", "freedom")
            },
            **{f"vectors_{number}": none if one.vectors is None else one.vectors for number, one in enumerate(seen)},
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Go on where `checkpoint` was called; arrays that are damaged, or of other channels, change nothing."""
        (of,), (text,) = texts(arrays, "of"), texts(arrays, "reference")
        if of != self._of:
            raise CheckpointError("the levels are of other sensors or settings")
        try:
            reference = LevelReference.model_validate_json(text) if text else None
        except ValueError as error:
            raise CheckpointError(f"the reference of the levels cannot be restored: {error}") from error
        speeds = checked(arrays, "speeds", np.float64, (None,))
        hops = checked(arrays, "hops", np.int64, (speeds.size,)).tolist()
        shape = (speeds.size, len(COMPARED), len(self._channels))
        values, errors = (checked(arrays, name, np.float64, shape) for name in ("values", "errors"))
        flat, wide = (None,), (None, shape[2])
        forms = {"edges_hz": flat, "rms": wide, "errors": wide, "freedom": flat}
        seen = []
        for n, speed in enumerate(speeds.tolist()):
            vectors = checked(arrays, f"vectors_{n}", np.complex128, (None, None))
            bands = {name: checked(arrays, f"{name}_{n}", np.float64, form) for name, form in forms.items()}
            seen.append(
                WindowLevels(
                    dict(zip(COMPARED, values[n], strict=True)),
                    dict(zip(COMPARED, errors[n], strict=True)),
                    vectors if vectors.size else None,
                    BandLevels(**bands),
                    speed if math.isfinite(speed) else None,
                    hops[n],
                )
            )
        end_ns = int(checked(arrays, "end_ns", np.int64, ()))
        self._seen, self.reference, self._end_ns = seen, reference, end_ns
