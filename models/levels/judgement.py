"""Levels against their limits: absolute ones, and those relative to a reference."""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from models.levels.bands import Growth, growth
from models.levels.gains import place_of, wrong_gain
from models.levels.kurtosis import departure
from models.levels.limits import (
    BEYOND_RANGE,
    ERRORS,
    PEAK_TO_PEAK,
    Limit,
    RelativeLimits,
    level_per_amplitude,
    relative_limits,
    rounded,
    shown_level,
    unit_of,
)
from models.levels.measures import LevelPlan, WindowLevels
from models.levels.reference import LevelReference
from models.levels.settings import LevelSettings
from models.levels.zones import ZONES, zone_of
from models.signals.channels import Channel, Quantity
from rotorwatch.records.levels import LEVEL_MEASURES, ChannelLevels, LevelGrowth, LevelLimits

_ERRORS_OF_DOUBT = 4.0
"""Where it decides whether to believe what else has been found, not whether anything has happened."""
_TURNED_OUT = "1x vector"
_DEADBAND = 0.9
_WORDS = {
    "overall": "overall", "velocity": "velocity", "s_max": "S_max", "x_half": "0.5x", "x1": "1x", "x2": "2x",
    "x3": "3x", "not_x1": "not 1x", "high": "high frequency", "peak": "peak", "mean": "gap", "envelope": "envelope",
    "crest": "crest factor", "kurtosis": "kurtosis", "growth": "growth",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Nearest:
    """The nearest of the limits of a level, and what is said of it while it is within all of them."""

    alert: Limit | None
    danger: Limit | None
    fall: Limit | None
    normal: LevelLimits


class LevelJudge:
    """Says what the levels of a machine's windows are, and on which side of their limits.

    Parameters
    ----------
    channels : sequence of Channel
        Of its columns.
    """

    def __init__(self, plan: LevelPlan, channels: Sequence[Channel], settings: LevelSettings) -> None:
        self._plan = plan
        self._channels = tuple(channels)
        self._settings = settings
        self._zones = {ZONES[name].shaft: name for name in settings.zones}
        self._reference: LevelReference | None = None
        self._relatives: dict[tuple[int, bool, int], RelativeLimits] = {}  # they are the same in all full windows
        self._nearest = lru_cache(maxsize=16 * len(self._channels))(
            _nearest_limits
        )  # most are those of the window before

    def judge(self, levels: WindowLevels, reference: LevelReference | None) -> tuple[ChannelLevels, ...]:
        """Levels of one window, channel by channel."""
        relative = None if reference is None else self._relative(levels, reference)
        grown: Sequence[Growth | None] = [None] * len(self._channels)
        if relative is not None and relative.bands is not None and levels.bands is not None:
            grown = growth(levels.bands, relative.bands)
        return tuple(self._channel(column, levels, relative, of_bands) for column, of_bands in enumerate(grown))

    def foreign(
        self, levels: WindowLevels, judged: Sequence[ChannelLevels], reference: LevelReference | None, *, named: bool
    ) -> str:
        """What the levels of a window show that no change of a parameter makes; empty if nothing.

        A wrong gain of all sensors of a place, a 2x that has grown, or a random part that is not Gaussian as it was on
        the healthy machine.

        Parameters
        ----------
        judged : sequence of ChannelLevels
            What `judge` says of them.
        named : bool
            Whether a parameter has been found to have changed, which this would cast doubt on.
        """
        if reference is None:
            return ""
        if reference.gains is not None and levels.bands is not None:
            wrong = wrong_gain(levels.bands, [place_of(one) for one in self._channels], reference.gains)
            if wrong is not None:
                own = " and ".join(one.name for one in self._channels if place_of(one) == wrong[0])
                return f"gain of {own}: {wrong[1]:.2f} times as much at all frequencies, compared with the other places"
        state, seen = reference.at(levels.speed_rad_s)
        if not seen:  # at another speed much is otherwise
            return ""
        twice = [one.limit("x2") for one in judged]
        grown = [limits.text for limits in twice if limits and limits.text and not limits.absolute]
        if grown or levels.random_kurtosis is None:
            return next(iter(grown), "")
        n_errors = _ERRORS_OF_DOUBT if named else ERRORS
        found = [
            (departure(levels.random_kurtosis[:, column], state.kurtosis[one.name], BEYOND_RANGE, n_errors), one)
            for column, one in enumerate(self._channels)
            if one.name in state.kurtosis
        ]
        most, channel = max(found, key=lambda one: abs(one[0]), default=(0.0, None))
        if channel is None or not most:
            return ""
        healthy = state.kurtosis[channel.name].mean
        how = "clipped, as by a rub" if most < 0 else "with impacts, as of a rub or a loose part"
        return (
            f"a vibration at {channel.name} ({channel.location} {channel.direction}) that is {how}: kurtosis of its "
            f"random part {healthy + most:.2f}, {healthy:.2f} on the healthy machine"
        )

    def _channel(
        self, column: int, levels: WindowLevels, relative: RelativeLimits | None, grown: Growth | None
    ) -> ChannelLevels:
        channel, speed_rad_s = self._channels[column], levels.speed_rad_s
        values = {
            name: shown_level(channel, name, float(levels.values[name][column]))
            for name in LEVEL_MEASURES
            if name != "growth"
        }
        values["growth"] = math.nan if grown is None else grown.ratio
        zone, limits = "", dict[str, tuple[Limit, ...]]()
        for own in self._settings.limits:
            if own.channel == channel.name:
                given = Limit("own limit", True, own.alert, own.danger)
                limits[own.measure] = (*limits.get(own.measure, ()), given)
        standard = self._standard(channel, speed_rad_s)
        if standard is not None:
            name, measure, boundaries = standard
            zone = zone_of(values[measure], boundaries)
            judged = Limit(f"{name}, zone {zone}", True, boundaries[1], boundaries[2], zones=boundaries)
            limits[measure] = (*limits.get(measure, ()), judged)
        words = _WORDS
        if relative is not None:
            for measure, limit in relative.limits[column].items():
                limits[measure] = (*limits.get(measure, ()), limit)
            region = relative.regions[column]
            if region is not None and levels.vectors is not None:
                moved = complex(levels.vectors[1, column])
                if abs(moved - region.centre) > region.radius:
                    edge = shown_level(channel, "x1", min(abs(moved) * level_per_amplitude(channel), region.alert))
                    limits["x1"] = (*limits.get("x1", ()), Limit(_TURNED_OUT, False, alert=edge))
            if grown is not None:
                limits["growth"] = (Limit(relative.source, False, grown.limit),)
                words = {**_WORDS, "growth": f"{grown.band_hz[0]:.3g} to {grown.band_hz[1]:.3g} Hz"}
        vectors = levels.vectors
        lags = {}
        if vectors is not None and speed_rad_s is not None:
            turned = 1.0 if speed_rad_s >= 0 else -1.0
            lags = {
                f"{name}_phase_lag_deg": math.degrees(-turned * cmath.phase(vectors[row, column])) % 360
                for name, row in (("x1", 1), ("x2", 2))
            }
        casing = channel.quantity in {Quantity.VELOCITY, Quantity.ACCELERATION}
        return ChannelLevels(
            channel=channel.name,
            unit=channel.unit,
            detection="rms" if casing else "peak to peak",
            band_hz=self._plan.band_hz if casing else None,
            **{name: rounded(value) for name, value in (values | lags).items()},
            zone=zone,
            limits=tuple(
                self._limited(channel, name, values[name], found, words[name]) for name, found in limits.items()
            ),
        )

    def _standard(
        self, channel: Channel, speed_rad_s: float | None
    ) -> tuple[str, str, tuple[float, float, float]] | None:
        """The zones of a standard that apply to a channel: their name, the measure, boundaries as shown."""
        shaft = channel.quantity is Quantity.DISPLACEMENT
        name = self._zones.get(shaft)
        if name is None or not (shaft or channel.quantity in {Quantity.VELOCITY, Quantity.ACCELERATION}):
            return None
        boundaries = ZONES[name].at(speed_rad_s)
        if boundaries is None:
            return None
        measure = "velocity" if channel.quantity is Quantity.ACCELERATION else "overall"
        first, second, third = (shown_level(channel, measure, edge) for edge in boundaries)
        return name, measure, (first, second, third)

    def _relative(self, levels: WindowLevels, reference: LevelReference) -> RelativeLimits:
        """What a window is judged by, once for all windows alike."""
        if reference is not self._reference:
            self._reference, self._relatives = reference, {}
        state, seen = reference.at(levels.speed_rad_s)
        alike = (id(state), seen, levels.hops)  # of the reference that is kept here
        if alike not in self._relatives:
            self._relatives[alike] = relative_limits(levels, reference, self._channels, self._settings)
        return self._relatives[alike]

    def _limited(self, channel: Channel, name: str, value: float, limits: tuple[Limit, ...], words: str) -> LevelLimits:
        """The nearest limits of a level, and on which side it is."""
        nearest = self._nearest(name, limits)
        danger, alert, fall = nearest.danger, nearest.alert, nearest.fall
        if danger is not None and value >= (danger.danger or math.inf):
            state, decided, what = "danger", danger, f"danger from {danger.danger:.3g} ({danger.source})"
        elif alert is not None and value >= (alert.alert or math.inf):
            state, decided, what = "alert", alert, f"alert from {alert.alert:.3g} ({alert.source})"
            if alert.source == _TURNED_OUT:
                what = "has moved out of its acceptance region"
        elif fall is not None and value < (fall.fall or 0.0):
            state, decided, what = "alert", fall, f"alert below {fall.fall:.3g} ({fall.source})"
        else:
            return nearest.normal
        unit = unit_of(channel.unit, name, channel.quantity in PEAK_TO_PEAK)
        said = f"{channel.name} ({channel.location} {channel.direction}) {words}".rstrip()
        return nearest.normal.model_copy(
            update={
                "absolute": decided.absolute,
                "source": decided.source,
                "state": state,
                "text": f"{said} {value:.3g} {unit}, {what}",
            }
        )


def _nearest_limits(name: str, limits: tuple[Limit, ...]) -> _Nearest:
    danger = min((one for one in limits if one.danger is not None), key=lambda one: one.danger or 0.0, default=None)
    alert = min((one for one in limits if one.alert is not None), key=lambda one: one.alert or 0.0, default=None)
    fall = max((one for one in limits if one.fall is not None), key=lambda one: one.fall or 0.0, default=None)
    decided = alert or danger or fall
    several = len(limits) > 1 or any(one.zones for one in limits)
    normal = LevelLimits(
        measure=name,
        absolute=decided is not None and decided.absolute,
        alert=None if alert is None else rounded(alert.alert or 0.0),
        danger=None if danger is None else rounded(danger.danger or 0.0),
        fall=None if fall is None else rounded(fall.fall or 0.0),
        source="" if decided is None else decided.source,
        state="normal",
        bounds=tuple(one.bound() for one in limits if one.source != _TURNED_OUT) if several else (),  # that is no level
    )
    return _Nearest(alert, danger, fall, normal)


@dataclass(frozen=True, slots=True)
class ChannelState:
    """How a channel stands as a whole: its worst level, and whether all are well within their limits."""

    beyond: bool
    danger: bool
    absolute: bool  # beyond a limit of the machine file or of a standard, not only of a reference
    small: bool  # every level is back by a tenth of its limit: the deadband of ISA-18.2
    text: str


def channel_state(levels: ChannelLevels) -> ChannelState:
    """Sum up the limits of a channel."""
    limits = levels.limits
    small = all(one.state == "normal" and not _near(getattr(levels, one.measure), one) for one in limits)
    texts = sorted((one.state != "danger", not one.absolute, one.text) for one in limits if one.text)
    absolute = any(one.state != "normal" and one.absolute for one in limits)
    return ChannelState(
        levels.beyond != "", levels.beyond == "danger", absolute, small, "; ".join(text for *_, text in texts)
    )


def _near(value: float | None, limits: LevelLimits) -> bool:
    """Whether a level that is within its limits is within the deadband of one of them."""
    if value is None:
        return False
    above = min((edge for edge in (limits.alert, limits.danger) if edge is not None), default=math.inf)
    return value > _DEADBAND * above or (limits.fall is not None and value < limits.fall / _DEADBAND)


_NO_GROWTH = {"mean", "crest", "kurtosis"}
"""Measures that do not grow with the vibration."""


def growth_seen(levels: Sequence[ChannelLevels]) -> LevelGrowth:
    """By how much every channel would have had to grow to raise an alert; the one that needs most decides.

    Parameters
    ----------
    levels : sequence of ChannelLevels
        Of one window, at least one.
    """
    nearest = [(one, _nearest(one)) for one in levels]
    unlimited = [one.channel for one, found in nearest if found is None]
    if unlimited:
        *most, last = unlimited
        names, they_have = f"{', '.join(most)} or {last}" if most else last, "they have" if most else "it has"
        text = f"no growth of {names} would have raised an alert: {they_have} no limit yet"
        return LevelGrowth(growth=None, channel=unlimited[0], measure="", text=text)
    one, (growth, measure, value, limit) = max(
        ((one, found) for one, found in nearest if found), key=lambda each: each[1]
    )
    word, unit = _WORDS[measure], unit_of(one.unit, measure, one.detection == "peak to peak")
    if measure == "growth":
        word = "strongest band"
    text = (
        f"every channel that had grown by {growth:.0%} would have raised an alert; {one.channel} last, whose {word} is "
        f"{value:.3g} {unit} and its alert from {limit:.3g}"
    ).replace("%", " %")
    return LevelGrowth(growth=rounded(growth), channel=one.channel, measure=measure, text=text)


def _nearest(levels: ChannelLevels) -> tuple[float, str, float, float] | None:
    """The smallest growth of a channel that takes one of its levels to a limit: that, measure, level and limit."""
    found = []
    for limits in levels.limits:
        value = getattr(levels, limits.measure)
        edges = [edge for edge in (limits.alert, limits.danger) if edge is not None]
        if limits.measure not in _NO_GROWTH and edges and value is not None and value > 0:
            found.append((max(0.0, min(edges) / value - 1), limits.measure, value, min(edges)))
    return min(found, default=None)
