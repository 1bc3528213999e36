"""A machine that moves five times as fast, seen with its own time scale: the same relations, the same readings."""

from dataclasses import replace

import numpy as np

from benchmarks.finite_elements.rotor import changed_rotor
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.learned import learn_baseline, unsuitable
from models.diagnosis.window.statistics import WindowStatistics
from tests.diagnosis.baseline.fe_rotor import OTHER, ROTOR, Excitation, recorded
from tests.sure import sure

_TIMES = 5.0


def faster(window: WindowStatistics) -> WindowStatistics:
    """The window of a machine that makes the same motion in a fifth of the time."""
    rates = np.array([_TIMES if name.endswith("_dot") else 1.0 for name in window.states])
    both, (slowest, fastest) = np.outer(rates, rates), window.speed_range
    return replace(
        window, lags_s=window.lags_s / _TIMES, correlation=window.correlation * both,
        hop_correlation=window.hop_correlation * both, spectrum=window.spectrum * both / _TIMES,
        frequencies_hz=window.frequencies_hz * _TIMES, synchronous=sure(window.synchronous) * rates,
        hop_synchronous=sure(window.hop_synchronous) * rates, speed_rad_s=window.speed_rad_s * _TIMES,
        speed_range=(slowest * _TIMES, fastest * _TIMES), hop_speed_rad_s=window.hop_speed_rad_s * _TIMES,
        duration_s=window.duration_s / _TIMES, time_scale=1 / _TIMES,
    )  # fmt: skip


def test_a_machine_five_times_as_fast_reads_the_same() -> None:
    healthy = recorded(ROTOR, Excitation(), 71, 2) + recorded(ROTOR, OTHER, 72, 1)
    later = recorded(changed_rotor(ROTOR, {"k_by": -0.2, "c_bz": 0.5}), Excitation(), 73, 1)[0]
    conditions = ["one", "one", "two"]
    usual = BaselineDiagnostician(learn_baseline(healthy, conditions)).diagnose(later)
    fast = BaselineDiagnostician(learn_baseline([faster(one) for one in healthy], conditions)).diagnose(faster(later))
    assert len(usual.evaluable) >= 5
    for one, other in zip(usual.parameters, fast.parameters, strict=True):
        error, near = sure(one.standard_error), 0.03 if one.name == "e" else 1e-3  # its error has numeric derivatives
        assert abs(sure(one.relative_change) - sure(other.relative_change)) < near * error, one.name
        assert abs(error / sure(other.standard_error) - 1) < near, one.name


def test_lags_are_judged_relative_to_the_time_scale() -> None:
    window = recorded(ROTOR, Excitation(), 71, 2)[0]
    fast = faster(window)
    assert unsuitable(window) == unsuitable(fast) == ""
    assert unsuitable(replace(fast, time_scale=1.0)) == "correlations reach 0.025 s, 0.1 s are needed"
    assert unsuitable(replace(window, time_scale=0.2)) == "lags are 1 ms apart, at most 0.252 ms are needed"
