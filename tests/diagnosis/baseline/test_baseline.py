"""A baseline learned on healthy windows of a finite-element rotor, and later windows read against it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.finite_elements.observed import windows_of
from benchmarks.finite_elements.rotor import BeamRotor, changed_rotor
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.learned import learn_baseline, positive
from models.diagnosis.baseline.rows import ROWS, parameters_of
from models.diagnosis.baseline.unbalance import combination, rotation_of
from models.diagnosis.readings import Diagnosis
from models.diagnosis.verdict.isolation import isolate_window
from models.errors import EstimationError
from tests.diagnosis.baseline.fe_rotor import OTHER, ROTOR, Excitation, of_states, plan, recorded, simulate
from tests.sure import sure

USUAL, QUIET = Excitation(), replace(OTHER, level_N=1.0)


@cache
def monitor(excitation: Excitation = USUAL) -> BaselineDiagnostician:
    return BaselineDiagnostician(learn_baseline(recorded(ROTOR, excitation, 1, 3)))


def z_of(diagnosis: Diagnosis) -> dict[str, float]:
    return {reading.name: reading.z for reading in diagnosis.parameters if reading.z is not None}


@pytest.mark.slow
def test_a_healthy_machine_reads_healthy_under_another_excitation() -> None:
    found = [z_of(monitor().diagnose(window)) for window in recorded(ROTOR, OTHER, 2, 3)]
    for name in parameters_of():
        z = np.array([each[name] for each in found])
        assert np.all(np.abs(z) < 3.5), (name, z)
        assert abs(z.mean()) < 2, (name, z)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rotor", "low", "high"),
    [
        pytest.param("c_by", changed_rotor(ROTOR, {"c_by": -0.3}), -0.40, -0.20, marks=pytest.mark.long),
        pytest.param("k_bz", changed_rotor(ROTOR, {"k_bz": -0.1}), -0.12, -0.06, marks=pytest.mark.long),
        ("e", changed_rotor(ROTOR, {"e": 0.5}), 0.2, 0.9),
    ],
)
def test_only_the_changed_parameter_is_named(name: str, rotor: BeamRotor, low: float, high: float) -> None:
    # Under twice this random force, an unbalance 50 % larger is named in only every other window.
    (window,) = recorded(rotor, replace(OTHER, level_N=2.0) if name == "e" else OTHER, 3)
    diagnosis = monitor().diagnose(window)
    assert isolate_window(diagnosis, 0.001).changed == (name,)
    reading = next(reading for reading in diagnosis.parameters if reading.name == name)
    assert low < sure(reading.relative_change) < high


@pytest.mark.slow
def test_intervals_from_little_healthy_data_are_wider_and_still_hold() -> None:
    sizes = plan(hops=6)
    short = BaselineDiagnostician(learn_baseline(windows_of(simulate(ROTOR, Excitation(), 33, 5), sizes)))
    for window in recorded(ROTOR, OTHER, 2, 3):
        little, much = short.diagnose(window), monitor().diagnose(window)
        assert max(abs(z) for z in z_of(little).values()) < 3.5
        assert np.all(np.diag(sure(little.common))[:4] > np.diag(sure(much.common))[:4])


@pytest.mark.slow
def test_sensor_noise_does_not_bias() -> None:
    clean = BaselineDiagnostician(learn_baseline(recorded(ROTOR, Excitation(), 1, 2, noise=1e-4)))
    noisy = recorded(ROTOR, OTHER, 2, 2, noise=0.05, noise_corner_hz=80.0)
    z = np.array([[z_of(clean.diagnose(window))[name] for name in parameters_of()[:4]] for window in noisy])
    assert np.all(np.abs(z.mean(axis=0)) < 2), z


def test_parameters_that_cannot_be_read_state_a_reason() -> None:
    (window,) = recorded(ROTOR, OTHER, 3)
    diagnosis = monitor().diagnose(replace(window, synchronous=None))
    reasons = {reading.name: reading.reason for reading in diagnosis.parameters}
    assert reasons["e"] == "no phase reference, and no speed found in the vibration"
    assert not reasons["k_by"]
    states = tuple(name for name in window.states if name != "y2_dot")
    partial = replace(of_states(window, states), synchronous=None)
    reasons = {reading.name: reading.reason for reading in monitor().diagnose(partial).parameters}
    assert reasons["k_by"] == reasons["c_by"] == "not measured: y2_dot, which the baseline was learned with"
    assert not reasons["k_bz"]
    short = replace(window, lags_s=window.lags_s[:20])
    with pytest.raises(EstimationError, match="correlations reach"):
        learn_baseline([short])
    assert all(reading.reason for reading in monitor().diagnose(short).parameters)


def test_a_1x_vector_that_no_unbalance_causes_is_unexplained() -> None:
    """An unbalance is one force in both planes: a plane whose sensors are all reversed shows two."""
    (window,) = recorded(ROTOR, QUIET, 3)
    q = sure(window.synchronous).copy()
    assert not monitor(QUIET).diagnose(window).unexplained
    q[[number for number, name in enumerate(window.states) if name.startswith("y")]] *= -1
    diagnosis = monitor(QUIET).diagnose(replace(window, synchronous=q))
    assert "the 1× vibration is not what an unbalance causes" in diagnosis.unexplained
    reasons = {one.name: one.reason for one in diagnosis.parameters}
    assert reasons["e"] == diagnosis.unexplained
    for turned in (2.0, 0.5j, -1.0):  # another unbalance is explained at any angle
        more = monitor(QUIET).diagnose(replace(window, synchronous=sure(window.synchronous) * turned))
        assert not more.unexplained


@pytest.mark.parametrize("planes", ["y", "yz"])
def test_signs_reversed_within_the_window_give_no_reading_of_the_unbalance(planes: str) -> None:
    """One hop of reversed signs was taken for a changed unbalance, with full confidence."""
    (window,) = recorded(ROTOR, QUIET, 3)
    of_plane = [state[0] in planes for state in window.states]
    for hops, factor, unread in ((1, -1.0, True), (4, -1.0, True), (4, 1.0j, False), (4, -2.0, False)):
        vectors = sure(window.hop_synchronous).copy()
        vectors[-hops:, of_plane] *= factor
        found = monitor(QUIET).diagnose(replace(window, hop_synchronous=vectors))
        assert ("turned by 180° within the window" in found.parameters[-1].reason) == unread, (hops, factor)


def test_an_unbalance_smaller_than_its_errors_is_not_determined() -> None:
    """As two sines in all channels left of a rotor: a hop of that was a defect in the monitor."""
    lost = positive(np.array([[-8.0, 0.0], [-12.0, -2.0]]) * 2.0**40)  # what cancels in such a hop
    with pytest.raises(EstimationError, match="not determined well enough: it is smaller than its errors"):
        combination(np.eye(2), lost)
    np.testing.assert_allclose(combination(np.eye(2), np.diag([1.0, 4.0])), np.eye(2))


@pytest.mark.parametrize("resonance", [0.95, 1.0, 1.04, 2.0])
def test_errors_of_the_unbalance_are_those_of_the_force_however_near_a_resonance_is(resonance: float) -> None:
    """A white force of density one on a stiff shaft, whose displacement has a narrow resonance near the speed."""
    window = of_states(recorded(ROTOR, Excitation(), 1, 3)[0], ("y1", "y2"))
    own = resonance * window.speed_rad_s
    left = np.array([1.0, 0.02 / own, own**-2, 0.0, 0.0])  # of y1, its derivative, and that of y2, the second
    w = 2 * np.pi * window.frequencies_hz
    moved = 1 / (1 + 0.02j * w / own - (w / own) ** 2)
    window = replace(window, spectrum=np.abs(moved[:, None, None]) ** 2 * np.ones((2, 2)) + 0j)
    found = sure(rotation_of(window, ("y1", "y2"), [(ROWS[0], left)]))
    at_speed = np.array([1 + 0.02j * window.speed_rad_s / own, -((window.speed_rad_s / own) ** 2)])
    force = np.concatenate([at_speed, 1j * at_speed])  # what real and imaginary parts of displacements leave
    for part in (force.real, force.imag):
        np.testing.assert_allclose(part @ found.covariance @ part, 2 / window.duration_s)
