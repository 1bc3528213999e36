"""The relation of one plane: learned on healthy windows, and what a later window adds to it.

Both are least squares in which every variable has errors: the moments of the terms scatter with the same force as the
residual. Left alone that pulls the coefficients towards zero (many weak instruments), so the known part of the scatter
is taken out of the normal equations (k-class estimator, k the smallest root and at most one).
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from models.diagnosis.baseline.excitation import lag_beyond_memory
from models.diagnosis.baseline.lag_moments import LAG_FROM_S, N_TERMS, LagMoments, inverse, lag_moments
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.signals.block import FloatArray

__all__ = ["N_COEFFICIENTS", "Contribution", "PlaneChange", "PlaneRelation", "learn_plane", "read_plane"]

N_COEFFICIENTS = N_TERMS - 1
_ITERATIONS = 8
_OWN_SPREAD = 1.0  # standard deviation expected beforehand of m1/k, in units of m2/k
_SHAFT_SPREAD = 0.5  # the same of s
_FITS = 3.0  # standard deviations of χ² within which a relation is taken to fit
_NO_SHAFT_SPREAD = 0.02  # the same where there is no such term


@dataclass(frozen=True, slots=True)
class PlaneRelation:
    """What holds between the correlation functions of one plane on the healthy machine.

    Attributes
    ----------
    plane : str
        ``y`` or ``z``.
    coefficients : ndarray, shape (4,)
        Of ẏ1, ÿ2, ÿ1 and y2 - y1 in y1 = Σ b x: minus c/k, m2/k, m1/k and s.
    covariance : ndarray, shape (4, 4)
        Theirs, widened where the relation did not fit.
    misfit : float
        χ² of the fit per degree of freedom.
    degrees_of_freedom : int
    """

    plane: str
    coefficients: FloatArray
    covariance: FloatArray
    misfit: float
    degrees_of_freedom: int

    @property
    def combination(self) -> FloatArray:
        """Combination of the terms that is the force."""
        return np.concatenate([[1.0], -self.coefficients])


@dataclass(frozen=True, slots=True)
class Contribution:
    """What one healthy window adds to the coefficients of a plane.

    Attributes
    ----------
    moments : LagMoments
    projection : ndarray, shape (4, n_moments)
        From its moments to the coefficients.
    """

    moments: LagMoments
    projection: FloatArray


@dataclass(frozen=True, slots=True)
class PlaneChange:
    """What one window says of one plane.

    Attributes
    ----------
    change : ndarray, shape (2,)
        Relative change of stiffness to ground and of damping.
    projection : ndarray, shape (2, n_moments)
        From the window's moments to the change.
    sensitivity : ndarray, shape (2, 4)
        Of the change to the relation's coefficients.
    moments : LagMoments
    combination : ndarray, shape (5,)
        The window's own force.
    widening : float
        Scatter from hop to hop over what the spectra expect, at least 1.
    chi2 : float
        What the change leaves, in units of all its errors.
    degrees_of_freedom : int
    """

    change: FloatArray
    projection: FloatArray
    sensitivity: FloatArray
    moments: LagMoments
    combination: FloatArray
    widening: float
    chi2: float
    degrees_of_freedom: int


def learn_plane(windows: tuple[WindowStatistics, ...], plane: str) -> tuple[PlaneRelation, list[Contribution]]:
    """Learn the relation of a plane.

    Parameters
    ----------
    windows : tuple of WindowStatistics
        Healthy windows that do not overlap, each in one condition; they may differ from each other.
    plane : str
        ``y`` or ``z``.

    Raises
    ------
    EstimationError
        If the windows do not determine stiffness and damping.
    """
    parts = [lag_moments(window, plane, LAG_FROM_S) for window in windows]
    b, prior = _start(parts)
    fitted = _fit(parts, b, prior)
    lags = [lag_beyond_memory(part, np.concatenate([[1.0], -fitted[0]])) for part in parts]
    parts = [lag_moments(window, plane, lag) for window, lag in zip(windows, lags, strict=True)]
    b, covariance, chi2, freedom = _fit(parts, fitted[0], prior)
    # Without the last term where that fits; its uncertainty counts in either case. With one source, y2 - y1 and the
    # disc's acceleration can take each other's place, and the estimate wanders along that direction further than its
    # covariance says, to where the terms' own noise hides the misfit.
    minimal = _fit(parts, fitted[0], np.concatenate([prior[:3], [1 / _NO_SHAFT_SPREAD**2]]))
    if minimal[2] <= minimal[3] + _FITS * np.sqrt(2 * minimal[3]):
        b, _, chi2, freedom = minimal
        covariance = _fit(parts, b, prior, iterations=1)[1]
    spread = np.sqrt(np.diag(covariance))
    if not (np.all(np.isfinite(b)) and b[0] < 0 and b[0] < -2 * spread[0]):
        raise EstimationError(
            f"plane {plane}: the healthy recording does not determine the bearing's damping; record longer, or while "
            "more than the unbalance moves the machine"
        )
    misfit = chi2 / freedom
    relation = PlaneRelation(plane, b, covariance * max(1.0, misfit), misfit, freedom)
    contributions = []
    for part in parts:
        W, kept = inverse(part.covariance(relation.combination))
        widening = max(1.0, part.scatter(relation.combination, W, kept))
        contributions.append(Contribution(part, covariance @ part.values[:, 1:].T @ W / widening))
    return relation, contributions


def _start(parts: list[LagMoments]) -> tuple[FloatArray, FloatArray]:
    """First coefficients from damping and disc alone, and the precision expected beforehand of the other two."""
    rows = []
    for part in parts:
        scale = 1 / np.sqrt(np.sum(np.abs(part.factor) ** 2, axis=(0, 2)))
        rows.append(part.values * scale[:, None])
    stacked = np.concatenate(rows)
    first = np.linalg.lstsq(stacked[:, 1:3], stacked[:, 0], rcond=None)[0]
    prior = np.array([0.0, 0.0, 1 / (_OWN_SPREAD * first[1]) ** 2, 1 / _SHAFT_SPREAD**2])
    return np.concatenate([first, [0.0, 0.0]]), prior


def _fit(
    parts: list[LagMoments], b: FloatArray, prior: FloatArray, iterations: int = _ITERATIONS
) -> tuple[FloatArray, FloatArray, float, int]:
    """Coefficients, covariance, χ² and its degrees of freedom."""
    for _ in range(iterations):
        combination = np.concatenate([[1.0], -b])
        Q, C, rank = np.zeros((N_TERMS, N_TERMS)), np.zeros((N_TERMS, N_TERMS)), 0
        for part in parts:
            V = part.covariance(combination)
            W, kept = inverse(V)
            widening = max(1.0, part.scatter(combination, W, kept))
            Q += part.values.T @ W @ part.values / widening
            C += part.noise(W) / widening
            rank += kept
        b, covariance = _least_squares(Q, C, prior)
    left = np.concatenate([[1.0], -b])
    return b, covariance, float(left @ Q @ left), max(1, rank - N_COEFFICIENTS)


def _least_squares(Q: FloatArray, C: FloatArray, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Regress the first variable on the others, given products Q and the part C of them that is scatter."""
    scale = 1 / np.sqrt(np.diag(Q))
    root = float(eigh(Q * np.outer(scale, scale), C * np.outer(scale, scale), eigvals_only=True)[0])
    k = min(1.0, root)
    normal = Q[1:, 1:] - k * C[1:, 1:] + np.diag(prior)
    unit = 1 / np.sqrt(np.diag(normal))
    covariance = np.linalg.pinv(normal * np.outer(unit, unit), hermitian=True) * np.outer(unit, unit)
    return covariance @ (Q[1:, 0] - k * C[1:, 0]), covariance


def read_plane(relation: PlaneRelation, window: WindowStatistics) -> PlaneChange:
    """Read the change of stiffness and damping in one window.

    Moments are weighted by all that is uncertain, the relation included: where the healthy recording did not determine
    the relation, a window is not asked.

    Raises
    ------
    EstimationError
        If the window does not determine them.
    """
    first = _read(relation, lag_moments(window, relation.plane, LAG_FROM_S))
    lag = lag_beyond_memory(first.moments, first.combination)
    return _read(relation, lag_moments(window, relation.plane, lag))


def _read(relation: PlaneRelation, moments: LagMoments) -> PlaneChange:
    beta = -relation.coefficients[0]
    X = moments.values[:, 1:]
    signatures = np.zeros((N_TERMS, 3))
    signatures[:, 0] = relation.combination
    signatures[0, 1], signatures[1, 2] = -1.0, -beta
    Z = moments.values @ signatures
    uncertain = X @ relation.covariance @ X.T
    d, widening = np.zeros(2), 1.0
    for _ in range(_ITERATIONS // 2):
        combination = signatures @ np.concatenate([[1.0], -d])
        own = moments.covariance(combination)
        W_own, own_rank = inverse(own)
        widening = max(1.0, moments.scatter(combination, W_own, own_rank))
        W, rank = inverse(own * widening + uncertain)
        Q = Z.T @ W @ Z
        C = signatures.T @ moments.noise(W) @ signatures * widening
        d, covariance = _least_squares(Q, C, np.zeros(2))
    if not np.all(np.diag(covariance) > 0):
        raise EstimationError(f"plane {relation.plane}: the bearing hardly moves in this window")
    projection = covariance @ Z[:, 1:].T @ W
    left = Z[:, 0] - Z[:, 1:] @ d
    return PlaneChange(
        change=d,
        projection=projection,
        sensitivity=-projection @ X,
        moments=moments,
        combination=combination,
        widening=widening,
        chi2=float(left @ W @ left),
        degrees_of_freedom=max(1, rank - 2),
    )
