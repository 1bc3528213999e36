"""Training windows for the amortised networks, drawn as spectra: no time series is made.

A window's averaged cross-spectrum at one frequency is a sum of outer products of nearly independent complex Gaussian
Fourier coefficients. Its distribution therefore follows from the expected spectrum alone: complex Wishart, with as many
degrees of freedom as untapered segments fit into the window. The Hann taper of the real segments mixes three
neighbouring frequencies, (1, 4, 1)/6 in power. The theoretical spectrum is mixed like this, and so are the white
Wishart matrices that scatter around it; so expectation, scatter at one frequency and correlation between neighbouring
frequencies come out as in `models.diagnosis.window.moments`. This is a thousand times faster than simulating in time,
so that every training step can use new windows.

Calibration and evaluation still use windows simulated in time (`simulator.training.draws`).

References
----------
N. R. Goodman, "Statistical analysis based on a certain multivariate complex Gaussian distribution", Ann. Math. Stat. 34
(1963); the triangular factor of a Wishart matrix after Bartlett (1933). P. D. Welch, IEEE Trans. Audio 15 (1967).

Inputs of the networks are drawn in numbered batches. A batch depends on (seed, number) alone: any number of processes
may make them in any order.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from models.diagnosis.networks.amortised import NEAR, around
from models.diagnosis.networks.features import ForceFeatures, condensed, principal_directions
from models.diagnosis.window.moments import plan_for
from models.machine import Machine
from models.physics.rotor import PARAMETERS, STATE_INDEX, H_matrix, M_matrix, P_matrix, Q_matrix, changed
from models.signals.block import ComplexArray, Float32Array, FloatArray
from simulator.training.draws import Purpose, made_by

_Complex = TypeVar("_Complex", npt.NDArray[np.complex64], ComplexArray)
# Every parameter is drawn log-uniformly from -42 % to +73 %: wide, continuous, and without a peak at healthy, which
# would teach the network to answer "healthy" to everything small.
LOG_RATIO = 0.55
_CHANGED_BEFORE = 0.25  # probability that a parameter of a centre is not nominal
_PER_ROTOR = 3  # windows that share a rotor and a speed; excitation, noise, unbalance and realisation are their own
_HANN = (np.float32(1 / 6), np.float32(4 / 6), np.float32(1 / 6))


@dataclass(frozen=True, slots=True)
class DrawnConditions:
    """A batch of random machines in random conditions."""

    log_ratio: FloatArray  # (n_windows, 6), logarithm of each of `PARAMETERS` over nominal
    centre: FloatArray  # (n_windows, 6), the same of the machine by which spectra are turned into those of forces
    speed_rad_s: FloatArray  # (n_windows,)
    # (n_windows, n_bins, n, n): expected cross-spectra of the segments, as `WindowStatistics.spectrum` estimates them,
    # SI²/Hz
    spectrum: ComplexArray
    synchronous: ComplexArray  # (n_windows, n), rotation-synchronous vectors as of `WindowStatistics.synchronous`, SI
    # (n_windows, n, n): Cholesky factor of the covariance that the stochastic part gives the estimate of `synchronous`
    synchronous_factor: ComplexArray


class SpectralDraws:
    """Draws windows of one machine in random conditions and with random parameters.

    With `near`, parameters are drawn around a centre, within the error of a first reading; most parameters of a centre
    are nominal. The excitation is drawn more broadly than the diagnosis assumes: mostly one second-order low-pass for
    all sources, as in the simulator, but also other slopes and a cutoff per source, and noise that differs by sensor.
    """

    def __init__(self, machine: Machine, near: bool = False) -> None:
        plan = plan_for(machine)
        self._machine, self._near = machine, near
        self._duration_s = plan.hops * plan.hop / plan.rate_hz
        self._spacing_hz = plan.rate_hz / plan.segment
        band = plan.frequencies_hz
        self._grid_hz = np.concatenate([[band[0] - self._spacing_hz], band, [band[-1] + self._spacing_hz]])
        index = np.array([STATE_INDEX[name] for name in plan.states])
        self.states = plan.states
        self._dofs, self._is_rate = index % 6, index >= 6
        # The segments' whole span, which is half a segment longer than the window.
        self._averages = (self._duration_s + machine.window.segment_s / 2) * self._spacing_hz

    def draw(self, rng: np.random.Generator, count: int) -> DrawnConditions:
        """Draw machines and conditions, with the expected statistics of their windows."""
        groups = [self._rotor(rng, min(_PER_ROTOR, count - first)) for first in range(0, count, _PER_ROTOR)]
        parts = (np.concatenate(part) for part in zip(*groups, strict=True))
        return DrawnConditions(*parts)

    def realisations(
        self, rng: np.random.Generator, expected: ComplexArray, speed_rad_s: FloatArray, count: int
    ) -> Iterator[npt.NDArray[np.complex64]]:
        """Realisations of the averaged cross-spectra, each of the shape of `expected`, (n_windows, n_bins, n, n).

        `expected` may be of any linear combinations of the measured states; speeds have shape (n_windows,).
        """
        n_windows, n_bins, n, _ = expected.shape
        # The regression on the shaft angle takes one coefficient in all out of the bins around the rotation.
        turns = speed_rad_s[:, None] / (2 * np.pi)
        removed = np.clip(1 - np.abs(self._grid_hz - turns) / self._spacing_hz, 0, 1)
        freedom = (self._averages - removed)[:, :, None] - np.arange(n)
        L = _factor(expected).astype(np.complex64)
        L_adjoint = np.ascontiguousarray(L.conj().swapaxes(-1, -2))
        A = np.zeros((n_windows, n_bins + 2, n, n), dtype=np.complex64)
        below, diagonal = np.tril_indices(n, -1), np.arange(n)
        for _ in range(count):
            A[..., below[0], below[1]] = _complex_normal(rng, (n_windows, n_bins + 2, below[0].size))
            A[..., diagonal, diagonal] = np.sqrt(rng.standard_gamma(freedom))
            white = self._hann_smoothed(A @ A.conj().swapaxes(-1, -2)) / np.float32(self._averages)
            yield L @ white @ L_adjoint

    def scattered_vectors(self, rng: np.random.Generator, conditions: DrawnConditions) -> ComplexArray:
        """One realisation of the rotation-synchronous vectors, shape (n_windows, n)."""
        normal = _complex_normal(rng, (*conditions.synchronous.shape, 1)).astype(np.complex128)
        return np.asarray(conditions.synchronous + (conditions.synchronous_factor @ normal)[..., 0])

    def _rotor(
        self, rng: np.random.Generator, n: int
    ) -> tuple[FloatArray, FloatArray, FloatArray, ComplexArray, ComplexArray, ComplexArray]:
        """Machines that share a rotor."""
        machine, condition = self._machine, self._machine.condition
        centre, apart = np.zeros(len(PARAMETERS)), np.full(len(PARAMETERS), LOG_RATIO)
        if self._near:
            apart = np.array([NEAR[name] for name in PARAMETERS])
            centre = rng.uniform(-LOG_RATIO, LOG_RATIO, centre.size) * (rng.random(centre.size) < _CHANGED_BEFORE)
        log_ratio = np.tile(centre + rng.uniform(-apart, apart), (n, 1))
        unbalance = PARAMETERS.index("e")
        log_ratio[:, unbalance] = centre[unbalance] + rng.uniform(-1, 1, n) * apart[unbalance]
        rotor = changed(machine.rotor, dict(zip(PARAMETERS, np.expm1(log_ratio[0]), strict=True)))
        tolerance = machine.operation.speed_tolerance
        speed = machine.operation.speed_rad_s * float(rng.uniform(1 - tolerance, 1 + tolerance))
        frequencies = np.append(self._grid_hz, speed / (2 * np.pi))
        w = 2 * np.pi * frequencies[:, None, None]
        dynamic = -(w**2) * M_matrix(rotor) + 1j * w * P_matrix(rotor, speed) + Q_matrix(rotor)
        receptance = np.linalg.inv(dynamic)
        G = receptance[:, self._dofs] * np.where(self._is_rate[:, None], 1j * w, 1.0)
        S = np.empty((n, frequencies.size, len(self.states), len(self.states)), dtype=np.complex128)
        response = (receptance[-1] @ (H_matrix(rotor, speed) @ np.array([1.0, -1.0j])))[self._dofs]
        response = response * np.where(self._is_rate, 1j * speed, 1.0)
        response = response * np.exp(1j * machine.operation.unbalance_phase_rad)
        q = response * np.exp(log_ratio[:, unbalance, None] - log_ratio[0, unbalance])
        disc = [position for position, name in enumerate(self.states) if name in {"y2", "z2"}]
        for number in range(n):
            directions, shapes = self._sources(rng, frequencies)
            forced = G @ directions
            S[number] = (forced * shapes[:, None, :]) @ forced.conj().swapaxes(1, 2)
            # Levels as the simulator sets them: the stochastic displacement at the disc over its 1x amplitude, or over
            # that of all channels where the disc has none.
            seen = disc or list(range(len(self.states)))
            power = np.einsum("fii->i", S[number, :-1]).real * 2 * self._spacing_hz
            synchronous = np.abs(q[number]) ** 2 / 2
            wanted = float(rng.uniform(*condition.stochastic_to_1x)) ** 2
            factor = wanted * float(synchronous[seen].mean() / power[seen].mean())
            S[number] *= factor
            S[number] += self._noise(rng, power * factor + synchronous, frequencies)
        scatter = _factor(S[:, -1] * (4 / self._duration_s))
        return log_ratio, np.tile(centre, (n, 1)), np.full(n, speed), self._hann_smoothed(S[:, :-1]), q, scatter

    def _sources(self, rng: np.random.Generator, frequencies: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Directions of the sources, shape (6, n_sources), and their spectra, shape (n_frequencies, n_sources)."""
        condition, lever = self._machine.condition, self._machine.rotor.shaft_length_m / 3
        layout = rng.random()
        if layout < 0.45:
            directions = np.eye(6)[:, [0, 1, 3, 4]] * rng.uniform(0.3, 1.0, 4)
        else:
            n_random = 1 if layout < 0.9 else int(rng.integers(2, 4))
            directions = rng.standard_normal((6, n_random)) * np.array([1, 1, lever, 1, 1, lever])[:, None]
            directions *= rng.uniform(0.3, 1.0, n_random) / np.linalg.norm(directions, axis=0)
        n_sources = directions.shape[1]
        low, high = condition.cutoff_hz
        if rng.random() < 0.6:
            cutoff, slope = np.full(n_sources, rng.uniform(low, high)), np.full(n_sources, 2.0)
        else:
            own = 1 if rng.random() < 0.5 else n_sources
            cutoff = np.resize(np.exp(rng.uniform(np.log(0.8 * low), np.log(1.25 * high), own)), n_sources)
            slope = np.resize(rng.uniform(1.0, 4.0, own), n_sources)
        # A Butterworth low-pass of any order; order two is the colouring filter of Eqs. (7)-(8).
        return directions, 1 / (1 + (frequencies[:, None] / cutoff) ** (2 * slope)) / cutoff

    def _noise(self, rng: np.random.Generator, power: FloatArray, frequencies: FloatArray) -> FloatArray:
        """Two-sided densities of the sensor noise as diagonal matrices, shape (n_frequencies, n, n)."""
        n = power.size
        level = np.full(n, rng.uniform(*self._machine.condition.noise_relative))
        corner = np.full(n, np.exp(rng.uniform(np.log(50), np.log(500))))
        if rng.random() < 0.3:
            level *= np.exp(rng.uniform(-0.5, 0.5, n))
            corner = np.exp(rng.uniform(np.log(50), np.log(500), n))
        rate = self._machine.rate_hz
        memory = np.zeros(n) if rng.random() < 0.5 else np.exp(-2 * np.pi * corner / rate)
        turn = np.exp(-2j * np.pi * frequencies[:, None] / rate)
        density = level**2 * power * (1 - memory**2) / np.abs(1 - memory * turn) ** 2 / rate
        return np.asarray(density[:, :, None] * np.eye(n), dtype=np.float64)

    @staticmethod
    def _hann_smoothed(S: _Complex) -> _Complex:
        mixed: _Complex = _HANN[0] * S[:, :-2] + _HANN[1] * S[:, 1:-1] + _HANN[2] * S[:, 2:]
        return mixed


def _factor(S: ComplexArray) -> ComplexArray:
    """Cholesky factor; channels are scaled first, as displacements and velocities differ by many powers of ten."""
    scale = np.sqrt(np.einsum("...ii->...i", S).real)
    L = np.linalg.cholesky(S / scale[..., :, None] / scale[..., None, :])
    return np.asarray(L * scale[..., :, None], dtype=np.complex128)


def _complex_normal(rng: np.random.Generator, shape: tuple[int, ...]) -> npt.NDArray[np.complex64]:
    """Circular complex normal numbers of unit variance."""
    parts = rng.standard_normal((*shape[:-1], 2 * shape[-1]), dtype=np.float32)
    return np.asarray(parts.view(np.complex64) * np.float32(np.sqrt(0.5)))


KEPT = 28  # principal components of every function of frequency; the next ones vary less than the sampling error
_KEPT_NEAR = 9
_STREAM = 50  # keeps the random numbers apart from those of the relation networks' training windows
_BASIS_DRAWS = 1500
_AT_ONCE = 24  # conditions worked on together: more do not fit into a processor's cache and take twice the time
_REALISATIONS = 4  # windows drawn from one condition
# Sampling error of the agreement of displacement and rate, in logarithms: larger than the real one (0.02 to 0.05), so
# that no network reads a parameter from an agreement that real sensors do not have.
_CONSISTENCY_ERROR = 0.1
# Condensed features, shape (n_windows, n_inputs), and logarithmic ratios of the parameters, shape (n_windows, 6).
Batch = tuple[Float32Array, Float32Array]


@dataclass(frozen=True, slots=True)
class FeatureDraws:
    """A recipe for batches."""

    machine: Machine
    seed: int
    conditions: int  # conditions per batch; each gives four windows
    # Principal directions, see `models.diagnosis.networks.features`.
    mean: Float32Array
    directions: Float32Array
    near: bool = False  # for the networks of the second reading: parameters relative to those of the centre

    @classmethod
    def for_machine(cls, machine: Machine, seed: int, conditions: int, near: bool = False) -> "FeatureDraws":
        """Find the principal directions from expected spectra and make the recipe."""
        draws = SpectralDraws(machine, near)
        rng = np.random.default_rng([seed, Purpose.TRAINING, _STREAM + near, 0])
        parts = []
        for _ in range(0, _BASIS_DRAWS, _AT_ONCE):
            drawn = draws.draw(rng, _AT_ONCE)
            parts += [one.series(one.force(drawn.spectrum[own])) for own, one in _centres(machine, drawn.centre, near)]
        kept = _KEPT_NEAR if near else KEPT
        return cls(machine, seed, conditions, *principal_directions(np.concatenate(parts, axis=1), kept), near)

    @property
    def windows(self) -> int:
        """Windows per batch."""
        return self.conditions * _REALISATIONS

    @property
    def n_common(self) -> int:
        """Inputs that all networks share, without those of equation 29."""
        features = ForceFeatures(self.machine, near=self.near)
        centre = len(PARAMETERS) if self.near else 0
        return features.n_series * int(self.directions.shape[2]) + centre + features.n_consistency

    def batch(self, number: int) -> Batch:
        """Make one batch."""
        draws = SpectralDraws(self.machine, self.near)
        rng = np.random.default_rng([self.seed, Purpose.TRAINING, _STREAM + self.near, number + 1])
        inputs: list[Float32Array] = []
        targets: list[Float32Array] = []
        for first in range(0, self.conditions, _AT_ONCE):
            conditions = draws.draw(rng, min(_AT_ONCE, self.conditions - first))
            inputs += self._windows(rng, draws, conditions)
            targets += [(conditions.log_ratio - conditions.centre).astype(np.float32)] * _REALISATIONS
        return np.concatenate(inputs), np.concatenate(targets)

    def _windows(
        self, rng: np.random.Generator, draws: SpectralDraws, conditions: DrawnConditions
    ) -> list[Float32Array]:
        speed = conditions.speed_rad_s
        through = list(_centres(self.machine, conditions.centre, self.near))
        features = through[0][1]
        expected = np.concatenate([one.force(conditions.spectrum[own]) for own, one in through])
        centre = conditions.centre.astype(np.float32)[:, : len(PARAMETERS) if self.near else 0]
        agreement = features.consistency(conditions.spectrum, speed)
        windows: list[Float32Array] = []
        for force in draws.realisations(rng, expected, speed, _REALISATIONS):
            scores = condensed(features.series(force), self.mean, self.directions)
            seen = agreement.copy()
            # The first feature is the speed.
            seen[:, 1:] += _CONSISTENCY_ERROR * rng.standard_normal(seen[:, 1:].shape, dtype=np.float32)
            parts = [scores, centre, seen]
            if features.has_angle:
                vectors = draws.scattered_vectors(rng, conditions)
                seen_1x = [one.unbalance(conditions.spectrum[own], vectors[own], speed[own]) for own, one in through]
                parts.append(np.concatenate(seen_1x))
            windows.append(np.concatenate(parts, axis=1))
        return windows


def _centres(machine: Machine, centre: FloatArray, near: bool) -> Iterator[tuple[slice, ForceFeatures]]:
    """Slices of windows with the same centre, and the features of the machine at that centre."""
    starts = [0, *(np.flatnonzero(np.any(np.diff(centre, axis=0) != 0, axis=1)) + 1), len(centre)]
    for first, end in pairwise(starts):
        yield slice(first, end), ForceFeatures(around(machine, centre[first]), near=near)


def batches(draws: FeatureDraws, count: int, processes: int) -> Iterator[Batch]:
    """Batches 0 to `count` - 1 in order, see `made_by`."""
    return made_by(processes, draws.batch, range(count))
