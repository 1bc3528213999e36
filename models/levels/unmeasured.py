"""Limits of a machine file on levels that its sensors can never give: they would guard nothing."""

from collections.abc import Sequence

from models.levels.bands import NYQUIST_PART
from models.levels.measures import LevelPlan, level_plan
from models.levels.orders import ORDERS
from models.levels.settings import LevelSettings
from models.mistakes import did_you_mean
from models.signals.channels import Channel, Quantity

_QUANTITIES = {
    "velocity": (Quantity.ACCELERATION,),
    "high": (Quantity.ACCELERATION,),
    "envelope": (Quantity.ACCELERATION,),
    "mean": (Quantity.DISPLACEMENT, Quantity.TILT),
}


def unmeasured(
    settings: LevelSettings, sensors: Sequence[Channel], rate_hz: float, speed_rpm: float | None
) -> str | None:
    """Describe the first band or limit without a level, if there is one; orders need an angle or a nominal speed."""
    band_hz, end_hz = settings.band(speed_rpm), NYQUIST_PART * rate_hz / 2
    if settings.band_hz is not None and band_hz[0] >= end_hz:
        return f"levels.band_hz begins at {band_hz[0]:g} Hz, expected below 0.4 of rate_hz, {end_hz:g} Hz"
    channels = [one for one in sensors if one.quantity is not Quantity.SHAFT_ANGLE]
    plan = level_plan(channels, rate_hz, band_hz)
    turning = speed_rpm is not None or len(channels) < len(sensors)
    names = [one.name for one in channels]
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
    if wanted and plan.quantities[column] not in wanted:
        return f": it is a {plan.quantities[column].value}, expected {' or '.join(one.value for one in wanted)}"
    if measure in {"high", "envelope"} and plan.high_hz is None:
        return f" at {plan.rate_hz:g} samples per second, expected 5000 or more"
    if measure == "s_max" and column not in [first for first, _ in plan.pairs]:
        return ": expected the first of two displacements of one place in two directions"
    if measure in ORDERS and not turning:
        return ": the running speed is not known, expected a shaft angle or [operation] speed_rpm"
    return None
