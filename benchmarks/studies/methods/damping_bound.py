"""Smallest error of damping readings by a method that knows only the form of a bearing's relation.

The relation states that a combination of motions equals a force that is uncorrelated with motions earlier than the
force's memory. Nothing else is known: not the relation's coefficients, which are learned from a healthy recording of
finite length, nor the force, nor the rest of the machine. The available information is the moments of this combination
with past motions; the bound is the error at their optimal weighting for a Gaussian process (L. P. Hansen,
J. Econometrics 30 (1985)). It is computed from the rotor's true spectra and the sensors' true noise.

The kernels over lags are the monitor's. Halving their spacing or doubling the lags changes no error by more than 10 %.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.finite_elements.assembly import assemble, probed, unbalance_response
from benchmarks.finite_elements.forces import distribution, forced
from benchmarks.finite_elements.observed import MOTION, RATE_HZ, RunCondition
from benchmarks.finite_elements.rotor import BeamRotor, changed_rotor
from benchmarks.studies.subjects.watched_machine import displacement_response
from models.diagnosis.baseline.lag_moments import SHORTEST_LAG_FROM_S, LagMoments, inverse, row_window
from models.diagnosis.baseline.learned import references_of
from models.diagnosis.baseline.relation import prior_of
from models.diagnosis.baseline.rows import Row
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.block import FloatArray

_STEP_HZ = 0.1
_ROUNDS = 20


def expected(rotor: BeamRotor, condition: RunCondition, like: WindowStatistics) -> WindowStatistics:
    """Expected statistics of a window: true spectra, and the corresponding correlation functions."""
    changed = changed_rotor(rotor, condition.changes)
    equations, at = assemble(changed, condition.speed_rad_s), list(probed(changed))
    f = np.arange(0.0, RATE_HZ / 2 + _STEP_HZ / 2, _STEP_HZ)
    places = list(forced(condition.forces))
    kept = [*at, *(one for one in places if one not in at)]
    rate = 2j * np.pi * f[:, None, None]
    moved = displacement_response(equations, kept, f)[:, : len(at)][:, :, [kept.index(one) for one in places]]
    moved = np.concatenate([moved, rate * moved], axis=1)
    S = np.zeros((f.size, len(MOTION), len(MOTION)), dtype=np.complex128)
    for force, spread in zip(condition.forces, distribution(condition.forces), strict=True):
        colour = force.colour
        resolved = np.linalg.solve(rate * np.eye(len(colour.R)) - colour.R, np.asarray(colour.S, dtype=np.complex128))
        source = (moved @ spread)[:, :, None] * (colour.output @ resolved)[:, None, :]
        S += source @ source.conj().transpose(0, 2, 1)
    whirl = unbalance_response(changed, condition.speed_rad_s)[at]
    whirl = np.concatenate([whirl, 1j * condition.speed_rad_s * whirl])
    variance = 2 * _STEP_HZ * np.einsum("fii->i", S).real + np.abs(whirl) ** 2 / 2
    noise = np.diag(condition.noise_relative**2 * variance / RATE_HZ)
    count = 2 * (f.size - 1)
    lagged = np.fft.irfft(S.transpose(0, 2, 1), n=count, axis=0) * count * _STEP_HZ
    correlation = lagged[np.round(like.lags_s * count * _STEP_HZ).astype(int)]
    band = (f >= like.frequencies_hz[0]) & (f <= like.frequencies_hz[-1])
    return replace(
        like,
        states=MOTION,
        correlation=correlation,
        hop_correlation=correlation[None],
        spectrum=np.asarray(S[band] + noise, dtype=np.complex128),
        frequencies_hz=f[band],
        speed_rad_s=condition.speed_rad_s,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Score function: deviation of a window's moments from their mean, weighted to the units of the information."""

    mean: LagMoments
    combination: FloatArray  # coefficients of the terms whose sum is the force
    weights: FloatArray  # (n_information, n_moments)

    def of(self, row: Row, window: WindowStatistics) -> FloatArray:
        """Compute the score of a simulated window."""
        seen = row_window(row, window, MOTION, self.mean.of.references).beyond(SHORTEST_LAG_FROM_S)
        return np.asarray(self.weights @ (seen.values - self.mean.values) @ self.combination, dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class DampingBound:
    """Information on the changes of a row's own parameters and on its coefficients, from a window and a recording."""

    row: Row
    information: FloatArray  # (n_own + n_coefficients, n_own + n_coefficients)
    left: float  # expected excess χ² of the relation in the healthy recording over chance, i.e. its model error
    scores: tuple[Score, Score]  # for a later window, and for a healthy one

    def error(self, parameter: str, *, alone: bool) -> float:
        """Smallest standard error of a parameter's relative change; `alone` if no other parameter may have changed."""
        at = [own.parameter for own in self.row.own].index(parameter)
        n = len(self.row.own)
        kept = [at, *range(n, len(self.information))] if alone else list(range(len(self.information)))
        covariance = np.linalg.inv(self.information[np.ix_(kept, kept)])
        where = kept.index(at)
        return float(np.sqrt(covariance[where, where]))

    def oracle(self, parameter: str, window: WindowStatistics, healthy: Sequence[WindowStatistics]) -> float:
        """Error of an oracle that uses the true optimal weights, for one simulated window and its healthy windows."""
        later, before = self.scores
        seen = (later.of(self.row, window), *(before.of(self.row, one) for one in healthy))
        at = [own.parameter for own in self.row.own].index(parameter)
        return float(np.linalg.solve(self.information, np.sum(seen, axis=0))[at])


def damping_bound(
    row: Row, healthy: WindowStatistics, later: WindowStatistics, changes: dict[str, float], durations_s: FloatArray
) -> DampingBound:
    """Information from statistics of `expected`, the later ones with the changes.

    `durations_s` are the lengths of the healthy recording and of the later data.
    """
    references = references_of(MOTION)
    before, after = (row_window(row, one, MOTION, references).beyond(SHORTEST_LAG_FROM_S) for one in (healthy, later))
    times = durations_s / healthy.duration_s
    X, y = before.values[:, 1:], before.values[:, 0]
    b, prior = np.zeros(row.n_coefficients), np.zeros((row.n_coefficients, row.n_coefficients))
    for _ in range(_ROUNDS):
        W, _rank = inverse(before.covariance(np.concatenate([[1.0], -b])))
        b = np.linalg.solve(times[0] * X.T @ W @ X + prior, times[0] * X.T @ W @ y)
        prior = prior_of(row, b, minimal=False)
    W, _rank = inverse(before.covariance(np.concatenate([[1.0], -b])))
    left = times[0] * float((y - X @ b) @ W @ (y - X @ b))
    combination = np.concatenate([[1.0], -b])
    changed, slopes = combination.copy(), np.zeros((combination.size, len(row.own)))
    for number, own in enumerate(row.own):
        terms = list(own.terms)
        slopes[terms, number] = combination[terms]
        changed[terms] *= 1 + changes.get(own.parameter, 0.0)
    # Derivatives of y - X b, with the changes applied, with respect to the changes and to the coefficients.
    to_b = -np.eye(combination.size)[:, 1:] * (changed[1:] / combination[1:])
    W_later, _rank = inverse(after.covariance(changed))
    D = after.values @ np.hstack([slopes, to_b])
    information = times[1] * D.T @ W_later @ D
    n = len(row.own)
    information[n:, n:] += times[0] * X.T @ W @ X + prior
    taught = np.vstack([np.zeros((n, len(W))), X.T @ W])
    scores = Score(after, changed, -D.T @ W_later), Score(before, combination, taught)
    return DampingBound(row, np.asarray(information, dtype=np.float64), left, scores)
