"""A change that grows little by little: windows of before and after it are added up."""

from dataclasses import replace

import numpy as np

from models.diagnosis.verdict.sequential import SequentialTest
from models.diagnosis.verdict.stretch import Stretch
from models.physics.rotor import PARAMETERS
from models.signals.block import FloatArray
from tests.diagnosis.verdict.gaussian_hops import true
from tests.diagnosis.verdict.test_sequential import SETTINGS

WINDOW_NS = 60_000_000_000


def information(error: float, correlation: float) -> FloatArray:
    """Of a window in which the unbalance has this error, correlated with that of damping."""
    found = np.diag(np.array([0.03, 0.07, 0.03, 0.07, error, 0.01]) ** 2)
    c, e = PARAMETERS.index("c_by"), PARAMETERS.index("e")
    found[c, e] = found[e, c] = correlation * 0.07 * error
    return np.asarray(np.linalg.inv(found), dtype=np.float64)


def test_a_window_is_believed_where_a_sum_with_the_one_before_names_another_parameter() -> None:
    test = SequentialTest(replace(SETTINGS, short_hops=()))
    healthy, now, grown = information(0.03, -0.6), information(0.06, 0.75), true(e=0.35)
    for end_ns in range(WINDOW_NS, 2 * WINDOW_NS, WINDOW_NS // 12):
        test.update({12: Stretch(end_ns - WINDOW_NS, end_ns, 0 * grown, healthy)})
    verdict = test.update({12: Stretch(WINDOW_NS, 2 * WINDOW_NS, now @ grown, now)})
    assert [one.name for one in verdict.changed] == ["e"]
