"""Accelerometers alone: the likelihood reads them as velocities in its band."""

import numpy as np
import pytest

from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.likelihood.motions import integrated
from models.diagnosis.window import WindowStatistics
from models.machine import Machine
from models.signals.block import FloatArray
from models.signals.channels import Channel, Quantity
from tests.commissioning.rotor_kit import LAB, recording, samples_of, stream, with_samples

SEED = 63


def accelerometers() -> Machine:
    """The rotor kit with accelerometers in place of its velocity sensors, and no displacement."""
    sensors = []
    for channel in LAB.sensors:
        if channel.quantity is Quantity.VELOCITY:
            fields = channel.model_dump() | {"quantity": "acceleration", "unit": "m/s2"}
            sensors.append(Channel.model_validate(fields))
        elif channel.quantity is Quantity.SHAFT_ANGLE:
            sensors.append(channel)
    return LAB.model_copy(update={"sensors": tuple(sensors)})


def differentiated(samples: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Velocities in mm/s as accelerations in m/s² with half a per cent of white noise, by a Fourier transform."""
    columns = [n for n, channel in enumerate(LAB.sensors) if channel.quantity is Quantity.VELOCITY]
    spectra = np.fft.rfft(samples[:, columns] * 1e-3, axis=0)
    w = 2 * np.pi * np.fft.rfftfreq(samples.shape[0], 1 / LAB.rate_hz)
    w[w > 2 * np.pi * 400] = 0  # sensor noise of the velocities, which an accelerometer does not have
    a = np.fft.irfft(1j * w[:, None] * spectra, n=samples.shape[0], axis=0)
    a += 0.005 * a.std(axis=0) * rng.standard_normal(a.shape)
    return np.column_stack([a, samples[:, -1]])


@pytest.fixture(scope="module")
def window() -> WindowStatistics:
    blocks = stream(70.0, SEED)
    samples = differentiated(samples_of(blocks), np.random.default_rng(SEED))
    return recording(accelerometers(), with_samples(blocks, samples)).windows()[0]


def test_accelerations_become_velocities(window: WindowStatistics) -> None:
    found = integrated(window)
    assert found.states == ("y1_dot", "y2_dot", "z1_dot", "z2_dot")
    true = recording(LAB, stream(70.0, SEED)).windows()[0]
    at = [true.states.index(name) for name in found.states]
    inside = true.frequencies_hz > 10
    ratio = found.spectrum[inside].real.diagonal(axis1=1, axis2=2) / (true.spectrum[inside][:, at, at].real)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)
    assert found.synchronous is not None
    assert true.synchronous is not None
    np.testing.assert_allclose(found.synchronous, true.synchronous[at], rtol=0.02)
    assert integrated(true) is true


def test_the_likelihood_reads_a_healthy_machine_from_accelerometers_alone(window: WindowStatistics) -> None:
    diagnosis = LikelihoodFit(accelerometers()).diagnose(window)
    assert len(diagnosis.evaluable) == 6
    for reading in diagnosis.evaluable:
        assert reading.z is not None
        assert abs(reading.z) < 4, reading
        assert reading.standard_error is not None
        assert reading.standard_error < 0.05
