"""Simulates the motion of a finite-element rotor, sample by sample.

The force is linear between samples. For such a force the linear rotor is advanced exactly, mode by mode, and its
accelerations are continuous; displacement, velocity and acceleration are exactly consistent. The responses to unbalance
and to the mesh tone are the stationary ones, in closed form.

A rotor with cubic stiffness is advanced by the same exact step of its linear part on a finer grid, unbalance included;
the cubic force is taken as linear over the step, extrapolated from its last two values. The error is proportional to
the square of the step.
"""

from dataclasses import dataclass

import numpy as np

from benchmarks.finite_elements.assembly import (
    ComplexArray,
    Equations,
    assemble,
    harmonic_response,
    mesh_force,
    place,
    probed,
    unbalance_force,
)
from benchmarks.finite_elements.forces import Force, force_samples, forced
from benchmarks.finite_elements.rotor import BeamRotor
from models.errors import EstimationError
from models.signals.block import FloatArray

PROBES = (
    *("y1", "y2", "z1", "z2"),
    *("y1_dot", "y2_dot", "z1_dot", "z2_dot"),
    *("y1_ddot", "y2_ddot", "z1_ddot", "z2_ddot"),
)
"""Quantities that can be measured: motions of the first bearing (1) and the first disc (2)."""

_DECAYS = 6.0
_LONGEST_WARM_S = 30.0
_PIECE = 20_000
_STRETCH, _SIDE_BY_SIDE = 125, 160


@dataclass(frozen=True, slots=True)
class Motion:
    """Samples of a run."""

    values: FloatArray  # (n_samples, 12), in the order of `PROBES`, SI
    angle_rad: FloatArray  # shaft angle, unwrapped


@dataclass(frozen=True, slots=True)
class _Modal:
    """Modal form of the state equations: A = V diag(s) V⁻¹, and V⁻¹B for forces at some coordinates."""

    roots: ComplexArray
    shapes: ComplexArray
    drive: ComplexArray
    direct: FloatArray  # M⁻¹ of these forces


def move(
    rotor: BeamRotor,
    speed_rad_s: float,
    forces: tuple[Force, ...],
    duration_s: float,
    rate_hz: float,
    rng: np.random.Generator,
    *,
    oversampling: int = 2,
) -> Motion:
    """Simulate a rotor at constant speed; one with cubic stiffness takes `oversampling` steps per sample.

    Raises EstimationError if the rotor is unstable at this speed, or diverges because of its cubic stiffness.
    """
    equations = assemble(rotor, speed_rad_s)
    fine = 1 if rotor.linear else oversampling
    springs = _springs(rotor)
    places = (*forced(forces), *(at for at, _ in springs))
    modal = _modal(equations, places)
    slowest = float(np.min(-modal.roots.real))
    if slowest <= 0:
        raise EstimationError(f"{rotor.name}: unstable at {speed_rad_s * 30 / np.pi:.0f} rpm")
    warm = round(min(_DECAYS / slowest, _LONGEST_WARM_S) * rate_hz)
    count = warm + round(duration_s * rate_hz)
    force = force_samples(forces, count * fine, rate_hz * fine, rng)
    start = float(rng.uniform(0, 2 * np.pi))
    angle = np.asarray(start + speed_rad_s * np.arange(count) / rate_hz, dtype=np.float64)
    if rotor.linear:
        values = _linear(modal, probed(rotor), force, rate_hz)
        turning = [(1, unbalance_force(rotor, speed_rad_s))]
        if rotor.gear is not None:
            turning.append((rotor.gear.teeth, mesh_force(rotor)))
        for order, pull in turning:
            q = harmonic_response(equations, order * speed_rad_s, pull)[list(probed(rotor))]
            W = 1j * order * speed_rad_s
            wave = np.concatenate([q, W * q, W**2 * q])
            values += np.column_stack([np.cos(order * angle), np.sin(order * angle)]) @ [wave.real, -wave.imag]
    else:
        fine_angle = np.asarray(start + speed_rad_s * np.arange(count * fine) / (rate_hz * fine), dtype=np.float64)
        pull = unbalance_force(rotor, speed_rad_s)
        run = _Run(rotor, equations, modal, springs)
        with np.errstate(over="ignore", invalid="ignore"):  # checked below
            values = _stiffening(run, force, pull, fine_angle, rate_hz * fine)[::fine]
        if not np.all(np.isfinite(values)):
            raise EstimationError(f"{rotor.name}: the cubic stiffness throws it out of range at this force")
    return Motion(values[warm:], angle[warm:])


def _modal(equations: Equations, places: tuple[int, ...]) -> _Modal:
    n = len(equations.M)
    roots, shapes = np.linalg.eig(equations.A)
    direct = np.asarray(np.linalg.inv(equations.M)[:, list(places)], dtype=np.float64)
    drive = np.linalg.solve(shapes, np.vstack([np.zeros((n, len(places))), direct]).astype(np.complex128))
    return _Modal(roots, shapes, drive, direct)


def _steps(roots: ComplexArray, step_s: float) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Decay of each mode over a step, and the weights of the force at the beginning and at the end of the step."""
    decay = np.exp(roots * step_s)
    after = (decay - 1 - roots * step_s) / (roots**2 * step_s)
    return decay, (decay - 1) / roots - after, after


def _linear(modal: _Modal, rows: tuple[int, ...], force: FloatArray, rate_hz: float) -> FloatArray:
    """Motion at some coordinates; the samples are cut into stretches that advance side by side, from rest."""
    n = len(modal.roots) // 2
    # one of each pair of complex conjugate roots is enough
    kept = np.flatnonzero(modal.roots.imag >= 0)
    decay, before, after = (each[kept, None] for each in _steps(modal.roots, 1 / rate_hz))
    output = modal.shapes[list(rows)][:, kept]
    rate = modal.shapes[[n + row for row in rows]][:, kept]
    shapes = np.concatenate([output, rate, rate * modal.roots[kept]]) * np.where(modal.roots[kept].imag == 0, 1, 2)
    drive = modal.drive[kept, : force.shape[1]]
    drive = np.hstack([before * drive, after * drive])  # of the force a sample before, and now
    direct = modal.direct[list(rows), : force.shape[1]]
    stretches = -(-len(force) // _STRETCH)
    padded = np.zeros((stretches * _STRETCH + 1, force.shape[1]))
    padded[1 : len(force) + 1] = force
    powers = decay.T ** np.arange(1, _STRETCH + 1)[:, None]
    starts = np.zeros((len(kept), _SIDE_BY_SIDE + 1), dtype=np.complex128)
    values = np.empty((stretches, _STRETCH, 3 * len(rows)))
    for first in range(0, stretches, _SIDE_BY_SIDE):
        out = values[first : first + _SIDE_BY_SIDE]
        piece = padded[first * _STRETCH : (first + len(out)) * _STRETCH + 1]
        inputs = np.hstack([piece[:-1], piece[1:]]).reshape(*out.shape[:2], -1).transpose(1, 2, 0)
        states = drive @ np.ascontiguousarray(inputs)
        for number in range(1, _STRETCH):
            states[number] += decay * states[number - 1]
        for number in range(len(out)):
            starts[:, number + 1] = powers[-1] * starts[:, number] + states[-1, :, number]
        states += powers[:, :, None] * starts[:, : len(out)]
        starts[:, 0] = starts[:, len(out)]
        out[:] = (shapes.real @ states.real - shapes.imag @ states.imag).transpose(2, 0, 1)
    found = values.reshape(-1, 3 * len(rows))[: len(force)]
    found[:, 2 * len(rows) :] += force @ direct.T
    return found


def _springs(rotor: BeamRotor) -> tuple[tuple[int, float], ...]:
    """Coordinates with cubic stiffness, and its values, N/m³."""
    found: list[tuple[int, float]] = []
    for bearing in rotor.bearings:
        if bearing.cubic_N_per_m3:
            found.append((place(rotor, bearing.node, "y"), bearing.cubic_N_per_m3))
            found.append((place(rotor, bearing.node, "z"), bearing.cubic_N_per_m3 * bearing.cubic_ratio_z))
    return tuple(found)


@dataclass(frozen=True, slots=True)
class _Run:
    rotor: BeamRotor
    equations: Equations
    modal: _Modal
    springs: tuple[tuple[int, float], ...]


def _stiffening(run: _Run, force: FloatArray, pull: ComplexArray, angle: FloatArray, rate_hz: float) -> FloatArray:
    modal, n = run.modal, len(run.equations.M)
    decay, before, after = _steps(modal.roots, 1 / rate_hz)
    inverse = np.linalg.inv(modal.shapes)
    F = np.real((modal.shapes * decay) @ inverse)
    first, second = (np.real((modal.shapes * part) @ modal.drive) for part in (before, after))
    turning = np.linalg.solve(run.equations.M, pull)
    wheel = np.vstack([np.zeros((n, 2)), np.column_stack([turning.real, -turning.imag])])
    first_1x, second_1x = (np.real((modal.shapes * part) @ inverse @ wheel) for part in (before, after))
    n_force = force.shape[1]
    at = np.array([where for where, _ in run.springs])
    cubic = np.array([stiffness for _, stiffness in run.springs])
    # The cubic force over a step is extrapolated from g to g + (g - g_before), so the step needs g and g_before.
    g_now = -(first + 2 * second)[:, n_force:]
    g_old = second[:, n_force:]
    step = np.hstack([F, g_now, g_old])
    size = 2 * n
    state = np.zeros(size + 2 * len(at))
    moving, now, old = np.split(state, [size, size + len(at)])  # views of `state`
    inputs = np.hstack([force, np.cos(angle)[:, None], np.sin(angle)[:, None]])
    first_all, second_all = np.hstack([first[:, :n_force], first_1x]), np.hstack([second[:, :n_force], second_1x])
    rows = list(probed(run.rotor))
    to_rates = np.hstack([run.equations.A[[n + row for row in rows]], -modal.direct[rows][:, n_force:] * cubic])
    to_rates_direct = np.hstack([modal.direct[rows][:, :n_force], wheel[[n + row for row in rows]]])
    values = np.zeros((len(force), 12))
    for begin in range(1, len(force), _PIECE):
        end = min(begin + _PIECE, len(force))
        driven = inputs[begin - 1 : end - 1] @ first_all.T + inputs[begin:end] @ second_all.T
        path = np.empty_like(driven)
        for drive, reached in zip(driven, path, strict=True):
            old[:] = now
            moved = moving[at]
            np.multiply(cubic * moved, moved * moved, out=now)
            np.dot(step, state, out=reached)
            np.add(reached, drive, out=reached)
            moving[:] = reached
        values[begin:end, :4] = path[:, rows]
        values[begin:end, 4:8] = path[:, [n + row for row in rows]]
        values[begin:end, 8:] = np.hstack([path, path[:, at] ** 3]) @ to_rates.T + inputs[begin:end] @ to_rates_direct.T
    return values
