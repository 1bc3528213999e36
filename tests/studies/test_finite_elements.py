"""Finite-element rotors against closed forms, the Lyapunov equation and the frequency response."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from benchmarks.finite_elements.assembly import (
    assemble,
    harmonic_response,
    mesh_force,
    modes,
    place,
    probed,
    unbalance_response,
)
from benchmarks.finite_elements.film import Film
from benchmarks.finite_elements.forces import Force, covariance_under
from benchmarks.finite_elements.machines import rotor_named
from benchmarks.finite_elements.motion import PROBES, move
from benchmarks.finite_elements.observed import (
    MOTION,
    RATE_HZ,
    RunCondition,
    WindowSizes,
    blocks,
    machine_of,
    plan,
    sampled,
    windows_of,
)
from benchmarks.finite_elements.rotor import BeamRotor, Bearing, Disc, changed_rotor
from benchmarks.finite_elements.scenes import COMMISSIONED, SourceLayout, drawn_condition
from benchmarks.studies.methods.bound import source_spectrum
from benchmarks.studies.methods.damping_bound import damping_bound
from benchmarks.studies.methods.damping_bound import expected as expected_under
from models.diagnosis.baseline.rows import ROWS
from models.diagnosis.window.moments import plan_for
from models.errors import EstimationError
from models.physics.excitation import Source
from models.signals.block import FloatArray
from tests.sure import sure
from tests.windows import last_window

BEAM = BeamRotor(
    name="beam", description="", length_m=1.0, diameter_m=0.02, elements=12,
    bearings=(Bearing(0, 1e12, 1e12, 0, 0), Bearing(12, 1e12, 1e12, 0, 0)), discs=(), speed_rad_s=0.0,
    shaft_damping_s=0.0,
)  # fmt: skip


def forces(rotor: BeamRotor) -> tuple[Force, ...]:
    y1, y2, z1, z2 = probed(rotor)
    return (Force(60.0, 5.0, ((y1, 0.6), (y2, 0.5), (z1, 0.4), (z2, -0.5))), Force(90.0, 2.0, ((y2, 1.0),)))


@pytest.mark.parametrize("shear", [False, True])
def test_a_simply_supported_beam_has_the_frequencies_of_the_closed_form(shear: bool) -> None:
    ends = (Bearing(0, 1e13, 1e13, 0, 0), Bearing(24, 1e13, 1e13, 0, 0))
    rotor = replace(BEAM, shear=shear, diameter_m=0.12 if shear else 0.02, elements=24, bearings=ends)
    found = [mode.frequency_hz for mode in modes(assemble(rotor, 0.0))][::2]
    EI, rho, E = rotor.bending_stiffness, rotor.density_kg_m3, rotor.E_Pa
    for n in (1, 2, 3):
        wave = n * math.pi / rotor.length_m
        if shear:  # Timoshenko's beam on pins: a quadratic in ω²
            kG = 6 * 1.3 / (7 + 6 * 0.3) * E / 2.6
            I = EI / E  # noqa: E741
            a = rho**2 * I / kG
            b = rho * rotor.area_m2 + rho * I * (1 + E / kG) * wave**2
            squared = (b - math.sqrt(b**2 - 4 * a * EI * wave**4)) / (2 * a)
        else:
            squared = EI * wave**4 / (rho * rotor.area_m2)
        assert found[n - 1] == pytest.approx(math.sqrt(squared) / (2 * math.pi), rel=2e-3)


def test_a_spinning_disc_splits_its_tilting_modes_as_the_rigid_rotor_says() -> None:
    k, L, disc, speed = 1e5, 0.4, Disc(2, 5.0, 0.1), 300.0
    bearings = (Bearing(0, k, k, 0, 0), Bearing(4, k, k, 0, 0))
    rigid = replace(BEAM, length_m=L, diameter_m=0.1, elements=4, E_Pa=1e13, density_kg_m3=1e-3)
    rotor = replace(rigid, bearings=bearings, discs=(disc,), speed_rad_s=speed)
    I_d, I_p, turning = 5 * 0.01 / 4, 5 * 0.01 / 2, k * L**2 / 2
    roots = np.roots([I_d, -I_p * speed, -turning])
    expected = sorted(np.abs(roots) / (2 * np.pi))
    found = [mode.frequency_hz for mode in modes(assemble(rotor, speed)) if mode.frequency_hz < 200]
    bounce = math.sqrt(2 * k / 5) / (2 * math.pi)
    assert sorted([bounce, bounce, *expected]) == pytest.approx(found, rel=1e-4)


def test_an_unbalance_drives_the_forward_whirl_which_is_the_faster_one() -> None:
    between = rotor_named("between")
    bearings = tuple(replace(one, k_z=one.k_y, c_y=1.0, c_z=1.0) for one in between.bearings)
    equations = assemble(replace(between, bearings=bearings, shaft_damping_s=0.0), 1500.0)
    slow, fast = modes(equations)[2:4]
    assert fast.frequency_hz > 1.05 * slow.frequency_hz
    force = np.zeros(len(equations.M), dtype=complex)
    at = [place(between, 2, "y"), place(between, 2, "z")]
    moved = {}
    for turn in (1, -1):
        force[at] = 1, -1j * turn
        for mode in (slow, fast):
            response = harmonic_response(equations, 2 * math.pi * mode.frequency_hz, force)
            moved[turn, mode] = abs(response[at[0]])
    assert moved[1, fast] > 5 * moved[-1, fast]
    assert moved[-1, slow] > 5 * moved[1, slow]


def test_the_lyapunov_covariance_is_the_integral_of_the_spectrum() -> None:
    rotor = rotor_named("overhung")
    equations, sources = assemble(rotor, rotor.speed_rad_s), forces(rotor)
    covariance = covariance_under(equations, sources)
    frequency = np.arange(0.05, 900.0, 0.1)
    total = np.zeros(4)
    for force in sources:
        colour = Source(cutoff_hz=force.cutoff_hz, direction=(0,) * 6, force_rms_N=force.rms_N)
        pull = np.zeros(len(equations.M), dtype=complex)
        for at, part in force.share:
            pull[at] += part
        gain = np.array([np.abs(harmonic_response(equations, 2 * np.pi * f, pull)) ** 2 for f in frequency])
        total += 2 * 0.1 * source_spectrum(frequency, colour) @ gain[:, list(probed(rotor))]
    assert np.diag(covariance)[list(probed(rotor))] == pytest.approx(total, rel=3e-3)


@pytest.mark.parametrize("name", ["overhung", "both-sides"])
def test_simulated_variances_agree_with_the_lyapunov_equation(name: str) -> None:
    rotor = rotor_named(name)
    still = replace(rotor, discs=tuple(replace(disc, unbalance_kg_m=0.0) for disc in rotor.discs))
    sources = forces(rotor)
    n, rows = 4 * (rotor.elements + 1), list(probed(rotor))
    theory = np.diag(covariance_under(assemble(rotor, rotor.speed_rad_s), sources))[rows + [n + row for row in rows]]
    runs = [move(still, rotor.speed_rad_s, sources, 60, RATE_HZ, np.random.default_rng([11, k])) for k in range(5)]
    ratio = np.array([run.values[:, :8].var(axis=0) / theory for run in runs])
    error = ratio.std(axis=0, ddof=1) / math.sqrt(len(runs))
    assert np.all(np.abs(ratio.mean(axis=0) - 1) < np.maximum(6 * error, 0.02)), ratio.mean(axis=0)
    assert np.all(error < 0.06)
    step = runs[0].values
    # velocity is the integral of a continuous acceleration
    gained = np.diff(step[:, 4:8], axis=0)
    mean = (step[1:, 8:] + step[:-1, 8:]) / (2 * RATE_HZ)
    assert np.all(np.std(gained - mean, axis=0) < 0.04 * np.std(gained, axis=0))


def test_unbalance_alone_gives_the_frequency_response() -> None:
    rotor = rotor_named("asymmetric")
    motion = move(rotor, rotor.speed_rad_s, (), 2, RATE_HZ, np.random.default_rng(1))
    q = unbalance_response(rotor, rotor.speed_rad_s)[list(probed(rotor))]
    W = rotor.speed_rad_s
    expected = np.real(np.exp(1j * motion.angle_rad)[:, None] * np.concatenate([q, 1j * W * q, -(W**2) * q]))
    assert motion.values == pytest.approx(expected)


def test_the_stepped_rotor_equals_the_linear_one_for_vanishing_cubic_stiffness() -> None:
    linear = rotor_named("overhung")
    stepped = replace(linear, bearings=(replace(linear.bearings[0], cubic_N_per_m3=1e-9), *linear.bearings[1:]))
    one, other = (
        move(rotor, 150.0, forces(linear), 1.0, RATE_HZ, np.random.default_rng(4), oversampling=1).values
        for rotor in (linear, stepped)
    )
    assert np.all(np.std(one - other, axis=0) < 2e-3 * np.std(one, axis=0))  # what is left of the start has decayed


def test_whirl_under_cubic_stiffness_converges_to_harmonic_balance() -> None:
    rotor = rotor_named("stiffening")
    bearing = replace(rotor.bearings[0], k_z=rotor.bearings[0].k_y, c_z=rotor.bearings[0].c_y)
    heavy = tuple(replace(disc, unbalance_kg_m=4 * disc.unbalance_kg_m) for disc in rotor.discs)
    rotor = replace(rotor, bearings=(bearing, rotor.bearings[1]), discs=heavy)
    speed, y1 = 2 * math.pi * 17.0, probed(rotor)[0]
    radius = 0.0
    for _ in range(200):
        k = bearing.k_y + 0.75 * bearing.cubic_N_per_m3 * radius**2
        stiff = replace(rotor, bearings=(replace(bearing, k_y=k, k_z=k), rotor.bearings[1]))
        response = unbalance_response(stiff, speed)
        radius = 0.5 * (radius + abs(response[y1]))
    found = []
    for oversampling in (1, 2, 4):
        motion = move(rotor, speed, (), 2.0, RATE_HZ, np.random.default_rng(5), oversampling=oversampling)
        design = np.column_stack([np.cos(motion.angle_rad), np.sin(motion.angle_rad)])
        a, b = np.linalg.lstsq(design, motion.values[:, 0], rcond=None)[0]
        found.append(a - 1j * b)
    assert 0.03 < bearing.cubic_N_per_m3 * radius**2 / bearing.k_y < 0.5
    assert found[2] == pytest.approx(response[y1], rel=0.01)
    assert abs(found[1] - found[2]) < abs(found[0] - found[2]) / 2.5


def test_an_unstable_rotor_is_refused() -> None:
    rotor = rotor_named("fluid-film")
    whirling = replace(rotor, bearings=(replace(rotor.bearings[0], k_yz=4e5, k_zy=-4e5), rotor.bearings[1]))
    with pytest.raises(EstimationError, match="fluid-film: unstable at"):
        move(whirling, rotor.speed_rad_s, (), 1.0, RATE_HZ, np.random.default_rng(0))


def film_force(film: Film, speed_rad_s: float, at: FloatArray, rate: FloatArray) -> FloatArray:
    """Force on the journal from Reynolds' equation for a short bearing, by quadrature; shape (2,), N."""
    angle = np.arange(40_000) * (2 * np.pi / 40_000)
    round_ = np.array([np.cos(angle), np.sin(angle)])
    wedge = speed_rad_s * (at @ [round_[1], -round_[0]]) - 2 * rate @ round_
    pressed = np.maximum(-film.viscosity_Pa_s * film.length_m**3 / 2 * wedge / (film.clearance_m - at @ round_) ** 3, 0)
    return np.asarray(-(round_ @ pressed) * film.diameter_m * np.pi / angle.size)


def test_an_oil_film_has_the_derivatives_of_reynolds_equation() -> None:
    film, speed = Film(0.03, 0.012, 8e-5, 0.03, 30.0), 200.0
    still, size = np.zeros(2), film.clearance_m * film.eccentricity(speed)
    attitude = math.atan(math.pi / 4 * math.sqrt(1 / film.eccentricity(speed) ** 2 - 1))
    at = size * np.array([math.sin(attitude), -math.cos(attitude)])
    assert film_force(film, speed, at, still) == pytest.approx([0.0, film.load_N], abs=1e-3)
    steps = 1e-8 * np.eye(2)
    K = [(film_force(film, speed, at - d, still) - film_force(film, speed, at + d, still)) / 2e-8 for d in steps]
    C = [(film_force(film, speed, at, -d) - film_force(film, speed, at, d)) / 2e-8 for d in steps]
    found = film.coefficients(speed)
    assert found[0] == pytest.approx(np.transpose(K), rel=1e-3)
    assert found[1] == pytest.approx(np.transpose(C), rel=1e-3)


def test_a_film_without_load_whirls_at_half_the_speed_and_a_loaded_one_does_not() -> None:
    for load_N, stable in ((0.5, False), (3000.0, True)):
        film = Film(0.03, 0.015, 8e-5, 0.02, load_N)
        ends = tuple(Bearing(node, 1, 1, 1, 1, film=film) for node in (0, 12))
        rigid = replace(BEAM, E_Pa=1e14, diameter_m=0.03, density_kg_m3=100.0, bearings=ends)
        least = max(np.linalg.eigvals(assemble(rigid, 1500.0).A), key=lambda root: root.real)
        assert (least.real < 0) == stable
        if not stable:
            assert abs(least.imag) == pytest.approx(750.0, rel=0.05)
            K, _ = film.coefficients(1500.0)
            assert K[0, 1] == pytest.approx(-K[1, 0], rel=1e-2)  # what drives the whirl
            assert film.eccentricity(1500.0) < 0.05


def test_a_stand_sways_with_the_mass_on_it_and_a_stiff_one_acts_as_ground() -> None:
    rotor = rotor_named("soft-stand")
    stand = sure(rotor.stand)
    total = stand.mass_kg + sum(one.mass_kg for one in rotor.discs) + sum(b.housing_kg for b in rotor.bearings)
    total += rotor.density_kg_m3 * rotor.area_m2 * rotor.length_m
    slowest = modes(assemble(rotor, 0.0))[0].frequency_hz
    assert slowest == pytest.approx(math.sqrt(stand.k / total) / (2 * math.pi), rel=0.05)
    stiff = replace(rotor, stand=replace(stand, k=1e12))
    ground = [mode.frequency_hz for mode in modes(assemble(replace(rotor, stand=None), rotor.speed_rad_s))]
    found = [mode.frequency_hz for mode in modes(assemble(stiff, rotor.speed_rad_s))]
    assert found[:6] == pytest.approx(ground[:6], rel=1e-3)


def test_a_gear_mesh_is_a_spring_and_excites_at_tooth_frequency() -> None:
    rotor = rotor_named("geared")
    gear = sure(rotor.gear)
    free = assemble(replace(rotor, gear=None), rotor.speed_rad_s)
    across = np.zeros(rotor.size)
    across[[place(rotor, gear.node, plane) for plane in ("y", "z")]] = gear.along @ [[0, 1], [-1, 0]]
    difference = assemble(rotor, rotor.speed_rad_s).K - free.K
    assert np.linalg.norm(difference @ across) < 1e-9 * np.linalg.norm(difference)
    assert np.trace(difference) == pytest.approx(gear.k)
    still = replace(rotor, discs=tuple(replace(disc, unbalance_kg_m=0.0) for disc in rotor.discs))
    motion = move(still, rotor.speed_rad_s, (), 1, RATE_HZ, np.random.default_rng(1))
    design = np.column_stack([np.cos(19 * motion.angle_rad), np.sin(19 * motion.angle_rad)])
    parts = np.linalg.lstsq(design, motion.values[:, 2], rcond=None)[0]
    assert design @ parts == pytest.approx(motion.values[:, 2], abs=1e-12)
    response = harmonic_response(assemble(rotor, rotor.speed_rad_s), 19 * rotor.speed_rad_s, mesh_force(rotor))
    assert math.hypot(*parts) == pytest.approx(abs(response[place(rotor, 0, "z")]))


def test_changes_act_on_the_named_parameters() -> None:
    rotor = rotor_named("stiffening")
    other = changed_rotor(rotor, {"k_bz": -0.1, "c_by": -0.3, "e": 0.2})
    one, two = rotor.bearings[0], other.bearings[0]
    assert (two.k_y, two.c_z, two.cubic_N_per_m3) == (one.k_y, one.c_z, one.cubic_N_per_m3)
    assert (two.k_z, two.c_y, two.cubic_ratio_z) == pytest.approx((0.9 * one.k_z, 0.7 * one.c_y, 0.9))
    assert other.discs[1].unbalance_kg_m == pytest.approx(1.2 * rotor.discs[1].unbalance_kg_m)
    plain = rotor_named("plain-bearings")
    before, after = (one.bearings[0].coefficients(200.0) for one in (plain, changed_rotor(plain, {"k_by": -0.1})))
    assert after[0] / before[0] == pytest.approx(np.array([[0.9, 1.0], [1.0, 1.0]]))
    assert after[1] == pytest.approx(before[1])
    with pytest.raises(ValueError, match="stiffening: change EI"):
        changed_rotor(rotor, {"EI": 0.1})


def test_windows_follow_the_plan_and_show_the_unbalance() -> None:
    rotor = rotor_named("between")
    condition = drawn_condition(rotor, SourceLayout.ONE_SOURCE, COMMISSIONED, {}, np.random.default_rng(3))
    sizes = plan(rotor, WindowSizes(length_s=20.0))
    assert sizes.states == ("y1", "y2", "z1", "z2", "y1_dot", "y2_dot", "z1_dot", "z2_dot")
    found = windows_of(sampled(rotor, condition, 43.0, 8), sizes)
    assert [window.duration_s for window in found] == [20.0, 20.0]
    assert found[1].start_ns == found[0].end_ns
    expected = unbalance_response(rotor, condition.speed_rad_s)[list(probed(rotor))]
    assert np.all(np.abs(sure(found[0].synchronous)[:4] / expected - 1) < 0.3)
    assert found[0].speed_rad_s == pytest.approx(condition.speed_rad_s, rel=1e-6)
    disc = [found[0].states.index("y2"), found[0].states.index("z2")]
    level = np.sqrt(np.mean([np.diag(window.correlation[0])[disc].sum() for window in found]))
    assert level / np.sqrt(np.sum(np.abs(expected[[1, 3]]) ** 2) / 2) == pytest.approx(1.5, rel=0.25)


def test_the_stream_gives_the_same_windows_as_the_samples() -> None:
    rotor, sizes = rotor_named("overhung"), WindowSizes(length_s=20.0)
    samples = sampled(rotor, RunCondition(forces(rotor), rotor.speed_rad_s), 23.0, 3)
    machine = machine_of(rotor, sizes)
    sent = list(blocks(samples, machine.descriptor))
    assert [block.sequence for block in sent] == list(range(len(sent)))
    assert all(after.start_ns == before.end_ns for before, after in pairwise(sent))
    found = last_window(plan_for(machine), sent)
    (direct,) = windows_of(samples, plan(rotor, sizes))
    scale = np.sqrt(np.outer(np.diag(direct.correlation[0]), np.diag(direct.correlation[0])))
    assert found.correlation / scale == pytest.approx(direct.correlation / scale, abs=1e-5)


def test_the_machine_file_holds_channels_and_sampling_but_not_the_rotor() -> None:
    rotor = rotor_named("both-sides")
    file = machine_of(rotor, WindowSizes(), (*MOTION, "y1_ddot"))
    assert file.model_fields_set == {"site", "name", "description", "rate_hz", "window", "sensors"}
    assert [sensor.name for sensor in file.sensors] == [*MOTION, "y1_ddot", "theta"]
    assert set(PROBES) >= {sensor.name for sensor in file.sensors} - {"theta"}
    bare = machine_of(rotor, WindowSizes(), ("y1", "z1"), phase_reference=False)
    assert [sensor.location for sensor in bare.sensors] == ["bearing", "bearing"]


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("changes", [{}, {"c_by": -0.2}])
def test_errors_of_an_oracle_agree_with_the_bound(changes: dict[str, float]) -> None:
    """The bound of damping without parameters, against readings that use the truth for their weights."""
    rotor = rotor_named("overhung")
    sizes = plan(rotor, WindowSizes(length_s=30.0, hop_s=2.5, segment_s=2.5))
    condition = drawn_condition(rotor, SourceLayout.ONE_SOURCE, COMMISSIONED, {}, np.random.default_rng(31))
    changed = replace(condition, changes=changes)
    healthy = windows_of(sampled(rotor, condition, 24 * 30.0 + 3, 1), sizes)[:24]
    later = windows_of(sampled(rotor, changed, 12 * 30.0 + 3, 2), sizes)[:12]
    before, after = (expected_under(rotor, one, later[0]) for one in (condition, changed))
    # simulated mean spectra against the expected ones
    mean = np.mean([one.spectrum for one in later], axis=0)
    band = slice(10, 150)
    power = np.einsum("fii->i", mean[band]).real * (later[0].frequencies_hz[1] - later[0].frequencies_hz[0])
    lines = (after.frequencies_hz >= later[0].frequencies_hz[10]) & (
        after.frequencies_hz <= later[0].frequencies_hz[149]
    )
    assert power == pytest.approx(np.einsum("fii->i", after.spectrum[lines]).real * 0.1, rel=0.1)
    for row in ROWS[:2]:
        bound = damping_bound(row, before, after, changes, np.array([60.0, 30.0]))
        name = row.own[1].parameter
        errors = [bound.oracle(name, later[n], healthy[2 * n % 24 : 2 * n % 24 + 2]) for n in range(12)]
        rms = np.sqrt(np.mean(np.square(errors))) / bound.error(name, alone=False)
        assert 0.6 < rms < 1.5  # twelve independent readings: 0.61 to 1.39 hold 95 %
        longer = damping_bound(row, before, after, changes, np.array([120.0, 30.0]))
        assert longer.error(name, alone=False) < bound.error(name, alone=False)
        assert bound.error(name, alone=True) <= bound.error(name, alone=False)
