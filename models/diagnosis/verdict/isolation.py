"""Which parameters changed: a choice among all sets of parameters, with its confidence.

For every set A the parameters outside A are held at nominal. What the set then leaves unexplained,
R(A) = x'Jx - x_A' J_AA x_A with the restricted estimate x_A = J_AA⁻¹ (Jx)_A, is χ² with one degree of freedom per
parameter outside A if nothing outside A changed. A set pays for its size, R(A) + h₁² + (|A| - 1) h₂², and the cheapest
set is the verdict. So a single parameter is named if its restricted test value exceeds h₁, the declared rate's
threshold, and another one is added if it reduces R by more than h₂². The price of two would hide two small changes, so
what the best pair explains is also compared with what chance lets a pair explain: if it is more, something has changed,
and the cheapest set that is not empty is the verdict.

This amounts to prior odds of exp(-h₁²/2) for the first and exp(-h₂²/2) for every further changed parameter, with the
spread of possible sizes included. The confidence is the posterior probability under that prior.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, compress

import numpy as np
from scipy.special import chdtrc, ndtr, ndtri

from models.diagnosis.misfit import Rival
from models.diagnosis.readings import Diagnosis, possible_reading
from models.diagnosis.verdict.calibration import Thresholds, widened, window_thresholds
from models.diagnosis.verdict.stretch import Stretch, from_scale, slope, stretch_of
from models.physics.rotor import PARAMETERS
from models.signals.block import FloatArray
from rotorwatch.records.windows import Alternative, Parameter

_LIKELIEST = 4  # most probable sets, which are reported whatever they hold
_LEAST_PART = 0.75  # of what parameters explain, the least that another cause must
_SURE_AGAINST = 2 * math.log(9)  # twice the logarithm of the odds at which parameters are sure against another cause
_BY_PAIRS = 0.1  # false alarms by two parameters together, over those of the declared rate


@dataclass(frozen=True, slots=True)
class Isolation:
    """Verdict on one stretch of data."""

    changed: tuple[str, ...]  # parameters that changed, in the order of `PARAMETERS`; empty: none
    confidence: float  # posterior probability of exactly this set among all sets
    probability: tuple[float, ...]  # posterior probability of each of `PARAMETERS` to be among the changed ones
    # The window is further from the model than sampling explains: something changed that no parameter describes, or a
    # sensor is at fault. The verdict on the parameters is then of low confidence.
    outside: bool = False
    outside_confidence: float | None = None  # of that, see `outside_confidence`; None where there is no such test
    alternatives: tuple[Alternative, ...] = ()  # sets that were weighed, the most probable first

    @property
    def low_confidence(self) -> bool:
        """Whether the verdict on parameters should be taken with reserve."""
        return self.outside or self.confidence < 0.5


def outside_confidence(misfit_z: float) -> float:
    """Largest confidence in "outside the model" that a misfit can give, at even prior odds.

    One minus the bound of Sellke, Bayarri and Berger (The American Statistician 55, 2001) on the posterior of the
    model: 1 / (1 + 1/(-e p ln p)) with the one-sided probability p of the misfit.
    """
    p = float(ndtr(-misfit_z))
    if p >= math.exp(-1):
        return 0.5
    bound = -math.e * p * math.log(p) if p > 0 else 0.0
    return 1 / (1 + bound)


def isolate_window(diagnosis: Diagnosis, rate: float) -> Isolation:
    """Decide one window by itself at a declared rate of false alarms per window; the test of the model has the same."""
    stretch = stretch_of(widened(diagnosis, rate), 0, 0).complete().believed()
    isolation = isolate(stretch, window_thresholds(rate, max(1, len(stretch.known))))
    return replace(isolation, changed=(), outside=True) if stretch.unexplained else isolation


def model_test(stretch: Stretch, thresholds: Thresholds) -> tuple[bool, float | None]:
    """Say of a stretch whether it is outside the model, and with what confidence; see `Isolation`."""
    if stretch.misfit_z is None or not math.isfinite(stretch.misfit_z):
        return False, None
    return stretch.misfit_z > thresholds.outside, outside_confidence(stretch.misfit_z)


def misfit_beside(stretch: Stretch, names: Collection[str]) -> float:
    """Misfit of a stretch in which no other parameters than these have changed, as a standard normal variable."""
    look = stretch.complete().believed()
    misfit_z, others = look.misfit_z or 0.0, [at for at, name in enumerate(look.names) if name not in names]
    if not others:
        return misfit_z
    values, covariance = look.estimate
    chi2 = float(values[others] @ np.linalg.solve(covariance[np.ix_(others, others)], values[others]))
    return max(misfit_z, -float(ndtri(max(chdtrc(len(others), chi2), 1e-300))))


def isolate(stretch: Stretch, thresholds: Thresholds) -> Isolation:
    """Decide a stretch of data."""
    known = stretch.known
    outside, confidence = model_test(stretch, thresholds)
    probability = np.zeros(len(PARAMETERS))
    if not known:
        return Isolation((), 1.0, tuple(probability.tolist()), outside, confidence)
    members = _members(len(known))
    J = stretch.information[np.ix_(known, known)]
    b = stretch.vector[list(known)]
    explained = _explained(J, b, members)
    price = thresholds.first**2 + (members.sum(axis=1) - 1) * thresholds.further**2
    price[0] = 0.0  # of the empty set
    gain = (explained - price) / 2
    pairs = members.sum(axis=1) == 2
    if pairs.any():
        # Where two together are beyond chance and neither is by itself, something has changed all the same.
        beyond = (float(explained[pairs].max()) - _pair_price(thresholds.first, len(known))) / 2
        gain[0] = min(0.0, float(gain[1:].max()) - beyond)
    weight = np.exp(gain - gain.max())
    weight /= weight.sum()
    best = int(np.argmax(gain))
    probability[list(known)] = weight @ members
    changed = tuple(compress(stretch.names, members[best]))
    return Isolation(
        changed=changed,
        confidence=float(weight[best]),
        probability=tuple(np.minimum(probability, 1.0).tolist()),
        outside=outside,
        outside_confidence=confidence,
        alternatives=_alternatives(stretch.names, members, weight, explained) if changed else (),
    )


def rival_of(stretch: Stretch, names: Collection[str], rivals: Sequence[Rival], thresholds: Thresholds) -> str:
    """Causes outside the model that explain a stretch as well as changes of some parameters, the best first.

    A cause is one unknown and pays the price of one parameter. The parameters must be as sure against it as a name must
    be, unless it leaves much of what they explain. The slopes of a cause hold while it is small: of a size s, about
    s²/2 of what it explains is allowed for.
    """
    if not (chosen := [i for i in stretch.known if PARAMETERS[i] in names]):
        return ""
    own, known = stretch.vector[chosen], list(stretch.known)
    explained = float(own @ np.linalg.solve(stretch.information[np.ix_(chosen, chosen)], own))
    least = max(explained - (len(chosen) - 1) * thresholds.further**2 - _SURE_AGAINST, _LEAST_PART * explained)
    as_well: dict[str, float] = {}
    for rival in rivals:
        size, by_it = rival.fitted(stretch.vector[known], stretch.information[np.ix_(known, known)], known)
        if abs(size) < 1 and by_it > least - size**2 / 2 * explained:
            as_well[rival.name] = max(as_well.get(rival.name, 0.0), by_it)
    return " or ".join(sorted(as_well, key=lambda name: -as_well[name]))


@lru_cache
def _pair_price(first: float, n: int) -> float:
    """What the best pair of n parameters explains by chance, a tenth as often as one parameter exceeds `first`."""
    alone = 2 * n * float(ndtr(-first))
    return -2 * math.log(_BY_PAIRS * alone / (n * (n - 1) / 2))


def _alternatives(
    names: tuple[str, ...], members: FloatArray, weight: FloatArray, explained: FloatArray
) -> tuple[Alternative, ...]:
    """The most probable sets, each parameter by itself, and the empty set: what a reader would ask for."""
    likeliest = np.argsort(-weight)[:_LIKELIEST].tolist()
    simple = np.flatnonzero(members.sum(axis=1) < 2).tolist()
    return tuple(
        Alternative(
            names=tuple(compress(names, members[number])),
            probability=min(1.0, float(weight[number])),
            explained=min(1.0, max(0.0, float(explained[number] / explained[-1]))),
        )
        for number in sorted({*likeliest, *simple}, key=lambda number: -weight[number])
    )


@lru_cache
def _members(n: int) -> FloatArray:
    """All sets of n parameters, the empty one first, small ones before large ones: 1 if it is in one, (n_sets, n)."""
    sets = [A for size in range(n + 1) for A in combinations(range(n), size)]
    return np.array([[float(i in A) for i in range(n)] for A in sets])


def _explained(J: FloatArray, b: FloatArray, members: FloatArray) -> FloatArray:
    """What each set explains, b_A' J_AA⁻¹ b_A, for all sets at once: parameters outside a set are decoupled from it."""
    scale = 1 / np.sqrt(np.diag(J))
    alone = J * np.outer(scale, scale) * members[:, :, None] * members[:, None, :]
    alone[:, range(b.size), range(b.size)] = 1.0
    own = b * scale * members
    return np.asarray(np.sum(own * np.linalg.solve(alone, own[:, :, None])[:, :, 0], axis=1), dtype=np.float64)


def reading_of(stretch: Stretch, name: str, by: str, value: float, error: float) -> Parameter:
    """A parameter's reading from its value and standard error in the scale of the errors."""
    if name != "e":
        return possible_reading(name, by, from_scale(name, value), error * slope(name, value))
    # If errors put an unbalance that has almost vanished below zero, it is one of that size on the other side.
    own = float(stretch.estimate[0][stretch.names.index(name)])
    vector = None if stretch.unbalance is None else stretch.unbalance.read_as(value, own)
    return possible_reading(name, by, abs(1 + value) - 1, error, vector)
