"""Noise that rises in one sensor is found and attributed to it; a faulty shaft angle is named."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from pydantic import ValidationError

from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.reference import SensorReference, learn_sensor_reference
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import load_machine
from models.signals.block import FloatArray
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault
from simulator.scenario import Event
from tests.diagnosis.sensors.test_gain_jumps import of_rotor
from tests.diagnosis.sensors.test_sensor_checks import (
    DISPLACEMENTS,
    MORE_S,
    WINDOW_S,
    column,
    of_displacements,
    only,
    plan_of,
)
from tests.diagnosis.sensors.test_sensor_checks import recorded as recorded_with
from tests.diagnosis.sensors.test_sensor_checks import windows_of as windows_in
from tests.sure import sure
from tests.windows import healthy_samples, statistics

recorded = partial(recorded_with, noise=0.02, key=6, largest=2.0)


def windows_of(name: str, samples: FloatArray, *, displacements: bool = False) -> list[WindowStatistics]:
    return windows_in(
        plan_of(name, displacements=displacements), of_displacements(samples) if displacements else samples
    )


@cache
def reference_of(name: str, *, displacements: bool = False) -> SensorReference:
    """Learned under one source; the excitation may differ later."""
    samples = recorded(name, 900, 2, one_source=True)
    return learn_sensor_reference(windows_of(name, samples, displacements=displacements))


def found_in(
    samples: FloatArray, *, displacements: bool = False, reference: SensorReference | None = None
) -> tuple[SensorFault, ...]:
    (window,) = windows_of("lab", samples, displacements=displacements)
    reference = reference_of("lab", displacements=displacements) if reference is None else reference
    return sensor_findings(window, reference, load_machine("lab").sensors)


def with_noise(samples: FloatArray, state: str, part: float, seed: int = 0) -> FloatArray:
    noisy, at = samples.copy(), column(state)
    noisy[:, at] += part * samples[:, at].std() * np.random.default_rng(seed).standard_normal(len(samples))
    return noisy


def with_hum(samples: FloatArray, state: str, part: float, line_hz: float = 50.0) -> FloatArray:
    """The samples with a line whose rms is a part of the channel's."""
    humming, at = samples.copy(), column(state)
    t_s = np.arange(len(samples)) / load_machine("lab").rate_hz
    humming[:, at] += part * samples[:, at].std() * np.sqrt(2) * np.sin(2 * np.pi * line_hz * t_s)
    return humming


def in_band(part: float) -> float:
    """The in-band rms of white noise of this size, relative to the rms of channel and noise together."""
    low, high = load_machine("lab").window.band_hz
    return float(part * np.sqrt((high - low) / (load_machine("lab").rate_hz / 2)) / np.hypot(1, part))


@pytest.mark.parametrize("name", ["lab", pytest.param("heavy", marks=pytest.mark.long)])
@pytest.mark.parametrize("displacements", [False, True])
def test_healthy_sensors_are_quiet_under_another_excitation(name: str, displacements: bool) -> None:
    reference = reference_of(name, displacements=displacements)
    for seed, noise in ((911, 0.05), (914, 0.05), (914, 0.01)):
        samples = recorded(name, seed, one_source=seed == 911, noise=noise)
        (window,) = windows_of(name, samples, displacements=displacements)
        assert sensor_findings(window, reference) == ()


@pytest.mark.parametrize(
    ("state", "part", "displacements"),
    [
        *((state, 0.3, False) for state in ("y1", "z2", "z1_dot", "y2_dot")),
        *((state, 0.8, True) for state in ("y2", "z2")),  # without its pair, noise must exceed the vibration
    ],
)
def test_the_noisy_sensor_is_named_with_its_noise(state: str, part: float, displacements: bool) -> None:
    finding = only(found_in(with_noise(recorded("lab", 920), state, part), displacements=displacements))
    assert (finding.kind, finding.states) == ("noise", (state,))
    assert finding.value == pytest.approx(in_band(part), rel=0.3)
    assert sure(finding.z) > 5


@pytest.mark.parametrize("displacements", [False, True])
def test_mains_hum_in_one_channel_is_noise(displacements: bool) -> None:
    finding = only(found_in(with_hum(recorded("lab", 920), "z2", 0.08), displacements=displacements))
    assert (finding.kind, finding.states) == ("noise", ("z2",))
    assert finding.value == pytest.approx(0.08, rel=0.25)
    assert ("50 Hz" in finding.text) == displacements


@pytest.mark.parametrize(("line_hz", "hums"), [(60.0, True), (100.2, True), (3 * 22.0, False), (87.3, False)])
def test_a_line_in_one_sensor_is_noise_only_at_mains_frequencies(line_hz: float, hums: bool) -> None:
    found = found_in(with_hum(recorded("lab", 920), "z2", 0.1, line_hz), displacements=True)
    assert [(one.kind, one.states) for one in found] == ([("noise", ("z2",))] if hums else [])


def test_a_mains_line_in_all_channels_is_no_sensor_noise() -> None:
    samples = recorded("lab", 920).copy()
    t_s = np.arange(len(samples)) / load_machine("lab").rate_hz
    for place, size in zip(DISPLACEMENTS, (0.05, 0.1, 0.15, 0.1), strict=True):
        samples[:, column(place)] += size * samples[:, column(place)].std() * np.sin(2 * np.pi * 50 * t_s)
    assert found_in(samples, displacements=True) == ()


def test_noise_that_rises_in_all_channels_is_no_sensor_fault() -> None:
    samples = recorded("lab", 920)
    assert found_in(with_noise(samples, "y1", 0.04)) == ()  # not worth a finding
    assert only(found_in(with_noise(samples, "y1", 0.25))).kind == "noise"
    for state in plan_of("lab").states:
        samples = with_noise(samples, state, 0.25, seed=column(state))
    assert found_in(samples) == ()


@pytest.mark.parametrize(
    ("seed", "event"),
    [
        (925, Event(at_s=31.0, parameter="k_by", relative_change=-0.25)),
        (925, Event(at_s=31.0, parameter="e", relative_change=1.0)),
        (925, Event(at_s=0.0, parameter="e", relative_change=1.0)),
        (927, Event(at_s=25.0, ramp_s=10.0, speed_rpm=1.03 * load_machine("lab").operation.speed_rpm)),
    ],
)
def test_a_machine_fault_or_speed_change_is_no_sensor_fault(seed: int, event: Event) -> None:
    samples = recorded("lab", seed, events=(event,))
    assert found_in(samples) == found_in(samples, displacements=True) == ()


def test_noise_needs_a_noise_reference_and_older_references_stay_valid() -> None:
    noisy = with_noise(recorded("lab", 920), "y1", 0.2)
    (window,) = windows_of("lab", noisy)
    assert sensor_findings(window) == ()
    content = reference_of("lab").model_dump(mode="json")
    for one in (*content["channels"], *content["pairs"]):
        one.pop("noise", None)
    old = SensorReference.model_validate(content, strict=False)
    assert "noise" not in old.model_dump_json()
    assert found_in(noisy, reference=old) == ()
    assert found_in(noisy)[0].kind == "noise"


def test_a_reference_round_trips_and_is_validated() -> None:
    reference = reference_of("lab")
    assert SensorReference.model_validate_json(reference.model_dump_json()) == reference
    assert all(pair.noise is not None for pair in reference.pairs)
    assert all(channel.noise is not None for channel in reference_of("lab", displacements=True).channels)
    content = reference.model_dump(mode="json")
    first, *others = content["pairs"]
    shorter = first["noise"] | {"share": first["noise"]["share"][1:]}
    for damage, says in (
        ({"noise": shorter}, "density holds 24 bands and share 23"),
        ({"second": "x9"}, "x9 not among channels"),
    ):
        with pytest.raises(ValidationError, match=says):
            SensorReference.model_validate(content | {"pairs": [first | damage, *others]}, strict=False)


def jumped(theta: FloatArray) -> FloatArray:
    return theta + np.where(np.arange(theta.size) > 0.55 * theta.size, np.pi / 2, 0.0)


def lost_a_turn(theta: FloatArray) -> FloatArray:
    """One missing pulse: for two turns the angle goes at half speed."""
    first, turn = theta.size // 3, round(2 * np.pi * theta.size / (theta[-1] - theta[0]))
    late = np.clip((np.arange(theta.size) - first) / (2 * turn), 0, 1)
    return np.asarray(theta - 2 * np.pi * late)


def jittering(theta: FloatArray) -> FloatArray:
    return np.asarray(theta + 0.8 * np.random.default_rng(1).standard_normal(theta.size))


@pytest.mark.parametrize(
    ("spoilt", "kind", "value", "displacements"),
    [
        (jumped, "offset", np.pi / 2, False), (jumped, "offset", np.pi / 2, True),
        (lost_a_turn, "incoherent", 1.0, False), (lambda theta: 1.001 * theta, "incoherent", 1.001, True),
        (lambda theta: 0.8 * theta, "incoherent", 0.8, False),
        (jittering, "noise", 0.8, False), (jittering, "noise", 0.8, True),
    ],
)  # fmt: skip
def test_a_faulty_shaft_angle_is_named(
    spoilt: Callable[[FloatArray], FloatArray], kind: str, value: float, displacements: bool
) -> None:
    samples = recorded("lab", 920).copy()
    samples[:, -1] = np.mod(spoilt(np.unwrap(samples[:, -1])), 2 * np.pi)
    finding = only(found_in(samples, displacements=displacements))
    assert (finding.kind, finding.states) == (kind, ("theta",))
    assert finding.value == pytest.approx(value, rel=0.15)


def test_a_heavy_spot_that_turns_is_no_fault_of_the_angle() -> None:
    """The 1x vectors turn as when the angle jumps, but the angle is continuous; over a gap this is unknown."""
    samples = recorded("lab", 921).copy()
    n, theta, after = samples.shape[1] - 1, samples[:, -1], round(0.55 * len(samples))
    turning = np.stack([np.cos(theta), np.sin(theta)], axis=1)
    cosine, sine = np.linalg.lstsq(turning, samples[:, :n], rcond=None)[0]
    elsewhere = np.stack([sine - cosine, -sine - cosine])  # a quarter of a turn on, less what was there
    samples[after:, :n] += turning[after:] @ elsewhere
    assert found_in(samples) == ()
    (window,) = windows_of("lab", samples)
    unknown = replace(window, hop_jump_rad=np.full(window.hop_jump_rad.size, np.nan))
    finding = only(sensor_findings(unknown))
    assert (finding.kind, finding.states) == ("offset", ("theta",))


@pytest.mark.parametrize("part", [0.1, 0.5, 0.7])
def test_reversed_signs_of_all_sensors_are_found_while_the_window_holds_both(part: float) -> None:
    samples = recorded("lab", 921).copy()
    samples[round(part * len(samples)) :, :-1] *= -1
    (finding,) = [one for one in found_in(samples) if one.states == ("theta",)]
    assert finding.kind == "offset"
    assert finding.value == pytest.approx(np.pi)
    assert "the signs of all sensors were reversed" in finding.text


def test_a_small_jump_of_the_angle_is_found_in_loud_vibration() -> None:
    samples, machine = recorded("lab", 922).copy(), load_machine("lab")
    shaking = np.fft.rfft(np.random.default_rng(923).standard_normal(samples[:, :-1].shape), axis=0)
    f = np.fft.rfftfreq(len(samples), 1 / machine.rate_hz)
    shaking[np.abs(f - machine.operation.speed_rpm / 60) > 1] = 0
    noise, after = np.fft.irfft(shaking, len(samples), axis=0), round(0.55 * len(samples))
    samples[:, :-1] += 0.7 * samples[:, :-1].std(axis=0) * noise / noise.std()
    samples[after:, -1] = np.mod(samples[after:, -1] + 0.4, 2 * np.pi)
    (window,) = windows_of("lab", samples)
    (finding,) = [one for one in sensor_findings(window) if one.states == ("theta",)]
    assert finding.value == pytest.approx(0.4, abs=1e-3)


@pytest.mark.parametrize(
    ("wanders", "resonance", "damping"), [(0.0, 1.0, 0.002), (0.0, 1.01, 0.01), (0.01, 1.0, 0.01), (0.01, 1.2, 0.002)]
)
def test_a_resonance_near_the_speed_is_no_fault_of_the_angle(wanders: float, resonance: float, damping: float) -> None:
    rng, plan = np.random.default_rng([60120, round(1e4 * damping), round(100 * resonance)]), plan_of("lab")
    plan = replace(plan, states=("y1",), columns=plan.columns[:1], scales=plan.scales[:1])
    machine = load_machine("lab")
    t_s = np.arange(round((WINDOW_S + MORE_S) * machine.rate_hz)) / machine.rate_hz
    speed_hz = machine.operation.speed_rpm / 60
    knots_s = np.arange(0.0, t_s[-1] + 8.0, 4.0)
    turning_hz = speed_hz * (1 + wanders * np.interp(t_s, knots_s, rng.standard_normal(knots_s.size)))
    theta = 2 * np.pi * np.cumsum(turning_hz) / machine.rate_hz
    f, own_hz = np.fft.rfftfreq(t_s.size, 1 / machine.rate_hz), resonance * speed_hz
    force = np.fft.rfft(rng.standard_normal(t_s.size))
    shaken = np.fft.irfft(force / (own_hz**2 - f**2 + 2j * damping * own_hz * f), t_s.size)
    motion = 1e-4 * (np.cos(theta) + shaken / shaken.std() / np.sqrt(2))
    (window,) = windows_in(plan, np.stack([motion, np.mod(theta, 2 * np.pi)], axis=1))
    assert window.removed_by_hop == (wanders > 0)
    assert sensor_findings(window) == ()


def test_a_1x_that_moves_beside_low_resonances_is_no_gain_drift() -> None:
    """It leaks into bins half a hertz off, a twentieth of its frequency; a true drift is still found."""
    soft = {"k_by_N_per_m": 6e3, "k_bz_N_per_m": 7e3, "shaft_E_Pa": 2.6e10, "e_m": 4e-4}
    machine = of_rotor(2000.0, 490.0, **soft)
    samples = healthy_samples(machine, 63.0, 3224001, Event(at_s=30.0, ramp_s=5.0, speed_rpm=539.0))
    assert sensor_findings(statistics(machine, samples)) == ()
    samples[100_000:, 6] *= 1.05
    (finding,) = sensor_findings(statistics(machine, samples))
    assert (finding.kind, finding.states) == (FaultKind.GAIN, ("y2", "y2_dot"))


def test_a_1x_that_shrinks_as_the_shaft_leaves_a_resonance_is_no_fault_of_the_angle() -> None:
    """Its line at the earlier speed is not that of another shaft."""
    plan, rng = plan_of("lab"), np.random.default_rng(3224002)
    plan = replace(plan, states=("y1",), columns=plan.columns[:1], scales=plan.scales[:1])
    t_s = np.arange(round((WINDOW_S + MORE_S) * plan.rate_hz)) / plan.rate_hz
    noise = 2e-6 * rng.standard_normal(t_s.size)

    def turning(hz: FloatArray, size: FloatArray) -> WindowStatistics:
        theta = 2 * np.pi * np.cumsum(hz) / plan.rate_hz
        (window,) = windows_in(plan, np.stack([1e-4 * size * np.cos(theta) + noise, np.mod(theta, 2 * np.pi)], axis=1))
        return window

    steady = turning(np.full(t_s.size, 22.0), np.ones(t_s.size))
    slower = turning(np.interp(t_s, [17.5, 17.6], [22.0, 21.9]), np.interp(t_s, [17.5, 17.6], [1.0, 0.02]))
    assert sensor_findings(slower, learn_sensor_reference([steady])) == ()
