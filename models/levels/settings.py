"""What a machine file says of levels: their band, the limits they are judged by, and the zones of standards, as data.

Zones A to D: newly commissioned, unrestricted long-term operation, unsuitable for long-term operation, damaging
(ISO 20816-1:2016, 6.2.3). An alarm at the boundary of zones B and C, danger at that of C and D.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Literal, Self

from pydantic import BaseModel, Field, model_validator

from models.mistakes import did_you_mean
from rotorwatch.records.levels import LEVEL_MEASURES


@dataclass(frozen=True, slots=True)
class Zones:
    """Boundaries A/B, B/C and C/D of one measure."""

    # Whether of the peak-to-peak displacement of the shaft relative to its bearing, or of the casing's rms velocity.
    shaft: bool
    # Casing: m/s rms. Shaft: times 1/√n, m peak to peak with n in rpm.
    boundaries: tuple[float, float, float]

    def at(self, speed_rad_s: float | None) -> tuple[float, float, float] | None:
        """Boundaries in SI units at a speed; None where they depend on it and it is not known."""
        if not self.shaft:
            return self.boundaries
        if speed_rad_s is None or not math.isfinite(speed_rad_s) or speed_rad_s == 0:
            return None
        root = math.sqrt(abs(speed_rad_s) * 30 / math.pi)
        first, second, third = self.boundaries
        return first / root, second / root, third / root


def _casing(*boundaries_mm_s: float) -> Zones:
    first, second, third = (value * 1e-3 for value in boundaries_mm_s)
    return Zones(False, (first, second, third))


ZONES: Mapping[str, Zones] = MappingProxyType(
    {
        # ISO 20816-3:2022, tables A.1 and A.2: group 1 above 300 kW, group 2 from 15 kW to 300 kW.
        "ISO 20816-3 group 1 rigid": _casing(2.3, 4.5, 7.1),
        "ISO 20816-3 group 1 flexible": _casing(3.5, 7.1, 11.0),
        "ISO 20816-3 group 2 rigid": _casing(1.4, 2.8, 4.5),
        "ISO 20816-3 group 2 flexible": _casing(2.3, 4.5, 7.1),
        # ISO 20816-3, for the shaft relative to the bearing: µm peak to peak over √(rpm). From one source only so far.
        "ISO 20816-3 shaft": Zones(True, (4800e-6, 9000e-6, 13200e-6)),
    }
)
"""Zones by the name that a machine file gives."""


def zone_of(value: float, boundaries: tuple[float, float, float]) -> str:
    """The zone that a level lies in.

    Examples
    --------
    >>> zone_of(3.0e-3, ZONES["ISO 20816-3 group 2 rigid"].boundaries)
    'C'
    """
    return "ABCD"[sum(value > boundary for boundary in boundaries)]


_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class LevelLimit(BaseModel, extra="forbid", frozen=True):
    """Limits of one measure of one channel, in the unit in which it is shown."""

    channel: str = Field(description="name of the channel")
    measure: str = Field(default="overall", description="which level of it")
    alert: _Positive | None = Field(default=None, description="alert from here on")
    danger: _Positive | None = Field(default=None, description="danger from here on")

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        if self.measure not in LEVEL_MEASURES:
            hint = did_you_mean(self.measure, LEVEL_MEASURES)
            raise ValueError(f"measure: {self.measure!r} is not one of {', '.join(LEVEL_MEASURES)}{hint}")
        if self.alert is None and self.danger is None:
            raise ValueError(f"limits of {self.channel}: neither alert nor danger is given")
        if self.alert is not None and self.danger is not None and self.alert >= self.danger:
            raise ValueError(f"limits of {self.channel}: alert {self.alert:g} must be below danger {self.danger:g}")
        return self


class LevelSettings(BaseModel, extra="forbid", frozen=True):
    """Vibration levels and their limits."""

    band_hz: tuple[_Positive, _Positive] | None = Field(
        default=None,
        description="band of velocities, from and to; 10 to 1000 Hz, or from 2 Hz on below 600 rpm, if left out",
    )
    zones: tuple[str, ...] = Field(default=(), description="zones of a standard that apply: " + ", ".join(ZONES))
    limits: tuple[LevelLimit, ...] = Field(default=(), description="own limits of single levels")
    alert_ratio: float = Field(default=1.6, gt=1, le=100, description="alert above so many times the reference")
    danger_ratio: float = Field(default=2.5, gt=1, le=1000, description="danger above so many times the reference")
    fall_ratio: float = Field(default=0.5, ge=0, lt=1, description="alert below so many times the reference")
    reference: Literal["commissioned", "first windows"] | None = Field(
        default=None,
        description="what relative limits refer to: the healthy recordings of commissioning, or the first windows that "
        "were seen; if left out, the first windows where nothing else is known of the machine",
    )
    reference_windows: int = Field(default=5, ge=2, le=1000, description="how many first windows make a reference")
    reference_since: str = Field(
        default="",
        max_length=200,
        exclude_if=lambda text: not text,  # machine files from before keep their hash
        description="since when first windows count, and why, such as '2026-11-25, new bearing': with another "
        "text they are taken again",
    )

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        for name in self.zones:
            if name not in ZONES:
                raise ValueError(f"zones: {name!r} is not one of {', '.join(ZONES)}{did_you_mean(name, ZONES)}")
        if len({ZONES[name].shaft for name in self.zones}) < len(self.zones):
            raise ValueError(f"zones: {', '.join(self.zones)}: one for the casing and one for the shaft at most")
        if self.band_hz is not None and not self.band_hz[0] < self.band_hz[1]:
            raise ValueError(f"band_hz {self.band_hz} must be 0 < from < to")
        for kind in ("alert", "danger"):
            given = [(one.channel, one.measure) for one in self.limits if getattr(one, kind) is not None]
            if twice := next((one for one in given if given.count(one) > 1), None):
                raise ValueError(f"limits: {kind} of {' '.join(twice)} is given twice; is another channel meant?")
        if self.alert_ratio >= self.danger_ratio:
            raise ValueError(f"alert_ratio {self.alert_ratio:g} must be below danger_ratio {self.danger_ratio:g}")
        return self

    def band(self, speed_rpm: float | None) -> tuple[float, float]:
        """Band of velocities, Hz (ISO 20816-1:2016, 4.2.3; ISO 20816-3:2022, 4.3)."""
        if self.band_hz is not None:
            return self.band_hz
        return (2.0 if speed_rpm is not None and speed_rpm < 600 else 10.0, 1000.0)
