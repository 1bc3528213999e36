"""The limits of levels: single ones, and those relative to a reference.

A limit relative to a reference is never nearer than a quarter above the largest healthy level, nor than six standard
errors of one window above the mean. So excitation that varies as it did in the healthy windows raises nothing, and a
line where there was only noise has to stand out of it. While a window fills, its levels scatter more: the limits allow
for that about the loudest and the quietest healthy level as well as about the mean.

A limit of a machine file on a level that its sensors can never give would guard nothing: `unmeasured` finds it.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pydantic import BaseModel, Field

from models.levels.bands import BEYOND_RANGE, ERRORS, NYQUIST_PART, BandLimits, band_limits
from models.levels.measures import LevelPlan, WindowLevels, level_plan
from models.levels.orders import ORDERS
from models.levels.reference import LevelReference, OperatingState, ReferenceLevel
from models.levels.settings import ZONES, LevelSettings
from models.mistakes import did_you_mean
from models.signals.block import FloatArray
from models.signals.channels import Channel, Quantity
from rotorwatch.records.levels import LevelBound

_TURNED = 0.6
_LEAST_DANGER = 0.25  # of the overall level, for a line that was only noise: it has no healthy level to multiply
PEAK_TO_PEAK = (Quantity.DISPLACEMENT, Quantity.TILT)


@dataclass(frozen=True, slots=True)
class Limit:
    """One limit of a level, as shown."""

    source: str
    absolute: bool
    # Infinite where there is none.
    alert: float = math.inf
    danger: float = math.inf
    fall: float = -math.inf
    zones: tuple[float, float, float] | None = field(default=None, kw_only=True)

    def bound(self) -> LevelBound:
        """The limit as a record, rounded."""
        alert, danger, fall = map(finite, (self.alert, self.danger, self.fall))
        if self.zones is None:
            return LevelBound(source=self.source, alert=alert, danger=danger, fall=fall)
        first, second, third = map(rounded, self.zones)
        standard = self.source.rpartition(", zone ")[0]
        return LevelBound(source=standard, zones=(first, second, third), alert=alert, danger=danger, fall=fall)


@dataclass(frozen=True, slots=True)
class Region:
    """The acceptance region of a 1x vector (ISO 20816-1, criterion II)."""

    centre: complex
    radius: float
    # Alert limit of the level, and its healthy mean, SI units.
    alert: float
    mean: float


@dataclass(frozen=True, slots=True)
class RelativeLimits:
    """The limits relative to a reference, of windows of one length in one operating state."""

    source: str
    # By column, and measure.
    limits: tuple[dict[str, Limit], ...]
    regions: tuple[Region | None, ...]
    bands: BandLimits | None


def relative_limits(
    levels: WindowLevels,
    reference: LevelReference,
    channels: Sequence[Channel],
    given: LevelSettings,
    states: Sequence[tuple[OperatingState, bool]],
) -> RelativeLimits:
    """Relative limits of a window, and of all others with as many hops in the same operating states and sense.

    The first of `states` is that of the mean speed; any others are those that the machine passed through, each with
    whether it ran at such a speed when it was learned. The levels of such a window are a mixture, in which those of one
    speed may be many times those of the mean speed: of each level, the farthest limit counts, and 1x has no region.
    """
    mean, *passed = (_limits_at(levels, reference, channels, given, at) for at in states)
    if not passed:
        return mean
    limits = []
    for column in range(len(channels)):
        every = [one.limits[column] for one in passed]
        shared = set(every[0]).intersection(*every[1:])
        limits.append({name: _farthest([one[name] for one in every]) for name in every[0] if name in shared})
    return RelativeLimits(mean.source, tuple(limits), (None,) * len(limits), mean.bands)


def _limits_at(
    levels: WindowLevels,
    reference: LevelReference,
    channels: Sequence[Channel],
    given: LevelSettings,
    at: tuple[OperatingState, bool],
) -> RelativeLimits:
    state, seen = at
    # Turning the other way, the same machine has other phases.
    same_sense = all(edge * (levels.speed_rad_s or 0.0) > 0 for edge in state.speed_rad_s or ())
    source = reference.source if seen else f"{reference.source} at another speed"
    shorter = _shorter(state, levels.hops)
    limits, regions = [], []
    for channel in channels:
        of_channel, region = dict[str, Limit](), None
        for name, one in state.levels.get(channel.name, {}).items():
            spread = ERRORS * one.error * shorter
            alert = _alert_from(one, given, shorter)
            danger = math.inf  # levels at another speed say too little
            if seen:
                danger = max(given.danger_ratio * one.mean, alert * given.danger_ratio / given.alert_ratio)
                overall = state.levels[channel.name].get("overall")
                if name in {"x1", "x2"} and one.mean < ERRORS * one.error and overall is not None:
                    danger = max(danger, _LEAST_DANGER * overall.mean)
            fall = -math.inf  # at another speed a quieter machine is not at fault, as while it runs down
            if seen and name in {"overall", "velocity"} and given.fall_ratio:
                quietest = one.low * min(1 / BEYOND_RANGE, 1 - _filling_margin(one, shorter))
                fall = min(given.fall_ratio * one.mean, quietest, one.mean - spread)
            shown = [shown_level(channel, name, edge) for edge in (alert, danger, fall)]
            of_channel[name] = Limit(source, False, *shown)
            if seen and same_sense and name == "x1" and one.vector is not None:
                region = _region(channel, one, complex(*one.vector), alert, shorter)
        limits.append(of_channel)
        regions.append(region)
    bands = None
    if seen:  # at a speed that was never seen lines are elsewhere
        own = [state.bands.get(channel.name) for channel in channels]
        bands = band_limits(levels.bands, own, given.alert_ratio, shorter)
    return RelativeLimits(source, tuple(limits), tuple(regions), bands)


def _farthest(limits: Sequence[Limit]) -> Limit:
    danger, fall = max(one.danger for one in limits), min(one.fall for one in limits)
    return replace(max(limits, key=lambda one: one.alert), danger=danger, fall=fall)


def _region(channel: Channel, one: ReferenceLevel, centre: complex, alert: float, shorter: float) -> Region:
    factor = 2.0 if channel.quantity in PEAK_TO_PEAK else math.sqrt(0.5)  # level of a line over its amplitude
    farthest = max(BEYOND_RANGE * one.turned, one.turned + _filling_margin(one, shorter) * one.mean / factor)
    by_chance = ERRORS * one.error * shorter / factor
    return Region(centre, max(_TURNED * abs(centre), farthest, by_chance), alert, one.mean)


def _shorter(state: OperatingState, hops: int) -> float:
    """Factor by which a level scatters more than in the healthy windows while the window fills."""
    return math.sqrt(max(1.0, state.hops / hops))


def _filling_margin(one: ReferenceLevel, shorter: float) -> float:
    """Relative margin for the scatter of a level about that of a full window; zero once the window is full."""
    return ERRORS * one.error / one.mean * math.sqrt(shorter**2 - 1) if one.mean else 0.0


def _alert_from(one: ReferenceLevel, given: LevelSettings, shorter: float) -> float:
    loudest = one.high * max(BEYOND_RANGE, 1 + _filling_margin(one, shorter))
    return max(given.alert_ratio * one.mean, loudest, one.mean + ERRORS * one.error * shorter)


class GrowthToAlert(BaseModel, extra="forbid", frozen=True):
    """What growth of one level of one channel raises an alert relative to the healthy machine."""

    speed_rpm: tuple[float, float] | None = Field(description="slowest and fastest window of the operating state")
    windows: int = Field(description="healthy windows in it")
    channel: str
    measure: str
    unit: str
    healthy: float = Field(description="mean level of the healthy windows")
    alert: float = Field(description="alert from here on")
    growth: float | None = Field(description="of the mean healthy level, relative; none where that is nothing")


def alerts_of(
    reference: LevelReference, channels: Sequence[Channel], settings: LevelSettings, hops: int
) -> Iterator[GrowthToAlert]:
    """Alert limits relative to a reference, for windows of `hops` hops, state by state."""
    for state in reference.states:
        slowest, fastest = sorted(abs(speed) * 30 / math.pi for speed in state.speed_rad_s or (0.0, 0.0))
        for channel in channels:
            for name, one in state.levels.get(channel.name, {}).items():
                limit = _alert_from(one, settings, _shorter(state, hops))
                healthy, alert = (shown_level(channel, name, value) for value in (one.mean, limit))
                yield GrowthToAlert(
                    speed_rpm=None if state.speed_rad_s is None else (slowest, fastest),
                    windows=state.windows,
                    channel=channel.name,
                    measure=name,
                    unit=unit_of(channel.unit, name, channel.quantity in PEAK_TO_PEAK),
                    healthy=healthy,
                    alert=alert,
                    growth=alert / healthy - 1 if healthy > 0 else None,
                )


def shown_level(channel: Channel, name: str, value: float) -> float:
    """A level in the unit in which it is shown."""
    return value / unit_size(channel, name)


def unit_size(channel: Channel, name: str) -> float:
    """Size of the unit in which a measure is shown, SI."""
    if name in {"crest", "kurtosis"}:
        return 1.0
    return 1e-3 if name == "velocity" else channel.to_si


MEASURE_WORDS = {
    "overall": "overall", "velocity": "velocity", "s_max": "S_max", "x_half": "0.5x", "x1": "1x", "x2": "2x",
    "x3": "3x", "not_x1": "not 1x", "high": "high frequency", "peak": "peak", "mean": "gap", "envelope": "envelope",
    "crest": "crest factor", "kurtosis": "kurtosis", "growth": "growth",
}  # fmt: skip
"""What each measure is called."""


def unit_of(unit: str, name: str, peak_to_peak: bool) -> str:
    """The unit in which a measure is shown, of a channel in `unit`."""
    if name in {"crest", "kurtosis"}:
        return ""
    if name == "growth":
        return "times the reference"
    if name == "velocity":
        return "mm/s rms"
    if name in {"peak", "s_max", "mean"}:
        return f"{unit} peak" if name != "mean" else unit
    return f"{unit} {'pp' if peak_to_peak and name != 'not_x1' else 'rms'}"


def rounded(value: float) -> float:
    """Round to five digits: no sensor has more."""
    return float(f"{value:.5g}")


def finite(value: float) -> float | None:
    """A value `rounded`; None if it is infinite."""
    return rounded(value) if math.isfinite(value) else None


_POWERS_OF_TEN = np.array([float(f"1e{exponent}") for exponent in range(309)])


def all_rounded(values: FloatArray) -> list[list[float | None]]:
    """Rows of a two-dimensional array, `rounded`; None where a value is not finite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        digits = 4 - np.floor(np.log10(np.abs(values)))
        power = _POWERS_OF_TEN[np.where(np.isfinite(digits), np.minimum(np.abs(digits), 308), 0).astype(np.intp)]
        found = np.where(digits < 0, np.rint(values / power) * power, np.rint(values * power) / power)
    shown = found.astype(object)
    shown[~np.isfinite(values)] = None
    rows: list[list[float | None]] = shown.tolist()
    return rows


_QUANTITIES: dict[str, tuple[Quantity, ...]] = {"mean": (Quantity.DISPLACEMENT, Quantity.TILT)}
_NO_SPEED = ": the running speed is not known, expected a shaft angle or [operation] speed_rpm"
_QUANTITIES |= dict.fromkeys(("velocity", "high", "envelope"), (Quantity.ACCELERATION,))


def unmeasured(
    settings: LevelSettings, sensors: Sequence[Channel], rate_hz: float, speed_rpm: float | None
) -> str | None:
    """Describe the first band, zone or limit without a level; orders and a shaft's zones need an angle or a speed."""
    band_hz, end_hz = settings.band(speed_rpm), NYQUIST_PART * rate_hz / 2
    if settings.band_hz is not None and band_hz[0] >= end_hz:
        return f"levels.band_hz begins at {band_hz[0]:g} Hz, expected below 0.4 of rate_hz, {end_hz:g} Hz"
    channels = [one for one in sensors if one.quantity is not Quantity.SHAFT_ANGLE]
    plan = level_plan(channels, rate_hz, band_hz)
    turning = speed_rpm is not None or len(channels) < len(sensors)
    names = [one.name for one in channels]
    for zone in settings.zones:
        shaft = ZONES[zone].shaft
        wanted = (Quantity.DISPLACEMENT,) if shaft else (Quantity.VELOCITY, Quantity.ACCELERATION)
        if not any(one.quantity in wanted for one in channels):
            return f"levels.zones: {zone} applies to no channel, expected one of {' or '.join(wanted)}"
        if shaft and not turning:
            return f"levels.zones: {zone}{_NO_SPEED}"
    for limit in settings.limits:
        if limit.channel not in names:
            hint = did_you_mean(limit.channel, names)
            return f"levels.limits: no channel {limit.channel!r}; there are {', '.join(names)}{hint}"
        if why := _missing(plan, names.index(limit.channel), limit.measure, turning=turning):
            return f"levels.limits: {limit.channel} has no {limit.measure}{why}"
    return None


def _missing(plan: LevelPlan, column: int, measure: str, *, turning: bool) -> str | None:
    """Why a channel has no such level; None if it has."""
    wanted = _QUANTITIES.get(measure, ())
    if measure == "velocity" and plan.quantities[column] is Quantity.VELOCITY:
        return ": the rms velocity of a velocity sensor is its overall"
    if wanted and plan.quantities[column] not in wanted:
        return f": it is a {plan.quantities[column].value}, expected {' or '.join(one.value for one in wanted)}"
    if measure in {"high", "envelope"} and plan.high_hz is None:
        return f" at {plan.rate_hz:g} samples per second, expected 5000 or more"
    if measure == "s_max" and column not in [first for first, _ in plan.pairs]:
        return ": expected the first of two displacements of one place in two directions"
    if measure in ORDERS and not turning:
        return _NO_SPEED
    return None
