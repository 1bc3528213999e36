"""Values of the plots of a machine: of its newest samples, and over time or speed.

They come from the newest samples of a monitor, from its history, or from recordings, as `source` states. Phase is the
lag from the phase reference's mark to the positive peak, as in API 670 and ISO 13373-2. Numbers have six significant
digits; null stands for unknown values.
"""

from typing import Annotated, Literal

from pydantic import Field

from rotorwatch.records.fields import EXAMPLE_NS, OfMachine, Record

_Series = tuple[float | None, ...]
_Reason = Annotated[str, Field(description="why values are missing; empty if all are there", examples=[""])]
_Speed = Annotated[
    float | None,
    Field(description="mean speed, negative where the shaft turns from z to y; null if not known", examples=[138.23]),
]
_Speeds = Annotated[
    _Series,
    Field(description="speed of each value, negative for rotation from z to y", examples=[(62.8, 94.2, 138.23)]),
]
_Times = Annotated[
    tuple[int, ...],
    Field(description="time of each", examples=[(EXAMPLE_NS - 2_000_000_000, EXAMPLE_NS - 1_000_000_000, EXAMPLE_NS)]),
]
_Location = Annotated[str, Field(description="place at which two displacements are measured", examples=["bearing"])]


class _Values(OfMachine):
    source: Literal["newest samples", "history", "recordings"] = Field(
        description="where the values come from", examples=["newest samples"]
    )


class _ValuesOfSamples(_Values):
    start_ns: int | None = Field(
        default=None, description="beginning of the data used; null without data", examples=[EXAMPLE_NS - 400_000_000]
    )
    end_ns: int | None = Field(default=None, description="end of the data used", examples=[EXAMPLE_NS])


class ChannelWaveform(Record):
    """The newest samples of one channel about their mean; n_samples values."""

    channel: str = Field(description="name of the channel", examples=["y1"])
    unit: str = Field(description="unit of the values", examples=["µm"])
    mean: float | None = Field(description="mean that was subtracted", examples=[0.12])
    values: _Series = Field(description="samples less their mean", examples=[(3.2, 4.1)])


class WaveformSnapshot(_ValuesOfSamples):
    """The newest whole revolutions, channel by channel."""

    speed_rad_s: _Speed = None
    revolutions: int = Field(default=0, description="whole revolutions; 0 if not known", examples=[8])
    times_s: tuple[float, ...] = Field(
        default=(), description="time of each sample after `start_ns`", examples=[(0.0, 0.0005)]
    )
    pulses_s: tuple[float, ...] = Field(
        default=(),
        description="when the shaft angle was 0, after `start_ns`; empty without a phase reference",
        examples=[(0.0, 0.0455)],
    )
    waveforms: tuple[ChannelWaveform, ...] = Field(default=(), description="channel by channel")
    reason: _Reason = ""


class PlaceSpectrum(Record):
    """Full spectrum at one place: diameters of the circles that add up to the shaft's motion; n_lines values."""

    location: _Location
    channels: tuple[str, ...] = Field(description="the two channels", examples=[("y1", "z1")])
    unit: str = Field(description="unit of the diameters", examples=["µm pp"])
    values: _Series = Field(description="diameter of the circle of each line", examples=[(0.8, 0.3, 7.4)])


class FullSpectrumSnapshot(_ValuesOfSamples):
    """Full spectra: motion of the shaft in the direction of rotation (forward) and against it."""

    speed_rad_s: _Speed = None
    frequencies_hz: tuple[float, ...] = Field(
        default=(),
        description="n_lines values; positive is forward precession, or from y to z where the rotation is not known",
        examples=[(-22.0, 0.0, 22.0)],
    )
    resolution_hz: float | None = Field(default=None, description="line spacing; null if there is none", examples=[1.0])
    averages: int = Field(default=0, description="number of half-overlapping Hann segments averaged", examples=[19])
    places: tuple[PlaceSpectrum, ...] = Field(default=(), description="place by place")
    reason: _Reason = ""


class WaterfallRow(Record):
    """One spectrum of a waterfall; n_bins values."""

    start_ns: int | None = Field(
        description="beginning of its data; null if ordered by speed", examples=[EXAMPLE_NS - 1_000_000_000]
    )
    end_ns: int | None = Field(description="end of its data; null if ordered by speed", examples=[EXAMPLE_NS])
    speed_rad_s: _Speed = None
    values: _Series = Field(description="amplitudes in `unit`", examples=[(0.8, 7.4)])


class WaterfallSnapshot(_ValuesOfSamples):
    """Spectra of one channel over time or speed."""

    channel: str = Field(default="", description="name of the channel; empty without one", examples=["y1"])
    unit: str = Field(default="", description="unit of the amplitudes", examples=["µm pp"])
    over: Literal["time", "speed"] = Field(description="whether rows are ordered by time or speed", examples=["time"])
    frequencies_hz: tuple[float, ...] = Field(default=(), description="n_bins values", examples=[(20.0, 22.0)])
    resolution_hz: float | None = Field(default=None, description="line spacing; null if there is none", examples=[2.0])
    rows: tuple[WaterfallRow, ...] = Field(default=(), description="the oldest, or slowest, first")
    reason: _Reason = ""


class ChannelVectors(Record):
    """Vectors of one channel at an order of running speed; n values."""

    channel: str = Field(description="name of the channel", examples=["y1"])
    unit: str = Field(description="unit of the amplitudes", examples=["µm pp"])
    amplitude: _Series = Field(description="amplitude", examples=[(4.1, 9.8, 16.2)])
    phase_lag_deg: _Series = Field(description="phase lag, 0 to 360°", examples=[(12.0, 15.5, 21.3)])


class VectorSeries(_Values):
    """Vectors at an order of running speed over time and speed, for Bode and polar plots."""

    order: int = Field(description="multiple of running speed", examples=[1])
    revolutions: int | None = Field(
        default=None, description="revolutions per vector; null for windows of the monitor", examples=[None]
    )
    slow_roll_rpm: float | None = Field(
        default=None,
        description="speed up to which the subtracted mean vector was taken; null if none was subtracted",
        examples=[None],
    )
    times_ns: _Times = ()
    speeds_rad_s: _Speeds = ()
    channels: tuple[ChannelVectors, ...] = Field(default=(), description="channel by channel")
    steady: str = Field(
        default="",
        description="note that the speeds are nearly the same, so that a Bode plot shows little; empty otherwise",
        examples=[""],
    )
    reason: _Reason = ""


class PlaceCentreline(Record):
    """Mean positions of the shaft at one place; n values."""

    location: _Location
    channels: tuple[str, ...] = Field(description="the two channels", examples=[("y1", "z1")])
    y_um: _Series = Field(description="position along y, µm", examples=[(0.0, 1.1, 2.3)])
    z_um: _Series = Field(description="position along z, µm", examples=[(0.0, 4.2, 8.9)])


class CentrelineSeries(_Values):
    """Average position of the shaft over time and speed (API 670: average shaft centreline)."""

    times_ns: _Times = ()
    speeds_rad_s: _Speeds = ()
    places: tuple[PlaceCentreline, ...] = Field(default=(), description="place by place")
    reason: _Reason = ""
