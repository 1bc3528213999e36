"""How long the excitation remembers: from the roll-off of the relation's own residual."""

from functools import lru_cache

import numpy as np

from models.diagnosis.baseline.lag_moments import LONGEST_LAG_FROM_S, SHORTEST_LAG_FROM_S, RowWindow
from models.signals.block import FloatArray

__all__ = ["lag_beyond_memory"]

_MEMORY = 1.1
_CUTOFFS_HZ = np.geomspace(10.0, 300.0, 40)
_NOISES = np.concatenate([[0.0], np.geomspace(1e-6, 10.0, 25)])
_LOWEST_RAISED_HZ = 8.0


def lag_beyond_memory(row: RowWindow, combination: FloatArray) -> float:
    """Shortest lag, s, at which a force of this residual's colour has forgotten all but a few per cent.

    The residual is the force, and the noise of the accelerations on top. A second-order roll-off and a noise that
    rises with f⁴ are fitted by Whittle's likelihood on a grid. A wrong guess costs sharpness or shows in the misfit.
    Where the row was differentiated, that is undone first; the sensors' noise at the lowest frequencies is left out.
    """
    raised = row.formation.raised
    f = row.window.frequencies_hz
    used = f >= _LOWEST_RAISED_HZ if raised else np.ones(f.size, dtype=bool)
    f = f[used]
    density = row.residual_spectrum(combination)[used] / f ** (2 * raised)
    logarithm, inverse_model = _models(f.tobytes())
    cost = logarithm + np.log(inverse_model @ density / f.size)
    cutoff_hz = _CUTOFFS_HZ[int(np.argmin(cost)) // _NOISES.size]
    return float(np.clip(_MEMORY / cutoff_hz, SHORTEST_LAG_FROM_S, LONGEST_LAG_FROM_S))


@lru_cache(maxsize=8)
def _models(frequencies: bytes) -> tuple[FloatArray, FloatArray]:
    """Mean logarithm of every spectrum on the grid, shape (n,), and its inverse, shape (n, n_bins)."""
    ratio = np.frombuffer(frequencies)[None, :] / _CUTOFFS_HZ[:, None]
    force = 1 / (1 + ratio**2) ** 2
    noise = (ratio / 10) ** 4
    model = force[:, None, :] + _NOISES[None, :, None] * noise[:, None, :]
    flat = model.reshape(-1, model.shape[-1])
    return np.log(flat).mean(axis=-1), 1 / flat
