"""The plant: rotor states and shaft angle, continuous through every change.

The motion is split as ``x(t) = d(t) + s(θ)``. ``s`` is the steady response to the unbalance at the shaft angle θ, known
in closed form; the rest ``d`` obeys ``ḋ = A* d + B* w`` without unbalance, because s solves the forced equation. So the
unbalance enters without any discretisation error. At a change ``x`` carries over and ``d`` is what remains of it beside
the new ``s``: the transient is in ``d``.
"""

from dataclasses import dataclass

import numpy as np

from models.machine import Machine
from models.physics.discretise import DiscreteSystem, advance, discretise
from models.physics.excitation import expanded_A, expanded_B
from models.physics.lyapunov import stationary_covariance, synchronous_response
from models.physics.parameters import RotorParameters, changed
from models.signals.block import FloatArray
from simulator.timeline import Condition

__all__ = ["Plant", "PlantSamples", "rotor_in", "theoretical_rms"]


@dataclass(frozen=True, slots=True)
class PlantSamples:
    """Consecutive samples of the plant.

    Attributes
    ----------
    states : ndarray, shape (n_samples, 12)
        Displacements, tilts and their rates in the order of `models.physics.matrices.STATES`, SI.
    theta_rad : ndarray, shape (n_samples,)
        Shaft angle in [0, 2π).
    """

    states: FloatArray
    theta_rad: FloatArray


class Plant:
    """Rotor, coloured excitation and unbalance, advanced sample by sample with an exact discretisation.

    The first sample is a draw from the stationary distribution, at shaft angle 0.

    Parameters
    ----------
    machine : Machine
        The original machine, its rate, and the angle of the heavy spot from the phase reference.
    condition : Condition
        What holds from the first sample on.
    rng : numpy.random.Generator
        Used by nothing else, so that the realisation depends on the seed alone.
    """

    def __init__(self, machine: Machine, condition: Condition, rng: np.random.Generator) -> None:
        self._machine = machine
        self._rng = rng
        self._n_sources = len(condition.sources)
        self._A = np.empty((0, 0))
        self._set(condition)
        self._start_revolution = 0.0
        self._since_change = 0
        covariance = stationary_covariance(self._A, expanded_B(condition.sources))
        self._d = _draw(covariance * condition.excitation_level**2, rng)

    @property
    def theta_rad(self) -> float:
        """Shaft angle of the next sample, rad, in [0, 2π)."""
        return float(self._angles(1)[0])

    def change(self, condition: Condition) -> None:
        """Let another condition hold from the next sample on; displacement, velocity and shaft angle carry over.

        Raises
        ------
        ValueError
            If the number of sources changes: the state would not fit.
        """
        if len(condition.sources) != self._n_sources:
            raise ValueError(f"{len(condition.sources)} sources instead of {self._n_sources}: the state would not fit")
        theta = self.theta_rad
        state = self._d.copy()
        state[:12] += self._synchronous(np.array([theta]))[0]
        if condition.speed_rpm != self._speed_rpm:
            self._start_revolution = theta / (2 * np.pi)
            self._since_change = 0
        self._set(condition)
        state[:12] -= self._synchronous(np.array([theta]))[0]
        self._d = state

    def advance(self, n_samples: int) -> PlantSamples:
        """Return the next `n_samples` samples and move on behind them."""
        theta = self._angles(n_samples)
        noise = self._noise(n_samples)
        after = advance(self._system, self._d, noise)
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

    def _set(self, condition: Condition) -> None:
        self._level = condition.excitation_level
        rotor = rotor_in(self._machine, condition)
        speed_rad_s = condition.speed_rpm * 2 * np.pi / 60
        A = expanded_A(rotor, speed_rad_s, condition.sources)
        if not np.array_equal(A, self._A):  # a changed unbalance alone leaves the discretisation as it is
            self._A = A
            self._system: DiscreteSystem = discretise(A, expanded_B(condition.sources), 1 / self._machine.rate_hz)
        self._q1, self._q2 = synchronous_response(rotor, speed_rad_s)
        self._speed_rpm = condition.speed_rpm
        self._revolutions_per_sample = condition.speed_rpm / 60 / self._machine.rate_hz

    def _angles(self, n_samples: int) -> FloatArray:
        # Counted from the last change of speed, never summed up: the error stays at rounding level over days.
        count = self._since_change + np.arange(n_samples)
        turned = np.mod(self._start_revolution + self._revolutions_per_sample * count, 1.0)
        return np.asarray(2 * np.pi * turned, dtype=np.float64)

    def _synchronous(self, theta_rad: FloatArray) -> FloatArray:
        """Steady response to the unbalance at given shaft angles, shape (n, 12)."""
        angle = theta_rad[:, None] + self._machine.operation.unbalance_phase_rad
        return np.asarray(self._q1 * np.cos(angle) + self._q2 * np.sin(angle), dtype=np.float64)


def rotor_in(machine: Machine, condition: Condition) -> RotorParameters:
    """Return the rotor in a condition: changed parameters, and a deposit on the disc.

    The deposit lies evenly around the shaft: masses and moments of inertia of the disc grow by the same part, and the
    unbalance m₂e stays what it is.
    """
    rotor = changed(machine.rotor, condition.relative_changes)
    factor = 1 + condition.anomalies.get("added_mass", 0.0)
    if factor == 1:
        return rotor
    return rotor.model_copy(
        update={
            "m2_kg": rotor.m2_kg * factor,
            "I2_kg_m2": rotor.I2_kg_m2 * factor,
            "I2p_kg_m2": rotor.I2p_kg_m2 * factor,
            "e_m": rotor.e_m / factor,
        }
    )


def theoretical_rms(machine: Machine, condition: Condition) -> FloatArray:
    """Root mean square of each of the twelve states in a condition, stochastic and synchronous together; SI.

    Of the linear rotor: a crack or a rub is left out.
    """
    rotor = rotor_in(machine, condition)
    speed_rad_s = condition.speed_rpm * 2 * np.pi / 60
    A, B = expanded_A(rotor, speed_rad_s, condition.sources), expanded_B(condition.sources)
    variance = np.diag(stationary_covariance(A, B))[:12] * condition.excitation_level**2
    q1, q2 = synchronous_response(rotor, speed_rad_s)
    return np.asarray(np.sqrt(variance + (q1**2 + q2**2) / 2), dtype=np.float64)


def _draw(covariance: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Draw from N(0, covariance); the states are scaled first, or the factor loses the small ones."""
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(deviation > 0, deviation, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    factor = vectors * np.sqrt(np.maximum(values, 0.0)) * scale[:, None]
    return np.asarray(factor @ rng.standard_normal(scale.size), dtype=np.float64)
