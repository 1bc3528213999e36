"""Plots from the history of a monitor: trend, run-ups and centrelines from its reports."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from models.errors import RotorwatchError
from rotorwatch.records.example import example
from rotorwatch.records.health import Report
from rotorwatch.records.levels import ChannelLevels, LevelBound, LevelLimits
from service.analysis.orbit import recorded_pairs
from service.analysis.past import Past, in_units
from service.analysis.runup import read_centreline, read_run_up
from service.analysis.trend import past_trend, trend_of
from service.commands.rotorwatch import app
from service.history.records import Step, StoredReport
from tests.service.rig.postgres import opened

START_NS, S = 1_767_225_600 * 10**9, 10**9
COUNT = 40
NAMES = ("y1", "z1", "y2", "z2")


def report(number: int) -> Report:
    """A window of 60 s, 10 rpm faster than the one before, with vectors that turn by 2° and gaps that grow by 1 µm."""
    end_ns = START_NS + (60 + 5 * number) * S
    levels = [
        {"channel": name, "unit": "um", "detection": "peak to peak", "overall": 50.0, "peak": 30.0, "crest": 2.0,
         "kurtosis": 3.0, "x1": 20.0 + number, "x1_phase_lag_deg": 90 * at + 2.0 * number, "x3": 1.0,
         "mean": 100.0 * at + number}
        for at, name in enumerate(NAMES)
    ]  # fmt: skip
    fields = example(Report) | {
        "start_ns": end_ns - 60 * S,
        "end_ns": end_ns,
        "speed_rad_s": -(1000 + 10 * number) * np.pi / 30,
        "levels": [example(ChannelLevels) | {"velocity": None, "limits": [], "zone": ""} | one for one in levels],
    }
    return Report.model_validate(fields)


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Settings of a monitor whose history has reports, one of them from another version of the program."""
    folder = tmp_path_factory.mktemp("past")
    (folder / "plant.toml").write_text('[history]\nurl = "sqlite:///history.sqlite"\n', encoding="utf-8")
    with opened(f"sqlite:///{folder / 'history.sqlite'}") as store:
        machine = store.machine("demo", "lab")
        for number in range(COUNT):
            one = report(number)
            stored = StoredReport(one.start_ns, one.end_ns, one.state, one.filled, one.model_dump_json())
            machine.commit(Step(reports=(stored,)))
        machine.commit(Step(reports=(StoredReport(START_NS, START_NS + 61 * S, "healthy", 1.0, "{}"),)))
    return folder / "plant.toml"


def test_vectors_and_centrelines_of_the_history_are_those_of_the_reports(settings: Path) -> None:
    data = Past.find(settings, None, (None, None))
    assert (data.name, len(data.reports)) == ("demo/lab", COUNT)
    number = np.arange(COUNT)
    found = read_run_up(data, data.channels(["z1", "y2"]), 1, 8)
    assert found.speed_rad_s * 30 / np.pi == pytest.approx(-(1000 + 10 * number))
    assert (found.direction, found.units) == (-1, ("µm pp", "µm pp"))
    assert found.amplitude == pytest.approx(np.stack([20.0 + number] * 2, axis=1))
    assert found.lag_deg == pytest.approx(np.stack([90 + 2.0 * number, 180 + 2.0 * number], axis=1))
    line = read_centreline(data, recorded_pairs(data), 1.0)
    assert line.y_um == pytest.approx(np.stack([0.0 + number, 200.0 + number], axis=1))
    assert line.z_um == pytest.approx(np.stack([100.0 + number, 300.0 + number], axis=1))
    assert line.time_ns.tolist() == [START_NS + (30 + 5 * one) * S for one in range(COUNT)]
    assert past_trend(data, levels=True).levels[0].level.tolist() == [50.0] * COUNT


def test_levels_from_before_a_change_of_unit_are_converted(settings: Path) -> None:
    data = Past.find(settings, None, (None, None))
    bound = LevelBound(source="own limit", zones=(1.0, 2.0, 3.0), alert=2.0)
    limit = LevelLimits(measure="overall", alert=2.0, source="own limit", state="alert", bounds=(bound,))
    first, *others = data.reports[0].levels
    mils = first.model_copy(update={"unit": "mil", "overall": 1.0, "peak": 3.0, "x1": 1.0, "limits": (limit,)})
    speed = first.model_copy(update={"channel": "z1", "unit": "mm/s"})
    before = data.reports[0].model_copy(update={"levels": (mils, speed, *others[1:])})
    shown = trend_of([before, *data.reports[1:]], (), None, "", levels=True).levels
    assert shown[0].title == "y1   overall, µm pp"
    assert (*shown[0].level[:2], shown[0].alert[0]) == pytest.approx((25.4, 50.0, 50.8))
    (other,) = (one for one in shown if one.title.startswith("z1"))
    assert np.isnan(other.level[0])  # it was a velocity
    assert other.level[1] == 50
    converted = in_units(before, {"y1": "um"}).levels[0]
    assert (converted.peak, converted.x1, converted.crest) == pytest.approx((76.2, 25.4, first.crest))
    assert converted.limits[0].bounds[0].zones == pytest.approx((25.4, 50.8, 76.2))


def test_a_part_of_the_history_and_data_that_it_lacks(settings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    some = Past.find(settings, "demo/lab", ("20", "51"))
    assert [one.end_ns for one in some.reports] == [START_NS + (80 + 5 * one) * S for one in range(7)]
    with pytest.raises(RotorwatchError, match="no report of demo/lab has amplitude and phase of 3x of y1"):
        read_run_up(some, some.channels(["y1"]), 3, 8)
    with pytest.raises(RotorwatchError, match="no reports of demo/lab in this stretch of time"):
        Past.find(settings, None, ("5000", None))
    monkeypatch.setattr("service.analysis.past._MOST", 10)
    assert len(Past.find(settings, None, (None, None)).reports) == pytest.approx(9, abs=1)


def run(*arguments: str | Path) -> tuple[int, str]:
    found = CliRunner().invoke(app, ["plot", *map(str, arguments)])
    return found.exit_code, found.output


@pytest.mark.parametrize("kind", ["trend", "polar", "centreline"])
def test_plots_of_the_history_are_written(settings: Path, tmp_path: Path, kind: str) -> None:
    out = tmp_path / "picture.png"
    code, said = run(kind, "--history", settings, "--out", out, "--size", "6x4", "--dpi", "60")
    assert (code, said.strip()) == (0, str(out)), said
    assert out.stat().st_size > 5000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("spectrum", "--history"), "--history: this picture needs samples, which a history lacks"),
        (("polar", "--key", "demo/fan", "--history"), "machines: demo/lab; name one, as --key SITE/MACHINE"),
        (("bode", "--slow-roll", "300", "--history"), "--slow-roll and --speeds need samples"),
        (("trend", "--machine", "lab", "--history"), "--machine needs samples: name recordings instead of --history"),
        (("trend", "some.mcap", "--history"), "both recordings and --history are given, expected one of them"),
    ],
)
def test_unusable_options_are_named(settings: Path, tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    code, said = run(*arguments, settings, "--out", tmp_path / "picture.png")
    assert (code, message in said) == (2, True), said


def test_without_recordings_a_history_is_asked_for_and_none_is_created(tmp_path: Path) -> None:
    code, said = run("orbit", "--out", tmp_path / "picture.png")
    assert (code, "no recordings are named: expected FILE..." in said) == (2, True)
    (tmp_path / "plant.toml").write_text('[history]\nurl = "sqlite:///none.sqlite"\n', encoding="utf-8")
    code, said = run("polar", "--history", tmp_path / "plant.toml", "--out", tmp_path / "picture.png")
    assert (code, "unable to open" in said) == (1, True), said
    assert not (tmp_path / "none.sqlite").exists()
