"""Bundles and the amortised networks in them: round trips, readings, and every refusal."""

import hashlib
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from models.diagnosis.networks.amortised import NEAR, AmortisedNetworks, NetworkDiagnostician, around
from models.diagnosis.networks.bundle import Training, load_bundle, save_bundle
from models.diagnosis.networks.features import ForceFeatures
from models.diagnosis.networks.relation import EquationNetwork, RelationDiagnostician, read_equation
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import BundleError
from models.machine import load_machine
from models.physics.rotor import PARAMETERS
from simulator.training.draws import Draw, Layout, Purpose, simulate_window, with_tilt
from simulator.training.spectral_draws import SpectralDraws
from tests.sure import sure

SEED = 7_700_003
LAB = load_machine("lab")
SHIPPED = Path(__file__).parents[3] / "models" / "bundles" / "lab"
MADE = Training(seed=SEED, training_windows=24, calibration_windows=10, versions={})


def test_a_bundle_round_trips_and_an_uncalibrated_one_is_not_saved(tmp_path: Path) -> None:
    shipped, amortised = load_bundle("lab", LAB), sure(load_bundle("lab", LAB).amortised)
    saved = save_bundle(tmp_path / "bundle", LAB, shipped.networks, MADE, amortised)
    again = load_bundle(tmp_path / "bundle", LAB)
    assert (again.identity, again.manifest) == (saved.identity, saved.manifest)
    one = np.random.default_rng(0).standard_normal((5, 4))
    np.testing.assert_array_equal(again.networks[0].network(one), shipped.networks[0].network(one))
    assert again.networks[0].healthy == shipped.networks[0].healthy
    loaded = sure(again.amortised)
    assert loaded.calibration == amortised.calibration
    assert (loaded.coherent, loaded.coherence_limit) == (amortised.coherent, amortised.coherence_limit)
    for read, expected in ((loaded, amortised), (sure(loaded.near), sure(amortised.near))):
        x = np.random.default_rng(SEED).standard_normal((3, read.networks[0].direct.shape[0])).astype(np.float32)
        for part, of in zip(read.networks[0](x), expected.networks[0](x), strict=True):
            np.testing.assert_array_equal(part, of)
    save_bundle(tmp_path / "once", LAB, shipped.networks, MADE, replace(amortised, near=None))
    assert "near" not in json.loads((tmp_path / "once" / "manifest.json").read_text())["amortised"]
    assert sure(load_bundle(tmp_path / "once", LAB).amortised).near is None
    uncalibrated = replace(amortised, calibration={})
    with pytest.raises(BundleError, match="the amortised networks are not calibrated"):
        save_bundle(tmp_path / "other", LAB, shipped.networks, MADE, uncalibrated)
    trained = shipped.networks[0]
    with pytest.raises(BundleError, match="equation 28 has no healthy spread"):
        save_bundle(tmp_path, LAB, (EquationNetwork(trained.equation, trained.network, None),), MADE)


def test_machines_with_the_same_bundle_share_its_weights(tmp_path: Path) -> None:
    copied = shutil.copytree(SHIPPED, tmp_path / "copy")
    one, other = (load_bundle(place, LAB.model_copy(update={"name": place.name})) for place in (SHIPPED, copied))
    ours, others = sure(one.amortised), sure(other.amortised)
    for mine, theirs in zip(ours.networks, others.networks, strict=True):
        assert all(a is b for a, b in zip(mine.weights, theirs.weights, strict=True))
    assert ours.basis.directions is others.basis.directions
    with pytest.raises(ValueError, match="read-only"):
        ours.networks[0].weights[0][0, 0] = 0.0


def edit_manifest(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    def edit(directory: Path) -> None:
        manifest = json.loads((directory / "manifest.json").read_text())
        change(manifest)
        (directory / "manifest.json").write_text(json.dumps(manifest))

    return edit


def edit_weights(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def edit(directory: Path) -> None:
        weights = directory / "weights.safetensors"
        arrays = load_file(weights)
        change(arrays)
        save_file(arrays, weights)
        digest = hashlib.sha256(weights.read_bytes()).hexdigest()
        edit_manifest(lambda manifest: manifest.update(weights_sha256=digest))(directory)

    return edit


def flip_a_byte(directory: Path) -> None:
    data = bytearray((directory / "weights.safetensors").read_bytes())
    data[-1] ^= 1
    (directory / "weights.safetensors").write_bytes(data)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (flip_a_byte, "sha256 is .* the manifest says"),
        (lambda d: (d / "weights.safetensors").unlink(), "not a bundle, no weights.safetensors"),
        (lambda d: (d / "manifest.json").write_text("{"), "manifest.json: .*JSON"),
        (edit_manifest(lambda m: m.update(format=3)), "format is 3, this program reads 2"),
        (edit_manifest(lambda m: m.update(code="import os")), "code: unknown"),
        (edit_manifest(lambda m: m["physics"]["rotor"].update(m1_kg=0.6)), "rotor.m1_kg is 0.5, trained for 0.6"),
        (edit_manifest(lambda m: m["physics"].update(rate_hz=4000.0)), "rate_hz is 2000.0, trained for 4000.0"),
        (edit_manifest(lambda m: m["physics"]["window"].update(lag_to_s=0.2)), "window.lag_to_s is 0.125, trained"),
        (edit_manifest(lambda m: m["equations"][0].update(number="99")), "equation 99 is not in this program's table"),
        (edit_manifest(lambda m: m["equations"][0]["channels"].reverse()), "equation 28: channels are"),
        (edit_manifest(lambda m: m["equations"][0]["healthy"].update(z_scale=[1.0])), "28: lengths of z_scale"),
        (edit_manifest(lambda m: m["equations"][0]["healthy"].update(z_scale=[-1.0, 1.0])), "z_scale.*above 0"),
        (edit_manifest(lambda m: m["equations"][0]["healthy"].update(gain=[1.0])), "28: length of gain"),
        (edit_manifest(lambda m: m["equations"][0]["healthy"].update(gain=[0.0, 1.0])), "gain.*above 0"),
        (edit_manifest(lambda m: m["amortised"]["coherent"].pop("e")), "calibrated are .* expected .*'e'"),
        (edit_manifest(lambda m: m["equations"].append(m["equations"][0])), "occurs twice"),
        (edit_weights(lambda a: a.update({"28.input_scale": np.zeros(4)})), "input_scale has a value"),
        (edit_manifest(lambda m: m["equations"][0].update(units="um")), "units: expected SI"),
        (edit_manifest(lambda m: m["equations"][0].update(inputs=["R[i,y1]"])), "equation 28: inputs are"),
        (edit_weights(lambda a: a.update({"28.W1": np.zeros((3, 15))})), r"28: weight W1 is float64\(3, 15\)"),
        (edit_weights(lambda a: a.update({"28.b2": np.array([np.nan])})), "28: weight b2 .* expected finite"),
        (edit_weights(lambda a: a.pop("31.W2")), "31: weight W2 is missing"),
        (edit_weights(lambda a: a.pop("amortised.29.W1")), "amortised networks: amortised.29.W1 is missing"),
        (edit_weights(lambda a: a.pop("basis.centre")), "basis.centre is missing, expected finite float32"),
        (edit_weights(lambda a: a.update({"basis.scale": np.ones(3)})), r"basis.scale is float64\(3,\), expected"),
        (edit_manifest(lambda m: m["amortised"].update(layers=[8])), r"layers are \(8,\), this program expects"),
        (edit_weights(lambda a: a.pop("near.amortised.28.b1")), "near.amortised.28.b1 is missing"),
        (edit_manifest(lambda m: m["amortised"]["near"].update(e=0.5)), "remainders are .*0.5.*, this program expects"),
        (edit_manifest(lambda m: m["amortised"]["calibration"].pop("e")), "calibrated are .* expected .*'e'"),
        (
            edit_manifest(lambda m: m["amortised"]["calibration"]["e"].update(log_deviation=[-1.0, -2.0, -3.0])),
            "calibration of e: expected ascending log_deviation",
        ),
    ],
)
def test_a_damaged_or_foreign_bundle_is_refused(tmp_path: Path, damage: Callable[[Path], object], message: str) -> None:
    directory = tmp_path / "bundle"
    shutil.copytree(SHIPPED, directory)
    damage(directory)
    with pytest.raises(BundleError) as caught:
        load_bundle(directory, LAB)
    assert re.search(message, str(caught.value), re.DOTALL)


def test_the_shipped_bundle_is_the_documented_training_and_refuses_another_machine() -> None:
    bundle = load_bundle("lab", LAB)
    assert [network.equation.number for network in bundle.networks] == ["28", "29", "30", "31"]
    assert bundle.manifest.training.seed not in {SEED}
    assert [network.equation for network in sure(bundle.amortised).networks] == ["28", "29", "30", "31"]
    with pytest.raises(BundleError, match=r"trained for another machine than demo/heavy: .*rotor\.m1_kg is 5\.0"):
        load_bundle("lab", load_machine("heavy"))


@pytest.mark.slow
def test_the_tilt_equation_is_evaluated_where_tilt_is_measured() -> None:
    rig = with_tilt(LAB)
    bundle = load_bundle("lab", rig)
    network = next(network for network in bundle.networks if network.equation.number == "30")
    draw = Draw(rig, SEED, Purpose.EVALUATION, 2, layout=Layout.INDEPENDENT)
    reading = read_equation(network, simulate_window(draw, 0), rig)
    assert reading.evaluable
    assert reading.parameters[0].name == "EI"
    assert abs(reading.parameters[0].z or 0.0) < 5


SEED_OF_AMORTISED = 7_700_041
FAULTS: dict[str, float] = {"k_by": -0.05, "c_by": -0.2, "k_bz": -0.05, "c_bz": -0.2, "e": 0.2, "EI": -0.1}


@cache
def window(parameter: str, number: int, layout: Layout = Layout.INDEPENDENT) -> WindowStatistics:
    faults = {parameter: FAULTS[parameter]} if parameter else {}
    stream = 400 + (0 if not parameter else 1 + PARAMETERS.index(parameter)) + 10 * layout
    return simulate_window(
        Draw(LAB, SEED_OF_AMORTISED, Purpose.EVALUATION, stream, faults=faults, layout=layout), number
    )


@cache
def shipped() -> AmortisedNetworks:
    return sure(load_bundle("lab", LAB).amortised)


@pytest.mark.slow
def test_drawn_spectra_scatter_around_their_expectation_like_averaged_segments() -> None:
    draws = SpectralDraws(LAB)
    rng = np.random.default_rng(SEED_OF_AMORTISED)
    conditions = draws.draw(rng, 1)
    expected, speed = conditions.spectrum, conditions.speed_rad_s
    made = np.concatenate(list(draws.realisations(rng, expected, speed, 300)))
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
    for number in range(2):
        for layout in Layout:
            seen = sure(reader.inputs(window("", number, layout)))
            novelty.append(float(shipped().basis.novelty(seen[0])[0]))
    # The novelty of training windows averages one; those of the evaluation are drawn less broadly.
    assert 0.2 < np.median(novelty) < 1.5
    assert max(novelty) < shipped().novelty_limit


def test_force_features_hold_coherences_and_do_not_depend_on_the_level() -> None:
    features, draws = ForceFeatures(LAB), SpectralDraws(LAB)
    rng = np.random.default_rng(SEED_OF_AMORTISED + 1)
    while True:  # a machine that happens to be drawn near nominal, with independent sources
        one = draws.draw(rng, 1)
        if np.all(np.abs(one.log_ratio[0, [0, 1, 2, 3, 5]]) < 0.2):
            break
    series = features.series(features.force(one.spectrum))
    assert series.shape == (features.n_series, 1, one.spectrum.shape[1])
    assert np.all(np.abs(series[4:]) <= 1 + 1e-5)  # coherences
    louder = features.series(features.force(49.0 * one.spectrum))
    np.testing.assert_allclose(louder, series, atol=1e-4)  # levels drop out


def test_forces_of_one_source_are_in_phase_through_the_true_machine() -> None:
    draws, rng = SpectralDraws(LAB, near=True), np.random.default_rng(SEED_OF_AMORTISED + 2)
    # One source: through the right machine all forces are in phase, except for its tilting moment.
    while True:
        one = draws.draw(rng, 1)
        apart = one.log_ratio - one.centre
        assert np.all(np.abs(apart) <= [NEAR[name] for name in PARAMETERS])
        nominal = ForceFeatures(LAB)
        if np.abs(one.centre[0, 0]) > 0.3 and nominal.coherence(nominal.series(nominal.force(one.spectrum))) > 0.5:
            break
    lag = {}
    near, true = around(LAB, one.centre[0]), around(LAB, one.log_ratio[0])
    for name, machine in (("nominal", LAB), ("near", near), ("true", true)):
        features = ForceFeatures(machine, near=True)
        series = features.series(features.force(one.spectrum))
        assert series.shape == (features.n_series, 1, one.spectrum.shape[1])
        np.testing.assert_allclose(series[1:5].sum(axis=0), 0, atol=1e-4)  # contrasts of levels
        lag[name] = float(np.abs(series[-6:]).mean())  # imaginary parts of squared coherences
    assert lag["true"] < 0.3 * lag["nominal"]
    assert lag["near"] < lag["nominal"]


@pytest.mark.slow
@pytest.mark.long
def test_the_second_reading_is_more_precise() -> None:
    twice, once = (NetworkDiagnostician(LAB, one) for one in (shipped(), replace(shipped(), near=None)))
    errors, stated = [], []
    for layout, parameter, number in product(Layout, ("k_by", "k_bz"), range(4)):
        seen = window(parameter, number, layout)
        looked_at = sure(once.inputs(seen))
        read = [one.stated(seen, looked_at[0]) for one in (once, twice)]
        for equation, name in (("28", "k_by"), ("31", "k_bz")):
            true = np.log1p(FAULTS[name]) if name == parameter else 0.0
            errors.append([abs(one[equation][0][0] - true) for one in read])
            stated.append([one[equation][1][0, 0] for one in read])
    for first, second in (np.median(errors, axis=0), np.median(stated, axis=0)):
        assert second < 0.8 * first


def test_a_second_reading_states_less_error_and_the_first_is_kept_where_it_was_not_trained() -> None:
    healthy, vague = window("", 0), shipped().networks[0]
    once, twice = (NetworkDiagnostician(LAB, one) for one in (replace(shipped(), near=None), shipped()))
    looked_at = sure(once.inputs(healthy))[0]
    for equation in ("28", "31"):
        first_error, second_error = (one.stated(healthy, looked_at)[equation][1][0, 0] for one in (once, twice))
        assert second_error < 0.9 * first_error
    deaf = replace(vague, biases=(*vague.biases[:-1], vague.biases[-1] + np.array([0, 0, 5, 5, 0], dtype=np.float32)))
    amortised = replace(shipped(), networks=(deaf, *shipped().networks[1:]))
    reader = NetworkDiagnostician(LAB, amortised)
    seen = sure(reader.inputs(healthy))
    stated = reader.stated(healthy, seen[0])
    first = NetworkDiagnostician(LAB, replace(amortised, near=None)).stated(healthy, seen[0])
    for name, (mean, _) in stated.items():
        np.testing.assert_array_equal(mean, first[name][0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "parameter", [one if one in ("k_by", "c_bz") else pytest.param(one, marks=pytest.mark.long) for one in FAULTS]
)
def test_the_shipped_networks_find_and_size_faults_on_new_windows(parameter: str) -> None:
    reader = NetworkDiagnostician(LAB, shipped())
    read, z_others = [], []
    for number in range(3):
        diagnosis = reader.diagnose(window(parameter, number))
        by_name = {reading.name: reading for reading in diagnosis.parameters}
        assert tuple(by_name) == ("k_by", "c_by", "e", "EI", "k_bz", "c_bz")
        stated = [sure(one.standard_error) for one in diagnosis.evaluable]
        np.testing.assert_allclose(np.sqrt(np.diag(sure(diagnosis.covariance))), stated)
        read.append(sure(by_name[parameter].relative_change))
        z_others += [abs(one.z or 0.0) for name, one in by_name.items() if name != parameter]
    assert np.median(np.array(read, dtype=np.float64)) == pytest.approx(FAULTS[parameter], abs=0.03)
    assert np.mean(np.array(z_others) > 3.14) < 0.1


def test_networks_state_why_a_window_cannot_be_judged() -> None:
    reader = NetworkDiagnostician(LAB, shipped())
    healthy = window("", 0)
    assert len(reader.diagnose(healthy).evaluable) == len(PARAMETERS)

    blind = replace(healthy, synchronous=None)
    reasons = {one.name: one.reason for one in reader.diagnose(blind).parameters}
    assert (reasons["e"], reasons["k_by"]) == ("no phase reference", "")

    fewer = replace(healthy, states=healthy.states[:-1], spectrum=healthy.spectrum[:, :-1, :-1])
    assert {one.reason for one in reader.diagnose(fewer).parameters} == {"not measured: z2_dot"}

    strange = healthy.spectrum.copy()
    strange[250:350] *= 1e4  # a tone as of a passing gear, in all channels
    of_first = np.arange(len(healthy.states)) == healthy.states.index("y1")
    for spectrum, reason in (
        (healthy.spectrum * np.outer(~of_first, ~of_first), "displacement and rate disagree: y1 by 100 %"),
        (healthy.spectrum * np.outer(1 + of_first, 1 + of_first), "displacement and rate disagree: y1 by "),
        (strange, "unlike what the networks were trained on"),
    ):
        diagnosis = reader.diagnose(replace(healthy, spectrum=spectrum))
        assert not diagnosis.evaluable
        assert all(reason in one.reason for one in diagnosis.parameters)
        assert diagnosis.covariance is None or diagnosis.covariance.size == 0


def test_tilt_sensors_beside_the_trained_ones_do_no_harm() -> None:
    rig = with_tilt(LAB)
    draw = Draw(rig, SEED_OF_AMORTISED, Purpose.EVALUATION, 450, layout=Layout.INDEPENDENT)
    seen = simulate_window(draw, 0)
    assert len(seen.states) == 12
    diagnosis = NetworkDiagnostician(rig, shipped()).diagnose(seen)
    assert len(diagnosis.evaluable) == len(PARAMETERS)


def test_relation_networks_give_a_diagnosis_of_the_common_form() -> None:
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
