"""Units in which other programs write samples, and what they are in SI.

A recording knows few units, one spelling each (`models.signals.channels.UNIT_TO_SI`). Files from elsewhere spell them
in many ways; here is what is understood when one is imported.
"""

import re

from models.signals.channels import Quantity

__all__ = ["same_unit", "time_unit_ns", "unit_factor"]

_INCH = 25.4e-3
_DEGREE = 0.017453292519943295
_TURN = 6.283185307179586

_UNITS: dict[str, dict[str, float]] = {
    Quantity.DISPLACEMENT: {
        **{"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "micron": 1e-6, "nm": 1e-9},
        **{"in": _INCH, "mil": 25.4e-6, "mils": 25.4e-6},
    },
    Quantity.VELOCITY: {
        **{"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "um/s": 1e-6, "µm/s": 1e-6},
        **{"in/s": _INCH, "ips": _INCH, "mil/s": 25.4e-6},
    },
    Quantity.ACCELERATION: {
        **{"m/s^2": 1.0, "m/s²": 1.0, "m/s2": 1.0, "mm/s^2": 1e-3, "mm/s²": 1e-3, "mm/s2": 1e-3},
        **{"g": 9.80665, "mg": 9.80665e-3, "in/s^2": _INCH, "in/s²": _INCH, "in/s2": _INCH},
    },
    Quantity.TILT: {"rad": 1.0, "mrad": 1e-3, "deg": _DEGREE, "°": _DEGREE},
    Quantity.TILT_RATE: {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": _DEGREE, "°/s": _DEGREE},
    Quantity.SHAFT_ANGLE: {"rad": 1.0, "deg": _DEGREE, "°": _DEGREE, "rev": _TURN},
}

_TIME_NS: dict[str, float] = {"s": 1e9, "ms": 1e6, "us": 1e3, "µs": 1e3, "ns": 1.0, "min": 60e9, "h": 3600e9}

_DETECTED = re.compile(r"(?:[ _(-]|\b)(pp|p-p|pk-pk|pkpk|peak-peak|0-p|0-pk|pk|peak|rms|avg)\)?$", re.IGNORECASE)


def unit_factor(quantity: str, unit: str) -> float:
    """Factor that turns samples in `unit` into SI units of `quantity`.

    Parameters
    ----------
    quantity : str
        A `Quantity`.
    unit : str
        As a person or a measuring program writes it; both micro signs are understood.

    Raises
    ------
    ValueError
        If it is not a unit of this quantity; the message says of which it is one, or that it describes a detected
        value (peak to peak, rms) and not the samples of a waveform.

    Examples
    --------
    >>> unit_factor("displacement", "mil")
    2.54e-05
    """
    known = _UNITS[quantity]
    spelled = _spelled(unit)
    if spelled in known:
        return known[spelled]
    accepted = f"expected one of {', '.join(known)}"
    detected = _DETECTED.search(spelled)
    if detected and _spelled(spelled[: detected.start()]) in {name for units in _UNITS.values() for name in units}:
        raise ValueError(
            f"unit {unit!r} is that of an overall value ({detected.group(1)}), but samples of a waveform are needed: "
            f"they have no peak-to-peak or rms unit; {accepted}"
        )
    others = [name for name, units in _UNITS.items() if spelled in units]
    if others:
        raise ValueError(f"unit {unit!r} is a unit of {' or '.join(others)}, not of {quantity}; {accepted}")
    raise ValueError(f"unit {unit!r} is not known for {quantity}; {accepted}")


def same_unit(quantity: str, one: str, other: str) -> bool:
    """Whether two spellings mean one unit; a spelling that is not understood contradicts nothing."""
    known = _UNITS[quantity]
    first, second = _spelled(one), _spelled(other)
    if any(second in units for units in _UNITS.values()):
        return known.get(first) == known.get(second)
    return True


def time_unit_ns(unit: str) -> float:
    """Nanoseconds in a unit of time.

    Raises
    ------
    ValueError
        If the unit is not known; the message names those that are.
    """
    spelled = _spelled(unit)
    if spelled not in _TIME_NS:
        raise ValueError(f"unit {unit!r} is not a unit of time; expected one of {', '.join(_TIME_NS)}")
    return _TIME_NS[spelled]


def _spelled(unit: str) -> str:
    return unit.strip().replace("\N{GREEK SMALL LETTER MU}", "\N{MICRO SIGN}")
