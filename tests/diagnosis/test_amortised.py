"""Amortised networks: drawn spectra against simulated ones, features, readings, and refusals."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from models.diagnosis.networks.amortised import AmortisedNetworks, NetworkDiagnostician
from models.diagnosis.networks.bundle import load_bundle
from models.diagnosis.networks.features import ForceFeatures
from models.diagnosis.networks.relation import RelationDiagnostician
from models.diagnosis.window import WindowStatistics
from models.machine import load_machine
from models.physics.rotor import PARAMETERS
from simulator.training.draws import Draw, Layout, Purpose, simulate_window, with_tilt
from simulator.training.spectral_draws import SpectralDraws

SEED = 7_700_041
LAB = load_machine("lab")
FAULTS: dict[str, float] = {"k_by": -0.05, "c_by": -0.2, "k_bz": -0.05, "c_bz": -0.2, "e": 0.2, "EI": -0.1}


@cache
def window(parameter: str, number: int, layout: Layout = Layout.INDEPENDENT) -> WindowStatistics:
    faults = {parameter: FAULTS[parameter]} if parameter else {}
    stream = 400 + (0 if not parameter else 1 + PARAMETERS.index(parameter)) + 10 * layout
    return simulate_window(Draw(LAB, SEED, Purpose.EVALUATION, stream, faults=faults, layout=layout), number)


@cache
def shipped() -> AmortisedNetworks:
    amortised = load_bundle("lab", LAB).amortised
    assert amortised is not None
    return amortised


@pytest.mark.slow
def test_drawn_spectra_scatter_around_their_expectation_like_averaged_segments() -> None:
    draws = SpectralDraws(LAB)
    rng = np.random.default_rng(SEED)
    conditions = draws.draw(rng, 1)
    expected, speed = conditions.spectrum, conditions.speed_rad_s
    made = np.concatenate(list(draws.realisations(rng, expected, speed, 600)))
    power = np.einsum("bfii->bfi", made).real / np.einsum("bfii->bfi", expected).real
    assert power.mean() == pytest.approx(1.0, abs=0.01)
    # Half-overlapped Hann segments: variance 1/24 · (1 + 2/36) in each bin, correlation 4/9 between neighbours.
    assert power.var(axis=0).mean() == pytest.approx((1 + 2 / 36) / 24, rel=0.12)
    deviation = power - power.mean(axis=0)
    neighbours = (deviation[:, 1:] * deviation[:, :-1]).mean() / deviation.var()
    assert neighbours == pytest.approx(4 / 9, abs=0.04)
    coherent = np.abs(made[:, :, 0, 1].mean(axis=0) - expected[0, :, 0, 1])
    assert np.all(coherent < 0.07 * np.sqrt(expected[0, :, 0, 0].real * expected[0, :, 1, 1].real))


@pytest.mark.slow
def test_simulated_windows_look_like_drawn_ones() -> None:
    reader = NetworkDiagnostician(LAB, shipped())
    novelty = []
    for number in range(5):
        for layout in Layout:
            inputs = reader.inputs(window("", number, layout))
            assert inputs is not None
            novelty.append(float(shipped().basis.novelty(inputs)[0]))
    # Training windows are one on average; the evaluation's are drawn less broadly.
    assert 0.2 < np.median(novelty) < 1.5
    assert max(novelty) < shipped().novelty_limit


def test_forces_of_the_nominal_machine_are_those_of_its_sources() -> None:
    features, draws = ForceFeatures(LAB), SpectralDraws(LAB)
    rng = np.random.default_rng(SEED + 1)
    while True:  # a machine that happens to be drawn near nominal, with independent sources
        one = draws.draw(rng, 1)
        if np.all(np.abs(one.log_ratio[0, [0, 1, 2, 3, 5]]) < 0.2):
            break
    series = features.series(features.force(one.spectrum))
    assert series.shape == (features.n_series, 1, one.spectrum.shape[1])
    assert np.all(np.abs(series[4:]) <= 1 + 1e-5)  # coherences
    louder = features.series(features.force(49.0 * one.spectrum))
    np.testing.assert_allclose(louder, series, atol=1e-4)  # levels drop out


@pytest.mark.slow
@pytest.mark.parametrize(
    "parameter", [one if one in ("k_by", "c_bz") else pytest.param(one, marks=pytest.mark.long) for one in FAULTS]
)
def test_the_shipped_networks_find_and_size_faults_on_new_windows(parameter: str) -> None:
    reader = NetworkDiagnostician(LAB, shipped())
    read, z_others = [], []
    for number in range(6):
        diagnosis = reader.diagnose(window(parameter, number))
        by_name = {reading.name: reading for reading in diagnosis.parameters}
        assert tuple(by_name) == ("k_by", "c_by", "e", "EI", "k_bz", "c_bz")
        assert diagnosis.covariance is not None
        np.testing.assert_allclose(
            np.sqrt(np.diag(diagnosis.covariance)),
            np.array([one.standard_error for one in diagnosis.evaluable], dtype=np.float64),
        )
        assert by_name[parameter].relative_change is not None
        read.append(by_name[parameter].relative_change)
        z_others += [abs(one.z or 0.0) for name, one in by_name.items() if name != parameter]
    assert np.median(np.array(read, dtype=np.float64)) == pytest.approx(FAULTS[parameter], abs=0.03)
    assert np.mean(np.array(z_others) > 3.14) < 0.1


def test_what_the_networks_cannot_judge_is_said_to_be_so() -> None:
    reader = NetworkDiagnostician(LAB, shipped())
    healthy = window("", 0)
    assert len(reader.diagnose(healthy).evaluable) == len(PARAMETERS)

    blind = replace(healthy, synchronous=None)
    reasons = {one.name: one.reason for one in reader.diagnose(blind).parameters}
    assert reasons["e"] == "no phase reference"
    assert reasons["k_by"] == ""

    fewer = replace(healthy, states=healthy.states[:-1], spectrum=healthy.spectrum[:, :-1, :-1])
    assert {one.reason for one in reader.diagnose(fewer).parameters} == {"not measured: z2_dot"}

    dead = healthy.spectrum.copy()
    dead[:, 0, :] = dead[:, :, 0] = 0.0
    assert all(
        one.reason.startswith("displacement and rate disagree: y1 by 100 %")
        for one in reader.diagnose(replace(healthy, spectrum=dead)).parameters
    )

    strange = healthy.spectrum.copy()
    strange[250:350] *= 1e4  # a tone as of a passing gear, in all channels
    assert all(
        "unlike what the networks were trained on" in one.reason
        for one in reader.diagnose(replace(healthy, spectrum=strange)).parameters
    )


def test_a_gain_error_of_one_sensor_is_not_taken_for_a_fault() -> None:
    healthy = window("", 1)
    gain = np.ones(len(healthy.states))
    gain[healthy.states.index("y1")] = 2.0
    wrong = replace(healthy, spectrum=healthy.spectrum * np.outer(gain, gain))
    diagnosis = NetworkDiagnostician(LAB, shipped()).diagnose(wrong)
    assert not diagnosis.evaluable
    assert "disagree: y1 by" in diagnosis.parameters[0].reason
    assert diagnosis.covariance is None or diagnosis.covariance.size == 0


def test_tilt_sensors_beside_the_trained_ones_do_no_harm() -> None:
    rig = with_tilt(LAB)
    draw = Draw(rig, SEED, Purpose.EVALUATION, 450, layout=Layout.INDEPENDENT)
    seen = simulate_window(draw, 0)
    assert len(seen.states) == 12
    diagnosis = NetworkDiagnostician(rig, shipped()).diagnose(seen)
    assert len(diagnosis.evaluable) == len(PARAMETERS)


def test_relations_speak_the_common_language() -> None:
    bundle = load_bundle("lab", LAB)
    diagnosis = RelationDiagnostician(LAB, bundle.networks).diagnose(window("", 0))
    assert diagnosis.by == "relation"
    assert [one.equation for one in diagnosis.equations] == ["28", "29", "30", "31"]
    reasons = {one.name: one.reason for one in diagnosis.parameters}
    assert set(reasons) == set(PARAMETERS)
    assert reasons["EI"].startswith("not measured: psi")
    assert all(one.by == "relation" for one in diagnosis.parameters)
    untrained = RelationDiagnostician(LAB, ()).diagnose(window("", 0))
    assert {one.reason for one in untrained.parameters} == {"no trained network"}
