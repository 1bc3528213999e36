"""How long the excitation remembers: from the roll-off of the relation's own residual."""

import numpy as np

from models.diagnosis.baseline.lag_moments import LagMoments
from models.signals.block import FloatArray

__all__ = ["lag_beyond_memory"]

_SHORTEST_S, _LONGEST_S = 0.014, 0.045
_MEMORY = 1.1
_CUTOFFS_HZ = np.geomspace(10.0, 300.0, 40)
_NOISES = np.concatenate([[0.0], np.geomspace(1e-6, 10.0, 25)])


def lag_beyond_memory(moments: LagMoments, combination: FloatArray) -> float:
    """Shortest lag, s, at which a force of this residual's colour has forgotten all but a few per cent.

    The residual is the force, and the noise of the accelerations on top. A second-order roll-off and a noise that
    rises with f⁴ are fitted by Whittle's likelihood on a grid. A wrong guess costs sharpness or shows in the misfit.
    """
    density = moments.residual_spectrum(combination)
    ratio = moments.frequencies_hz[None, :] / _CUTOFFS_HZ[:, None]
    force = 1 / (1 + ratio**2) ** 2
    noise = (ratio / 10) ** 4
    model = force[:, None, :] + _NOISES[None, :, None] * noise[:, None, :]
    cost = np.mean(np.log(model), axis=-1) + np.log(np.mean(density / model, axis=-1))
    cutoff_hz = _CUTOFFS_HZ[np.unravel_index(int(np.argmin(cost)), cost.shape)[0]]
    return float(np.clip(_MEMORY / cutoff_hz, _SHORTEST_S, _LONGEST_S))
