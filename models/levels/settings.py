"""What a machine file says of levels: their band, and the limits they are judged by."""

from typing import Annotated, Literal, Self

from pydantic import BaseModel, Field, model_validator

from models.levels.zones import ZONES
from models.mistakes import did_you_mean
from rotorwatch.records.levels import LEVEL_MEASURES

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
        if self.alert_ratio >= self.danger_ratio:
            raise ValueError(f"alert_ratio {self.alert_ratio:g} must be below danger_ratio {self.danger_ratio:g}")
        return self

    def band(self, speed_rpm: float | None) -> tuple[float, float]:
        """Band of velocities, Hz (ISO 20816-1:2016, 4.2.3; ISO 20816-3:2022, 4.3)."""
        if self.band_hz is not None:
            return self.band_hz
        return (2.0 if speed_rpm is not None and speed_rpm < 600 else 10.0, 1000.0)
