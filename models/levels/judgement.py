"""Levels against their limits: absolute ones, and those relative to a reference.

A limit relative to a reference is never nearer than the reference itself has been: not within a quarter of its largest
healthy level, nor within six standard errors of one window. So excitation that varies as it did in the healthy windows
raises nothing, and a line that was nothing but noise has to stand out of it. While a window fills it scatters more,
about the loudest and the quietest healthy level as well as about their mean.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from models.levels.bands import Growth, growth
from models.levels.gains import place_of, wrong_gain
from models.levels.kurtosis import departure
from models.levels.measures import LevelPlan, WindowLevels
from models.levels.reference import LevelReference, OperatingState, ReferenceLevel
from models.levels.settings import LevelSettings
from models.levels.zones import ZONES, zone_of
from models.signals.channels import Channel, Quantity
from rotorwatch.records.levels import LEVEL_MEASURES, ChannelLevels, LevelBound, LevelGrowth, LevelLimits

_BEYOND_RANGE = 1.25
_ERRORS = 6.0
_ERRORS_OF_DOUBT = 4.0
"""Where it decides whether to believe what else has been found, not whether anything has happened."""
_TURNED = 0.6
_TURNED_OUT = "1x vector"
_DEADBAND = 0.9
_PEAK_TO_PEAK = (Quantity.DISPLACEMENT, Quantity.TILT)
_WORDS = {
    "overall": "overall", "velocity": "velocity", "s_max": "S_max", "x_half": "0.5x", "x1": "1x", "x2": "2x",
    "x3": "3x", "not_x1": "not 1x", "high": "high frequency", "peak": "peak", "mean": "gap", "envelope": "envelope",
    "crest": "crest factor", "kurtosis": "kurtosis", "growth": "growth",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Limit:
    source: str
    absolute: bool
    alert: float | None = None
    danger: float | None = None
    fall: float | None = None
    zones: tuple[float, float, float] | None = field(default=None, kw_only=True)

    def bound(self) -> LevelBound:
        edges = {"alert": self.alert, "danger": self.danger, "fall": self.fall}
        rounded = {name: None if edge is None else _rounded(edge) for name, edge in edges.items()}
        zones = None if self.zones is None else tuple(map(_rounded, self.zones))
        source = self.source if zones is None else self.source.rpartition(", zone ")[0]
        return LevelBound.model_validate({"source": source, "zones": zones} | rounded)


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

    def judge(self, levels: WindowLevels, reference: LevelReference | None) -> tuple[ChannelLevels, ...]:
        """Levels of one window, channel by channel."""
        return tuple(self._channel(column, levels, reference) for column in range(len(self._channels)))

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
        n_errors = _ERRORS_OF_DOUBT if named else _ERRORS
        found = [
            (departure(levels.random_kurtosis[:, column], state.kurtosis[one.name], _BEYOND_RANGE, n_errors), one)
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

    def _channel(self, column: int, levels: WindowLevels, reference: LevelReference | None) -> ChannelLevels:
        channel, speed_rad_s = self._channels[column], levels.speed_rad_s
        values = {
            name: _shown(channel, name, float(levels.values[name][column]))
            for name in LEVEL_MEASURES
            if name != "growth"
        }
        grown = None if reference is None else self._grown(column, levels, reference)
        values["growth"] = math.nan if grown is None else grown.ratio
        zone, limits = "", dict[str, list[_Limit]]()
        for own in self._settings.limits:
            if own.channel == channel.name:
                limits.setdefault(own.measure, []).append(_Limit("own limit", True, own.alert, own.danger))
        standard = self._standard(channel, speed_rad_s)
        if standard is not None:
            name, measure, boundaries = standard
            zone = zone_of(values[measure], boundaries)
            judged = _Limit(f"{name}, zone {zone}", True, boundaries[1], boundaries[2], zones=boundaries)
            limits.setdefault(measure, []).append(judged)
        if reference is not None:
            for measure, limit in self._relative(column, levels, reference):
                limits.setdefault(measure, []).append(limit)
        words = dict(_WORDS)
        if grown is not None and reference is not None:
            limits["growth"] = [_Limit(reference.source, False, grown.limit)]
            words["growth"] = f"{grown.band_hz[0]:.3g} to {grown.band_hz[1]:.3g} Hz"
        vectors = levels.vectors
        lags = {}
        if vectors is not None and speed_rad_s is not None:
            turned = 1.0 if speed_rad_s >= 0 else -1.0
            lags = {
                f"{name}_phase_lag_deg": float(np.degrees(-turned * np.angle(vectors[row, column])) % 360)
                for name, row in (("x1", 1), ("x2", 2))
            }
        casing = channel.quantity in {Quantity.VELOCITY, Quantity.ACCELERATION}
        return ChannelLevels(
            channel=channel.name,
            unit=channel.unit,
            detection="rms" if casing else "peak to peak",
            band_hz=self._plan.band_hz if casing else None,
            **{name: _rounded(value) for name, value in (values | lags).items()},
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
        first, second, third = (_shown(channel, measure, edge) for edge in boundaries)
        return name, measure, (first, second, third)

    def _relative(self, column: int, levels: WindowLevels, reference: LevelReference) -> Iterator[tuple[str, _Limit]]:
        channel, given = self._channels[column], self._settings
        state, seen = reference.at(levels.speed_rad_s)
        source = reference.source if seen else f"{reference.source} at another speed"
        shorter = _shorter(state, levels.hops)
        for name, one in state.levels.get(channel.name, {}).items():
            spread = _ERRORS * one.error * shorter
            alert = _alert_from(one, given, shorter)
            danger = None  # what levels are at another speed says too little
            if seen:
                danger = max(given.danger_ratio * one.mean, alert * given.danger_ratio / given.alert_ratio)
            fall = None
            if name in {"overall", "velocity"} and given.fall_ratio:
                quietest = one.low * min(1 / _BEYOND_RANGE, 1 - _filling(one, shorter))
                fall = min(given.fall_ratio * one.mean, quietest, one.mean - spread)
            shown = [None if edge is None else _shown(channel, name, edge) for edge in (alert, danger, fall)]
            yield name, _Limit(source, False, *shown)
            if seen and name == "x1" and one.vector is not None and levels.vectors is not None:
                yield from self._turned(channel, one, complex(levels.vectors[1, column]), alert, shorter)

    def _grown(self, column: int, levels: WindowLevels, reference: LevelReference) -> Growth | None:
        """The band that stands out most; nothing at a speed that was never seen, at which lines are elsewhere."""
        state, seen = reference.at(levels.speed_rad_s)
        own = state.bands.get(self._channels[column].name)
        if own is None or levels.bands is None or not seen:
            return None
        shorter = _shorter(state, levels.hops)
        return growth(levels.bands, column, own, self._settings.alert_ratio, _BEYOND_RANGE, _ERRORS, shorter)

    def _turned(
        self, channel: Channel, one: ReferenceLevel, now: complex, alert: float, shorter: float
    ) -> Iterator[tuple[str, _Limit]]:
        """The acceptance region of the 1x vector (ISO 20816-1, criterion II): an alert outside it, however large."""
        assert one.vector is not None  # noqa: S101  # for the type checker
        of_amplitude = 2.0 if channel.quantity in _PEAK_TO_PEAK else math.sqrt(0.5)
        farthest = max(_BEYOND_RANGE * one.turned, one.turned + _filling(one, shorter) * one.mean / of_amplitude)
        by_chance = _ERRORS * one.error * shorter / of_amplitude
        radius = max(_TURNED * abs(complex(*one.vector)), farthest, by_chance)
        if abs(now - complex(*one.vector)) > radius:
            yield "x1", _Limit(_TURNED_OUT, False, alert=_shown(channel, "x1", min(abs(now) * of_amplitude, alert)))

    def _limited(self, channel: Channel, name: str, value: float, limits: Sequence[_Limit], words: str) -> LevelLimits:
        """The nearest limits of a level, and on which side it is."""
        danger = min((one for one in limits if one.danger is not None), key=lambda one: one.danger or 0.0, default=None)
        alert = min((one for one in limits if one.alert is not None), key=lambda one: one.alert or 0.0, default=None)
        fall = max((one for one in limits if one.fall is not None), key=lambda one: one.fall or 0.0, default=None)
        unit = _unit(channel.unit, name, channel.quantity in _PEAK_TO_PEAK)
        said = f"{channel.name} ({channel.location} {channel.direction}) {words}".rstrip()
        said += f" {value:.3g} {unit}"
        state, text, decided = "normal", "", alert or danger or fall
        if danger is not None and value >= (danger.danger or math.inf):
            state, text, decided = "danger", f"{said}, danger from {danger.danger:.3g} ({danger.source})", danger
        elif alert is not None and value >= (alert.alert or math.inf):
            what = (
                "has moved out of its acceptance region"
                if alert.source == _TURNED_OUT
                else (f"alert from {alert.alert:.3g} ({alert.source})")
            )
            state, text, decided = "alert", f"{said}, {what}", alert
        elif fall is not None and value < (fall.fall or 0.0):
            state, text, decided = "alert", f"{said}, alert below {fall.fall:.3g} ({fall.source})", fall
        return LevelLimits.model_validate(
            {
                "measure": name,
                "absolute": decided is not None and decided.absolute,
                "alert": None if alert is None else _rounded(alert.alert or 0.0),
                "danger": None if danger is None else _rounded(danger.danger or 0.0),
                "fall": None if fall is None else _rounded(fall.fall or 0.0),
                "source": "" if decided is None else decided.source,
                "state": state,
                "text": text,
                "bounds": tuple(one.bound() for one in limits if one.source != _TURNED_OUT)  # that is no level
                if len(limits) > 1 or any(one.zones for one in limits)
                else (),
            }
        )


def _shorter(state: OperatingState, hops: int) -> float:
    """By how much a level scatters more than in the healthy windows while the window fills."""
    return math.sqrt(max(1.0, state.hops / hops))


def _filling(one: ReferenceLevel, shorter: float) -> float:
    """By how much, relative, a level may scatter about that of a full window; nothing once the window is full."""
    return _ERRORS * one.error / one.mean * math.sqrt(shorter**2 - 1) if one.mean else 0.0


def _alert_from(one: ReferenceLevel, given: LevelSettings, shorter: float) -> float:
    loudest = one.high * max(_BEYOND_RANGE, 1 + _filling(one, shorter))
    return max(given.alert_ratio * one.mean, loudest, one.mean + _ERRORS * one.error * shorter)


@dataclass(frozen=True, slots=True)
class AlertFrom:
    """From where on a level of a channel raises an alert relative to its reference, as shown."""

    state: OperatingState
    channel: Channel
    measure: str
    unit: str
    healthy: float  # mean of the healthy windows
    alert: float

    @property
    def growth(self) -> float | None:
        """Of the mean healthy level, relative; None where that is nothing."""
        return self.alert / self.healthy - 1 if self.healthy > 0 else None


def alerts_of(
    reference: LevelReference, channels: Sequence[Channel], settings: LevelSettings, hops: int
) -> Iterator[AlertFrom]:
    """Alert limits relative to a reference, state by state.

    Parameters
    ----------
    hops : int
        In the windows that are judged.
    """
    for state in reference.states:
        for channel in channels:
            for name, one in state.levels.get(channel.name, {}).items():
                alert = _alert_from(one, settings, _shorter(state, hops))
                healthy, limit = (_shown(channel, name, value) for value in (one.mean, alert))
                peak_to_peak = channel.quantity in _PEAK_TO_PEAK
                yield AlertFrom(state, channel, name, _unit(channel.unit, name, peak_to_peak), healthy, limit)


def _shown(channel: Channel, name: str, value: float) -> float:
    """A level in the unit in which it is shown."""
    if name in {"crest", "kurtosis"}:
        return value
    if name == "velocity":
        return value * 1e3
    return value / channel.to_si


def _unit(unit: str, name: str, peak_to_peak: bool) -> str:
    if name in {"crest", "kurtosis"}:
        return ""
    if name == "growth":
        return "times the reference"
    if name == "velocity":
        return "mm/s rms"
    if name in {"peak", "s_max", "mean"}:
        return f"{unit} peak" if name != "mean" else unit
    return f"{unit} {'pp' if peak_to_peak and name != 'not_x1' else 'rms'}"


def _rounded(value: float) -> float:
    """Five digits: no sensor has more."""
    return float(f"{value:.5g}")


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
    word, unit = _WORDS[measure], _unit(one.unit, measure, one.detection == "peak to peak")
    if measure == "growth":
        word = "strongest band"
    text = (
        f"every channel that had grown by {growth:.0%} would have raised an alert; {one.channel} last, whose {word} is "
        f"{value:.3g} {unit} and its alert from {limit:.3g}"
    ).replace("%", " %")
    return LevelGrowth(growth=_rounded(growth), channel=one.channel, measure=measure, text=text)


def _nearest(levels: ChannelLevels) -> tuple[float, str, float, float] | None:
    """The smallest growth of a channel that takes one of its levels to a limit: that, measure, level and limit."""
    found = []
    for limits in levels.limits:
        value = getattr(levels, limits.measure)
        edges = [edge for edge in (limits.alert, limits.danger) if edge is not None]
        if limits.measure not in _NO_GROWTH and edges and value is not None and value > 0:
            found.append((max(0.0, min(edges) / value - 1), limits.measure, value, min(edges)))
    return min(found, default=None)
