"""Likelihood readings of the unbalance vector, at varying speed, and from accelerometers alone."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.likelihood.motions import integrated
from models.diagnosis.readings import Diagnosis, UnbalanceVector, parameter_reading
from models.diagnosis.verdict.isolation import isolate_window, reading_of
from models.diagnosis.verdict.stretch import stretch_of
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine, load_machine
from models.signals.block import FloatArray
from models.signals.channels import Quantity, Sensor
from rotorwatch.records.windows import Parameter
from simulator.scenario import Event
from simulator.stream import blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, simulate_window
from tests.commissioning.rotor_kit import LAB, recording, samples_of, stream, windows_of, with_samples
from tests.sure import sure
from tests.windows import statistics

SEED = 7_700_021
MACHINE = load_machine("lab")


@cache
def drawn(number: int, e: float = 0.0, layout: Layout = Layout.INDEPENDENT) -> WindowStatistics:
    return simulate_window(Draw(MACHINE, SEED, Purpose.EVALUATION, 0, faults={"e": e}, layout=layout), number)


def turned(window: WindowStatistics, degrees: float) -> WindowStatistics:
    """The window with the heavy spot turned: its 1x vectors lead by that much more."""
    turn, hops = np.exp(1j * np.radians(degrees)), sure(window.hop_synchronous)
    return replace(window, synchronous=turn * sure(window.synchronous), hop_synchronous=turn * hops)


def e_of(window: WindowStatistics) -> tuple[Parameter, UnbalanceVector]:
    diagnosis = LikelihoodFit(MACHINE).diagnose(window)
    return diagnosis.parameters[-1], sure(diagnosis.unbalance)


@pytest.mark.parametrize(("e", "degrees"), [(-0.5, -170.0), (0.0, 180.0), (1.0, 40.0)])
def test_a_turned_heavy_spot_is_read_as_a_vector_and_never_below_zero(e: float, degrees: float) -> None:
    reading, vector = e_of(turned(drawn(1, e), degrees))
    assert vector.magnitude_change == pytest.approx(e, abs=4.5 * vector.magnitude_error)
    apart = (sure(vector.turned_deg) - degrees + 180) % 360 - 180
    assert abs(apart) < 4.5 * sure(vector.turned_error_deg) + 0.5
    true = (1 + e) * np.exp(1j * np.radians(degrees)) - 1
    assert vector.change == pytest.approx(abs(true), abs=4.5 * vector.change_error + 0.01)
    change = sure(reading.relative_change)
    assert change > -1
    # The change of the vector, or that of its size where the turn is the lesser part.
    assert change == pytest.approx(abs(true) if abs(change - e) > 0.05 else e, abs=0.1)
    assert sure(reading.interval_95)[0] >= -1


@pytest.mark.parametrize("removed_by_hop", [False, True])
def test_after_a_jump_of_the_angle_the_unbalance_is_judged_by_its_size(removed_by_hop: bool) -> None:
    for e in (0.0, 0.3):
        seen = turned(drawn(1, e), 90.0)
        reading, vector = e_of(replace(seen, directed=False, removed_by_hop=removed_by_hop))
        assert reading.relative_change == pytest.approx(vector.magnitude_change)
        assert reading.standard_error == pytest.approx(vector.magnitude_error)
        assert reading.relative_change == pytest.approx(e, abs=4.5 * vector.magnitude_error)


@pytest.mark.slow
def test_a_balanced_rotor_reads_a_loss_of_unbalance_of_less_than_all_of_it() -> None:
    """The difference of two windows' vectors is noise alone, whose sign is chance."""
    draw = Draw(MACHINE, SEED, Purpose.EVALUATION, 0, layout=Layout.INDEPENDENT, fixed_condition=True)
    window, last = (simulate_window(draw, number) for number in range(2))
    reading, vector = e_of(replace(window, synchronous=sure(window.synchronous) - sure(last.synchronous)))
    assert -1 < sure(reading.relative_change) < -0.8
    assert vector.turned_deg is None


def test_an_angle_rounded_to_zero_has_no_sign() -> None:
    vector = UnbalanceVector(1.5, -1e-3, 1e-8, 0.0, 1e-8)
    said = "a vector of 50 % of the nominal unbalance at 0° from the heavy spot (size +50 %, turned by 0°)"
    assert vector.sentence == said
    assert "(size +0 %, turned by −57°: the heavy spot" in UnbalanceVector(0.54, -0.84, 1e-8, 0.0, 1e-8).sentence


@pytest.mark.parametrize(
    ("change", "said"), [(0.29, "direction of its change not known"), (0.02, "no change of its vector")]
)
def test_a_change_whose_direction_is_uncertain_is_not_called_no_change(change: float, said: str) -> None:
    """At the nominal phase the size may be known well where the phase itself is not."""
    vector = UnbalanceVector(1 + change, 0.0, 0.0009, 0.0, 0.0144)
    assert sure(parameter_reading("e", "likelihood", change, 0.03, vector).vector).text == said


def test_1x_vectors_that_no_unbalance_causes_are_not_read_as_one() -> None:
    window = drawn(2)
    foreign = np.abs(sure(window.synchronous)) * np.exp(1j * np.random.default_rng(5).uniform(0, 6, len(window.states)))
    diagnosis = LikelihoodFit(MACHINE).diagnose(replace(window, synchronous=foreign))
    vector = sure(diagnosis.unbalance)
    assert "not what an unbalance causes" in vector.foreign
    verdict = isolate_window(diagnosis, 0.001)
    assert "e" not in verdict.changed
    assert not verdict.outside


def test_without_a_shaft_angle_the_size_of_the_unbalance_is_still_read() -> None:
    """In either direction of rotation; vectors that no unbalance causes give no reading, and no misfit."""
    window, rng = drawn(2, 0.4), np.random.default_rng(5)
    seen = sure(window.hop_synchronous) * np.exp(1j * rng.uniform(0, 6, (12, 1)))
    foreign = np.abs(seen) * np.exp(1j * rng.uniform(0, 6, len(window.states)))
    blind = replace(window, synchronous=None, hop_synchronous=None)
    mirror = np.array([-1.0 if state.startswith("z") else 1.0 for state in window.states])
    unsized = LikelihoodFit(MACHINE).diagnose(replace(blind, relative_synchronous=seen)).parameters
    for vectors in (seen, seen * mirror, foreign):
        alone = replace(blind, relative_synchronous=vectors)
        *others, e = LikelihoodFit(MACHINE, sized=True).diagnose(alone).parameters
        assert tuple(others) == unsized
        if vectors is foreign:
            assert "not what an unbalance causes" in e.reason
        else:
            assert e.relative_change == pytest.approx(0.4, abs=4 * sure(e.standard_error))


@pytest.mark.parametrize(
    ("number", "layout", "e"),
    [pytest.param(4, Layout.INDEPENDENT, 0.0, marks=pytest.mark.long), (8, Layout.ONE_SOURCE, 0.4)],
)
def test_run_out_biases_the_unbalance_by_no_more_than_its_own_size(number: int, layout: Layout, e: float) -> None:
    """The 1x of each sensor is 5 % off in its own direction; weights by random error alone made it 23 and 14 %."""
    window = drawn(number, e, layout)
    off = 0.05 * np.exp(1j * np.random.default_rng(number).uniform(0, 2 * np.pi, len(window.states)))
    reading, vector = e_of(replace(window, synchronous=sure(window.synchronous) * (1 + off)))
    assert not vector.foreign
    assert sure(reading.relative_change) == pytest.approx(e, abs=0.05 * (1 + e))


@pytest.mark.parametrize("turn", [0.0, 60.0])
def test_the_vector_of_a_window_across_a_change_has_the_size_that_is_read(turn: float) -> None:
    """The change is in the middle of the window: its vector shows half of the change, the reading all of it."""
    new = 1.8 * np.exp(1j * np.radians(turn)) if not turn else np.exp(1j * np.radians(turn))
    half = (1 + new) / 2
    vector = UnbalanceVector(half.real, half.imag, 1e-6, 0.0, 1e-6)
    own = vector.change if turn else half.real - 1
    diagnosis = Diagnosis("likelihood", (parameter_reading("e", "likelihood", own, 1e-3, vector),), unbalance=vector)
    reading = reading_of(stretch_of(diagnosis, 0, 60 * 10**9), "e", "likelihood", abs(new - 1), 1e-3)
    told = sure(reading.vector)
    assert told.change == pytest.approx(sure(reading.relative_change))
    assert told.magnitude_change == pytest.approx(abs(new) - 1, abs=1e-9)
    assert f"a vector of {100 * abs(new - 1):.0f} %" in told.text


SEED_OF_VARYING_SPEED = 900


def read(seed: int, ramp: float, *events: Event) -> Diagnosis:
    """A window of the rotor kit whose speed rises by a relative amount from start to end."""
    rpm = LAB.operation.speed_rpm
    rise = (
        Event(at_s=0.0, speed_rpm=rpm * (1 - ramp / 2)),
        Event(at_s=0.01, ramp_s=65.9, speed_rpm=rpm * (1 + ramp / 2)),
    )
    (window,) = windows_of(recording(LAB, stream(66.0, seed, *rise, *events)))
    assert window.removed_by_hop
    assert window.speed_range[1] > window.speed_range[0] * (1 + 0.8 * ramp)
    return LikelihoodFit(LAB).diagnose(window)


@pytest.mark.slow
@pytest.mark.parametrize("ramp", [pytest.param(0.05, marks=pytest.mark.long), 0.15])
def test_a_healthy_machine_at_varying_speed_reads_healthy(ramp: float) -> None:
    diagnosis = read(SEED_OF_VARYING_SPEED, ramp)
    assert len(diagnosis.evaluable) == 6
    assert all(abs(reading.z or 99.0) < 4 for reading in diagnosis.evaluable)
    assert (diagnosis.misfit_z or 0.0) < 3


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(("name", "change"), [("e", 0.2), ("c_by", -0.2)])
def test_a_change_at_varying_speed_is_named_alone(name: str, change: float) -> None:
    diagnosis = read(SEED_OF_VARYING_SPEED + 1, 0.1, Event(at_s=0.0, parameter=name, relative_change=change))
    assert isolate_window(diagnosis, 0.001).changed == (name,)
    reading = next(one for one in diagnosis.evaluable if one.name == name)
    assert reading.interval_95 is not None
    assert reading.relative_change == pytest.approx(change, abs=4 * sure(reading.standard_error))


SEED_OF_INTEGRATED = 63


def accelerometers() -> Machine:
    """The rotor kit with accelerometers in place of its velocity sensors, and no displacement."""
    sensors = []
    for channel in LAB.sensors:
        if channel.quantity is Quantity.VELOCITY:
            fields = channel.model_dump() | {"quantity": "acceleration", "unit": "m/s2"}
            sensors.append(Sensor.model_validate(fields))
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
    blocks = stream(70.0, SEED_OF_INTEGRATED)
    samples = differentiated(samples_of(blocks), np.random.default_rng(SEED_OF_INTEGRATED))
    return windows_of(recording(accelerometers(), with_samples(blocks, samples)))[0]


def test_accelerations_are_integrated_to_velocities(window: WindowStatistics) -> None:
    found = integrated(window)
    assert found.states == ("y1_dot", "y2_dot", "z1_dot", "z2_dot")
    true = windows_of(recording(LAB, stream(70.0, SEED_OF_INTEGRATED)))[0]
    at = [true.states.index(name) for name in found.states]
    inside = true.frequencies_hz > 10
    ratio = found.spectrum[inside].real.diagonal(axis1=1, axis2=2) / (true.spectrum[inside][:, at, at].real)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(sure(found.synchronous), sure(true.synchronous)[at], rtol=0.02)
    assert integrated(true) is true


def test_the_likelihood_reads_a_healthy_machine_from_accelerometers_alone(window: WindowStatistics) -> None:
    diagnosis = LikelihoodFit(accelerometers()).diagnose(window)
    assert len(diagnosis.evaluable) == 6
    for reading in diagnosis.evaluable:
        assert abs(sure(reading.z)) < 4, reading
        assert sure(reading.standard_error) < 0.05


@pytest.mark.slow
def test_accelerations_of_one_place_and_displacements_of_another_are_within_the_model() -> None:
    """One force moves both alike, but for noise. Integrated bin by bin, not group by group, they are unexplained."""
    draw = draw_condition(Draw(LAB, SEED, Purpose.EVALUATION, 39, layout=Layout.ONE_SOURCE), 1)
    quiet = draw.model_copy(update={"sensors": draw.sensors.model_copy(update={"noise_relative": 0.0})})
    samples = np.concatenate([block.samples for block, _ in blocks(quiet, LAB, 1.0)])
    rng = np.random.default_rng(SEED)
    probes = samples[:, 4:6] + 0.005 * samples[:, 4:6].std(axis=0) * rng.standard_normal((len(samples), 2))
    accelerations = differentiated(samples, rng)
    seen = np.column_stack([accelerations[:, :2], probes, accelerations[:, -1]])
    sensors = (*accelerometers().sensors[:2], *LAB.sensors[4:6], LAB.sensors[-1])
    window = LAB.window.model_copy(update={"segment_s": 2.0})
    machine = LAB.model_copy(update={"sensors": sensors, "window": window})
    diagnosis = LikelihoodFit(machine).diagnose(statistics(machine, seen))
    assert sure(diagnosis.misfit_z) < 4
    assert not diagnosis.unexplained
