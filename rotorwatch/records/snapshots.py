"""Snapshots of a machine, live or of a recorded window.

Values in the unit of a channel, or of a product of two channels, state it in `unit`. Arrays that belong together have
the same length, which their descriptions name. Numbers have six significant digits; null stands for unknown values.
"""

from typing import Annotated, Literal

from pydantic import Field

from rotorwatch.records.fields import EXAMPLE_NS, BundleIdentity, MachineHash, OfMachine, ParameterName, Record

Units = Literal["channel", "SI"]

_Series = tuple[float | None, ...]
_Reason = Annotated[str, Field(description="why there is nothing to show; empty if there is", examples=[""])]
_DensityUnit = Annotated[
    str, Field(description="unit of the values: a product of two channels' units, per Hz", examples=["um^2/Hz"])
]


class _OfWindow(OfMachine):
    start_ns: int | None = Field(
        description="oldest data in the window; null without one", examples=[EXAMPLE_NS - 60_000_000_000]
    )
    end_ns: int | None = Field(description="end of the newest data in the window", examples=[EXAMPLE_NS])
    filled: float = Field(description="fraction of a full window that is filled now", examples=[1.0])
    speed_rad_s: float | None = Field(
        description="mean speed in the window; null if it is not known", examples=[138.23]
    )


class PredictedChange(Record):
    """One parameter of the machine as it is estimated now."""

    name: ParameterName
    relative_change: float = Field(description="relative change from nominal", examples=[-0.247])


class Theory(Record):
    """Basis of the predictions.

    The excitation is not measured. It is estimated as the one that explains the window best with the machine as
    estimated (as nominal, if there is no estimate). Both predictions use it, and so differ only in the parameters.
    """

    changes: tuple[PredictedChange, ...] = Field(
        description="parameters of the machine as estimated, from the latest reading; all others are nominal"
    )
    nominal_reason: str = Field(
        description="why there is no prediction for the machine as nominal; empty if there is", examples=[""]
    )
    estimated_reason: str = Field(
        description="why there is no prediction for the machine as estimated; empty if there is", examples=[""]
    )


class CorrelationPair(Record):
    """Correlation function R_ij(τ) = E{x_i(t) x_j(t+τ)} of two channels without mean and 1×; n_lags values each."""

    first: str = Field(description="name of channel i, the reference", examples=["y1"])
    second: str = Field(description="name of channel j, the response", examples=["y2"])
    unit: str = Field(description="unit of the values: a product of the two channels' units", examples=["um^2"])
    measured: _Series = Field(description="estimated in the window", examples=[(94.31, 93.67, 91.77)])
    standard_error: _Series = Field(description="standard error of `measured`", examples=[(3.37, 3.31, 3.19)])
    nominal: _Series | None = Field(
        description="prediction for the machine as nominal; null if there is none, see `theory`",
        examples=[(96.02, 95.36, 93.41)],
    )
    estimated: _Series | None = Field(
        description="prediction for the machine as now estimated; null if there is none, see `theory`",
        examples=[(94.90, 94.25, 92.34)],
    )
    nominal_z: float | None = Field(
        description="root mean square over the lags of `measured` less `nominal`, in standard errors; about 1 if "
        "theory holds, but errors of neighbouring lags are correlated, so that 2 is not unusual",
        examples=[1.1],
    )
    estimated_z: float | None = Field(description="the same for `estimated`", examples=[0.9])
    outside_band: float | None = Field(
        description="if `method` is spectrum: part of the correlation at lag zero outside the band, over the product "
        "of the two channels' rms; null otherwise",
        examples=[0.004],
    )


class CorrelationSnapshot(_OfWindow):
    """Correlation functions of a window, measured and predicted."""

    lags_s: tuple[float, ...] = Field(description="τ, n_lags values from 0 on", examples=[(0.0, 0.001, 0.002)])
    method: Literal["samples", "spectrum"] = Field(
        description="samples: computed from the samples, with standard errors from the scatter of the window's hops. "
        "spectrum: transformed from the window's spectra, if the monitor itself needs no lags; frequencies outside "
        "`band_hz` are missing from both measured and predicted values, and the standard errors come from the spectra",
        examples=["samples"],
    )
    band_hz: tuple[float, float] | None = Field(
        description="frequency band to which the values are limited; null if `method` is samples", examples=[None]
    )
    pairs: tuple[CorrelationPair, ...] = Field(description="pair by pair")
    theory: Theory = Field(description="basis of the predictions")
    reason: _Reason
    bundle: BundleIdentity
    machine_hash: MachineHash


class ChannelDensity(Record):
    """One-sided power spectral density (mean square per hertz, not amplitude) without mean and 1×; n_lines values."""

    channel: str = Field(description="name of the channel", examples=["y2"])
    quantity: str = Field(description="quantity that the channel measures", examples=["displacement"])
    unit: _DensityUnit
    measured: _Series = Field(description="estimated in the window", examples=[(0.231, 0.198, 0.212)])
    nominal: _Series | None = Field(
        description="prediction for the machine as nominal, sensor noise included; null if there is none, see `theory`",
        examples=[(0.214, 0.215, 0.216)],
    )
    estimated: _Series | None = Field(
        description="the same for the machine as now estimated", examples=[(0.216, 0.217, 0.218)]
    )
    rms: float | None = Field(
        description="root mean square in the band, in the channel's unit (SI where `unit` is)", examples=[14.2]
    )


class CrossSpectrum(Record):
    """Cross-spectrum of two channels, one-sided, and their coherence; n_lines values each."""

    first: str = Field(description="name of channel i", examples=["y1"])
    second: str = Field(description="name of channel j", examples=["y2"])
    unit: _DensityUnit
    magnitude: _Series = Field(description="magnitude of the cross-spectrum", examples=[(0.116, 0.101, 0.109)])
    phase_deg: _Series = Field(
        description="phase by which channel j leads channel i, -180 to 180°", examples=[(-0.8, 1.1, 0.3)]
    )
    coherence: _Series = Field(description="coherence squared, 0 to 1", examples=[(0.41, 0.38, 0.44)])
    nominal_magnitude: _Series | None = Field(
        description="predicted magnitude for the machine as nominal; null if there is none, see `theory`",
        examples=[(0.110, 0.110, 0.111)],
    )
    nominal_coherence: _Series | None = Field(
        description="coherence squared of the same", examples=[(0.40, 0.40, 0.40)]
    )
    estimated_magnitude: _Series | None = Field(
        description="predicted magnitude for the machine as now estimated", examples=[(0.111, 0.111, 0.112)]
    )
    estimated_coherence: _Series | None = Field(
        description="coherence squared of the same", examples=[(0.41, 0.41, 0.41)]
    )


class SpectrumSnapshot(_OfWindow):
    """Power spectral densities of a window, measured and predicted."""

    frequencies_hz: tuple[float, ...] = Field(description="n_lines values", examples=[(3.0, 3.2, 3.4)])
    line_spacing_hz: float | None = Field(
        description="line spacing; null without a window. The segments have a Hann window, so that each of their "
        "lines has a noise bandwidth of 1.5 times their own spacing",
        examples=[0.2],
    )
    averaged_lines: int = Field(description="number of adjacent lines of the segments averaged into one", examples=[1])
    degrees_of_freedom: float | None = Field(
        description="degrees of freedom of every density: measured over true is distributed as χ² divided by them",
        examples=[45.5],
    )
    interval_95: tuple[float, float] | None = Field(
        description="factors on a measured density between which the true one lies with 95 % probability",
        examples=[(0.69, 1.57)],
    )
    coherence_95: float | None = Field(
        description="coherence squared that two incoherent channels exceed in 5 % of all lines", examples=[0.129]
    )
    rotation_hz: float | None = Field(description="1×, removed from the densities; null if not known", examples=[22.0])
    left_out_hz: tuple[float, float] | None = Field(
        description="band around 1× in which a remainder of it may show; null if the speed is not known",
        examples=[(21.4, 22.6)],
    )
    densities: tuple[ChannelDensity, ...] = Field(description="channel by channel")
    cross: tuple[CrossSpectrum, ...] = Field(description="pair by pair, as requested")
    theory: Theory = Field(description="basis of the predictions")
    reason: _Reason
    bundle: BundleIdentity
    machine_hash: MachineHash


class RunningSpeedVector(Record):
    """Vibration of one channel at running speed."""

    channel: str = Field(
        description="name of the channel; of two probes at an angle, resolved into y and z, such as 'y of VE-1X and "
        "VE-1Y'",
        examples=["y1"],
    )
    amplitude: float = Field(
        description="peak amplitude (half of peak to peak), in `unit` of the orbit", examples=[8.1]
    )
    amplitude_error: float | None = Field(
        description="standard error of the amplitude, from the scatter of the hops; null if it is not known",
        examples=[0.05],
    )
    phase_lag_deg: float | None = Field(
        description="angle by which the shaft turns from the phase reference's mark to the positive peak, 0 to 360°; "
        "null without a phase reference",
        examples=[21.3],
    )
    phase_error_deg: float | None = Field(description="standard error of the phase lag", examples=[0.4])


class OrbitEllipse(Record):
    """Path of the shaft at running speed."""

    semi_major: float = Field(description="half of the long axis, in `unit` of the orbit", examples=[9.4])
    semi_minor: float = Field(description="half of the short axis", examples=[7.2])
    tilt_deg: float = Field(
        description="angle from y, towards z, to the long axis, above -90 and up to 90°", examples=[12.0]
    )
    sense: Literal["y to z", "z to y"] = Field(
        description="direction in which the shaft's centre travels round the orbit", examples=["y to z"]
    )
    precession: Literal["forward", "backward"] | None = Field(
        description="forward: in the direction of rotation of the shaft; null without a phase reference, when that "
        "direction is not known",
        examples=["forward"],
    )


class PathSamples(Record):
    """The newest whole revolutions as measured, about their mean; n_samples values each."""

    times_s: tuple[float, ...] = Field(description="time of each sample after `start_ns`", examples=[(0.0, 0.0005)])
    y: tuple[float, ...] = Field(description="samples of the y channel, in `unit` of the orbit", examples=[(3.2, 4.1)])
    z: tuple[float, ...] = Field(description="samples of the z channel", examples=[(-7.7, -7.1)])


class PlaceOrbit(Record):
    """Orbit at one place."""

    location: str = Field(description="bearing, disc, or another place with two displacements", examples=["bearing"])
    unit: str = Field(description="unit of all lengths: that of the y channel, or m", examples=["um"])
    y: RunningSpeedVector | None = Field(description="y channel at running speed; null without a window")
    z: RunningSpeedVector | None = Field(description="z channel at running speed; null without a window")
    ellipse: OrbitEllipse | None = Field(
        description="ellipse measured in the window, or in `path` at places other than bearing and disc; null if "
        "there is none, see `reason`"
    )
    nominal: OrbitEllipse | None = Field(
        description="ellipse that the unbalance causes on the machine as nominal; null if there is none, see `theory`"
    )
    estimated: OrbitEllipse | None = Field(description="the same for the machine as now estimated")
    path: PathSamples | None = Field(description="samples as measured; null if there are none, see `path_reason`")


class OrbitSnapshot(_OfWindow):
    """Orbits at all places where displacements are measured in both directions."""

    speed_source: Literal["phase reference", "estimated", "unknown"] = Field(
        description="source of the speed; estimated: from the line in the vibration", examples=["phase reference"]
    )
    orbits: tuple[PlaceOrbit, ...] = Field(description="place by place")
    revolutions: int = Field(description="whole revolutions in `path`, 0 without", examples=[8])
    path_start_ns: int | None = Field(
        description="time of the first sample in `path`; null without", examples=[EXAMPLE_NS - 400_000_000]
    )
    pulses_s: tuple[float, ...] = Field(
        description="when the shaft angle was 0, after `path_start_ns`: revolutions + 1 values",
        examples=[(0.0, 0.0455)],
    )
    theory: Theory = Field(description="basis of the predictions")
    reason: str = Field(description="why there is no ellipse; empty if there is", examples=[""])
    path_reason: str = Field(description="why there is no path, or a shorter one; empty otherwise", examples=[""])
    bundle: BundleIdentity
    machine_hash: MachineHash
