"""What depends on the conditions that relations are learned under: the force, and how large the motion is.

Parts of the machine that a relation omits bias its coefficients. As long as the same force moves the machine the bias
is constant and cancels in a change. The residual of each row is that force, as far as the sensors show it. Its
cross-spectra in bands describe its level, colour and direction.

A relation is linear and reads the stiffness at the amplitude of its own window. If the stiffness grows with the motion,
a force of another direction or level changes it without a fault; the standard errors of the stiffness allow for that,
as far as the hops of the healthy recording show it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import FiniteFloat

from models.diagnosis.baseline.lag_moments import LagMoments, RowWindow
from models.diagnosis.baseline.numbers import NotNegative, Positive
from models.diagnosis.baseline.relation import Relation, change_of
from models.diagnosis.baseline.rows import Row
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.signals.block import ComplexArray, FloatArray

_BAND_HZ = 8.0
# Largest distance at which two forces count as the same. On finite-element rotors (overhung, between bearings; seeds
# 100 to 105, windows of 30 s) the same force is 0.0005 to 0.019 from itself with changes of up to c -40 %, up to 0.038
# with k -25 %; forces of the same colour and level in other directions 0.044 to 0.97, one window in ten below 0.09.
_MOST_DISTANCE = 0.03


def force_spectrum(windows: Sequence[RowWindow], combinations: Sequence[FloatArray]) -> FloatArray:
    """Mean cross-spectra of the residuals of all rows in one window, by bands, shape (n_bands, n_rows, n_rows).

    The residual of each row is a combination of its terms. Real parts are stored on and above the diagonal, imaginary
    parts below.
    """
    window = windows[0].window
    forces = np.stack([one.terms @ combination for one, combination in zip(windows, combinations, strict=True)], axis=1)
    spectra = forces @ window.spectrum @ forces.conj().transpose(0, 2, 1)
    f = window.frequencies_hz
    bands = np.array_split(spectra, max(1, int((f[-1] - f[0]) * window.time_scale // _BAND_HZ)))
    mean = np.stack([band.mean(axis=0) for band in bands])
    return np.asarray(np.triu(mean.real) + np.tril(mean.imag, -1), dtype=np.float64)


def alike(healthy: FloatArray, now: FloatArray) -> bool:
    """Whether two forces (`force_spectrum`) agree in level, colour and direction.

    In each band, every row is normalised with its own healthy power.
    """
    power = np.einsum("fii->fi", healthy)
    if healthy.size == 0 or healthy.shape != now.shape or not np.all(power > 0):
        return False
    root = np.sqrt(power)
    A, B = (_hermitian(one) / root[:, :, None] / root[:, None, :] for one in (healthy, now))
    return bool(np.linalg.norm(A - B) ** 2 < 2 * _MOST_DISTANCE * np.linalg.norm(A) * np.linalg.norm(B))


def _hermitian(packed: FloatArray) -> ComplexArray:
    real, imaginary = np.triu(packed), np.tril(packed, -1)
    mirrored = np.triu(packed, 1).transpose(0, 2, 1)
    return np.asarray(real + mirrored + 1j * (imaginary - imaginary.transpose(0, 2, 1)), dtype=np.complex128)


_MOST_CHANCE_RATIO = 4.0  # squared ratio of growth to its standard error up to which growth is taken for chance
# Largest hidden growth assumed where the power of the motion is e times as large or as small, or beyond; if smaller,
# the standard error of the growth is used. Every stiffness carries half a per cent in any case (`rows.py`).
_UNSEEN, _CARRIED = 0.02, 0.005


@dataclass(frozen=True, slots=True)
class Growth:
    """Growth of the scale of a row with the power of the motion that it resists."""

    power: Positive  # mean of the healthy windows
    slope: FiniteFloat  # relative change of the scale where the power changes by `power`
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
