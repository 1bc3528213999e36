"""Windows of AC-coupled sensors, or of channels sampled one after the other, are corrected to the vibration itself."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from models.diagnosis.likelihood.lengths import LengthFits
from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.window.equaliser import Equaliser
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine, MachineFile, load_machine
from models.signals.block import FloatArray
from simulator.scenario import Event
from tests.sure import sure
from tests.windows import fed, healthy_samples, statistics

# Velocities behind geophones and AC-coupled inputs; channels one after the other.
SIGNAL: dict[str, dict[str, Any]] = {
    "y1_dot": {"high_pass_hz": 2.0},
    "z1_dot": {"high_pass_hz": 4.5, "high_pass_order": 2},
    "y2": {"delay_us": 250.0},
    "z2": {"high_pass_hz": 0.5, "delay_us": -400.0},
}


def machine(*, declared: bool, without_angle: bool = False) -> Machine:
    fields = load_machine("lab").model_dump() | {"dtype": "float64"}
    fields["sensors"] = [
        sensor | (SIGNAL.get(sensor["name"], {}) if declared else {})
        for sensor in fields["sensors"]
        if not (without_angle and sensor["quantity"] == "shaft_angle")
    ]
    return Machine.model_validate(fields)


@cache
def simulated(*, declared: bool = False, speed_rpm: float | None = None) -> FloatArray:
    changes = () if speed_rpm is None else (Event(at_s=30, speed_rpm=speed_rpm),)
    return healthy_samples(machine(declared=declared), 64.0, 31_301, *changes)


def behind_sensors(samples: FloatArray) -> FloatArray:
    """The samples filtered by the declared responses, circularly as one piece."""
    rate_hz, seen = machine(declared=False).rate_hz, samples.copy()
    f = np.fft.rfftfreq(len(samples), 1 / rate_hz)
    for column, sensor in enumerate(machine(declared=True).sensors):
        signal = SIGNAL.get(sensor.name, {})
        response = np.exp(-2j * np.pi * f * signal.get("delay_us", 0.0) * 1e-6)
        if corner_hz := signal.get("high_pass_hz"):
            s = 1j * f / corner_hz
            response *= s**2 / (1 + np.sqrt(2) * s + s**2) if "high_pass_order" in signal else s / (1 + s)
        seen[:, column] = np.fft.irfft(np.fft.rfft(samples[:, column]) * response, len(samples))
    seen[:, -1] = samples[:, -1]  # the shaft angle
    return seen


def apart(found: WindowStatistics, true: WindowStatistics) -> tuple[float, float, float]:
    """Largest differences relative to the channels' sizes: spectra at their strongest bins, correlations, vectors."""
    density = np.sqrt(np.einsum("fii->fi", true.spectrum).real)
    strong = density > 0.1 * density.max(axis=0)
    both = strong[:, :, np.newaxis] & strong[:, np.newaxis]
    spectra = np.abs(found.spectrum - true.spectrum) / (density[:, :, np.newaxis] * density[:, np.newaxis])
    size = np.sqrt(np.diag(true.correlation[0]))
    correlations = np.abs(found.correlation - true.correlation) / np.outer(size, size)
    vectors = sure(found.rotation_vectors), sure(true.rotation_vectors)
    off = np.abs(vectors[0] - vectors[1]) / np.abs(vectors[1]).max(axis=0)
    return float(spectra[both].max()), float(correlations.max()), float(off.max())


@pytest.mark.parametrize(("without_angle", "speed_rpm"), [(False, None), (False, 1000.0), (True, None)])
def test_declared_responses_are_corrected_in_a_window(without_angle: bool, speed_rpm: float | None) -> None:
    true_machine, declared = (machine(declared=one, without_angle=without_angle) for one in (False, True))
    true = statistics(true_machine, simulated(speed_rpm=speed_rpm))
    seen = behind_sensors(simulated(speed_rpm=speed_rpm))
    assert all(one < 0.06 for one in apart(statistics(declared, seen), true))
    # Responses that are not declared cause large errors.
    assert all(one > 0.1 for one in apart(statistics(true_machine, seen), true))


def test_at_an_unknown_speed_there_is_no_response_and_no_warning() -> None:
    channels = machine(declared=True).sensors[:8]
    found = Equaliser(channels).response(np.array([np.nan, 0.0, 22.0]))
    np.testing.assert_array_equal(found[:2], np.ones((2, 8)))
    assert (np.abs(found[2]) < 1).any()


def test_the_latest_hops_have_the_same_news_behind_declared_responses() -> None:
    samples = healthy_samples(machine(declared=False), 64.0, 31_302)
    for of, seen in ((machine(declared=False), samples), (machine(declared=True), behind_sensors(samples))):
        sliding, fits = fed(plan_for(of), seen), LengthFits(of)
        window = sure(sliding.statistics())
        fits.window(window)
        # Four hops happen to have news here; a response that is not corrected would cause news in all of them.
        assert [fits.has_news(sliding, window, (hops,)) for hops in (2, 4, 6)] == [False, True, False]


def test_the_simulator_applies_the_declared_responses() -> None:
    declared = machine(declared=True)
    found = statistics(declared, simulated(declared=True))
    assert all(one < 0.01 for one in apart(found, statistics(machine(declared=False), simulated())))


def test_declared_responses_prevent_findings_of_disagreeing_sensors() -> None:
    undeclared, declared = (machine(declared=one) for one in (False, True))
    seen = behind_sensors(simulated())
    assert sensor_findings(statistics(declared, seen), None, declared.sensors) == ()
    findings = sensor_findings(statistics(undeclared, seen), None, undeclared.sensors)
    assert any("state corner and order of its data sheet as high_pass_hz" in one.text for one in findings)


def test_declared_responses_leave_descriptor_and_other_machine_files_as_they_are() -> None:
    undeclared, declared = (machine(declared=one) for one in (False, True))
    assert declared.descriptor == undeclared.descriptor
    assert not {"high_pass", "delay_us"} & set(undeclared.model_dump_json().split('"'))
    assert plan_for(undeclared).equaliser is None
    assert Machine.model_validate(declared.model_dump()) == declared


@pytest.mark.parametrize(
    ("name", "signal", "says"),
    [
        ("y1", {"high_pass_order": 2}, "y1: high_pass_order is 2 without high_pass_hz, its corner"),
        ("y1", {"high_pass_hz": 2.0, "high_pass_order": 3}, "high_pass_order"),
        ("theta", {"high_pass_hz": 2.0}, "theta: high_pass_hz is given, but this measures shaft_angle"),
        ("theta", {"delay_us": 20.0}, "theta: delay_us is given, but this measures shaft_angle"),
        ("y1", {"high_pass_hz": 1000.0}, "y1: high_pass_hz is 1000, expected below half of rate_hz"),
        ("y1", {"delay_us": -30_000.0}, "delay_us"),
        (
            "y1_dot",
            {"high_pass_hz": 10.0},
            "y1_dot: high_pass_hz is 10, expected at most twice the lowest frequency of window.band_hz, 3 Hz: "
            ".*let the band begin at 5 Hz or above",
        ),
    ],
)
def test_invalid_sensor_responses_are_refused(name: str, signal: dict[str, Any], says: str) -> None:
    fields = load_machine("lab").model_dump()
    fields["sensors"] = [one | (signal if one["name"] == name else {}) for one in fields["sensors"]]
    with pytest.raises(ValidationError, match=says):
        MachineFile.model_validate(fields)


def test_hum_is_removed_behind_declared_responses_too() -> None:
    true_machine, declared = (machine(declared=one) for one in (False, True))
    hummed = simulated().copy()
    t_s = np.arange(len(hummed)) / true_machine.rate_hz
    for column, sensor in enumerate(true_machine.sensors):
        if sensor.quantity != "shaft_angle":
            hummed[:, column] += 0.3 * hummed[:, column].std() * np.cos(2 * np.pi * 50.0 * t_s + column)
    clean, true = statistics(true_machine, simulated()), statistics(true_machine, hummed)
    found = statistics(declared, behind_sensors(hummed))
    assert true.without_lines is not true
    for one in (true, found):
        assert apart(one.without_lines, clean)[1] < 0.005 < apart(one, clean)[1]
