"""Following the maximum from hop to hop without searching it anew.

A window that has slid by one hop is nearly the same as before. The slopes of the expected spectra, most of the cost of
a search, are therefore taken from the last search, and the equation to solve is

    Σ ν tr{W_a (Ŝ - S(θ))} = pulls,    W_a = L₀⁻ᴴ (L₀⁻¹ ∂S/∂θ_a L₀⁻ᴴ) L₀⁻¹ at the last search's maximum,

with S(θ) exact. For any weights W, the left side's expectation is zero at the true parameters (an unbiased estimating
equation, V. P. Godambe, Annals of Mathematical Statistics 31 (1960)); near the last maximum W are the likelihood's own
weights, so hardly any precision is lost. The levels are stepped as elements of C, in which the spectra are linear.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from models.checkpoint import checked
from models.diagnosis.likelihood.scoring import (
    Derivatives,
    Maximum,
    Weights,
    gradient_of,
    information_of,
    inverse_factor,
    whitened_at,
)
from models.diagnosis.likelihood.spectral_model import ROWS, Expected, ModelPoint, SpectralModel, Speeds, packed
from models.signals.block import ComplexArray, FloatArray

_MOST_STEPS = 6
_FARTHEST = 0.15  # relative change of the expected spectra (rms) beyond which the weights no longer suit them
# Standard errors by which a stretch may differ from the window it is part of without a search of its own.
_NEWS = 3.0
# Excess over the theory beyond which a stretch gets a search of its own. The margin is for a changed excitation level,
# which counts as excess in full.
_LEAST_EXCESS_Z, _EXCESS_MARGIN = 4.0, 1.15


class Linearised:
    """The spectra linearised around the maximum of the last search, and the current maximum.

    The search used `weights` and ended at `searched` with `derivatives` and the gradient `left`, shape (n_levels,), of
    the data with respect to the levels; the current maximum is at `point`.
    """

    def __init__(
        self,
        model: SpectralModel,
        weights: Weights,
        searched: Expected,
        point: Expected,
        derivatives: Derivatives,
        left: FloatArray,
        fitted: float,
    ) -> None:
        self.model, self.weights, self.derivatives = model, weights, derivatives
        self.theta = searched.theta
        self._point, self._left, self._fitted = point, left, fitted
        self._searched_rad_s = searched.speed_rad_s
        self._L_inverse = inverse_factor(searched.S)
        self._S = np.einsum("fii->fi", searched.S).real.copy()
        self._pull = weights.pull
        self._inverses: dict[float, FloatArray] = {}

    @classmethod
    def around(cls, model: SpectralModel, weights: Weights, found: Maximum) -> "Linearised":
        """Linearise around the maximum of a search that has just ended, with its slopes."""
        point = found.whitened.point.expected
        # Where only the pulls on T determine the levels, the equation keeps the gradient that the search ended with.
        left = gradient_of(found.derivatives.slopes, packed(found.whitened.excess), weights)[model.level_at]
        return cls(model, weights, point, point, found.derivatives, left, found.fitted)

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything that the model and the weights do not hold, as named arrays.

        Spectra, slopes and information (megabytes) are recomputed at the same points. Only the information's diagonal
        is stored, because the pulls have been added to it and subtracted again.
        """
        return {
            "searched": self.theta,
            "point": self._point.theta,
            "point_levels": self._point.C,
            "speeds_rad_s": np.array(
                [self._searched_rad_s, self._point.speed_rad_s, self.derivatives.speed_rad_s], dtype=np.float64
            ).ravel(),
            "information": np.diag(self.derivatives.information),
            "left": self._left,
            "fitted": np.array(self._fitted, dtype=np.float64),
        }

    @classmethod
    def restored(cls, model: SpectralModel, weights: Weights, arrays: Mapping[str, np.ndarray]) -> "Linearised":
        """Restore what `checkpoint` returned; raises LinAlgError if the point gives no valid spectra."""
        size = (model.size,)
        theta = checked(arrays, "searched", np.float64, size)
        speeds = checked(arrays, "speeds_rad_s", np.float64, (3 * model.groups.speeds,)).tolist()
        of_searched, of_point, of_slopes = (
            speeds if model.groups.speeds == 1 else zip(speeds[::2], speeds[1::2], strict=True)
        )
        levels = checked(arrays, "point_levels", np.float64, (6, 6))
        point = checked(arrays, "point", np.float64, size)
        if not (np.all(np.isfinite(theta)) and np.all(np.isfinite(point)) and np.all(np.isfinite(levels))):
            raise np.linalg.LinAlgError("a point that is not finite")
        at_slopes = model.at(theta, of_slopes)
        slopes = model.slopes(at_slopes, inverse_factor(at_slopes.S))
        information = information_of(slopes, weights)
        information[np.diag_indices(model.size)] = checked(arrays, "information", np.float64, size)
        return cls(
            model,
            weights,
            model.at(theta, of_searched),
            model.at(point, of_point, levels).expected,
            Derivatives(slopes, information, of_slopes),
            checked(arrays, "left", np.float64, (ROWS.size,)),
            float(checked(arrays, "fitted", np.float64, ())),
        )

    def follow(self, observed: ComplexArray, speed_rad_s: Speeds, near: float, gain: float) -> Maximum | None:
        """Find the maximum for the next window's estimated spectra, in the model's units; None if a new search is due.

        `near` and `gain` define convergence as in `FisherScoring.maximise`.
        """
        model, point = self.model, self._point
        there: ModelPoint | None = None
        covariance = self._inverse(1.0)
        diagnosed = slice(model.cutoff_at)
        errors = np.sqrt(np.diag(covariance)[diagnosed])
        before = np.inf
        for steps in range(_MOST_STEPS + 1):
            rest = self._whitened(observed - point.S)
            gradient = self._pulled(gradient_of(self.derivatives.slopes, rest, self.weights), point, 1.0)
            step = np.asarray(covariance @ gradient, dtype=np.float64)
            left = float(gradient @ step) / 2
            if np.all(np.abs(step[diagnosed]) < near * errors) and left < gain:
                there = there or model.at(point.theta, point.speed_rad_s, point.C)
                whitened = whitened_at(there, observed)
                if whitened is None:
                    return None
                self._point = there.expected
                information = self.derivatives.information + np.diag(self._pull)
                remaining = step[diagnosed]
                return Maximum(information, self.derivatives, whitened, steps, self._fitted, remaining, covariance)
            if steps == _MOST_STEPS or left > before:
                break
            before = left
            point = there = model.stepped(point, step, speed_rad_s)
            expected = np.einsum("fii->fi", point.S).real
            if not np.mean((expected / self._S - 1) ** 2) < _FARTHEST**2:
                break
        return None

    def glance(self, observed: ComplexArray, share: float) -> tuple[Expected, FloatArray] | None:
        """Take one step from the latest maximum for a stretch, a share of the window; None if it differs from that.

        The diagnosed parameters of the point are the stretch's, all others, and the spectra, the window's. With it
        comes the covariance of the diagnosed parameters, shape (n_diagnosed, n_diagnosed).
        """
        model, point = self.model, self._point
        rest = self._whitened(observed - point.S)
        gradient = gradient_of(self.derivatives.slopes, rest, self.weights)
        covariance = self._inverse(share)
        step = covariance @ self._pulled(gradient, point, share)
        diagnosed = slice(model.cutoff_at)
        structural = covariance[diagnosed, diagnosed]
        if np.any(np.abs(step[diagnosed]) > _NEWS * np.sqrt(np.diag(structural))):
            return None
        theta = point.theta.copy()
        theta[diagnosed] += step[diagnosed]
        # Σ ν |rest - slopes · step|², expanded in the known gradient and information.
        left = np.sum(rest**2, axis=1) @ self.weights.averages
        total = share * float(left - (2 * gradient - self.derivatives.information @ step) @ step)
        usual = model.n**2 * float(np.trace(model.groups.shared))
        scatter = model.n * float(np.sqrt(2 * np.sum(model.groups.shared**2)))
        if total > _EXCESS_MARGIN * usual + _LEAST_EXCESS_Z * scatter:
            return None
        return replace(point, theta=theta), np.asarray(structural, dtype=np.float64)

    def _whitened(self, difference: ComplexArray) -> FloatArray:
        """L₀⁻¹ X L₀⁻ᴴ, packed, shape (n_groups, n²)."""
        return packed(self._L_inverse @ difference @ self._L_inverse.conj().swapaxes(1, 2))

    def _pulled(self, gradient: FloatArray, point: Expected, share: float) -> FloatArray:
        """Gradient of a share of the data plus that of the pulls."""
        levels = self.model.level_at
        pulled = share * gradient - self.weights.ridge * (point.theta - self.weights.centre)
        pulled[levels] = share * (gradient[levels] - self._left)
        return pulled

    def _inverse(self, share: float) -> FloatArray:
        if share not in self._inverses:
            information = share * self.derivatives.information + np.diag(self._pull)
            self._inverses[share] = np.asarray(np.linalg.inv(information), dtype=np.float64)
        return self._inverses[share]
