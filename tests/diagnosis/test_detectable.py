"""Minimum detectable changes against Gaussian windows."""

import numpy as np
import pytest

from models.diagnosis.verdict.calibration import detectable_changes, length_to_find, month_thresholds, window_thresholds
from models.diagnosis.verdict.isolation import isolate
from models.diagnosis.verdict.stretch import Stretch, stretch_of, to_scale
from models.physics.rotor import PARAMETERS
from models.signals.block import FloatArray
from tests.diagnosis.test_isolation import covariance, window

SEED = 88_200


def healthy(seed: int) -> Stretch:
    cov = covariance(np.random.default_rng(seed))
    return stretch_of(window(np.zeros(6), cov), 0, 60_000_000_000)


def power(cov: FloatArray, name: str, seed: int) -> list[float]:
    """Share of 1200 windows in which the minimum detectable loss and gain are named."""
    rng, thresholds, shares = np.random.default_rng(seed), window_thresholds(0.01, 6), []
    stretch = stretch_of(window(np.zeros(6), cov), 0, 60_000_000_000)
    (found,) = (one for one in detectable_changes(stretch, thresholds, 60.0) if one.name == name)
    for change in (found.loss, found.gain):
        true = np.zeros(6)
        true[PARAMETERS.index(name)] = to_scale(name, change)
        values = rng.multivariate_normal(true, cov, size=1200)
        shares.append(
            float(
                np.mean([name in isolate(stretch_of(window(value, cov), 0, 1), thresholds).changed for value in values])
            )
        )
    return shares


@pytest.mark.slow
@pytest.mark.parametrize("name", ["c_by", "e"])
def test_the_change_is_found_in_95_of_100_windows(name: str) -> None:
    cov = np.diag(np.geomspace(0.001, 0.02, 6) ** 2)
    assert power(cov, name, SEED) == pytest.approx([0.95, 0.95], abs=0.025)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_correlated_parameters_are_found_more_often_never_less(seed: int) -> None:
    cov = covariance(np.random.default_rng(SEED + seed))
    assert min(power(cov, "k_bz", SEED + seed)) > 0.925


def test_loss_and_gain_are_ratios_of_each_other() -> None:
    for found in detectable_changes(healthy(1), month_thresholds(1.0, 5.0, 12, 6), 60.0):
        if found.name == "e":
            assert found.loss == -found.gain or found.loss == -1
        else:
            assert (1 + found.loss) * (1 + found.gain) == pytest.approx(1)
        assert -1 <= found.loss < 0 < found.gain


def test_length_and_change_are_inverse() -> None:
    stretch, thresholds = healthy(2), window_thresholds(1e-3, 6)
    found = {one.name: one for one in detectable_changes(stretch, thresholds, 60.0)}
    for one in found.values():
        for change in (one.loss, one.gain):
            assert length_to_find(one, change) == pytest.approx(60.0)
    assert length_to_find(found["e"], 0.05) == pytest.approx(4 * length_to_find(found["e"], 0.10))


@pytest.mark.parametrize("change", [0.0, -1.0, -2.0])
def test_changes_that_cannot_be_are_refused(change: float) -> None:
    with pytest.raises(ValueError, match="expected above -1 and not 0"):
        length_to_find(detectable_changes(healthy(3), window_thresholds(0.01, 6), 60.0)[0], change)
