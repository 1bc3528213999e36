"""How far a window is from all that the model can explain: tests of single causes outside the model, and the total.

Masses and shaft of a machine file are never exact, so even the healthy machine deviates from its theory. It does so
equally in every window: the score of each cause is compared with its mean in the healthy windows.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat
from scipy.special import chdtri, log_ndtr, ndtri

from models.physics.rotor import impossible
from models.signals.block import FloatArray

ACROSS = "share"  # first word of the name of a sensor's cross-axis part, from the motion in the other plane
DELAY = "delay"  # first word of the name of a channel's delay relative to the others
EACH_LATE = f"{DELAY} of each channel after the one before"
UNEQUAL = "shaft stiffer in y than in z"
_LEAST_SUSPECT_Z = 5.0
# Smallest change that is named: no sensor or machine file is more accurate, but with one source a tenth is significant.
_LEAST_SUSPECT = 5e-3
_SCATTER = 1e-4  # significance level at which the scatter of a score among healthy windows is more than chance
_MOST_STATED_CHANGE = 0.5  # largest one-step estimate whose size is stated: beyond it, only "not small" is certain
_LEAST_DELAY_S, _LONGEST_DELAY_S = 2e-6, 1e-3  # the same two limits for delays
# Least part of the excess that a single cause must account for to be named: in an unexplained window, and in any other.
# Among delays, gains and masses, the right cause mostly accounted for at least a third, and always for a sixth if the
# window was not unexplained; with another rotor or force, such as a whirl, no cause accounted for a twentieth.
_ACCOUNTS, _ACCOUNTS_LITTLE = 1 / 3, 1 / 10


@dataclass(frozen=True, slots=True)
class AlternativeTest:
    """Score test of one cause outside the model on a window."""

    name: str
    z: float  # its score in standard errors
    change: float  # one-step estimate of its relative size; of a delay, s
    pair: tuple[str, ...] = ()  # two sensors that disagree, if that is the cause; `name` blames one of them

    @property
    def quantity(self) -> str:
        """Kind of quantity: the first word of the name."""
        return self.name.split()[0]

    @property
    def tried(self) -> str:
        """Key that identifies the cause from window to window."""
        return " and ".join(self.pair) or self.name

    @property
    def told(self) -> str:
        """The cause and its size in words; empty if it is too small to matter, or impossible."""
        change, quantity = self.change, self.quantity
        least, most, size = _LEAST_SUSPECT, _MOST_STATED_CHANGE, f"{change:+.1%}"
        if quantity == DELAY:
            least, most, size = _LEAST_DELAY_S, _LONGEST_DELAY_S, f"{1e6 * change:+.0f} µs"
        # An unequal shaft that gains in y loses as much in z.
        if abs(change) < least or impossible(-abs(change) if self.name == UNEQUAL else change, quantity):
            return ""
        return f"{self.name} ({size})" if abs(change) <= most else self.name


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """A cause outside the model, as which changes of parameters a window would show it, and what shows it besides."""

    name: str
    # (6,): changes read per unit of it, in the order of `PARAMETERS` and the scale of their errors (see `Stretch`)
    taken_for: FloatArray
    information: float  # on its size, beyond what parameters imitate
    score: float  # of the window, with that variance

    def fitted(self, vector: FloatArray, information: FloatArray, known: Sequence[int]) -> tuple[float, float]:
        """Its size if it alone is the cause, and how much it explains, in squared standard errors.

        `vector` and `information` are those of a stretch (`Stretch`), with the parameters `known` alone.
        """
        taken = self.taken_for[list(known)]
        weight = float(taken @ information @ taken) + self.information
        seen = float(taken @ vector) + self.score
        return (seen / weight, seen**2 / weight) if weight > 0 else (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Goodness:
    """How well the theory explains a window."""

    excess_z: float  # total squared excess of the whitened spectra over its expectation, in standard deviations
    alternatives: tuple[AlternativeTest, ...]  # all causes tried
    tests: int  # number of independent tests among them and the total
    excess: float = 0.0  # total squared excess beyond its expectation, in squared standard errors of a score

    @property
    def misfit_z(self) -> float:
        """The most significant test, Šidák-corrected: standard normal (one-sided) if the model holds."""
        two_sided = [-float(np.log(2) + log_ndtr(-abs(one.z))) for one in self.alternatives]
        worst, tests = max([-log_ndtr(-self.excess_z), *two_sided]), self.tests
        log_p = np.log(-np.expm1(tests * np.log1p(-np.exp(-worst)))) if worst < 30 else np.log(tests) - worst
        return -float(ndtri(np.exp(max(log_p, -700.0))))

    @property
    def suspect(self) -> str:
        """The alternative with the largest score, if that is beyond 5 standard errors and possible; else empty.

        A one-step estimate that is physically impossible rules the cause out. No suspect is named then, because the
        second-best score explains even less.
        """
        if not self.alternatives:
            return ""
        best = max(self.alternatives, key=lambda one: abs(one.z))
        return best.told if abs(best.z) > _LEAST_SUSPECT_Z else ""

    def suspected(self, *, unexplained: bool) -> str:
        """`suspect`, if it alone accounts for some of the excess, or much of it if the window is unexplained."""
        accounted = max([one.z**2 for one in self.alternatives], default=0.0)
        return "" if accounted < (_ACCOUNTS if unexplained else _ACCOUNTS_LITTLE) * self.excess else self.suspect


_Error = Annotated[FiniteFloat, Field(ge=0)]


class HealthyMisfit(BaseModel, extra="forbid", frozen=True):
    """How far healthy windows lie from the theory, for windows of the monitor's length."""

    mean: FiniteFloat = Field(description="mean of the windows' misfit, standard deviations")
    scores: dict[str, FiniteFloat] = Field(description="mean score of each thing that was tried, standard errors")
    error: _Error = Field(description="standard error of the mean scores")
    excess: FiniteFloat = Field(description="mean total excess, standard deviations")
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

        For a given deviation, scores grow with the root of the data's length, and the total excess with the length.
        They also depend on the excitation: with one force a gain error of 1 % is many standard errors, with several
        hardly one. `parts` are the lengths of the windows' data over that of a window of the monitor.
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
        """A later window's scores and excess beyond the healthy ones: as if the theory explained the healthy machine.

        `part` is the length of its data over that of a window of the monitor.
        """
        root = math.sqrt(part)
        alternatives = []
        for one in window.alternatives:
            if one.quantity == DELAY and one.tried not in self.scores:
                continue  # an earlier version did not test delays, so their healthy scores are unknown
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
    """Standard deviation of a new value about the mean beyond its own variance; 0 if that may be chance."""
    count = len(values)
    if count < 2 or np.sum((values - values.mean()) ** 2 / variances) < chdtri(count - 1, _SCATTER):
        return 0.0
    return math.sqrt(max(0.0, float(values.var(ddof=1) - variances.mean())) * (1 + 1 / count))
