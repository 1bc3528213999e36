"""Operating conditions that a commissioning has seen: outside them nothing is said."""

from collections.abc import Sequence
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from models.diagnosis.window import WindowStatistics

__all__ = ["LEVEL_MARGIN", "SPEED_MARGIN", "OperatingRange"]

_STRICT = ConfigDict(extra="forbid", frozen=True)
_RPM = 30 / np.pi
SPEED_MARGIN = 0.05
"""The relations hold no speed; a bearing's film and the unbalance response do."""
LEVEL_MARGIN = 10.0
"""Random vibration this many times below or above what was seen is another regime: a stopped drive, a mounting come
loose, a bearing lifted through its clearance."""
_Positive = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class OperatingRange(BaseModel):
    """Speeds and levels of random vibration in the healthy windows."""

    model_config = _STRICT

    speed_rpm: tuple[_Positive, _Positive] | None = Field(
        default=None, description="slowest and fastest mean speed of a window; none without a speed"
    )
    rms: dict[str, tuple[_Positive, _Positive]] = Field(
        description="measured state to the smallest and largest rms of its random part in a window, SI"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name, (low, high) in (("speed_rpm", self.speed_rpm or (0.0, 0.0)), *self.rms.items()):
            if low > high:
                raise ValueError(f"{name} is ({low}, {high}), expected from ≤ to")
        return self

    @classmethod
    def of(cls, windows: Sequence[WindowStatistics]) -> "OperatingRange":
        """Range of healthy windows."""
        speeds = [window.speed_rad_s * _RPM for window in windows if np.isfinite(window.speed_rad_s)]
        rms = np.array([_rms(window) for window in windows])
        return cls(
            speed_rpm=(min(speeds), max(speeds)) if speeds else None,
            rms={
                name: (float(low), float(high))
                for name, low, high in zip(windows[0].states, rms.min(axis=0), rms.max(axis=0), strict=True)
            },
        )

    def outside(self, window: WindowStatistics) -> str:
        """Why a window lies outside the commissioned conditions; empty if it does not."""
        if self.speed_rpm is not None and np.isfinite(window.speed_rad_s):
            low, high = self.speed_rpm
            rpm = window.speed_rad_s * _RPM
            if not low * (1 - SPEED_MARGIN) <= rpm <= high * (1 + SPEED_MARGIN):
                seen = f"{low:.0f} rpm" if f"{low:.0f}" == f"{high:.0f}" else f"{low:.0f} to {high:.0f} rpm"
                return f"speed is {rpm:.0f} rpm, commissioned is {seen} ± {SPEED_MARGIN:.0%}"
        for name, value in zip(window.states, _rms(window).tolist(), strict=True):
            if name not in self.rms:
                continue
            low, high = self.rms[name]
            if not low / LEVEL_MARGIN <= value <= high * LEVEL_MARGIN:
                return (
                    f"random vibration of {name} is {value:.3g} rms (SI), commissioned is {low:.3g} to {high:.3g}, and "
                    f"up to {LEVEL_MARGIN:g} times less or more"
                )
        return ""


def _rms(window: WindowStatistics) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.sqrt(np.maximum(np.diag(window.correlation[0]), 0.0))
