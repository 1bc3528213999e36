"""The relation of one row: learning it on healthy windows, and reading the changes of later windows against it.

Both are least-squares problems with errors in all variables: the moments of the terms scatter with the same force as
the residual. Uncorrected, that biases the coefficients towards zero (many weak instruments), so the known part of the
scatter is subtracted from the normal equations (k-class estimator, k being the smallest root and at most one).

A covariance approximates the criterion near its minimum by a parabola. In directions that the windows determine weakly
the criterion is flatter: the estimate moves to where the noise of the terms hides the misfit, and so does the parabola.
The interval is then taken from the criterion itself, which is valid however weak the instruments are.

References
----------
J. H. Stock and J. H. Wright, "GMM with weak identification", Econometrica 68 (2000).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.linalg import eigh

from models.diagnosis.baseline.lag_moments import (
    LAG_FROM_S,
    LONGEST_LAG_FROM_S,
    SHORTEST_LAG_FROM_S,
    LagMoments,
    RowWindow,
    inverse,
    telling,
)
from models.diagnosis.baseline.numbers import Covariance, NotNegative, Vector
from models.diagnosis.baseline.rows import Row
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.signals.block import FloatArray

_RISE = 4.0  # rise of the criterion at two standard errors if the covariance is right
# Distances tried, standard errors: the last one stretches the errors about twentyfold.
_STEPS = 2.0 * 1.4 ** np.arange(10)


def stretching(criterion: Callable[[FloatArray], float], b: FloatArray, covariance: FloatArray) -> FloatArray:
    """Matrix A that stretches errors e with the given covariance to errors A e that agree with the criterion.

    The criterion is χ² as a function of the estimate; `covariance`, shape (n, n), is that of the estimate `b`, (n,).
    """
    spread = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(spread, spread))
    lowest = criterion(b)
    scales = np.ones(b.size)
    for number, (value, vector) in enumerate(zip(np.maximum(values, 1e-12), vectors.T, strict=True)):
        step = np.sqrt(value) * vector * spread
        for sign in (1, -1):
            for distance in _STEPS:
                if criterion(b + sign * distance * step) - lowest >= _RISE:
                    break
                scales[number] = max(scales[number], distance / np.sqrt(_RISE))
    return np.asarray((vectors * scales) @ vectors.T * np.outer(spread, 1 / spread), dtype=np.float64)


def relation_criterion(parts: Sequence[LagMoments], prior: FloatArray, b: FloatArray) -> float:
    """χ² of the residual moments of healthy windows, weighted as at these coefficients, less its expectation.

    The prior, shape (n, n), is the prior precision of the coefficients.
    """
    combination = np.concatenate([[1.0], -b])
    total = float(b @ prior @ b)
    for part in parts:
        W, kept = inverse(part.covariance(combination))
        left = part.values @ combination
        total += float(left @ W @ left) / part.widening(combination, W, kept) - kept
    return total


_MEMORY_PERIODS = 1.1
_CUTOFFS_HZ = np.geomspace(10.0, 300.0, 40)
_NOISES = np.concatenate([[0.0], np.geomspace(1e-6, 10.0, 25)])
_LOWEST_RAISED_HZ = 8.0
_COHERENT = 0.9  # least share of the coherence that one source explains: 0.97 to 1 with one, 0.6 to 0.85 with several


def lag_beyond_memory(row: RowWindow, combination: FloatArray) -> float:
    """Lag, s, beyond which the autocorrelation of a force with this residual's spectrum is at most a few per cent.

    The residual is the force plus the noise of the accelerations. A second-order roll-off and a noise that rises with
    f⁴ are fitted by Whittle's likelihood on a grid. Too long a lag costs precision, too short a lag shows as misfit. If
    the row was differentiated, that is undone first, and the lowest frequencies, with most sensor noise, are left out.
    """
    raised = row.formation.raised
    scale = row.window.time_scale
    f = row.window.frequencies_hz * scale  # scaled to a machine that suits the usual window
    used = f >= _LOWEST_RAISED_HZ if raised else np.ones(f.size, dtype=bool)
    f = f[used]
    residual = np.einsum("i,fij,j->f", combination, row.spectra, combination, optimize=True).real
    density = np.clip(residual, 0.0, None)[used] / f ** (2 * raised)
    logarithm, inverse_model = _models(f.tobytes())
    cost = logarithm + np.log(inverse_model @ density / f.size)
    cutoff_hz = _CUTOFFS_HZ[int(np.argmin(cost)) // _NOISES.size]
    return scale * float(np.clip(_MEMORY_PERIODS / cutoff_hz, SHORTEST_LAG_FROM_S, LONGEST_LAG_FROM_S))


def one_source(window: WindowStatistics) -> bool:
    """Whether one source moves all channels: their coherence matrices have one large eigenvalue.

    Frequencies are weighted with their power. Channels of one coordinate are coherent whatever moves it, so one channel
    of each coordinate is used.
    """
    columns = list({name.split("_")[0]: number for number, name in enumerate(window.states)}.values())
    if len(columns) < 2:
        return False
    spectra = window.spectrum[:, columns][:, :, columns]
    power = np.einsum("fii->fi", spectra).real
    if not np.all(power.sum(axis=0) > 0):
        return False
    root = np.sqrt(np.maximum(power, np.finfo(float).tiny))
    largest = np.linalg.eigvalsh(spectra / root[:, :, None] / root[:, None, :])[:, -1]
    weight = np.mean(power / power.sum(axis=0), axis=1)
    return bool(weight @ largest > _COHERENT * len(columns))


@lru_cache(maxsize=8)
def _models(frequencies: bytes) -> tuple[FloatArray, FloatArray]:
    """Mean logarithm of every spectrum on the grid, shape (n,), and its inverse, shape (n, n_bins)."""
    ratio = np.frombuffer(frequencies)[None, :] / _CUTOFFS_HZ[:, None]
    force = 1 / (1 + ratio**2) ** 2
    noise = (ratio / 10) ** 4
    model = force[:, None, :] + _NOISES[None, :, None] * noise[:, None, :]
    flat = model.reshape(-1, model.shape[-1])
    return np.log(flat).mean(axis=-1), 1 / flat


_ITERATIONS, _HALVED = 8, 16
_FITS = 3.0  # standard deviations by which χ² of a relation that fits may exceed its expectation
_LAG_ROUNDS = 2
_LONGER_LAGS_S = (0.02, 0.028, 0.036, LONGEST_LAG_FROM_S)
_CONVERGED = 1e-4  # largest change of a coefficient in the last iteration, standard errors
LOST = 0.5  # standard error of a stiffness beyond which a window does not determine it


_Names = Annotated[tuple[str, ...], Field(min_length=1)]


@dataclass(frozen=True, slots=True, eq=False)
class Relation:
    """Linear relation between the correlation functions of one row on the healthy machine."""

    row: str  # name in the table of rows
    states: _Names  # measured states the terms are formed from
    references: _Names  # measured states they were correlated with
    # (n,): b of every term but the first in term₀ = Σ b term; for the bearing's row -c/k, -m2/k, -m1/k and -s
    coefficients: Annotated[Vector, Field(min_length=1)]
    covariance: Covariance  # (n, n), of the coefficients, widened if the relation did not fit
    misfit: NotNegative  # χ² of the fit per degree of freedom
    degrees_of_freedom: Annotated[int, Field(ge=1)]
    # Factor on the variances of every later window, from how well the relation holds in conditions that it was not
    # learned in; at least 1.
    allowance: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 1.0
    # Shortest lag at which the relation fits: later windows are not read below it. Zero is not stored, as older records
    # lack the field, so that their commissionings keep their identity.
    lag_from_s: Annotated[NotNegative, Field(exclude_if=lambda lag_s: lag_s == 0)] = 0.0

    @property
    def combination(self) -> FloatArray:
        """Weights of the terms whose sum is the force."""
        return np.concatenate([[1.0], -self.coefficients])


Contribution = tuple[LagMoments, FloatArray]
"""Moments of one healthy window, and the projection, (n_coefficients, n_moments), from them to a row's coefficients."""


@dataclass(frozen=True, slots=True, eq=False)
class RowChange:
    """Changes of one row's own parameters as read in one window."""

    change: FloatArray  # (n_own,), relative change of the row's own parameters
    # (n_own, n_moments): from the window's moments to the change, stretched to agree with the criterion (`stretching`),
    # and further if the residual exceeds its scatter
    projection: FloatArray
    sensitivity: FloatArray  # (n_own, n_coefficients), of the change to the relation's coefficients
    moments: LagMoments
    combination: FloatArray  # (n_terms,), weights of the terms whose sum is the window's own force
    widening: float  # scatter from hop to hop over that predicted from the spectra, at least 1, times the allowance
    chi2: float  # residual moments after the change, in units of all their errors
    degrees_of_freedom: int
    # Whether the row fits without any change, too, and its terms partly cancel. If a sensor is reversed or late they do
    # not: the residual force is then so large that anything is within its scatter.
    unchanged: bool

    @property
    def fits(self) -> bool:
        """Whether the residual is within its scatter."""
        return _by_chance(self.chi2, self.degrees_of_freedom)

    def error(self, relation: Relation) -> FloatArray:
        """Standard errors of the change, shape (n_own,), from the window and from the row's coefficients."""
        noise = self.projection @ self.moments.covariance(self.combination) @ self.projection.T * self.widening
        uncertain = self.sensitivity @ relation.covariance @ self.sensitivity.T
        return np.asarray(np.sqrt(np.diag(noise + uncertain)), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Result of least squares over healthy windows."""

    coefficients: FloatArray  # (n,)
    covariance: FloatArray  # (n, n)
    chi2: float
    degrees_of_freedom: int

    @property
    def fits(self) -> bool:
        """Whether the residual is within its scatter."""
        return _by_chance(self.chi2, self.degrees_of_freedom)


def _by_chance(chi2: float, freedom: int) -> bool:
    return bool(chi2 <= freedom + _FITS * np.sqrt(2 * freedom))


def prior_of(row: Row, start: FloatArray, *, minimal: bool) -> FloatArray:
    """Prior precision of the coefficients, shape (n, n); `minimal` all but excludes the optional terms."""
    precision = np.zeros((row.n_coefficients, row.n_coefficients))
    for number, term in enumerate(row.terms[1:]):
        spread = term.without if minimal and term.without is not None else term.spread
        if spread is None:
            continue
        along, unit = np.zeros(row.n_coefficients), 1.0
        along[number] = 1.0
        if term.in_units_of is not None:
            along[term.in_units_of - 1] = -term.about
            unit = start[term.in_units_of - 1]
        precision += np.outer(along, along) / (spread * unit) ** 2
    return precision


def _start(row: Row, parts: Sequence[LagMoments]) -> FloatArray:
    """First coefficients: least squares with the terms that have no prior, zero for the others."""
    target = np.eye(len(row.terms))[0]
    stacked = np.concatenate([part.values / np.sqrt(np.diag(part.covariance(target)))[:, None] for part in parts])
    free = [number for number, term in enumerate(row.terms) if number and term.spread is None]
    b = np.zeros(row.n_coefficients)
    b[[number - 1 for number in free]] = np.linalg.lstsq(stacked[:, free], stacked[:, 0], rcond=None)[0]
    return b


def beyond_memory(row: Row, windows: Sequence[RowWindow]) -> tuple[list[LagMoments], tuple[Fit, Fit], float]:
    """Moments of every window beyond the memory of its excitation, their `fit_row`, and a longer shortest lag, s.

    The force's spectrum, and so its memory, depends on the fitted relation. It is estimated from the fits without and
    with the optional terms, and the longer lag is used; this is done twice.

    Parts of the machine that the row omits may act for longer than the memory of the force. If no relation fits, longer
    lags are tried; the last value is the one from which a relation fits, 0 if none was needed or none helped.
    """
    parts, fits, lags = _beyond_force(row, windows)
    if any(fit.fits for fit in fits):
        return parts, fits, 0.0
    for longer in np.multiply(windows[0].window.time_scale, _LONGER_LAGS_S).tolist():
        beyond = [window.beyond(max(lag, longer)) for window, lag in zip(windows, lags, strict=True)]
        again = fit_row(row, beyond)
        if any(fit.fits for fit in again):
            return beyond, again, longer
    return parts, fits, 0.0


def _beyond_force(row: Row, windows: Sequence[RowWindow]) -> tuple[list[LagMoments], tuple[Fit, Fit], list[float]]:
    lags, used = [0.0] * len(windows), [LAG_FROM_S * window.window.time_scale for window in windows]
    parts = [window.beyond(lag) for window, lag in zip(windows, used, strict=True)]
    fits = fit_row(row, parts)
    for _ in range(_LAG_ROUNDS):
        for fit in fits:
            combination = np.concatenate([[1.0], -fit.coefficients])
            found = [lag_beyond_memory(window, combination) for window in windows]
            lags = [max(one, other) for one, other in zip(lags, found, strict=True)]
        if lags == used:
            break
        parts, used = [window.beyond(lag) for window, lag in zip(windows, lags, strict=True)], lags
        fits = fit_row(row, parts)
    return parts, fits, used


def fit_row(row: Row, parts: Sequence[LagMoments]) -> tuple[Fit, Fit]:
    """Fit a row without its optional terms, and with them."""
    start = _start(row, parts)
    full = _fit(parts, start, prior_of(row, start, minimal=False))
    return _fit(parts, full.coefficients, prior_of(row, start, minimal=True)), full


def learn_row(
    row: Row,
    parts: Sequence[LagMoments],
    fits: tuple[Fit, Fit] | None = None,
    lag_from_s: float = 0.0,
    *,
    widened: bool = True,
) -> tuple[Relation, list[Contribution]]:
    """Learn the relation of a row from moments of healthy windows that do not overlap, each in one condition.

    `fits` is the result of `fit_row` for these moments, if already known; later windows are to be read from
    `lag_from_s` on. Widening the covariance to agree with the criterion (`stretching`) takes most of the time.

    Raises
    ------
    EstimationError
        If the windows do not determine the row's own parameters.
    """
    # Leave out the optional terms if that fits, but always include their uncertainty. With one source, y2 - y1 and the
    # disc's acceleration are interchangeable, and the estimate moves along that direction by more than its covariance
    # indicates, to where the terms' own noise hides the misfit.
    minimal, full = fit_row(row, parts) if fits is None else fits
    chosen, covariance = full, full.covariance
    prior = prior_of(row, _start(row, parts), minimal=False)
    if minimal.fits:
        chosen = minimal
        covariance = _fit(parts, minimal.coefficients, prior, iterations=1).covariance
    b = chosen.coefficients
    spread = np.sqrt(np.diag(covariance))
    for own in row.own:
        for number in (term for term in own.terms if term):
            # Stiffness and damping have the sign of the first term: a fit with the other one has not determined them.
            known = -b[number - 1] > 2 * spread[number - 1]
            if not (np.all(np.isfinite(b)) and known):
                raise EstimationError(
                    f"{row.title}: the healthy recording does not determine {own.parameter}; record longer, or "
                    "while something besides the unbalance excites the machine"
                )
    misfit = chosen.chi2 / chosen.degrees_of_freedom
    stretch = np.sqrt(max(1.0, misfit)) * np.eye(b.size)
    if widened:
        stretch = stretch @ stretching(partial(relation_criterion, parts, prior), b, covariance)
    first = parts[0].of
    relation = Relation(
        row=row.name,
        states=first.formation.states,
        references=first.references,
        coefficients=b,
        covariance=stretch @ covariance @ stretch.T,
        misfit=misfit,
        degrees_of_freedom=chosen.degrees_of_freedom,
        lag_from_s=lag_from_s,
    )
    contributions = []
    for part in parts:
        W, kept = inverse(part.covariance(relation.combination))
        projection = stretch @ covariance @ part.values[:, 1:].T @ W / part.widening(relation.combination, W, kept)
        contributions.append((part, projection))
    return relation, contributions


def _fit(parts: Sequence[LagMoments], b: FloatArray, prior: FloatArray, iterations: int = _ITERATIONS) -> Fit:
    n = b.size + 1
    for _ in range(iterations):
        combination = np.concatenate([[1.0], -b])
        Q, C, rank = np.zeros((n, n)), np.zeros((n, n)), 0
        for part in parts:
            W, kept = inverse(part.covariance(combination))
            widening = part.widening(combination, W, kept)
            Q += part.values.T @ W @ part.values / widening
            C += part.noise(W) / widening
            rank += kept
        before = b
        b, covariance = _least_squares(Q, C, prior)
        if np.all(np.abs(b - before) <= _CONVERGED * np.sqrt(np.abs(np.diag(covariance)))):
            break
    left = np.concatenate([[1.0], -b])
    return Fit(b, covariance, float(left @ Q @ left), max(1, rank - b.size))


def _least_squares(Q: FloatArray, C: FloatArray, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Regress the first variable on the others, given the matrix of products Q and its part C due to scatter."""
    scale = 1 / np.sqrt(np.diag(Q))
    root = float(eigh(Q * np.outer(scale, scale), C * np.outer(scale, scale), eigvals_only=True)[0])
    k = min(1.0, root)
    normal = Q[1:, 1:] - k * C[1:, 1:] + prior
    unit = 1 / np.sqrt(np.diag(normal))
    covariance = np.linalg.pinv(normal * np.outer(unit, unit), hermitian=True) * np.outer(unit, unit)
    return covariance @ (Q[1:, 0] - k * C[1:, 0]), covariance


def read_row(row: Row, relation: Relation, window: RowWindow) -> RowChange:
    """Read the change of a row's own parameters in one window.

    Moments are weighted by all uncertainties including the relation's: directions in which the healthy recording did
    not determine the relation carry little weight.

    Too short an estimate of the force's memory leaves a residual beyond its scatter. If so, and the longer lag of the
    first reading leaves none, that reading is used, as when the relation was learned.

    Raises
    ------
    EstimationError
        If the window does not determine them: it fits without any change, and with nearly any change.
    """
    usual_s = LAG_FROM_S * window.window.time_scale
    first = change_of(row, relation, window.beyond(max(usual_s, relation.lag_from_s)), stretched=False)
    lag_s = max(relation.lag_from_s, lag_beyond_memory(window, first.combination))
    believed = change = change_of(row, relation, window.beyond(lag_s))
    # The misfit of an undetermined estimate can be anything, so whether it fits without any change is tested, too.
    unchanged = change.unchanged
    if lag_s < usual_s:
        unchanged |= first.unchanged
        if (first.fits or first.unchanged) and not change.fits:
            believed = change_of(row, relation, first.moments)
    if row.own[0].terms != (0,) or believed.error(relation)[0] <= LOST:
        return believed
    if unchanged:
        raise EstimationError(f"{row.title}: this window does not determine it at lags beyond the memory of its force")
    halved = change_of(row, relation, believed.moments, halved=True)
    # Where sensors are swapped or reversed, a loss of all stiffness may fit as well.
    remains = 1 + halved.change[0] > 2 * halved.error(relation)[0]
    return halved if halved.fits and remains else believed


def change_of(
    row: Row, relation: Relation, moments: LagMoments, *, stretched: bool = True, halved: bool = False
) -> RowChange:
    """Read the change from given moments.

    Widening the errors to agree with the criterion (`stretching`) takes most of the time. After a large change, each
    estimate may give weights that lead far away, and so on in circles; `halved` steps lead to where both agree.

    Raises
    ------
    EstimationError
        If they do not determine it.
    """
    combination = relation.combination
    X = moments.values[:, 1:]
    signatures = np.zeros((combination.size, 1 + len(row.own)))
    signatures[:, 0] = combination
    for number, own in enumerate(row.own, start=1):
        terms = list(own.terms)
        signatures[terms, number] = -combination[terms]
    Z = moments.values @ signatures
    uncertain = X @ relation.covariance @ X.T
    d, widening = np.zeros(len(row.own)), 1.0
    for _ in range(_HALVED if halved else _ITERATIONS // 2):
        combination = signatures @ np.concatenate([[1.0], -d])
        own_covariance = moments.covariance(combination)
        kept = telling(own_covariance)
        used, grid = moments.only(kept), np.ix_(kept, kept)
        widening = used.widening(combination, np.linalg.inv(own_covariance[grid]), kept.size) * relation.allowance
        W = np.linalg.inv(own_covariance[grid] * widening + uncertain[grid])
        Q = Z[kept].T @ W @ Z[kept]
        C = signatures.T @ used.noise(W) @ signatures * widening
        before = d
        d, covariance = _least_squares(Q, C, np.zeros((d.size, d.size)))
        if np.all(np.abs(d - before) <= _CONVERGED * np.sqrt(np.abs(np.diag(covariance)))):
            break
        if halved:
            d = (before + d) / 2
    if not np.all(np.diag(covariance) > 0):
        raise EstimationError(f"{row.title}: the bearing hardly moves in this window")
    projection = np.zeros((d.size, len(Z)))
    projection[:, kept] = covariance @ Z[kept, 1:].T @ W
    left = Z[kept, 0] - Z[kept, 1:] @ d

    def criterion(trial: FloatArray) -> float:
        force = signatures @ np.concatenate([[1.0], -trial])
        rest = used.values @ force
        return float(rest @ np.linalg.solve(used.covariance(force) * widening + uncertain[grid], rest))

    chi2, freedom = float(left @ W @ left), max(1, kept.size - d.size)
    # A residual beyond its scatter comes from an error that is not modelled, which affects the change, too.
    beyond = 1.0 if _by_chance(chi2, freedom) else chi2 / freedom
    stretch = stretching(criterion, d, covariance) if stretched else np.eye(d.size)
    return RowChange(
        change=d,
        projection=np.sqrt(beyond) * stretch @ projection,
        sensitivity=-projection @ X,
        moments=moments,
        combination=combination,
        widening=widening,
        chi2=chi2,
        degrees_of_freedom=freedom,
        unchanged=_by_chance(criterion(np.zeros(d.size)), kept.size) and not _cancels_nothing(relation, moments),
    )


def _cancels_nothing(relation: Relation, moments: LagMoments) -> bool:
    """Whether the residual of the learned relation exceeds the sum of its terms' powers, as if a sign were wrong."""
    parts = [np.trace(moments.covariance(part)) for part in np.diag(relation.combination)]
    return bool(np.trace(moments.covariance(relation.combination)) > sum(parts))
