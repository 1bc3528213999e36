"""Unbalance from the rotation-synchronous vector: generalised least squares with known phase."""

from dataclasses import dataclass

import numpy as np

from models.diagnosis.likelihood.bins import BinGroups
from models.diagnosis.likelihood.spectral_model import STRUCTURAL, ModelPoint, SpectralModel
from models.diagnosis.moments import ComplexArray
from models.errors import EstimationError
from models.machine import Machine
from models.signals.block import FloatArray

__all__ = ["Unbalance", "estimate_unbalance", "estimate_unbalance_by_hop"]


@dataclass(frozen=True, slots=True)
class Unbalance:
    """Relative change of e in one window.

    Attributes
    ----------
    change, variance : float
    covariance : ndarray, shape (5,)
        With the logarithmic ratios of the structural parameters.
    """

    change: float
    variance: float
    covariance: FloatArray


def estimate_unbalance(
    machine: Machine,
    model: SpectralModel,
    point: ModelPoint,
    covariance: FloatArray,
    synchronous: ComplexArray,
    speed_rad_s: float,
    duration_s: float,
) -> Unbalance:
    """Estimate e from q of x_n = Re{q e^{jθ}}.

    The vector's covariance is the stochastic part's spectrum over the window length, averaged around Ω as a window of
    that length sees it, plus what the uncertainty of the structural parameters makes of the predicted response.

    Parameters
    ----------
    machine : Machine
    model : SpectralModel
    point : ModelPoint
        The model's spectra at the estimate.
    covariance : ndarray, shape (5, 5)
        Of the logarithmic ratios of the structural parameters.
    synchronous : ndarray of complex, shape (n_states,)
        q, SI.
    speed_rad_s, duration_s : float

    Raises
    ------
    EstimationError
        If the vector says nothing about e.
    """
    rotor = machine.rotor
    w = np.array([speed_rad_s])
    phase = np.exp(1j * machine.operation.unbalance_phase_rad)
    force = rotor.m2_kg * rotor.e_m * speed_rad_s**2 * phase * np.array([0, 1, 0, 0, -1j, 0])

    def response(ratios: FloatArray) -> ComplexArray:
        vectors = model.measured(model.receptance(ratios, speed_rad_s, w) @ force[:, None], w)
        return np.asarray(vectors[0, :, 0], dtype=np.complex128)

    structural = point.theta[: len(STRUCTURAL)]
    g = response(structural)
    step = 1e-5
    slopes = np.stack(
        [response(structural + step * unit) - response(structural - step * unit) for unit in np.eye(len(STRUCTURAL))]
    ) / (2 * step)
    noise = 4 * _around_rotation(machine, model, point, speed_rad_s, duration_s) / duration_s
    q = (model.motions.combine(w) @ synchronous)[0]
    e_ratio = float(np.real(np.vdot(g, np.linalg.solve(noise, q))) / np.real(np.vdot(g, np.linalg.solve(noise, g))))
    # Real representation: the structural uncertainty moves real and imaginary parts together.
    total = np.block([[noise.real, -noise.imag], [noise.imag, noise.real]]) / 2
    J = np.concatenate([slopes.real, slopes.imag], axis=1).T * e_ratio
    total = total + J @ covariance @ J.T
    g2, q2 = np.concatenate([g.real, g.imag]), np.concatenate([q.real, q.imag])
    weight = np.linalg.solve(total, g2)
    precision = float(weight @ g2)
    if not precision > 0:
        raise EstimationError(f"{machine.name}: the spectrum at the speed of rotation is not determined")
    return Unbalance(float(weight @ q2) / precision - 1, 1 / precision, -(weight @ J) / precision @ covariance)


def estimate_unbalance_by_hop(
    machine: Machine,
    model: SpectralModel,
    point: ModelPoint,
    covariance: FloatArray,
    hop_synchronous: ComplexArray,
    hop_speed_rad_s: FloatArray,
    hop_s: float,
) -> Unbalance:
    """Estimate e where the speed varies: every hop at its own speed, with its own vector.

    The hops' own errors are independent; that of the structural parameters is one for all.

    Parameters
    ----------
    machine, model, point, covariance
        As for `estimate_unbalance`.
    hop_synchronous : ndarray of complex, shape (n_hops, n_states)
    hop_speed_rad_s : ndarray, shape (n_hops,)
    hop_s : float
        Length of a hop, s.

    Raises
    ------
    EstimationError
        If a vector says nothing about e.
    """
    hops = [
        estimate_unbalance(machine, model, point, covariance, vectors, float(speed), hop_s)
        for vectors, speed in zip(hop_synchronous, hop_speed_rad_s, strict=True)
    ]
    precision = np.linalg.inv(covariance)
    shared = np.array([hop.covariance for hop in hops])
    own = np.array([hop.variance for hop in hops]) - np.einsum("hi,ij,hj->h", shared, precision, shared)
    weight = 1 / np.maximum(own, np.finfo(float).tiny)
    weight /= weight.sum()
    together = weight @ shared
    return Unbalance(
        float(weight @ np.array([hop.change for hop in hops])),
        float(weight**2 @ own + together @ precision @ together),
        together,
    )


def _around_rotation(
    machine: Machine, model: SpectralModel, point: ModelPoint, speed_rad_s: float, duration_s: float
) -> ComplexArray:
    """Stochastic cross-spectrum under the kernel of a plain window of the given length, centred on Ω, shape (n, n).

    On the frequencies Ω ± (k + ½)/T the kernel has the weights 1/(π(k + ½))². Its tails are long: with one source, what
    they let in from a resonance is more than the sensor noise. Beyond the excluded neighbourhood the mean kernel
    1/(2π²T (f - Ω)²) is applied to the groups' own spectra.
    """
    groups = model.groups
    centre_hz = speed_rad_s / (2 * np.pi)
    distance_hz = np.abs(groups.centre_hz - centre_hz)
    spacing_hz = 1 / machine.window.segment_s
    edge_hz = max(float(np.min(distance_hz - groups.bins * spacing_hz / 2)), spacing_hz)
    k = np.arange(max(1, round(edge_hz * duration_s))) + 0.5
    weights = np.tile((np.pi * k) ** -2.0, 2)
    nodes_hz = np.abs(np.concatenate([centre_hz - k / duration_s, centre_hz + k / duration_s]))
    near = BinGroups(((0, 1),), np.ones(1), np.array([centre_hz]), nodes_hz[np.newaxis], weights[np.newaxis], np.eye(1))
    force_scale = float(model.force_unit[0])
    at_speed = SpectralModel(machine, model.motions, near, force_scale, model.shapes)
    far = groups.bins * spacing_hz / (2 * np.pi**2 * duration_s * np.maximum(distance_hz, edge_hz) ** 2)
    seen = at_speed.at(point.theta, speed_rad_s).S[0] + np.tensordot(far, point.S, axes=1)
    return np.asarray(seen, dtype=np.complex128)
