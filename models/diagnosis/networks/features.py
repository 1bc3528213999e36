"""Inputs of the amortised networks: a window's cross-spectra, transformed so that faults stand out.

The cross-spectra are the Fourier transforms of the correlation functions (Eq. 18), with the same information. They are
transformed to forces with the *nominal* machine: the motion of the measured degrees of freedom times the nominal
dynamic stiffness is the force that the nominal machine would have needed. If the machine is nominal, these force
spectra are those of the excitation: smooth, with one constant coherence. A changed parameter adds a component of its
own, the measured motion times the change. Every frequency has the same weight as in the likelihood: logarithms of the
force spectra, and coherences instead of cross-spectra, have the same sampling error at all frequencies, loud or quiet.
Levels drop out.

Frequencies are then condensed to principal components of *expected* features over random machines and conditions, which
leaves out directions with nothing but sampling error.
"""

from copy import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.diagnosis.window.moments import plan_for
from models.machine import Machine
from models.physics.excitation import Source
from models.physics.response import stochastic_covariance
from models.physics.rotor import STATE_INDEX, M_matrix, P_matrix, Q_matrix
from models.signals.block import ComplexArray, Float32Array, FloatArray

_BANDS = 8
_FLOOR = 1e-9
_LEAST_VARIANCE = 1e-3


class ForceFeatures:
    """Features of one machine's windows before they are condensed, from all its measured states or from some.

    `near` adds features for machines that are nearly nominal. With one source, all forces at a frequency share their
    sampling error, so it cancels in differences of their levels; the imaginary part of the squared coherence shows
    whether forces lag behind each other, independently of their relative sign.
    """

    def __init__(self, machine: Machine, states: tuple[str, ...] | None = None, near: bool = False) -> None:
        plan = plan_for(machine)
        self.states, self.frequencies_hz = plan.states if states is None else states, plan.frequencies_hz
        self.has_angle = plan.angle_column is not None
        self._near = near
        self._duration_s = plan.hops * plan.hop / plan.rate_hz
        index = np.array([STATE_INDEX[name] for name in self.states])
        self._dofs, self._rates = sorted(set(index % 6)), index >= 6
        self._rows = np.searchsorted(self._dofs, index % 6)
        self._pairs = tuple((i, j) for i in range(len(self._dofs)) for j in range(i))
        self._measured_twice = tuple(
            (self.states.index(name), self.states.index(f"{name}_dot"))
            for name in self.states
            if f"{name}_dot" in self.states
        )
        self._bands = np.linspace(0, self.frequencies_hz.size, _BANDS + 1)[:-1].astype(int)
        self._take(machine)

    def around(self, machine: Machine) -> "ForceFeatures":
        """The `near` features with forces computed for another machine with the same sensors."""
        found = copy(self)
        found._near = True
        found._take(machine)
        return found

    def _take(self, machine: Machine) -> None:
        self._machine = machine
        rotor = machine.rotor
        self._corners_rad_s = self._corners()[self._rows]
        # Matrices multiplied by 1, ω², jω and jωΩ (gyroscopic); measured degrees of freedom first.
        still = P_matrix(rotor, 0.0)
        order = [*self._dofs, *(dof for dof in range(6) if dof not in self._dofs)]
        terms = np.array([Q_matrix(rotor), -M_matrix(rotor), still, P_matrix(rotor, 1.0) - still])
        self._terms = terms[:, order][:, :, order].reshape(4, -1).astype(np.complex128)
        w = 2 * np.pi * self.frequencies_hz
        self._force = self._to_force(w, np.full(w.size, machine.operation.speed_rad_s))

    @property
    def n_series(self) -> int:
        """Number of functions of frequency: force spectra, real and imaginary coherences, and more with `near`."""
        return len(self._dofs) + 2 * len(self._pairs) + (1 + len(self._pairs) if self._near else 0)

    @property
    def n_consistency(self) -> int:
        """Number of features from `consistency`."""
        return 1 + 2 * _BANDS * len(self._measured_twice)

    def _corners(self) -> FloatArray:
        """Corner ω above which rates replace displacements, for each measured degree of freedom, rad/s.

        Sensor noise is proportional to a channel's rms, so ω is the ratio of the rms of rate and displacement, here of
        the nominal machine under equal forces. It is 0 if only the rate is measured, infinite if only the displacement.
        """
        machine = self._machine
        cutoff = float(np.sqrt(machine.condition.cutoff_hz[0] * machine.condition.cutoff_hz[1]))
        sources = tuple(
            Source(cutoff_hz=cutoff, direction=tuple(np.eye(6)[dof]), force_rms_N=1.0) for dof in (0, 1, 3, 4)
        )
        variance = np.diag(stochastic_covariance(machine.rotor, machine.operation.speed_rad_s, sources))
        corner = np.sqrt(variance[6:] / variance[:6])
        present = {STATE_INDEX[name] for name in self.states}
        return np.array(
            [0.0 if d not in present else np.inf if d + 6 not in present else corner[d] for d in self._dofs]
        )

    def _to_force(self, w: FloatArray, speed_rad_s: FloatArray) -> ComplexArray:
        """Matrices that transform measured states to equivalent forces, shape (n_frequencies, n_dofs, n).

        They are for angular frequencies w, rad/s, with the speed Ω at each of them.
        """
        m, jw = len(self._dofs), 1j * w
        dynamic = (np.stack([np.ones_like(jw), w**2, jw, jw * speed_rad_s], axis=1) @ self._terms).reshape(-1, 6, 6)
        # Unmeasured degrees of freedom carry no force and follow the others (Schur complement).
        stiffness = dynamic[:, :m, :m]
        if m < 6:
            stiffness = stiffness - dynamic[:, :m, m:] @ np.linalg.solve(dynamic[:, m:, m:], dynamic[:, m:, :m])
        rate = 1 / (1 + (self._corners_rad_s / w[:, None]) ** 2)
        motion = np.where(self._rates, rate / jw[:, None], 1 - rate)
        return np.asarray(stiffness[:, :, self._rows] * motion[:, None], dtype=np.complex128)

    def force(self, spectrum: npt.NDArray[np.complexfloating]) -> ComplexArray:
        """Cross-spectra of the equivalent forces, shape (n_windows, n_bins, n_dofs, n_dofs).

        `spectrum` holds those of the measured states, SI²/Hz, shape (n_windows, n_bins, n, n).
        """
        return np.asarray(self._force @ spectrum @ self._force.conj().swapaxes(1, 2), dtype=np.complex128)

    def series(self, force: npt.NDArray[np.complexfloating]) -> Float32Array:
        """Functions of frequency, shape (n_series, n_windows, n_bins), of the cross-spectra of the forces."""
        m = len(self._dofs)
        power = np.maximum(np.einsum("bfii->ibf", force).real, np.finfo(np.float32).tiny)
        out = np.empty((m + 2 * len(self._pairs), *force.shape[:2]), dtype=np.float32)
        out[:m] = np.log(power)
        out[:m] -= out[:m].mean(axis=(0, 2), keepdims=True)
        amplitude = np.sqrt(power)
        for k, (i, j) in enumerate(self._pairs):
            coherence = force[:, :, i, j] / (amplitude[i] * amplitude[j])
            out[m + 2 * k], out[m + 2 * k + 1] = coherence.real, coherence.imag
        if not self._near:
            return out
        level = out[:m].mean(axis=0, keepdims=True)
        return np.concatenate([level, out[:m] - level, out[m:], 2 * out[m::2] * out[m + 1 :: 2]])

    def coherence(self, series: Float32Array) -> float:
        """Mean squared coherence over all windows, frequencies and pairs of forces; 0 without a pair.

        `series` must be that of the nominal machine.
        """
        parts = series[len(self._dofs) :]
        return 2 * float(np.mean(parts**2)) if self._pairs else 0.0

    def consistency(self, spectrum: npt.NDArray[np.complexfloating], speed_rad_s: FloatArray) -> Float32Array:
        """Speed, and agreement of displacement and rate, shape (n_windows, n).

        For every degree of freedom measured twice, in eight bands: the logarithm of the ratio of the two powers, which
        shows a faulty sensor, and that of their incoherent part, which shows the sensor noise.
        """
        n_windows = spectrum.shape[0]
        speed = np.where(np.isfinite(speed_rad_s), speed_rad_s / self._machine.operation.speed_rad_s - 1, 0.0)
        parts = [speed[:, None]]
        w = 2 * np.pi * self.frequencies_hz
        if self._measured_twice:
            x, v = (list(side) for side in zip(*self._measured_twice, strict=True))
            powers = spectrum[:, :, x, x].real * w[:, None] ** 2, spectrum[:, :, v, v].real
            s_x, s_v = (np.add.reduceat(power, self._bands, axis=1) for power in powers)
            s_xv = np.add.reduceat(spectrum[:, :, x, v] * w[:, None], self._bands, axis=1)
            apart = np.maximum(1 - np.abs(s_xv) ** 2 / (s_x * s_v), _FLOOR)
            parts += [np.log(of).reshape(n_windows, -1) for of in (s_x / s_v, apart)]
        return np.asarray(np.concatenate(parts, axis=1).reshape(n_windows, -1), dtype=np.float32)

    def disagreement(self, consistency: Float32Array) -> dict[str, FloatArray]:
        """Relative difference in amplitude of displacement and rate, each of shape (n_windows,), by displacement.

        It is taken from `consistency` in the band in which they agree best: sensor noise makes them differ in some
        bands, a wrong gain in all of them.
        """
        n = len(self._measured_twice)
        ratio = consistency[:, 1 : 1 + _BANDS * n].reshape(-1, _BANDS, n)
        best = np.abs(np.expm1(ratio / 2)).min(axis=1)
        return {self.states[x]: best[:, k].astype(np.float64) for k, (x, _) in enumerate(self._measured_twice)}

    def unbalance(
        self,
        spectrum: npt.NDArray[np.complexfloating],
        synchronous: npt.NDArray[np.complexfloating],
        speed_rad_s: FloatArray,
    ) -> Float32Array:
        """Additional features for equation 29, shape (n_windows, 3 n_dofs).

        These are the rotation-synchronous vectors as forces, in units of the nominal unbalance force (real parts,
        imaginary parts), and the logarithm of their sampling variance due to the stochastic forces near 1x. `spectrum`
        is of shape (n_windows, n_bins, n, n), `synchronous` (n_windows, n), `speed_rad_s` (n_windows,).
        """
        machine = self._machine
        unbalance = machine.rotor.m2_kg * machine.rotor.e_m * speed_rad_s**2
        transfer = self._to_force(speed_rad_s, speed_rad_s)  # at each window's own speed
        force = (transfer @ synchronous[:, :, None])[:, :, 0]
        force = force * np.exp(-1j * machine.operation.unbalance_phase_rad) / unbalance[:, None]
        nearest = np.argmin(np.abs(self.frequencies_hz - speed_rad_s[:, None] / (2 * np.pi)), axis=1)
        nearest = np.clip(nearest, 6, self.frequencies_hz.size - 7)
        beside = np.concatenate([np.arange(-6, -2), np.arange(3, 7)])  # bins at 1x lack the synchronous part
        around = spectrum[np.arange(nearest.size)[:, None], nearest[:, None] + beside].mean(axis=1)
        power = np.einsum("bij,bjk,bik->bi", transfer, around, transfer.conj()).real
        error = np.log(np.maximum(power, np.finfo(np.float64).tiny) * 4 / self._duration_s / unbalance[:, None] ** 2)
        return np.asarray(np.concatenate([force.real, force.imag, error], axis=1), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class FeatureBasis:
    """Transformation of raw features to the inputs of the networks, float32."""

    mean: Float32Array  # (n_series, 1, n_bins)
    directions: Float32Array  # (n_series, n_bins, n_kept), principal components of every function of frequency
    # (n_inputs,): of all inputs over random machines and conditions; those for equation 29 alone come last
    centre: Float32Array
    scale: Float32Array
    # (n_common, n_common): factor F of the inverse covariance F Fᵀ of the common inputs
    precision_factor: Float32Array

    @property
    def n_common(self) -> int:
        """Number of inputs that all networks share."""
        return int(self.precision_factor.shape[0])

    def standardised(self, raw: Float32Array) -> Float32Array:
        """Inputs less their mean, in units of their standard deviation; `raw` may lack those for equation 29."""
        n = raw.shape[1]
        return np.asarray((raw - self.centre[:n]) / self.scale[:n], dtype=np.float32)

    def novelty(self, inputs: Float32Array) -> FloatArray:
        """Squared Mahalanobis distance from the training windows, per input, shape (n_windows,); usually about 1."""
        n = self.n_common
        return np.asarray(np.mean((inputs[:, :n] @ self.precision_factor) ** 2, axis=1), dtype=np.float64)


def condensed(series: Float32Array, mean: Float32Array, directions: Float32Array) -> Float32Array:
    """Principal-component scores of the functions of frequency, shape (n_windows, n_series · n_kept)."""
    scores = (series - mean) @ directions
    return np.asarray(scores.transpose(1, 0, 2).reshape(series.shape[1], -1), dtype=np.float32)


def principal_directions(series: Float32Array, n_kept: int) -> tuple[Float32Array, Float32Array]:
    """Mean, shape (n_series, 1, n_bins), and first principal components, shape (n_series, n_bins, n_kept).

    `series`, shape (n_series, n_windows, n_bins), must be from expected spectra, without sampling error.
    """
    mean = series.mean(axis=1, keepdims=True)
    deviation = (series - mean).astype(np.float64)
    vectors = np.linalg.eigh(deviation.swapaxes(1, 2) @ deviation)[1]  # ascending
    directions = vectors[:, :, ::-1][:, :, :n_kept]
    return mean, np.ascontiguousarray(directions, dtype=np.float32)


def fit_basis(mean: Float32Array, directions: Float32Array, raw: Float32Array, n_common: int) -> FeatureBasis:
    """Standardise condensed features and measure their covariance.

    `raw`, (n_windows, n_inputs), is of windows with sampling error; all networks share its first `n_common` columns.
    """
    centre = raw.mean(axis=0)
    scale = raw.std(axis=0) + np.float32(1e-6)
    common = ((raw - centre) / scale)[:, :n_common].astype(np.float64)
    values, vectors = np.linalg.eigh(common.T @ common / common.shape[0])
    # Some variance is added to directions that hardly vary in training; otherwise every real window would be novel.
    factor = vectors / np.sqrt(values + _LEAST_VARIANCE)
    return FeatureBasis(mean, directions, centre, scale, np.ascontiguousarray(factor, dtype=np.float32))
