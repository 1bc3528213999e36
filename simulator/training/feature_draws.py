"""Inputs of the amortised networks for windows drawn as spectra (`spectral_draws`), in numbered batches.

A batch depends on (seed, number) alone: any number of processes may make them in any order.
"""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from models.diagnosis.networks.features import Float32Array, ForceFeatures, principal_directions
from models.machine import Machine
from simulator.training.draws import Purpose
from simulator.training.spectral_draws import DrawnConditions, SpectralDraws

__all__ = ["Batch", "FeatureDraws", "batches"]

KEPT = 28
"""Principal components of every function of frequency; the next ones vary less than the sampling error."""

_STREAM = 50
"""Keeps the random numbers apart from those of the relation networks' training windows."""

_BASIS_DRAWS = 1500
_AT_ONCE = 24
"""Conditions worked on together: more do not fit into a processor's cache and take twice the time."""
_REALISATIONS = 4
"""Windows drawn from one condition."""
_CONSISTENCY_ERROR = 0.1
"""Sampling error of the agreement of displacement and rate, in logarithms: larger than the real one (0.02 to 0.05), so
that no network reads a parameter from an agreement that real sensors do not have."""

Batch = tuple[Float32Array, Float32Array]
"""Condensed features, shape (n_windows, n_inputs), and logarithmic ratios of the parameters, shape (n_windows, 6)."""


@dataclass(frozen=True, slots=True)
class FeatureDraws:
    """A recipe for batches.

    Attributes
    ----------
    conditions : int
        Conditions per batch; each gives four windows.
    mean, directions : ndarray
        Principal directions, see `models.diagnosis.networks.features`.
    """

    machine: Machine
    seed: int
    conditions: int
    mean: Float32Array
    directions: Float32Array

    @classmethod
    def for_machine(cls, machine: Machine, seed: int, conditions: int) -> "FeatureDraws":
        """Find the principal directions from expected spectra and make the recipe."""
        draws, features = SpectralDraws(machine), ForceFeatures(machine)
        rng = np.random.default_rng([seed, Purpose.TRAINING, _STREAM, 0])
        parts = [
            features.series(features.force(draws.draw(rng, _AT_ONCE).spectrum))
            for _ in range(0, _BASIS_DRAWS, _AT_ONCE)
        ]
        return cls(machine, seed, conditions, *principal_directions(np.concatenate(parts, axis=1), KEPT))

    @property
    def windows(self) -> int:
        """Windows per batch."""
        return self.conditions * _REALISATIONS

    @property
    def n_common(self) -> int:
        """Inputs that all networks share, without those of equation 29."""
        features = ForceFeatures(self.machine)
        return features.n_series * int(self.directions.shape[2]) + features.n_consistency

    def batch(self, number: int) -> Batch:
        """Make one batch."""
        draws, features = SpectralDraws(self.machine), ForceFeatures(self.machine)
        rng = np.random.default_rng([self.seed, Purpose.TRAINING, _STREAM, number + 1])
        inputs: list[Float32Array] = []
        targets: list[Float32Array] = []
        for first in range(0, self.conditions, _AT_ONCE):
            conditions = draws.draw(rng, min(_AT_ONCE, self.conditions - first))
            inputs += self._windows(rng, draws, features, conditions)
            targets += [conditions.log_ratio.astype(np.float32)] * _REALISATIONS
        return np.concatenate(inputs), np.concatenate(targets)

    def _windows(
        self, rng: np.random.Generator, draws: SpectralDraws, features: ForceFeatures, conditions: DrawnConditions
    ) -> list[Float32Array]:
        speed, n_kept = conditions.speed_rad_s, self.directions.shape[2]
        agreement = features.consistency(conditions.spectrum, speed)
        n_speed = 1
        windows: list[Float32Array] = []
        for force in draws.realisations(rng, features.force(conditions.spectrum), speed, _REALISATIONS):
            series = (features.series(force) - self.mean) @ self.directions
            scores = series.transpose(1, 0, 2).reshape(speed.size, features.n_series * n_kept)
            seen = agreement.copy()
            seen[:, n_speed:] += _CONSISTENCY_ERROR * rng.standard_normal(seen[:, n_speed:].shape, dtype=np.float32)
            parts: list[Float32Array] = [np.asarray(scores, dtype=np.float32), seen]
            if features.has_angle:
                vectors = draws.scattered_vectors(rng, conditions)
                parts.append(features.unbalance(conditions.spectrum, vectors, speed))
            windows.append(np.concatenate(parts, axis=1))
        return windows


def batches(draws: FeatureDraws, count: int, processes: int) -> Iterator[Batch]:
    """Batches 0 to `count` - 1 in order, made by worker processes a few ahead of their use."""
    if processes == 1:
        yield from map(draws.batch, range(count))
        return
    with ProcessPoolExecutor(processes) as pool:
        ahead = 2 * processes
        waiting = deque(pool.submit(draws.batch, number) for number in range(min(ahead, count)))
        for number in range(count):
            made = waiting.popleft().result()
            if number + ahead < count:
                waiting.append(pool.submit(draws.batch, number + ahead))
            yield made
