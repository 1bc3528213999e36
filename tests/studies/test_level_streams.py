"""The study of levels: its streams are as drawn, and its counts are right."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.studies.level_years import Drawing, level_years
from benchmarks.studies.levels import levels
from benchmarks.studies.reporting.results import Record
from benchmarks.studies.reporting.study import Options
from benchmarks.studies.subjects.level_streams import KINDS, At, Defect, drawn, generator, steady
from models.diagnosis.verdict.calibration import MONTH_S
from models.levels.judgement import LevelJudge
from models.levels.reference import learn_levels
from models.levels.settings import LevelSettings

VELOCITY = "velocity sensors, speed in the machine file"


def test_a_stream_has_the_lines_and_the_noise_that_were_drawn() -> None:
    scene = drawn(KINDS["proximity probes, phase reference"], generator(1, 2, 3, At.CONDITION))
    blocks = list(scene.blocks(generator(1, 2, 3, At.EVALUATION), 30, steady))
    samples = np.concatenate([block.samples for block in blocks]).astype(np.float64)
    lines = [2 * np.abs((samples[:, :2] * np.exp(-1j * k * samples[:, 2:])).mean(axis=0)) for k in (1, 2, 3)]
    np.testing.assert_allclose(lines, scene.lines, rtol=0.05, atol=0.02 * scene.noise.max())
    expected = np.sqrt((scene.lines**2).sum(axis=0) / 2 + scene.noise**2)
    np.testing.assert_allclose(samples[:, :2].std(axis=0), expected, rtol=0.05)


def test_a_bearings_impacts_have_the_rms_they_have_grown_to() -> None:
    kind = replace(KINDS["accelerometers, speed unknown"], rate_hz=12800.0)
    scene = drawn(kind, generator(1, 2, 4, At.CONDITION))
    defect = Defect(begins_s=5.0, growth_s=1e-9, rolling_hz=90.0, resonance_hz=4000.0, damping=0.03)
    streams = [
        np.concatenate([block.samples[:, 0] for block in one.blocks(generator(1, 2, 4, At.EVALUATION), 15, steady)])
        for one in (scene, replace(scene, defect=defect))
    ]
    before, after = (
        x.astype(np.float64) for part in (slice(0, 12800), slice(76800, None)) for x in (streams[1][part],)
    )
    assert after.std() / streams[0].std() == pytest.approx(np.hypot(1, 20), rel=0.1)
    assert before.std() == pytest.approx(streams[0].std(), rel=0.1)
    assert (defect.overall(4.9), defect.overall(5.1)) == pytest.approx((1.0, np.hypot(1, 20)))


def test_a_doubling_of_one_sensor_is_counted_with_its_delay() -> None:
    study = levels(Options(windows=1, seed=99, small=True))
    cell = next(one for one in study.cells if one.keys["machine"] == VELOCITY)
    found = list(cell.measure(None, 0))
    assert [row["doubled"] for row in found] == ["overall", "1x", "2x"]
    assert (found[0]["any"], found[0]["level"], found[0]["early"]) == (True, True, False)
    assert 0 < float(found[0]["delay_s"] or 0) <= 40


@pytest.mark.long
def test_a_2x_on_a_rotor_doubles_from_what_was_commissioned() -> None:
    study = levels(Options(windows=1, seed=99, small=True))
    cell = next(one for one in study.cells if one.keys["machine"] == "lab, level none")
    found = list(cell.measure(None, 1))
    assert [row["doubled"] for row in found] == ["overall", "1x", "2x"]
    assert [(row["any"], row["early"]) for row in found] == [(True, False)] * 3


def test_alarms_per_month_have_the_exact_interval_of_a_poisson_count() -> None:
    study = level_years(Options(small=True))
    (of,) = (table.columns["per machine and month"] for table in study.tables if table.name == "level-years")
    month_h = MONTH_S / 3600

    def rows(alarms: int) -> list[Record]:
        return [{"alarms": alarms, "hours": month_h}, {"alarms": 0, "hours": month_h}]

    nothing, some = of(rows(0)), of(rows(3))
    assert str(nothing) == "0 (0–1.84)"
    assert str(some) == "1.5 (0.309–4.38)"  # of 3: 0.6187 to 8.7673


@pytest.mark.parametrize("topic", ["beside", "years"])
def test_drawn_levels_agree_with_a_simulation_in_time(topic: str) -> None:
    study = level_years(Options(windows=1, seed=99, small=True))
    cell = next(one for one in study.cells if one.keys["topic"] == topic)
    rows = list(cell.measure(None, 0))
    if topic == "years":
        assert rows[0]["hours"] == pytest.approx(14 / 60)
        assert not rows[0]["alarms"]
    for row in rows if topic == "beside" else ():
        assert abs(float(row["mean"] or 0.0)) < 0.06, row
        assert 0.5 < float(row["scatter"] or 0.0) < 2, row


def test_a_drawn_machine_that_grows_louder_is_beyond_its_limits() -> None:
    scene = drawn(KINDS[VELOCITY], generator(1, 2, 3, At.CONDITION), noise_over_1x=(1.0, 3.0))
    drawing, rng = Drawing.of(scene), np.random.default_rng(5)
    healthy = learn_levels("test", [one.name for one in scene.machine.sensors], list(drawing.windows(rng, np.ones(5))))
    judge = LevelJudge(drawing.plan, scene.machine.sensors, LevelSettings())
    states = [
        {limit.state for one in judge.judge(levels, healthy) for limit in one.limits if limit.measure == "overall"}
        for levels in drawing.windows(rng, np.array([1.0, 4.0]))
    ]
    assert states == [{"normal"}, {"danger"}]
