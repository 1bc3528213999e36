"""Estimated correlations and spectra of the simulated machine against the Lyapunov theory."""

import numpy as np
import pytest

from models.diagnosis.window.moments import plan_for
from models.machine import load_machine
from models.physics.excitation import expanded_A, expanded_B
from models.physics.response import stationary_covariance, synchronous_response
from models.physics.rotor import STATE_INDEX
from simulator.stream import blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition
from tests.windows import correlation, last_window

LAB = load_machine("lab")
MACHINE = LAB.model_copy(update={"window": LAB.window.model_copy(update={"length_s": 30.0})})
SEED = 7_700_004


@pytest.mark.slow
def test_correlation_functions_and_synchronous_vectors_agree_with_theory() -> None:
    """Twelve independent windows: every correlation at every lag within 5.5 standard errors of their mean.

    Each of 8064 correlated comparisons, t-distributed with 11 degrees of freedom, exceeds 5.5 twice in ten thousand
    runs, so a handful may: 0.1 % of them.
    """
    condition = draw_condition(Draw(MACHINE, SEED, Purpose.EVALUATION, 0, layout=Layout.INDEPENDENT), 0)
    quiet = condition.sensors.model_copy(update={"noise_relative": 0.0})
    runs = [condition.model_copy(update={"sensors": quiet, "seed": SEED + number}) for number in range(12)]
    streams = (blocks(run, MACHINE, block_s=1.0) for run in runs)
    windows = [last_window(plan_for(MACHINE), (block for block, _ in stream)) for stream in streams]
    speed = next(event.speed_rpm for event in condition.events if event.speed_rpm is not None) * 2 * np.pi / 60
    A, B = expanded_A(MACHINE.rotor, speed, condition.sources), expanded_B(condition.sources)
    R0 = stationary_covariance(A, B)
    index = [STATE_INDEX[name] for name in windows[0].states]
    theory = np.stack([correlation(A, R0, lag)[np.ix_(index, index)] for lag in windows[0].lags_s])
    estimates = np.stack([window.correlation for window in windows])
    error = estimates.std(axis=0, ddof=1) / np.sqrt(12)
    deviation = np.abs(estimates.mean(axis=0) - theory) / error
    assert np.mean(deviation > 5.5) < 1e-3
    scale = np.sqrt(np.diagonal(R0)[index])
    assert np.all(error / np.outer(scale, scale) < 0.05)  # or agreement would mean little
    q1, q2 = synchronous_response(MACHINE.rotor, speed)
    expected = (q1 - 1j * q2)[index]
    found = np.stack([window.synchronous for window in windows if window.synchronous is not None])
    off = np.sqrt(np.var(found, axis=0, ddof=1) / 12)
    assert np.all(np.abs(found.mean(axis=0) - expected) < 5 * off)
    assert np.all(off < 0.05 * np.abs(expected))
    assert windows[0].speed_rad_s == pytest.approx(speed, rel=1e-6)
