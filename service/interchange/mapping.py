"""The mapping from the columns of a foreign file to the machine's channels, with units and time base.

One TOML file; ``docs/interchange.md`` explains each field.
"""

import re
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from typing import Annotated, Any, Literal, Self
from zoneinfo import ZoneInfo

from pydantic import BaseModel, BeforeValidator, Field, model_validator

from models.errors import MachineFileError
from models.machine import MachineFile
from models.mistakes import checked, did_you_mean, read_toml
from models.signals.block import nanoseconds
from models.signals.channels import Channel, Quantity, Sensor, time_unit_ns, unit_factor
from service.interchange.source import Format, Source, SourceError

_DATETIME = "datetime"
_ZEROS_NS = {"unix": 0, "datenum": -719_529 * 86_400 * 10**9}
"""Zero points of time counts, nanoseconds since 1970; MATLAB counts days from a year 0."""


def _text(value: object) -> object:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


_Name = Annotated[str, BeforeValidator(_text), Field(min_length=1)]
"""Name of a column; columns without names are numbered from 1."""


class CsvFormat(BaseModel, extra="forbid", frozen=True):
    """Layout of a text table."""

    delimiter: str = Field(default=",", min_length=1, max_length=1, description="between cells")
    decimal: Literal[".", ","] = Field(default=".", description="decimal sign")
    header: bool = Field(default=True, description="whether the first line has names")
    skip_lines: int = Field(default=0, ge=0, description="lines before the table")
    skip_lines_after_header: int = Field(default=0, ge=0, description="lines between names and numbers, such as units")
    encoding: str = Field(default="utf-8", description="such as latin-1 for a µ from an old program")
    missing: tuple[str, ...] = Field(default=(), description="cells without a number, such as OVL or ---")

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        if self.delimiter == self.decimal:
            raise ValueError(f"delimiter and decimal are both {self.decimal!r}, expected different signs")
        return self


class TimeBase(BaseModel, extra="forbid", frozen=True):
    """When the rows were sampled."""

    column: _Name | None = Field(default=None, description="column with the time of each row")
    index: int | None = Field(default=None, ge=0, description="its column, in a table within an array file")
    unit: str = Field(default="s", description="of that column: s, ms, us, ns, min, h, d; datetime for dates and times")
    start: datetime | Literal["unix", "datenum"] | None = Field(
        default=None,
        description="time of the first row, or of 0 in the time column; unix if that counts from 1970, datenum if that "
        "counts the days of MATLAB",
    )
    zone: str | None = Field(
        default=None,
        description="time zone of dates and times without one, in start, the file and file names, such as "
        "Europe/Berlin or +01:00; UTC if left out",
    )
    rate_hz: float | None = Field(default=None, gt=0, le=1e6, description="samples per second where no column says so")
    rate_from: _Name | None = Field(default=None, description="array of the file with the rate, Hz")
    resample: bool = Field(default=False, description="whether a file at another rate than the machine's is resampled")
    jitter: float = Field(
        default=0.4, gt=0, le=0.5, description="how far a time step may be from the usual one, in steps"
    )
    fill_gaps_up_to_s: float = Field(
        default=0.0, ge=0, le=1, description="gaps up to this length are filled with straight lines"
    )
    # Refused by default: empty cells in a file are more often due to columns with different rates or a wrong mapping
    # than to a dead probe, and unlike in a live stream, this can still be corrected.
    not_finite: Literal["refuse", "gap", "missing"] = Field(
        default="refuse",
        description="what to make of empty cells, NaN and infinities: missing keeps the other channels of such rows",
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        # The zero of a spreadsheet's day numbers stays refused: one offset is not that of summer and winter.
        if isinstance(self.start, datetime) and self.start.tzinfo is None and (not self.zone or self.start.year < 1970):
            told = f"start {self.start.isoformat()} has no time zone, expected UTC such as {self.start}Z"
            raise ValueError(told if self.zone else f"{told}, or local time with time.zone")
        if self.rate_hz is not None and self.rate_from is not None:
            raise ValueError("rate_hz and rate_from are both given, expected one of them")
        if self.unit == _DATETIME:
            if self.start is not None:
                raise ValueError("start is given although the time column has dates, expected no start")
        else:
            time_unit_ns(self.unit)
        _ = self.time_zone
        return self

    @property
    def time_zone(self) -> tzinfo:
        """Time zone of dates and times that name none."""
        if self.zone is None:
            return UTC
        try:
            ahead = re.fullmatch(r"[+-]\d\d:\d\d", self.zone)
            return datetime.strptime(self.zone, "%z").tzinfo or UTC if ahead else ZoneInfo(self.zone)
        except (ValueError, OSError, LookupError) as error:
            raise ValueError(f"zone {self.zone!r} is not known, expected such as Europe/Berlin or +01:00") from error

    @property
    def is_datetime(self) -> bool:
        """Whether the time column has dates and times by itself."""
        return self.column is not None and self.unit == _DATETIME

    @property
    def start_ns(self) -> int | None:
        """Start in nanoseconds since 1970, if it is given."""
        if self.start is None:
            return None
        if not isinstance(self.start, datetime):
            return _ZEROS_NS[self.start]
        return nanoseconds(self.start if self.start.tzinfo else self.start.replace(tzinfo=self.time_zone))


class Column(BaseModel, extra="forbid", frozen=True, allow_inf_nan=False):
    """Column with a channel's samples: sample = sign · (number · scale + offset) in `unit`."""

    column: _Name = Field(description="column, array, channel or data set")
    index: int | None = Field(default=None, ge=0, description="column of a table within an array file, from 0")
    unit: str | None = Field(default=None, description="unit of the samples; may be left out where the file states it")
    scale: float = Field(default=1.0, description="units per number in the file")
    scale_from: _Name | None = Field(default=None, description="array of the file with the scale, of each index or one")
    offset: float = Field(default=0.0, description="added after scaling, in `unit`")
    sign: Literal[1, -1] = Field(default=1, description="-1 turns the direction round")

    @model_validator(mode="after")
    def _effective(self) -> Self:
        if self.scale == 0:
            raise ValueError("scale is 0, expected another number")
        return self


class Acceleration(BaseModel, extra="forbid", frozen=True):
    """Channels that are integrated from accelerometers."""

    high_pass_hz: float = Field(gt=0, le=1e4, description="corner of the high-pass; valid from twice that frequency")
    channels: dict[str, Column] = Field(min_length=1, description="channel of the machine to accelerometer")


class Keyphasor(BaseModel, extra="forbid", frozen=True, allow_inf_nan=False):
    """Shaft angle from pulses: their times, or a sampled signal that has them."""

    pulse_times: _Name | None = Field(default=None, description="array of the times of all pulses")
    unit: str = Field(default="s", description="unit of these times, counted like the rows")
    column: _Name | None = Field(default=None, description="sampled signal with the pulses")
    index: int | None = Field(default=None, ge=0, description="its column, in a table within an array file")
    threshold: float | None = Field(default=None, description="level at which a pulse begins, as numbers in the file")
    hysteresis: float = Field(default=0.0, ge=0, description="how far it must fall back before the next pulse")
    edge: Literal["rising", "falling"] = "rising"
    pulses_per_revolution: int = Field(default=1, ge=1, le=10000)
    direction: Literal["forward", "reverse"] = Field(default="forward", description="forward turns from y to z")

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if (self.pulse_times is None) == (self.column is None):
            raise ValueError("expected either pulse_times or column")
        if self.column is not None and self.threshold is None:
            raise ValueError("column needs a threshold")
        time_unit_ns(self.unit)
        return self


class Mapping(BaseModel, extra="forbid", frozen=True):
    """A complete mapping."""

    format: Format | None = Field(default=None, description="format of the file where its name does not say")
    csv: CsvFormat = CsvFormat()
    time: TimeBase = TimeBase()
    channels: dict[str, Column] = Field(default={}, description="channel of the machine to column")
    acceleration: Acceleration | None = None
    keyphasor: Keyphasor | None = None

    @property
    def accelerations(self) -> dict[str, Column]:
        """Channels to integrate."""
        return {} if self.acceleration is None else self.acceleration.channels

    def format_of(self, path: Path) -> Format | None:
        """Format stated in the mapping, or else by the file name; None if unknown."""
        return self.format or Format.of(path)

    def open(self, path: Path) -> Source:
        """Open a file.

        Raises
        ------
        SourceError
            If the format is not known, or the file is not of it.
        """
        if not path.is_file():
            raise SourceError(f"{path}: no such file")
        kind, base = self.format_of(path), self.time
        if kind is None:
            suffixes = ", ".join(suffix for known in Format for suffix in known.suffixes)
            raise SourceError(
                f"{path}: format {path.suffix or 'without a suffix'!r} is not known; say format = ... in the mapping, "
                f"or name the file {suffixes}"
            )
        options: dict[str, Any] = {}
        if kind in {Format.CSV, Format.PARQUET, Format.NPZ}:
            options["zone"] = base.zone or "UTC"
        if kind is Format.MF4:
            options["zone"] = base.time_zone
        if kind is Format.CSV:
            options |= {"form": self.csv, "time_column": base.column, "datetimes": base.is_datetime}
        return kind.open(path, **options)

    def check_against(self, machine: MachineFile) -> None:
        """Check that every channel of the machine is mapped exactly once, in a unit of its quantity.

        Raises
        ------
        ValueError
            Naming the field.
        """
        known = {channel.name: channel for channel in machine.sensors}
        tables = {"channels": self.channels, "acceleration.channels": self.accelerations}
        for table, columns in tables.items():
            for name in columns:
                if name not in known:
                    raise ValueError(
                        f"{table}.{name}: not a channel of the machine, which has {', '.join(known)}"
                        f"{did_you_mean(name, known)}"
                    )
        for name, channel in known.items():
            self._check_channel(name, channel)
        for table, columns in tables.items():
            self._check_double(table, columns, known)
        if self.keyphasor is not None and Quantity.SHAFT_ANGLE not in [one.quantity for one in machine.sensors]:
            raise ValueError("keyphasor: the machine has no shaft_angle channel for it")

    def _check_double(self, table: str, columns: dict[str, Column], known: dict[str, Sensor]) -> None:
        """Refuse one column for two channels, except an accelerometer for one velocity and one displacement."""
        taken: dict[tuple[str, int | None, Quantity | None], str] = {}
        for name, one in columns.items():
            key = (one.column, one.index, known[name].quantity if columns is self.accelerations else None)
            first = taken.setdefault(key, name)
            if first != name:
                where = f"column {one.column!r}" + ("" if one.index is None else f", index {one.index},")
                raise ValueError(
                    f"{table}.{name}: {where} is that of channel {first} already; expected that of another sensor"
                )

    def _check_channel(self, name: str, channel: Channel) -> None:
        is_angle = channel.quantity is Quantity.SHAFT_ANGLE
        ways = [name in self.channels, name in self.accelerations, is_angle and self.keyphasor is not None]
        if sum(ways) != 1:
            how = "nothing" if not any(ways) else "more than one of them"
            angle = ", or a [keyphasor]" if is_angle else f" or [acceleration.channels.{name}]"
            raise ValueError(f"channels.{name}: expected [channels.{name}]{angle}, found {how}")
        if name in self.accelerations:
            if channel.quantity not in (Quantity.DISPLACEMENT, Quantity.VELOCITY):
                raise ValueError(
                    f"acceleration.channels.{name}: a {channel.quantity} is not what acceleration integrates to"
                )
            self._check_unit(f"acceleration.channels.{name}", Quantity.ACCELERATION, self.accelerations[name])
        elif name in self.channels:
            self._check_unit(f"channels.{name}", channel.quantity, self.channels[name])

    def _check_unit(self, field: str, quantity: str, column: Column) -> None:
        if column.unit is not None:
            try:
                unit_factor(quantity, column.unit)
            except ValueError as error:
                raise ValueError(f"{field}.unit: {error}{of_voltage(column.unit)}") from error


def of_voltage(unit: str) -> str:
    """What to do about a unit that was refused: a hint if it is that of a sensor's voltage, else empty."""
    return "; of a sensor's voltage, give unit and scale in the mapping" if unit in {"V", "mV"} else ""


def load_mapping(path: Path, machine: MachineFile) -> Mapping:
    """Load a mapping for a machine.

    Raises
    ------
    MachineFileError
        Naming the file, the field, the value found and what was expected.
    """
    mapping = checked(Mapping, read_toml(path), path)
    try:
        mapping.check_against(machine)
    except ValueError as error:
        raise MachineFileError(f"{path}: {error}") from error
    return mapping
