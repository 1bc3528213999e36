"""The runner, the page, every study at its smallest size; rates and goals; variants of the relation networks."""

import csv
import pickle
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.studies import __main__ as command
from benchmarks.studies.delay import bound_time_s, with_hop
from benchmarks.studies.evaluate import evaluate
from benchmarks.studies.methods.paper import full_correlation
from benchmarks.studies.methods.variants import VARIANTS, as_seen, linear_fit, variant_equation
from benchmarks.studies.reporting.opinions import physics_hash
from benchmarks.studies.reporting.pages import write_page
from benchmarks.studies.reporting.results import (
    Chart,
    Estimate,
    Goal,
    Record,
    Table,
    Value,
    among,
    at_least,
    at_most,
    holding,
    limit_of,
    limits_of,
    rate,
    resampled,
    robust,
    scatter,
    share,
    where,
    within,
)
from benchmarks.studies.reporting.study import Cell, Options, Over, Study, read, run, spread_over
from benchmarks.studies.reproduction import CONDITIONS, own_equations
from benchmarks.studies.subjects.machines import SHIPPED, SUBJECTS, subject_named
from models.commissioning.commissioned import KnowledgeLevel, knowledge_of
from models.diagnosis.networks.equations import EQUATIONS
from models.diagnosis.networks.relation import window_view
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError, RecordingError
from models.machine import load_machine
from simulator.training.draws import Draw, Purpose, simulate_window
from tests.sure import sure

LAB = load_machine("lab")


def _learn(over: Over) -> int:
    return sum(over("adding", abs, [1, -2, 3]))


def _measure(learned: int, number: int) -> list[dict[str, Value]]:
    return [{"method": by, "named": number % 2 == 0, "sum": learned} for by in ("likelihood", "network")]


def _goals(records: Sequence[Record]) -> Iterator[Goal]:
    yield at_least("named", rate(row["named"] for row in records), 0.9)


def _charts(records: Sequence[Record]) -> Iterator[Chart]:
    share = sure(rate(row["named"] for row in records))
    yield Chart("toy", "A caption", {"panel": {"one": [("a", share), ("b", 0.5)]}}, "what", "share")
    yield Chart("toy-steps", "Steps", {"panel": {"one": [(1.0, 0.5), (2.0, 1.0)]}}, "s", "found", steps=True)


def toy(windows: int = 4, machine: str = "none") -> Study:
    """A study under a name that has texts for its page."""
    columns = {"named": lambda rows: rate(row["named"] for row in rows)}
    return Study(
        name="sensors", cells=tuple(Cell({"changed": changed}, windows, _measure) for changed in ("healthy", "e +20%")),
        tables=(Table("toy", ("changed", "method"), columns, page="Everything:"),), goals=_goals, charts=_charts,
        learn=_learn, made_with={"machine": machine},
    )  # fmt: skip


@pytest.mark.parametrize("processes", [1, 2])
def test_an_interrupted_study_carries_on_and_gives_the_same_records(tmp_path: Path, processes: int) -> None:
    with spread_over(processes) as spread:
        kept = run(toy(), Options(windows=4), tmp_path, spread)
        whole = kept.read_text(encoding="utf-8")
        assert len(read(toy(), tmp_path)) == 2 * 4 * 2
        kept.write_text(whole[: len(whole) * 2 // 3], encoding="utf-8")  # in the middle of a line
        assert 0 < len(read(toy(), tmp_path)) < 16
        run(toy(), Options(windows=4), tmp_path, spread)
    assert kept.read_text(encoding="utf-8") == whole
    assert {record["sum"] for record in read(toy(), tmp_path)} == {6}


def test_windows_can_be_added_but_another_plan_is_refused(tmp_path: Path) -> None:
    run(toy(2), Options(windows=2), tmp_path, map)
    kept = run(toy(3), Options(windows=3), tmp_path, map)
    assert (len(read(toy(3), tmp_path)), len(read(toy(2), tmp_path))) == (12, 8)
    for study, options in ((toy(), Options(seed=5)), (toy(machine="other"), Options())):
        with pytest.raises(RecordingError, match="choose another --out"):
            run(study, options, tmp_path, map)
    kept.write_text("nonsense\n", encoding="utf-8")
    with pytest.raises(RecordingError, match="is not JSON"):
        read(toy(), tmp_path)


def test_the_page_has_figures_goals_and_how_to_run_it_again(tmp_path: Path) -> None:
    run(toy(), Options(windows=4), tmp_path, map)
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


def test_wrong_arguments_exit_with_2_and_a_message(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("name", command.STUDIES)
def test_the_cells_of_a_study_can_be_pickled(name: str) -> None:
    study = command.STUDIES[name](Options(windows=2, small=True))
    assert pickle.loads(pickle.dumps(study.cells))  # noqa: S301  # what was just written


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


def test_machine_files_have_the_knowledge_level_asked_for() -> None:
    for name in SUBJECTS:
        subject = subject_named(name)
        for level in KnowledgeLevel:
            file = subject.file(level)
            assert (file is None) == (level is not KnowledgeLevel.NONE and name not in SHIPPED)
            assert file is None or knowledge_of(file).level is level
    with pytest.raises(KeyError):
        subject_named("nobody")


def shares(count: int, of: int) -> Estimate:
    return sure(rate([True] * count + [False] * (of - count)))


def test_rates_have_clopper_pearson_intervals() -> None:
    nothing, some, everything = shares(0, 100), shares(5, 100), shares(100, 100)
    assert (nothing.low, nothing.high) == pytest.approx((0.0, 0.0362), abs=1e-4)
    assert (some.low, some.high) == pytest.approx((0.0164, 0.1128), abs=1e-4)
    assert (everything.low, everything.high) == pytest.approx((0.9638, 1.0), abs=1e-4)
    assert rate([]) is None


def test_intervals_by_resampling_are_those_of_the_normal_distribution() -> None:
    values = np.random.default_rng(99).standard_normal(4000)
    found = resampled(lambda x: np.asarray(np.std(x, axis=-1)), values)
    assert found.low == pytest.approx(found.value * (1 - 1.96 / np.sqrt(8000)), rel=0.01)
    assert found.high == pytest.approx(found.value * (1 + 1.96 / np.sqrt(8000)), rel=0.01)


def test_a_spread_is_robust_and_needs_four_windows() -> None:
    # Median 0.005, distances 0.025, 0.005, 0.005, 0.045 with the median 0.015.
    found = sure(scatter("off")([{"off": off} for off in (-0.02, 0.0, 0.01, 0.05, None)]))
    assert found.value == pytest.approx(1.4826 * 0.015)
    assert scatter("off")([{"off": off} for off in (0.1, 0.2, 0.3)]) is None
    assert robust(np.array([1.0, 2.0, 1e9])) == pytest.approx(1.4826)


def test_a_goal_is_missed_only_where_the_whole_interval_misses_it_and_not_by_chance() -> None:
    found = shares(80, 100)
    assert at_least("found", found, 0.79).verdict == "met"
    assert at_least("found", found, 0.85).verdict == "within chance"
    assert at_least("found", found, 0.95).verdict == "missed"
    assert at_most("found", found, 0.5).verdict == "missed"
    assert at_most("found", None, 0.5).verdict == "–"
    covered = {"e": shares(94, 100), "k_by": shares(999, 1000)}
    judged = within("covered", covered, 0.93, 0.97)
    assert judged.verdict == "missed"
    assert "1 of 2 inside; worst k_by: 99.9 %" in judged.measured
    assert judged.declared == "93 % to 97 %"
    judged = within("found", {"k_by": shares(40, 40), "c_by": shares(39, 40)}, 0.95, 1.0)
    assert "2 of 2 inside; worst c_by: 97.5 %" in judged.measured
    off, good = shares(85, 100), shares(95, 100)
    assert within("covered", {"one": off}, 0.93, 0.97).verdict == "missed"
    assert within("covered", {"one": off} | {str(n): good for n in range(20)}, 0.93, 0.97).verdict == "within chance"
    assert holding("false alarms", {"lab": shares(5, 50)}, 0.01).verdict == "missed"


def test_limits_keep_the_declared_rate_alone_and_together_whatever_the_scale() -> None:
    """400 repetitions of 99 healthy windows and 50 further ones; seed 9."""
    rng = np.random.default_rng(9)

    def drawn(count: int) -> list[dict[str, float]]:
        return [{"small": one, "large": 1000 * other} for one, other in rng.lognormal(size=(count, 2)).tolist()]

    exceeded, alone, of_one = [], [], []
    for _ in range(400):
        healthy = drawn(99)
        limits, limit = limits_of(healthy, 0.05), limit_of(np.array([one["small"] for one in healthy]), 0.05)
        later = drawn(50)
        of_one.append(np.mean([one["small"] > limit for one in later]))
        found = [{name for name, value in one.items() if value > limits[name]} for one in later]
        exceeded.append(np.mean([bool(one) for one in found]))
        alone += [name for one in found for name in one]
    assert np.mean(of_one) == pytest.approx(0.05, abs=0.006)
    assert np.mean(exceeded) == pytest.approx(0.05, abs=0.006)
    assert alone.count("small") / len(alone) == pytest.approx(0.5, abs=0.1)
    with pytest.raises(EstimationError, match="expected at least 99"):
        limit_of(np.ones(98), 0.01)


def test_the_physics_hash_covers_what_networks_depend_on() -> None:
    lab = load_machine("lab")
    alarm = lab.model_copy(update={"alarms": lab.alarms.model_copy(update={"on_delay_s": 61.0})})
    rotor = lab.model_copy(update={"rotor": lab.rotor.model_copy(update={"m1_kg": 0.51})})
    assert physics_hash(alarm) == physics_hash(lab)
    assert physics_hash(rotor) != physics_hash(lab)


def test_figures_use_only_the_selected_records() -> None:
    records = [{"method": by, "named": by != "paper", "e": None} for by in ("likelihood", "network", "paper")]
    assert [row["method"] for row in where(records, method=("paper", "network"), e=None)] == ["network", "paper"]
    assert among(share("named"), method=("likelihood", "network"))(records) == shares(2, 2)
    assert among(share("named"), method="nobody")(records) is None


def test_a_table_has_a_row_for_every_group_and_is_written_with_intervals(tmp_path: Path) -> None:
    records = [{"method": by, "named": n < 3, "error": float(n)} for by in ("likelihood", "network") for n in range(4)]
    columns = {"named": lambda rows: rate(row["named"] for row in rows), "largest": lambda rows: rows[-1]["error"]}
    table = Table("groups", ("method",), columns, lambda rows: (row for row in rows if row["error"]))
    first, second = table.of(records)
    assert (first["method"], first["named"], second["largest"]) == ("likelihood", shares(2, 3), 3.0)
    with table.write(records, tmp_path).open(encoding="utf-8") as written:
        rows = list(csv.DictReader(written))
    assert [row["named windows"] for row in rows] == ["3", "3"]
    assert float(rows[0]["named low"]) == pytest.approx(shares(2, 3).low, rel=1e-4)


SHORT = LAB.model_copy(update={"window": LAB.window.model_copy(update={"length_s": 20.0})})
PRESENT = next(variant for variant in VARIANTS if variant.label.endswith("(the present one)"))


@pytest.fixture(scope="module")
def window() -> WindowStatistics:
    return simulate_window(Draw(SHORT, 41, Purpose.EVALUATION), 0)


@pytest.mark.parametrize("number", ["28", "29", "31"])
def test_the_variant_with_everything_on_equals_the_equation_of_the_table(window: WindowStatistics, number: str) -> None:
    equation = next(one for one in EQUATIONS if one.number == number)
    rows = variant_equation(PRESENT, number).rows(window_view(window, SHORT), SHORT)
    expected = equation.rows(window_view(window, SHORT), SHORT)
    for name in ("inputs", "target", "signatures"):
        np.testing.assert_array_equal(getattr(rows, name), getattr(expected, name))


def test_y1_alone_without_tilt_is_the_printed_equation_28(window: WindowStatistics) -> None:
    variant = replace(PRESENT, has=PRESENT.has - {"references", "tilt"})
    view = window_view(window, SHORT)
    rows = variant_equation(variant, "28").rows(view, SHORT)
    R, at = view.correlation, view.states.index
    printed = np.stack([R[:, at("y1"), at(name)] for name in ("y1", "y2", "y1_dot")], axis=1)
    np.testing.assert_array_equal(rows.inputs, printed)
    np.testing.assert_array_equal(rows.target, R[:, at("y1_dot"), at("y1_dot")])
    k_over_m = LAB.rotor.k_by_N_per_m / LAB.rotor.m1_kg
    np.testing.assert_allclose(rows.signatures[:, 0], k_over_m * printed[:, 0])


def test_a_given_unit_replaces_the_norm(window: WindowStatistics) -> None:
    view = window_view(window, SHORT)
    equation = variant_equation(PRESENT, "28")
    rows = equation.rows(view, SHORT)
    in_unit = replace(equation, unit=2 * rows.norm).rows(view, SHORT)  # type: ignore[call-arg]  # 28 has a unit
    assert in_unit.norm == 1
    np.testing.assert_allclose(in_unit.target, rows.target / (2 * rows.norm))


def test_the_synchronous_part_is_restored_as_in_the_paper(window: WindowStatistics) -> None:
    seen = as_seen(replace(PRESENT, has=PRESENT.has - {"synchronous"}), window)
    i, j = window.states.index("y1"), window.states.index("z2")
    np.testing.assert_allclose(seen.correlation[:, i, j], full_correlation(window, "y1", "z2"))
    assert as_seen(PRESENT, window) is window


def test_the_residual_of_the_linear_fit_is_orthogonal_to_its_inputs(window: WindowStatistics) -> None:
    equation = variant_equation(PRESENT, "31")
    rows = equation.rows(window_view(window, SHORT), SHORT)
    fit = linear_fit(equation, [window], SHORT)
    residual = rows.target / rows.norm - fit(rows.inputs / rows.norm)
    projected = (rows.inputs / np.linalg.norm(rows.inputs, axis=0)).T @ residual
    assert np.abs(projected).max() < 1e-8
    assert 0 < np.mean(residual**2) < 0.2
