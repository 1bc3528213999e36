"""The campaign on machines without parameters: its windows, its records, its sums and its section."""

import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from models.commissioning.knowledge import KnowledgeLevel, knowledge_of
from models.errors import RecordingError
from simulator.campaigns.rates import Rate
from simulator.campaigns.unknown_command import watch_unknown
from simulator.campaigns.unknown_page import BEGIN, END, placed, unknown_section
from simulator.campaigns.unknown_study import CELLS, UnknownPlan, UnknownRecord, read_unknown, run_unknown
from simulator.campaigns.unknown_subjects import SHIPPED, SUBJECTS, Later, subject_named
from simulator.campaigns.unknown_summary import summarize_unknown
from simulator.rotortrain import app
from simulator.training.draws import Layout

NONE = KnowledgeLevel.NONE


def later(**other: object) -> Later:
    values = {"seed": 1, "commissioning": 0, "cell": 0, "number": 0, "layout": Layout.ONE_SOURCE, "changes": {}}
    return Later(**(values | other))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["between", "lab"])
def test_no_two_windows_share_a_realisation_and_the_same_one_comes_again(name: str) -> None:
    subject = subject_named(name)
    asked = [later(), later(number=1), later(cell=1), later(commissioning=1), later(seed=2)]
    windows = [subject.later(which) for which in asked]
    cutoffs = [cutoff_hz for _, cutoff_hz in windows]
    assert len(set(cutoffs)) == len(cutoffs)
    spectra = [window.spectrum[:50, 0, 0].real for window, _ in windows]
    for n, one in enumerate(spectra):
        for other in spectra[:n]:
            assert abs(np.corrcoef(np.log(one), np.log(other))[0, 1]) < 0.999
    assert np.array_equal(subject.later(asked[0])[0].spectrum, windows[0][0].spectrum)
    assert windows[0][0].duration_s == 60.0


def test_healthy_windows_share_their_condition_and_later_ones_have_another_cutoff() -> None:
    subject = subject_named("between")
    first, second = subject.healthy(1, 0, 2)
    (other, _) = subject.healthy(1, 1, 2)
    assert second.start_ns == first.end_ns
    assert second.speed_rad_s == pytest.approx(first.speed_rad_s)
    assert other.speed_rad_s != pytest.approx(first.speed_rad_s, rel=1e-5)
    shipped = subject_named("lab").healthy(1, 0, 2)
    assert shipped[0].speed_rad_s == pytest.approx(shipped[1].speed_rad_s, rel=1e-6)
    assert not np.allclose(shipped[0].correlation[1], shipped[1].correlation[1])


def test_a_true_change_is_in_the_window() -> None:
    subject = subject_named("between")
    changed, _ = subject.later(later(changes={"e": 1.0}))
    healthy, _ = subject.later(later())
    assert changed.synchronous is not None
    assert healthy.synchronous is not None
    # the same random numbers: the stochastic part takes no notice of the unbalance, the synchronous one doubles
    assert np.abs(changed.synchronous[:4] / healthy.synchronous[:4]) == pytest.approx(2, rel=0.35)


@pytest.mark.long
def test_an_interrupted_campaign_carries_on_and_gives_the_same_records(tmp_path: Path) -> None:
    plan = UnknownPlan(("overhung",), (NONE,), seed=5, windows=2, commissionings=1, healthy=4)
    kept = tmp_path / "records.jsonl"
    seen: list[tuple[str, int, int]] = []
    run_unknown(plan, kept, 1, lambda *done: seen.append(done))
    assert seen[0] == ("overhung, none", 0, 12)
    assert seen[-1] == ("overhung, none", 12, 12)
    whole = list(read_unknown(kept))
    assert [(one.cell, one.layout) for one in whole] == [(n // 2, Layout(n % 2)) for n in range(12)]
    assert all(set(one.change) == {"k_by", "c_by", "k_bz", "c_bz", "e"} for one in whole)
    for cell, name in enumerate(("k_by", "c_by", "k_bz", "c_bz"), start=1):
        truth = CELLS[cell][name]
        for one in whole[2 * cell : 2 * cell + 2]:
            assert one.change[name] == pytest.approx(truth, abs=0.4 * abs(truth))
            assert name in one.named
    text = kept.read_text(encoding="utf-8")
    kept.write_text(text[: len(text) * 2 // 3], encoding="utf-8")  # in the middle of a line
    assert 0 < len(list(read_unknown(kept))) < 12
    run_unknown(plan, kept, 1, lambda *_: None)
    assert sorted(read_unknown(kept), key=lambda one: (one.cell, one.number)) == whole
    kept.write_text(text.replace('"cell":1', '"cell":"?"', 1), encoding="utf-8")
    with pytest.raises(RecordingError, match="line 3 is not a record"):
        list(read_unknown(kept))


def test_a_machine_that_cannot_be_commissioned_counts_as_read_in_vain(tmp_path: Path) -> None:
    plan = UnknownPlan(("stuck",), (NONE,), seed=5, windows=1, commissionings=1)
    records = [record(cell, 0, refused="not commissioned: too little") for cell in range(len(CELLS))]
    summary = summarize_unknown(plan, [one.model_copy(update={"machine": "stuck"}) for one in records], {"stuck": "it"})
    for cell in summary.of(NONE, "stuck"):
        assert (cell.exact.count, cell.refused.count, cell.readings) == (0, 1, {})
    assert "| 100 % (2.5–100, 1 of 1) |" in unknown_section(summary)


def record(cell: int, number: int, commissioning: int = 0, **other: object) -> UnknownRecord:
    values = {
        "machine": "overhung",
        "commissioning": commissioning,
        "cell": cell,
        "number": number,
        "layout": Layout(number % 2),
        "cutoff_hz": 50.0,
    }
    return UnknownRecord.model_validate(values | other)


def test_sums_count_what_they_say() -> None:
    plan = UnknownPlan(("overhung",), (NONE,), seed=1, windows=4, commissionings=2)
    records = [
        record(0, 0, named=("e",), change={"k_by": 0.03}, error={"k_by": 0.01}, outside=True),
        record(0, 1, change={"k_by": 0.01}, error={"k_by": 0.01}),
        record(0, 0, 1, change={"k_by": -0.01}, error={"k_by": 0.01}),
        record(0, 1, 1, refused="no"),
        record(1, 0, named=("k_by",), change={"k_by": -0.11}, error={"k_by": 0.01}),
        record(1, 1, named=("k_by", "e"), change={"k_by": -0.13}, error={"k_by": 0.01}),
        record(1, 0, 1, named=("e",), change={"k_by": -0.1}, error={"k_by": 0.01}),
        record(1, 1, 1, change={"k_by": -0.1}, error={"k_by": 0.01}),
        record(1, 2, 1, named=("k_by",)),  # beyond the plan's windows
        record(1, 0, 2, named=("k_by",)),  # beyond its commissionings
    ]
    summary = summarize_unknown(plan, records, {"overhung": "a rotor"})
    healthy, changed = summary.of(NONE, "overhung")
    assert (healthy.windows, changed.windows) == (4, 4)
    assert [one.count for one in (healthy.detected, healthy.exact, healthy.other)] == [1, 2, 1]
    assert [one.count for one in (healthy.outside, healthy.refused)] == [1, 1]
    assert [one.count for one in (changed.detected, changed.exact, changed.other)] == [3, 1, 2]
    assert [one.count for one in changed.by_commissioning] == [1, 0]
    assert healthy.readings["k_by"].covered == Rate.of_counts(2, 3)
    assert healthy.readings["k_by"].z_rms == pytest.approx(math.sqrt(11 / 3))
    assert changed.readings["k_by"].covered == Rate.of_counts(3, 4)
    assert summary.of(NONE, "overhung", Layout.INDEPENDENT)[1].exact == Rate.of_counts(0, 2)
    section = unknown_section(summary)
    assert "| none | **overhung**: a rotor | 25 % (0.631–80.6, 1 of 4) | 25 % (0.631–80.6, 1 of 4) | – |" in section
    assert "| none | overhung | k −10 % located in at least 95 % | 25 %" in section


def test_the_section_replaces_itself_and_leaves_the_rest_of_the_page() -> None:
    page = "# Results\n\nfirst\n\n## Last\n\ntext\n"
    once = placed(page, f"{BEGIN}\nold\n{END}\n")
    assert once.startswith(page.rstrip())
    after = once + "\n## Added later\n"
    twice = placed(after, f"{BEGIN}\nnew\n{END}\n")
    assert twice == after.replace("old", "new")


def test_files_tell_what_their_level_allows() -> None:
    for name in SUBJECTS:
        subject = subject_named(name)
        for level in KnowledgeLevel:
            file = subject.file(level)
            assert file is None or knowledge_of(file).level is level
        assert (subject.file(KnowledgeLevel.FULL) is None) == (name not in SHIPPED)
        partial = subject.file(KnowledgeLevel.PARTIAL)
        assert partial is not None
        assert partial.rotor is not None
        assert set(partial.rotor.unknown) == {"k_by_N_per_m", "k_bz_N_per_m", "c_by_N_s_per_m", "c_bz_N_s_per_m", "e_m"}
        assert partial.window.length_s == 60.0


def test_levels_are_counted_apart(tmp_path: Path) -> None:
    both = (KnowledgeLevel.NONE, KnowledgeLevel.FULL)
    plan = UnknownPlan(("between", "lab"), both, seed=5, windows=1, commissionings=1, healthy=3)
    assert list(plan.pairs()) == [(NONE, "between"), (NONE, "lab"), (KnowledgeLevel.FULL, "lab")]
    full = UnknownPlan(("lab",), (KnowledgeLevel.FULL,), seed=5, windows=1, commissionings=1, healthy=3)
    run_unknown(full, tmp_path / "records.jsonl", 1, lambda *_: None)
    records = list(read_unknown(tmp_path / "records.jsonl"))
    assert [one.named for one in records] == [tuple(truth) for truth in CELLS]
    summary = summarize_unknown(plan, [*records, record(0, 0)], {"between": "", "lab": ""})
    assert summary.pairs == ((KnowledgeLevel.FULL, "lab"),)


def test_every_subject_can_be_had() -> None:
    for name in SUBJECTS:
        assert subject_named(name).description
    with pytest.raises(KeyError):
        subject_named("nobody")


def test_the_command_writes_numbers_section_and_page(tmp_path: Path) -> None:
    page = tmp_path / "results.md"
    page.write_text("# Measured results\n", encoding="utf-8")
    watch_unknown(
        ["overhung"],
        [],
        tmp_path / "out",
        windows=1,
        commissionings=1,
        healthy=3,
        conditions=1,
        seed=9,
        processes=1,
        page=page,
    )
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"9-3x1-records.jsonl", "unknown.json", "unknown.md"}
    text = page.read_text(encoding="utf-8")
    assert text.startswith("# Measured results\n")
    assert (tmp_path / "out" / "unknown.md").read_text(encoding="utf-8").strip() in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--machine", "nobody", "--out", "x"), "--machine nobody: not among overhung, between"),
        (("--level", "some", "--out", "x"), "--level some: not among full, partial, none"),
        (("--out", "x", "--page", "none.md"), "--page none.md: no such page"),
        ((), "Missing option '--out'"),
    ],
)
def test_wrong_arguments_exit_with_2_and_a_sentence(
    arguments: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["unknown", *arguments])
    assert done.exit_code == 2
    assert message in done.output
    assert "Traceback" not in done.output
    assert not list(tmp_path.iterdir())
