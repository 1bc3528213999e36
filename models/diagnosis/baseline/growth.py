"""How a bearing's stiffness grows with its displacement, as far as the hops of the healthy recording show it.

A relation is linear and reads the stiffness at the amplitude of its own window. If the stiffness grows with the motion,
a force of another direction or level changes it without a fault; the standard errors of the stiffness allow for that.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.diagnosis.baseline.lag_moments import LagMoments
from models.diagnosis.baseline.numbers import NotNegative, Number, Positive
from models.diagnosis.baseline.relation import Relation, change_of
from models.diagnosis.baseline.rows import Row
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.signals.block import FloatArray

_MOST_CHANCE_RATIO = 4.0  # squared ratio of growth to its standard error up to which growth is taken for chance
# Largest hidden growth assumed where the power of the motion is e times as large or as small, or beyond; if smaller,
# the standard error of the growth is used. Every stiffness carries half a per cent in any case (`rows.py`).
_UNSEEN, _CARRIED = 0.02, 0.005


@dataclass(frozen=True, slots=True)
class Growth:
    """Growth of the scale of a row with the power of the motion that it resists."""

    power: Positive  # mean of the healthy windows
    slope: Number  # relative change of the scale where the power changes by `power`
    standard_error: NotNegative  # of the slope

    def seen_variance(self, power: float) -> float:
        """Variance of the scale's relative change at another power of the motion, from growth beyond chance.

        A stiffness that falls as the motion grows is taken for chance.
        """
        seen = max(0.0, self.slope**2 - _MOST_CHANCE_RATIO * self.standard_error**2) if self.slope > 0 else 0.0
        return seen * (power / self.power - 1) ** 2

    def unseen_variance(self, power: float) -> float:
        """The same from growth that scatter may have hidden, beyond the error that every stiffness carries."""
        hidden = max(0.0, min(_UNSEEN, self.standard_error) ** 2 - _CARRIED**2)
        return hidden * min(1.0, abs(math.log(power / self.power))) ** 2


def growth_of(row: Row, relation: Relation, parts: Sequence[LagMoments]) -> Growth | None:
    """Regress the scale of a row, read in each hop of the healthy windows, on the power of its motion.

    Each window is centred on its own mean and weighted by its standard error, because a window that hardly determines
    the scale reads large changes by chance. None if the row reads no scale, or the hops do not determine the growth.
    """
    at = next((number for number, own in enumerate(row.own) if 0 in own.terms), None)
    powers = [one for part in parts if (one := motion_power(row, relation, part.of.window)) is not None]
    freedom = sum(one.size - 1 for one in powers) - 1
    if at is None or freedom < 1 or len(powers) < len(parts):
        return None
    power = float(np.mean(np.concatenate(powers)))
    levels, found = [], []
    for part, own in zip(parts, powers, strict=True):
        try:
            change = change_of(row, relation, part)
        except (EstimationError, np.linalg.LinAlgError):
            return None
        along = change.projection[at]
        hops = part.hop_values @ change.combination @ along
        error = np.sqrt(own.size * change.widening * (along @ part.covariance(change.combination) @ along))
        levels.append((own - own.mean()) / error)
        found.append((hops - hops.mean()) / error)
    x, y = np.concatenate(levels), np.concatenate(found)
    if not (power > 0 and x @ x > 0):
        return None
    x /= power
    slope = float(x @ y / (x @ x))
    rest = y - slope * x
    return Growth(power, slope, float(np.sqrt(rest @ rest / freedom / (x @ x))))


def motion_power(row: Row, relation: Relation, window: WindowStatistics) -> FloatArray | None:
    """Power of the stochastic motion that a row's scale resists, in each hop, shape (n_hops,); None if not measured.

    Motion at running speed is not included, so a stiffening due to growing unbalance is not seen.
    """
    coordinate = row.terms[0].motions[0].coordinate
    at = [window.states.index(name) for name in relation.references if name in window.states and name[:2] == coordinate]
    return np.asarray(window.hop_correlation[:, 0, at[0], at[0]], dtype=np.float64) if at else None
