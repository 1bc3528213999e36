"""What is learned at each level of knowledge, and its round trip through the file."""

import json
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from models.alarm_names import LEVEL
from models.commissioning.checks import Check, check_agreement
from models.commissioning.commission import Commissioning
from models.commissioning.commissioned import (
    FILE,
    Commissioned,
    Installed,
    KnowledgeLevel,
    OperatingRange,
    install,
    knowledge_of,
    load_commissioned,
)
from models.commissioning.identified import identify
from models.commissioning.levels import pieces_of
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.misfit import AlternativeTest, Goodness, HealthyMisfit
from models.diagnosis.readings import Diagnosis
from models.diagnosis.sensors.reference import Naming
from models.errors import BundleError, EstimationError
from models.machine import MachineFile
from models.physics.rotor import FAULT_FIELDS, PARAMETERS
from models.signals.channels import Quantity
from service.monitor.evaluators import evaluator_for
from service.monitor.monitor import MachineMonitor
from simulator.scenario import Event, load_scenario
from simulator.stream import blocks
from tests.commissioning.rotor_kit import (
    LAB,
    NOTHING,
    PARTIAL,
    blind,
    commissioned,
    elsewhere,
    healthy,
    no_velocity,
    recording,
    samples_of,
    stream,
    told_of,
    windows_of,
    with_lines,
    with_samples,
    with_sensors,
    without_angle,
)
from tests.service.rig.watching import at_once, feed
from tests.sure import sure
from tests.windows import healthy_blocks

HEALTHY_S = 90.0
MACHINES = {"full": LAB, "partial": PARTIAL, "none": NOTHING}


@cache
def made_at(level: str) -> Commissioning:
    """The rotor kit commissioned on one recording at this level of knowledge."""
    return commissioned(MACHINES[level], healthy(MACHINES[level], HEALTHY_S if level == "none" else 70.0, 41))


def assert_identified(made: Commissioning, names: Sequence[str]) -> list[float]:
    """Assert that these parameters are within four standard errors of the truth; return the standard errors."""
    errors = np.sqrt(np.diag(sure(sure(made.commissioned).identified).matrix())).tolist()
    for name, error in zip(names, errors, strict=False):
        found, true = (getattr(machine.rotor, FAULT_FIELDS[name]) for machine in (sure(made.machine), LAB))
        assert abs(np.log(found / true)) < 4 * error, name
    return list(errors)


def test_the_knowledge_level_follows_from_the_machine_file() -> None:
    assert (knowledge_of(LAB).level, knowledge_of(PARTIAL).level) == (KnowledgeLevel.FULL, KnowledgeLevel.PARTIAL)
    assert "k_by_N_per_m, k_bz_N_per_m, c_by_N_s_per_m, c_bz_N_s_per_m, e_m" in knowledge_of(PARTIAL).text
    assert knowledge_of(NOTHING).level is KnowledgeLevel.NONE
    rotor = sure(PARTIAL.rotor).model_copy(update={"I2_kg_m2": None})
    without_inertia = PARTIAL.model_copy(update={"rotor": rotor})
    assert knowledge_of(without_inertia).level is KnowledgeLevel.NONE
    assert "lacks I2_kg_m2" in knowledge_of(without_inertia).text
    at_bearing = [one for one in NOTHING.sensors if one.location != "disc"]
    assert "allow no equation" in knowledge_of(NOTHING.model_copy(update={"sensors": tuple(at_bearing)})).text


@pytest.mark.parametrize("known", [LAB, NOTHING])
def test_without_motion_sensors_only_levels_are_commissioned(known: MachineFile) -> None:
    machine = elsewhere(known)
    assert install(machine, None).watching
    made = sure(commissioned(machine, healthy(machine, 70.0, 60106)).commissioned)
    assert (made.level, made.levels is None) == (KnowledgeLevel.NONE, False)
    blocks = stream(70.0, 60106)
    still = samples_of(blocks)
    still[:, machine.descriptor.states.index("theta")] = 1.0
    assert commissioned(machine, recording(machine, with_samples(blocks, still))).commissioned is not None
    stuck = samples_of(blocks)
    stuck[:, 2] = 0.3
    report = commissioned(machine, recording(machine, with_samples(blocks, stuck))).report
    assert report.verdict == "refused"
    assert "y1_dot: repeated the value 0.3 mm/s" in report.summary


def test_a_wrong_heavy_spot_angle_in_the_file_is_refused_with_the_measured_one() -> None:
    operation = LAB.operation.model_copy(update={"unbalance_phase_rad": 1.5})
    elsewhere_now = LAB.model_copy(update={"operation": operation})
    file, seen = with_sensors(elsewhere_now, stream(70.0, 41), lambda sensor: sensor.name in {"y1", "z1", "theta"})
    report = commissioned(file, recording(file, seen)).report
    assert report.verdict == "refused"
    assert "is 0° from the phase reference, whereas the file has it at 86°" in report.summary
    assert "unbalance_phase_rad = " in report.summary


def test_samples_in_a_wrong_unit_are_doubted_and_a_huge_unbalance_later_may_be_a_lost_part() -> None:
    """A factor that all channels share changes the unbalance alone."""
    seen = stream(65.0, 4_910_013)
    factor = [1.0 if one.quantity is Quantity.SHAFT_ANGLE else 1000.0 for one in PARTIAL.sensors]
    made = commissioned(PARTIAL, recording(PARTIAL, with_samples(seen, samples_of(seen) * factor)))
    verdict, text, advice = told_of(made, "units")
    assert (verdict, text.split(", ")[1]) == ("limited", "more than the shaft's diameter of 10 mm")
    assert advice.startswith("check unit and scale of every channel")
    grown = np.array(factor) * [1.0 if one == 1.0 else 30.0 for one in factor]
    (window,) = windows_of(recording(PARTIAL, with_samples(seen, samples_of(seen) * grown)))
    read = sure(evaluator_for(Installed(PARTIAL, None, sure(made.commissioned))).evaluate(window).deciding)
    assert (
        "30.0 times the unbalance of the commissioning, the limit is 20 times: a part may be lost" in read.unexplained
    )


def test_steady_lines_do_not_prevent_identification_of_the_rotor() -> None:
    """The lines are of a gear, hum, and the second harmonic of every real machine: theory has none of them."""
    made = commissioned(PARTIAL, recording(PARTIAL, with_lines(stream(70.0, 41), {50.03: 0.1, 37.3: 0.1}, order=2)))
    found = sure(made.commissioned)
    assert {round(line_hz) for line_hz, _ in found.lines} == {37, 44, 50}
    assert_identified(made, PARAMETERS[:4])
    assert Commissioned.model_validate_json(found.model_dump_json()) == found


def test_a_damped_rotor_is_identified_with_sensors_at_its_bearing_alone() -> None:
    """Without a relation of bearing and disc, the first guess of damping is an assumption, here far too low."""
    damped = LAB.rotor.model_copy(update={"c_by_N_s_per_m": 160.0, "c_bz_N_s_per_m": 160.0})
    shaken = healthy_blocks(LAB.model_copy(update={"rotor": damped}), 70.0, 2_901_092)
    file, at_bearing = with_sensors(PARTIAL, shaken, lambda sensor: sensor.location != "disc")
    made = commissioned(file, recording(file, at_bearing))
    assert made.report.verdict == "limited"  # by its length alone
    rotor = sure(made.machine).rotor
    assert (rotor.c_by_N_s_per_m, rotor.c_bz_N_s_per_m) == pytest.approx((160.0, 160.0), rel=0.25)


def test_a_heavy_rotor_with_sensors_in_the_vertical_alone_is_identified() -> None:
    """It moves like the rotor kit, at 16 times its masses and stiffness."""
    rotor = sure(PARTIAL.rotor)
    heavier = {name: 16 * getattr(rotor, name) for name in ("m1_kg", "m2_kg", "I2_kg_m2", "I2p_kg_m2")}
    heavier["shaft_diameter_m"] = 2 * sure(rotor.shaft_diameter_m)
    shorter = PARTIAL.window.model_copy(update={"segment_s": 2.0})  # of which a spectrum takes less time
    heavy = PARTIAL.model_copy(update={"rotor": rotor.model_copy(update=heavier), "window": shorter})
    file, vertical = with_sensors(heavy, stream(70.0, 41), lambda sensor: sensor.direction != "y")
    made = commissioned(file, recording(file, vertical))
    assert made.report.verdict == "limited"  # by its length alone
    assert sure(made.machine).rotor.k_bz_N_per_m == pytest.approx(16 * LAB.rotor.k_bz_N_per_m, rel=0.02)


@pytest.mark.parametrize(
    ("change", "known", "directions"),
    [
        # z moves in its second mode; with the damping known, few starts differ
        (
            {},
            ("c_by_N_s_per_m", "c_bz_N_s_per_m"),
            [(-0.4, -0.8, 0.0, 0.3, -0.3, 0.0), (0.8, 0.4, 0.0, 0.3, -0.3, 0.0)],
        ),
        ({"k_by_N_per_m": 38e3, "c_by_N_s_per_m": 130.0, "k_bz_N_per_m": 145e3, "c_bz_N_s_per_m": 20.0}, (), []),
        ({"c_by_N_s_per_m": 3.0, "c_bz_N_s_per_m": 3.0}, (), []),
    ],
)
def test_a_rotor_whose_first_guess_is_far_off_is_identified_from_another_one(
    change: dict[str, float], known: tuple[str, ...], directions: list[tuple[float, ...]]
) -> None:
    """With velocities at the bearing alone, it is read from the strongest peaks and a likely damping."""
    scenario, machine = load_scenario("healthy")
    scenario = scenario.overridden(duration_s=70.0, seed=2_901_097, faults=())
    if directions:
        pairs = zip(scenario.sources, directions, strict=False)
        sources = tuple(one.model_copy(update={"direction": direction}) for one, direction in pairs)
        scenario = scenario.model_copy(update={"sources": sources})
    rotor = LAB.rotor.model_copy(update=change)
    shaken = tuple(block for block, _ in blocks(scenario, machine.model_copy(update={"rotor": rotor})))
    kept = {("bearing", Quantity.VELOCITY), ("shaft", Quantity.SHAFT_ANGLE)}
    told = sure(PARTIAL.rotor).model_copy(update={name: getattr(LAB.rotor, name) for name in known})
    coarse = PARTIAL.window.model_copy(update={"segment_s": 2.5})  # half as many frequencies
    partial = PARTIAL.model_copy(update={"rotor": told, "window": coarse})
    file, at_bearing = with_sensors(partial, shaken, lambda sensor: (sensor.location, sensor.quantity) in kept)
    found = sure(commissioned(file, recording(file, at_bearing)).machine).rotor
    for name in PARAMETERS[:4]:
        field = FAULT_FIELDS[name]
        assert getattr(found, field) == pytest.approx(getattr(rotor, field), rel=0.05)


def test_values_of_an_incomplete_file_that_the_recordings_contradict_are_reported() -> None:
    """They are only a first guess: the identified ones are used, but a wrong mass may be the cause."""
    given = {"k_by_N_per_m": 1.25 * LAB.rotor.k_by_N_per_m, "k_bz_N_per_m": LAB.rotor.k_bz_N_per_m}
    machine = PARTIAL.model_copy(update={"rotor": sure(PARTIAL.rotor).model_copy(update=given)})
    made = commissioned(machine, healthy(PARTIAL, 70.0, 41))
    assert_identified(made, PARAMETERS[:4])
    verdict, text, advice = told_of(made, "values in the machine file")
    assert verdict == made.report.verdict == "limited"
    assert text.endswith("used as identified: bearing stiffness, horizontal (k_by) -19%")
    assert "leave out" in advice


@pytest.mark.parametrize("machine", [blind(LAB, 1.5), pytest.param(blind(PARTIAL), marks=pytest.mark.long)])
def test_without_a_shaft_angle_the_unbalance_is_identified_by_its_size(machine: MachineFile) -> None:
    """A wrong value in the file does no harm, and only the later growth is alarmed."""
    made = commissioned(machine, recording(machine, without_angle(stream(75.0, 5_570_010))))
    identified = sure(sure(made.commissioned).identified)
    error = np.sqrt(identified.matrix()[PARAMETERS.index("e"), PARAMETERS.index("e")])
    assert "e" in identified.names
    assert 0.002 < error < 0.03
    assert sure(made.machine).rotor.e_m == pytest.approx(LAB.rotor.e_m, rel=4 * error)
    doubled = without_angle(stream(80.0, 5_570_011, Event(at_s=65.0, parameter="e", relative_change=1.0)))
    windows, events = feed(MachineMonitor(Installed(at_once(machine), None, made.commissioned)), doubled)
    assert {event.alarm.name for event in events if not event.alarm.name.startswith(LEVEL)} == {"e"}
    first = next(window for window in windows if window.filled == 1.0)
    assert abs(sure(next(one for one in first.parameters if one.name == "e").z)) < 4


def test_recordings_whose_shaft_angles_have_different_zeros_are_refused_with_that_reason() -> None:
    """As with several pulses per revolution, any of which may count as 0."""
    theta = [sensor.name for sensor in PARTIAL.sensors].index("theta")
    two = []
    for number in range(2):
        blocks = stream(33.0, 5_570_030 + number)
        samples = samples_of(blocks).copy()
        samples[:, theta] = np.mod(samples[:, theta] + number * np.pi / 2, 2 * np.pi)
        two.append(recording(PARTIAL, with_samples(blocks, samples)))
    told = (
        r"after [1-4] rounds e still moves; its heavy spot is at angles that differ by (8|9)\d°: the zero of the shaft"
    )
    with pytest.raises(EstimationError, match=told):  # no further round changes that
        identify(PARTIAL, [piece.window for piece in pieces_of(two)], lambda *_: None, "Eq. 27", sized=False)


def test_without_a_shaft_angle_differing_unbalances_are_not_identified() -> None:
    machine = blind(LAB)
    sizes = [(), (Event(at_s=0.0, parameter="e", relative_change=0.5),)]
    two = [recording(machine, without_angle(stream(46.0, 5_570_020 + n, *one))) for n, one in enumerate(sizes)]
    made = commissioned(machine, *two)
    assert sure(made.commissioned).identified is None
    assert "e" not in [one.name for one in made.report.parameters if one.evaluable]


@pytest.mark.slow
def test_partial_knowledge_identifies_the_rotor_within_its_errors() -> None:
    made = made_at("partial")
    assert made.report.verdict in {"commissioned", "limited"}
    assert sure(made.commissioned).gyroscopic == "Eq. 27"
    assert "gyroscopic" not in sure(made.commissioned).model_dump()
    errors = assert_identified(made, PARAMETERS)
    assert 0 < min(errors) <= max(errors) < 0.03
    machine = sure(made.machine)
    assert abs(machine.operation.unbalance_phase_rad - LAB.operation.unbalance_phase_rad) < 0.1
    assert machine.operation.speed_rpm == pytest.approx(LAB.operation.speed_rpm, rel=1e-4)
    k_by = next(one for one in made.report.parameters if one.name == "k_by")
    assert k_by.commissioning_error == pytest.approx(errors[0], rel=0.1)
    assert k_by.identified == machine.rotor.k_by_N_per_m


def test_later_misfit_is_judged_relative_to_that_of_healthy_windows() -> None:
    rng, names = np.random.default_rng(4_501), ("mass of the disc", "gain of y1", "gain of z1")
    off = np.array([4.0, -2.5, 0.0])

    def window(part: float, *, more: float = 0.0) -> Goodness:
        mass, gain, other = rng.normal(off * part**0.5, 1.0).tolist()
        tests = [AlternativeTest(name, z, z / 100) for name, z in zip(names, (mass, gain, other + more), strict=True)]
        return Goodness(rng.normal(2.0 * part, 1.0), tuple(tests), 4)

    before, judged, changed = [], [], []
    for _ in range(1500):
        # Healthy windows of half the monitor's length, then a window of its full length.
        healthy = sure(HealthyMisfit.of([window(0.5) for _ in range(8)], [0.5] * 8))
        assert (healthy.error, healthy.excess_error) == pytest.approx((0.5, 0.5**0.5))
        before.append(window(1.0).misfit_z)
        judged.append(healthy.beyond(window(1.0), 1.0).misfit_z)
        changed.append(healthy.beyond(window(1.0, more=7.0), 1.0))
    assert np.mean(before) > 2.5
    assert (np.array(judged) > 2.0).mean() < 0.023 + 4 * (0.023 / 1500) ** 0.5
    assert np.mean(judged) > -0.5
    # A deviation of another kind shows, though it is no larger than the healthy one.
    assert np.mean([one.misfit_z > 4.0 for one in changed]) > 0.8
    suspects = {one.suspect.partition(" (")[0] for one in changed}
    assert suspects <= {"gain of z1", ""}
    assert HealthyMisfit.of([], []) is None


def test_a_healthy_misfit_that_varies_with_excitation_is_tolerated_later() -> None:
    """A slightly wrong gain stands out under a single force, and hardly under several."""
    rng, names = np.random.default_rng(4_502), ("gain of y1", "gain of z1")

    def window(gain: float, other: float = 0.0) -> Goodness:
        tests = (AlternativeTest(name, rng.normal(z), z / 100) for name, z in zip(names, (gain, other), strict=True))
        return Goodness(rng.normal(gain / 2), tuple(tests), 3)

    healthy = sure(HealthyMisfit.of([window(gain) for gain in (20.0, 2.0, 20.0) * 4], [1.0] * 12))
    assert set(healthy.spreads) == {"gain of y1"}
    assert HealthyMisfit.model_validate_json(healthy.model_dump_json()) == healthy
    assert max(healthy.beyond(window(gain), 1.0).misfit_z for gain in (20.0, 2.0) * 100) < 4.0
    assert min(healthy.beyond(window(gain, 12.0), 1.0).misfit_z for gain in (20.0, 2.0) * 100) > 4.5
    alike = sure(HealthyMisfit.of([window(20.0) for _ in range(12)], [1.0] * 12))
    assert not {"spreads", "excess_spread"} & set(json.loads(alike.model_dump_json()))


@pytest.mark.slow
@pytest.mark.parametrize("level", ["partial", pytest.param("full", marks=pytest.mark.long)])
def test_a_misfit_of_the_healthy_machine_is_no_misfit_of_a_later_window(level: str) -> None:
    made, machine = sure(made_at(level).commissioned), MACHINES[level]
    misfit = sure(made.misfit)
    assert "misfit" not in json.loads(made.model_copy(update={"misfit": None}).model_dump_json())
    assert misfit.error == pytest.approx((60 / 35 / 2) ** 0.5, rel=0.05)  # of 70 s
    assert abs(misfit.mean) < 5 * misfit.error
    (window,) = windows_of(healthy(machine, 66.0, 43))

    def judged(known: HealthyMisfit | None) -> Diagnosis:
        installed = Installed(machine, None, made.model_copy(update={"misfit": known}))
        return evaluator_for(installed).evaluate(window).deciding

    raw = judged(None)
    goodness = sure(raw.goodness)
    scores = {one.tried: one.z for one in goodness.alternatives}
    assert len(scores) == len(goodness.alternatives)
    exact = HealthyMisfit(mean=0.0, scores=scores, error=0.0, excess=goodness.excess_z, excess_error=0.0)
    assert (judged(exact).misfit_z or 0.0) < sure(raw.misfit_z)
    shifted = exact.model_copy(update={"scores": scores | {"mass of the disc": scores["mass of the disc"] - 12.0}})
    assert (judged(shifted).misfit_z or 0.0) > 10.0
    assert "mass of the disc" in judged(shifted).suspect
    assert judged(shifted).parameters == raw.parameters


@pytest.mark.slow
@pytest.mark.parametrize("level", ["partial", "none", pytest.param("full", marks=pytest.mark.long)])
def test_a_commissioned_bundle_round_trips_through_its_file(level: str, tmp_path: Path) -> None:
    made, machine = sure(made_at(level).commissioned), MACHINES[level]
    assert made_at(level).report.level == level
    (tmp_path / FILE).write_text(made.model_dump_json(indent=1))
    again = load_commissioned(tmp_path, machine)
    assert again == made
    assert again.identity == made.identity
    installed = install(machine, tmp_path)
    assert installed.identity == again.identity
    assert (installed.known is None) == (level == "none")
    (window,) = windows_of(healthy(machine, 66.0, 43))
    for fresh, restored in zip(made.baselines, again.baselines, strict=True):
        first, second = (BaselineDiagnostician(one.baseline).diagnose(window) for one in (fresh, restored))
        assert first.parameters == second.parameters


@pytest.mark.slow
def test_a_bundle_is_refused_for_another_machine_or_when_damaged(tmp_path: Path) -> None:
    made = sure(made_at("none").commissioned)
    path = tmp_path / FILE
    path.write_text(made.model_dump_json())
    with pytest.raises(BundleError, match="commissioned for demo/lab, not for demo/other"):
        load_commissioned(tmp_path, NOTHING.model_copy(update={"name": "other"}))
    fewer = NOTHING.model_copy(update={"sensors": NOTHING.sensors[1:]})
    with pytest.raises(BundleError, match=r"sensors in the machine file of demo/lab differ.*commission"):
        load_commissioned(tmp_path, fewer)
    shorter = NOTHING.model_copy(update={"window": NOTHING.window.model_copy(update={"lag_to_s": 0.12})})
    with pytest.raises(BundleError, match=r"window in the .* \(what \[window\] leaves out may be chosen otherwise"):
        load_commissioned(tmp_path, shorter)
    first, *others = NOTHING.model_dump()["sensors"]
    rolled = NOTHING.model_dump() | {"sensors": [first | {"slow_roll_um_pp": 5.0, "slow_roll_phase_lag_deg": 40.0}]}
    rolled["sensors"] += others
    with pytest.raises(BundleError, match="sensors"):
        load_commissioned(tmp_path, MachineFile.model_validate(rolled))
    with pytest.raises(BundleError, match=r"nowhere is no folder, expected a commissioned bundle.*or name no bundle"):
        install(NOTHING, tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BundleError, match="is not a commissioned bundle"):
        install(NOTHING, tmp_path / "empty")
    assert install(NOTHING, None).watching
    fields = json.loads(made.model_dump_json())
    path.write_text(json.dumps(fields | {"share": 1, "states": 2}))
    with pytest.raises(BundleError, match=r"of another version of the program, which knew share: use .* again$"):
        load_commissioned(tmp_path, NOTHING)
    fields["baselines"][0]["baseline"]["covariance"][0][0] = "NaN"
    path.write_text(json.dumps(fields))
    with pytest.raises(BundleError, match=r"baselines\.0\.baseline\.covariance"):
        load_commissioned(tmp_path, NOTHING)
    del fields["baselines"], fields["shape"], fields["levels"]
    path.write_text(json.dumps(fields))
    with pytest.raises(BundleError, match="neither a baseline, nor a healthy shape, nor levels"):
        load_commissioned(tmp_path, NOTHING)


def test_a_vibration_outside_the_commissioned_range_is_named() -> None:
    windows = windows_of(healthy(NOTHING, HEALTHY_S, 41))
    conditions, naming = OperatingRange.of(windows), Naming(NOTHING.sensors)
    assert all(conditions.outside(window, naming) == "" for window in windows)
    quiet = Event(at_s=0.0, excitation_level=0.01)
    (window,) = windows_of(recording(NOTHING, stream(66.0, 45, quiet)))
    assert re.match(r"random vibration of y1 is \S+ µm rms, commissioned at", conditions.outside(window, naming))


@pytest.mark.slow
def test_a_longer_recording_lowers_commissioning_errors_and_detectable_changes() -> None:
    little = commissioned(NOTHING, healthy(NOTHING, 46.0, 46))
    much = made_at("none")
    for one, other in zip(little.report.parameters[:4], much.report.parameters[:4], strict=True):
        assert sure(one.commissioning_error) > 1.3 * sure(other.commissioning_error)
        assert sure(one.detectable_loss) < sure(other.detectable_loss) < 0
    assert isinstance(much.commissioned, Commissioned)


def test_a_reading_that_a_window_does_not_determine_is_not_compared_between_the_halves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As in the monitor: a damping known to 110 % only had let its plane's unbalance look changed, at 0.7 errors."""
    compared: list[Diagnosis] = []

    def check(machine: MachineFile, diagnoses: Sequence[Diagnosis]) -> Check:
        compared.extend(diagnoses)
        return check_agreement(machine, diagnoses)

    monkeypatch.setattr("models.commissioning.levels.check_agreement", check)
    monkeypatch.setattr("models.diagnosis.verdict.stretch._VAGUE", 0.05)  # of a window three times as long
    commissioned(NOTHING, healthy(NOTHING, 46.0, 46))
    assert [[one.name for one in each.evaluable] for each in compared] == 2 * [["k_by", "k_bz", "e"]]


@pytest.mark.parametrize(("segment_s", "noted"), [(0.25, True), (2.0, False)])
def test_a_note_asks_for_segments_that_resolve_the_narrowest_mode(segment_s: float, noted: bool) -> None:
    machine = LAB.model_copy(update={"window": LAB.window.model_copy(update={"segment_s": segment_s})})
    made = commissioned(machine, healthy(machine, 70.0, 41))
    assert ("Let segment_s in [window] be about 2, and" in "".join(made.report.notes)) is noted


@pytest.mark.slow
def test_a_rotor_that_is_not_identified_for_its_narrow_modes_is_refused_with_the_segments_it_needs() -> None:
    machine = PARTIAL.model_copy(update={"window": PARTIAL.window.model_copy(update={"segment_s": 1.0})})
    ringing = (Event(at_s=0.0, parameter=name, relative_change=-0.985) for name in ("c_by", "c_bz"))
    made = commissioned(machine, recording(machine, stream(70.0, 41, *ringing)))
    assert made.commissioned is None
    assert "segments of 1 s do not resolve it" in made.report.summary
    assert "Let segment_s in [window] be about 10, and commission again" in made.report.summary


@pytest.mark.slow
def test_a_note_states_the_valid_band_of_the_derivatives() -> None:
    note, linear = made_at("none").report.notes
    assert linear.startswith("The relations are linear.")
    found = sure(re.search(r"up to (\d) derivatives .* valid from 0 to (\d+) Hz", note))
    assert 50 <= int(found[2]) <= NOTHING.window.band_hz[1]
    few, blocks = with_sensors(NOTHING, stream(HEALTHY_S, 41)[:700], no_velocity)
    less, _ = commissioned(few, recording(few, blocks)).report.notes
    deeper = sure(re.search(r"up to (\d) derivatives", less))
    assert int(deeper[1]) > int(found[1])
