"""The methods a user would otherwise pick: theory where there is one, and independent windows."""

import numpy as np
import pytest
import scipy.stats

from benchmarks.studies.other_methods import FeatureVector, SubspaceModes, reference_modes
from models.diagnosis.moments import plan_for
from models.errors import EstimationError
from models.machine import load_machine
from models.signals.block import FloatArray
from simulator.stream import blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition

LAB = load_machine("lab")


def _samples(number: int, faults: dict[str, float] | None = None) -> FloatArray:
    draw = Draw(LAB, 31, Purpose.EVALUATION, faults=faults or {}, layout=Layout.INDEPENDENT, fixed_condition=True)
    plan = plan_for(LAB)
    return np.concatenate(
        [plan.to_si(block.samples) for block, _ in blocks(draw_condition(draw, number), LAB, block_s=5.0)]
    )


@pytest.mark.long
def test_ssi_finds_the_modes_of_the_machine() -> None:
    """Four modes 28-95 Hz, two close pairs of whirl modes, 7-8 % damped; one 60 s window."""
    frequency, _ = reference_modes(LAB)
    found = np.median([SubspaceModes(LAB).features(_samples(number)) for number in range(3)], axis=0)
    assert found[:4] == pytest.approx(frequency, rel=0.015)
    assert found[4:] == pytest.approx([0.084, 0.0714, 0.0727, 0.0722], rel=0.25)


@pytest.mark.long
def test_ssi_follows_the_mode_that_a_soft_bearing_lowers() -> None:
    healthy, soft = (SubspaceModes(LAB).features(_samples(0, faults)) for faults in ({}, {"k_by": -0.2}))
    assert soft[0] / healthy[0] < 0.95
    assert soft[1] / healthy[1] == pytest.approx(1, abs=0.02)  # the vertical mode stays


@pytest.mark.long
def test_a_peer_learns_healthy_and_scores_a_large_change_above_its_limit() -> None:
    learned = [_samples(number) for number in range(12)]
    fresh, changed = _samples(60), _samples(50, {"k_by": -0.3})
    for peer in (SubspaceModes(LAB), FeatureVector(LAB)):
        peer.fit(np.stack([peer.features(samples) for samples in learned]))
        assert peer.score(peer.features(changed)) > 4 * peer.score(peer.features(fresh)), peer.name


def test_a_peer_that_has_learned_nothing_does_not_score() -> None:
    peer = FeatureVector(LAB)
    with pytest.raises(EstimationError, match="before any healthy window"):
        peer.score(np.zeros(72))


def test_a_lost_mode_does_not_end_the_score() -> None:
    rng = np.random.default_rng(5)
    peer = SubspaceModes(LAB)
    peer.fit(rng.standard_normal((40, 8)))
    features = rng.standard_normal(8)
    whole = peer.score(features)
    features[3] = np.nan
    assert 0 <= peer.score(features) <= whole
    assert np.isnan(peer.score(np.full(8, np.nan)))


def test_hotellings_limit_is_that_of_gaussian_features() -> None:
    """2000 draws of n = 30 learned windows and one further one, p = 8 features; seed 9."""
    rng = np.random.default_rng(9)
    peer = SubspaceModes(LAB)
    count = 0
    n, p = 30, 8
    limit = p * (n - 1) * (n + 1) / (n * (n - p)) * scipy.stats.f.isf(0.05, p, n - p)
    for _ in range(2000):
        drawn = rng.standard_normal((31, 8))
        peer.fit(drawn[:30])
        count += peer.score(drawn[30]) > limit
    low, high = scipy.stats.binom.interval(0.999, 2000, 0.05)
    assert low <= count <= high
