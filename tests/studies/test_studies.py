"""The runner, the page, and every study at its smallest size."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks.studies import __main__ as command
from benchmarks.studies.delay import bound_time_s, with_hop
from benchmarks.studies.evaluate import evaluate
from benchmarks.studies.pages import write_page
from benchmarks.studies.reproduction import CONDITIONS, own_equations
from benchmarks.studies.results import Chart, Goal, Record, Table, Value, at_least, rate
from benchmarks.studies.study import Cell, Options, Over, Study, read, run
from benchmarks.studies.subjects import SHIPPED, SUBJECTS, subject_named
from models.commissioning.commissioned import KnowledgeLevel, knowledge_of
from models.errors import RecordingError
from models.machine import load_machine

LAB = load_machine("lab")


def _learn(over: Over) -> int:
    return sum(over("adding", abs, [1, -2, 3]))


def _measure(learned: int, cell: Cell, number: int) -> list[dict[str, Value]]:
    return [{"method": by, "named": number % 2 == 0, "sum": learned} for by in ("likelihood", "network")]


def _goals(records: Sequence[Record]) -> Iterator[Goal]:
    yield at_least("named", rate(row["named"] for row in records), 0.9)


def _charts(records: Sequence[Record]) -> Iterator[Chart]:
    share = rate(row["named"] for row in records)
    assert share is not None
    yield Chart("toy", "A caption", {"panel": {"one": [("a", share), ("b", 0.5)]}}, "what", "share")
    yield Chart("toy-steps", "Steps", {"panel": {"one": [(1.0, 0.5), (2.0, 1.0)]}}, "s", "found", steps=True)


def toy(windows: int = 4, machine: str = "none") -> Study:
    """Under the name of a study that has words for its page."""
    columns = {"named": lambda rows: rate(row["named"] for row in rows)}
    return Study(
        name="sensors",
        cells=tuple(Cell({"changed": changed}, windows) for changed in ("healthy", "e +20%")),
        measure=_measure,
        tables=(Table("toy", ("changed", "method"), columns, page="Everything:"),),
        goals=_goals,
        charts=_charts,
        learn=_learn,
        made_with={"machine": machine},
    )


@pytest.mark.parametrize("processes", [1, 2])
def test_an_interrupted_study_carries_on_and_gives_the_same_records(tmp_path: Path, processes: int) -> None:
    kept = run(toy(), Options(windows=4), tmp_path, processes)
    whole = kept.read_text(encoding="utf-8")
    assert len(read(toy(), tmp_path)) == 2 * 4 * 2
    kept.write_text(whole[: len(whole) * 2 // 3], encoding="utf-8")  # in the middle of a line
    assert 0 < len(read(toy(), tmp_path)) < 16
    run(toy(), Options(windows=4), tmp_path, processes)
    assert kept.read_text(encoding="utf-8") == whole
    assert {record["sum"] for record in read(toy(), tmp_path)} == {6}


def test_more_windows_are_welcome_and_another_plan_is_not(tmp_path: Path) -> None:
    run(toy(2), Options(windows=2), tmp_path, 1)
    kept = run(toy(3), Options(windows=3), tmp_path, 1)
    assert (len(read(toy(3), tmp_path)), len(read(toy(2), tmp_path))) == (12, 8)
    for study, options in ((toy(), Options(seed=5)), (toy(machine="other"), Options())):
        with pytest.raises(RecordingError, match="choose another --out"):
            run(study, options, tmp_path, 1)
    kept.write_text("nonsense\n", encoding="utf-8")
    with pytest.raises(RecordingError, match="is not JSON"):
        read(toy(), tmp_path)


def test_the_page_has_figures_goals_and_how_to_run_it_again(tmp_path: Path) -> None:
    run(toy(), Options(windows=4), tmp_path, 1)
    written = write_page(toy(), Options(windows=4, seed=7), read(toy(), tmp_path), tmp_path)
    text = written[0].read_text(encoding="utf-8")
    assert text.startswith("# Sensors at fault\n")
    assert "| healthy | likelihood | 50 % (6.76–93.2, 2 of 4) |" in text
    assert "0 met, 1 missed, 0 missed within chance" in " ".join(text.split())
    assert "4 windows per fault" in " ".join(text.split())
    assert "--windows 4 --seed 7" in text
    for target in re.findall(r"\]\(((?:figures|results)/[^)]+)\)", text):
        assert (tmp_path / target).exists()
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        assert len({line.count("|") for line in block.splitlines()}) == 1, block


def test_wrong_arguments_exit_with_2_and_a_sentence(tmp_path: Path) -> None:
    app = command.app
    for arguments, message in (
        (["everything"], "'everything', expected among evaluate"),
        (["unknown", "--machine", "nobody"], "--machine nobody: not among overhung, between"),
        (["evaluate", "--machine", "nothing.toml"], "nothing.toml: no such machine file"),
    ):
        done = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "x")])
        assert done.exit_code == 2
        assert message in " ".join(done.output.replace("│", " ").split())
        assert not (tmp_path / "x").exists()


@pytest.mark.long
@pytest.mark.parametrize("name", command.STUDIES)
def test_every_study_runs_at_its_smallest_size_and_writes_its_page(name: str, tmp_path: Path) -> None:
    machine = {"unknown": ["--machine", "lab"]}.get(name, [])
    arguments = [name, *machine, "--small", "--windows", "2", "--seed", "99", "--processes", "1"]
    done = CliRunner().invoke(command.app, [*arguments, "--out", str(tmp_path), "--docs", str(tmp_path)])
    assert done.exit_code == 0, done.output
    page = next(path for path in tmp_path.glob("*.md")).read_text(encoding="utf-8")
    assert not re.search(r"\b(nan|inf|None)\b", page)
    assert "--small" in page
    records = read(command.STUDIES[name](Options(tuple(machine[1:]), 2, 99, small=True)), tmp_path)
    likelihood = [row for row in records if row.get("method") == "likelihood" and row.get("k_by error")]
    for row in likelihood if name == "evaluate" else ():
        if row["topic"] in ("healthy", "small", "paper"):
            assert abs(float(row["k_by"] or 0) - float(row["k_by true"] or 0)) < 6 * float(row["k_by error"] or 0)


def test_every_machine_of_the_evaluation_has_its_cells() -> None:
    study = evaluate(Options(("lab", "light"), windows=500))
    counts = {(cell.keys["machine"], cell.keys["topic"]) for cell in study.cells}
    assert counts >= {("lab", "detectable"), ("lab", "outside"), ("light", "healthy"), ("light", "small")}
    assert ("light", "outside") not in counts
    assert len({cell.name for cell in study.cells}) == len(study.cells)
    assert study.cells[0].windows == 800


def test_the_papers_eight_conditions_name_their_equations() -> None:
    expected = [(), ("28",), ("28",), ("31",), ("29",), ("28", "31"), ("28", "31"), ("29", "31"), ("28", "29")]
    assert [own_equations(faults) for faults in CONDITIONS.values()] == expected


def test_the_bounds_time_falls_with_the_square_of_the_change() -> None:
    assert bound_time_s(0.01, 60, "e", 0.1, 4) == pytest.approx(4 * bound_time_s(0.01, 60, "e", 0.2, 4))
    # A loss of damping is a larger step in the logarithm than a gain.
    assert bound_time_s(0.01, 60, "c_by", -0.2, 4) < bound_time_s(0.01, 60, "c_by", 0.2, 4)


def test_another_hop_keeps_the_window() -> None:
    assert with_hop(LAB, 2.5).window.hops == 24
    with pytest.raises(ValueError, match="multiple of half of segment_s"):
        with_hop(LAB, 1.5)


def test_files_tell_what_their_level_allows() -> None:
    for name in SUBJECTS:
        subject = subject_named(name)
        for level in KnowledgeLevel:
            file = subject.file(level)
            assert (file is None) == (level is not KnowledgeLevel.NONE and name not in SHIPPED)
            assert file is None or knowledge_of(file).level is level
    with pytest.raises(KeyError):
        subject_named("nobody")
