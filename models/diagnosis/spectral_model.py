"""Theory of the cross-spectra for the likelihood: rotor, unknown smooth excitation, sensor noise.

The measured states' cross-spectral matrix at frequency f is

    S(f) = c(f; fc) · G C Gᴴ + diag(d(f)),   G = [H; jωH] at the measured rows,

with H = (-ω²M + jωP + Q)⁻¹ the receptance of Eq. (1), c the power gain of a second-order low-pass of unknown cutoff,
and C an unknown full level matrix over all six degrees of freedom: one source of any direction, or many. It enters
linearly, so the search does not get stuck where a factor of it would lose rank, and standard errors stay honest there.
The spectra are the Fourier transforms of the correlation functions of Eq. (18), so this is the comparison of
theoretical and estimated correlations with the right weight on every lag.

The sensor noise has a smooth spectrum of its own in every channel, d(f) = d₀ (1 + (f/f_r)²)^b with f_r two thirds of
the band's end: white for b = 0, first-order low-pass at f_r for b = -1. Taken as white when it is not, it pulled the
damping of the heavy machine down by up to 15 %.
"""

from dataclasses import dataclass

import numpy as np

from models.diagnosis.moments import ComplexArray
from models.machine import Machine
from models.physics.excitation import low_pass, low_pass_slope
from models.physics.matrices import STATE_INDEX, M_matrix, P_matrix, Q_matrix, Q_shaft
from models.signals.block import FloatArray

__all__ = ["STRUCTURAL", "ModelPoint", "SpectralModel"]

STRUCTURAL = ("k_by", "c_by", "k_bz", "c_bz", "EI")
"""Parameters that shape the spectra, in the order of the parameter vector."""

_BEARING_DOFS = (0, 0, 3, 3)
_ROWS, _COLUMNS = np.tril_indices(6)


@dataclass(frozen=True, slots=True)
class ModelPoint:
    """Spectra at one parameter point and what their derivatives are made of, in units of the states' scale.

    Attributes
    ----------
    theta : ndarray, shape (size,)
        The parameter point.
    S : ndarray, shape (n_bins, n, n)
        Cross-spectral matrices.
    G : ndarray, shape (n_bins, n, 6)
        Transfer from forces to measured states.
    H : ndarray, shape (n_bins, 6, 6)
        Receptance of all six degrees of freedom, for levels in units of `force_scale`.
    C : ndarray, shape (6, 6)
        Level matrix.
    """

    theta: FloatArray
    S: ComplexArray
    G: ComplexArray
    H: ComplexArray
    C: FloatArray


class SpectralModel:
    """Cross-spectra and their derivatives for one machine, set of measured states, and frequencies.

    The parameter vector holds the logarithmic ratios of `STRUCTURAL` to nominal, the logarithm of the cutoff (Hz), the
    logarithms of the noise densities d₀ of the measured states (in units of `scale`² per Hz), their exponents b, and
    the lower triangle of C.

    Parameters
    ----------
    machine : Machine
        Nominal rotor.
    states : tuple of str
        Measured states.
    frequencies_hz : ndarray, shape (n_bins,)
        Frequencies of the spectra.
    scale : ndarray, shape (n,)
        Unit of each measured state, so that all spectra are of the order of one.
    force_scale : float
        Unit of forces, N/√Hz, so that the elements of C are of the order of one.
    """

    def __init__(
        self,
        machine: Machine,
        states: tuple[str, ...],
        frequencies_hz: FloatArray,
        scale: FloatArray,
        force_scale: float = 1.0,
    ) -> None:
        rotor = machine.rotor
        self.n = len(states)
        self.frequencies_hz = frequencies_hz
        self.scale = scale
        self.force_scale = force_scale
        index = np.array([STATE_INDEX[name] for name in states])
        self._dofs, self._is_rate = index % 6, index >= 6
        # A moment acts through a lever of a third of the shaft, so that levels of forces and moments share one unit.
        lever = rotor.shaft_length_m / 3
        self._lever = force_scale * np.array([1.0, 1.0, lever, 1.0, 1.0, lever])
        self._rotor = rotor
        self._M, self._Q, self._Q_shaft = M_matrix(rotor), Q_matrix(rotor), Q_shaft(rotor)
        self._bearing = np.array([rotor.k_by_N_per_m, rotor.c_by_N_s_per_m, rotor.k_bz_N_per_m, rotor.c_bz_N_s_per_m])
        self._noise_shape = np.log1p((frequencies_hz / (2 / 3 * machine.window.band_hz[1])) ** 2)
        self.cutoff_at = len(STRUCTURAL)
        self.noise_at = slice(self.cutoff_at + 1, self.cutoff_at + 1 + self.n)
        self.colour_at = slice(self.noise_at.stop, self.noise_at.stop + self.n)
        self.level_at = slice(self.colour_at.stop, self.colour_at.stop + _ROWS.size)
        self.size = self.level_at.stop

    def receptance(self, structural: FloatArray, speed_rad_s: float, w: FloatArray) -> ComplexArray:
        """H(ω) = (-ω²M + jωP + Q)⁻¹ in SI units, shape (n_frequencies, 6, 6).

        Parameters
        ----------
        structural : ndarray, shape (5,)
            Logarithmic ratios of `STRUCTURAL` to nominal.
        speed_rad_s : float
            Speed Ω of the gyroscopic terms.
        w : ndarray, shape (n_frequencies,)
            Angular frequencies, rad/s.
        """
        change = self._bearing * np.expm1(structural[:4])
        Q = self._Q + self._Q_shaft * np.expm1(structural[4])
        P = P_matrix(self._rotor, speed_rad_s)
        Q[0, 0] += change[0]
        P[0, 0] += change[1]
        Q[3, 3] += change[2]
        P[3, 3] += change[3]
        dynamic = -(w[:, None, None] ** 2) * self._M + 1j * w[:, None, None] * P + Q
        return np.asarray(np.linalg.inv(dynamic), dtype=np.complex128)

    def measured(self, response: ComplexArray, w: FloatArray) -> ComplexArray:
        """Measured states of the responses of all coordinates, shape (n_frequencies, n, …), in the scale's units."""
        factor = np.where(self._is_rate, 1j * w[:, None], 1.0) / self.scale
        return np.asarray(response[:, self._dofs] * factor[:, :, None], dtype=np.complex128)

    def at(self, theta: FloatArray, speed_rad_s: float) -> ModelPoint:
        """Spectra at a parameter point."""
        w = 2 * np.pi * self.frequencies_hz
        H = self.receptance(theta[: self.cutoff_at], speed_rad_s, w)
        C = np.zeros((6, 6))
        C[_ROWS, _COLUMNS] = C[_COLUMNS, _ROWS] = theta[self.level_at]
        G = self.measured(H, w) * self._lever
        colour = low_pass(self.frequencies_hz, float(np.exp(theta[self.cutoff_at])))
        S = colour[:, None, None] * (G @ C @ _H(G))
        diagonal = np.arange(self.n)
        S[:, diagonal, diagonal] += self._noise(theta)
        return ModelPoint(theta, S, G, H * self._lever, C)

    def _noise(self, theta: FloatArray) -> FloatArray:
        """d(f) of every measured state, shape (n_bins, n)."""
        exponent = theta[self.noise_at] + self._noise_shape[:, None] * theta[self.colour_at]
        return np.asarray(np.exp(exponent), dtype=np.float64)

    def whitened_derivatives(self, point: ModelPoint, L_inverse: ComplexArray) -> ComplexArray:
        """L⁻¹ (∂S/∂θ_a) L⁻ᴴ for every parameter a, shape (n_bins, size, n, n), where S = L Lᴴ.

        With ∂H = -H ∂D H every structural derivative, and every level's, is an outer product of columns of G and B plus
        its conjugate transpose.
        """
        w = 2 * np.pi * self.frequencies_hz
        theta = point.theta
        cutoff_hz = float(np.exp(theta[self.cutoff_at]))
        colour = low_pass(self.frequencies_hz, cutoff_hz)
        G = L_inverse @ point.G * np.sqrt(colour)[:, None, None]
        GC = G @ point.C
        out = np.empty((w.size, self.size, self.n, self.n), dtype=np.complex128)
        dynamic_change = self._bearing * np.exp(theta[:4])
        for parameter, dof in enumerate(_BEARING_DOFS):
            u = -dynamic_change[parameter] / self._lever[dof] * G[:, :, dof]
            if parameter % 2:
                u = u * (1j * w[:, None])
            v = (GC @ point.H[:, dof].conj()[:, :, None])[:, :, 0]
            out[:, parameter] = _plus_transpose(u[:, :, None] * v.conj()[:, None, :])
        shaft = -((G / self._lever) @ (self._Q_shaft * np.exp(theta[4]))) @ point.H @ _H(GC)
        out[:, 4] = _plus_transpose(shaft)
        out[:, self.cutoff_at] = low_pass_slope(self.frequencies_hz, cutoff_hz)[:, None, None] * (GC @ _H(G))
        columns = L_inverse.transpose(0, 2, 1)
        noise = self._noise(theta)[:, :, None, None] * (columns[:, :, :, None] * columns.conj()[:, :, None, :])
        out[:, self.noise_at] = noise
        out[:, self.colour_at] = noise * self._noise_shape[:, None, None, None]
        forces = G.transpose(0, 2, 1)
        pairs = forces[:, _ROWS, :, None] * forces.conj()[:, _COLUMNS, None, :]
        out[:, self.level_at] = _plus_transpose(pairs) * np.where(_ROWS == _COLUMNS, 0.5, 1.0)[:, None, None]
        return out


def _H(matrices: ComplexArray) -> ComplexArray:
    return matrices.conj().swapaxes(-1, -2)


def _plus_transpose(matrices: ComplexArray) -> ComplexArray:
    return matrices + _H(matrices)
