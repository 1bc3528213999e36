"""Cramér-Rao bound: the smallest error with which an unbiased method can read the parameters from one window.

The information of T seconds of a stationary Gaussian process with spectra S(f; θ) is (P. Whittle, J. Roy. Statist. Soc.
B 15 (1953))

    J_ab = T ∫ tr(S⁻¹ ∂_a S S⁻¹ ∂_b S) df  over the band.

Besides the parameters, the level matrix, the cutoff of the excitation and the density and colour of every channel's
noise are unknown; only the rotor's other properties are known. The excitation's shape, a second-order low-pass, is
assumed known; a method that does not know it has a higher bound.
"""

from dataclasses import dataclass

import numpy as np

from models.diagnosis.likelihood.motions import BinGroups, Motions
from models.diagnosis.likelihood.spectral_model import COLUMNS, ROWS, SHAPES, STRUCTURAL, SpectralModel
from models.diagnosis.likelihood.unbalance import estimate_unbalance
from models.diagnosis.window.moments import plan_for
from models.machine import Machine
from models.physics.excitation import Source, floor_density
from models.physics.response import synchronous_response
from models.physics.rotor import STATE_INDEX, changed
from models.signals.block import FloatArray
from simulator.plant import theoretical_moments
from simulator.scenario import Scenario
from simulator.timeline import Condition

_PULL = 1e-6  # keeps the information invertible in directions that no sensor measures


@dataclass(frozen=True, slots=True)
class TrueCondition:
    """True condition of a window, SI units."""

    changes: dict[str, float]  # relative changes of parameters
    speed_rad_s: float
    cutoff_hz: float  # cutoff of the second-order low-pass that colours all forces
    levels: FloatArray  # (6, 6): two-sided density of the forces far below the cutoff, N²/Hz and Nm²/Hz
    noise: FloatArray  # (n_states,): two-sided density of the sensor noise at the lower end of the band
    noise_colour: FloatArray  # (n_states,): exponent b of the noise's colour


def cramer_rao(
    machine: Machine, states: tuple[str, ...], true: TrueCondition, duration_s: float, *, shape_known: bool = True
) -> dict[str, float]:
    """Smallest standard error of the relative change of ``k_by, c_by, k_bz, c_bz, EI, e``, read from measured states.

    `shape_known`: whether the excitation is known to be a second-order low-pass.
    """
    low, high = machine.window.band_hz
    spacing = 1 / machine.window.segment_s
    frequencies_hz = np.arange(low, high + spacing / 2, spacing)
    one = np.ones(frequencies_hz.size)
    bins = BinGroups(
        tuple((k, k + 1) for k in range(frequencies_hz.size)),
        one,
        frequencies_hz,
        frequencies_hz[:, None],
        one[:, None],
        np.eye(one.size),
    )
    lever = machine.rotor.shaft_length_m / 3
    unit = np.array([1, 1, lever, 1, 1, lever])
    levels = true.levels / np.outer(unit, unit)
    force_scale = float(np.sqrt(np.trace(levels) / 6))
    shapes = 0 if shape_known else SHAPES
    # In units of the true noise, motions retain all information of displacement and velocity.
    motions = Motions(states, np.sqrt(true.noise))
    model = SpectralModel(machine, motions, bins, force_scale, shapes)
    theta = _theta(model, true, levels)
    point = model.at(theta, true.speed_rad_s)
    whiten = np.asarray(np.linalg.inv(np.linalg.cholesky(point.S)), dtype=np.complex128)
    slopes = model.slopes(point, whiten).reshape(model.size, -1)
    information = duration_s * spacing * (slopes @ slopes.T)
    pull = np.full(model.size, _PULL)
    if shape_known:
        pull[model.order_at] = 1e9
    everything = np.asarray(np.linalg.inv(information + np.diag(pull)), dtype=np.float64)
    covariance = everything[: len(STRUCTURAL), : len(STRUCTURAL)]
    ratio = np.exp(theta[: len(STRUCTURAL)])
    bound = dict(zip(STRUCTURAL, (ratio * np.sqrt(np.diag(covariance))).tolist(), strict=True))
    # The exact 1x vector, x = q1 cos(θ + φ) + q2 sin(θ + φ): it determines how far errors of the structural parameters
    # propagate to e.
    q1, q2 = synchronous_response(changed(machine.rotor, true.changes), true.speed_rad_s)
    order = [STATE_INDEX[name] for name in states]
    synchronous = np.asarray(
        (q1 - 1j * q2)[order] * np.exp(1j * machine.operation.unbalance_phase_rad), dtype=np.complex128
    )
    e = estimate_unbalance(machine, model, point, covariance, synchronous, true.speed_rad_s, duration_s).decided()
    return bound | {"e": float(np.sqrt(e.variance))}


def _theta(model: SpectralModel, true: TrueCondition, levels: FloatArray) -> FloatArray:
    """Parameters of the true condition in the model's units."""
    theta = np.zeros(model.size)
    theta[: len(STRUCTURAL)] = np.log1p([true.changes.get(name, 0.0) for name in STRUCTURAL])
    theta[model.cutoff_at], theta[model.order_at] = np.log(true.cutoff_hz), np.log(2)
    theta[model.colour_at] = true.noise_colour.mean()
    relative = levels / model.force_unit[0] ** 2
    relative = relative + 1e-12 * np.trace(relative) * np.eye(6)
    theta[model.level_at] = np.linalg.cholesky(relative)[ROWS, COLUMNS]
    return theta


def bound_of(scenario: Scenario, machine: Machine) -> dict[str, float]:
    """The bound for one window of a scenario, in its initial condition."""
    states = plan_for(machine).states
    return cramer_rao(machine, states, _true_condition(scenario, machine), machine.window.length_s)


def source_spectrum(frequency_hz: FloatArray, source: Source) -> FloatArray:
    """Two-sided power spectral density of a source's force, N²/Hz; same shape as `frequency_hz`."""
    fallen = 1 + (frequency_hz / source.cutoff_hz) ** (2 * source.order)
    floor = floor_density(source.cutoff_hz, source.order) / fallen
    r2 = (frequency_hz / source.hump_hz) ** 2
    hump = 2 * source.hump_damping / (np.pi * source.hump_hz) * r2 / ((1 - r2) ** 2 + 4 * source.hump_damping**2 * r2)
    density = (1 - source.hump_share) * floor + source.hump_share * hump
    return np.asarray(source.force_rms_N**2 * density, dtype=np.float64)


def _true_condition(scenario: Scenario, machine: Machine) -> TrueCondition:
    changes = {one.parameter: one.relative_change for one in scenario.events if one.parameter}
    truth = {name: float(change) for name, change in changes.items() if change is not None}
    speed_rpm = [one.speed_rpm for one in scenario.events if one.speed_rpm is not None][-1]
    rms = np.sqrt(np.diag(theoretical_moments(machine, Condition(truth, speed_rpm, scenario.sources))))
    states = [STATE_INDEX[name] for name in plan_for(machine).states]
    low_hz, high_hz = machine.window.band_hz
    frequencies_hz = np.linspace(low_hz, high_hz, 64)
    corner_hz = scenario.sensors.noise_corner_hz
    memory = 0.0 if corner_hz is None else float(np.exp(-2 * np.pi * corner_hz / machine.rate_hz))
    density = (1 - memory**2) / np.abs(1 - memory * np.exp(-2j * np.pi * frequencies_hz / machine.rate_hz)) ** 2
    colour = np.stack([np.ones(64), np.log1p((frequencies_hz / (2 / 3 * high_hz)) ** 2)], axis=1)
    (level, exponent), *_ = np.linalg.lstsq(colour, np.log(density / machine.rate_hz), rcond=None)
    variance = (scenario.sensors.noise_relative * rms[states]) ** 2
    levels = np.zeros((6, 6))
    for source in scenario.sources:
        levels += np.outer(source.direction, source.direction) * float(source_spectrum(np.array([1e-6]), source)[0])
    return TrueCondition(
        changes=truth,
        speed_rad_s=speed_rpm * 2 * np.pi / 60,
        cutoff_hz=scenario.sources[0].cutoff_hz,
        levels=levels,
        noise=np.asarray(np.exp(level) * variance, dtype=np.float64),
        noise_colour=np.full(len(states), float(exponent)),
    )
