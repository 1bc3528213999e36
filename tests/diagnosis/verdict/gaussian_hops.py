"""How long the sequential test takes to find a change, on Gaussian hops with given standard errors."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from models.diagnosis.verdict.sequential import SequentialSettings, SequentialTest
from models.diagnosis.verdict.stretch import Stretch, to_scale
from models.physics.rotor import PARAMETERS
from models.signals.block import FloatArray


@dataclass(frozen=True, slots=True)
class DelayStudy:
    """Delays of independent trials.

    Attributes
    ----------
    detected_s, named_s : ndarray, shape (trials,)
        From the change to the hop at which something was detected, and to the one at which the changed parameter and no
        other was named, s; infinity where that did not happen in the time of the trial.
    wrong : int
        Trials in which, at any hop after the change, a parameter was named that did not change.
    early : int
        Trials in which something was detected before the change: false alarms; they take no part in the delays.
    """

    detected_s: FloatArray
    named_s: FloatArray
    wrong: int
    early: int


class GaussianHops:
    """Hops that carry the information of a machine, without the machine.

    Every hop's estimate is normal around the mean of the true values in it; stretches are means of hops.

    Parameters
    ----------
    settings : SequentialSettings
        Hop and lengths.
    covariance : ndarray, shape (6, 6)
        Of one full window, in the scale of the errors.
    rng : numpy.random.Generator
        Where the realisation comes from.
    """

    def __init__(self, settings: SequentialSettings, covariance: FloatArray, rng: np.random.Generator) -> None:
        self._settings, self._rng = settings, rng
        self._factor = np.linalg.cholesky(covariance * settings.window_hops)
        self._information = np.linalg.inv(covariance * settings.window_hops)
        self._hops: list[FloatArray] = []
        self._count = 0

    def looks(self, true: FloatArray) -> dict[int, Stretch]:
        """Stretches after one more hop with these mean true values; empty while the window is not full."""
        settings = self._settings
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


def detection_delays(
    settings: SequentialSettings,
    covariance: FloatArray,
    changes: Mapping[str, float],
    *,
    trials: int,
    seed: int,
    before_hops: int = 36,
    after_hops: int = 120,
) -> DelayStudy:
    """Play step changes at random moments within a hop.

    Parameters
    ----------
    settings : SequentialSettings
        The test.
    covariance : ndarray, shape (6, 6)
        Of one full window, in the scale of the errors.
    changes : mapping of str to float
        Relative changes of the parameters that step.
    trials : int
        Independent trials.
    seed : int
        Of all trials together.
    before_hops, after_hops : int
        Healthy hops before the change, hops after it.
    """
    step = np.zeros(len(PARAMETERS))
    for name, change in changes.items():
        step[PARAMETERS.index(name)] = to_scale(name, change)
    detected, named = [], []
    wrong = early = 0
    for rng in (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(trials)):
        test, hops = SequentialTest(settings), GaussianHops(settings, covariance, rng)
        share = float(rng.uniform())
        detected_s = named_s = np.inf
        false, misnamed = False, False
        for number in range(before_hops + after_hops):
            weight = 0.0 if number < before_hops else share if number == before_hops else 1.0
            looks = hops.looks(weight * step)
            if not looks:
                continue
            wanted = (*test.wanted(), settings.window_hops)
            verdict = test.update({hops: look for hops, look in looks.items() if hops in wanted})
            delay_s = (number - before_hops + share) * settings.hop_s
            if number < before_hops:
                false = false or verdict.detected
                continue
            said = {finding.name for finding in verdict.changed}
            misnamed = misnamed or bool(said - set(changes))
            detected_s = min(detected_s, delay_s if verdict.detected else np.inf)
            named_s = min(named_s, delay_s if said == set(changes) else np.inf)
        early += false
        wrong += misnamed and not false
        if not false:
            detected.append(detected_s)
            named.append(named_s)
    return DelayStudy(np.array(detected), np.array(named), wrong, early)
