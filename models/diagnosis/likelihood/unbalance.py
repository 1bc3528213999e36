"""Unbalance from the rotation-synchronous vector: generalised least squares, as a number and as a vector.

While the heavy spot keeps its angle, the unbalance is read as a real number times the nominal one. Once the heavy spot
has turned, that number would be the projection on the old direction: half a turn would read as -200 %. The complex
ratio is read then: the size of the unbalance or, if most of the change is the turn, the size of the vector by which it
changed. Once the shaft angle itself has jumped, directions mean nothing, and only the size is read.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from models.diagnosis.likelihood.motions import BinGroups
from models.diagnosis.likelihood.spectral_model import STRUCTURAL, Expected, SpectralModel
from models.diagnosis.readings import UnbalanceVector, foreign_rotation
from models.errors import EstimationError
from models.machine import Machine
from models.signals.block import ComplexArray, FloatArray

# Probability that vectors of one unbalance contradict each other by chance, and the least relative error tried if so.
_CHANCE, _LEAST_ERROR = 1e-3, 1e-3
_HALVINGS = 12


@dataclass(frozen=True, slots=True)
class Unbalance:
    """Relative change of e in one window."""

    change: float
    variance: float
    covariance: FloatArray  # (5,), with the logarithmic ratios of the structural parameters
    vector: UnbalanceVector
    weights: ComplexArray  # see `UnbalanceRatios`


@dataclass(frozen=True, slots=True)
class UnbalanceRatios:
    """The unbalance over the nominal one: as a real number at the nominal phase, and as a complex number."""

    # (3,): the real number; real and imaginary part of the complex one
    values: FloatArray
    variances: FloatArray
    between: float  # covariance of the two parts
    covariance: FloatArray  # (3, 5), of the three with the logarithmic ratios of the structural parameters
    foreign: str  # see `UnbalanceVector`
    # (n_states,): weights @ vector gives the real and imaginary part; empty for several vectors
    weights: ComplexArray
    explained: float  # how much of the vector the unbalance explains, in squared standard errors

    def decided(self, *, directed: bool = True) -> Unbalance:
        """Choose the description that holds, see this module; the size alone unless vectors are `directed`."""
        known, real, imaginary = self.values.tolist()
        variances = float(self.variances[1]), self.between, float(self.variances[2])
        vector = UnbalanceVector(real, imaginary, *variances, self.foreign, directed)
        if directed and not vector.turned and known > 0:
            return Unbalance(known - 1, float(self.variances[0]), self.covariance[0], vector, self.weights)
        if vector.moved:
            along = np.array([real - 1, imaginary]) / vector.change
            return Unbalance(vector.change, vector.change_error**2, along @ self.covariance[1:], vector, self.weights)
        size = math.hypot(real, imaginary)
        along = np.array([real, imaginary]) / size
        return Unbalance(size - 1, vector.magnitude_error**2, along @ self.covariance[1:], vector, self.weights)


def estimate_unbalance(
    machine: Machine,
    model: SpectralModel,
    point: Expected,
    covariance: FloatArray,
    synchronous: ComplexArray,
    speed_rad_s: float,
    duration_s: float,
    *,
    sized: bool = False,
    backward: bool = False,
) -> UnbalanceRatios:
    """Estimate e from q of x_n = Re{q e^{jθ}}; `UnbalanceRatios.decided` turns it into one reading.

    The vector's covariance is the stochastic part's spectrum divided by the window length, averaged around Ω under the
    kernel of a window of that length, plus the effect of the structural parameters' errors on the predicted response.

    `covariance`, shape (5, 5), is that of the logarithmic ratios of the structural parameters at the estimate, `point`;
    `synchronous`, shape (n_states,), is q, SI. If `sized`, the zero of its angle is unknown, so that only its size
    counts: it is turned to the heavy spot. If `backward`, the shaft turns from z to y although the speed is positive
    (one found in the vibration always is). Raises EstimationError if the vector does not determine e.
    """
    rotor = machine.rotor
    w = np.array([speed_rad_s])
    phase = np.exp(1j * machine.operation.unbalance_phase_rad)
    force = rotor.m2_kg * rotor.e_m * speed_rad_s**2 * phase * np.array([0, 1, 0, 0, 1j if backward else -1j, 0])

    structural = point.theta[: len(STRUCTURAL)]
    H = model.receptance(structural, speed_rad_s, w)[0]
    moved = H @ force
    slopes = -(model.dynamic_changes(structural, speed_rad_s) @ moved) @ H.T  # ∂H = -H ∂D H
    g, *slopes = model.measured(np.vstack([moved, slopes]).T[np.newaxis], w)[0].T
    noise = 4 * around_rotation(model, point, speed_rad_s, duration_s) / duration_s
    combined = model.motions.combine(w)
    q = (combined @ synchronous)[0]
    weighted = np.linalg.solve(noise, g)
    total_weight = float(np.real(np.vdot(weighted, g)))
    ratio = complex(np.vdot(weighted, q)) / total_weight
    if sized and ratio:
        q, ratio = q * (abs(ratio) / ratio), complex(abs(ratio))
    # Real representation: the structural uncertainty moves real and imaginary parts together.
    own = np.block([[noise.real, -noise.imag], [noise.imag, noise.real]]) / 2
    q2, g2 = parts(q), parts(g)
    both = np.stack([g2, parts(1j * g)], axis=1)
    values, variances, with_structural = np.empty(3), np.empty(3), np.empty((3, len(STRUCTURAL)))
    J = parts(np.stack(slopes) * ratio).T
    apart = _contradiction(q2, both, own + J @ covariance @ J.T, np.maximum(np.abs(q), np.abs(g)))
    for design, at, expected in ((g2[:, None], [0], ratio.real), (both, [1, 2], ratio)):
        J = parts(np.stack(slopes) * expected).T
        total = own + J @ covariance @ J.T + apart
        weight = np.linalg.solve(total, design).T
        precision = weight @ design
        if not precision[0, 0] > 0:
            raise EstimationError(f"{machine.name}: the spectrum at the speed of rotation is not determined")
        spread = np.linalg.inv(precision)
        values[at] = spread @ (weight @ q2)
        variances[at] = np.diag(spread)
        with_structural[at] = -spread @ (weight @ J) @ covariance
    foreign = foreign_rotation(q2, design @ values[1:], total - apart)
    if foreign:
        foreign = f"{machine.name}: the 1× vibration is not what an unbalance causes on this rotor: {foreign}"
    weights = np.asarray(weighted.conj() @ combined[0] / total_weight, dtype=np.complex128)
    explained = abs(ratio) ** 2 * total_weight
    return UnbalanceRatios(values, variances, float(spread[0, 1]), with_structural, foreign, weights, explained)


def parts(vectors: ComplexArray) -> FloatArray:
    """Real parts, then imaginary parts."""
    return np.concatenate([vectors.real, vectors.imag], axis=-1)


def _contradiction(observed: FloatArray, design: FloatArray, spread: FloatArray, size: FloatArray) -> FloatArray:
    """Covariance of the least relative error that makes all vectors agree with one unbalance; zero mostly.

    Run-out and slightly wrong gains are not random. Weights for random errors alone, which are large and of either sign
    where a single force moves the machine, would amplify them many times (R. C. Paule and J. Mandel, Journal of
    Research of the National Bureau of Standards 87 (1982)).

    `observed`, shape (2n,), holds the real parts of the vectors, then the imaginary ones, and `spread` their random
    covariance; `design`, shape (2n, 2), the same of the nominal unbalance and of it turned by 90°; the error is
    relative to `size`, shape (n,).
    """
    relative = np.diag(np.tile(size**2 / 2, 2))

    def chi2(variance: float) -> float:
        weighted = np.linalg.solve(spread + variance * relative, np.column_stack([observed, design]))
        to_fit = design.T @ weighted
        return float(observed @ weighted[:, 0] - to_fit[:, 0] @ np.linalg.solve(to_fit[:, 1:], to_fit[:, 0]))

    most, low, high = float(chdtri(max(1, observed.size - 2), _CHANCE)), _LEAST_ERROR**2, 1.0
    if observed.size <= design.shape[1] or chi2(0.0) <= most:
        return 0 * relative
    for _ in range(_HALVINGS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if chi2(middle) > most else (low, middle)
    return high * relative


def estimate_unbalance_by_hop(
    machine: Machine,
    model: SpectralModel,
    point: Expected,
    covariance: FloatArray,
    hop_synchronous: ComplexArray,
    hop_speed_rad_s: FloatArray,
    hop_s: float,
    *,
    directed: bool = True,
    sized: bool = False,
) -> Unbalance:
    """Estimate e where the speed varies: every hop at its own speed, with its own vector.

    The hops' own errors are independent; the error of the structural parameters is common to all. If `sized`, the zero
    of each hop's angle is unknown, and so is the sense of rotation: the one that explains more of the vectors is taken.
    Raises as `estimate_unbalance`.
    """
    known = machine, model, point, covariance
    ways = [
        [
            estimate_unbalance(*known, vectors, float(speed), hop_s, sized=sized, backward=backward)
            for vectors, speed in zip(hop_synchronous, hop_speed_rad_s, strict=True)
        ]
        for backward in ((False, True) if sized else (False,))
    ]
    hops = max(ways, key=lambda way: sum(one.explained for one in way))
    precision = np.linalg.inv(covariance)
    shared = np.array([hop.covariance for hop in hops])
    common = np.einsum("hai,ij,hbj->hab", shared, precision, shared)
    own = np.array([hop.variances for hop in hops]) - np.einsum("haa->ha", common)
    weight = 1 / np.maximum(own, np.finfo(float).tiny)
    weight[:, 1:] = weight[:, 1:].sum(axis=1, keepdims=True)  # the same for both parts of a vector
    weight /= weight.sum(axis=0)
    together = np.einsum("ha,hai->ai", weight, shared)
    left = together @ precision @ together.T
    between = np.array([hop.between for hop in hops]) - common[:, 1, 2]
    return UnbalanceRatios(
        np.einsum("ha,ha->a", weight, np.array([hop.values for hop in hops])),
        np.einsum("ha,ha->a", weight**2, own) + np.diag(left),
        float(weight[:, 1] ** 2 @ between + left[1, 2]),
        together,
        next((hop.foreign for hop in hops if hop.foreign), ""),
        np.empty(0, dtype=np.complex128),
        sum(hop.explained for hop in hops),
    ).decided(directed=directed and not sized)


def around_rotation(model: SpectralModel, point: Expected, speed_rad_s: float, duration_s: float) -> ComplexArray:
    """Stochastic cross-spectrum under the kernel of a rectangular window of this length, centred on Ω, shape (n, n).

    At the frequencies Ω ± (k + ½)/T the kernel has the weights 1/(π(k + ½))². Its tails are long: with one source, the
    leakage from a resonance exceeds the sensor noise. Beyond the excluded neighbourhood the mean kernel
    1/(2π²T (f - Ω)²) is applied to the groups' own spectra.
    """
    groups = model.groups
    centre_hz = speed_rad_s / (2 * np.pi)
    distance_hz = np.abs(groups.centre_hz - centre_hz)
    spacing_hz = 1 / model.machine.window.segment_s
    edge_hz = max(float(np.min(distance_hz - groups.bins * spacing_hz / 2)), spacing_hz)
    k = np.arange(max(1, round(edge_hz * duration_s))) + 0.5
    weights = np.tile((np.pi * k) ** -2.0, 2)
    nodes_hz = np.abs(np.concatenate([centre_hz - k / duration_s, centre_hz + k / duration_s]))
    near = BinGroups(((0, 1),), np.ones(1), np.array([centre_hz]), nodes_hz[np.newaxis], weights[np.newaxis], np.eye(1))
    far = groups.bins * spacing_hz / (2 * np.pi**2 * duration_s * np.maximum(distance_hz, edge_hz) ** 2)
    seen = model.seen_in(near).at(point.theta, speed_rad_s).S[0] + np.tensordot(far, point.S, axes=1)
    return np.asarray(seen, dtype=np.complex128)
