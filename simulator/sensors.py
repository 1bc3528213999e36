"""Sensors: from rotor states and shaft angle to samples in the channel's unit, with noise, errors and faults."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from itertools import pairwise
from operator import itemgetter

import numpy as np
import numpy.typing as npt
import scipy.signal

from models.machine import Machine
from models.physics.rotor import STATE_INDEX
from models.signals.block import FloatArray, SampleArray
from models.signals.channels import Channel, Quantity, Sensor, parts_seen
from simulator.plant import PlantSamples
from simulator.scenario import Sensors, SensorSettings
from simulator.timeline import SWAPPED_WITH, SensorFaults

_TURN = 2 * np.pi
_NO_FAULT: SensorFaults = {}
_AHEAD = 8192


class SimulatedSensor:
    """One channel: (value + noise) · gain + offset, clipped, rounded to a step, in the channel's unit.

    The value passes the high-pass and the delay of the machine file. A delay that is a fault shifts it by the nearest
    whole number of samples; before the first sample the value is taken as constant.

    ``noise_relative`` refers to `rms_SI`: the channel's own theoretical rms, one revolution for a shaft angle. `late_s`
    is the delay in the machine file, counted so that no sensor is early. `rng` belongs to this sensor alone, and
    one number per sample is drawn whatever the settings are, so that a noise level can change without the noise.
    """

    def __init__(
        self,
        channel: Sensor,
        settings: SensorSettings,
        rms_SI: float,
        rate_hz: float,
        rng: np.random.Generator,
        longest_delay_s: float = 0.0,
        late_s: float = 0.0,
    ) -> None:
        self.channel = channel
        self._settings = settings
        self._rms_SI = rms_SI
        self._rng = rng
        corner_hz = settings.noise_corner_hz
        self._memory = 0.0 if corner_hz is None else float(np.exp(-2 * np.pi * corner_hz / rate_hz))
        self._noise: float | None = None
        self._ahead: FloatArray = np.empty(0)
        self._last_value: float | None = None
        self._rate_hz, self._reach = rate_hz, round(longest_delay_s * rate_hz)
        self._past: FloatArray | None = None
        angle = channel.quantity is Quantity.SHAFT_ANGLE
        self._filter = None if angle else _sections(channel, rate_hz, late_s)
        self.late = late_s * rate_hz  # samples
        self._filtered: FloatArray | None = None  # its state

    def noise(self, n_samples: int) -> FloatArray:
        """Take the next samples of noise of unit variance (white or exact first-order), shape (n_samples,)."""
        if self._ahead.size < n_samples:  # a filter takes as long to be set up as for thousands of samples
            self._ahead = np.concatenate([self._ahead, self._draw_noise(max(n_samples - self._ahead.size, _AHEAD))])
        taken, self._ahead = self._ahead[:n_samples], self._ahead[n_samples:]
        return taken

    def _draw_noise(self, n_samples: int) -> FloatArray:
        white = self._rng.standard_normal(n_samples)
        if self._memory == 0:
            return white
        innovation = float(np.sqrt(1 - self._memory**2))
        # Stationary from the first sample on, which has the full variance instead of that of one innovation.
        carried = white[0] * (1 - innovation) if self._noise is None else self._memory * self._noise
        coloured, _ = scipy.signal.lfilter([innovation], [1.0, -self._memory], white, zi=[carried])
        self._noise = float(coloured[-1])
        return np.asarray(coloured, dtype=np.float64)

    def measure(self, value_SI: FloatArray, noise: FloatArray, faults: SensorFaults) -> FloatArray:
        """Turn true values, while the same faults are active, into samples in the channel's unit; NaN in a dropout."""
        settings = self._settings
        level = _value(faults, "noise_relative", settings.noise_relative) * self._rms_SI
        seen = self._delayed(self._pass_filter(value_SI), round(_value(faults, "delay", 0.0) * self._rate_hz))
        seen = seen + level * noise
        seen = seen * settings.gain * _value(faults, "gain", 1.0) + settings.offset_SI + _value(faults, "offset", 0.0)
        if "clip" in faults:
            limit = _value(faults, "clip", np.inf)
            seen = np.clip(seen, -limit, limit)
        if settings.step_SI > 0:
            seen = np.round(seen / settings.step_SI) * settings.step_SI
        if "stuck" in faults:
            seen = np.full_like(seen, seen[0] if self._last_value is None else self._last_value)
        self._last_value = float(seen[-1])
        if "dropout" in faults:
            return np.full_like(seen, np.nan)
        return np.asarray(seen / self.channel.to_si, dtype=np.float64)

    def _pass_filter(self, value_SI: FloatArray) -> FloatArray:
        """Pass values through the high-pass and the delay of the file, as if constant before the first sample."""
        if self._filter is None:
            return value_SI
        if self._filtered is None:
            self._filtered = scipy.signal.sosfilt_zi(self._filter) * value_SI[0]
        passed, self._filtered = scipy.signal.sosfilt(self._filter, value_SI, zi=self._filtered)
        return np.asarray(passed, dtype=np.float64)

    def _delayed(self, value_SI: FloatArray, late: int) -> FloatArray:
        """Values `late` samples earlier."""
        if self._reach == 0:
            return value_SI
        past = np.full(self._reach, value_SI[0]) if self._past is None else self._past
        known = np.concatenate([past, value_SI])
        self._past = known[-self._reach :]
        return known[self._reach - late : known.size - late]


class SensorBank:
    """All channels of a machine, in the order of its file; `moments` are those of `theoretical_moments`."""

    def __init__(
        self,
        machine: Machine,
        sensors: Sensors,
        moments: FloatArray,
        faults: Mapping[str, Sequence[tuple[int, SensorFaults]]],
        rngs: Sequence[np.random.Generator],
    ) -> None:
        self._dtype = np.dtype(machine.dtype)
        first_us = min(0.0, *(one.delay_us or 0.0 for one in machine.sensors))
        self._faults = faults
        self._sensors = []
        for channel, rng in zip(machine.sensors, rngs, strict=True):
            settings, rms_SI = sensors.settings(channel), _reference(channel, moments)
            longest_s = max((_value(kinds, "delay", 0.0) for _, kinds in faults.get(channel.name, ())), default=0.0)
            late_s = ((channel.delay_us or 0.0) - first_us) * 1e-6
            self._sensors.append(SimulatedSensor(channel, settings, rms_SI, machine.rate_hz, rng, longest_s, late_s))

    def measure(self, plant: PlantSamples, first: int) -> SampleArray:
        """Return all channels of consecutive plant samples; shape (n_samples, n_channels), the machine's dtype."""
        n_samples = plant.theta_rad.size
        samples = np.empty((n_samples, len(self._sensors)), dtype=self._dtype)
        for column, sensor in enumerate(self._sensors):
            angle = sensor.channel.quantity is Quantity.SHAFT_ANGLE
            value = _delayed_angle(plant.theta_rad, sensor.late) if angle else _measured(sensor.channel, plant.states)
            noise = sensor.noise(n_samples)
            for begin, end, faults in self._stretches(sensor.channel.name, first, n_samples):
                samples[begin:end, column] = sensor.measure(value[begin:end], noise[begin:end], faults)
            if angle:
                samples[:, column] = _wrapped(samples[:, column])
        self._swap(samples, first)
        return samples

    def _swap(self, samples: npt.NDArray[np.floating], first: int) -> None:
        """Exchange columns whose channels are swapped."""
        column = {sensor.channel.name: number for number, sensor in enumerate(self._sensors)}
        for name, own in column.items():
            for begin, end, faults in self._stretches(name, first, len(samples)):
                for kind in faults:
                    if kind.startswith(SWAPPED_WITH):
                        other = column[kind.removeprefix(SWAPPED_WITH)]
                        samples[begin:end, [own, other]] = samples[begin:end, [other, own]]

    def faults_at(self, sample: int) -> dict[str, SensorFaults]:
        """Active faults by channel name at a sample; channels without any are left out."""
        active = {name: _in_force(states, sample) for name, states in self._faults.items()}
        return {name: faults for name, faults in active.items() if faults}

    def _stretches(self, name: str, first: int, n_samples: int) -> list[tuple[int, int, SensorFaults]]:
        """Rows during which one channel's faults stay the same."""
        states = self._faults.get(name, ())
        if not states:
            return [(0, n_samples, _NO_FAULT)]
        begin, end = (bisect_right(states, sample, key=itemgetter(0)) for sample in (first, first + n_samples - 1))
        cuts = [0, *(sample - first for sample, _ in states[begin:end]), n_samples]
        return [(begin, end, _in_force(states, first + begin)) for begin, end in pairwise(cuts)]


def _delayed_angle(angle_rad: FloatArray, late: float) -> FloatArray:
    """Shaft angle `late` samples earlier, extrapolated at the present speed."""
    if not late or angle_rad.size < 2:
        return angle_rad
    return np.asarray(angle_rad - late * np.gradient(np.unwrap(angle_rad)))


def _sections(sensor: Sensor, rate_hz: float, late_s: float) -> FloatArray | None:
    """Second-order sections of a sensor's high-pass and delay; None without either.

    The part of a delay below a sample is a Thiran all-pass of first order (Laakso et al., IEEE Signal Processing
    Magazine 13(1), 1996): its delay is right at low frequencies, within 1 % up to a twentieth of the sampling rate.
    """
    found = []
    if sensor.high_pass_hz is not None:
        found.append(
            scipy.signal.butter(sensor.high_pass_order or 1, sensor.high_pass_hz, "high", fs=rate_hz, output="sos")
        )
    late = late_s * rate_hz
    if late > 0:
        whole = max(0, round(late - 1))
        part = (1 - (late - whole)) / (1 + (late - whole))
        found += [np.array([[0.0, 1.0, 0.0, 1.0, 0.0, 0.0]])] * whole
        found.append(np.array([[part, 1.0, 0.0, 1.0, part, 0.0]]))
    return np.concatenate(found) if found else None


def _in_force(states: Sequence[tuple[int, SensorFaults]], sample: int) -> SensorFaults:
    past = bisect_right(states, sample, key=itemgetter(0))
    return states[past - 1][1] if past else _NO_FAULT


def _value(faults: SensorFaults, kind: str, otherwise: float) -> float:
    value = faults.get(kind)
    return otherwise if value is None else value


def _measured(channel: Channel, states: FloatArray) -> FloatArray:
    """What a channel measures of states, shape (..., 12); channels at an angle measure two of them."""
    parts = [(STATE_INDEX[state], part) for state, part in parts_seen(channel).items()]
    if len(parts) == 1:
        return states[..., parts[0][0]]
    return np.asarray(sum(part * states[..., column] for column, part in parts), dtype=np.float64)


def _reference(channel: Channel, moments: FloatArray) -> float:
    if channel.quantity is Quantity.SHAFT_ANGLE:
        return _TURN
    return float(np.sqrt(_measured(channel, _measured(channel, moments))))


def _wrapped(angle: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Wrap angles into [0, 2π); a remainder that rounds up to 2π, as for an angle just below 0, becomes 0."""
    wrapped = np.mod(angle, _TURN)
    return np.where(wrapped >= _TURN, 0.0, wrapped)
