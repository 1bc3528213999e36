"""Sensors: units, columns, noise level and colour, and each fault."""

import numpy as np
import numpy.typing as npt
import pytest

from models.machine import Machine, load_machine
from models.physics.rotor import STATES
from models.signals.block import FloatArray
from models.signals.channels import Sensor
from simulator.plant import PlantSamples
from simulator.scenario import ChannelSettings, Sensors, SensorSettings
from simulator.sensors import SensorBank, SimulatedSensor
from simulator.timeline import SensorFaults

RATE_HZ = 2000.0
DISPLACEMENT = Sensor(name="XE", quantity="displacement", location="bearing", direction="y", unit="um")


def _sensor(settings: SensorSettings, seed: int = 0, rms_SI: float = 1e-5) -> SimulatedSensor:
    return SimulatedSensor(DISPLACEMENT, settings, rms_SI, RATE_HZ, np.random.default_rng(seed))


def _machine(*channels: dict[str, str], dtype: str = "float64") -> Machine:
    sensors = tuple(Sensor.model_validate(channel) for channel in channels)
    return load_machine("lab").model_copy(update={"sensors": sensors, "dtype": dtype})


def _bank(
    machine: Machine, sensors: Sensors, faults: dict[str, list[tuple[int, SensorFaults]]] | None = None
) -> SensorBank:
    rngs = [np.random.default_rng(seed) for seed in range(len(machine.sensors))]
    return SensorBank(machine, sensors, np.eye(12) * 1e-10, faults or {}, rngs)


def _plant(n_samples: int = 50) -> PlantSamples:
    states = 1e-6 * (np.arange(12)[None, :] + 0.01 * np.arange(n_samples)[:, None])
    return PlantSamples(states, np.linspace(0, 2 * np.pi, n_samples, endpoint=False))


TILT = {"name": "T", "quantity": "tilt", "location": "disc", "direction": "z", "unit": "mrad"}
TILT_RATE = {"name": "R", "quantity": "tilt_rate", "location": "disc", "direction": "y", "unit": "rad/s"}
VELOCITY = {"name": "V", "quantity": "velocity", "location": "disc", "direction": "z", "unit": "in/s"}
ANGLE = {"name": "A", "quantity": "shaft_angle", "location": "shaft", "direction": "rotation", "unit": "rad"}


def test_channels_come_in_the_file_order_in_their_units() -> None:
    plant = _plant()
    samples = _bank(_machine(ANGLE, VELOCITY, TILT, TILT_RATE), Sensors()).measure(plant, 0)
    z2_dot, phi, psi_dot = (plant.states[:, STATES.index(name)] for name in ("z2_dot", "phi", "psi_dot"))
    expected = np.column_stack([plant.theta_rad, z2_dot / 0.0254, phi * 1e3, psi_dot])
    np.testing.assert_allclose(samples, expected, rtol=1e-12)
    assert samples.dtype == np.float64
    assert _bank(_machine(ANGLE, dtype="float32"), Sensors()).measure(plant, 0).dtype == np.float32


@pytest.mark.parametrize("corner_hz", [None, 30.0, 300.0])
def test_noise_has_the_level_and_the_colour_asked_for(corner_hz: float | None) -> None:
    n_samples = 200_000
    sensor = _sensor(SensorSettings(noise_relative=0.02, noise_corner_hz=corner_hz))
    pieces = [sensor.measure(np.zeros(1000), sensor.noise(1000), {}) for _ in range(n_samples // 1000)]
    noise = np.concatenate(pieces) * 1e-6
    memory = 0.0 if corner_hz is None else float(np.exp(-2 * np.pi * corner_hz / RATE_HZ))
    # Effective number of independent squares of first-order noise is n (1 - a²) / (1 + a²).
    spread = np.sqrt(2 / n_samples * (1 + memory**2) / (1 - memory**2))
    assert noise.var() / (0.02 * 1e-5) ** 2 == pytest.approx(1.0, abs=5 * spread)
    for lag in (1, 2, 5):
        correlation = noise[lag:] @ noise[:-lag] / (noise @ noise)
        assert correlation == pytest.approx(memory**lag, abs=5 * np.sqrt((1 + memory**2) / (1 - memory**2) / n_samples))


def test_noise_is_stationary_from_the_first_sample() -> None:
    settings = SensorSettings(noise_relative=1.0, noise_corner_hz=10.0)
    first = np.array([_sensor(settings, seed).noise(1)[0] for seed in range(1000)])
    assert first.var() == pytest.approx(1.0, rel=5 * np.sqrt(2 / 1000))  # one innovation alone would have 0.06


def test_noise_does_not_depend_on_how_it_is_split() -> None:
    settings = SensorSettings(noise_corner_hz=100.0)
    whole = _sensor(settings).noise(1000)
    sensor = _sensor(settings)
    np.testing.assert_allclose(np.concatenate([sensor.noise(n) for n in (1, 500, 499)]), whole, rtol=1e-12, atol=1e-14)


def test_settings_act_in_order() -> None:
    sensor = _sensor(SensorSettings(gain=2.0, offset_SI=1e-4, step_SI=3e-6))
    samples = sensor.measure(np.array([0.0, 1e-6, 3e-6]), np.zeros(3), {})
    np.testing.assert_allclose(samples, [99.0, 102.0, 105.0], rtol=1e-12)  # 100, 102, 106 um on steps of 3 um


VALUES = np.array([-3e-6, 1e-6, 5e-6])


@pytest.mark.parametrize(
    ("faults", "expected"),
    [
        ({}, [-3.0, 1.0, 5.0]), ({"offset": 2e-6}, [-1.0, 3.0, 7.0]), ({"gain": 0.5}, [-1.5, 0.5, 2.5]),
        ({"offset": 2e-6, "gain": 0.5}, [0.5, 2.5, 4.5]), ({"clip": 2e-6}, [-2.0, 1.0, 2.0]),
        ({"clip": 0.0}, [0.0, 0.0, 0.0]), ({"noise_relative": 0.1}, [-2.0, 0.0, 6.0]),
        ({"stuck": None}, [7.0, 7.0, 7.0]), ({"stuck": None, "dropout": None}, [np.nan, np.nan, np.nan]),
        ({"dropout": None}, [np.nan, np.nan, np.nan]),
    ],
    ids=lambda value: "+".join(value) or "healthy" if isinstance(value, dict) else "",
)  # fmt: skip
def test_each_sensor_fault_changes_the_samples(faults: SensorFaults, expected: list[float]) -> None:
    sensor = _sensor(SensorSettings())
    sensor.measure(np.array([7e-6]), np.zeros(1), {})  # what a stuck sensor repeats
    samples = sensor.measure(VALUES, np.array([1.0, -1.0, 1.0]), faults)
    np.testing.assert_allclose(samples, expected, rtol=1e-12, atol=1e-12)


def test_a_stuck_sensor_holds_until_it_is_released() -> None:
    sensor = _sensor(SensorSettings())
    stuck: SensorFaults = {"stuck": None}
    zero = np.zeros(3)
    np.testing.assert_allclose(sensor.measure(VALUES, zero, stuck), -3.0)  # from the first sample on: its own
    np.testing.assert_allclose(sensor.measure(VALUES, zero, {}), VALUES * 1e6)
    np.testing.assert_allclose(sensor.measure(2 * VALUES, zero, stuck), 5.0)
    np.testing.assert_allclose(sensor.measure(3 * VALUES, zero, stuck), 5.0)
    np.testing.assert_allclose(sensor.measure(VALUES, zero, {}), VALUES * 1e6)


def test_noise_is_drawn_even_before_it_is_used() -> None:
    """A sensor whose noise begins later has the noise it would have had anyway."""
    channel = DISPLACEMENT.model_dump()
    noisy = _bank(_machine(channel), Sensors(noise_relative=0.1)).measure(_plant(), 0)
    later = _bank(_machine(channel), Sensors(), {"XE": [(20, {"noise_relative": 0.1})]}).measure(_plant(), 0)
    np.testing.assert_array_equal(later[20:], noisy[20:])
    assert not np.any(later[:20] == noisy[:20])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_shaft_angle_stays_below_one_revolution(dtype: str) -> None:
    just_below = np.nextafter(2 * np.pi, 0)  # float32 rounds it up to a number above 2π
    theta = np.array([0.0, 1.0, just_below])
    plant = PlantSamples(np.zeros((3, 12)), theta)
    just_before = Sensors(channels={"A": ChannelSettings(offset_SI=-1e-20)})  # the remainder of -1e-20 rounds up to 2π
    for sensors in (Sensors(), just_before):
        samples = _bank(_machine(ANGLE, dtype=dtype), sensors).measure(plant, 0)[:, 0]
        assert np.all((samples >= 0) & (samples.astype(np.float64) < 2 * np.pi))
        assert samples[1] == 1.0


def test_a_shaft_angle_with_errors_wraps() -> None:
    sensors = Sensors(channels={"A": ChannelSettings(noise_relative=0.01, offset_SI=-0.5)})
    theta: npt.NDArray[np.float64] = np.tile(np.linspace(0, 6.28, 100), 100)
    samples: FloatArray = np.asarray(
        _bank(_machine(ANGLE), sensors).measure(PlantSamples(np.zeros((10_000, 12)), theta), 0)[:, 0], dtype=np.float64
    )
    assert np.all((samples >= 0) & (samples < 2 * np.pi))
    error = np.angle(np.exp(1j * (samples - theta + 0.5)))
    assert error.std() == pytest.approx(0.01 * 2 * np.pi, rel=5 / np.sqrt(2 * 10_000))


@pytest.mark.parametrize("pieces", [(60,), (7, 1, 30, 22)])
def test_a_delay_shifts_by_whole_samples_however_it_is_split(pieces: tuple[int, ...]) -> None:
    channel = DISPLACEMENT.model_dump()
    faults: dict[str, list[tuple[int, SensorFaults]]] = {"XE": [(20, {"delay": 0.0051}), (50, {})]}  # 10.2 samples
    bank, plant, first, seen = _bank(_machine(channel), Sensors(), faults), _plant(60), 0, []
    for count in pieces:
        part = slice(first, first + count)
        seen.append(bank.measure(PlantSamples(plant.states[part], plant.theta_rad[part]), first)[:, 0])
        first += count
    true = plant.states[:, 0] * 1e6
    expected = np.concatenate([true[:20], true[10:40], true[50:]])
    np.testing.assert_allclose(np.concatenate(seen), expected, rtol=1e-12, atol=1e-12)


def test_a_delay_from_the_start_repeats_the_first_value() -> None:
    faults: dict[str, list[tuple[int, SensorFaults]]] = {"XE": [(0, {"delay": 0.001})]}
    plant = _plant(6)
    seen = _bank(_machine(DISPLACEMENT.model_dump()), Sensors(), faults).measure(plant, 0)[:, 0]
    np.testing.assert_allclose(seen, plant.states[[0, 0, 0, 1, 2, 3], 0] * 1e6, rtol=1e-12, atol=1e-12)


def test_swapped_channels_exchange_places_with_their_errors() -> None:
    channel = DISPLACEMENT.model_dump()
    machine = _machine(channel, {**channel, "name": "ZE", "direction": "z"})
    sensors = Sensors(noise_relative=0.1, channels={"ZE": ChannelSettings(gain=3.0)})
    straight = _bank(machine, sensors).measure(_plant(), 0)
    crossed = _bank(machine, sensors, {"XE": [(20, {"swapped with ZE": None}), (40, {})]}).measure(_plant(), 0)
    np.testing.assert_array_equal(crossed[20:40], straight[20:40, ::-1])
    np.testing.assert_array_equal(crossed[:20], straight[:20])
    np.testing.assert_array_equal(crossed[40:], straight[40:])
