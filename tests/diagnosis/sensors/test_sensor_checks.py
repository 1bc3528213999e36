"""Each fault of a sensor is found, named where it can be, and healthy sensors are left alone."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.kinematics import banded, read_pairs
from models.diagnosis.sensors.reference import SensorReference, implicated, learn_sensor_reference
from models.diagnosis.window.moments import Plan, plan_for
from models.diagnosis.window.motion import motion_pairs
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.machine import load_machine
from models.signals.block import FloatArray
from models.signals.channels import unit_in_text
from rotorwatch.records.windows import SensorFault
from simulator.scenario import Event, NamedSource, Scenario, Sensors
from simulator.stream import blocks
from tests.sure import sure

WINDOW_S, MORE_S = 60.0, 3.0
DISPLACEMENTS = ("y1", "z1", "y2", "z2")


@cache
def plan_of(name: str, *, displacements: bool = False) -> Plan:
    plan = plan_for(load_machine(name), lagged=False)
    if not displacements:
        return plan
    keep = [plan.states.index(state) for state in DISPLACEMENTS]
    return replace(plan, states=DISPLACEMENTS, columns=plan.columns[keep], scales=plan.scales[keep])


def of_displacements(samples: FloatArray) -> FloatArray:
    """The displacements of the rotor kit and the shaft angle."""
    return samples[:, [*(column(state) for state in DISPLACEMENTS), -1]]


def sources_along(directions: FloatArray, cutoff_hz: float, force_N: float, order: int = 2) -> tuple[NamedSource, ...]:
    """One source for each direction, shape (n, 6)."""
    return tuple(
        NamedSource.model_validate(
            {"name": str(i), "cutoff_hz": cutoff_hz, "direction": tuple(row), "force_rms_N": force_N, "order": order}
        )
        for i, row in enumerate(directions)
    )


@cache
def recorded(
    name: str, seed: int, windows: int = 1, *, one_source: bool = False, noise: float | None = None,
    events: tuple[Event, ...] = (), key: int = 5, largest: float = 3.0,
) -> FloatArray:  # fmt: skip
    """SI samples of all channels and, last, the shaft angle; level and cutoff are drawn from the seed.

    So is the noise, if it is not given.
    """
    rng, machine = np.random.default_rng([seed, key]), load_machine(name)
    force_N = machine.rotor.m2_kg * machine.rotor.e_m * machine.operation.speed_rad_s**2 * rng.uniform(0.5, largest)
    cutoff_hz, directions = rng.uniform(*machine.condition.cutoff_hz), np.eye(6)[[0, 1, 3, 4]]
    if one_source:
        directions = rng.standard_normal((1, 6)) * [1, 1, 0.05, 1, 1, 0.05]
    sources = sources_along(directions, cutoff_hz, force_N)
    sensors = Sensors(noise_relative=rng.uniform(0.01, 0.05), noise_corner_hz=rng.uniform(30, 500))
    if noise is not None:
        sensors = Sensors(noise_relative=noise)
    scenario = Scenario(
        machine=name, seed=seed, duration_s=windows * WINDOW_S + MORE_S, sources=sources, sensors=sensors, events=events
    )
    return np.concatenate([plan_of(name).to_si(block.samples) for block, _ in blocks(scenario, machine, 1.0)])


def windows_of(plan: Plan, samples: FloatArray) -> list[WindowStatistics]:
    sliding, found = SlidingWindow(plan), []
    for number, _ in enumerate(sliding.feed(samples, 0), start=1):
        statistics = sliding.statistics() if number % plan.hops == 0 else None
        if statistics is not None:
            found.append(statistics)
    return found


@cache
def reference_of(name: str, seed: int = 900) -> SensorReference:
    return learn_sensor_reference(windows_of(plan_of(name), recorded(name, seed, 2)))


def column(state: str) -> int:
    return plan_of("lab").states.index(state)


def found_in(samples: FloatArray, reference: SensorReference | None = None) -> tuple[SensorFault, ...]:
    (window,) = windows_of(plan_of("lab"), samples)
    return sensor_findings(window, reference, load_machine("lab").sensors)


def spoilt(state: str, change: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Samples of the rotor kit, one channel of which is changed."""
    samples = recorded("lab", 1).copy()
    samples[:, column(state)] = change(samples[:, column(state)])
    return samples


def only(findings: tuple[SensorFault, ...]) -> SensorFault:
    assert len(findings) == 1, [finding.text for finding in findings]
    return findings[0]


@pytest.mark.parametrize(
    ("name", "one_source"),
    [
        ("lab", False),
        ("heavy", True),
        *(
            pytest.param(*one, marks=pytest.mark.long)
            for one in (("lab", True), ("heavy", False), ("light", False), ("light", True))
        ),
    ],
)
def test_healthy_sensors_are_left_alone_under_any_excitation(name: str, one_source: bool) -> None:
    for window in windows_of(plan_of(name), recorded(name, 31, one_source=one_source)):
        assert sensor_findings(window) == sensor_findings(window, reference_of(name)) == ()


@pytest.mark.parametrize("state", ["y1", "z2_dot"])
def test_a_stuck_sensor_is_named_with_its_value_and_duration(state: str) -> None:
    samples = recorded("lab", 1).copy()
    samples[50_000:110_000, column(state)] = samples[50_000, column(state)]
    finding = only(found_in(samples))
    assert (finding.kind, finding.states) == ("stuck", (state,))
    assert finding.value == pytest.approx(30.0, abs=5.0)
    channel = next(one for one in load_machine("lab").sensors if one.name == state)
    assert f"{samples[50_000, column(state)] / channel.to_si:.3g} {unit_in_text(channel.unit)}" in finding.text


def test_a_sensor_that_has_just_stuck_is_named_without_a_value() -> None:
    samples = recorded("lab", 1).copy()
    samples[122_000:, column("y1")] = samples[122_000, column("y1")]  # the mean of its hop is another value
    assert "y1: repeated one value for 1.5 s" in only(found_in(samples)).text


def test_a_sensor_without_any_signal_is_named_as_stuck() -> None:
    found = found_in(spoilt("y1", np.zeros_like))
    assert ("stuck", ("y1",)) in [(finding.kind, finding.states) for finding in found]


def test_a_shaft_angle_that_stops_turning_is_named_as_stuck() -> None:
    samples = recorded("lab", 1).copy()
    samples[80_000:, -1] = samples[80_000, -1]
    assert ("theta",) in [finding.states for finding in found_in(samples) if finding.kind == "stuck"]


def test_quantisation_steps_are_no_fault() -> None:
    """Converters of 16 and 12 bits over a range of ±10 times the rms."""
    samples = recorded("lab", 1).copy()
    for step_parts in (2**16 / 20, 2**12 / 20):
        step = samples[:, :8].std(axis=0) / step_parts
        coarse = samples.copy()
        coarse[:, :8] = np.round(samples[:, :8] / step) * step
        assert found_in(coarse) == ()


@pytest.mark.parametrize(("also", "every"), [((), 5_000), ((), 25_000), (("y2_dot",), 5_000)])
def test_peaks_that_the_paired_sensor_does_not_show_are_named(also: tuple[str, ...], every: int) -> None:
    samples = recorded("lab", 1).copy()
    for name in ("y2", *also):
        samples[::every, column(name)] += 20 * samples[:, column(name)].std()
    findings = found_in(samples)
    if also or every > 10_000:  # an impact, or too rare to matter
        assert not any("peaks of up to" in finding.text for finding in findings)
        return
    finding = only(findings)
    assert (finding.kind, finding.states) == ("incoherent", ("y2",))
    assert "which y2_dot does not show" in finding.text


@pytest.mark.parametrize(("state", "gap"), [("y1", 0.0), ("z2", 40.0), ("y2_dot", 0.0)])
def test_repeated_dropouts_are_reported_as_jumps_to_a_constant(state: str, gap: float) -> None:
    samples = recorded("lab", 1).copy()
    own = samples[:, column(state)]
    own += gap * own.std()  # a probe's distance from the shaft
    for first in range(3_000, len(own), 4_000):
        own[first : first + 40] = 0.0
    finding = only(found_in(samples))
    assert (finding.kind, finding.states) == ("stuck", (state,))
    assert f"{state}: jumps to a constant and back, for 0." in finding.text
    few = recorded("lab", 1).copy()
    few[60_000:60_040, column(state)] = 0.0  # a single dropout does not matter
    assert found_in(few) == ()


@pytest.mark.parametrize("kind", ["few digits", "8 bits", "held", "impulses on a coarse converter"])
def test_quantised_or_held_samples_are_no_dropouts(kind: str) -> None:
    samples = recorded("lab", 1).copy()
    rng, own = np.random.default_rng(1611), samples[:, 0]
    spread = own.std()
    if kind == "held":  # sent at a quarter of the rate
        own[:] = np.repeat(own[::4], 4)[: len(own)]
    else:
        if kind.startswith("impulses"):
            own += np.where(rng.random(len(own)) < 0.002, 12 * spread * rng.standard_normal(len(own)), 0.0)
        step = {"few digits": 0.01, "8 bits": 0.08}.get(kind, 0.5) * spread
        own[:] = np.round(own / step) * step
    assert not any("jumps to a constant" in finding.text for finding in found_in(samples))


@pytest.mark.parametrize(
    ("bounds", "angle"),
    [
        ("0.0 to 1.0", lambda theta: theta / (2 * np.pi)), ("0.0 to 359.6", np.degrees),
        ("-10.0 to -8.0", lambda theta: np.where(theta < 0.3, -8.0, -10.0)), ("", lambda theta: theta - np.pi),
        ("", np.unwrap), ("", lambda theta: np.mod(np.unwrap(theta), 20 * np.pi)),
    ],
)  # fmt: skip
def test_a_shaft_angle_that_is_not_in_radians_is_named(bounds: str, angle: Callable[[FloatArray], FloatArray]) -> None:
    samples = recorded("lab", 1).copy()
    samples[:, -1] = angle(samples[:, -1])
    told = [finding.text for finding in found_in(samples) if finding.states == ("theta",) and "2π" in finding.text]
    assert bool(told) == bool(bounds)
    assert not told or len(found_in(samples)) == 1
    assert all(f"theta: runs from {bounds} rad in every hop" in text for text in told)


def scaled(gain: float) -> Callable[[FloatArray], FloatArray]:
    return lambda own: gain * own


def late(count: int) -> Callable[[FloatArray], FloatArray]:
    return lambda own: np.concatenate([own[:count], own[:-count]])


def clipped(deviations: float) -> Callable[[FloatArray], FloatArray]:
    return lambda own: np.clip(own, -deviations * own.std(), deviations * own.std())


def coarse(own: FloatArray) -> FloatArray:
    return np.asarray(np.round(own / (10 * own.std()) + 0.45) * 10 * own.std())


@pytest.mark.parametrize(
    ("state", "change", "kind", "states", "value"),
    [
        ("z1", coarse, "stuck", {"z1"}, None),
        ("z1_dot", lambda own: own.std() * np.random.default_rng(0).standard_normal(own.size), "incoherent",
         {"z1", "z1_dot"}, None),
        ("y2", lambda own: own * np.linspace(1, 0.7, own.size), "gain", {"y2"}, None),
        # The share of samples of a normal variable beyond its limits.
        ("y2", clipped(1.5), "clipped", {"y2"}, 0.134), ("y2", clipped(2.0), "clipped", {"y2"}, 0.046),
        ("y1", scaled(0.9), "gain", {"y1", "y1_dot"}, 1 / 0.9 - 1),
        ("z2", scaled(1.2), "gain", {"z2", "z2_dot"}, 1 / 1.2 - 1),
        ("y2_dot", scaled(0.8), "gain", {"y2", "y2_dot"}, -0.2),
        ("y1", late(1), "delay", {"y1"}, 1 / 2000), ("z2_dot", late(2), "delay", {"z2_dot"}, 2 / 2000),
        ("z1", late(10), "delay", {"z1"}, 10 / 2000),
    ],
)  # fmt: skip
def test_a_fault_of_one_channel_is_named_with_its_size(
    state: str, change: Callable[[FloatArray], FloatArray], kind: str, states: set[str], value: float | None
) -> None:
    finding = only(found_in(spoilt(state, change)))
    assert (finding.kind, set(finding.states)) == (kind, states)
    if value is not None:
        near = {"clipped": 0.01, "gain": 0.005, "delay": 3e-5}[kind]
        assert finding.value == pytest.approx(value, abs=near)


def test_a_step_of_the_mean_is_an_offset_and_a_slow_drift_is_allowed() -> None:
    samples, at = recorded("lab", 1).copy(), column("z1")
    rms = samples[:, at].std()
    samples[:, at] += np.linspace(0, 1.5 * rms, len(samples))
    assert found_in(samples) == ()
    samples[70_000:, at] += 5 * rms
    finding = only(found_in(samples))
    assert (finding.kind, finding.states) == ("offset", ("z1",))
    assert finding.value == pytest.approx(5 * rms, rel=0.2)
    assert sure(finding.z) > 8


def test_an_offset_from_the_start_needs_the_reference_and_a_moved_shaft_is_no_offset() -> None:
    samples, at = recorded("lab", 1).copy(), column("y1")
    samples[:, at] += 1e-3
    assert found_in(samples) == ()
    assert only(found_in(samples, reference_of("lab"))).kind == "offset"
    samples[:, column("z1")] -= 6e-4  # the shaft's centre went elsewhere: not a sensor's doing
    assert found_in(samples, reference_of("lab")) == ()


def test_a_mismatch_at_commissioning_is_healthy_and_a_new_gain_error_is_named() -> None:
    """Commissioned with a velocity 4 % too large; then the displacement loses a fifth."""
    usual = np.ones(9)
    usual[column("y1_dot")] = 1.04
    reference = learn_sensor_reference(windows_of(plan_of("lab"), recorded("lab", 900, 2) * usual))
    samples = recorded("lab", 1).copy() * usual
    assert found_in(samples, reference) == ()
    samples[:, column("y1")] *= 0.8
    findings = found_in(samples, reference)
    assert "y1" in implicated(findings)
    assert implicated(findings) <= {"y1", "y1_dot"}


def coupled(samples: FloatArray, states: tuple[str, ...], corner_hz: float) -> FloatArray:
    """The samples with some channels behind a first-order high-pass."""
    numerator, denominator = butter(1, corner_hz, "highpass", fs=2000.0)
    found, columns = samples.copy(), [column(state) for state in states]
    found[:, columns] = lfilter(numerator, denominator, samples[:, columns], axis=0)
    return found


RATES = ("y1_dot", "z1_dot", "y2_dot", "z2_dot")


@pytest.mark.parametrize("states", [RATES, DISPLACEMENTS])
def test_an_ac_coupled_sensor_is_not_reported_as_delayed(states: tuple[str, ...]) -> None:
    assert found_in(coupled(recorded("lab", 1), states, 1.0)) == ()


def test_a_delay_is_found_with_its_size_despite_ac_coupling() -> None:
    healthy = coupled(recorded("lab", 900, 2), RATES, 1.0)
    reference = learn_sensor_reference(windows_of(plan_of("lab"), healthy))
    assert [pair.lead_rad_s for pair in reference.pairs] == pytest.approx([2 * np.pi] * 4, rel=0.05)
    assert SensorReference.model_validate_json(reference.model_dump_json()) == reference
    samples = coupled(recorded("lab", 1), RATES, 1.0)
    assert found_in(samples, reference) == ()
    samples[1:, column("z2_dot")] = samples[:-1, column("z2_dot")]
    finding = only(found_in(samples, reference))
    assert (finding.kind, finding.states) == ("delay", ("z2_dot",))
    assert finding.value == pytest.approx(1 / 2000.0, abs=3e-5)


@pytest.mark.parametrize("state", ["y2_dot", "z1"])
def test_an_ac_coupling_corner_that_is_too_high_is_named(state: str) -> None:
    finding = only(found_in(coupled(recorded("lab", 1), (state,), 2.0)))
    assert (finding.kind, finding.states) == ("delay", (state,))
    assert f"{state}: runs ahead of" in finding.text
    assert "as behind a first-order high-pass at 2 Hz (AC coupling), expected at most 1.1 Hz" in finding.text


def test_run_out_a_quarter_turn_off_is_no_delay() -> None:
    samples = recorded("lab", 3).copy()
    turning = np.exp(1j * samples[:, -1])
    synchronous = 2 * (samples[:, column("y2")] * turning.conj()).mean()
    samples[:, column("y2")] += (0.05j * synchronous * turning).real
    assert found_in(samples) == ()


@pytest.mark.parametrize(("one", "other"), [("y1", "y2"), ("y2_dot", "z2_dot")])
def test_swapped_channels_are_found_and_the_reference_tells_which(one: str, other: str) -> None:
    samples = recorded("lab", 1).copy()
    samples[:, [column(one), column(other)]] = samples[:, [column(other), column(one)]]
    finding = only(found_in(samples))
    assert finding.kind == "swapped"
    assert {one, other} < set(finding.states)
    assert len(finding.states) == 4
    assert {one, other} <= implicated(found_in(samples, reference_of("lab")))


def test_a_reference_without_usable_healthy_windows_is_an_error() -> None:
    with pytest.raises(EstimationError, match="no healthy window"):
        learn_sensor_reference([])
    with pytest.raises(EstimationError, match="no fluctuation in y1"):
        learn_sensor_reference(windows_of(plan_of("lab"), spoilt("y1", np.zeros_like)))


def test_a_signal_fading_into_sensor_noise_is_no_gain_drift() -> None:
    plan, samples = plan_of("lab"), recorded("lab", 31).copy()
    moving = samples[:, : len(plan.states)]
    mean, rms = moving.mean(axis=0), moving.std(axis=0)
    fades = np.interp(np.arange(len(samples)) / plan.rate_hz, [40.0, 55.0], [1.0, 0.03])[:, np.newaxis]
    noise = 0.02 * rms * np.random.default_rng([31, 8]).standard_normal(moving.shape)
    moving[:] = mean + (moving - mean) * fades + noise
    assert found_in(samples) == found_in(samples, reference_of("lab")) == ()


def test_a_line_that_begins_where_sensors_showed_noise_is_no_gain_drift() -> None:
    """Such as a gear that begins to whine: a displacement hardly shows it, and shows it alone from then on."""
    plan, samples = plan_of("lab"), recorded("lab", 31).copy()
    at_s, omega = np.arange(len(samples)) / plan.rate_hz, 2 * np.pi * 120.0
    for place in ("y1", "z1", "y2", "z2"):
        motion, rate = (plan.states.index(f"{place}{of}") for of in ("", "_dot"))
        size = samples[:, rate].std()
        samples[:, rate] += size * np.cos(omega * at_s) * (at_s > 40.0)
        samples[:, motion] += size / omega * np.sin(omega * at_s) * (at_s > 40.0)
    assert found_in(samples) == found_in(samples, reference_of("lab")) == ()


@pytest.mark.parametrize(("seed", "one_source"), [(5, True), (24, False)])
def test_a_channel_that_becomes_delayed_has_no_gain_error_besides(seed: int, *, one_source: bool) -> None:
    """The mean transfer function of two successive delays is smaller than either's."""
    plan, samples = plan_of("lab"), recorded("lab", seed, one_source=one_source).copy()
    column, late, start = plan.states.index("y2_dot"), round(4e-3 * plan.rate_hz), round(15 * plan.rate_hz)
    samples[start:, column] = samples[start - late : -late, column]
    (finding,) = found_in(samples, reference_of("lab"))
    assert (finding.states, finding.kind) == (("y2_dot",), "delay")


@pytest.mark.parametrize(("state", "from_s", "part"), [("y1", 50.0, 0.5), ("y1_dot", 25.0, 0.5), ("y1", 25.0, 1.0)])
def test_noise_that_begins_in_one_channel_is_no_gain_drift(state: str, from_s: float, part: float) -> None:
    plan, samples = plan_of("lab"), recorded("lab", 31).copy()
    noisy = samples[round(from_s * plan.rate_hz) :, plan.states.index(state)]
    noisy += part * noisy.std() * np.random.default_rng([31, 9]).standard_normal(noisy.size)
    kinds = {finding.kind for finding in found_in(samples, reference_of("lab"))}
    assert kinds <= {"noise", "incoherent"}


def test_an_increase_of_all_vibration_is_no_sensor_fault() -> None:
    samples = of_displacements(recorded("lab", 23))
    samples[70_000:, :4] *= 1.5
    (window,) = windows_of(plan_of("lab", displacements=True), samples)
    assert sensor_findings(window) == ()


@pytest.mark.parametrize(("factor", "told"), [(2.0, "too many pulses"), (0.5, "pulses are missing")])
def test_a_shaft_angle_at_the_wrong_speed_is_named_with_the_pulse_fault(factor: float, told: str) -> None:
    samples = recorded("lab", 1).copy()
    samples[:, -1] = factor * np.unwrap(samples[:, -1]) % (2 * np.pi)
    (finding,) = [one for one in found_in(samples, reference_of("lab")) if one.states == ("theta",)]
    assert told in finding.text


def test_a_1x_that_passes_through_zero_is_no_fault_of_the_angle() -> None:
    """Such as where a bow grows opposite to the unbalance: the 1x vector averages to zero over the window."""
    samples = recorded("lab", 1).copy()
    turns, moving = np.exp(1j * samples[:, -1]), samples[:, :-1]
    grown = np.interp(np.arange(len(samples)) / plan_of("lab").rate_hz, [20.0, 45.0], [0.0, 2.0])
    moving -= np.real(np.outer(grown * turns, 2 * (turns.conj() @ moving) / len(samples)))
    assert "theta" not in implicated(found_in(samples, reference_of("lab")))


def test_cross_talk_from_the_other_plane_is_no_delay() -> None:
    """One force moves both planes, so that cross-talk enters the transfer: two sensors were reported 0.13 ms late."""
    samples, states = recorded("heavy", 1, one_source=True).copy(), plan_of("heavy").states
    for state, other in (("z1_dot", "y1_dot"), ("y2", "z2")):
        samples[:, states.index(state)] += 0.02 * samples[:, states.index(other)]
    (window,) = windows_of(plan_of("heavy"), samples)
    assert sensor_findings(window, None, load_machine("heavy").sensors) == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_narrow_resonance_that_bands_divide_is_no_gain_or_lead(seed: int) -> None:
    """Beside it the window leaks power whose jω is not that of the bin: gains were off by five standard errors."""
    rng, plan, rate_hz = np.random.default_rng(58_100 + seed), plan_of("lab"), load_machine("lab").rate_hz
    size = round((WINDOW_S + MORE_S) * rate_hz)
    f = np.fft.rfftfreq(size, 1 / rate_hz)
    force = np.fft.rfft(rng.standard_normal(size)) / (1 + (f / 30) ** 4)
    modes = ((9.1, 0.01), (9.4, 0.01), (23.0, 0.03))
    y, z, high = (1 / (at**2 - f**2 + 2j * damping * at * f) for at, damping in modes)
    motions = {"y1": y, "z1": z, "y2": y - 5 * high, "z2": 1.5 * z + 4 * high}
    samples = np.zeros((size, len(plan.states) + 1))
    for state, motion in motions.items():
        for derivatives, name in enumerate((state, f"{state}_dot")):
            own = np.fft.irfft((2j * np.pi * f) ** derivatives * motion * force, size)
            samples[:, plan.states.index(name)] = own + 0.002 * own.std() * rng.standard_normal(size)
    samples[:, -1] = 2 * np.pi * 22.0 * np.arange(size) / rate_hz
    (window,) = windows_of(plan, samples)
    pairs = motion_pairs(window.states)
    for one in read_pairs(window, pairs, banded(window, pairs), {}):
        assert abs(one.log_gain) < 4 * one.log_gain_error < 0.05, one.second
        assert (abs(one.delay_s) < 4 * one.delay_error_s, one.lead_rad_s) == (True, 0.0), one.second


@pytest.mark.parametrize(("ppm", "speed"), [(400.0, "slow"), (-400.0, "fast")])
def test_sensors_on_a_drifting_clock_are_reported_with_the_drift(ppm: float, speed: str) -> None:
    samples = recorded("lab", 1).copy()
    at = np.arange(len(samples), dtype=np.float64)
    late = np.minimum(at + np.maximum(0, at - 40_000) * ppm * 1e-6, at[-1])
    disc = ("y2", "z2", "y2_dot", "z2_dot")
    for state in disc:
        samples[:, column(state)] = np.interp(late, at, samples[:, column(state)])
    finding = only(found_in(samples))
    assert (finding.kind, set(finding.states)) == ("delay", set(disc))
    assert finding.text.endswith(f" ppm {speed}")
    assert float(finding.text.split()[-3]) == pytest.approx(abs(ppm), rel=0.15)


def test_a_phase_drift_of_one_plane_is_no_clock_drift() -> None:
    samples = recorded("lab", 1).copy()
    at = np.arange(len(samples), dtype=np.float64)
    for state in ("y1", "y1_dot", "y2", "y2_dot"):  # as where a resonance of one plane passes the speed
        samples[:, column(state)] = np.interp(np.minimum(1.0004 * at, at[-1]), at, samples[:, column(state)])
    assert not any("clock" in finding.text for finding in found_in(samples, reference_of("lab")))
