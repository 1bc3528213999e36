"""Whether the theory explains a window at all: where it does not, parameters fitted to the window mean nothing."""

import math

import numpy as np

from models.diagnosis.likelihood.scoring import Maximum, Weights, Whitened, inverse_factor
from models.diagnosis.likelihood.spectral_model import COLUMNS, ROWS, STRUCTURAL, SpectralModel
from models.diagnosis.limits import beyond
from models.diagnosis.moments import ComplexArray
from models.physics.parameters import PARAMETER_TEXT

__all__ = ["MOST_MISFIT", "unexplained_at", "unseen"]

_MOST_LOG_RATIO = float(np.log(5))
"""No stiffness or damping is believed to have changed by more than a factor of five within the model."""
_MOST_EXCESS = 100.0
"""Mean squared excess over its expectation, beyond which there is nothing to follow: the next search starts cold."""
_MOST_DEVIATION = 0.2
"""Deviation of the spectra from the theory (relative, rms, less what sampling makes) up to which readings mean a thing.
Where parameters of the model changed, by whatever, it stays below 0.05; a rub or a small mass makes up to 0.17."""
_LARGE, _MOST_DEVIATION_LARGE = float(np.log(2)), 0.1
"""The same where a parameter would have changed by more than a factor of two: a rub or a mass hardly moves them, and a
change as large as that must explain the window."""
_MOST_NOISE = 0.3
"""Share of the motion that the theory takes for noise of the sensors though displacement and velocity show it alike,
up to which a rotor can be seen behind it: a spectrum without resonances is taken for coloured noise, and what is left
of it fits any rotor."""
_UNEQUAL = 5.0
"""How many times more noise one sensor of a pair may have than the other."""
MOST_MISFIT, _BLIND = 4.0, 10.0
"""Misfit that is no chance, and how many times less certain than on the rotor as it was most of its parameters may be
then. Within the model nothing makes them less certain than three times; a line that passes for the one resonance of a
softer shaft leaves bearings anywhere."""


def unexplained_at(
    model: SpectralModel, weights: Weights, reached: Whitened, states: ComplexArray, times: float = 1.0
) -> tuple[str, bool]:
    """Why nothing at this point means anything, if so, and whether nothing within the model comes near the window.

    Parameters
    ----------
    reached : Whitened
        The point.
    states : ndarray, shape (n_groups, n_states, n_states)
        Estimated cross-spectra of the states, SI.
    times : float
        So many times what is evaluated counts as too much.
    """
    excess, point, bins = reached.excess, reached.point, model.groups.bins
    squared = np.einsum("fij,fij->f", excess, excess.conj()).real / model.n**2
    deviation = max(0.0, float(np.mean(squared - 1 / weights.averages))) ** 0.5
    far = bool(np.mean(weights.averages * squared) > times * _MOST_EXCESS)
    worst = int(np.argmax(np.abs(point.theta[: len(STRUCTURAL)])))
    log_ratio = float(point.theta[worst])
    impossible = abs(log_ratio) > times * _MOST_LOG_RATIO
    most = _MOST_DEVIATION if abs(log_ratio) <= _LARGE else _MOST_DEVIATION_LARGE
    if far or deviation > times * most:
        text, limit = beyond(100 * deviation, 100 * most)
        why = f"its spectra deviate from it by {text} % (rms, sampling aside), evaluated is at most {limit} %"
        return why, far or impossible
    # Noise is a sensor's own: what both sensors of a motion show is motion, and this one the theory does not explain.
    shared = np.maximum(model.noise(point.theta) - _UNEQUAL * model.motions.rest(states, model.centre), 0)
    share = float(np.mean(bins @ shared / (bins @ np.einsum("fii->fi", point.S).real)))
    if share > times * _MOST_NOISE:
        text, limit = beyond(100 * share, 100 * _MOST_NOISE)
        why = f"{text} % of what pairs of sensors show alike would be noise of each, evaluated is at most {limit} %"
        return why, impossible
    if not impossible:
        return "", False
    extreme = math.exp(math.copysign(_MOST_LOG_RATIO, log_ratio))
    text, limit = beyond(max(math.exp(min(log_ratio, math.log(1e6))), 1e-6), extreme)
    side = "at least" if extreme < 1 else "at most"
    return f"{PARAMETER_TEXT[STRUCTURAL[worst]]} would be {text} times nominal, evaluated is {side} {limit} times", True


def unseen(model: SpectralModel, weights: Weights, found: Maximum, misfit_z: float) -> str:
    """Say what a window does not show that the rotor as it was would show in one like it; empty if it shows most.

    Beside a misfit a reading means something as long as the rotor is seen: then it is the nearest rotor's.
    """
    n = len(STRUCTURAL)
    usual = weights.centre.copy()
    usual[model.level_at] = np.eye(6)[ROWS, COLUMNS]
    point = model.at(usual, found.whitened.point.speed_rad_s)
    slopes = model.slopes(point, inverse_factor(point.S)) * np.sqrt(weights.averages)[:, None]
    flat = slopes.reshape(model.size, -1)
    expected, read = (
        np.sqrt(np.diag(np.linalg.inv(information))[:n])
        for information in (flat @ flat.T + np.diag(weights.pull), found.information)
    )
    seen = expected < 1 / _BLIND  # by these sensors at all
    lost = seen & ~(read < _BLIND * expected)
    if 2 * np.count_nonzero(lost) <= np.count_nonzero(seen):
        return ""
    text, limit = beyond(misfit_z, MOST_MISFIT)
    names = ", ".join(PARAMETER_TEXT[name] for name, missing in zip(STRUCTURAL, lost, strict=True) if missing)
    return (
        f"it hardly shows the rotor's {names}, and it deviates from the theory by {text} standard errors, evaluated is "
        f"then at most {limit}"
    )
