"""Levels against their limits: absolute ones, and those relative to a reference."""

import cmath
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import compress
from operator import attrgetter, itemgetter
from typing import Any, NamedTuple

import numpy as np

from models.levels.bands import ERRORS, Growth, band_in_words, growth
from models.levels.contact import LatestContact
from models.levels.kurtosis import GAUSSIAN, departure, fallen_by_beats, fallen_by_lines, varied, without_lines
from models.levels.limits import (
    MEASURE_WORDS,
    PEAK_TO_PEAK,
    Limit,
    RelativeLimits,
    all_rounded,
    finite,
    relative_limits,
    rounded,
    shown_level,
    unit_of,
    unit_size,
)
from models.levels.lines import new_line
from models.levels.measures import LevelPlan, WindowLevels
from models.levels.places import left_of_1x, place_of, rewired, wrong_gain
from models.levels.reference import LevelReference, OperatingState
from models.levels.settings import ZONES, LevelSettings, zone_of
from models.signals.block import FloatArray
from models.signals.channels import Channel, Quantity, unit_in_text
from rotorwatch.records.levels import LEVEL_MEASURES, ChannelLevels, LevelGrowth, LevelLimits, three_digits
from rotorwatch.records.windows import SensorFault

_ERRORS_OF_CONTACT = 5.0
"""Standard errors from which on a contact is reported: one-sided and Gaussian in theory, chance seldom makes five."""
_STILL = 0.3
"""Fraction of the effect in several windows that the newest one must show; otherwise the contact is over."""
_RANGE_DEVIATIONS = 4.0
"""Range of the windows of a healthy machine, in standard deviations."""
_ERRORS_OF_DOUBT = 4.0
"""Standard errors from which on a kurtosis casts doubt on a parameter that is named; on its own it takes `ERRORS`."""
_X1_VECTOR = "1x vector"
_MOST_KEPT = 16  # sets of limits kept per channel: for its zones, operating states, lengths of a window that fills
_DEADBAND = 0.9
_MEASURED = tuple(name for name in LEVEL_MEASURES if name != "growth")
_SHOWN = (*_MEASURED, "growth", "x1_phase_lag_deg", "x2_phase_lag_deg")
_ROW = {name: row for row, name in enumerate(_SHOWN)}
_Standard = tuple[str, str, tuple[float, float, float]]
"""Zones of a standard: their name, the measure, boundaries in the unit that is shown."""


@dataclass(frozen=True, slots=True)
class _Nearest:
    """The nearest limits of a level, and the record of a level that is within all of them."""

    alert: Limit
    danger: Limit
    fall: Limit
    normal: LevelLimits
    # The level is within its limits from `low` to below `high`.
    low: float
    high: float


class Foreign(NamedTuple):
    """What the levels of a window show that no change of a parameter can cause."""

    text: str = ""  # empty if there is nothing
    hides: bool = False  # whether no parameter read in the same window can be believed
    direction: str = ""  # of the sensors of a place that all have a wrong gain
    unlike: float = 0.0  # what that gain leaves of the change of 1x, see `left_of_1x`
    held: bool = False  # whether that place is held by a bearing or support, whose stiffness may look like a gain


class LevelJudge:
    """Judges the levels of a machine's windows against their limits; `channels` are those of the plan."""

    def __init__(self, plan: LevelPlan, channels: Sequence[Channel], settings: LevelSettings) -> None:
        self._plan = plan
        self._channels = tuple(channels)
        self._settings = settings
        self._zones = {ZONES[name].shaft: name for name in settings.zones}
        self._units = np.array([[unit_size(channel, name) for channel in channels] for name in _MEASURED])
        self._blank = [_blank(plan, channel) for channel in channels]
        self._reference: LevelReference | None = None
        # Caches of what most windows have in common with the one before.
        self._relatives: dict[tuple[object, ...], RelativeLimits] = {}
        self._limits: dict[tuple[object, ...], dict[str, _Nearest]] = {}
        self._growth = lru_cache(maxsize=16 * len(self._channels))(
            lambda source, alert: _nearest_limits("growth", [Limit(source, False, alert)])
        )

    def judge(
        self,
        levels: WindowLevels,
        reference: LevelReference | None,
        *,
        moved: bool = False,
        missing: Sequence[int] = (),
    ) -> tuple[ChannelLevels, ...]:
        """Judge the levels of one window, channel by channel; columns with `missing` samples have none.

        If lines `moved` to other bands within the window, there is no growth. Then, and at a speed that the reference
        does not know, random vibration at 2x may be many times that of the reference: its limit counts only for a 2x
        that stands out of the present one.
        """
        relative = None if reference is None else self._relative_limits(levels, reference)
        grown: Sequence[Growth | None] = [None] * len(self._channels)
        if relative is not None and relative.bands is not None and not moved:
            grown = growth(levels.bands, relative.bands)
        grown = [None if column in missing else one for column, one in enumerate(grown)]
        told = np.full(len(grown), True)  # which 2x are compared
        if reference is not None and (moved or not reference.at(levels.speed_rad_s)[1]):
            hidden = levels.hidden_twice
            told = ~told if hidden is None else ~hidden
        values = np.full((len(_SHOWN), len(grown)), np.nan)
        values[: len(_MEASURED)] = [levels.values[name] for name in _MEASURED]
        values[: len(_MEASURED)] /= self._units
        values[len(_MEASURED)] = [np.nan if one is None else one.ratio for one in grown]
        vectors = levels.vectors
        if vectors is not None and levels.speed_rad_s is not None:
            turned = 1.0 if levels.speed_rad_s >= 0 else -1.0
            values[-2:] = np.degrees(-turned * np.angle(vectors[1:3])) % 360
        values[:, [*missing]] = np.nan
        shown = all_rounded(values.T)
        return tuple(
            self._channel(column, own, dict(zip(_SHOWN, shown[column], strict=True)), levels, relative, one, x2)
            for column, (own, one, x2) in enumerate(zip(values.T.tolist(), grown, told.tolist(), strict=True))
        )

    def foreign(
        self,
        levels: WindowLevels,
        judged: Sequence[ChannelLevels],
        reference: LevelReference | None,
        latest: LatestContact,
        *,
        named: bool,
        faulty: Sequence[int] = (),
    ) -> Foreign:
        """Find what the levels of a window show that no change of a parameter can cause.

        A shaft that is pushed back where it is far out, a new line, a wrong gain of all sensors of a place, a 2x that
        has grown, or a random part whose kurtosis departs from that of the healthy machine.

        `judged` is what `judge` returned for the window; its latest hop is added to `latest`, the ones before. `named`
        says whether a parameter has been found to have changed, which a finding would cast doubt on. Sensors in
        `faulty` columns show neither the machine nor a gain.
        """
        if reference is None:
            return Foreign()
        levels = levels.without(faulty, self._plan.pairs)
        state, seen = reference.at(levels.speed_rad_s)
        found = ""
        if seen:
            found = self._contact(levels, state, latest, reference.states.index(state))
            names = [one.name for one in self._channels]
            by_theory = {} if state.levels else {"unlike": "no rotor of the machine file makes"}
            found = found or new_line(levels, names, state.lines, state.bands, **by_theory)
        if not found and reference.gains is not None:
            places = [place_of(one) for one in self._channels]
            wrong = wrong_gain(levels.bands, places, reference.gains)
            if wrong is not None:
                own = [one for one in self._channels if place_of(one) == wrong[0]]
                more = f"{wrong[1]:.2f} times its healthy value at all frequencies, compared with the other places"
                text = f"gain of {' and '.join(one.name for one in own)}: {more}"
                unlike = left_of_1x(*self._turned_up(levels, state), places, *wrong) if seen else 0.0
                held = own[0].location != "disc"
                return Foreign(text, hides=True, direction=own[0].direction, unlike=unlike, held=held)
        if found or not seen:  # at another speed much differs in any case
            return Foreign(found)
        kurtosis, hidden = levels.random_kurtosis, levels.hidden_twice
        told = np.full(len(judged), True) if hidden is None else ~hidden
        told[[*faulty]] = False
        twice = [one.limit("x2") for one in compress(judged, told)]
        grown = [limits.text for limits in twice if limits and limits.text and not limits.absolute]
        if grown or kurtosis is None:
            return Foreign(next(iter(grown), ""))
        n_errors = _ERRORS_OF_DOUBT if named else ERRORS
        known = [(column, one) for column, one in enumerate(self._channels) if one.name in state.kurtosis]
        departures = [(self._departure(levels, column, state, n_errors), one) for column, one in known]
        most, channel = max(departures, key=lambda one: abs(one[0]), default=(0.0, None))
        if channel is None or not most:
            return Foreign()
        healthy = state.kurtosis[channel.name].mean
        how = (
            "that is clipped, as by a rub"
            if most < 0
            else "with impacts, as from a rub, a loose part or a damaged bearing"
        )
        return Foreign(
            f"a vibration at {channel.name} ({channel.location} {channel.direction}) {how}: kurtosis of its "
            f"random part {healthy + most:.2f}, {healthy:.2f} on the healthy machine"
        )

    def rewired(self, levels: WindowLevels, reference: LevelReference) -> SensorFault | None:
        """Places whose sensors have been exchanged or reversed since, at a speed at which the reference was learned."""
        state, seen = reference.at(levels.speed_rad_s)
        known = [state.levels.get(one.name, {}).get("x1") for one in self._channels]
        healthy = np.array([complex(*one.vector) for one in known if one is not None and one.vector is not None])
        if not seen or levels.vectors is None or levels.moments is None or len(healthy) < len(self._channels):
            return None
        if self._plan.runout is not None:  # hops show it
            healthy += self._plan.runout if (levels.speed_rad_s or 0.0) >= 0 else self._plan.runout.conj()
        return rewired(levels.moments[2][:, 0], healthy, self._channels)

    def _turned_up(self, levels: WindowLevels, state: OperatingState) -> tuple[FloatArray, FloatArray]:
        """Logarithm of each channel's 1x over that of the healthy machine, and its error; NaN where it is not known."""
        healthy = [state.levels.get(one.name, {}).get("x1") for one in self._channels]
        mean, low, high, error = np.array(
            [(np.nan,) * 4 if one is None else (one.mean, one.low, one.high, one.error) for one in healthy]
        ).T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.log(levels.values["x1"] / mean), np.hypot(error, (high - low) / _RANGE_DEVIATIONS) / mean

    def _contact(self, levels: WindowLevels, state: OperatingState, latest: LatestContact, number: int) -> str:
        """Describe where the shaft is pushed back far out, unlike the healthy machine's; empty if nowhere."""
        columns = [(column, (y, z)) for y, z, _ in self._plan.contacts for column in (y, z)]
        if levels.contact is None or not columns:
            return ""
        window = levels.contact[:, [column for column, _ in columns]]
        looked, several = [], latest.take(window[-1], number)
        for at, (column, pair) in enumerate(columns):
            if (healthy := state.contact.get(self._channels[column].name)) is None:
                continue
            now, lasting = (departure(hops[:, at], healthy, _ERRORS_OF_CONTACT) for hops in (window, several))
            # With no more hops than the window, `several` adds nothing to it, and may rest on one impact.
            if len(several) > len(window) and window[:, at].mean() - healthy.mean > _STILL * lasting:
                now = max(now, lasting)
            looked.append((now, healthy.mean, pair))
        most, mean, pair = max(looked, default=(0.0, 0.0, (0, 0)))
        if most <= 0:
            return ""
        y, z = (self._channels[column] for column in pair)
        return (
            f"a shaft at {y.name} and {z.name} ({y.location}) that is pushed back at large displacements, as by a "
            f"rub or a stop: {mean + most:.1f} standard errors in an average hop, {mean:.1f} on the healthy machine"
        )

    def _departure(self, levels: WindowLevels, column: int, state: OperatingState, n_errors: float) -> float:
        """Departure of a channel's kurtosis from the healthy one; 0 if beats, or lines grown or gone, explain it.

        The loss of a line explains a kurtosis that has risen to no more than a Gaussian's 3.
        """
        name, kurtosis, shares = self._channels[column].name, levels.random_kurtosis, levels.random_share
        if kurtosis is None or levels.moments is None or shares is None:
            return 0.0
        hops, healthy = kurtosis[:, column], state.kurtosis[name]
        growth = healthy.growth(shares[:, column])
        found = departure(hops, healthy, n_errors, growth)
        if found < 0:
            orders, in_bands = levels.moments[2][:, :, column], levels.moments[3][:, :, column]
            strongest = None if levels.lines is None else levels.lines[:, :, column]
            before, speed_rad_s = (state.bands.get(name), state.lines.get(name, ())), levels.speed_rad_s or 0.0
            lines, varies = fallen_by_lines(levels.bands, in_bands, orders, speed_rad_s, *before, strongest)
            beats = fallen_by_beats(varied(levels.moments[0][:, column]), healthy)
            hops = hops + np.maximum(lines + beats, fallen_by_beats(varies, healthy))
            return found if departure(hops, healthy, n_errors) < 0 else 0.0
        if found and healthy.mean < GAUSSIAN:
            random = without_lines(healthy)
            return found if departure(hops, random, n_errors, growth) > 0 else 0.0
        return found

    def _channel(
        self,
        column: int,
        values: list[float],
        record: dict[str, Any],
        levels: WindowLevels,
        relative: RelativeLimits | None,
        grown: Growth | None,
        told: bool,
    ) -> ChannelLevels:
        channel = self._channels[column]
        standard = self._standard(channel, levels.speed_rad_s)
        zone = "" if standard is None else zone_of(values[_ROW[standard[1]]], standard[2])
        edge, out, region = None, "", None if relative is None else relative.regions[column]
        if region is not None and levels.vectors is not None:
            moved = complex(levels.vectors[1, column])
            if abs(moved - region.centre) > region.radius:
                edge = min(values[_ROW["x1"]], shown_level(channel, "x1", region.alert))  # beyond it in any case
                sense = -math.copysign(1.0, levels.speed_rad_s or 0.0)
                was_deg = math.degrees(sense * cmath.phase(region.centre)) % 360
                out = (
                    f"phase lag {values[_ROW['x1_phase_lag_deg']]:.0f}°: outside its acceptance region around "
                    f"{three_digits(shown_level(channel, 'x1', region.mean))} {unit_in_text(channel.unit)} "
                    f"at {was_deg:.0f}°"
                )
        words = MEASURE_WORDS
        key = column, id(relative), standard, zone, edge, told  # unique while the reference is kept
        limits = self._limits.get(key)
        if limits is None:
            if len(self._limits) >= _MOST_KEPT * len(self._channels):
                self._limits.clear()
            limits = self._limits[key] = self._limits_of(column, relative, standard, zone, edge, told)
        if grown is not None and relative is not None:
            limits = limits | {"growth": self._growth(relative.source, grown.limit)}
            words = {**MEASURE_WORDS, "growth": band_in_words(grown.band_hz)}
        record["zone"] = zone
        judged = []
        for name, near in limits.items():
            value = values[_ROW[name]]
            within = near.low <= value < near.high
            judged.append(near.normal if within else self._judged_limits(channel, name, value, near, words[name], out))
        record["limits"] = tuple(judged)
        return self._blank[column].model_copy(update=record)

    def _limits_of(
        self,
        column: int,
        relative: RelativeLimits | None,
        standard: _Standard | None,
        zone: str,
        edge: float | None,
        told: bool,
    ) -> dict[str, _Nearest]:
        """Limits of a channel except for its bands.

        `edge` is that for a 1x vector out of its acceptance region; `told`, whether 2x is compared with the reference.
        """
        limits = defaultdict[str, list[Limit]](list)
        for own in self._settings.limits:
            if own.channel == self._channels[column].name:
                limits[own.measure].append(Limit("own limit", True, own.alert or math.inf, own.danger or math.inf))
        if standard is not None:
            name, measure, boundaries = standard
            limits[measure].append(Limit(f"{name}, zone {zone}", True, boundaries[1], boundaries[2], zones=boundaries))
        for measure, limit in relative.limits[column].items() if relative is not None else ():
            if told or measure != "x2":
                limits[measure].append(limit)
        if edge is not None:
            limits["x1"].append(Limit(_X1_VECTOR, False, alert=edge))
        return {name: _nearest_limits(name, found) for name, found in limits.items()}

    def _standard(self, channel: Channel, speed_rad_s: float | None) -> _Standard | None:
        """The zones of a standard that apply to a channel."""
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

    def _relative_limits(self, levels: WindowLevels, reference: LevelReference) -> RelativeLimits:
        """Relative limits of a window, which are computed if no earlier window had the same."""
        if reference is not self._reference:
            self._reference, self._relatives = reference, {}
            self._limits.clear()
        every = reference.at(levels.speed_rad_s), *reference.passed(levels)  # unique while the reference is kept
        alike = (levels.hops, (levels.speed_rad_s or 0.0) < 0, *((id(state), seen) for state, seen in every))
        if alike not in self._relatives:
            self._relatives[alike] = relative_limits(levels, reference, self._channels, self._settings, every)
        return self._relatives[alike]

    def _judged_limits(
        self, channel: Channel, name: str, value: float, nearest: _Nearest, words: str, out: str
    ) -> LevelLimits:
        """On which side of its limits a level is; `out` is the text for a 1x vector out of its acceptance region."""
        danger, alert, fall = nearest.danger, nearest.alert, nearest.fall
        if _reached(danger.danger, value):
            state, decided, what = "danger", danger, f"danger limit {three_digits(danger.danger)} ({danger.source})"
        elif _reached(alert.alert, value):
            state, decided, what = "alert", alert, f"alert limit {three_digits(alert.alert)} ({alert.source})"
            if alert.source == _X1_VECTOR:
                what = out
        elif value < fall.fall:
            state, decided, what = "alert", fall, f"alert below {three_digits(fall.fall)} ({fall.source})"
        else:  # not a number
            return nearest.normal
        unit = unit_of(channel.unit, name, channel.quantity in PEAK_TO_PEAK)
        said = f"{channel.name} ({channel.location} {channel.direction}) {words}".rstrip()
        return nearest.normal.model_copy(
            update={
                "absolute": decided.absolute,
                "source": decided.source,
                "state": state,
                "text": f"{said} {three_digits(value)} {unit_in_text(unit)}, {what}",
            }
        )


def _blank(plan: LevelPlan, channel: Channel) -> ChannelLevels:
    casing = channel.quantity in {Quantity.VELOCITY, Quantity.ACCELERATION}
    return ChannelLevels(
        channel=channel.name,
        unit=channel.unit,
        detection="rms" if casing else "peak to peak",
        band_hz=plan.band_hz if casing else None,
        overall=None,
        peak=None,
    )


def _nearest_limits(name: str, limits: Sequence[Limit]) -> _Nearest:
    """The nearest of one limit or more, each with an alert or danger limit."""
    danger, alert = min(limits, key=attrgetter("danger")), min(limits, key=attrgetter("alert"))
    fall = max(limits, key=attrgetter("fall"))
    decided = danger if alert.alert == math.inf else alert
    several = len(limits) > 1 or any(one.zones for one in limits)
    normal = LevelLimits(
        measure=name,
        absolute=decided.absolute,
        alert=finite(alert.alert),
        danger=finite(danger.danger),
        fall=finite(fall.fall),
        source=decided.source,
        state="normal",
        bounds=tuple(one.bound() for one in limits if one.source != _X1_VECTOR) if several else (),  # no level's limit
    )
    # A limit of nothing is shown and not judged by, see `_reached`.
    high = min((edge for edge in (alert.alert, danger.danger) if edge > 0), default=math.inf)
    return _Nearest(alert, danger, fall, normal, fall.fall, high)


def _reached(limit: float, value: float) -> bool:
    """Whether a level has reached a limit: not one of nothing, as of a dead channel, nor one that is not there."""
    return 0 < limit <= value and limit != math.inf


@dataclass(frozen=True, slots=True)
class ChannelState:
    """State of a channel as a whole: its worst level, and whether all are well within their limits."""

    beyond: bool
    danger: bool
    absolute: bool  # beyond a limit of the machine file or of a standard, not only of a reference
    small: bool  # every level is a tenth within its limit: the deadband of ISA-18.2
    text: str


def channel_state(levels: ChannelLevels) -> ChannelState:
    """Sum up the limits of a channel; the text names channel and place once, before the worst level."""
    limits = levels.limits
    texts = sorted((one.state != "danger", not one.absolute, one.text) for one in limits if one.text)
    return ChannelState(
        beyond=levels.beyond != "",
        danger=levels.beyond == "danger",
        absolute=any(one.state != "normal" and one.absolute for one in limits),
        small=all(one.state == "normal" and not _near(getattr(levels, one.measure), one) for one in limits),
        text="; ".join(text if at == 0 else text.split(") ", 1)[1] for at, (*_, text) in enumerate(texts)),
    )


def fallen(levels: ChannelLevels) -> bool:
    """Whether a level of a channel is below its limit."""
    found = [(getattr(levels, one.measure), one.fall) for one in levels.limits]
    return any(value is not None and fall is not None and value < fall for value, fall in found)


def _near(value: float | None, limits: LevelLimits) -> bool:
    """Whether a level that is within its limits is within the deadband of one of them."""
    if value is None:
        return False
    above = min((edge for edge in (limits.alert, limits.danger) if edge is not None), default=math.inf)
    return value > _DEADBAND * above or (limits.fall is not None and value < limits.fall / _DEADBAND)


_NO_GROWTH = {"mean", "crest", "kurtosis"}
"""Measures that do not grow with the vibration."""


def growth_seen(levels: Sequence[ChannelLevels]) -> LevelGrowth:
    """Least growth with which every channel of a window would raise an alert; the one that needs most decides."""
    nearest = [(_nearest(one), one) for one in levels]
    if unlimited := [one.channel for found, one in nearest if found is None]:
        *most, last = unlimited
        names, they_have = f"{', '.join(most)} or {last}" if most else last, "they have" if most else "it has"
        text = f"no growth of {names} would have raised an alert: {they_have} no limit yet"
        return LevelGrowth(growth=None, channel=unlimited[0], measure="", text=text)
    (growth, measure, value, limit), one = max(((found, one) for found, one in nearest if found), key=itemgetter(0))
    word, unit = MEASURE_WORDS[measure], unit_of(one.unit, measure, one.detection == "peak to peak")
    if measure == "growth":
        word = "strongest band"
    text = (
        f"growth of {growth:.0%} in any channel would have raised an alert; last in {one.channel}, whose {word} is "
        f"{three_digits(value)} {unit_in_text(unit)} with an alert limit of {three_digits(limit)}"
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
