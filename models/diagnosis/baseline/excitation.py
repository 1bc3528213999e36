"""The excitation: how long it remembers, and whether one source moves everything."""

from functools import lru_cache

import numpy as np

from models.diagnosis.baseline.lag_moments import LONGEST_LAG_FROM_S, SHORTEST_LAG_FROM_S, RowWindow
from models.diagnosis.window import WindowStatistics
from models.signals.block import FloatArray

__all__ = ["lag_beyond_memory", "one_source"]

_MEMORY = 1.1
_CUTOFFS_HZ = np.geomspace(10.0, 300.0, 40)
_NOISES = np.concatenate([[0.0], np.geomspace(1e-6, 10.0, 25)])
_LOWEST_RAISED_HZ = 8.0
_COHERENT = 0.9
"""Share of the coherence that one source explains: 0.97 to 1 with one, 0.6 to 0.85 with several."""


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


def one_source(window: WindowStatistics) -> bool:
    """Whether one source moves all channels: their coherence matrices have one large eigenvalue.

    Frequencies count by their power. Rates of one motion are coherent whatever moves it, so one channel of each
    coordinate is looked at.
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
