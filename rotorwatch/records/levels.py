"""Vibration levels of a window, channel by channel."""

from typing import Literal

from pydantic import Field

from rotorwatch.records.fields import Number, Record


class LevelBound(Record):
    """Limits of one kind: of a standard, of the machine file, or relative to a reference."""

    source: str = Field(description="where the limits come from", examples=["ISO 20816-3 group 2 rigid"])
    zones: tuple[float, float, float] | None = Field(
        default=None, description="boundaries A/B, B/C and C/D of a standard; null without", examples=[(1.4, 2.8, 4.5)]
    )
    alert: Number = Field(default=None, description="alert from here on; null without such a limit", examples=[2.8])
    danger: Number = Field(default=None, description="danger from here on; null without such a limit", examples=[4.5])
    fall: Number = Field(default=None, description="alert below; null without such a limit", examples=[None])


def three_digits(value: float) -> str:
    """A level with three significant digits, and with all those before the decimal point.

    Examples
    --------
    >>> three_digits(0.04968), three_digits(999.7), three_digits(-1014.6)
    ('0.0497', '1000', '-1015')
    """
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"


class LevelLimits(Record):
    """Limits by which one level is judged, and its state."""

    measure: str = Field(description="which of the levels", examples=["overall"])
    alert: Number = Field(default=None, description="alert from here on; null without such a limit", examples=[2.8])
    danger: Number = Field(default=None, description="danger from here on; null without such a limit", examples=[4.5])
    fall: Number = Field(default=None, description="alert below; null without such a limit", examples=[0.4])
    source: str = Field(
        description="where the nearest limit comes from", examples=["ISO 20816-3 group 2 rigid", "commissioned"]
    )
    absolute: bool = Field(
        default=False, description="whether `source` is the machine file or a standard", examples=[True]
    )
    state: Literal["normal", "alert", "danger"] = Field(description="state of the level", examples=["normal"])
    text: str = Field(
        default="",
        description="the level and the limit it is beyond, in words; empty while it is normal",
        examples=[""],
    )
    bounds: tuple[LevelBound, ...] = Field(
        default=(),
        exclude_if=lambda value: not value,
        description="every kind of limit, including those that are not the nearest; left out if the limits above are "
        "the only ones and there are no zones",
    )


class LevelGrowth(Record):
    """Growth of vibration that would have raised an alert in a window reported as unchanged, or only watched."""

    growth: Number = Field(
        description="smallest growth, relative to the level of the window, with which every channel would have raised "
        "an alert; null if a channel has no limit, so that no growth of it would have raised one",
        examples=[0.6],
    )
    channel: str = Field(description="channel that would have raised an alert last, or never", examples=["DE-H"])
    measure: str = Field(description="deciding level of that channel; empty if there is none", examples=["overall"])
    text: str = Field(
        description="the same in words",
        examples=[
            "growth of 60 % in any channel would have raised an alert; last in DE-H, whose overall is 1.93 "
            "m/s2 rms with an alert limit of 3.09"
        ],
    )


class ChannelLevels(Record):
    """Vibration levels of one channel in one window."""

    channel: str = Field(description="name of the channel", examples=["DE-H"])
    unit: str = Field(description="unit of the levels, except `velocity`", examples=["m/s2"])
    detection: Literal["peak to peak", "rms"] = Field(
        description="of `overall` and the orders: peak to peak for a displacement, otherwise rms", examples=["rms"]
    )
    band_hz: tuple[float, float] | None = Field(
        description="frequency band of velocities; null for a displacement", examples=[(10.0, 1000.0)]
    )
    overall: Number = Field(description="overall level (ISO 20816-1)", examples=[1.93])
    velocity: Number = Field(
        default=None, description="of an accelerometer: velocity in the band, mm/s rms", examples=[2.1]
    )
    s_max: Number = Field(
        default=None,
        description="of the first of two displacements at right angles: largest distance of the shaft from its mean "
        "position (ISO 20816-1)",
        examples=[None],
    )
    peak: Number = Field(description="largest deviation from the mean: a true peak", examples=[6.4])
    x_half: Number = Field(
        default=None, description="at half running speed; null if the speed is not known", examples=[0.02]
    )
    x1: Number = Field(default=None, description="at running speed", examples=[1.1])
    x1_phase_lag_deg: Number = Field(
        default=None, description="phase lag of 1x; null without a phase reference", examples=[212.0]
    )
    x2: Number = Field(default=None, description="at twice running speed", examples=[0.3])
    x2_phase_lag_deg: Number = Field(default=None, description="phase lag of 2x", examples=[44.0])
    x3: Number = Field(default=None, description="at three times running speed", examples=[0.1])
    not_x1: Number = Field(default=None, description="rms without the part at running speed", examples=[1.6])
    mean: Number = Field(default=None, description="of a displacement: mean position (gap)", examples=[None])
    crest: Number = Field(default=None, description="crest factor: peak over rms", examples=[3.3])
    kurtosis: Number = Field(default=None, description="kurtosis: 3 for a Gaussian vibration", examples=[3.0])
    high: Number = Field(default=None, description="of an accelerometer: rms above 1 kHz", examples=[0.8])
    envelope: Number = Field(default=None, description="rms of the envelope of the part above 1 kHz", examples=[0.3])
    growth: Number = Field(
        default=None,
        description="level of the twelfth-octave band nearest to its limit, over the reference; null without a "
        "reference",
        examples=[1.1],
    )
    zone: Literal["", "A", "B", "C", "D"] = Field(
        default="", description="zone of the standard that applies; empty without one", examples=["B"]
    )
    limits: tuple[LevelLimits, ...] = Field(default=(), description="limits of the levels that have any")

    def values(self) -> dict[str, float]:
        """Levels that have a value, by measure."""
        found = {name: getattr(self, name) for name in LEVEL_MEASURES}
        return {name: value for name, value in found.items() if value is not None}

    @property
    def beyond(self) -> Literal["", "alert", "danger"]:
        """The worst state of any level; empty if all are within their limits."""
        states = {limit.state for limit in self.limits}
        return "danger" if "danger" in states else "alert" if "alert" in states else ""

    @property
    def text(self) -> str:
        """The most important levels, in words.

        Examples
        --------
        >>> from rotorwatch.records.example import example
        >>> ChannelLevels.model_validate(example(ChannelLevels)).text
        'DE-H 1.93 m/s2 rms, velocity 2.1 mm/s rms, 1x 1.1, zone B'
        """
        detection = "pp" if self.detection == "peak to peak" else "rms"
        unit = self.unit.replace("um", "µm")
        overall = "nothing" if self.overall is None else f"{three_digits(self.overall)} {unit} {detection}"
        parts = [f"{self.channel} {overall}"]
        parts += [] if self.velocity is None else [f"velocity {three_digits(self.velocity)} mm/s rms"]
        parts += [] if self.x1 is None else [f"1x {three_digits(self.x1)}"]
        parts += [] if self.mean is None else [f"gap {three_digits(self.mean)} {unit}"]
        return ", ".join(parts + ([f"zone {self.zone}"] if self.zone else []))

    def limit(self, measure: str) -> LevelLimits | None:
        """Limits of one level."""
        return next((one for one in self.limits if one.measure == measure), None)


LEVEL_MEASURES = tuple(
    name
    for name, field in ChannelLevels.model_fields.items()
    if field.annotation == float | None and not name.endswith("_deg")
)
"""Every measure, in the order in which they are shown."""
