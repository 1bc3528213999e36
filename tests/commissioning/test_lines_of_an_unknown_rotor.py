"""Steady lines of the healthy machine, such as hum, are removed before relations are learned or windows read."""

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest

from models.commissioning.commissioned import Commissioned
from models.commissioning.healthy import HealthyRecording
from models.commissioning.identified import identify
from models.commissioning.levels import pieces_of
from models.diagnosis.window.statistics import WindowStatistics, window_statistics
from models.signals.block import SampleBlock
from service.monitor.evaluators import BaselineEvaluator
from tests.commissioning.rotor_kit import (
    LAB,
    NOTHING,
    PARTIAL,
    commissioned,
    no_velocity,
    recording,
    stream,
    with_lines,
    with_sensors,
)
from tests.sure import sure
from tests.windows import healthy_blocks

HUM = {50.02: 0.03, 100.04: 0.02, 150.06: 0.02}


@cache
def recorded(*, lines: bool) -> Sequence[SampleBlock]:
    clean = stream(95.0, 5_270_041)
    return with_lines(clean, HUM, order=2) if lines else clean


@cache
def read(*, lines: bool) -> HealthyRecording:
    return recording(NOTHING, recorded(lines=lines))


def healthy(*, lines: bool) -> tuple[WindowStatistics, ...]:
    return tuple(piece.window for piece in pieces_of([read(lines=lines)]))


@cache
def made(*, lines: bool) -> Commissioned:
    return sure(commissioned(NOTHING, read(lines=lines)).commissioned)


def test_lines_are_removed_from_correlations_at_all_lags_exactly_once() -> None:
    for clean, window in zip(healthy(lines=False), healthy(lines=True), strict=True):
        spread = np.sqrt(np.diag(clean.correlation[0]))
        there, left = (
            (one.correlation - clean.correlation) / np.outer(spread, spread) for one in (window, window.without_lines)
        )
        assert np.sqrt((left**2).mean()) < 0.35 * np.sqrt((there**2).mean())
        again = window.without_lines
        assert again.without_lines is again
        np.testing.assert_allclose(again.hop_correlation.mean(axis=0), again.correlation, atol=1e-6 * spread.max() ** 2)


def test_relations_learned_with_lines_agree_with_those_learned_without() -> None:
    assert {round(line_hz) for line_hz, _ in made(lines=True).lines} == {44, 50, 100, 150}
    assert made(lines=False).lines == ()
    own, seen = (made(lines=lines).baselines[0].baseline.relations for lines in (False, True))
    for one, other in zip(map(sure, own), map(sure, seen), strict=True):
        errors = np.sqrt(np.diag(one.covariance))
        assert np.all(np.abs(other.coefficients - one.coefficients) < 0.2 * errors)  # 0.9 with the lines


def test_windows_are_read_without_lines_if_relations_were_learned_without_them() -> None:
    hops = read(lines=True)
    window = window_statistics(hops.plan, hops.hops[: hops.plan.hops], lines=made(lines=True).lines)
    before = made(lines=True).model_copy(update={"lines": ()})  # of a version that did not remove lines
    with_them, without = (
        BaselineEvaluator(NOTHING, one).evaluate(seen)
        for one, seen in ((before, window), (before, window.without_lines))
    )
    now = BaselineEvaluator(NOTHING, made(lines=True)).evaluate(window)
    assert now.deciding.parameters == without.deciding.parameters
    assert now.deciding.parameters != with_them.deciding.parameters


def test_identification_starts_from_a_guess_without_the_lines() -> None:
    """From displacements alone the guess used to be far off, so that commissioning at level partial was refused."""
    known = {"m1_kg": 2.5, "m2_kg": 4.0, "I2_kg_m2": 9e-3, "I2p_kg_m2": 0.0162, "shaft_length_m": 0.22}
    known |= {"shaft_diameter_m": 0.018}
    own = {"k_by_N_per_m": 4.5e5, "k_bz_N_per_m": 6e5, "c_by_N_s_per_m": 180.0, "c_bz_N_s_per_m": 200.0}
    rotor = LAB.model_copy(update={"rotor": LAB.rotor.model_copy(update=known | own)})
    told = PARTIAL.model_copy(update={"rotor": sure(PARTIAL.rotor).model_copy(update=known)})
    shown = healthy_blocks(rotor, 130.0, 5_270_042)
    machine, seen = with_sensors(told, with_lines(shown, {50.02: 0.1, 100.04: 0.06, 150.06: 0.1}), no_velocity)
    windows = [piece.window for piece in pieces_of([recording(machine, seen)])]
    assert identify(
        machine, windows, lambda *_: None, "Eq. 27", sized=False
    ).machine.rotor.c_by_N_s_per_m == pytest.approx(180, rel=0.1)
