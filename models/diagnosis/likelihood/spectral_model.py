"""Theoretical cross-spectra for the likelihood: rotor, unknown smooth excitation, sensor noise.

The cross-spectral matrix of the measured motions (displacement and velocity of a degree of freedom combined, see
`models.diagnosis.likelihood.motions`) at frequency f is

    S(f) = c(f; fc) · G D(f) C D(f) Gᴴ + diag(d(f)),   G = H at the measured rows, in the motions' units,

with H = (-ω²M + jωP + Q)⁻¹ the receptance of Eq. (1), c the power gain of a low-pass of unknown cutoff and order, C an
unknown full level matrix over all six degrees of freedom, and D = diag(exp(½ Σ_j a_ij b_j(f))) the colour of each
degree of freedom's force, with polynomials b_j in √f: a fine one that all forces share, and coarser differences. The
excitation may thus be one source in any direction or many, of first or fourth order, each with its own cutoff or with a
hump; only a smooth spectrum is assumed. The spectra are the Fourier transforms of the correlation functions of Eq.
(18): this is the comparison of theoretical and estimated correlations with the right weight on every lag.

C = T Tᵀ with T lower triangular, so that every point the search tries is a possible excitation. Standard errors come
from the information on C itself, which stays right where T loses rank (decision 0002).

The sensor noise has a smooth spectrum of its own in every motion, d(f) = d₀ (1 + (f/f_r)²)^b with f_r two thirds of
the band's end: white for b = 0, first-order low-pass at f_r for b = -1; d₀ combines the densities of the sensors.
Assuming white noise where it is not white lowered the damping read on the heavy machine by up to 15 %. With several
corners, a product of such powers follows noise that falls from the band's lower end, such as that of an integrator.
"""

from copy import copy
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import helmert
from scipy.special import eval_legendre

from models.diagnosis.likelihood.motions import BinGroups, Motions
from models.diagnosis.window.moments import through
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine
from models.physics.excitation import low_pass, low_pass_slopes
from models.physics.rotor import STATE_INDEX, M_matrix, P_matrix, Q_matrix, Q_shaft
from models.signals.block import BoolArray, ComplexArray, FloatArray, IndexArray
from models.signals.channels import parts_seen

# Parameters that shape the spectra, in the order of the parameter vector.
STRUCTURAL = ("k_by", "c_by", "k_bz", "c_bz", "EI")
Speeds = float | tuple[float, float]
"""Speed of the gyroscopic terms, rad/s; where it varies within a window, two of the same mean and standard deviation.

The spectra are averaged over both. With a single source, motions at one speed are fully coherent but for noise, and
those at a mixture of speeds are not, which would pass for a misfit.
"""
CORNERS = 3  # of the noise's colour, where one does not suffice
_APART = 4.0  # ratio of each corner to the next
_GRID = 100  # frequencies over which their functions are made orthonormal
# Polynomials in √f for the colour that all forces share, and for the difference of each one's own from it.
COMMON, SHAPES = 24, 8
_OWN = helmert(6)  # orthonormal differences of six forces, shape (5, 6)
ROWS, COLUMNS = np.tril_indices(6)  # elements of C and T in the order of the parameter vector
IDENTITY = np.eye(6)[ROWS, COLUMNS]  # equal independent sources of level one
_BEARING_DOFS = (0, 0, 3, 3)


@dataclass(frozen=True, slots=True)
class Expected:
    """Expected spectra at one parameter point, in the motions' units."""

    theta: FloatArray  # (size,), the parameter point
    S: ComplexArray  # (n_groups, n, n), cross-spectral matrices
    C: FloatArray  # (6, 6), level matrix
    speed_rad_s: Speeds


@dataclass(frozen=True, slots=True)
class ModelPoint(Expected):
    """Expected spectra and what their derivatives need: a megabyte, so do not keep it."""

    # (n_groups, n_nodes, n, 6): transfer from forces (in units of C, coloured) to measured motions, times the root of
    # the node's weight
    G: ComplexArray
    receptance: ComplexArray  # (n_distinct, 6, 6), of all six degrees of freedom, SI, distinct frequencies by speed
    place: IndexArray  # (n_groups, n_nodes), index of each node's receptance among these
    unit: FloatArray  # (n_groups, 1, 1, 6), the forces' units and D

    @property
    def H(self) -> ComplexArray:
        """Receptance for the same forces, without the root of the weight, shape (n_groups, n_nodes, 6, 6)."""
        return np.asarray(self.receptance[self.place] * self.unit, dtype=np.complex128)

    @property
    def expected(self) -> Expected:
        """The spectra alone."""
        return Expected(self.theta, self.S, self.C, self.speed_rad_s)


class SpectralModel:
    """Expected cross-spectra and their derivatives for one machine, set of measured states, and groups of bins.

    The parameter vector holds the logarithmic ratios of `STRUCTURAL` to nominal, the logarithms of the low-pass's
    cutoff (Hz) and order, the logarithms of the noise densities of the measured states (in units of `scale`² per
    Hz), their exponents b, the coefficients of the forces' colours (of that which all share, over √6, then of their
    orthonormal differences polynomial by polynomial), and the lower triangle of T.

    The motions are in units that make all spectra of order one, and forces in `force_scale`, N/√Hz, which does the same
    for the elements of C. Without polynomials for the forces' colour (`shapes` = 0), all forces share one low-pass.
    """

    def __init__(
        self,
        machine: Machine,
        motions: Motions,
        groups: BinGroups,
        force_scale: float = 1.0,
        shapes: int = SHAPES,
        corners: int = 1,
    ) -> None:
        rotor = machine.rotor
        self.machine, self.motions, self.n, self.shapes, self.corners = machine, motions, motions.n, shapes, corners
        # A moment acts through a lever of a third of the shaft, so that levels of forces and moments share one unit.
        lever = rotor.shaft_length_m / 3
        self.force_unit = force_scale * np.array([1.0, 1.0, lever, 1.0, 1.0, lever])
        self._M, self._Q, self._Q_shaft = M_matrix(rotor), Q_matrix(rotor), Q_shaft(rotor)
        made = np.array(motions.states)[_integrated(machine, motions.states)]
        self._integrated = np.isin(motions.dofs, [STATE_INDEX[state] % 6 for state in made])
        self._bearing = np.array([rotor.k_by_N_per_m, rotor.c_by_N_s_per_m, rotor.k_bz_N_per_m, rotor.c_bz_N_s_per_m])
        self.cutoff_at = len(STRUCTURAL)
        self.order_at = self.cutoff_at + 1
        self.noise_at = slice(self.order_at + 1, self.order_at + 1 + len(motions.states))
        self.colour_at = slice(self.noise_at.stop, self.noise_at.stop + corners * self.n)
        self.common_at = slice(self.colour_at.stop, self.colour_at.stop + (COMMON if shapes else 0))
        self.own_at = slice(self.common_at.stop, self.common_at.stop + 5 * shapes)
        self.level_at = slice(self.own_at.stop, self.own_at.stop + ROWS.size)
        self.size = self.level_at.stop
        self._see(groups)

    def seen_in(self, groups: BinGroups) -> "SpectralModel":
        """The same model with other groups of bins."""
        other = copy(self)
        other._see(groups)
        return other

    def _see(self, groups: BinGroups) -> None:
        self.groups = groups
        low, high = self.machine.window.band_hz
        self._noise_shapes = _noise_shapes(groups.centre_hz, low, high, self.corners)
        # In √f the polynomials resolve a low-pass at the lower end as well as a hump at the upper end.
        x = 2 * (np.sqrt(groups.centre_hz) - np.sqrt(low)) / (np.sqrt(high) - np.sqrt(low)) - 1
        self._b = eval_legendre(np.arange(1, (COMMON if self.shapes else 0) + 1), x[:, None])
        self._w = 2 * np.pi * groups.nodes_hz
        # Neighbouring groups share nodes and are padded to equal numbers: with light damping half are duplicates.
        self._distinct_w, place = np.unique(self._w, return_inverse=True)
        speed = np.arange(groups.speeds).repeat(self._w.shape[1] // groups.speeds)
        self._place = place.reshape(self._w.shape) + self._distinct_w.size * speed
        self.centre = 2 * np.pi * groups.centre_hz
        self._factor = self.motions.factor(self._w, self.centre[:, None])
        if self._integrated.any():  # an acceleration over jω of the group's centre, see `grouped`
            at_centre = self.motions.factor(self._w**2 / self.centre[:, None], self.centre[:, None])
            self._factor = np.where(self._integrated, at_centre, self._factor)
        shares = self.motions.shares(self.centre)
        self._motion_of = np.array([shares[state][0] for state in self.motions.states])
        self._share = np.stack([shares[state][1] for state in self.motions.states], axis=1)
        self._combined: ComplexArray | None = None

    def receptance(self, structural: FloatArray, speed_rad_s: float, w: FloatArray) -> ComplexArray:
        """H(ω) = (-ω²M + jωP + Q)⁻¹ in SI units, shape (n_frequencies, 6, 6), at angular frequencies w, rad/s.

        `structural`, shape (5,), are the logarithmic ratios of `STRUCTURAL` to nominal.
        """
        change = self._bearing * np.expm1(structural[:4])
        Q = self._Q + self._Q_shaft * np.expm1(structural[4])
        M, P = self._M, P_matrix(self.machine.rotor, speed_rad_s)
        Q[[0, 3], [0, 3]] += change[::2]
        P[[0, 3], [0, 3]] += change[1::2]
        # Both planes by cofactors, then the gyroscopic coupling g: [[A, g eeᵀ], [-g eeᵀ, B]]⁻¹ follows from A⁻¹, B⁻¹
        # and their columns A⁻¹e and B⁻¹e. For hundreds of frequencies at once this takes a quarter of the time of
        # inverting one matrix after the other.
        diagonal = np.diag(Q)[:, None] - np.diag(M)[:, None] * w**2 + 1j * np.diag(P)[:, None] * w
        p, q, r = diagonal.reshape(2, 3, w.size).swapaxes(0, 1)  # of each plane
        a, b, c = (Q[[i, i + 3], [j, j + 3], None] for i, j in ((0, 1), (0, 2), (1, 2)))
        pq, pr, qr = b * c - a * r, a * c - b * q, a * b - c * p
        cofactors = np.array([[q * r - c**2, pq, pr], [pq, p * r - b**2, qr], [pr, qr, p * q - a**2]])
        planes = (cofactors * (1 / (p * cofactors[0, 0] + a * pq + b * pr))).transpose(2, 0, 1, 3)
        columns, tilts, g = planes[:, 2], planes[:, 2, 2], 1j * w * P[2, 5]
        shared = g / (1 + g**2 * tilts[0] * tilts[1])
        coupling = (shared * columns[0])[:, None] * columns[1]
        turned = ((shared * g * tilts[::-1])[:, None] * columns)[:, :, None] * columns[:, None]
        H = np.empty((w.size, 2, 3, 2, 3), dtype=np.complex128)
        blocks = H.transpose(1, 3, 2, 4, 0)
        blocks[0, 0], blocks[1, 1] = planes - turned
        blocks[0, 1], blocks[1, 0] = -coupling, coupling.swapaxes(0, 1)
        return H.reshape(-1, 6, 6)

    def dynamic_changes(self, structural: FloatArray, w: float) -> ComplexArray:
        """Derivatives of -ω²M + jωP + Q with respect to the logarithmic ratios of `STRUCTURAL`, shape (5, 6, 6)."""
        changes = np.zeros((len(STRUCTURAL), 6, 6), dtype=np.complex128)
        for number, dof in enumerate(_BEARING_DOFS):
            changes[number, dof, dof] = (
                self._bearing[number] * np.exp(structural[number]) * (1j * w if number % 2 else 1)
            )
        changes[4] = self._Q_shaft * np.exp(structural[4])
        return changes

    def observed(self, states: ComplexArray) -> ComplexArray:
        """Cross-spectra of the motions from those of the states, shape (n_groups, n, n)."""
        matrix = self._combined = self.motions.combine(self.centre) if self._combined is None else self._combined
        return np.asarray(matrix @ states @ matrix.conj().swapaxes(-1, -2), dtype=np.complex128)

    def measured(self, response: ComplexArray, w: FloatArray) -> ComplexArray:
        """Measured motions from the responses of all coordinates at each frequency, shape (n_frequencies, n, …)."""
        return np.asarray(response[:, self.motions.dofs] * self.motions.factor(w, w)[:, :, None], dtype=np.complex128)

    def levels(self, theta: FloatArray) -> FloatArray:
        """C = T Tᵀ, shape (6, 6)."""
        T = self.factor(theta)
        return np.asarray(T @ T.T, dtype=np.float64)

    def factor(self, theta: FloatArray) -> FloatArray:
        """T, shape (6, 6)."""
        T = np.zeros((6, 6))
        T[ROWS, COLUMNS] = theta[self.level_at]
        return T

    def at(self, theta: FloatArray, speed_rad_s: Speeds, C: FloatArray | None = None) -> ModelPoint:
        """Expected spectra at a parameter point, with the level matrix C instead of its own if given.

        There are as many speeds as `groups` have.
        """
        speeds = speed_rad_s if isinstance(speed_rad_s, tuple) else (speed_rad_s,)
        H = np.concatenate([self.receptance(theta[: self.cutoff_at], one, self._distinct_w) for one in speeds])
        own = self._b[:, : self.shapes] @ theta[self.own_at].reshape(self.shapes, 5) @ _OWN
        colour = np.exp(0.5 * ((self._b @ theta[self.common_at])[:, None] / np.sqrt(6) + own))
        unit = self.force_unit * colour[:, None, None, :]
        gain = low_pass(self.groups.nodes_hz, *self.filter(theta)) * self.groups.weights
        G = H[:, self.motions.dofs][self._place]
        for factor in (self._factor[..., None], unit, np.sqrt(gain)[:, :, None, None]):
            G *= factor
        C = self.levels(theta) if C is None else C
        S = _summed(through(C, G), G)
        diagonal = np.arange(self.n)
        S[:, diagonal, diagonal] += self.noise(theta)
        return ModelPoint(theta, S, C, speed_rad_s, G, H, self._place, unit)

    def moved(self, theta: FloatArray, step: FloatArray) -> FloatArray:
        """The parameter point after a step: logarithms move by at most one, as far from the data the slopes mislead.

        A noise variance takes the scoring step on the variance itself.
        """
        moved, logarithms = theta + step, slice(self.level_at.start)
        moved[logarithms] = theta[logarithms] + np.clip(step[logarithms], -1, 1)
        moved[self.noise_at] = theta[self.noise_at] + np.log(np.clip(1 + step[self.noise_at], 0.2, 4))
        return moved

    def stepped(self, point: Expected, step: FloatArray, speed_rad_s: Speeds) -> ModelPoint:
        """The point after a step that moves the elements of C, not of T, linearly."""
        theta, C = self.moved(point.theta, step), point.C.copy()
        C[ROWS, COLUMNS] += step[self.level_at]
        C[COLUMNS, ROWS] = C[ROWS, COLUMNS]
        values, vectors = np.linalg.eigh(C)
        root = vectors * np.sqrt(np.maximum(values, 0))  # of the positive semidefinite matrix nearest to C
        theta[self.level_at] = np.linalg.qr(root.T)[1].T[ROWS, COLUMNS]
        return self.at(theta, speed_rad_s, C)

    def filter(self, theta: FloatArray) -> tuple[float, float]:
        """Cutoff (Hz) and order of the low-pass."""
        return float(np.exp(theta[self.cutoff_at])), float(np.exp(theta[self.order_at]))

    def noise(self, theta: FloatArray) -> FloatArray:
        """d(f) of every measured motion, shape (n_groups, n)."""
        noise = np.zeros((self._share.shape[0], self.n))
        np.add.at(noise.T, self._motion_of, self._noise_parts(theta).T)
        return noise

    def _noise_parts(self, theta: FloatArray) -> FloatArray:
        """Contribution of each state to the noise density of its motion, shape (n_groups, n_states)."""
        colour = self._noise_shapes @ theta[self.colour_at].reshape(self.corners, self.n)
        exponent = theta[self.noise_at] + colour[:, self._motion_of]
        return np.asarray(self._share * np.exp(exponent), dtype=np.float64)

    def slopes(self, point: ModelPoint, L_inverse: ComplexArray, out: FloatArray | None = None) -> FloatArray:
        """L⁻¹ (∂S/∂θ_a) L⁻ᴴ for every parameter a, packed, shape (size, n_groups, n²).

        The last 21 are with respect to the elements of C, not of T. With ∂H = -H ∂D H every derivative for a structural
        parameter or a level is an outer product of columns of G and of G C Hᴴ plus its conjugate transpose. `out` is a
        buffer for the result: megabytes, better not allocated at every step.
        """
        theta, sides = point.theta, Sides(point, L_inverse)
        whitened, response = sides.whitened, sides.response
        if out is None:
            out = np.empty((self.size, self._w.shape[0], self.n * self.n))
        dynamic_change = self._bearing * np.exp(theta[:4])
        for parameter, dof in enumerate(_BEARING_DOFS):
            factor = -dynamic_change[parameter] * (1j * self._w if parameter % 2 else np.ones_like(self._w))
            out[parameter] = sides.slope(factor, slice(dof, dof + 1))
        out[4] = sides.slope(-np.ones_like(self._w), change=self._Q_shaft * np.exp(theta[4]))
        of_filter = low_pass_slopes(self.groups.nodes_hz, *self.filter(theta))
        for at, slope in zip((self.cutoff_at, self.order_at), of_filter, strict=True):
            out[at] = packed(_summed(response * slope[:, :, None, None], whitened))
        of_noise = L_inverse.transpose(2, 0, 1)
        densities = packed(of_noise[:, :, :, None] * of_noise.conj()[:, :, None, :])
        out[self.noise_at] = self._noise_parts(theta).T[:, :, None] * densities[self._motion_of]
        of_colours = out[self.colour_at].reshape(self.corners, self.n, *out.shape[1:])
        shaped = self.noise(theta)[:, None] * self._noise_shapes[..., None]
        np.multiply(shaped.transpose(1, 2, 0)[..., None], densities, out=of_colours)
        left, right = (side.transpose(3, 0, 2, 1) for side in (whitened, response.conj()))  # of every force
        by_force = twice_packed(np.asarray(left @ right.swapaxes(2, 3))) / 2
        b = self._b.T[:, :, None]
        np.multiply(b, by_force.sum(axis=0) / np.sqrt(6), out=out[self.common_at])
        of_own = out[self.own_at].reshape(self.shapes, 5, *out.shape[1:])
        np.multiply(b[: self.shapes, None], np.tensordot(_OWN, by_force, axes=1), out=of_own)
        columns = whitened.transpose(0, 2, 3, 1).reshape(len(whitened), self.n * 6, -1)
        pairs = (columns @ columns.conj().swapaxes(1, 2)).reshape(-1, self.n, 6, self.n, 6)[:, :, ROWS, :, COLUMNS]
        out[self.level_at] = twice_packed(pairs) * np.where(ROWS == COLUMNS, 0.5, 1.0)[:, None, None]
        return out


def grouped(machine: Machine, window: WindowStatistics, groups: BinGroups) -> ComplexArray:
    """Estimated cross-spectra of a window's states, averaged over each group, shape (n_groups, n_states, n_states).

    Accelerations were divided by jω of their bins. What leaks from a narrow resonance into several bins keeps its phase
    and its ratio to a displacement only if one ω divides all bins of a group: that of its centre.
    """
    made, spectrum = _integrated(machine, window.states), window.spectrum
    if made.any():
        turn = np.ones(spectrum.shape[:2])
        for (first, end), centre_hz in zip(groups.edges, groups.centre_hz, strict=True):
            turn[first:end, made] = window.frequencies_hz[first:end, None] / centre_hz
        spectrum = spectrum * turn[:, :, None] * turn[:, None, :]
    return groups.average(spectrum)


def _integrated(machine: Machine, states: tuple[str, ...]) -> BoolArray:
    """Which states are velocities that no sensor measures: integrals of accelerations."""
    measured = {state for sensor in machine.sensors for state in parts_seen(sensor)}
    return np.array([state.endswith("_dot") and state not in measured for state in states])


def _noise_shapes(frequencies_hz: FloatArray, low_hz: float, high_hz: float, corners: int) -> FloatArray:
    """Functions of frequency that colour the noise, shape (n_frequencies, corners).

    Several are orthonormal over the band and to a constant: where parameters do nearly the same, the search is slow.
    """
    corner_hz = 2 / 3 * high_hz
    if corners == 1:
        return np.log1p((frequencies_hz[:, None] / corner_hz) ** 2)
    at_hz = np.concatenate([np.linspace(low_hz, high_hz, _GRID), frequencies_hz])[:, None]
    shapes = np.log1p((_APART ** np.arange(corners) * at_hz / corner_hz) ** 2)
    shapes = np.column_stack([np.ones(len(at_hz)), shapes])
    L = np.linalg.cholesky(shapes[:_GRID].T @ shapes[:_GRID] / _GRID)
    return np.asarray(np.linalg.solve(L, shapes[_GRID:].T)[1:].T, dtype=np.float64)


class Sides:
    """Left and right factors of a change of the dynamic matrix in the slope of the spectra.

    They are made of `whitened`, L⁻¹G, and its `response`, L⁻¹GC, both of shape (n_groups, n_nodes, n, 6).
    """

    def __init__(self, point: ModelPoint, L_inverse: ComplexArray) -> None:
        self.whitened: ComplexArray = L_inverse[:, None] @ point.G
        self.response = through(point.C, self.whitened)
        self._left = self.whitened * (1 / point.unit)
        self._right = self.response.conj() @ point.H.swapaxes(2, 3)

    def slope(
        self, factor: ComplexArray | FloatArray, dofs: slice = slice(None), change: FloatArray | None = None
    ) -> FloatArray:
        """Packed slope of the spectra with respect to a change of the dynamic matrix, sign reversed.

        The block of the `dofs` changes by `factor`, shape (n_groups, n_nodes), times the symmetric matrix `change`,
        shape (n_dofs, n_dofs), by default the identity.
        """
        n_groups, _, n, _ = self._left.shape
        moved = self._left[..., dofs] * factor[..., None, None]
        if change is not None:
            moved = through(change, moved)
        left, right = (side.transpose(0, 2, 1, 3).reshape(n_groups, n, -1) for side in (moved, self._right[..., dofs]))
        return twice_packed(np.asarray(left @ right.swapaxes(1, 2)))


def packed(matrices: ComplexArray) -> FloatArray:
    """Hermitian matrices as real vectors with the same inner product tr(A B), shape (…, n²)."""
    diagonal, rows, columns = _upper(matrices.shape[-1])
    upper = np.sqrt(2) * matrices[..., rows, columns]
    return np.concatenate([matrices[..., diagonal, diagonal].real, upper.real, upper.imag], axis=-1)


def twice_packed(matrices: ComplexArray) -> FloatArray:
    """X + Xᴴ of square matrices X, packed."""
    diagonal, rows, columns = _upper(matrices.shape[-1])
    upper = np.sqrt(2) * (matrices[..., rows, columns] + matrices[..., columns, rows].conj())
    return np.concatenate([2 * matrices[..., diagonal, diagonal].real, upper.real, upper.imag], axis=-1)


@lru_cache
def _upper(n: int) -> tuple[IndexArray, IndexArray, IndexArray]:
    """Indices of the diagonal, and rows and columns of the elements above it."""
    return np.arange(n), *np.triu_indices(n, 1)


def _summed(left: ComplexArray, right: ComplexArray) -> ComplexArray:
    """Σ over nodes of left rightᴴ, shape (n_groups, n, n)."""
    n_groups, _, n, _ = left.shape
    A, B = (part.transpose(0, 2, 1, 3).reshape(n_groups, n, -1) for part in (left, right))
    return np.asarray(A @ B.conj().transpose(0, 2, 1), dtype=np.complex128)


_START_NOISE = float(np.log(2e-3))
# Power, relative to the forced response, below which forces are not reconstructed: noise would pass for them.
_REGULARISED = 1e-2
_VISIBLE = 0.02
_LEAST_LEVEL = 1e-3


def usual_force(machine: Machine, motions: Motions, groups: BinGroups, speed_rad_s: Speeds, cutoff_hz: float) -> float:
    """Unit of force, N/√Hz, in which equal independent sources of level one cause the mean power that was measured.

    A parameter point therefore stays a good start when the machine merely becomes louder.
    """
    model = SpectralModel(machine, motions, groups, shapes=0)
    theta = np.zeros(model.size)
    theta[model.cutoff_at], theta[model.order_at] = np.log(cutoff_hz), np.log(2)
    theta[model.noise_at] = -np.inf
    theta[model.level_at] = IDENTITY
    explained = groups.bins @ np.einsum("fii->f", model.at(theta, speed_rad_s).S).real / (model.n * groups.bins.sum())
    return float(explained**-0.5)


def starting_point(model: SpectralModel, observed: ComplexArray, centre: FloatArray, speed_rad_s: float) -> FloatArray:
    """Guess the excitation with the nominal rotor.

    Forces follow from the response through the regularised inverse of G, bin group by bin group; their mean, divided by
    the low-pass that fits its trace best, is the level matrix. Everything else has its usual value, from `centre`.
    """
    groups = model.groups
    w = 2 * np.pi * groups.centre_hz
    G = model.measured(model.receptance(np.zeros(len(STRUCTURAL)), speed_rad_s, w), w) * model.force_unit
    power = np.einsum("fai,fai->f", G.conj(), G).real / model.n
    regular = G @ _H(G) + (_REGULARISED * power)[:, None, None] * np.eye(model.n)
    inverse = _H(G) @ np.linalg.inv(regular)
    forces = (inverse @ observed @ _H(inverse)).real
    total = np.einsum("fii->f", forces)
    visible = groups.bins * np.minimum(1, np.einsum("fii->f", observed).real / model.n / _VISIBLE)
    cutoff_hz = _best_cutoff(groups.centre_hz, total, visible)
    gain = low_pass(groups.centre_hz, cutoff_hz)
    weight = visible * np.minimum(1, 10 * gain)
    C = np.tensordot(weight / gain, forces, axes=1) / weight.sum()
    C += _LEAST_LEVEL * np.trace(C) / 6 * np.eye(6)
    theta = centre.copy()
    theta[model.cutoff_at] = np.log(cutoff_hz)
    theta[model.noise_at] = _START_NOISE
    theta[model.level_at] = np.linalg.cholesky(C)[ROWS, COLUMNS]
    return theta


def _best_cutoff(frequency_hz: FloatArray, total: FloatArray, weight: FloatArray) -> float:
    """Cutoff (Hz) whose low-pass leaves the least scatter in the logarithm of the forces, with outliers clipped."""
    scatter = {}
    for cutoff_hz in np.geomspace(frequency_hz[0] * 3, frequency_hz[-1] * 3, 24):
        rest = np.log(total / low_pass(frequency_hz, float(cutoff_hz)))
        rest = rest - weight @ rest / weight.sum()
        scatter[float(cutoff_hz)] = float(weight @ np.minimum(rest**2, 1))
    return min(scatter, key=scatter.__getitem__)


def _H(matrices: ComplexArray) -> ComplexArray:
    return np.asarray(matrices.conj().swapaxes(-1, -2), dtype=np.complex128)
