"""Figures in words: no more digits than are known, units that people use."""

import math
from collections.abc import Iterable

__all__ = ["change", "channel_text", "channel_unit", "duration", "listed", "parameter_value", "percent", "significant"]

_PLACES = {
    "y1": "bearing, horizontal",
    "y2": "disc, horizontal",
    "z1": "bearing, vertical",
    "z2": "disc, vertical",
    "psi": "disc tilt, horizontal",
    "phi": "disc tilt, vertical",
    "theta": "shaft angle (phase reference)",
}
_ENDINGS = {"": "displacement", "dot": "velocity", "ddot": "acceleration"}
_TILT_ENDINGS = {"": "angle", "dot": "rate", "ddot": "acceleration"}
_UNITS = {"": ("µm", 1e6), "dot": ("mm/s", 1e3), "ddot": ("m/s²", 1.0)}
_TILT_UNITS = {"": ("mrad", 1e3), "dot": ("mrad/s", 1e3), "ddot": ("rad/s²", 1.0)}
_VALUE_UNITS = {"k": "N/m", "c": "N s/m", "e": "m", "EI": "Pa"}
_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))


def significant(value: float, digits: int = 2) -> str:
    """Round to significant digits, without an exponent.

    Examples
    --------
    >>> [significant(x) for x in (0.0108, 1.96, 9.96, 2043.9)]
    ['0.011', '2.0', '10', '2000']
    """
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    rounded = float(f"{value:.{digits - 1}e}")
    decimals = digits - 1 - math.floor(math.log10(abs(rounded)))
    return f"{rounded:.{max(0, decimals)}f}"


def percent(value: float) -> str:
    """Size of a part, in percent with two digits.

    Examples
    --------
    >>> [percent(x) for x in (0.0108, 0.11022, 2.06, 0.0)]
    ['1.1%', '11%', '210%', '0%']
    """
    return f"{significant(100 * value)}%"


def change(value: float) -> str:
    """Relative change with its sign.

    Examples
    --------
    >>> [change(x) for x in (-0.1008, 0.112)]
    ['−10%', '+11%']
    """
    return f"{'−' if value < 0 else '+'}{percent(abs(value))}"


def duration(seconds: float) -> str:
    """Length of time in the unit that fits it.

    Examples
    --------
    >>> [duration(x) for x in (15, 27.5, 165.8, 300, 3830, 20000, 1e6)]
    ['15 s', '28 s', '2.8 min', '5 min', '64 min', '5.6 h', '12 days']
    """
    for limit, unit_s, unit in ((120, 1, "s"), (7200, 60, "min"), (48 * 3600, 3600, "h")):
        if seconds < limit:
            return f"{_short(seconds / unit_s, 3 if seconds / unit_s >= 100 else 2)} {unit}"
    return f"{_short(seconds / 86400)} days"


def _short(value: float, digits: int = 2) -> str:
    text = significant(value, digits)
    return text.rstrip("0").rstrip(".") if "." in text else text


def parameter_value(name: str, value: float) -> str:
    """Value of a parameter with its unit.

    Examples
    --------
    >>> parameter_value("k_by", 49945.5), parameter_value("e", 1.9977e-5), parameter_value("c_bz", 59.66)
    ('49.9 kN/m', '20.0 µm', '59.7 N s/m')
    >>> parameter_value("EI", 2.1e11)
    'E = 210 GPa'
    """
    unit = _VALUE_UNITS.get(name) or _VALUE_UNITS[name.partition("_")[0]]
    factor, prefix = next(((f, p) for f, p in _PREFIXES if abs(value) >= f), (1.0, ""))
    symbol = "E = " if name == "EI" else ""  # the shaft's stiffness is carried by its modulus
    return f"{symbol}{significant(value / factor, 3)} {prefix}{unit}"


def channel_text(state: str) -> str:
    """What a state variable measures.

    Examples
    --------
    >>> channel_text("y1"), channel_text("z2_dot"), channel_text("psi_dot")
    ('bearing, horizontal, displacement', 'disc, vertical, velocity', 'disc tilt, horizontal, rate')
    """
    place, _, ending = state.partition("_")
    if place == "theta" or place not in _PLACES:
        return _PLACES.get(place, state)
    return f"{_PLACES[place]}, {(_TILT_ENDINGS if place in ('psi', 'phi') else _ENDINGS)[ending]}"


def channel_unit(state: str) -> tuple[str, float]:
    """Unit in which a state is shown, and the factor from SI to it."""
    place, _, ending = state.partition("_")
    return (_TILT_UNITS if place in ("psi", "phi") else _UNITS)[ending]


def listed(words: Iterable[str]) -> str:
    """Join words as a sentence does.

    Examples
    --------
    >>> listed(["k_by", "c_by", "e"])
    'k_by, c_by and e'
    """
    *most, last = list(words) or [""]
    return f"{', '.join(most)} and {last}" if most else last
