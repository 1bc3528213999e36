"""The report of a commissioning, on the page and in the terminal, for recordings at every knowledge level."""

import json
import re
from collections.abc import Callable, Iterator
from functools import cache
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path

import pytest
from markupsafe import Markup
from matplotlib.figure import Figure
from rich.console import Console

from models.commissioning.commission import Commissioning, CommissioningReport, ParameterSummary
from models.commissioning.healthy import HealthyRecording
from models.errors import RecordingError
from models.levels.limits import MEASURE_WORDS
from models.machine import MachineFile, Operation
from simulator.commission.command import print_report
from simulator.commission.page import HTML, JSON, write_report
from simulator.commission.verdict import (
    budget_sentences,
    dominant,
    duration,
    growth_sentence,
    headline,
    next_steps,
    parameter_value,
    percent,
    smallest_change,
)
from simulator.scenario import load_scenario
from simulator.stream import blocks
from tests.commissioning.rotor_kit import (
    LAB,
    NOTHING,
    PARTIAL,
    commissioned,
    elsewhere,
    healthy,
    humming,
    mounted,
    recording,
    stream,
    with_sensors,
)
from tests.sure import sure

VOID = {"meta", "br", "link", "img", "hr", "input"}
MEASURES = (
    "healthy_spread", "window_error", "commissioning_error", "detectable_loss", "detectable_gain",
    "window_s_for_wished", "healthy_s_for_wished",
)  # fmt: skip
RUDE = '<script>alert("1")</script> & co.mcap'

Case = tuple[Commissioning, tuple[HealthyRecording, ...], MachineFile]


class Page(HTMLParser):
    """Elements and texts of a page; a page whose elements do not close in order is an error."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.texts: list[str] = []
        self.rows: dict[str, list[tuple[float, str]]] = {}
        self._open: list[tuple[str, dict[str, str]]] = []
        self.feed(text)
        self.close()
        assert not self._open, f"never closed: {self._open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attrs}
        self.elements.append((tag, found))
        if tag not in VOID:
            self._open.append((tag, found))

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        opened, _ = self._open.pop()
        assert opened == tag, f"<{opened}> is closed by </{tag}>"

    def handle_data(self, data: str) -> None:
        tags = [tag for tag, _ in self._open]
        if tags and tags[-1] == "data":
            row = next(attrs["id"] for tag, attrs in reversed(self._open) if tag == "tr")
            self.rows.setdefault(row, []).append((float(self._open[-1][1]["value"]), data))
        if "style" not in tags:
            self.texts.append(data)

    @property
    def text(self) -> str:
        """The visible text, with white space collapsed."""
        return " ".join(" ".join(self.texts).split())


def without_reference(operation: Operation | None) -> tuple[MachineFile, tuple[HealthyRecording]]:
    """Displacements alone, no shaft angle, and a block is missing."""
    whole = [block for number, block in enumerate(stream(85.0, 63)) if number != 100]
    machine, blocks = with_sensors(NOTHING, whole, lambda sensor: sensor.quantity == "displacement")
    machine = machine.model_copy(update={"operation": operation})
    return machine, (recording(machine, blocks),)


MADE_OF: dict[str, Callable[[], tuple[MachineFile, tuple[HealthyRecording, ...]]]] = {
    "full": lambda: (LAB, (healthy(LAB, 70.0, 64),)),
    "partial": lambda: (PARTIAL, (healthy(PARTIAL, 70.0, 66, RUDE),)),
    "none": lambda: (NOTHING, (healthy(NOTHING, 70.0, 67), healthy(NOTHING, 40.0, 68, RUDE))),
    # All is known of the machine, but its sensors measure no modelled motion.
    "casing": lambda: (elsewhere(LAB), (healthy(elsewhere(LAB), 70.0, 60105),)),
    "too short": lambda: (NOTHING, (healthy(NOTHING, 30.0, 69),)),
    "no hop": lambda: (NOTHING, (healthy(NOTHING, 3.0, 70),)),
    "second excitation": lambda: (NOTHING, (recording(NOTHING, humming(stream(70.0, 61), 41.4), RUDE),)),
    "no speed": lambda: without_reference(None),
    "no phase reference": lambda: without_reference(Operation(speed_rpm=1320.0)),
}


@cache
def case(name: str) -> Case:
    machine, recordings = MADE_OF[name]()
    return commissioned(machine, *recordings), recordings, machine


LEVELS = ("full", "partial", "none")
REFUSED = ("too short", "no hop", "second excitation", "no speed")
CASES = tuple(MADE_OF)
DRAWN = ("none", "no speed", "casing")
"""Cases whose pictures become SVG, which takes seconds; those of the others are only painted."""


def painted(_: str, label: str, paint: Callable[[], Figure | None]) -> Markup | None:
    return None if paint() is None else Markup('<svg aria-label="{}"></svg>').format(label)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("reports")


def written(folder: Path, name: str) -> tuple[str, CommissioningReport]:
    """Text of the page of a case, and the report in its JSON file."""
    place = folder / name.replace(" ", "-")
    if not (place / HTML).exists():
        made, recordings, machine = case(name)
        with pytest.MonkeyPatch.context() as patch:
            if name not in DRAWN:
                patch.setattr("simulator.commission.page.inline_svg", painted)
            page = write_report(place, made.report, recordings, machine=machine, commissioned=made.commissioned)
        assert page == place / HTML
    report = CommissioningReport.model_validate_json((place / JSON).read_text(encoding="utf-8"))
    return (place / HTML).read_text(encoding="utf-8"), report


def section(text: str, name: str) -> str:
    found = sure(re.search(rf'<section id="{name}">(.*?)</section>', text, re.DOTALL))
    return Page(found[1]).text


def squeezed(text: str) -> str:
    return " ".join(text.split())


@pytest.mark.parametrize("name", CASES)
def test_a_page_is_well_formed_and_self_contained(folder: Path, name: str) -> None:
    text, _ = written(folder, name)
    page = Page(text)
    assert text.startswith("<!doctype html>")
    assert not {tag for tag, _ in page.elements} & {"script", "link", "img", "iframe", "object", "base", "form"}
    assert not re.search(r"https?:|//[a-z]|@import|url\((?!#)", text)
    for _, attributes in page.elements:
        assert not any(attribute.startswith("on") for attribute in attributes)
        assert attributes.get("href", "#").startswith("#")
        assert "src" not in attributes
    names = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(names) == len(set(names))
    asked = re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', text)
    assert {one or other for one, other in asked} <= set(names)


def printed(report: CommissioningReport, width: int = 80) -> str:
    console = Console(file=StringIO(), width=width, highlight=False)
    print_report(report, console)
    file = console.file
    assert isinstance(file, StringIO)
    return file.getvalue()


@pytest.mark.parametrize("name", CASES)
def test_verdict_checks_and_equations_are_complete_in_page_json_and_80_columns(folder: Path, name: str) -> None:
    text, report = written(folder, name)
    verdict, checks = section(text, "verdict"), section(text, "checks")
    assert squeezed(headline(report)) in verdict
    assert report.level.value in verdict
    for step in next_steps(report):
        assert squeezed(step) in verdict
    assert text.count('<tr class="check">') == len(report.checks) > 0
    for check in report.checks:
        assert squeezed(f"{check.name} {check.verdict} {check.text} {check.advice or 'nothing'}") in checks
    equations = section(text, "equations")
    assert len(report.equations) > 6
    for row in report.equations:
        told = "yes" if row.used else f"no: {row.reason}"
        assert squeezed(f"{row.number} {row.title} {', '.join(row.parameters)} {told}") in equations
    assert report == case(name)[0].report
    assert json.loads((folder / name.replace(" ", "-") / JSON).read_text(encoding="utf-8"))["verdict"] == report.verdict
    text = printed(report)
    assert max(len(line.rstrip("\n")) for line in text.splitlines()) <= 80
    assert "…" not in text
    seen = squeezed(text)
    assert squeezed(headline(report)) in seen
    for step in next_steps(report):
        assert step.split()[0] in seen
    wide = squeezed(printed(report, 400))
    for check in report.checks:
        assert squeezed(f"{check.verdict} {check.name} {check.text}") in wide
    for one in report.parameters:
        if one.evaluable:
            assert re.search(rf"^{one.name} .*{percent(sure(one.window_error))} ", text, re.MULTILINE)
        else:
            assert re.search(rf"^{one.name} +not readable", text, re.MULTILINE)


@pytest.mark.parametrize("name", [*LEVELS, "no phase reference"])
def test_the_table_shows_the_figures_of_the_report(folder: Path, name: str) -> None:
    text, report = written(folder, name)
    rows = Page(text).rows
    assert len(report.parameters) == 6
    seen = section(text, "parameters")
    for one in report.parameters:
        assert f"{one.text} {one.name}" in seen
        if not one.evaluable:
            assert f"not readable: {one.reason}" in seen
            assert f"parameter-{one.name}" not in rows
            continue
        expected = [value for field in MEASURES if (value := getattr(one, field)) is not None]
        if one.identified is not None:
            expected.insert(0, one.identified)
        assert [value for value, _ in rows[f"parameter-{one.name}"]] == expected
        words = [shown for _, shown in rows[f"parameter-{one.name}"]]
        assert words == list(_words(one))


def _words(one: ParameterSummary) -> Iterator[str]:
    if one.identified is not None:
        yield parameter_value(one.name, one.identified)
    for error in (one.healthy_spread, one.window_error, one.commissioning_error):
        if error is not None:
            yield percent(error)
    yield from smallest_change(one)
    for seconds in (one.window_s_for_wished, one.healthy_s_for_wished):
        if seconds is not None:
            yield duration(seconds)


def test_the_page_explains_readings_at_each_knowledge_level(folder: Path) -> None:
    full, partial, none = (section(written(folder, name)[0], "parameters") for name in LEVELS)
    assert "taken as exact" in full
    assert "identified" not in full
    for told in (partial, none):
        assert "It is part of every later interval: longer windows do not remove it, but more healthy data do." in told
    report = written(folder, "partial")[1]
    k_by = next(one for one in report.parameters if one.name == "k_by")
    assert k_by.identified == pytest.approx(5e4, rel=0.02)
    assert re.search(r"horizontal k_by (49|50|51)\.\d kN/m", partial)
    assert "identified" not in none
    assert "EI not readable: cannot be told without the rotor's own parameters" in none


@pytest.mark.parametrize("name", REFUSED)
def test_a_refusal_says_why_and_what_to_record_instead(folder: Path, name: str) -> None:
    text, report = written(folder, name)
    assert report.verdict == "refused"
    verdict = section(text, "verdict")
    assert "demo/lab is not commissioned: " in verdict
    advice = [check.advice for check in report.checks if check.verdict == "refused"]
    assert advice
    assert all(f"{one[0].upper()}{one[1:]}." in verdict for one in advice)
    assert "Nothing was stored" in section(text, "identity")
    assert 'class="verdict refused"' in text
    assert "commissioned range" not in text
    assert "--machine FILE@BUNDLE" not in text


def test_a_machine_without_measured_motion_is_compared_by_its_levels(folder: Path) -> None:
    text, report = written(folder, "casing")
    assert report.verdict == "limited"
    told = "the vibration levels of its channels are compared with those of the healthy recordings"
    assert f"with limits: {told}, and no part is diagnosed. What limits it:" in section(text, "verdict")
    assert "only levels are compared; limited by: " in report.summary
    assert "has changed or has not" not in Page(text).text
    assert report.level_text.startswith("no channel is at bearing or disc")
    assert {one.channel for one in report.levels} == {one.name for one in LAB.sensors if one.name != "theta"}


def test_names_and_descriptions_are_escaped_on_the_page(folder: Path, tmp_path: Path) -> None:
    for name in ("partial", "none", "second excitation"):
        text, _ = written(folder, name)
        assert "<script" not in text
        assert RUDE in section(text, "recordings")
    assert f"{RUDE}: a steady line at 41.40 Hz" in section(written(folder, "second excitation")[0], "checks")
    made, recordings, machine = case("no hop")
    rude = machine.model_copy(update={"description": "</p><script>alert(1)</script> pump & motor"})
    text = write_report(tmp_path, made.report, recordings, machine=rude).read_text(encoding="utf-8")
    assert "<script" not in text
    assert "</p><script>alert(1)</script> pump & motor" in Page(text).text


def pictures(text: str) -> dict[str, str]:
    found = re.findall(r"<figure>\s*<h3>(.*?)</h3>\s*(<svg.*?</svg>)\s*<figcaption>(.*?)</figcaption>", text, re.DOTALL)
    assert all(Page(svg).elements[0][1]["aria-label"] == title for title, svg, _ in found)
    return {title: Page(caption).text for title, _, caption in found}


def test_each_page_has_its_pictures_and_captions(folder: Path) -> None:
    everything = [
        "Healthy readings", "What limits each reading", "Spectra of the recordings", "Speed and level over time",
    ]  # fmt: skip
    for name in (*LEVELS, "no phase reference"):
        assert list(pictures(written(folder, name)[0])) == everything
    for name in ("too short", "second excitation", "no speed"):
        assert list(pictures(written(folder, name)[0])) == everything[2:]
    assert pictures(written(folder, "no hop")[0]) == pictures(written(folder, "casing")[0]) == {}
    of = {name: pictures(written(folder, name)[0]) for name in CASES if name not in ("no hop", "casing")}
    spectra = {name: found["Spectra of the recordings"] for name, found in of.items()}
    assert "Shaded: the band that is used, 3 to 150 Hz. Grey: the rotation at 22.0 Hz" in spectra["none"]
    assert "speed is not known" in spectra["no speed"]
    assert "Grey: the rotation at 22.0 Hz" in spectra["no phase reference"]
    assert "A frequency in orange is a steady line" in spectra["second excitation"]
    assert "in orange" not in spectra["none"]
    levels = {name: found["Speed and level over time"] for name, found in of.items()}
    assert "broken where data are missing" in levels["no phase reference"]
    assert "broken" not in levels["full"]
    assert "number at the top" in levels["none"]


def test_pictures_take_the_colours_of_the_page(folder: Path) -> None:
    drawings = re.findall(r"<svg.*?</svg>", written(folder, "none")[0], re.DOTALL)
    assert len(drawings) == 4
    for drawing in drawings:
        assert "var(--ink)" in drawing
        assert "var(--c0)" in drawing
        assert not re.search(r"(?:fill|stroke): (?:#0{6}|#f{6}|black|white)\b", drawing)


def test_recordings_and_commissioned_conditions_are_on_the_page(folder: Path) -> None:
    text, report = written(folder, "none")
    seen = section(text, "recordings")
    assert "1 healthy.mcap 000000000000 2026-01-01 00:00:02 65 s none none 1320 rpm" in seen
    assert "Outside these conditions nothing is evaluated" in seen
    assert "speed 1320 rpm" in seen
    low, high = sure(report.conditions).rms["y2_dot"]
    found = sure(re.search(r"disc, horizontal, velocity ([\d.]+) to ([\d.]+) mm/s rms", seen))
    assert [float(edge) for edge in found.groups()] == pytest.approx([1e3 * low, 1e3 * high], rel=6e-3)
    seen = section(written(folder, "no phase reference")[0], "recordings")
    assert "1, 0.1 s missing" in seen
    assert "one gap of 0.1 s" in section(written(folder, "no phase reference")[0], "checks")
    assert "speed 1320 rpm" in seen


def test_a_page_says_what_it_replaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simulator.commission.page.pictures_of", lambda *_: ())  # they take long
    made, _, machine = case("no phase reference")
    before = sure(made.commissioned)
    after = before.model_copy(update={"version": 2, "replaces": before.identity, "why": "bearing exchanged < today"})
    report = made.report.model_copy(update={"version": 2, "identity": after.identity})
    text = write_report(tmp_path, report, (), machine=machine, commissioned=after).read_text(encoding="utf-8")
    told = section(text, "identity")
    assert f"Version 2 of the commissioning of demo/lab, identity {after.identity} ." in told
    assert f"It replaces {before.identity} , because: bearing exchanged < today." in told
    first = write_report(tmp_path, made.report, (), commissioned=before).read_text(encoding="utf-8")
    assert "It replaces nothing." in section(first, "identity")


def test_the_same_report_makes_the_same_page(tmp_path: Path, folder: Path) -> None:
    made, recordings, machine = case("no speed")
    again = write_report(tmp_path, made.report, recordings, machine=machine, commissioned=made.commissioned)
    assert again.read_text(encoding="utf-8") == written(folder, "no speed")[0]


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    made, recordings, _ = case("no hop")
    (tmp_path / "taken").write_text("", encoding="utf-8")
    with pytest.raises(RecordingError, match=r"taken: the report cannot be written"):
        write_report(tmp_path / "taken", made.report, recordings)


def test_the_dominant_error_follows_from_the_ratio_of_errors() -> None:
    one = next(each for each in case("partial")[0].report.parameters if each.name == "k_by")
    own = sure(one.window_error)
    shares = {0.0: "window", 1 / 2.1: "window", 1.0: "both", 1.9: "both", 2.1: "commissioning"}
    for share, which in shares.items():
        assert dominant(one.model_copy(update={"commissioning_error": share * own})) == which
    assert not dominant(one.model_copy(update={"commissioning_error": None}))


def test_undetectable_changes_are_stated_as_such() -> None:
    one = next(each for each in case("partial")[0].report.parameters if each.name == "c_by")
    poor = one.model_copy(update={"detectable_loss": -1.0, "detectable_gain": 27.0, "window_s_for_wished": 4000.0})
    assert smallest_change(poor) == ("not even all of it", "more than 10-fold")
    report = case("partial")[0].report.model_copy(update={"parameters": (poor,)})
    told = " ".join(budget_sentences(report))
    assert "For c_by the wished change would take a window of more than 60 min, the longest there is" in told
    assert "with the present settings" not in told
    sharp = one.model_copy(update={"detectable_loss": -0.05, "detectable_gain": 0.052, "wished": 0.1})
    told = " ".join(budget_sentences(report.model_copy(update={"parameters": (sharp,)})))
    assert "The wished change of 10% of c_by is found with the present settings." in told


def test_square_brackets_are_printed_literally_in_the_terminal() -> None:
    report = case("too short")[0].report
    check = report.checks[0].model_copy(update={"text": "[red]all[/red] of it [/]"})
    assert "[red]all[/red] of it [/]" in printed(report.model_copy(update={"checks": (check,)}))


def test_the_growth_that_raises_an_alert_is_on_the_page_and_in_the_terminal(folder: Path) -> None:
    text, report = written(folder, "no phase reference")
    assert {one.channel for one in report.levels} == {channel.name for channel in case("no phase reference")[2].sensors}
    growths = [one.model_copy(update={"growth": 0.6 + at / 1e4}) for at, one in enumerate(report.levels)]
    alike = growth_sentence(report.model_copy(update={"levels": tuple(growths)}))
    assert "once it has grown by 60%. A load" in alike
    told = section(text, "levels")
    for one in report.levels:
        growth = sure(one.growth)
        assert growth >= 0.6 - 1e-9  # 1.6 times the healthy level, or further
        assert one.alert == pytest.approx(one.healthy * (1 + growth))
        assert one.windows > 0
        assert f"{one.channel} {MEASURE_WORDS[one.measure]} " in told
        assert f"{100 * growth:.0f}%" in told
    out = printed(report, 400)
    assert "not in the recordings, stronger or from another direction, makes some channels louder" in out
    assert "A level raises an alert, relative to the healthy machine, once it has grown by 60%" in out
    refused, _ = written(folder, "no hop")
    assert 'id="levels"' not in refused


TURNED = mounted(LAB, dict.fromkeys(("y1", "y2", "y1_dot", "y2_dot"), (45, 135)))


@cache
def kit(*, turned: bool, full: bool) -> tuple[Commissioning, HealthyRecording, MachineFile]:
    rotor = TURNED if turned else LAB
    scenario, _ = load_scenario("healthy")
    sensors = scenario.sensors.model_copy(update={"noise_relative": 1e-6})
    scenario = scenario.model_copy(update={"duration_s": 70.0, "seed": 77_205, "sensors": sensors})
    without = rotor.model_dump(exclude={"rotor", "operation", "condition"})
    machine = rotor if full else MachineFile.model_validate(without)
    seen = recording(machine, [block for block, _ in blocks(scenario, rotor, 1.0)])
    return commissioned(machine, seen), seen, machine


@pytest.mark.parametrize("full", [True, pytest.param(False, marks=pytest.mark.long)])
def test_probes_at_an_angle_are_commissioned_as_probes_in_y_and_z(
    full: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, *_ = kit(turned=False, full=full)
    turned, seen, machine = kit(turned=True, full=full)
    assert turned.report.verdict == plain.report.verdict != "refused"
    for one, other in zip(plain.report.parameters, turned.report.parameters, strict=True):
        assert other.name == one.name
        if one.window_error is None:
            assert other.window_error is None
        else:
            assert other.window_error == pytest.approx(one.window_error, rel=0.05)
    learned = sure(turned.commissioned)
    sensors = sure(learned.sensors)
    assert {"bearing@45", "bearing@135_dot"} <= {one.state for one in sensors.channels}
    assert {(one.first, one.second) for one in sensors.pairs} >= {("disc@45", "disc@45_dot")}
    assert set(sure(learned.levels).states[0].levels) == {one.name for one in LAB.sensors[:-1]}
    for picture in ("draw_readings", "draw_budget", "draw_levels"):  # they take long and name no channel
        monkeypatch.setattr(f"simulator.commission.page.{picture}", lambda *_: None)
    page = write_report(tmp_path, turned.report, [seen], machine=machine, commissioned=turned.commissioned)
    assert json.loads((tmp_path / JSON).read_text())["verdict"] == turned.report.verdict
    assert "bearing, at 135°, velocity" in page.read_text(encoding="utf-8")
