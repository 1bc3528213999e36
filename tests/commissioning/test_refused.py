"""Recordings that are not fit: refused or limited, with a sentence that says what to record instead."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from models.commissioning.checks import check_agreement, check_lines, check_shapes, check_speed_given
from models.commissioning.commission import Commissioning
from models.diagnosis.misfit import AlternativeTest, Goodness
from models.diagnosis.readings import Diagnosis, UnbalanceVector, parameter_reading
from models.diagnosis.shape import HealthyShape, ShapeSpread
from models.machine import MachineFile, Operation
from models.signals.block import SampleBlock
from simulator.scenario import Event
from tests.commissioning.rotor_kit import (
    LAB,
    NOTHING,
    PARTIAL,
    commissioned,
    healthy,
    humming,
    recording,
    samples_of,
    stream,
    windows_of,
    with_samples,
)
from tests.sure import sure

HEALTHY_S = 80.0


def verdict_of(made: Commissioning, check: str) -> tuple[str, str, str]:
    """Verdict, text and advice of one check."""
    found = next(one for one in made.report.checks if one.name == check)
    return found.verdict, found.text, found.advice


def made_of(blocks: Sequence[SampleBlock], machine: MachineFile = NOTHING) -> Commissioning:
    return commissioned(machine, recording(machine, blocks))


def refused(made: Commissioning) -> bool:
    return made.commissioned is None and made.report.verdict == "refused"


def test_too_short() -> None:
    made = made_of(stream(30.0, 51))
    assert refused(made)
    assert verdict_of(made, "enough data")[1].startswith("too short: 25 s of usable data in one recording")
    assert "record at least 360 s without interruption" in made.report.summary


def test_full_of_gaps() -> None:
    kept = [block for number, block in enumerate(stream(HEALTHY_S, 52)) if number % 200 < 130]
    made = made_of(kept)
    assert refused(made)
    _, text, advice = verdict_of(made, "enough data")
    assert text.startswith("too many gaps:")
    assert advice.startswith("find out why 3")


@pytest.mark.slow
def test_a_few_gaps_are_told_and_cost_their_hops() -> None:
    kept = [block for number, block in enumerate(stream(HEALTHY_S, 52)) if number != 700]
    made = made_of(kept)
    assert not refused(made)
    assert "one gap of 0.1 s" in verdict_of(made, "enough data")[1]


def test_clipped() -> None:
    blocks = stream(HEALTHY_S, 52)
    samples = samples_of(blocks)
    limit = 1.5 * samples[:, 0].std()
    samples[:, 0] = np.clip(samples[:, 0], -limit, limit)
    made = made_of(with_samples(blocks, samples))
    assert refused(made)
    _, text, advice = verdict_of(made, "sensors")
    assert "y1" in text
    assert "cut off at" in text
    assert "record again" in advice


@pytest.mark.parametrize(("bits", "limit", "verdict"), [(16, 2.8, "limited"), (16, 5.0, "passed"), (8, 5.0, "passed")])
def test_a_channel_that_reaches_the_end_of_its_range_is_told(bits: int, limit: float, verdict: str) -> None:
    blocks = stream(HEALTHY_S, 52)
    samples = samples_of(blocks)
    end = limit * samples[:, 0].std()
    step = end / 2 ** (bits - 1)
    samples[:, 0] = np.clip(np.round(samples[:, 0] / step) * step, -end, end)
    found, text, _ = verdict_of(made_of(with_samples(blocks, samples)), "sensors")
    assert found == verdict
    assert ("y1 is at exactly" in text) == (verdict == "limited")


def displacements(exchanged: tuple[str, str] | None = None, sign: str = "") -> Commissioning:
    """The rotor kit with one sensor per motion, two of them exchanged or one with the wrong sign."""
    columns = [number for number, channel in enumerate(NOTHING.sensors) if channel.quantity != "velocity"]
    machine = NOTHING.model_copy(update={"sensors": tuple(NOTHING.sensors[number] for number in columns)})
    names = [channel.name for channel in machine.sensors]
    blocks = [replace(block, samples=block.samples[:, columns]) for block in stream(150.0, 58)]
    samples = samples_of(blocks)
    if exchanged is not None:
        first, second = (names.index(name) for name in exchanged)
        samples[:, [first, second]] = samples[:, [second, first]]
    if sign:
        samples[:, names.index(sign)] *= -1
    return made_of(with_samples(blocks, samples), machine)


@pytest.mark.parametrize("place", ["1", "2"])
def test_planes_that_are_exchanged_at_one_place(place: str) -> None:
    made = displacements((f"y{place}", f"z{place}"))
    assert refused(made)
    _, text, _ = verdict_of(made, "sensors")
    assert "y1 and z1 are swapped, or y2 and z2: bearing and disc move together across the planes" in text
    assert verdict_of(displacements(), "sensors")[0] == "passed"


@pytest.mark.parametrize(("exchanged", "sign"), [(("y1", "y2"), ""), (None, "y2")])
def test_bearing_and_disc_exchanged_or_of_opposite_sign(exchanged: tuple[str, str] | None, sign: str) -> None:
    made = displacements(exchanged, sign)
    assert refused(made)
    for advised in ("sensors of bearing and disc are not exchanged, that none has the wrong sign", "state delay_us"):
        assert advised in made.report.summary


def test_a_stuck_channel() -> None:
    blocks = stream(HEALTHY_S, 52)
    samples = samples_of(blocks)
    samples[80_000:, 4] = samples[80_000, 4]
    made = made_of(with_samples(blocks, samples))
    assert refused(made)
    assert verdict_of(made, "sensors")[0] == "refused"
    assert "of y2 in the second half is 0 times that of the first" in verdict_of(made, "stationary")[1]


@pytest.mark.slow
def test_speed_that_runs_away() -> None:
    made = made_of(stream(70.0, 53, Event(at_s=0.0, ramp_s=70.0, speed_rpm=2 * LAB.operation.speed_rpm)))
    assert refused(made)
    _, text, advice = verdict_of(made, "stationary")
    assert "the speed goes from" in text
    assert "one file for each speed" in advice


def test_an_angle_that_falls() -> None:
    blocks = stream(HEALTHY_S, 52)
    samples = samples_of(blocks)
    samples[:, -1] = -samples[:, -1] % (2 * np.pi)
    made = made_of(with_samples(blocks, samples))
    assert refused(made)
    _, text, advice = verdict_of(made, "stationary")
    assert text.endswith("the shaft angle falls, expected to grow from 0 to 2π in every turn")
    assert advice.startswith("send 2π minus the angle")


def test_vibration_that_grows() -> None:
    made = made_of(stream(70.0, 54, Event(at_s=35.0, excitation_level=4.0)))
    assert refused(made)
    assert "in the second half is" in verdict_of(made, "stationary")[1]


@pytest.mark.slow
def test_a_machine_that_changed_meanwhile() -> None:
    made = made_of(stream(90.0, 55, Event(at_s=45.0, parameter="k_by", relative_change=-0.3)))
    assert refused(made)
    _, text, _ = verdict_of(made, "halves agree")
    assert text.startswith("bearing stiffness, horizontal differs between the halves")


def test_another_machine_that_hums() -> None:
    disturbed = humming(stream(HEALTHY_S, 56), 48.6, bearing_m=20e-6)
    verdict, text, advice = verdict_of(made_of(disturbed), "second excitation")
    assert verdict in {"limited", "refused"}
    assert "a steady line at 48.60 Hz" in text
    assert "neighbouring machine" in advice
    sensors = tuple(one.model_copy(update={"name": f"XE-{one.name}"}) for one in NOTHING.sensors)
    named = check_lines(NOTHING.model_copy(update={"sensors": sensors}), [recording(NOTHING, disturbed)]).text
    assert "of the random vibration of XE-" in named


@pytest.mark.slow
def test_a_healthy_recording_has_no_foreign_line() -> None:
    """Which the check says of the recording before anything is learned from it."""
    for seed in (52, 58):
        assert check_lines(NOTHING, [recording(NOTHING, stream(HEALTHY_S, seed))]).verdict == "passed"


def test_a_file_that_describes_another_machine() -> None:
    softer = LAB.model_copy(update={"rotor": LAB.rotor.model_copy(update={"k_by_N_per_m": 4.4e4})})
    made = commissioned(softer, healthy(softer, HEALTHY_S, 52))
    assert refused(made)
    _, text, advice = verdict_of(made, "agrees with the parameters in the machine file")
    assert text.startswith("bearing stiffness, horizontal differs between the healthy data and the parameters")
    assert "leave out of [rotor]" in advice


@pytest.mark.parametrize(
    ("off", "limit", "verdict"), [(-0.003, 0.1, "passed"), (0.04, 0.1, "refused"), (0.04, 0.2, "passed")]
)
def test_a_difference_far_below_the_alarm_limit_is_no_reason_to_refuse(off: float, limit: float, verdict: str) -> None:
    """However many standard errors it is: one force that moves everything makes them as small as that."""
    limits = LAB.alarms.limits.model_copy(update={"raise_above": limit})
    machine = LAB.model_copy(update={"alarms": LAB.alarms.model_copy(update={"parameters": {"k_by": limits}})})
    read = tuple(
        parameter_reading(name, "likelihood", off if name == "k_by" else 0.0, 3e-4) for name in ("k_by", "c_by", "k_bz")
    )
    check = check_agreement(machine, [Diagnosis("likelihood", read, misfit_z=0.0)] * 6, "the parameters in the file")
    assert check.verdict == verdict
    if verdict == "passed":
        assert "no difference that matters between the healthy data and the parameters in the file" in check.text
        assert check.text.endswith(f"bearing stiffness, horizontal by {off:+.1%} at most")


@pytest.mark.slow
def test_sensors_that_allow_no_equation_are_limited_to_changed_or_not() -> None:
    bearing = tuple(channel for channel in NOTHING.sensors if channel.location != "disc")
    machine = NOTHING.model_copy(update={"sensors": bearing})
    columns = [n for n, channel in enumerate(NOTHING.sensors) if channel.location != "disc"]
    blocks = [replace(block, samples=block.samples[:, columns]) for block in stream(250.0, 60)]
    made = made_of(blocks, machine)
    verdict, text, advice = verdict_of(made, "equations")
    assert verdict == "limited"
    assert "changed or not changed" in text
    assert "at the disc" in advice
    assert made.commissioned is not None
    assert not made.commissioned.baselines
    assert made.commissioned.shape is not None
    assert not any(row.used for row in made.report.equations)
    short = made_of(blocks[:1000], machine)
    assert refused(short)


def test_a_window_that_no_relation_can_be_read_in_is_a_matter_of_the_machine_file() -> None:
    window = NOTHING.window.model_copy(update={"lag_step_s": 0.0025})
    made = made_of(stream(HEALTHY_S, 52), NOTHING.model_copy(update={"window": window}))
    assert refused(made)
    _, text, advice = verdict_of(made, "window settings")
    assert "lags are 2.5 ms apart" in text
    assert "change lag_step_s" in advice


@pytest.mark.slow
def test_a_rate_too_low_for_relations_leaves_the_shapes_of_the_channels() -> None:
    fields = NOTHING.model_dump(exclude={"window"}) | {"rate_hz": 500.0}
    machine = MachineFile.model_validate(fields)
    blocks = [replace(b, rate_hz=500.0, samples=b.samples[::4]) for b in stream(250.0, 60)]
    made = made_of(blocks, machine)
    verdict, text, advice = verdict_of(made, "equations")
    assert verdict == "limited"
    assert text.startswith("a sampling rate of 500 Hz allows no equation: each channel is at most called changed")
    assert advice == "sample at 794 Hz or faster"
    assert made.commissioned is not None
    assert made.commissioned.shape is not None


def test_the_usual_lag_spacing_fits_every_rate() -> None:
    fields = NOTHING.model_dump(exclude={"window"}) | {"rate_hz": 2560.0}
    machine = MachineFile.model_validate(fields)
    assert machine.window.lag_step_s == 3 / 2560
    assert MachineFile.model_validate(machine.model_dump()).window == machine.window
    assert MachineFile.model_validate(fields | {"rate_hz": 4000.0}).window.lag_step_s == 0.001


def _shaped(count: int, varies: float = 1.0) -> HealthyShape:
    """Shapes of two channels whose windows scatter."""
    lags = np.arange(20) * 1e-3
    mean = np.exp(-lags / 5e-3) * np.cos(2 * np.pi * 40 * lags)
    channels = [
        ShapeSpread(
            channel=name,
            mean=tuple(mean.tolist()),
            directions=(tuple(np.r_[0.0, np.full(19, 1.0)].tolist()),),
            variance=variance * varies,
            freedom=1.0,
        )
        for name, variance in (("y1", 1e-3), ("z1", 0.02))
    ]
    return HealthyShape(
        windows=count, window_s=60.0, lags_s=tuple(lags.tolist()), speed_rad_s=None, channels=tuple(channels)
    )


@pytest.mark.parametrize(
    ("count", "varies", "verdict"),
    [(30, 1.0, "passed"), (6, 1.0, "limited"), (4, 1.0, "refused"), (4, 20.0, "refused"), (90, 1e6, "limited")],
)
def test_shapes_without_power_are_no_commissioning(count: int, varies: float, verdict: str) -> None:
    shape = _shaped(count, varies)
    powers = shape.powers(3e-6)
    check = check_shapes(NOTHING, powers, count)
    assert check.verdict == verdict
    blind = [name for name, one in powers.items() if one.growth > 8]
    assert ("not even noise that makes" in check.text) == bool(blind)
    if verdict == "refused":
        (wanted,) = re.findall(r"record about (\d+) windows", check.advice)
        assert int(wanted) > count
        then = _shaped(int(wanted), varies).powers(3e-6)
        assert all(then[name].growth <= 8 for name, one in powers.items() if one.windows is not None)
    if verdict == "limited" and varies > 1:
        assert "limits for the levels yourself" in check.advice


@pytest.mark.slow
def test_a_machine_that_is_no_such_rotor_is_told_the_cure() -> None:
    masses = {"m1_kg": 1.5 * LAB.rotor.m1_kg, "m2_kg": 0.7 * LAB.rotor.m2_kg}
    wrong = PARTIAL.model_copy(update={"rotor": sure(PARTIAL.rotor).model_copy(update=masses)})
    made = commissioned(wrong, healthy(wrong, 45.0, 43))
    assert refused(made)
    assert "leave [rotor] out of the machine file" in verdict_of(made, "can be learned")[2]


@pytest.mark.parametrize(
    ("rpm", "given", "refused"),
    [
        (3600, None, False),
        (6600, None, True),
        (6600, Operation(speed_rpm=3000), True),
        (6600, Operation(speed_rpm=6600), False),
        (6600, Operation(speed_rpm=4500, speed_tolerance=0.6), False),  # of a drive with variable speed
    ],
)
def test_a_fast_machine_has_to_say_so(rpm: float, given: Operation | None, refused: bool) -> None:
    machine = NOTHING.model_copy(update={"operation": given})
    windows = [replace(window, speed_rad_s=rpm * np.pi / 30) for window in windows_of(healthy(NOTHING, HEALTHY_S, 55))]
    found = check_speed_given(machine, windows)
    assert (found is not None) == refused
    if found is not None:
        assert found.verdict == "refused"
        assert found.text == "the shaft turns at 6600 rpm, and the windows are those of a slower machine"
        assert "give speed_rpm = 6600 in [operation]" in found.advice
    assert check_speed_given(LAB, windows) is None  # its natural frequencies are known


@pytest.mark.parametrize(("turned_rad", "verdict"), [(0.02, "passed"), (0.2, "refused")])
def test_an_unbalance_that_is_elsewhere_differs_by_its_vector(turned_rad: float, verdict: str) -> None:
    vector = UnbalanceVector(np.cos(turned_rad), np.sin(turned_rad), 1e-7, 0.0, 1e-7)
    change = vector.change if vector.turned else vector.magnitude_change
    read = (parameter_reading("e", "likelihood", change, 3e-4, vector),)
    diagnoses = [Diagnosis("likelihood", read, misfit_z=0.0, unbalance=vector)] * 6
    assert check_agreement(LAB, diagnoses, "the parameters in the file").verdict == verdict


@pytest.mark.parametrize(
    ("tried", "change", "verdict"),
    [
        ("share of z1 in y1", 0.02, "limited"), ("share of z1 in y1", 0.06, "refused"),
        ("delay of y1", 4e-5, "limited"), ("delay of y1", 3e-4, "refused"), ("mass of the disc", 0.02, "refused"),
    ],
)  # fmt: skip
def test_a_sensor_that_is_a_degree_off_its_axis_or_a_little_late_makes_no_other_machine(
    tried: str, change: float, verdict: str
) -> None:
    read = (parameter_reading("k_by", "likelihood", 0.0, 3e-4),)
    goodness = Goodness(3.0, (AlternativeTest(tried, 12.0, change),), 2)
    one = Diagnosis("likelihood", read, misfit_z=goodness.misfit_z, goodness=goodness, suspect=goodness.suspect)
    check = check_agreement(LAB, [one] * 6, "the parameters in the file")
    assert check.verdict == verdict
    assert check.text.endswith(f"; best explained by: {tried}, in 6 of them")
