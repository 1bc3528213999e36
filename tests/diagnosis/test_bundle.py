"""The bundle's round trip, and every way to refuse a bundle."""

import hashlib
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from models.diagnosis.networks.bundle import Training, load_bundle, save_bundle
from models.diagnosis.networks.relation import EquationNetwork, read_equation
from models.errors import BundleError
from models.machine import load_machine
from simulator.training.draws import Draw, Layout, Purpose, simulate_window, with_tilt

SEED = 7_700_003
LAB = load_machine("lab")
SHIPPED = Path(__file__).parents[2] / "models" / "bundles" / "lab"
MADE = Training(seed=SEED, training_windows=24, calibration_windows=10, versions={})


def test_round_trip(tmp_path: Path) -> None:
    shipped = load_bundle("lab", LAB)
    assert shipped.amortised is not None
    saved = save_bundle(tmp_path / "bundle", LAB, shipped.networks, MADE, shipped.amortised)
    again = load_bundle(tmp_path / "bundle", LAB)
    assert again.identity == saved.identity
    assert again.manifest == saved.manifest
    one = np.random.default_rng(0).standard_normal((5, 4))
    np.testing.assert_array_equal(again.networks[0].network(one), shipped.networks[0].network(one))
    assert again.networks[0].healthy == shipped.networks[0].healthy
    loaded = again.amortised
    assert loaded is not None
    assert loaded.calibration == shipped.amortised.calibration
    x = np.random.default_rng(SEED).standard_normal((3, loaded.networks[0].direct.shape[0])).astype(np.float32)
    for part, expected in zip(loaded.networks[0](x), shipped.amortised.networks[0](x), strict=True):
        np.testing.assert_array_equal(part, expected)
    uncalibrated = replace(shipped.amortised, calibration={})
    with pytest.raises(BundleError, match="the amortised networks are not calibrated"):
        save_bundle(tmp_path / "other", LAB, shipped.networks, MADE, uncalibrated)


def test_an_uncalibrated_network_is_not_saved(tmp_path: Path) -> None:
    trained = load_bundle("lab", LAB).networks[0]
    with pytest.raises(BundleError, match="equation 28 has no healthy spread"):
        save_bundle(tmp_path, LAB, (EquationNetwork(trained.equation, trained.network, None),), MADE)


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
        (edit_manifest(lambda m: m["amortised"]["calibration"].pop("e")), "calibrated are .* expected .*'e'"),
        (
            edit_manifest(lambda m: m["amortised"]["calibration"]["e"].update(log_deviation=[-1.0, -2.0, -3.0])),
            "calibration of e: expected ascending log_deviation",
        ),
    ],
)
def test_a_damaged_or_foreign_bundle_is_refused_and_told_why(
    tmp_path: Path, damage: Callable[[Path], object], message: str
) -> None:
    directory = tmp_path / "bundle"
    shutil.copytree(SHIPPED, directory)
    load_bundle(directory, LAB)
    damage(directory)
    with pytest.raises(BundleError) as caught:
        load_bundle(directory, LAB)
    assert re.search(message, str(caught.value), re.DOTALL)


def test_the_shipped_bundle_is_the_documented_training_and_refuses_another_machine() -> None:
    bundle = load_bundle("lab", LAB)
    assert [network.equation.number for network in bundle.networks] == ["28", "29", "30", "31"]
    assert bundle.manifest.training.seed not in {SEED}
    assert bundle.amortised is not None
    assert [network.equation for network in bundle.amortised.networks] == ["28", "29", "30", "31"]
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
