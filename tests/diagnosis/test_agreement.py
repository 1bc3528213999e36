"""Two diagnosticians on the same window."""

import numpy as np
import pytest

from models.diagnosis.readings import Diagnosis, parameter_reading
from models.diagnosis.verdict.calibration import agreements
from models.physics.rotor import PARAMETERS

SEED = 88_400


def diagnosis(by: str, **changes: tuple[float, float]) -> Diagnosis:
    return Diagnosis(by, tuple(parameter_reading(name, by, *value) for name, value in changes.items()))


def test_agreement_disagreement_and_only_one() -> None:
    first = diagnosis("likelihood", k_by=(-0.25, 0.01), c_by=(0.01, 0.01), EI=(0.0, 0.002))
    second = diagnosis("network", k_by=(-0.24, 0.02), c_by=(0.30, 0.02), e=(0.1, 0.02))
    found = {one.name: one for one in agreements(first, second)}
    assert list(found) == ["k_by", "c_by", "e", "EI"]
    assert found["k_by"].verdict == "agree"
    assert found["k_by"].between == ("likelihood", "network")
    assert found["k_by"].difference_z == pytest.approx(0.01 / 5**0.5 / 0.01)
    assert found["c_by"].verdict == "disagree"
    assert found["c_by"].difference_z == pytest.approx(0.29 / 5**0.5 / 0.01)
    assert found["e"].verdict == found["EI"].verdict == "only-one"
    assert found["e"].difference_z is None


def test_nothing_to_compare() -> None:
    assert agreements(Diagnosis("likelihood"), Diagnosis("network")) == ()


@pytest.mark.slow
def test_two_who_are_right_disagree_once_in_a_thousand_windows() -> None:
    rng = np.random.default_rng(SEED)
    windows, apart = 20_000, 0
    for _ in range(windows):
        one, other = rng.normal(0, [[0.01], [0.03]], (2, 6))
        opinions = (
            diagnosis(by, **{name: (float(value), error) for name, value in zip(PARAMETERS, values, strict=True)})
            for by, values, error in (("likelihood", one, 0.01), ("network", other, 0.03))
        )
        apart += any(one.verdict == "disagree" for one in agreements(*opinions))
    assert 20 - 4 * 20**0.5 < apart < 20 + 4 * 20**0.5
