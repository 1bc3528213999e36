"""From evaluated windows to the results page: sums with known answers, and a short evaluation for real."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from models.physics.parameters import PARAMETERS
from simulator.campaigns.evaluate_command import read_summaries
from simulator.campaigns.evaluation import Opinion, WindowRecord, read_records
from simulator.campaigns.evaluation_cells import Topic, cells_for
from simulator.campaigns.evaluation_goals import Goal, goals, length_exponent
from simulator.campaigns.evaluation_summary import Campaign, Interval, Summary, summarise
from simulator.campaigns.rates import Rate
from simulator.campaigns.results_page import page
from simulator.campaigns.results_plots import FIGURES, draw_results, figure_name
from simulator.training.draws import Anomaly, Excitation, Layout

SEED = 99


def campaign(machine: str = "lab", *, full: bool = True) -> Campaign:
    return Campaign(machine=machine, physics="abc", seed=SEED, windows=4, fault=0.2, full=full)


def window(
    number: int,
    *,
    cell: int = 0,
    topic: Topic = Topic.HEALTHY,
    layout: Layout = Layout.INDEPENDENT,
    truth: dict[str, float] | None = None,
    length_s: float = 60.0,
    bound: dict[str, float] | None = None,
    anomaly: Anomaly = Anomaly.NONE,
    excitation: Excitation = Excitation.SECOND_ORDER,
    **said: Opinion,
) -> WindowRecord:
    return WindowRecord(
        cell=cell,
        topic=topic,
        number=number,
        layout=layout,
        excitation=excitation,
        anomaly=anomaly,
        length_s=length_s,
        truth=truth or {},
        cutoff_hz=50.0,
        noise_relative=0.02,
        bound=bound or {},
        opinions=dict(said),
    )


def test_bias_spread_and_coverage_of_four_windows() -> None:
    readings = (-0.22, -0.20, -0.19, -0.15)
    records = [
        window(
            n,
            topic=Topic.SMALL,
            truth={"k_by": -0.2},
            bound={"k_by": 0.005},
            likelihood=Opinion(
                change={"k_by": reading},
                error={"k_by": 0.01},
                named=(("k_by",), ()),
                outside=(False, False),
                seconds=0.001 * (n + 1),
            ),
        )
        for n, reading in enumerate(readings)
    ]
    (cell,) = summarise(records, campaign()).cells
    opinion = cell.opinions["likelihood"]
    one = opinion.parameter("k_by")
    assert one is not None
    assert (one.truth, one.n, one.standard_error, one.bound) == (-0.2, 4, 0.01, 0.005)
    assert one.median == pytest.approx(-0.195)
    assert one.bias == pytest.approx(0.01)
    assert one.bias_in_errors.value == pytest.approx(1.0)
    # Deviations -0.02, 0, 0.01, 0.05: median 0.005, distances 0.025, 0.005, 0.005, 0.045 with the median 0.015.
    assert one.spread is not None
    assert one.spread_in_errors is not None
    assert one.spread_in_bounds is not None
    assert one.spread.value == pytest.approx(1.4826 * 0.015)
    assert one.spread_in_errors.value == pytest.approx(1.4826 * 1.5)
    assert one.spread_in_bounds.value == pytest.approx(1.4826 * 3.0)
    assert one.spread.low <= one.spread.value <= one.spread.high
    assert one.rms == pytest.approx(np.sqrt((0.02**2 + 0.01**2 + 0.05**2) / 4))
    assert one.covered == Rate.of_counts(2, 4)  # 1.96 standard errors: -0.22 and -0.15 are farther off
    assert one.found == (Rate.of_counts(4, 4), Rate.of_counts(0, 4))
    assert one.mistaken == ()
    assert opinion.milliseconds == pytest.approx(2.5)


def test_named_sets_refusals_and_claims_are_counted_of_all_windows() -> None:
    said = [
        Opinion(named=(("k_by", "e"), ("k_by", "e")), outside=(False, False), change={"e": 0.1}, error={"e": 0.01}),
        Opinion(named=(("k_by", "c_bz"), ("k_by",)), outside=(True, False), suspect="gain of y1 (+10.0%)"),
        Opinion(named=(("EI",), ()), outside=(False, False), suspect="gain of y1 (+9.1%)"),
        Opinion(refused="too few averages"),
    ]
    records = [
        window(n, truth={"k_by": -0.2, "e": 0.1}, topic=Topic.PAPER, likelihood=one) for n, one in enumerate(said)
    ]
    opinion = summarise(records, campaign()).cells[0].opinions["likelihood"]
    assert (opinion.n, opinion.refused, opinion.reasons) == (4, 1, {"too few averages": 1})
    assert [rate.count for rate in opinion.exact] == [1, 1]
    assert [rate.count for rate in opinion.wrong] == [2, 0]
    assert [rate.count for rate in opinion.any_named] == [3, 2]
    assert [rate.count for rate in opinion.outside] == [1, 0]
    assert [rate.count for rate in opinion.noticed] == [2, 2]
    assert [rate.count for rate in opinion.claimed] == [1, 2]
    assert [rate.count for rate in opinion.claimed_shaft] == [1, 0]
    assert {rate.of for rate in opinion.exact} == {4}
    assert opinion.suspects == {"gain of y1": 2}
    e = opinion.parameter("e")
    assert e is not None
    assert (e.n, e.found[0]) == (1, Rate.of_counts(1, 4))  # named counts all windows, readings only those that exist


def test_changes_drawn_for_every_window_are_told_apart() -> None:
    named = Opinion(change={"e": 0.1}, error={"e": 0.05}, named=(("e",), ()), outside=(False, False))
    records = [
        window(0, topic=Topic.DETECTABLE, truth={"e": 0.1}, likelihood=named),
        window(1, topic=Topic.DETECTABLE, truth={"k_by": -0.02}, likelihood=named),
        window(2, topic=Topic.DETECTABLE, truth={"e": 0.1}, layout=Layout.ONE_SOURCE, likelihood=named),
    ]
    one_source, independent = summarise(records, campaign()).cells
    assert (one_source.layout, one_source.n) == (Layout.ONE_SOURCE, 1)
    assert independent.truth is None
    e = independent.opinions["likelihood"].parameter("e")
    assert e is not None
    assert e.truth is None
    assert (e.found[0], e.mistaken[0]) == (Rate.of_counts(1, 1), Rate.of_counts(1, 1))


def test_a_summary_survives_its_file_and_needs_windows() -> None:
    summary = of_everything(n=5)
    assert Summary.model_validate_json(summary.model_dump_json()) == summary
    with pytest.raises(ValueError, match="lab: no evaluated windows"):
        summarise([], campaign())


def of_everything(n: int, *, scale: float = 1.0, machine: str = "lab") -> Summary:
    """Every topic, errors as stated times `scale`, spread as 1/√T; every change is named, and nothing else."""
    rng = np.random.default_rng([SEED, n])
    records = []

    def said(truth: dict[str, float], length_s: float) -> tuple[dict[str, float], Opinion]:
        error = {name: 0.01 * (60 / length_s) ** 0.5 * float(rng.uniform(0.5, 2)) for name in PARAMETERS}
        change = {p: truth.get(p, 0.0) + scale * error[p] * float(rng.standard_normal()) for p in PARAMETERS}
        opinion = Opinion(
            change=change,
            error=error,
            named=(tuple(truth), ()),
            outside=(False, False),
            misfit_z=float(rng.standard_normal()),
            seconds=0.002,
        )
        return error, opinion

    kinds: list[tuple[Topic, dict[str, float], float, Anomaly, Excitation]] = [
        (Topic.HEALTHY, {}, 60.0, Anomaly.NONE, Excitation.SECOND_ORDER),
        (Topic.SMALL, {"k_by": -0.02, "c_bz": -0.1, "e": 0.1}, 60.0, Anomaly.NONE, Excitation.SECOND_ORDER),
        (Topic.SMALL, {"k_bz": -0.05, "c_by": -0.05, "e": 0.05}, 60.0, Anomaly.NONE, Excitation.SECOND_ORDER),
        *(
            (Topic.PAPER, {p: 0.2 if p == "e" else -0.2}, 60.0, Anomaly.NONE, Excitation.SECOND_ORDER)
            for p in PARAMETERS
        ),
        (Topic.EXCITATION, {}, 60.0, Anomaly.NONE, Excitation.HUMP),
        (Topic.DETECTABLE, {"e": 0.03}, 60.0, Anomaly.NONE, Excitation.SECOND_ORDER),
        (Topic.OUTSIDE, {}, 60.0, Anomaly.CRACK, Excitation.SECOND_ORDER),
        *((Topic.LENGTH, {}, length, Anomaly.NONE, Excitation.SECOND_ORDER) for length in (15.0, 240.0, 600.0)),
    ]
    for cell, (topic, truth, length_s, anomaly, excitation) in enumerate(kinds):
        for layout in Layout:
            for number in range(n):
                bound, opinion = said(truth, length_s)
                records.append(
                    window(
                        number,
                        cell=2 * cell + layout,
                        topic=topic,
                        layout=layout,
                        truth=truth,
                        length_s=length_s,
                        bound=bound if topic in {Topic.HEALTHY, Topic.LENGTH} else None,
                        anomaly=anomaly,
                        excitation=excitation,
                        likelihood=opinion,
                        network=opinion,
                    )
                )
    return summarise(records, campaign(machine))


def goal(summary: Summary, beginning: str) -> Goal:
    (found,) = [one for one in goals(summary) if one.what.startswith(beginning)]
    return found


@pytest.mark.long
def test_goals_are_met_where_errors_are_as_stated_and_missed_where_they_are_not() -> None:
    honest, wide = of_everything(n=200), of_everything(n=200, scale=1.6)
    spread = "likelihood: spread of k_by, independent sources"
    assert goal(honest, spread).met
    assert not goal(wide, spread).met
    assert goal(wide, spread).certain
    assert goal(wide, spread).verdict == "**no**"
    coverage = "likelihood: 95 % intervals cover, every parameter, changed windows, independent"
    assert goal(honest, coverage).met
    assert not goal(wide, coverage).met
    assert "0 of 6 inside" in goal(wide, coverage).measured
    bias = "likelihood: bias of every parameter, excitation untold, one source"
    assert goal(honest, bias).met
    assert goal(honest, "likelihood: spread of every parameter, excitation untold, one source").met
    assert not goal(wide, "likelihood: spread of every parameter, excitation untold, one source").met
    assert not goal(honest, "likelihood: detected at the quoted minimum").met  # all found is more than 98 %
    assert not goal(honest, "network: processor time").met
    for layout in Layout:
        exponent = length_exponent(honest, layout, "c_by")
        assert exponent is not None
        assert exponent.low <= -0.5 <= exponent.high
        assert exponent.high - exponent.low < 0.2


def test_false_alarms_are_judged_by_their_interval() -> None:
    def judged(alarms: int) -> Goal:
        named = [Opinion(named=(("e",), ()) if n < alarms else ((), ()), outside=(False, False)) for n in range(400)]
        summary = summarise([window(n, likelihood=one) for n, one in enumerate(named)], campaign())
        return next(one for one in goals(summary) if one.what.startswith("likelihood: false alarms"))

    assert judged(4).met
    assert not judged(20).met
    assert judged(20).measured.endswith("20 of 400)")


@pytest.mark.long
def test_the_page_has_every_table_and_figure_and_says_what_was_missed(tmp_path: Path) -> None:
    summaries = [of_everything(n=8, machine="light"), of_everything(n=8, scale=3)]
    figures = tmp_path / "figures"
    figures.mkdir()
    drawn = [path for summary in summaries for path in draw_results(summary, figures)]
    assert {path.name for path in drawn} == {figure_name(summary, name) for summary in summaries for name in FIGURES}
    assert all(path.stat().st_size < 150_000 for path in drawn)
    text = page(summaries, ["## From elsewhere\n\nA sentence.\n"])
    assert text.index("## Machine lab") < text.index("## Machine light") < text.index("## From elsewhere")
    for machine in ("lab", "light"):
        for heading in (
            "How sharp: healthy windows",
            "Changes: read and named",
            "Which parameters: the set that is named",
            "False alarms: healthy windows",
            "95 % intervals",
            "Power at the quoted minimum detectable change",
            "Excitation the model was not told about",
            "Window length",
            "Outside the model",
            "Cost",
        ):
            section = text.split(f"### {heading} ({machine})")[1].split("\n##")[0]
            assert re.search(r"^\|(---\|)+\n\| ", section, re.MULTILINE), f"{heading} ({machine}) has no table"
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        assert len({line.count("|") for line in block.splitlines()}) == 1, block
    for target in re.findall(r"\]\(([^)]+)\)", text):
        assert (tmp_path / target).exists()
    assert "Missed beyond chance:" in text
    assert not re.search(r"\b(nan|inf|None)\b", text)
    assert all(len(line) <= 120 for line in text.splitlines() if not line.startswith(("|", "!", "rotortrain")))
    with pytest.raises(ValueError, match="no summaries"):
        page([], [])


def test_intervals_by_resampling_are_those_of_the_normal_distribution() -> None:
    values = np.random.default_rng(SEED).standard_normal(4000)
    interval = Interval.resampled(lambda x: np.asarray(np.std(x, axis=-1)), values)
    assert interval.low == pytest.approx(interval.value * (1 - 1.96 / np.sqrt(8000)), rel=0.01)
    assert interval.high == pytest.approx(interval.value * (1 + 1.96 / np.sqrt(8000)), rel=0.01)


def test_rates_have_clopper_pearson_intervals() -> None:
    nothing, some, everything = Rate.of_counts(0, 100), Rate.of_counts(5, 100), Rate.of_counts(100, 100)
    assert (nothing.low, nothing.high) == pytest.approx((0.0, 0.0362), abs=1e-4)
    assert (some.low, some.high) == pytest.approx((0.0164, 0.1128), abs=1e-4)
    assert (everything.low, everything.high) == pytest.approx((0.9638, 1.0), abs=1e-4)


def evaluate(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "simulator.rotortrain", "evaluate", "--processes", "1", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.long
def test_a_quick_evaluation_is_kept_carried_on_and_written_up(tmp_path: Path) -> None:
    out, written = tmp_path / "evaluation", tmp_path / "docs" / "results.md"
    size = ("--quick", "--windows", "2", "--seed", str(SEED), "--out", str(out))
    done = evaluate("-m", "lab", "-b", "lab", *size, "--page", str(written))
    assert done.returncode == 0, done.stderr
    records = list(read_records(out / "lab.jsonl"))
    assert len(records) == sum(max(2, round(2 * cell.windows)) for cell in cells_for(0.2, full=False))
    (summary,) = read_summaries(out)
    assert summary.windows == len(records)
    assert summary.diagnosticians[0] == "likelihood"
    assert {"likelihood", "relation"} <= set(summary.diagnosticians)
    for record in records:
        likelihood = record.opinions["likelihood"]
        for name in PARAMETERS:
            truth = record.truth.get(name, 0.0)
            assert likelihood.change[name] == pytest.approx(truth, abs=6 * likelihood.error[name])
        if record.layout is Layout.ONE_SOURCE:
            assert set(record.truth) <= set(likelihood.named[0])
    text = written.read_text(encoding="utf-8")
    assert f"--windows 2 --fault 0.2 --seed {SEED}" in text
    for target in re.findall(r"\]\(([^)]+)\)", text):
        assert (written.parent / target).exists()

    kept = (out / "lab.jsonl").read_text(encoding="utf-8").splitlines(keepends=True)
    (out / "lab.jsonl").write_text("".join(kept[:-1]), encoding="utf-8")
    done = evaluate("-m", "lab", "-b", "lab", *size)
    assert done.returncode == 0, done.stderr
    again = (out / "lab.jsonl").read_text(encoding="utf-8").splitlines(keepends=True)
    assert again[:-1] == kept[:-1]
    last, before = json.loads(again[-1]), json.loads(kept[-1])
    for one in (*last["opinions"].values(), *before["opinions"].values()):
        del one["seconds"]
    assert last == before

    done = evaluate("-m", "lab", "-b", "lab", *size, "--seed", "5")
    assert done.returncode == 2
    assert f"seed is {SEED} there, expected 5" in done.stderr
