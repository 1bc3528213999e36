"""The machine file: everything the programs know about one machine, in one checked TOML file.

`MachineFile` is what every machine has: identity, channels, window, alarms. `Machine` is one whose parameters are known
as well, so that it can be simulated and compared with theory; nobody knows those of most real machines, which are
commissioned instead (`models.commissioning`).

Every field carries its unit in its name; unknown keys are refused. ``docs/machine-file.md`` explains each field.
"""

import math
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, Field, ValidationError, model_validator

from models.alarm_names import ALARMS, LEVEL, is_alarm
from models.errors import MachineFileError
from models.levels.settings import LevelSettings
from models.mistakes import changed, checked, did_you_mean, read_toml
from models.physics.rotor import PARAMETERS, KnownRotor, RotorParameters, natural_frequencies
from models.signals.channels import Channel, ChannelDescriptor, Quantity, Sensor, state_name
from models.signals.keys import MachineKeys
from models.stream_settings import IngestSettings, Schedule, WindowSettings, default_window, time_scale, whole

SHIPPED_MACHINES = Path(__file__).parent / "machines"


_BINS = 20
_MOST_OF_SEGMENT = 0.02  # delay over the length of a segment: what came before it is missing in it
_MOST_OF_BAND = 2.0  # corner of a high-pass over the lowest frequency of the band, where a first-order one halves it
_LONGEST_HOP_S = 600.0


class Operation(BaseModel, extra="forbid", frozen=True):
    """How the machine runs."""

    speed_rpm: float = Field(gt=0, le=1e6, description="nominal speed")
    speed_tolerance: float = Field(default=0.2, ge=0, lt=1, description="relative speed range, trained and evaluated")
    unbalance_phase_rad: float = Field(
        default=0.0, ge=-math.pi, le=math.pi, description="angle of the heavy spot from the phase reference"
    )

    @property
    def speed_rad_s(self) -> float:
        """Nominal speed Ω, rad/s."""
        return self.speed_rpm * 2 * math.pi / 60


class ConditionRange(BaseModel, extra="forbid", frozen=True):
    """Operating conditions the networks are trained for."""

    cutoff_hz: tuple[float, float] = Field(description="cutoff frequency of the excitation, from and to")
    stochastic_to_1x: tuple[float, float] = Field(
        default=(0.5, 4.0),
        description="stochastic displacement at the disc over its 1x amplitude, both rms, from and to",
    )
    noise_relative: tuple[float, float] = Field(
        default=(0.01, 0.05), description="sensor noise over the channel's own rms, from and to"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for field in ("cutoff_hz", "stochastic_to_1x", "noise_relative"):
            low, high = getattr(self, field)
            if not 0 <= low <= high:
                raise ValueError(f"{field} is ({low}, {high}), expected 0 ≤ from ≤ to")
        return self


class AlarmLimits(BaseModel, extra="forbid", frozen=True):
    """Limits of one parameter's relative change."""

    raise_above: float = Field(default=0.10, gt=0, lt=1, description="alert when the change is larger, either sign")
    clear_below: float = Field(default=0.06, gt=0, lt=1, description="back to normal when smaller")
    danger_above: float = Field(default=0.40, gt=0, description="danger when larger")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.clear_below < self.raise_above < self.danger_above:
            names = ("clear_below", "raise_above", "danger_above")
            default = {name: "" if name in self.model_fields_set else " (default)" for name in names}
            got = ", ".join(f"{getattr(self, name)}{default[name]}" for name in names)
            raise ValueError(f"expected clear_below < raise_above < danger_above, got {got}")
        return self


def _known_alarms(field: str, names: Iterable[str]) -> None:
    unknown = sorted(name for name in set(names) if not is_alarm(name))
    if unknown:
        hint = did_you_mean(unknown[0], ALARMS)
        known = f"{', '.join(ALARMS)} and {LEVEL}CHANNEL"
        raise ValueError(f"{field}: {', '.join(unknown)} is not an alarm; there are {known}{hint}")


_WHEN = ("while_alarm", "below_rpm", "above_rpm")


class SuppressRule(BaseModel, extra="forbid", frozen=True):
    """When some alarms are suppressed by design: while another alarm's condition is there, or outside some speed."""

    alarms: tuple[str, ...] = Field(min_length=1, description="which, by name")
    while_alarm: str | None = Field(default=None, description="as long as the condition of this alarm is present")
    below_rpm: float | None = Field(default=None, gt=0, description="as long as the machine turns slower than this")
    above_rpm: float | None = Field(default=None, gt=0, description="as long as the machine turns faster than this")
    because: str = Field(min_length=1, max_length=200, description="reason, as operators will read it")

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        _known_alarms("alarms", self.alarms)
        given = [name for name in _WHEN if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"expected exactly one of {', '.join(_WHEN)}; found {given or 'none'}")
        if self.while_alarm is not None:
            _known_alarms("while_alarm", [self.while_alarm])
            if self.while_alarm in self.alarms:
                raise ValueError(f"while_alarm: {self.while_alarm} would suppress itself")
        return self

    @property
    def identity(self) -> str:
        """What the rule depends on; rules that depend on the same thing hold together.

        Examples
        --------
        >>> SuppressRule(alarms=("model",), below_rpm=600, because="coasting down").identity
        'below_rpm=600.0'
        """
        return next(f"{name}={value}" for name in _WHEN if (value := getattr(self, name)) is not None)


_NAME_CONFIDENCE = 0.9


class AlarmSettings(BaseModel, extra="forbid", frozen=True):
    """When a parameter change becomes an alarm; all times are data time."""

    limits: AlarmLimits = AlarmLimits()
    parameters: dict[str, AlarmLimits] = Field(default={}, description="limits of single parameters instead")
    false_alarms_per_month: float = Field(
        default=1.0,
        gt=0,
        le=1000,
        description="how often a machine on which nothing has changed may be said to have changed, in 30 days of data; "
        "sets how many standard errors a change must exceed",
    )
    on_delay_s: float = Field(default=10.0, ge=0, le=86400, description="how long it must last before the alarm")
    off_delay_s: float = Field(default=60.0, ge=0, le=86400, description="how long it must be gone before it clears")
    name_confidence: float = Field(
        default=_NAME_CONFIDENCE,
        ge=0.5,
        lt=1,
        # Identities stay as they were before this field existed.
        exclude_if=lambda value: value == _NAME_CONFIDENCE,
        description="how probable it must be that a parameter is among the changed ones for an alarm to name it; "
        "below, the alarm is changed, with the candidates",
    )
    gap_s: float = Field(
        default=1.0, ge=0, le=86400, description="shortest gap in the data that is an alarm; shorter ones are counted"
    )
    latching: tuple[str, ...] = Field(
        default=(), description="alarms that stay, once cleared, until somebody resets them; by name"
    )
    longest_shelf_s: float = Field(
        default=8 * 3600.0, gt=0, le=30 * 86400, description="longest time for which an alarm may be shelved"
    )
    suppress: tuple[SuppressRule, ...] = Field(default=(), description="when alarms are suppressed by design")

    @model_validator(mode="after")
    def _known(self) -> Self:
        unknown = sorted(set(self.parameters) - set(PARAMETERS))
        if unknown:
            hint = did_you_mean(unknown[0], PARAMETERS)
            raise ValueError(f"parameters: {', '.join(unknown)} is not one of {', '.join(PARAMETERS)}{hint}")
        _known_alarms("latching", self.latching)
        return self

    def for_parameter(self, name: str) -> AlarmLimits:
        """Limits of one parameter."""
        return self.parameters.get(name, self.limits)


class MachineFile(BaseModel, extra="forbid", frozen=True):
    """One machine: identity, sensors, window, ingest and alarms, and as much as is known of its physics."""

    site: str
    name: str
    description: str = ""
    rotor: KnownRotor | None = None
    operation: Operation | None = None
    condition: ConditionRange | None = None
    rate_hz: float = Field(gt=0, le=1e6, strict=True, description="samples per second and channel")
    dtype: Literal["float32", "float64"] = "float32"
    sensors: tuple[Sensor, ...] = Field(min_length=1, max_length=64)
    window: WindowSettings = WindowSettings()
    ingest: IngestSettings = IngestSettings()
    alarms: AlarmSettings = AlarmSettings()
    levels: LevelSettings = LevelSettings()
    # Left out of a machine's identity if not given: identities stay as they were before this field existed.
    schedule: Schedule | None = Field(default=None, exclude_if=lambda schedule: schedule is None)

    @model_validator(mode="before")
    @classmethod
    def _defaults_that_depend_on_others(cls, fields: object) -> object:
        """Fill in what is not given but follows from rate and natural frequencies or speed, or from a schedule."""
        if not isinstance(fields, dict) or not isinstance(fields.get("window", {}), dict):
            return fields
        given, rate_hz = fields.get("window", {}), fields.get("rate_hz")
        if not isinstance(rate_hz, int | float) or not 0 < rate_hz <= 1e6:
            return fields
        modes_hz: tuple[float, ...] = ()
        schedule, speed_hz, turning = None, None, None
        with suppress(KeyError, ValidationError):  # reported when the table itself is checked
            schedule = Schedule.model_validate(fields["schedule"])
        with suppress(KeyError, ValidationError):
            speed_hz = Operation.model_validate(fields["operation"]).speed_rpm / 60
        with suppress(KeyError, ValidationError):
            modes_hz = KnownRotor.model_validate(fields["rotor"], from_attributes=True).modes_hz
            if modes_hz and speed_hz:
                rotor = RotorParameters.model_validate(fields["rotor"], from_attributes=True)
                turning = natural_frequencies(rotor, 2 * math.pi * speed_hz)
        if schedule is not None and isinstance(fields.get("ingest", {}), dict):
            fields = fields | {"ingest": schedule.ingest() | fields.get("ingest", {})}
        window = default_window(rate_hz, given, schedule, modes_hz, speed_hz, turning) | given
        return fields | {"window": window} if window else fields

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for fault in chain(self._faults_of_window(), self._faults_of_levels(), self._faults_of_signals()):
            raise ValueError(fault)  # the first one: the others may follow from it
        return self

    def _faults_of_window(self) -> Iterator[str]:
        """Names that make no keys, windows that do not fit the sampling, and sensors that show nothing in them."""
        window, rate_hz = self.window, self.rate_hz
        try:
            MachineKeys(self.site, self.name)
        except MachineFileError as error:
            yield str(error)
        for field in ("length_s", "hop_s", "segment_s", "lag_step_s"):
            samples = getattr(window, field) * rate_hz
            if not whole(samples):
                yield f"window.{field} is {samples:.12g} samples at {rate_hz} Hz, expected a whole number"
        if round(window.segment_s * rate_hz) % 2:
            yield f"window.segment_s {window.segment_s} is an odd number of samples, expected an even one"
        yield from self._faults_of_hops()
        if self.schedule is None and not self.holds_band:
            bins = (window.band_hz[1] - window.band_hz[0]) * window.segment_s
            yield f"window.band_hz holds {bins:.0f} frequencies of segment_s, expected at least {_BINS}"
        if all(channel.quantity == "shaft_angle" for channel in self.sensors):
            yield "sensors: a shaft angle alone shows no vibration, expected a displacement or velocity too"
        slow = [sensor.name for sensor in self.sensors if sensor.slow_roll_um_pp is not None]
        if slow and all(sensor.quantity is not Quantity.SHAFT_ANGLE for sensor in self.sensors):
            yield (
                f"sensors: {slow[0]} has a slow-roll vector, and no sensor measures the shaft angle: without a phase "
                "reference there is no vector at running speed that it could be taken from"
            )
        if window.band_hz[1] >= rate_hz / 2:
            yield f"window.band_hz {window.band_hz} ends above half of rate_hz {rate_hz}"

    def _faults_of_hops(self) -> Iterator[str]:
        """Segments and lags that do not fit into a hop."""
        window, schedule = self.window, self.schedule
        if schedule is None:
            if window.hop_s > _LONGEST_HOP_S:  # all samples of a hop are held
                most = f"{_LONGEST_HOP_S:g}, or snapshots ([schedule])"
                yield f"window.hop_s is {window.hop_s:g}, expected at most {most}"
            if not whole(2 * window.hop_s / window.segment_s):
                yield f"window.hop_s {window.hop_s} must be a multiple of half of segment_s {window.segment_s}"
            return
        if abs(window.hop_s - schedule.every_s) > 1e-9 * schedule.every_s:
            every = f"one every {schedule.every_s:g} s ([schedule] every_s)"
            yield f"window.hop_s is {window.hop_s:g}, but a hop is a snapshot, {every}: leave it out"
        for field in ("segment_s", "lag_to_s"):
            value, most_s = getattr(window, field), schedule.on_s / 2
            if value > most_s:
                most = f"half of a snapshot, {most_s:g} ([schedule] on_s)"
                yield f"window.{field} is {value:g}, expected at most {most}"
        if self.ingest.no_data_after_s <= schedule.silence_s:
            silence = f"the silence between snapshots, {schedule.silence_s:g} s"
            yield f"ingest.no_data_after_s is {self.ingest.no_data_after_s:g}, expected more than {silence}"

    def _faults_of_levels(self) -> Iterator[str]:
        """Limits and alarms of levels that no channel has; raises ValueError if two channels are the same."""
        _ = self.descriptor  # refuses duplicate channels
        names = [channel.name for channel in self.sensors if channel.quantity != "shaft_angle"]
        from models.levels.limits import unmeasured  # noqa: PLC0415  # it imports scipy, for which no --help waits

        speed_rpm = None if self.operation is None else self.operation.speed_rpm
        if missing := unmeasured(self.levels, self.sensors, self.rate_hz, speed_rpm):
            yield missing
        for name in (*self.alarms.latching, *(name for rule in self.alarms.suppress for name in rule.alarms)):
            if name.startswith(LEVEL) and name.removeprefix(LEVEL) not in names:
                yield f"alarms: {name}: no channel of that name; there are {', '.join(names)}"

    def _faults_of_signals(self) -> Iterator[str]:
        """High-passes and delays that take too much of the band or of a segment."""
        begin_hz, most_us = self.window.band_hz[0], 1e6 * _MOST_OF_SEGMENT * self.window.segment_s
        for sensor in self.sensors:
            corner_hz = sensor.high_pass_hz or 0.0
            high_pass = f"channel {sensor.name}: high_pass_hz is {corner_hz:g}"
            if corner_hz >= self.rate_hz / 2:
                yield f"{high_pass}, expected below half of rate_hz"
            if abs(sensor.delay_us or 0.0) > most_us:
                most = f"{most_us:g}, a fiftieth of window.segment_s"
                yield f"channel {sensor.name}: delay_us is {sensor.delay_us:g}, expected at most {most}"
            if self.holds_band and corner_hz > _MOST_OF_BAND * begin_hz and not state_name(sensor).startswith("@"):
                yield (
                    f"{high_pass}, expected at most twice the lowest frequency of window.band_hz, {begin_hz:g} Hz: "
                    "what a high-pass takes far below its corner is lost in noise; let the band begin at "
                    f"{corner_hz / _MOST_OF_BAND:g} Hz or above"
                )

    @property
    def hop_data_s(self) -> float:
        """Data in a hop, s."""
        return self.window.hop_s if self.schedule is None else self.schedule.on_s

    @property
    def window_data_s(self) -> float:
        """Data in a full window, s."""
        return self.window.length_s if self.schedule is None else self.window.hops * self.schedule.on_s

    @property
    def holds_band(self) -> bool:
        """Whether segments are long enough for spectra in the band; without them there are levels alone."""
        return (self.window.band_hz[1] - self.window.band_hz[0]) * self.window.segment_s >= _BINS

    @property
    def time_scale(self) -> float:
        """How many times slower the machine moves than those that the usual window suits (`models.stream_settings`).

        It is 1 for a fast machine whose file gives lags for a slower one, because it is evaluated by those.
        """
        speed_hz = None if self.operation is None else self.operation.speed_rpm / 60
        scale = time_scale(() if self.rotor is None else self.rotor.modes_hz, speed_hz)
        return scale if scale > 1 or self.window.lag_to_s <= 1.001 * scale * WindowSettings().lag_to_s else 1.0

    @property
    def title(self) -> str:
        """``site/name``."""
        return f"{self.site}/{self.name}"

    @property
    def keys(self) -> MachineKeys:
        """The machine's Zenoh keys."""
        return MachineKeys(self.site, self.name)

    @property
    def descriptor(self) -> ChannelDescriptor:
        """What the machine's stream must look like."""
        stream = {"site": self.site, "machine": self.name, "rate_hz": self.rate_hz, "dtype": self.dtype}
        channels = [sensor.model_dump(include=set(Channel.model_fields)) for sensor in self.sensors]
        return ChannelDescriptor.model_validate({**stream, "channels": channels})


class Machine(MachineFile):
    """A machine whose parameters are known: rotor, operation and the conditions it is trained for."""

    rotor: RotorParameters
    operation: Operation
    condition: ConditionRange


def load_machine(name_or_path: str | Path) -> Machine:
    """Load the file of a machine whose parameters are known, by path, or a shipped one by its name, such as ``lab``.

    Raises `MachineFileError` if it cannot be used.
    """
    path = _path(name_or_path)
    return checked(Machine, read_toml(path), path)


def load_machine_file(name_or_path: str | Path, changes: str = "") -> MachineFile:
    """Load a machine file, whatever is known of the machine; a `Machine` if all its parameters are.

    TOML in `changes` is merged into the file, see `models.mistakes.changed`. Raises as `load_machine`.
    """
    path = _path(name_or_path)
    fields = changed(read_toml(path), changes)
    if "machines" in fields:
        raise MachineFileError(f"{path}: is a settings file, expected a machine file")
    found = checked(MachineFile, fields, path)
    if found.rotor is None or found.rotor.unknown or found.operation is None or found.condition is None:
        return found
    return Machine.model_validate(found.model_dump() | {"operation": found.operation})  # keeps which fields were given


def _path(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if path.suffix != ".toml" and (SHIPPED_MACHINES / f"{name_or_path}.toml").is_file():
        return SHIPPED_MACHINES / f"{name_or_path}.toml"
    if not path.is_file():
        shipped = sorted(entry.stem for entry in SHIPPED_MACHINES.glob("*.toml"))
        hint = did_you_mean(path.name, [*shipped, *(entry.name for entry in path.parent.glob("*.toml"))])
        raise MachineFileError(f"{path}: no such machine file; shipped machines: {', '.join(shipped)}{hint}")
    return path
