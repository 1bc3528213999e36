"""The columns of a stream: channels, their units here and in other programs, and the descriptor beside the blocks."""

import cmath
import hashlib
import json
import math
import re
from collections.abc import Iterable, Sequence
from enum import StrEnum
from itertools import groupby
from typing import Literal, Self

from pydantic import BaseModel, Field, field_validator, model_validator

from models.mistakes import did_you_mean


class Quantity(StrEnum):
    """Physical quantity of a channel."""

    DISPLACEMENT = "displacement"
    VELOCITY = "velocity"
    ACCELERATION = "acceleration"
    TILT = "tilt"
    TILT_RATE = "tilt_rate"
    SHAFT_ANGLE = "shaft_angle"
    __hash__ = str.__hash__  # an enumeration's own is computed in Python


UNIT_TO_SI: dict[Quantity, dict[str, float]] = {
    Quantity.DISPLACEMENT: {"m": 1.0, "mm": 1e-3, "um": 1e-6, "mil": 25.4e-6},
    Quantity.VELOCITY: {"m/s": 1.0, "mm/s": 1e-3, "in/s": 25.4e-3},
    Quantity.ACCELERATION: {"m/s2": 1.0, "mm/s2": 1e-3, "g": 9.80665, "in/s2": 25.4e-3},
    Quantity.TILT: {"rad": 1.0, "mrad": 1e-3},
    Quantity.TILT_RATE: {"rad/s": 1.0, "mrad/s": 1e-3},
    Quantity.SHAFT_ANGLE: {"rad": 1.0},
}
"""Accepted units of each quantity and the factor that turns them into SI."""

_SPELLING = str.maketrans({"\N{MICRO SIGN}": "u", "\N{GREEK SMALL LETTER MU}": "u", "²": "2", "^": None})

_RATES: dict[Quantity, str] = {Quantity.DISPLACEMENT: "", Quantity.VELOCITY: "_dot", Quantity.ACCELERATION: "_ddot"}
_STATE_NAMES: dict[tuple[Quantity, str, str], str] = {
    **{
        (quantity, location, direction): f"{direction}{number}{rate}"
        for quantity, rate in _RATES.items()
        for direction in "yz"
        for number, location in enumerate(("bearing", "disc"), start=1)
    },
    (Quantity.TILT, "disc", "y"): "psi",
    (Quantity.TILT, "disc", "z"): "phi",
    (Quantity.TILT_RATE, "disc", "y"): "psi_dot",
    (Quantity.TILT_RATE, "disc", "z"): "phi_dot",
    (Quantity.SHAFT_ANGLE, "shaft", "rotation"): "theta",
}
_LOCATIONS, _DIRECTIONS = ("bearing", "disc", "shaft"), ("y", "z", "rotation")
_OTHER_LOCATIONS = ("DE", "NDE", "casing")
"""Names of other places, which are never taken for a misspelt location of the model."""
_EXPECTED = dict.fromkeys((Quantity.TILT, Quantity.TILT_RATE), "location 'disc', direction y or z")
_EXPECTED[Quantity.SHAFT_ANGLE] = "location 'shaft', direction 'rotation'"
_EXPECTED_VIBRATION = (
    "location 'bearing' or 'disc', direction y or z (horizontal or vertical), or angle_deg; at places with other names "
    f"({', '.join(_OTHER_LOCATIONS)}, …), where the direction is free, only levels are watched"
)
LEAST_APART_DEG = 30.0
"""Least angle between two sensors that are resolved into y and z: at less, the result would be mostly their noise."""
_PLACE = r"^[A-Za-z0-9][A-Za-z0-9 _.:/+-]*$"

ACCELERATIONS: tuple[str, ...] = tuple(
    name for (quantity, _, _), name in _STATE_NAMES.items() if quantity is Quantity.ACCELERATION
)
"""What accelerometers measure: rates of states, in the order in which they follow the states in statistics."""


def not_given(value: float | None) -> bool:
    """Whether to leave a field out of what is written, so that identities stay as they were before it existed."""
    return value is None


class Channel(BaseModel, extra="forbid", frozen=True):
    """One column of a stream; tilt in plane y is the paper's psi, in plane z its phi."""

    # Free name, unique in the stream ("XE-101").
    name: str = Field(
        min_length=1,
        max_length=64,
        pattern=r"^[A-Za-z0-9_.:-]+$",
        description="unique name of letters, digits and _ . : -",
    )
    # What is measured, where, and in which plane.
    quantity: Quantity
    location: str = Field(min_length=1, max_length=32, pattern=_PLACE)
    direction: str = Field(min_length=1, max_length=32, pattern=_PLACE)
    # One of `UNIT_TO_SI` for the quantity.
    unit: str = Field(description="; ".join(f"{', '.join(units)} for {of}" for of, units in UNIT_TO_SI.items()))
    # Left out if not given: descriptors without it, and their hashes, stay as they were before it existed.
    angle_deg: float | None = Field(
        default=None, ge=-360, le=360, exclude_if=not_given, description="angle of the sensor's axis from +y towards +z"
    )

    @field_validator("unit", mode="before")
    @classmethod
    def _spelled(cls, unit: object) -> object:
        """Accept what people write: either micro sign, a superscript two or ``^2``."""
        return unit.translate(_SPELLING).strip() if isinstance(unit, str) else unit

    @model_validator(mode="after")
    def _known_unit_and_place(self) -> Self:
        units = UNIT_TO_SI[self.quantity]
        if self.unit not in units:
            raise ValueError(
                f"channel {self.name}: unit {self.unit!r} is not one of {', '.join(units)} for {self.quantity}"
                f"{did_you_mean(self.unit, units)}"
            )
        if self.angle_deg is not None:
            self._check_angle(self.angle_deg)
        elif (self.quantity, self.location, self.direction) in _STATE_NAMES:
            return self
        if self.angle_deg is not None and self.location in ("bearing", "disc"):
            return self
        known = self.location in _LOCATIONS
        hint = did_you_mean(self.direction, _DIRECTIONS) if known else did_you_mean(self.location, _LOCATIONS)
        if self.location in _OTHER_LOCATIONS or not self.location.isalpha():  # "bearing1" and "bearing DE" are names
            hint = ""
        if self.quantity is Quantity.SHAFT_ANGLE or known or hint:
            raise ValueError(
                f"channel {self.name}: no {self.quantity} at location {self.location!r}, direction {self.direction!r}; "
                f"expected {_EXPECTED.get(self.quantity, _EXPECTED_VIBRATION)}{hint}"
            )
        return self

    def _check_angle(self, angle_deg: float) -> None:
        if self.quantity not in _RATES:
            raise ValueError(
                f"channel {self.name}: angle_deg is {angle_deg:g}, but a {self.quantity} sensor cannot be turned; "
                f"expected it with {', '.join(_RATES)} only"
            )
        if _cardinal(angle_deg) != {"y": 0, "z": 1}.get(self.direction, _cardinal(angle_deg)):
            raise ValueError(
                f"channel {self.name}: direction {self.direction!r} and angle_deg {angle_deg:g} contradict each other; "
                "give the direction the name it has on the machine, such as X or Y"
            )

    @property
    def axis(self) -> tuple[float, float]:
        """Direction cosines of its axis: the parts that it sees of a motion in y and of one in z."""
        if self.angle_deg is None:
            return (1.0, 0.0) if self.direction == "y" else (0.0, 1.0)
        exact = {0: (1.0, 0.0), 1: (0.0, 1.0), 2: (-1.0, 0.0), 3: (0.0, -1.0)}.get(_cardinal(self.angle_deg))
        angle = math.radians(self.angle_deg)
        return exact or (math.cos(angle), math.sin(angle))

    @property
    def way(self) -> str:
        """Direction, with the angle where there is one."""
        return self.direction if self.angle_deg is None else f"{self.direction} at {self.angle_deg:g}°"

    @property
    def to_si(self) -> float:
        """Factor that turns samples into SI units."""
        return UNIT_TO_SI[self.quantity][self.unit]

    @property
    def si_unit(self) -> str:
        """SI unit of the quantity."""
        return next(unit for unit, factor in UNIT_TO_SI[self.quantity].items() if factor == 1.0)


def _cardinal(angle_deg: float) -> int:
    """Number of quarter turns, 0 to 3; -1 if the angle is no multiple of 90°."""
    turns = angle_deg / 90
    return int(turns) % 4 if turns == round(turns) else -1


_STATE = re.compile(
    r"(?P<gain>(?<![\w-])gain of |)(?<![\w-])"
    r"(?P<state>[yz][12](?:_d?dot)?|(?:psi|phi)(?:_dot)?|(?:bearing|disc)@[\d.]+(?:_d?dot)?|theta)(?![\w-])"
)


def state_name(channel: Channel) -> str:
    """Name of the state variable that a channel measures (``y1`` … ``phi_dot``, ``theta``).

    A channel at an angle is named by its place and angle, one at a place that is not in the model by its own name after
    an ``@``.

    Examples
    --------
    >>> fields = {"name": "XE-1", "quantity": "velocity", "location": "bearing", "unit": "mm/s"}
    >>> state_name(Channel(direction="y", **fields)), state_name(Channel(direction="X", angle_deg=45, **fields))
    ('y1_dot', 'bearing@45_dot')
    """
    direction = channel.direction
    if channel.angle_deg is not None and channel.location in ("bearing", "disc"):
        direction = {0: "y", 1: "z"}.get(_cardinal(channel.angle_deg), "")
        if not direction:
            return f"{channel.location}@{channel.angle_deg % 360:g}{_RATES[channel.quantity]}"
    return _STATE_NAMES.get((channel.quantity, channel.location, direction), f"@{channel.name}")


def parts_seen(channel: Channel) -> dict[str, float]:
    """States and their factors: a channel measures the sum of the states, each times its factor.

    Examples
    --------
    >>> parts_seen(Channel(name="P", quantity="displacement", location="disc", direction="X", unit="um", angle_deg=180))
    {'y2': -1.0, 'z2': 0.0}
    """
    if channel.angle_deg is None or channel.location not in ("bearing", "disc"):
        return {state_name(channel): 1.0}
    names = (_STATE_NAMES[channel.quantity, channel.location, direction] for direction in ("y", "z"))
    return dict(zip(names, channel.axis, strict=True))


def turned_pairs(channels: Sequence[Channel]) -> list[tuple[int, int]]:
    """Pairs of columns of sensors at an angle that are resolved into y and z; the sensor nearer to y is the first.

    Raises
    ------
    ValueError
        Naming sensors that cannot be resolved.
    """
    found = []
    columns = [column for column, one in enumerate(channels) if one.location in ("bearing", "disc")]
    columns.sort(key=lambda column: (channels[column].location, channels[column].quantity))
    for (location, quantity), group in groupby(columns, lambda at: (channels[at].location, channels[at].quantity)):
        members = list(group)
        angled = [column for column in members if channels[column].angle_deg is not None]
        if not angled:
            continue
        names = [channels[column].name for column in angled]
        said = f"{', '.join(names[:-1])} and {names[-1]}" if names[1:] else names[0]
        others = [channels[column].name for column in members if column not in angled]
        if len(angled) == 1:
            beside = f"; {' and '.join(others)} has no angle_deg: 0 is that of y, 90 of z" if others else ""
            raise ValueError(
                f"channel {said}: one alone cannot be resolved into y and z, expected a second {quantity} sensor with "
                f"angle_deg at {location}{beside}; at a place with another name (DE, NDE, …) its levels are watched"
            )
        if len(angled) > 2:
            count = "three" if len(angled) == 3 else f"{len(angled)}"
            raise ValueError(
                f"channels {said}: {count} {quantity} sensors with angle_deg at {location}, expected two; levels of "
                "more are watched at a place with another name"
            )
        if others:
            raise ValueError(
                f"channel {' and '.join(others)}: measures y or z of {location} beside {said}, which are resolved into "
                "them; expected two sensors of a quantity at a place"
            )
        apart = apart_deg(channels[angled[0]], channels[angled[1]])
        if apart < LEAST_APART_DEG - 1e-9:
            raise ValueError(
                f"channels {said}: their axes are {round(apart, 1):g}° apart, expected at least {LEAST_APART_DEG:g}°: "
                "two sensors that point the same way cannot tell y from z"
            )
        first, second = angled
        nearer = abs(channels[second].axis[0]) > abs(channels[first].axis[0]) + 1e-9
        found.append((second, first) if nearer else (first, second))
    return found


def apart_deg(first: Channel, second: Channel) -> float:
    """Angle between the axes of two sensors, 0 to 90°, whichever way they point."""
    (a, b), (c, d) = first.axis, second.axis
    return math.degrees(math.atan2(abs(a * d - b * c), abs(a * c + b * d)))


def with_channel_names(text: str, channels: Iterable[Channel]) -> str:
    """Replace the states in a sentence (``y1``, ``z2_dot``) by the names of the machine's channels.

    A state that two sensors at an angle measure together is replaced by both names.

    Examples
    --------
    >>> probe = Channel(name="XE-1", quantity="displacement", location="bearing", direction="y", unit="um")
    >>> with_channel_names("gain of y1 or y1_dot", (probe,))
    'gain of XE-1 or y1_dot'
    """
    known = tuple(channels)

    def names(found: re.Match[str]) -> str:
        state = found["state"]
        seen_by = [one for one in known if state in {state_name(one), *parts_seen(one)}]
        if found["gain"] and "@" not in state:
            # Two sensors of a motion contradict each other: if one of them is at an angle, its partner may be wrong.
            own = state.partition("_")[0]
            place = [one for one in known if own in {part.partition("_")[0] for part in parts_seen(one)}]
            seen_by = place if any(len(parts_seen(one)) > 1 for one in place) else seen_by
        return found["gain"] + (" or ".join(one.name for one in seen_by) or state)

    return _STATE.sub(names, text)


class ChannelDescriptor(BaseModel, frozen=True):
    """Columns, rate and number format of one machine's stream, as served on the ``descriptor`` key.

    Publishers and recordings may be of a later version: unknown fields are ignored.
    """

    site: str
    machine: str
    rate_hz: float = Field(gt=0, le=1e6, description="samples per second and channel")
    dtype: Literal["float32", "float64"]
    channels: tuple[Channel, ...] = Field(min_length=1, max_length=64)

    @field_validator("channels", mode="before")
    @classmethod
    def _known_fields(cls, channels: object) -> object:
        """Drop unknown fields of channels here; in a machine file, which has channels as well, they are a mistake."""
        if not isinstance(channels, list):
            return channels
        known = Channel.model_fields
        return [
            {name: one[name] for name in one if name in known} if isinstance(one, dict) else one for one in channels
        ]

    @model_validator(mode="after")
    def _unique(self) -> Self:
        names = [channel.name for channel in self.channels]
        for what, values in (("name", names), ("measured quantity", self.states)):
            twice = sorted({value for value in values if values.count(value) > 1})
            if twice:
                raise ValueError(f"channel {what} occurs twice: {', '.join(twice)}")
        return self

    @property
    def schema_hash(self) -> str:
        """Twelve hexadecimal digits that change whenever columns, units, rate or number format change."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def states(self) -> tuple[str, ...]:
        """State variable of each column, in column order; for two sensors at an angle, what each is resolved into."""
        names = [state_name(channel) for channel in self.channels]
        for pair in turned_pairs(self.channels):
            for column, name in zip(pair, parts_seen(self.channels[pair[0]]), strict=True):
                names[column] = name
        return tuple(names)


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

_TIME_NS = {"s": 1e9, "ms": 1e6, "us": 1e3, "µs": 1e3, "ns": 1.0, "min": 60e9, "h": 3600e9, "d": 86_400e9}
_DETECTED = re.compile(r"(?:[ _(-]|\b)(pp|p-p|pk-pk|pkpk|peak-peak|0-p|0-pk|pk|peak|rms|avg)\)?$", re.IGNORECASE)


def unit_factor(quantity: str, unit: str) -> float:
    """Factor that turns samples in a unit, as a person or a measuring program writes it, into SI units of a quantity.

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
            f"unit {unit!r} is that of an overall value ({detected.group(1)}), but waveform samples are needed: they "
            f"have no peak-to-peak or rms unit; {accepted}"
        )
    others = [name for name, units in _UNITS.items() if spelled in units]
    if others:
        raise ValueError(f"unit {unit!r} is a unit of {' or '.join(others)}, not of {quantity}; {accepted}")
    if quantity == Quantity.SHAFT_ANGLE and spelled in ("rpm", "1/min", "Hz"):
        accepted += "; a speed is no angle: leave the channel out, and give speed_rpm in [operation] of the machine"
    raise ValueError(f"unit {unit!r} is not known for {quantity}; {accepted}")


def same_unit(quantity: str, one: str, other: str) -> bool:
    """Whether two spellings mean one unit; a spelling that is not understood contradicts nothing.

    A mark of an overall value in `other` (pp, rms), which a waveform may have by mistake, is ignored.

    Examples
    --------
    >>> same_unit("displacement", "mil", "mil pp"), same_unit("displacement", "um", "mil pp")
    (True, False)
    """
    known = _UNITS[quantity]
    first, second = _spelled(one), _spelled(_DETECTED.sub("", _spelled(other)))
    if any(second in units for units in _UNITS.values()):
        return known.get(first) == known.get(second)
    return True


def unit_in_text(unit: str) -> str:
    """Spell a unit as in texts.

    Examples
    --------
    >>> unit_in_text("um pp")
    'µm pp'
    """
    return unit.replace("um", "µm")


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
