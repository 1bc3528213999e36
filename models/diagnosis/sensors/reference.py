"""How the sensors of a machine were when it was healthy: levels, and how the two sensors of each motion compare.

Sensors disagree from the start, by a few per cent in gain and by the delay of their own filters. What counts later is
the change.
"""

from collections.abc import Sequence
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from models.diagnosis.pairs import motion_pairs
from models.diagnosis.sensors.kinematics import PairReading, banded, read_pair, same
from models.diagnosis.sensors.unshared import ChannelNoise, PairNoise, channel_noise, pair_noise, single
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.signals.block import FloatArray

__all__ = ["ChannelReference", "NoiseReference", "PairReference", "SensorReference", "learn_sensor_reference"]

_STRICT = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class NoiseReference(BaseModel):
    """Noise on the healthy machine, mean over the windows, in the bands of `models.diagnosis.sensors.unshared`."""

    model_config = _STRICT

    density: tuple[Annotated[float, Field(gt=0)], ...] = Field(description="two-sided, SI²/Hz")
    share: tuple[Annotated[float, Field(gt=0)], ...] = Field(description="over the channels' own mean squares, 1/Hz")
    line_rms: float = Field(default=0.0, ge=0, description="strongest line that one channel alone shows, SI")

    @model_validator(mode="after")
    def _as_many(self) -> Self:
        if len(self.density) != len(self.share):
            raise ValueError(f"density holds {len(self.density)} bands and share {len(self.share)}, expected as many")
        return self


class _WithNoise(BaseModel):
    """A reference that may be older than the check of noise; then it is written as it was read."""

    model_config = _STRICT

    noise: NoiseReference | None = Field(default=None, description="None where it was not learned")

    @model_serializer(mode="wrap")
    def _as_read(self, handler: SerializerFunctionWrapHandler) -> dict[str, object]:
        content: dict[str, object] = handler(self)
        if self.noise is None:
            content.pop("noise", None)
        return content


class ChannelReference(_WithNoise):
    """One channel on the healthy machine, SI units."""

    state: str = Field(description="what it measures")
    mean: float = Field(description="mean of the samples")
    mean_spread: float = Field(ge=0, description="standard deviation of a hop's mean about it")
    rms: float = Field(ge=0, description="root mean square about the mean")
    rotation: float | None = Field(default=None, ge=0, description="amplitude of the rotation-synchronous part")
    rotation_spread: float | None = Field(default=None, ge=0, description="its relative standard deviation")


class PairReference(_WithNoise):
    """Two sensors of one motion on the healthy machine."""

    first: str
    second: str
    log_gain: float = Field(description="logarithm of the second's gain over the first's")
    log_gain_spread: float = Field(ge=0, description="standard deviation of one more window about it, its own aside")
    polarity: int = Field(ge=-1, le=1)
    delay_s: float = Field(description="by how much the second comes later")
    delay_spread_s: float = Field(ge=0)
    shared: float = Field(ge=0, le=1, description="how much of the motion they share at the best delay")
    same: float = Field(ge=-1, le=1, description="how much of it they show alike, at the same time and size")


class SensorReference(BaseModel):
    """What healthy windows say of the sensors; as JSON it comes back bit for bit.

    Attributes
    ----------
    n_windows, n_hops : int
        Healthy windows it was learned from, and the hops in them.
    speed_rad_s : float or None
        Mean speed in them.
    """

    model_config = _STRICT

    n_windows: int = Field(ge=1)
    n_hops: int = Field(ge=1)
    speed_rad_s: float | None = None
    channels: tuple[ChannelReference, ...]
    pairs: tuple[PairReference, ...]

    @model_validator(mode="after")
    def _known(self) -> "SensorReference":
        known = {channel.state for channel in self.channels}
        for pair in self.pairs:
            strange = {pair.first, pair.second} - known
            if strange:
                raise ValueError(f"pairs: {', '.join(sorted(strange))} not among channels ({', '.join(sorted(known))})")
        return self

    def channel(self, state: str) -> ChannelReference | None:
        """One channel, or None if it was not there."""
        return next((channel for channel in self.channels if channel.state == state), None)

    def pair(self, first: str, second: str) -> PairReference | None:
        """Two sensors of one motion, or None if they were not there."""
        return next((pair for pair in self.pairs if (pair.first, pair.second) == (first, second)), None)


def learn_sensor_reference(windows: Sequence[WindowStatistics]) -> SensorReference:
    """Learn from healthy windows that do not overlap.

    Raises
    ------
    EstimationError
        If there is no window, or a channel shows no fluctuation in one.
    """
    if not windows:
        raise EstimationError("no healthy window to learn the sensors from")
    states = windows[0].states
    for window in windows:
        if window.states != states:
            raise EstimationError(
                f"healthy windows hold different channels: {', '.join(states)} and {', '.join(window.states)}"
            )
    pairs = []
    for pair in motion_pairs(states):
        bands = [banded(window, pair) for window in windows]
        readings = [read_pair(window, pair, own) for window, own in zip(windows, bands, strict=True)]
        there = [reading for reading in readings if reading is not None]
        if len(there) < len(readings):
            raise EstimationError(f"no fluctuation in {states[pair.first]} or {states[pair.second]}")
        noises = [pair_noise(window, own, one) for window, own, one in zip(windows, bands, there, strict=True)]
        pairs.append(_pair(states, there, min(same(own) for own in bands), _noise(noises)))
    alone = [channel_noise(window, single(states)) for window in windows]
    noise = {each[0].column: _noise(each) for each in zip(*alone, strict=False)}
    speeds = np.concatenate([window.hop_speed_rad_s for window in windows])
    return SensorReference(
        n_windows=len(windows),
        n_hops=sum(len(window.waveforms) for window in windows),
        speed_rad_s=float(speeds.mean()) if np.all(np.isfinite(speeds)) else None,
        channels=tuple(_channel(windows, column, noise.get(column)) for column in range(len(states))),
        pairs=tuple(pairs),
    )


def _noise(noises: Sequence[PairNoise | ChannelNoise]) -> NoiseReference | None:
    """Mean of the windows' noise."""
    density = np.mean([one.noise if isinstance(one, PairNoise) else one.density for one in noises], axis=0)
    share = np.mean([one.share for one in noises], axis=0)
    if not (np.all(density > 0) and np.all(share > 0) and np.all(np.isfinite(share))):
        return None
    return NoiseReference(
        density=tuple(density.tolist()),
        share=tuple(share.tolist()),
        line_rms=max(one.line_rms if isinstance(one, ChannelNoise) else 0.0 for one in noises),
    )


def _channel(windows: Sequence[WindowStatistics], column: int, noise: NoiseReference | None = None) -> ChannelReference:
    means = np.concatenate([window.hop_waveform.mean[:, column] for window in windows])
    squares = np.concatenate([window.hop_waveform.rms[:, column] ** 2 for window in windows])
    rotation = rotation_spread = None
    vectors = [window.rotation_vectors for window in windows]
    known = [np.abs(each[:, column]) for each in vectors if each is not None]
    if len(known) == len(windows):
        sizes = np.concatenate(known)
        rotation = float(sizes.mean())
        rotation_spread = float(sizes.std() / max(rotation, np.finfo(float).tiny))
    return ChannelReference(
        state=windows[0].states[column],
        mean=float(means.mean()),
        mean_spread=float(means.std()),
        rms=float(np.sqrt(squares.mean())),
        rotation=rotation,
        rotation_spread=rotation_spread,
        noise=noise,
    )


def _pair(
    states: tuple[str, ...], readings: list[PairReading], least_same: float, noise: NoiseReference | None
) -> PairReference:
    """Mean of the windows' readings; the spread is their scatter beyond their own errors, and the mean's error."""
    gains = np.array([reading.log_gain for reading in readings])
    delays = np.array([reading.delay_s for reading in readings])
    gain_errors = np.array([reading.log_gain_error for reading in readings])
    delay_errors = np.array([reading.delay_error_s for reading in readings])
    pair = readings[0].pair
    return PairReference(
        first=states[pair.first],
        second=states[pair.second],
        log_gain=float(gains.mean()),
        log_gain_spread=_spread(gains, gain_errors),
        polarity=1 if sum(reading.polarity for reading in readings) >= 0 else -1,
        delay_s=float(delays.mean()),
        delay_spread_s=_spread(delays, delay_errors),
        shared=min(reading.shared for reading in readings),
        same=least_same,
        noise=noise,
    )


def _spread(values: FloatArray, errors: FloatArray) -> float:
    own = float(np.mean(errors**2))
    n = len(values)
    scatter = float(values.var(ddof=1)) if n > 1 else own
    return float(np.sqrt(max(scatter - own, 0.0) + max(scatter, own) / n))
