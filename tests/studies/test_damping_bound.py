"""The bound of damping without parameters, against readings that use the truth for their weights."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.finite_elements.machines import rotor_named
from benchmarks.finite_elements.observed import WindowSizes, plan, sampled, windows_of
from benchmarks.finite_elements.scenes import COMMISSIONED, SourceLayout, drawn_condition
from benchmarks.studies.methods.damping_bound import damping_bound, expected
from models.diagnosis.baseline.rows import ROWS


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("changes", [{}, {"c_by": -0.2}])
def test_errors_of_an_oracle_agree_with_the_bound(changes: dict[str, float]) -> None:
    rotor = rotor_named("overhung")
    sizes = plan(rotor, WindowSizes(length_s=30.0, hop_s=2.5, segment_s=2.5))
    condition = drawn_condition(rotor, SourceLayout.ONE_SOURCE, COMMISSIONED, {}, np.random.default_rng(31))
    changed = replace(condition, changes=changes)
    healthy = windows_of(sampled(rotor, condition, 24 * 30.0 + 3, 1), sizes)[:24]
    later = windows_of(sampled(rotor, changed, 12 * 30.0 + 3, 2), sizes)[:12]
    before, after = (expected(rotor, one, later[0]) for one in (condition, changed))
    # simulated mean spectra against the expected ones
    mean = np.mean([one.spectrum for one in later], axis=0)
    band = slice(10, 150)
    power = np.einsum("fii->i", mean[band]).real * (later[0].frequencies_hz[1] - later[0].frequencies_hz[0])
    lines = (after.frequencies_hz >= later[0].frequencies_hz[10]) & (
        after.frequencies_hz <= later[0].frequencies_hz[149]
    )
    assert power == pytest.approx(np.einsum("fii->i", after.spectrum[lines]).real * 0.1, rel=0.1)
    for row in ROWS[:2]:
        bound = damping_bound(row, before, after, changes, np.array([60.0, 30.0]))
        name = row.own[1].parameter
        errors = [bound.oracle(name, later[n], healthy[2 * n % 24 : 2 * n % 24 + 2]) for n in range(12)]
        rms = np.sqrt(np.mean(np.square(errors))) / bound.error(name, alone=False)
        assert 0.6 < rms < 1.5  # twelve independent readings: 0.61 to 1.39 hold 95 %
        longer = damping_bound(row, before, after, changes, np.array([120.0, 30.0]))
        assert longer.error(name, alone=False) < bound.error(name, alone=False)
        assert bound.error(name, alone=True) <= bound.error(name, alone=False)
