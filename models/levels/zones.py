"""Zone boundaries of standards, as data.

Zones A to D: newly commissioned, unrestricted long-term operation, unsuitable for long-term operation, damaging
(ISO 20816-1:2016, 6.2.3). An alarm at the boundary of zones B and C, danger at that of C and D.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


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
