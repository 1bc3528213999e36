"""Stories of changes told to the sequential test, in Gaussian hops with given standard errors."""

import numpy as np

from models.diagnosis.verdict.sequential import SequentialSettings, SequentialTest
from models.diagnosis.verdict.stretch import Stretch, to_scale
from models.physics.rotor import PARAMETERS
from models.signals.block import FloatArray
from rotorwatch.records.windows import Verdict


class GaussianHops:
    """Hops that carry the information of a machine, without the machine.

    Every hop's estimate is normal around the mean of the true values in it; stretches are means of hops. The covariance
    is that of one full window, in the scale of the errors.
    """

    def __init__(self, settings: SequentialSettings, covariance: FloatArray, rng: np.random.Generator) -> None:
        self.settings, self._rng = settings, rng
        self._factor = np.linalg.cholesky(covariance * settings.window_hops)
        self._information = np.linalg.inv(covariance * settings.window_hops)
        self._hops: list[FloatArray] = []
        self._count = 0

    def looks(self, true: FloatArray) -> dict[int, Stretch]:
        """Stretches after one more hop with these mean true values; empty while the window is not full."""
        settings = self.settings
        self._hops.append(true + self._factor @ self._rng.standard_normal(len(PARAMETERS)))
        self._hops = self._hops[-settings.window_hops :]
        self._count += 1
        if self._count < settings.window_hops:
            return {}
        end_ns = round(self._count * settings.hop_s * 1e9)
        looks = {}
        for hops in (*settings.short_hops, settings.window_hops):
            information = np.asarray(self._information * hops, dtype=np.float64)
            vector = np.asarray(information @ np.mean(self._hops[-hops:], axis=0), dtype=np.float64)
            start_ns = end_ns - round(hops * settings.hop_s * 1e9)
            looks[hops] = Stretch(start_ns, end_ns, vector, information)
        return looks


def true(**changes: float) -> FloatArray:
    """Relative changes of parameters, in the scale of the errors."""
    values = np.zeros(len(PARAMETERS))
    for name, change in changes.items():
        values[PARAMETERS.index(name)] = to_scale(name, change)
    return values


def play(test: SequentialTest, hops: GaussianHops, *story: tuple[int, FloatArray]) -> list[tuple[int, Verdict]]:
    """Verdicts with their hop numbers, for a story of numbers of hops and their true values."""
    verdicts, number = [], 0
    for count, values in story:
        for _ in range(count):
            looks = hops.looks(values)
            if looks:
                wanted = (*test.wanted(), hops.settings.window_hops)
                verdicts.append((number, test.update({h: look for h, look in looks.items() if h in wanted})))
            number += 1
    return verdicts
