"""How far a window lies from all that the model can explain: things outside the model, each tried on it, and the rest.

Masses and shaft of a machine file are never quite the machine's, so the healthy machine may lie off its theory, too. It
does so in the same way in every window: each thing that was tried is compared with its mean in the healthy windows.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field
from scipy.special import chdtri, log_ndtr, ndtri

from models.physics.rotor import impossible
from models.signals.block import FloatArray

ACROSS = "share"  # first word of what a sensor shows of its place's motion in the other plane
DELAY = "delay"  # first word of how late a channel comes, relative to the others
EACH_LATE = f"{DELAY} of each channel after the one before"
UNEQUAL = "shaft stiffer in y than in z"
_LEAST_SUSPECT_Z = 5.0
_LEAST_SUSPECT = 5e-3  # no sensor and no machine file is truer than that, and with one source a tenth of it stands out
_SCATTER = 1e-4  # probability that a score scatters so much among healthy windows by chance
_LINEAR = 0.5  # largest one-step estimate that is worth telling: farther out it only says that the thing is not small
_LEAST_DELAY_S, _LONGEST_DELAY_S = 2e-6, 1e-3  # the same of delays
# Part of the excess that a thing accounts for by itself, from which it is told: of a window that is unexplained, and of
# any other. The right one of delays, gains and masses accounted for a third at least mostly, and for a sixth always
# where the window was not unexplained; where another rotor or force was at work, such as a whirl, nothing for a
# twentieth.
_ACCOUNTS, _ACCOUNTS_LITTLE = 1 / 3, 1 / 10


@dataclass(frozen=True, slots=True)
class AlternativeTest:
    """One thing outside the model, tried on a window."""

    name: str
    z: float  # its score in standard errors
    change: float  # one-step estimate of its relative size; of a delay, s
    pair: tuple[str, ...] = ()  # two sensors whose disagreement it is, put down to the one that `name` says

    @property
    def quantity(self) -> str:
        """What kind of quantity it is."""
        return self.name.split()[0]

    @property
    def tried(self) -> str:
        """What it is known by from window to window."""
        return " and ".join(self.pair) or self.name

    @property
    def told(self) -> str:
        """The thing and its size in words; empty where that is too little to matter, or impossible."""
        change, quantity = self.change, self.quantity
        if quantity == DELAY:
            least, most, size = _LEAST_DELAY_S, _LONGEST_DELAY_S, f"{1e6 * change:+.0f} µs"
        else:
            least, most, size = _LEAST_SUSPECT, _LINEAR, f"{change:+.1%}"
        # What y gains by an unequal shaft z loses.
        if abs(change) < least or impossible(-abs(change) if self.name == UNEQUAL else change, quantity):
            return ""
        return f"{self.name} ({size})" if abs(change) <= most else self.name


@dataclass(frozen=True, slots=True)
class Goodness:
    """How well the theory explains a window."""

    excess_z: float  # total squared excess of the whitened spectra over its expectation, in standard deviations
    alternatives: tuple[AlternativeTest, ...]  # everything tried
    tests: int  # how many of them, and the total, say something of their own
    excess: float = 0.0  # total squared excess beyond its expectation, in squared standard errors of a score

    @property
    def misfit_z(self) -> float:
        """All tests in one number, standard normal (one-sided) where the model holds: the worst, Šidák-corrected."""
        worst = max([-log_ndtr(-self.excess_z), *(-_two_sided(one.z) for one in self.alternatives)])
        tests = self.tests
        log_p = np.log(-np.expm1(tests * np.log1p(-np.exp(-worst)))) if worst < 30 else np.log(tests) - worst
        return -float(ndtri(np.exp(max(log_p, -700.0))))

    @property
    def suspect(self) -> str:
        """The alternative with the largest score, if that is beyond 5 standard errors and possible; else empty.

        A one-step estimate that physics does not allow says that this is not what happened: no suspect is named then,
        for a score that is only second best explains less still.
        """
        if not self.alternatives:
            return ""
        best = max(self.alternatives, key=lambda one: abs(one.z))
        return best.told if abs(best.z) > _LEAST_SUSPECT_Z else ""

    def suspected(self, *, unexplained: bool) -> str:
        """`suspect`, if it alone accounts for some of the excess; of a window that is unexplained, for much of it."""
        accounted = max([one.z**2 for one in self.alternatives], default=0.0)
        return "" if accounted < (_ACCOUNTS if unexplained else _ACCOUNTS_LITTLE) * self.excess else self.suspect


def _two_sided(z: float) -> float:
    return float(np.log(2) + log_ndtr(-abs(z)))


_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Error = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class HealthyMisfit(BaseModel, extra="forbid", frozen=True):
    """How far healthy windows lie from the theory, for windows of the monitor's length."""

    mean: _Finite = Field(description="mean of the windows' misfit, standard deviations")
    scores: dict[str, _Finite] = Field(description="mean score of each thing that was tried, standard errors")
    error: _Error = Field(description="standard error of the mean scores")
    excess: _Finite = Field(description="mean total excess, standard deviations")
    excess_error: _Error = Field(description="its standard error")
    spreads: dict[str, _Error] = Field(
        default={},
        exclude_if=lambda spreads: not spreads,
        description="by how much scores differ from window to window besides, where that is no chance",
    )
    excess_spread: _Error = Field(
        default=0.0, exclude_if=lambda spread: not spread, description="the same of the total excess"
    )

    @classmethod
    def of(cls, windows: Sequence[Goodness], parts: Sequence[float]) -> "HealthyMisfit | None":
        """Average over healthy windows; None without any.

        A deviation of one size stands out by the root of the data's length in a score, and by the length in the total
        excess. How much it stands out depends on what shakes the machine, too: where one force does, a wrong gain of a
        hundredth is many standard errors, where several do it is hardly one. The data of each are given in parts of a
        window of the monitor.
        """
        if not windows:
            return None
        count, length = len(windows), 1 / np.array(parts)
        root = np.sqrt(length)
        scores: dict[str, list[float]] = {}
        for one, by in zip(windows, root.tolist(), strict=True):
            for each in one.alternatives:
                scores.setdefault(each.tried, []).append(by * each.z)
        kept = {name: np.array(values) for name, values in scores.items() if len(values) == count}
        excess = length * [one.excess_z for one in windows]
        spreads = {name: _spread(values, length) for name, values in kept.items()}
        return cls(
            mean=float(np.mean([by * one.misfit_z for one, by in zip(windows, root, strict=True)])),
            scores={name: float(np.mean(values)) for name, values in kept.items()},
            error=float(np.sqrt(length.sum())) / count,
            excess=float(np.mean(excess)),
            excess_error=float(np.sqrt(np.sum(length**2))) / count,
            spreads={name: spread for name, spread in spreads.items() if spread},
            excess_spread=_spread(excess, length**2),
        )

    def beyond(self, window: Goodness, part: float) -> Goodness:
        """What is left of a later window: as of a machine that the theory explains, as long as this one is as it was.

        Its data are such a part of a window of the monitor.
        """
        root = math.sqrt(part)
        alternatives = []
        for one in window.alternatives:
            if one.quantity == DELAY and one.tried not in self.scores:
                continue  # of an earlier version, which did not try them: what healthy windows had of it is not known
            left = one.z - root * self.scores.get(one.tried, 0.0)
            change = one.change * left / one.z if one.z else 0.0
            error = root * math.hypot(self.error, self.spreads.get(one.tried, 0.0))
            alternatives.append(replace(one, z=left / math.hypot(1.0, error), change=change))
        excess = window.excess_z - part * max(0.0, self.excess)
        return replace(
            window,
            excess_z=excess / math.hypot(1.0, part * self.excess_error, part * self.excess_spread),
            excess=window.excess * excess / window.excess_z if window.excess_z else 0.0,
            alternatives=tuple(alternatives),
        )


def _spread(values: FloatArray, variances: FloatArray) -> float:
    """Standard deviation of one more value about the mean beyond its own variance; 0 where chance may have made it."""
    count = len(values)
    if count < 2 or np.sum((values - values.mean()) ** 2 / variances) < chdtri(count - 1, _SCATTER):
        return 0.0
    return math.sqrt(max(0.0, float(values.var(ddof=1) - variances.mean())) * (1 + 1 / count))
