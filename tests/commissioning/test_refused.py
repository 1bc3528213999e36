"""Recordings that are not fit: refused or limited, with a sentence that says what to record instead."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from models.commissioning.checks import (
    check_agreement,
    check_data,
    check_lines,
    check_sensors_of,
    check_shapes,
    check_speed_given,
    check_speed_range,
)
from models.commissioning.commission import Commissioning
from models.commissioning.commissioned import install
from models.commissioning.healthy import HealthyRecording
from models.diagnosis.misfit import AlternativeTest, Goodness
from models.diagnosis.readings import Diagnosis, UnbalanceVector, parameter_reading
from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.disagreement import crossed_planes
from models.diagnosis.sensors.reference import Naming
from models.diagnosis.shape import HealthyShape
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import BundleError
from models.machine import MachineFile, Operation
from models.signals.block import FloatArray, SampleBlock
from simulator.scenario import Event
from tests.commissioning.rotor_kit import (
    LAB,
    NOTHING,
    PARTIAL,
    blind,
    commissioned,
    healthy,
    humming,
    no_velocity,
    recording,
    samples_of,
    stream,
    told_of,
    windows_of,
    with_samples,
    with_sensors,
    without_angle,
)
from tests.sure import sure

HEALTHY_S = 80.0


def made_of(blocks: Sequence[SampleBlock], machine: MachineFile = NOTHING) -> Commissioning:
    return commissioned(machine, recording(machine, blocks))


def spoilt(change: Callable[[FloatArray], object]) -> list[SampleBlock]:
    """A recording whose samples `change` alters in place."""
    blocks = stream(HEALTHY_S, 52)
    samples = samples_of(blocks)
    change(samples)
    return with_samples(blocks, samples)


def clipped(samples: FloatArray) -> None:
    limit = 1.5 * samples[:, 0].std()
    samples[:, 0] = np.clip(samples[:, 0], -limit, limit)


def stuck(samples: FloatArray) -> None:
    samples[80_000:, 4] = samples[80_000, 4]


def turning_back(samples: FloatArray) -> None:
    samples[:, -1] = -samples[:, -1] % (2 * np.pi)


def of_displacements(order: Sequence[str], sign: str = "") -> Commissioning:
    """The rotor kit with one sensor per motion, columns in another order than stated, or one with the wrong sign."""
    machine, blocks = with_sensors(NOTHING, stream(HEALTHY_S, 58), no_velocity)
    names = [sensor.name for sensor in machine.sensors]
    samples = samples_of(blocks)[:, [names.index(name) for name in order]]
    if sign:
        samples[:, names.index(sign)] *= -1
    return made_of(with_samples(blocks, samples), machine)


def no_such_rotor() -> Commissioning:
    """With stiffness and damping known, there is one first guess, which the masses put too far off."""
    given = LAB.rotor.model_dump(include={"k_by_N_per_m", "k_bz_N_per_m", "c_by_N_s_per_m", "c_bz_N_s_per_m"})
    given |= {"m1_kg": 8 * LAB.rotor.m1_kg, "m2_kg": 8 * LAB.rotor.m2_kg}
    wrong = PARTIAL.model_copy(update={"rotor": sure(PARTIAL.rotor).model_copy(update=given)})
    machine, blocks = with_sensors(wrong, stream(45.0, 43), lambda sensor: sensor.direction != "z")
    return made_of(blocks, machine)


RUNNING_AWAY = Event(at_s=30.0, ramp_s=10.0, speed_rpm=2 * LAB.operation.speed_rpm)
SOFTENING = Event(at_s=45.0, parameter="k_by", relative_change=-0.3)
SOFTER = LAB.model_copy(update={"rotor": LAB.rotor.model_copy(update={"k_by_N_per_m": 4.4e4})})
THICK = LAB.model_copy(update={"rotor": LAB.rotor.model_copy(update={"shaft_diameter_m": 0.03})})
PER_MM = LAB.model_copy(update={"rotor": LAB.rotor.model_copy(update={"k_by_N_per_m": 50.0, "k_bz_N_per_m": 60.0})})
COARSE = NOTHING.model_copy(update={"window": NOTHING.window.model_copy(update={"lag_step_s": 0.0025})})
SWAPPED = "refused: .*y1 and z1 are swapped, or y2 and z2: bearing and disc move together across the planes"
NO_RELATION = "sensors of bearing and disc are not exchanged, that none has the wrong sign.* state delay_us"


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: made_of(stream(30.0, 51)), {
            "enough data": "refused: too short: 25 s of usable data in one recording.*; record at least 360 s",
        }),
        (lambda: made_of([one for at, one in enumerate(stream(HEALTHY_S, 52)) if at % 200 < 130]), {
            "enough data": "refused: too many gaps:.*; find out why 3",
        }),
        (lambda: made_of(spoilt(clipped)), {"sensors": "refused: .*y1.*cut off at.*; .*record again"}),
        (lambda: made_of(spoilt(stuck)), {
            "sensors": "refused", "stationary": "of y2 in the second half is 0 times that of the first",
        }),
        (lambda: made_of(spoilt(turning_back)), {
            "stationary": "the shaft angle falls, expected to grow from 0 to 2π in every turn; send 2π minus the angle",
        }),
        pytest.param(lambda: made_of(stream(70.0, 53, RUNNING_AWAY)), {
            "stationary": "the speed goes from.*; .*one file for each speed",
        }, marks=pytest.mark.slow),
        (lambda: made_of(stream(70.0, 54, Event(at_s=35.0, excitation_level=4.0))), {
            "stationary": "in the second half is",
        }),
        pytest.param(lambda: made_of(stream(90.0, 55, SOFTENING)), {
            "halves agree": "refused: bearing stiffness, horizontal differs between the halves",
        }, marks=pytest.mark.slow),
        (lambda: made_of(stream(45.0, 43), SOFTER), {
            "agrees with the parameters in the machine file":
                "refused: bearing stiffness, horizontal differs between the healthy data and the parameters"
                r".*; .*leave out of \[rotor\]",
        }),
        (lambda: made_of(stream(HEALTHY_S, 52), COARSE), {
            "window settings": "refused: .*lags are 2.5 ms apart.*; .*change lag_step_s",
        }),
        (no_such_rotor, {"can be learned": r"refused: .*; .*leave \[rotor\] out of the machine file"}),
        (lambda: made_of(stream(45.0, 43), THICK), {"can be learned": r"refused: .*; .*leave \[rotor\] out of the"}),
        (lambda: made_of(stream(45.0, 43), PER_MM), {
            "values in the machine file":
                r"refused: .*k_by_N_per_m 4.*e\+04 instead of 50, k_bz_N_per_m .*e\+04 instead of 60.*wrong unit",
        }),
        (lambda: of_displacements(("z1", "y1", "y2", "z2", "theta")), {"sensors": SWAPPED}),
        (lambda: of_displacements(("y1", "z1", "z2", "y2", "theta")), {"sensors": SWAPPED}),
        pytest.param(
            lambda: of_displacements(("y2", "z1", "y1", "z2", "theta")), {"": NO_RELATION}, marks=pytest.mark.long
        ),
        (lambda: of_displacements(("y1", "z1", "y2", "z2", "theta"), sign="y2"), {"": NO_RELATION}),
    ],
    ids=[
        *("too short", "gaps", "clipped", "stuck", "angle that falls", "speed runs away", "grows", "changed meanwhile"),
        *("another machine", "window", "no such rotor", "nor by its file", "another unit"),
        *("swapped at 1", "swapped at 2", "exchanged", "wrong sign"),
    ],
)  # fmt: skip
def test_an_unfit_recording_is_refused_with_advice(make: Callable[[], Commissioning], told: dict[str, str]) -> None:
    """Texts expected of each check by name; an empty name stands for the summary."""
    made = make()
    assert made.commissioned is None
    assert made.report.verdict == "refused"
    said = {one.name: f"{one.verdict}: {one.text}; {one.advice}" for one in made.report.checks}
    for check, words in told.items():
        assert re.search(words, said[check] if check else made.report.summary)


@pytest.mark.parametrize("machine", [LAB, PARTIAL])
def test_a_monitor_says_that_a_commissioning_was_refused(tmp_path: Path, machine: MachineFile) -> None:
    (tmp_path / "report.json").touch()
    with pytest.raises(BundleError, match=r"this commissioning was refused; .*report\.html says why"):
        install(machine, tmp_path)


@pytest.mark.parametrize(("hops", "verdict"), [(71, "passed"), (70, "limited")])
def test_six_windows_less_the_hop_that_fills_the_lags_are_enough_data(hops: int, verdict: str) -> None:
    one = recording(NOTHING, stream(60.0, 51))
    assert len(one.hops) == 11
    check = check_data(NOTHING, [replace(one, stretches=((one.hops * 7)[:hops],))])
    assert check.verdict == verdict


def test_the_advice_for_blocks_of_another_schema_is_to_import_again() -> None:
    check = check_data(
        NOTHING, [HealthyRecording("monday.mcap", plan_for(NOTHING), (), 0, 0.0, (("schema", 9),), "hash")]
    )
    assert check.advice.startswith("import again if the channels of the machine file have changed since, or record")


def test_one_sensor_for_each_motion_is_enough() -> None:
    machine, blocks = with_sensors(NOTHING, stream(HEALTHY_S, 58), no_velocity)
    for window in windows_of(recording(machine, blocks)):
        assert not sensor_findings(window, None, machine.sensors)
        assert not crossed_planes(window, Naming(machine.sensors))


@pytest.mark.parametrize(("bits", "limit", "verdict"), [(16, 2.8, "limited"), (16, 5.0, "passed"), (8, 5.0, "passed")])
def test_a_channel_at_the_end_of_its_range_is_reported(bits: int, limit: float, verdict: str) -> None:
    def converted(samples: FloatArray) -> None:
        end = limit * samples[:, 0].std()
        step = end / 2 ** (bits - 1)
        samples[:, 0] = np.clip(np.round(samples[:, 0] / step) * step, -end, end)

    check = check_sensors_of(NOTHING, {}, {"healthy.mcap": windows_of(recording(NOTHING, spoilt(converted)))})
    assert check.verdict == verdict
    assert ("y1 is at exactly" in check.text) == (verdict == "limited")


def test_a_line_from_a_neighbouring_machine_is_named() -> None:
    disturbed = humming(stream(HEALTHY_S, 56), 48.6, bearing_m=20e-6)
    verdict, text, advice = told_of(made_of(disturbed), "second excitation")
    assert verdict in {"limited", "refused"}
    assert "a steady line at 48.60 Hz" in text
    assert "neighbouring machine" in advice
    sensors = tuple(one.model_copy(update={"name": f"XE-{one.name}"}) for one in NOTHING.sensors)
    named = check_lines(NOTHING.model_copy(update={"sensors": sensors}), [recording(NOTHING, disturbed)]).text
    assert "of the random vibration of XE-" in named


@pytest.mark.parametrize(
    ("speed_rpm", "cure"), [(None, "give speed_rpm in [operation], or measure"), (2000.0, "measure"), (1320.0, None)]
)
def test_without_a_shaft_angle_a_line_near_the_stated_speed_may_be_the_rotation(
    speed_rpm: float | None, cure: str | None
) -> None:
    """At 2000 rpm, which may be off by half, it may as well be the line that is not taken for the rotation."""
    tolerance = 0.5 if speed_rpm == 2000.0 else 0.1
    given = None if speed_rpm is None else Operation(speed_rpm=speed_rpm, speed_tolerance=tolerance)
    machine = blind(PARTIAL).model_copy(update={"operation": given})
    made = recording(machine, without_angle(humming(stream(HEALTHY_S, 56), 48.6, bearing_m=20e-6)))
    advice = check_lines(machine, [made]).advice
    assert ("this may be the rotation itself" in advice) == (cure is not None)
    assert f"itself: {cure} the shaft angle; if" in advice or cure is None


@pytest.mark.slow
def test_a_healthy_recording_has_no_foreign_line() -> None:
    """The check looks at the recording before anything is learned from it."""
    for seed in (52, 58):
        assert check_lines(NOTHING, [recording(NOTHING, stream(HEALTHY_S, seed))]).verdict == "passed"


@pytest.mark.parametrize(
    ("off", "limit", "verdict"), [(-0.003, 0.1, "passed"), (0.04, 0.1, "refused"), (0.04, 0.2, "passed")]
)
def test_a_difference_far_below_the_alarm_limit_is_no_reason_to_refuse(off: float, limit: float, verdict: str) -> None:
    """However many standard errors it amounts to: a single force makes them that small."""
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
def test_without_equations_channels_are_only_judged_changed_or_not() -> None:
    machine, blocks = with_sensors(NOTHING, stream(250.0, 60), lambda sensor: sensor.location != "disc")
    made = made_of(blocks, machine)
    verdict, text, advice = told_of(made, "equations")
    assert verdict == "limited"
    assert "at most, a natural frequency or a channel is called changed" in text
    assert "at the disc" in advice
    learned = sure(made.commissioned)
    assert (learned.baselines, learned.shape is None) == ((), False)
    assert not any(row.used for row in made.report.equations)
    assert made_of(blocks[:1000], machine).report.verdict == "refused"


@pytest.mark.slow
def test_a_rate_too_low_for_equations_leaves_only_channel_shapes() -> None:
    fields = NOTHING.model_dump(exclude={"window"}) | {"rate_hz": 500.0}
    machine = MachineFile.model_validate(fields)
    blocks = [replace(b, rate_hz=500.0, samples=b.samples[::4]) for b in stream(250.0, 60)]
    made = made_of(blocks, machine)
    verdict, text, advice = told_of(made, "equations")
    assert verdict == "limited"
    assert text.startswith(
        "a sampling rate of 500 Hz allows no equation: at most, a natural frequency or a channel is called changed"
    )
    assert advice == "sample at 794 Hz or faster"
    assert sure(made.commissioned).shape is not None


def test_the_default_lag_spacing_is_a_whole_number_of_samples() -> None:
    fields = NOTHING.model_dump(exclude={"window"}) | {"rate_hz": 2560.0}
    machine = MachineFile.model_validate(fields)
    assert machine.window.lag_step_s == 3 / 2560
    assert MachineFile.model_validate(machine.model_dump()).window == machine.window
    assert MachineFile.model_validate(fields | {"rate_hz": 4000.0}).window.lag_step_s == 0.001


def _shaped(count: int, varies: float = 1.0) -> HealthyShape:
    """Shapes of two channels whose windows scatter."""
    lags = np.arange(20) * 1e-3
    mean = np.exp(-lags / 5e-3) * np.cos(2 * np.pi * 40 * lags)
    common = {"mean": mean.tolist(), "directions": [[0.0, *[1.0] * 19]], "freedom": 1.0}
    channels = [common | {"channel": name, "variance": size * varies} for name, size in (("y1", 1e-3), ("z1", 0.02))]
    fields = {"windows": count, "window_s": 60.0, "lags_s": lags.tolist(), "speed_rad_s": None, "channels": channels}
    return HealthyShape.model_validate_json(json.dumps(fields))


@pytest.mark.parametrize(
    ("count", "varies", "verdict"),
    [(30, 1.0, "passed"), (6, 1.0, "limited"), (4, 1.0, "refused"), (4, 20.0, "refused"), (90, 1e6, "limited")],
)
def test_channel_shapes_are_judged_by_their_power(count: int, varies: float, verdict: str) -> None:
    shape = _shaped(count, varies)
    powers = shape.powers(3e-6)
    check = check_shapes(NOTHING, powers, count)
    assert check.verdict == verdict
    blind = [name for name, one in powers.items() if one.growth > 8]
    assert ("not even noise that makes" in check.text) == bool(blind)
    if verdict == "refused":
        (wanted,) = re.findall(r"record about (\d+) windows", check.advice)
        assert int(wanted) > count
        assert check.advice.endswith("such as DE, and import or record again: then levels alone are learned")
        then = _shaped(int(wanted), varies).powers(3e-6)
        assert all(then[name].growth <= 8 for name, one in powers.items() if one.windows is not None)
    if verdict == "limited" and varies > 1:
        assert check.advice.startswith("rely on the levels, which are compared with the healthy machine, or set limits")


@cache
def healthy_windows() -> tuple[WindowStatistics, ...]:
    return windows_of(healthy(NOTHING, HEALTHY_S, 52))


@pytest.mark.parametrize(
    ("rpm", "given", "refused"),
    [
        (3600, None, False),
        (6600, None, True),
        (6600, Operation(speed_rpm=3000), True),
        (6600, Operation(speed_rpm=6600), False),
        (6600, Operation(speed_rpm=4500, speed_tolerance=0.6), False),  # a variable-speed drive
    ],
)
def test_a_fast_machine_must_have_its_speed_in_the_file(rpm: float, given: Operation | None, refused: bool) -> None:
    machine = NOTHING.model_copy(update={"operation": given})
    windows = [replace(window, speed_rad_s=rpm * np.pi / 30) for window in healthy_windows()]
    found = check_speed_given(machine, windows)
    assert (found is not None) == refused
    if found is not None:
        assert found.verdict == "refused"
        assert found.text == "the shaft turns at 6600 rpm, and the windows are those of a slower machine"
        assert "give speed_rpm = 6600 in [operation]" in found.advice
    assert check_speed_given(LAB, windows) is None  # its natural frequencies are known


@pytest.mark.parametrize(
    ("speeds_rpm", "verdict"), [((1250, 1500), None), ((800, 1320), "limited"), ((800, 810), "refused")]
)
def test_speeds_at_which_a_known_machine_is_not_evaluated_are_reported(
    speeds_rpm: Sequence[float], verdict: str | None
) -> None:
    first = healthy_windows()[0]
    check = check_speed_range(LAB, [replace(first, speed_rad_s=rpm * np.pi / 30) for rpm in speeds_rpm])
    assert (check.verdict if check else None) == verdict
    if check:
        assert re.search("turned at 800.* evaluated from 1056 to 1584 rpm alone", check.text)


def test_a_speed_beyond_that_of_the_file_is_refused_because_nothing_would_be_evaluated() -> None:
    wrong = PARTIAL.model_copy(update={"operation": Operation(speed_rpm=1000.0)})
    made = made_of(stream(HEALTHY_S, 52), wrong)
    assert made.commissioned is None
    verdict, text, advice = told_of(made, "speed range")
    assert verdict == "refused"
    assert "turned at 1320 rpm, and is evaluated from 800 to 1200 rpm alone" in text
    assert advice.startswith("correct speed_rpm")


@pytest.mark.parametrize(("turned_rad", "verdict"), [(0.02, "passed"), (0.2, "refused")])
def test_agreement_of_the_unbalance_is_judged_by_its_vector(turned_rad: float, verdict: str) -> None:
    vector = UnbalanceVector(np.cos(turned_rad), np.sin(turned_rad), 1e-7, 0.0, 1e-7)
    change = vector.change if vector.turned else vector.magnitude_change
    read = (parameter_reading("e", "likelihood", change, 3e-4, vector),)
    diagnoses = [Diagnosis("likelihood", read, misfit_z=0.0, unbalance=vector)] * 6
    assert check_agreement(LAB, diagnoses, "the parameters in the file").verdict == verdict


@pytest.mark.parametrize(
    ("tried", "change", "verdict", "told"),
    [
        ("share of z1 in y1", 0.02, "limited", "share of z1 in XE-1 (+2.0%)"),
        ("share of z1 in y1", 0.06, "refused", "share of z1 in XE-1 (+6.0%)"),
        ("delay of y1", 4e-5, "limited", "delay of XE-1 (+40 µs)"),
        ("delay of y1", 3e-4, "refused", "delay of XE-1 (+300 µs)"),
        ("mass of the disc", 0.02, "refused", "mass of the disc (+2.0%)"),
    ],
)
def test_a_slightly_turned_or_late_sensor_does_not_refuse_the_machine_file(
    tried: str, change: float, verdict: str, told: str
) -> None:
    """The check says by how much, and of which channel: what to enter in the machine file follows from it."""
    y1, *others = LAB.sensors
    machine = LAB.model_copy(update={"sensors": (y1.model_copy(update={"name": "XE-1"}), *others)})
    read = (parameter_reading("k_by", "likelihood", 0.0, 3e-4),)
    sizes = [Goodness(3.0, (AlternativeTest(tried, 12.0, one * change),), 2) for one in (0.9, 1.2, 1.0, 0.8, 1.1)]
    windows = [Diagnosis("likelihood", read, misfit_z=one.misfit_z, goodness=one, suspect=one.suspect) for one in sizes]
    check = check_agreement(machine, windows, "the parameters in the file")
    assert check.verdict == verdict
    assert check.text.endswith(f"; best explained by: {told}, in 5 of them")
    assert check.advice.startswith("check what explains it best, and masses")
