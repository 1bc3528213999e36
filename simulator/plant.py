"""The plant: rotor states and shaft angle, continuous through every change, and with a cracked shaft or a rub.

The motion is split as ``x(t) = d(t) + s(θ)``. ``s`` is the steady response to the unbalance at the shaft angle θ, known
in closed form; the rest ``d`` obeys ``ḋ = A* d + B* w`` without unbalance, because s solves the forced equation. So the
unbalance enters without any discretisation error. At a change ``x`` carries over and ``d`` becomes ``x`` minus the new
``s``: the transient is in ``d``.

**Crack and rub** add a force f to the linear rotor, and the rest obeys
``ḋ = A* d + B* w + f(d + s, θ)``. With f = 0 this plant is the linear one, to rounding.

**Crack.** Across the open crack the shaft loses a part of its bending stiffness. The crack turns with the shaft, its
direction at the phase reference (angle θ from the y axis), and breathes under the weight: fully open where it points
up, to the tension side of an overhung shaft, closed below, ``½(1 + sin θ)`` between (the smooth law of I. W. Mayes and
W. G. R. Davies, ASME J. Vibration, Acoustics, Stress and Reliability in Design 106, 1984). The stiffness then has
harmonics up to three times the speed, and acts on the shaft's static sag too, which gives rise to 1x and 2x vibration.
Displacements count from where the uncracked machine rests. The system is linear and periodic. Its transition over one
sample is a product of matrix exponentials, with the stiffness at the middle of each of eight parts of the sample; it is
a smooth, periodic function of the angle at the start of the sample, so a few Fourier coefficients give it at any angle.
The process noise is that of the uncracked shaft: within one sample the crack hardly acts on that sample's noise.

**Rub.** Where the disc's radial displacement r exceeds the clearance c, the casing pushes back with k(r - c), and
sliding friction μk(r - c) acts against the sense of rotation; the surface speed is taken to be larger than that of any
whirl. Between contacts the exact discretisation holds. During a contact the force is sampled at eight parts of the
sample, and the trapezoidal rule for its convolution with the rotor's exact impulse response gives displacement and
velocity. The impulse response of a displacement is zero at lag zero, so this is explicit, of second order, and as
stable as the rotor itself for contacts up to a few times stiffer than the shaft.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from models.errors import EstimationError
from models.machine import Machine
from models.physics.excitation import expanded_A, expanded_B
from models.physics.response import advance, discretise, stationary_covariance, synchronous_response
from models.physics.rotor import STATE_INDEX, M_matrix, Q_matrix, Q_shaft, RotorParameters, changed
from models.signals.block import FloatArray
from simulator.timeline import Condition


@dataclass(frozen=True, slots=True)
class PlantSamples:
    """Consecutive samples of the plant."""

    # (n_samples, 12): displacements, tilts and their rates in the order of `models.physics.rotor.STATES`, SI
    states: FloatArray
    theta_rad: FloatArray  # (n_samples,), shaft angle in [0, 2π)


class Plant:
    """Rotor, coloured excitation and unbalance, advanced sample by sample with an exact discretisation.

    The first sample is a draw from the stationary distribution, at shaft angle 0. `machine` is the original machine,
    and `condition` holds from the first sample on. Nothing else uses `rng`: the realisation depends on its seed alone.
    """

    def __init__(self, machine: Machine, condition: Condition, rng: np.random.Generator) -> None:
        self._machine = machine
        self._rng = rng
        self._A = np.empty((0, 0))
        self._set_condition(condition)
        self._start_revolution = 0.0
        self._since_change = 0
        covariance = stationary_covariance(self._A, expanded_B(condition.sources))
        self._d = _draw(covariance * condition.excitation_level**2, rng)

    @property
    def theta_rad(self) -> float:
        """Shaft angle of the next sample, rad, in [0, 2π)."""
        return float(self._angles(1)[0])

    def change(self, condition: Condition) -> None:
        """Apply another condition from the next sample on; displacement, velocity and shaft angle carry over."""
        theta = self.theta_rad
        state = self._d.copy()
        state[:12] += self._synchronous(np.array([theta]))[0]
        if condition.speed_rpm != self._speed_rpm:
            self._start_revolution = theta / (2 * np.pi)
            self._since_change = 0
        self._set_condition(condition)
        state[:12] -= self._synchronous(np.array([theta]))[0]
        self._d = state

    def advance(self, n_samples: int) -> PlantSamples:
        """Return the next `n_samples` samples and move on."""
        theta = self._angles(n_samples)
        noise = self._noise(n_samples)
        after = advance(self._F, self._G, self._d, noise)
        states = self._synchronous(theta)
        states[0] += self._d[:12]
        states[1:] += after[:-1, :12]
        self._d = after[-1].copy()
        self._since_change += n_samples
        return PlantSamples(states, theta)

    def _noise(self, n_samples: int) -> FloatArray:
        """White noise of the next samples, at the level of the excitation; shape (n_samples, n)."""
        noise = self._rng.standard_normal((n_samples, self._d.size))
        # All noise of the discrete system comes from the white drives, so their level scales it exactly.
        return noise if self._level == 1 else noise * self._level

    def _set_condition(self, condition: Condition) -> None:
        self._level = condition.excitation_level
        rotor = rotor_in(self._machine, condition)
        speed_rad_s = condition.speed_rpm * 2 * np.pi / 60
        A = expanded_A(rotor, speed_rad_s, condition.sources)
        if not np.array_equal(A, self._A):  # a changed unbalance alone leaves the discretisation as it is
            self._A = A
            self._F, self._G = discretise(A, expanded_B(condition.sources), 1 / self._machine.rate_hz)
        self._q1, self._q2 = synchronous_response(rotor, speed_rad_s)
        self._speed_rpm = condition.speed_rpm
        self._revolutions_per_sample = condition.speed_rpm / 60 / self._machine.rate_hz

    def _angles(self, n_samples: int) -> FloatArray:
        # Computed from the count of samples since the last change of speed: rounding errors do not add up over days.
        count = self._since_change + np.arange(n_samples)
        turned = np.mod(self._start_revolution + self._revolutions_per_sample * count, 1.0)
        return np.asarray(2 * np.pi * turned, dtype=np.float64)

    def _synchronous(self, theta_rad: FloatArray) -> FloatArray:
        """Steady response to the unbalance at given shaft angles, shape (n, 12)."""
        angle = theta_rad[:, None] + self._machine.operation.unbalance_phase_rad
        return np.asarray(self._q1 * np.cos(angle) + self._q2 * np.sin(angle), dtype=np.float64)


def rotor_in(machine: Machine, condition: Condition) -> RotorParameters:
    """Return the rotor in a condition: changed parameters, and a deposit on the disc.

    The deposit lies evenly around the shaft: mass and moments of inertia of the disc grow by the same factor, and the
    unbalance m₂e stays the same.
    """
    rotor = changed(machine.rotor, condition.relative_changes)
    factor = 1 + condition.anomalies.get("added_mass", 0.0)
    if factor == 1:
        return rotor
    grown = {name: getattr(rotor, name) * factor for name in ("m2_kg", "I2_kg_m2", "I2p_kg_m2")}
    return rotor.model_copy(update={**grown, "e_m": rotor.e_m / factor})


def theoretical_moments(machine: Machine, condition: Condition) -> FloatArray:
    """Mean products of the twelve states in a condition, stochastic and synchronous together; SI, shape (12, 12).

    They are those of the linear rotor: a crack or a rub is left out.
    """
    rotor = rotor_in(machine, condition)
    speed_rad_s = condition.speed_rpm * 2 * np.pi / 60
    A, B = expanded_A(rotor, speed_rad_s, condition.sources), expanded_B(condition.sources)
    covariance = stationary_covariance(A, B)[:12, :12] * condition.excitation_level**2
    q1, q2 = synchronous_response(rotor, speed_rad_s)
    return np.asarray(covariance + (np.outer(q1, q1) + np.outer(q2, q2)) / 2, dtype=np.float64)


def _draw(covariance: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Draw from N(0, covariance); the states are scaled first, so that the factor keeps the small ones."""
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(deviation > 0, deviation, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    factor = vectors * np.sqrt(np.maximum(values, 0.0)) * scale[:, None]
    return np.asarray(factor @ rng.standard_normal(scale.size), dtype=np.float64)


NONLINEAR = frozenset({"crack", "rub"})  # anomalies that need this plant
_GRAVITY_M_PER_S2 = 9.81
_PARTS = 8  # parts of a sample in which the crack's stiffness is constant and the contact force is sampled
_NODES = 32
_HARMONICS = 10
_RUN_IN_S = 5.0
_PIECE_S = 0.5
_RUNAWAY = 1e3  # radius, in clearances, beyond which friction has made the motion unstable
_Y2, _Z2 = STATE_INDEX["y2"], STATE_INDEX["z2"]


def crack_stiffness(rotor: RotorParameters, theta_rad: FloatArray) -> FloatArray:
    """Stiffness that a crack of size 1 takes away, shape (n, 6, 6), N/m, N and N m; shaft angles have shape (n,).

    ``½(1 + sin θ) PᵀKP``, with K the shaft's stiffness in a plane, P = (I cos θ, J sin θ) the projection onto the
    crack's direction θ, and J the change of sign of the tilt between the planes.
    """
    plane = Q_shaft(rotor)[:3, :3]
    mirror = np.diag([1.0, 1.0, -1.0])
    cosine, sine = np.cos(theta_rad)[:, None, None], np.sin(theta_rad)[:, None, None]
    along = np.concatenate([cosine * np.eye(3), sine * mirror], axis=2)
    opening = (1 + np.sin(theta_rad)) / 2
    return np.asarray(opening[:, None, None] * (along.transpose(0, 2, 1) @ plane @ along), dtype=np.float64)


class NonlinearPlant(Plant):
    """Rotor with a crack or a rub; same interface and random numbers as the linear plant.

    If there is an anomaly at the first sample, the plant has run with it for five seconds before.

    Raises
    ------
    EstimationError
        If a crack or a rub makes the rotor unstable; also raised by `change` and `advance`.
    """

    def __init__(self, machine: Machine, condition: Condition, rng: np.random.Generator) -> None:
        super().__init__(machine, condition, rng)
        if NONLINEAR & set(condition.anomalies):
            pieces, piece = round(_RUN_IN_S / _PIECE_S), round(_PIECE_S * machine.rate_hz)
            self._start_revolution = -pieces * piece * self._revolutions_per_sample
            for _ in range(pieces):
                self.advance(piece)
            self._start_revolution, self._since_change = 0.0, 0

    def advance(self, n_samples: int) -> PlantSamples:
        """Return the next `n_samples` samples and move on; EstimationError if friction makes the disc unstable."""
        if self._crack is None and self._contact is None:
            return super().advance(n_samples)
        theta = self._angles(n_samples)
        driven = self._noise(n_samples) @ self._G.T
        transitions = np.broadcast_to(self._F, (n_samples, *self._F.shape))
        if self._crack is not None:
            both = (_harmonics(theta) @ self._crack).reshape(n_samples, self._d.size, -1)
            transitions = np.ascontiguousarray(both[:, :, :-1])
            driven += both[:, :, -1]
        steady = self._synchronous(theta)
        rest = np.empty((n_samples + 1, self._d.size))
        rest[0] = self._d
        if self._contact is None:
            for k in range(n_samples):
                np.dot(transitions[k], rest[k], out=rest[k + 1])
                rest[k + 1] += driven[k]
        else:
            turn = 2 * np.pi * self._revolutions_per_sample
            parts = (theta[:, None] + turn * np.arange(_PARTS + 1) / _PARTS).ravel()
            disc = self._synchronous(parts)[:, (_Y2, _Z2)].reshape(n_samples, _PARTS + 1, 2)
            self._contact.follow(rest, transitions, driven, disc)
        self._d = rest[-1].copy()
        self._since_change += n_samples
        return PlantSamples(steady + rest[:-1, :12], theta)

    def _set_condition(self, condition: Condition) -> None:
        super()._set_condition(condition)
        rotor = rotor_in(self._machine, condition)
        depth, stiffness = condition.anomalies.get("crack", 0.0), condition.anomalies.get("rub", 0.0)
        self._crack = self._periodic(rotor, depth, condition) if depth else None
        self._contact: _Contact | None = None
        if stiffness and condition.rub is not None:
            rub, shaft_N_per_m = condition.rub, 3 * rotor.EI_N_m2 / rotor.shaft_length_m**3
            contact_N_per_m, step_s = stiffness * shaft_N_per_m, 1 / self._machine.rate_hz
            self._contact = _Contact(self._A, rotor.m2_kg, contact_N_per_m, rub.clearance_m, rub.friction, step_s)

    def _periodic(self, rotor: RotorParameters, depth: float, condition: Condition) -> FloatArray:
        """Fourier coefficients over θ of (F, g) in d ← F d + g, one sample; shape (2 · harmonics + 1, n · (n + 1))."""
        n, step_s = len(self._A), 1 / self._machine.rate_hz
        speed_rad_s = 2 * np.pi * self._revolutions_per_sample / step_s
        theta = 2 * np.pi * np.arange(_NODES) / _NODES
        weight = np.zeros(6)
        weight[3], weight[4] = -rotor.m1_kg * _GRAVITY_M_PER_S2, -rotor.m2_kg * _GRAVITY_M_PER_S2
        bent = np.column_stack([self._q1[:6], self._q2[:6], np.linalg.solve(Q_matrix(rotor), weight)])
        # Three more states, (cos, sin, 1) of the heavy spot's angle, carry the crack's force on s and the static sag.
        deviation = np.sqrt(np.diag(stationary_covariance(self._A, expanded_B(condition.sources))))
        scale = np.concatenate([np.where(deviation > 0, deviation, 1.0), np.ones(3)])
        product = np.broadcast_to(np.eye(n + 3), (_NODES, n + 3, n + 3))
        for part in range(_PARTS):
            middle = theta + speed_rad_s * step_s * (part + 0.5) / _PARTS
            push = depth / np.diag(M_matrix(rotor))[:, None] * crack_stiffness(rotor, middle)
            system = np.zeros((_NODES, n + 3, n + 3))
            system[:, :n, :n] = self._A
            system[:, 6:12, :6] += push
            system[:, 6:12, n:] = push @ bent
            system[:, n, n + 1], system[:, n + 1, n] = -speed_rad_s, speed_rad_s
            product = scipy.linalg.expm(system * (scale / scale[:, None]) * (step_s / _PARTS)) @ product
        product = product * (scale[:, None] / scale)
        heavy = theta + self._machine.operation.unbalance_phase_rad
        phase = np.column_stack([np.cos(heavy), np.sin(heavy), np.ones(_NODES)])
        nodes = np.concatenate([product[:, :n, :n], product[:, :n, n:] @ phase[:, :, None]], axis=2)
        spectrum = np.fft.rfft(nodes.reshape(_NODES, -1), axis=0)[: _HARMONICS + 1] * (2 / _NODES)
        coefficients = np.concatenate([spectrum.real, -spectrum.imag[1:]])
        coefficients[0] /= 2
        self._refuse_unstable(coefficients, depth)
        return np.asarray(coefficients, dtype=np.float64)

    def _refuse_unstable(self, coefficients: FloatArray, depth: float) -> None:
        """Floquet: no solution may grow over one turn."""
        n = len(self._A)
        steps = max(1, round(1 / self._revolutions_per_sample))
        transitions = (_harmonics(2 * np.pi * np.arange(steps) / steps) @ coefficients).reshape(steps, n, n + 1)
        turn = np.eye(n)
        for transition in transitions[:, :, :n]:
            turn = transition @ turn
        largest = float(np.max(np.abs(np.linalg.eigvals(turn))))
        if largest >= 1:
            raise EstimationError(
                f"machine {self._machine.name}: a crack of {depth:g} is unstable, the motion grows by a factor of "
                f"{largest:.4g} a turn at {self._speed_rpm:g} rpm, expected below 1"
            )


class _Contact:
    """Contact of the disc with the casing: force law, and effect of the force within one sample."""

    def __init__(
        self, A: FloatArray, m2_kg: float, k_N_per_m: float, clearance_m: float, friction: float, step_s: float
    ) -> None:
        self._k, self._clearance, self._friction = k_N_per_m, clearance_m, friction
        part = scipy.linalg.expm(A * (step_s / _PARTS))
        self._free = np.empty((_PARTS + 1, 2, len(A)))
        push = np.zeros((len(A), 2))
        push[_Y2 + 6, 0] = push[_Z2 + 6, 1] = step_s / _PARTS / m2_kg
        pushed = np.empty((_PARTS + 1, len(A), 2))
        power = np.eye(len(A))
        for j in range(_PARTS + 1):
            self._free[j] = power[[_Y2, _Z2]]
            pushed[j] = power @ push
            power = part @ power
        self._kernel = [tuple(map(float, pushed[j][[_Y2, _Z2]].ravel())) for j in range(_PARTS + 1)]
        ends = np.ones(_PARTS + 1)
        ends[0] = ends[-1] = 0.5  # trapezoidal rule
        self._ends = ends.tolist()
        self._final = np.concatenate([pushed[_PARTS - i] for i in range(_PARTS + 1)], axis=1)

    def follow(self, rest: FloatArray, transitions: FloatArray, driven: FloatArray, disc: FloatArray) -> None:
        """Fill `rest` after its first row; `disc` is the steady (y2, z2) at all parts, (n_samples, parts + 1, 2)."""
        limit, runaway = self._clearance**2, (self._clearance * _RUNAWAY) ** 2
        begin, end = disc[:, 0].tolist(), disc[:, -1].tolist()
        touching = (rest[0, _Y2] + begin[0][0]) ** 2 + (rest[0, _Z2] + begin[0][1]) ** 2 > limit
        for k in range(len(driven)):
            after = rest[k + 1]
            np.dot(transitions[k], rest[k], out=after)
            after += driven[k]
            y, z = end[k]
            radius2 = (after[_Y2] + y) ** 2 + (after[_Z2] + z) ** 2
            if touching or radius2 > limit:
                after += self._final @ self._forces(rest[k], disc[k])
                radius2 = (after[_Y2] + y) ** 2 + (after[_Z2] + z) ** 2
                if not radius2 < runaway:
                    raise EstimationError(
                        f"the rub is unstable: the disc is {np.sqrt(radius2):.3g} m from its place, "
                        f"expected below {self._clearance * _RUNAWAY:.3g} m"
                    )
            touching = radius2 > limit

    def _forces(self, rest: FloatArray, disc: FloatArray) -> FloatArray:
        """Contact force at the parts of one sample, weighted for the trapezoidal rule; shape (2 (parts + 1),)."""
        free = (self._free @ rest + disc).tolist()
        forces: list[tuple[float, float]] = []
        for j, (free_y, free_z) in enumerate(free):
            y, z = free_y, free_z
            for i, (force_y, force_z) in enumerate(forces):
                if force_y or force_z:
                    yy, yz, zy, zz = self._kernel[j - i]
                    y += yy * force_y + yz * force_z
                    z += zy * force_y + zz * force_z
            radius = (y * y + z * z) ** 0.5
            if radius <= self._clearance:
                forces.append((0.0, 0.0))
                continue
            push = self._k * (1 - self._clearance / radius) * self._ends[j]
            forces.append((-push * (y - self._friction * z), -push * (z + self._friction * y)))
        return np.array(forces).ravel()


def _harmonics(theta_rad: FloatArray) -> FloatArray:
    """(1, cos θ, …, cos mθ, sin θ, …, sin mθ), shape (n, 2 · harmonics + 1)."""
    angles = theta_rad[:, None] * np.arange(1, _HARMONICS + 1)
    return np.column_stack([np.ones(theta_rad.size), np.cos(angles), np.sin(angles)])
