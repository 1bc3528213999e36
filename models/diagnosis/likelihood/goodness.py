"""Over-identification: whether a window is explained at all, and if not, what else would explain it.

At the maximum of the likelihood every direction that the model does not have is tried by its score (C. R. Rao, Proc.
Cambridge Phil. Soc. 44 (1948)): the gain of every channel, masses, a shaft that is stiffer in one plane than in the
other. Each is standard normal where the model holds, and its one-step estimate says how large the thing would be. What
no such direction explains shows in the total excess of estimated over theoretical spectra.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr, ndtri

from models.diagnosis.likelihood.motions import Mismatch
from models.diagnosis.likelihood.scoring import Maximum, Weights
from models.diagnosis.likelihood.spectral_model import STRUCTURAL, SpectralModel, packed, twice_packed
from models.diagnosis.moments import ComplexArray
from models.machine import Machine
from models.physics.matrices import Q_shaft
from models.physics.possible import impossible
from models.signals.block import FloatArray

__all__ = ["Alternative", "Goodness", "goodness_of_fit"]

_SIGNS = np.kron([[1.0, 0.0], [0.0, -1.0]], np.ones((3, 3)))
"""Of the elements of the dynamic matrix: what couples motions in y, and what couples motions in z."""
_UNEQUAL = "shaft stiffer in y than in z"
_MASSES = {"mass at the bearing": (0, 3), "mass of the disc": (1, 4), "inertia of the disc": (2, 5)}
_LEAST_SUSPECT_Z = 5.0
_LINEAR = 0.5
"""Largest one-step estimate that is worth telling: farther out it only says that the thing is not small."""
_LEAST_INFORMATION = 1e-4
"""An alternative of which less than this is left beside the model's own parameters cannot be told from them."""


@dataclass(frozen=True, slots=True)
class Alternative:
    """One thing outside the model, tried on a window.

    Attributes
    ----------
    z : float
        Its score in standard errors.
    change : float
        One-step estimate of its relative size.
    """

    name: str
    z: float
    change: float

    @property
    def quantity(self) -> str:
        """What kind of quantity it is."""
        return self.name.split()[0]


@dataclass(frozen=True, slots=True)
class Goodness:
    """How well the theory explains a window.

    Attributes
    ----------
    excess_z : float
        Total squared excess of the whitened spectra over its expectation, in standard deviations.
    alternatives : tuple of Alternative
        Everything tried.
    tests : int
        How many of them, and the total, say something of their own.
    """

    excess_z: float
    alternatives: tuple[Alternative, ...]
    tests: int

    @property
    def misfit_z(self) -> float:
        """All tests in one number, standard normal (one-sided) where the model holds: the worst, Šidák-corrected."""
        worst = max(-log_ndtr(-self.excess_z), *(-_two_sided(one.z) for one in self.alternatives))
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
        if abs(best.z) <= _LEAST_SUSPECT_Z or impossible(best.change, best.quantity):
            return ""
        if best.name == _UNEQUAL and impossible(-best.change, best.quantity):
            return ""  # what y gains z loses
        return f"{best.name} ({best.change:+.1%})" if abs(best.change) <= _LINEAR else best.name


def _two_sided(z: float) -> float:
    return float(np.log(2) + log_ndtr(-abs(z)))


def goodness_of_fit(
    machine: Machine, model: SpectralModel, weights: Weights, found: Maximum, states: ComplexArray
) -> Goodness:
    """Try the alternatives at the maximum of one window.

    Parameters
    ----------
    states : ndarray, shape (n_groups, n_states, n_states)
        Estimated cross-spectra of the states, SI: displacement and velocity are compared with each other, too.
    """
    names, slopes = _alternatives(machine, model, found)
    excess = packed(found.whitened.excess)
    weight = weights.averages[:, None]
    flat = found.slopes.reshape(model.size, -1)
    weighted = (slopes * weight).reshape(len(names), -1)
    cross = weighted @ flat.T
    gradient = (found.slopes * weight).reshape(model.size, -1) @ excess.ravel()
    projection = np.linalg.solve(found.information, cross.T).T
    score = weighted @ excess.ravel() - projection @ gradient
    alone = np.einsum("af,af->a", weighted, slopes.reshape(len(names), -1))
    left = alone - np.einsum("ap,ap->a", projection, cross)
    alternatives = tuple(
        Alternative(name, float(s / np.sqrt(i)), float(s / i))
        for name, s, i, a in zip(names, score, left, alone, strict=True)
        if i > _LEAST_INFORMATION * a
    )
    mismatches = model.motions.mismatches(states, model.centre, weights.averages)
    pairs = [_named(mismatch, {one.name: one for one in alternatives}) for mismatch in mismatches]
    # The gains of a pair are nearly one test, and how far the pair disagrees is hardly random.
    tests = len(alternatives) - len(pairs) + 1
    return Goodness(_excess_z(model, weights, found), (*alternatives, *pairs), tests)


def _named(mismatch: Mismatch, alternatives: dict[str, Alternative]) -> Alternative:
    """Displacement and velocity disagree: which of them deviates is the one whose gain explains the window better."""
    x, v = (f"gain of {state}" for state in mismatch.states)
    z_x, z_v = (abs(alternatives[name].z) if name in alternatives else 0.0 for name in (x, v))
    if z_x > z_v:
        return Alternative(x, mismatch.z, 1 / (1 + mismatch.change) - 1)
    return Alternative(v, mismatch.z, mismatch.change)


def _excess_z(model: SpectralModel, weights: Weights, found: Maximum) -> float:
    """Σ ν ‖L⁻¹ŜL⁻ᴴ - I‖² over its expectation, in its standard deviations.

    Where the model holds every element scatters as the groups say, less one for every parameter that was fitted.
    """
    shared, excess = model.groups.shared, found.whitened.excess
    total = float(weights.averages @ np.einsum("fij,fji->f", excess, excess).real)
    expected = model.n**2 * float(np.trace(shared)) - found.fitted
    return float((total - expected) / (model.n * np.sqrt(2 * np.sum(shared**2))))


def _alternatives(machine: Machine, model: SpectralModel, found: Maximum) -> tuple[list[str], FloatArray]:
    """Names and packed slopes of everything tried, shape (n_alternatives, n_groups, n²)."""
    point, L_inverse = found.whitened.point, found.whitened.L_inverse
    whitened: ComplexArray = L_inverse[:, None] @ point.G
    response: ComplexArray = whitened @ point.C
    names, slopes = [], []
    coloured = point.S @ L_inverse.conj().swapaxes(1, 2)
    for state, (number, share) in model.motions.shares(model.centre).items():
        outer = share[:, None, None] * L_inverse[:, :, number, None] * coloured[:, None, number, :]
        names.append(f"gain of {state}")
        slopes.append(twice_packed(outer))
    w2 = (2 * np.pi * model.groups.nodes_hz) ** 2
    rotor = machine.rotor
    for (name, dofs), mass in zip(_MASSES.items(), (rotor.m1_kg, rotor.m2_kg, rotor.I2_kg_m2), strict=True):
        held = np.zeros((6, 6))
        held[dofs, dofs] = mass
        names.append(name)
        slopes.append(model.dynamic_slope(point, whitened, response, held, w2))
    shaft = Q_shaft(rotor) * np.exp(found.theta[STRUCTURAL.index("EI")])
    names.append(_UNEQUAL)
    slopes.append(model.dynamic_slope(point, whitened, response, shaft * _SIGNS, -np.ones_like(w2)))
    return names, np.stack(slopes)
