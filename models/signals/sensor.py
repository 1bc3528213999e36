"""A sensor of a machine file: its channel, and how its signal differs from the vibration."""

import cmath
import math
from typing import Literal, Self

from pydantic import Field, model_validator

from models.signals.channels import Channel, Quantity, not_given


class Sensor(Channel):
    """A channel, its run-out as measured at slow roll, and the high-pass and delay of its signal."""

    slow_roll_um_pp: float | None = Field(
        default=None, ge=0, le=1e6, exclude_if=not_given, description="1x at slow roll, um peak to peak"
    )
    slow_roll_phase_lag_deg: float | None = Field(
        default=None, ge=-360, le=360, exclude_if=not_given, description="phase lag of that"
    )
    high_pass_hz: float | None = Field(
        default=None, gt=0, le=1e4, exclude_if=not_given, description="corner of its high-pass (AC coupling), -3 dB"
    )
    high_pass_order: Literal[1, 2] | None = Field(
        default=None, exclude_if=not_given, description="1: AC coupling; 2: a geophone damped at 0.7, Butterworth"
    )
    delay_us: float | None = Field(
        default=None,
        ge=-2e4,
        le=2e4,
        exclude_if=not_given,
        description="how much later the signal comes than its times say; negative where it is sampled later than that",
    )

    @model_validator(mode="before")
    @classmethod
    def _of_a_channel(cls, fields: object) -> object:
        return fields.model_dump() if isinstance(fields, Channel) else fields

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        names = ("slow_roll_um_pp", "slow_roll_phase_lag_deg")
        given = [name for name in names if getattr(self, name) is not None]
        if len(given) == 1:
            (other,) = set(names) - set(given)
            raise ValueError(f"channel {self.name}: {given[0]} is given without {other}: a vector needs both")
        if given and self.quantity is not Quantity.DISPLACEMENT:
            why = f"run-out is that of a displacement, and this measures {self.quantity}"
            raise ValueError(f"channel {self.name}: slow_roll_um_pp is {self.slow_roll_um_pp:g}, but {why}")
        if self.high_pass_order is not None and self.high_pass_hz is None:
            raise ValueError(
                f"channel {self.name}: high_pass_order is {self.high_pass_order} without high_pass_hz, its corner"
            )
        given = [name for name in ("high_pass_hz", "delay_us") if getattr(self, name) is not None]
        if given and self.quantity is Quantity.SHAFT_ANGLE:
            raise ValueError(f"channel {self.name}: {given[0]} is given, but this measures {self.quantity}")
        return self

    @property
    def runout(self) -> complex:
        """Run-out vector q of x = Re{q e^{jθ}} for a shaft angle that grows, SI; 0 if none is given."""
        if self.slow_roll_um_pp is None or self.slow_roll_phase_lag_deg is None:
            return 0j
        return cmath.rect(self.slow_roll_um_pp * 0.5e-6, -math.radians(self.slow_roll_phase_lag_deg))
