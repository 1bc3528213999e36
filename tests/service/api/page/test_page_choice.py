"""What the page shows first of a machine: the page and the service's overview must choose the same."""

import itertools
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

import service.api
from rotorwatch.records.alarms import Alarm
from rotorwatch.records.example import example
from rotorwatch.records.health import Health, Report
from rotorwatch.records.levels import ChannelLevels, LevelLimits
from rotorwatch.records.windows import NaturalFrequency, Parameter
from service.analysis.overview import nearness, overview
from tests.service.api.page.browsing import run_deno
from tests.sure import sure

STATES = Path(service.api.__file__).parent / "page" / "monitor" / "states.js"
RAISED = [(), ("k_by",), ("level:y1",), ("stream-lost",), ("k_by", "level:z1"), ("c_by", "stream-lost", "level:y1")]
CHANGES = [None, -0.2, 0.0, 0.03]
LEVELS: list[list[tuple[float | None, str]]] = [
    [], [(1.4, "normal")], [(3.0, "alert"), (0.1, "normal")], [(None, "normal"), (2.9, "danger")],
]  # fmt: skip
_ASKED = """
import { worst } from "STATES";
const told = await new Response(Deno.stdin.readable).json();
console.log(JSON.stringify(told.map((one) => worst(one))));
"""


def limits(found: list[tuple[float | None, str]]) -> tuple[dict[str, float | None], tuple[LevelLimits, ...]]:
    """Levels of a channel and their limits."""
    measures = ["velocity", "overall"][: len(found)]
    judged = [
        LevelLimits.model_validate({"measure": measure, "alert": 2.8, "source": "", "state": state})
        for measure, (_, state) in zip(measures, found, strict=True)
    ]
    return {measure: value for measure, (value, _) in zip(measures, found, strict=True)}, tuple(judged)


def parameter(read: Parameter, name: str, change: float | None) -> Parameter:
    return read.model_copy(update={"name": name, "text": name, "relative_change": change})


def channel(level: ChannelLevels, name: str, found: list[tuple[float | None, str]]) -> ChannelLevels:
    values, judged = limits(found)
    return level.model_copy(update={"channel": name, "limits": judged, **values})


def healths() -> Iterator[Health]:
    """Every combination of alarms, readings and levels; some parameters have no detectable change."""
    health = Health.model_validate(example(Health))
    report, alarm = sure(health.report), health.alarms[0]
    one, seen, level = report.parameters[0], report.detectable[0], report.levels[0]
    least = [seen.model_copy(update={"name": name, "loss": -0.3, "gain": 0.02}) for name in ("k_by", "c_by")]
    for raised, settled, change, other, y1, z1, known in itertools.product(
        RAISED, (False, True), CHANGES, CHANGES, LEVELS, LEVELS, (1, 2)
    ):
        changes = {"k_by": change, "c_by": other}
        stated = tuple(parameter(one, name, value) for name, value in changes.items())
        made = Report.model_construct(
            **{
                **dict(report),
                **dict.fromkeys(("opinions", "equations", "sensors", "shapes"), ()),
                # Before the verdict is settled, current values differ from those of the whole window.
                "parameters": stated if settled else (*stated[:1], parameter(one, "c_by", 5.0)),
                "detectable": tuple(least[:known]),
                "levels": (channel(level, "y1", y1), channel(level, "z1", z1)),
                "verdict": sure(report.verdict).model_copy(
                    update={"settled": settled, "current": stated, "alternatives": ()}
                ),
            }
        )
        yield health.model_copy(update={"report": made, "alarms": tuple(named(alarm, name) for name in raised)})


def named(alarm: Alarm, name: str) -> Alarm:
    severity = "danger" if name == "c_by" else "alert"
    return Alarm.model_validate(
        {**alarm.model_dump(), "name": name, "text": name, "raised": True, "severity": severity}
    )


Found = tuple[Health, Report, dict[str, object], dict[str, object]]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> list[Found]:
    """Each full health, the report in its overview, and what the page finds worst in either."""
    folder = tmp_path_factory.mktemp("deno")
    script = folder / "ask.js"
    script.write_text(_ASKED.replace("STATES", STATES.as_uri()))
    all_of_them = list(healths())
    briefs = [overview(health) for health in all_of_them]
    told = [one for both in zip(all_of_them, briefs, strict=True) for one in both]
    done = run_deno(folder, "run", str(script), given="[" + ",".join(one.model_dump_json() for one in told) + "]")
    assert done.returncode == 0, done.stderr
    answers = json.loads(done.stdout)
    reports = [sure(one.report) for one in briefs]
    return list(zip(all_of_them, reports, answers[::2], answers[1::2], strict=True))


def test_the_page_agrees_with_the_overview(found: list[Found]) -> None:
    assert len(found) > 6000
    different = [(whole, brief) for *_, whole, brief in found if whole != brief]
    assert not different, different[:3]


def test_an_overview_keeps_only_what_alarms_are_about_or_what_is_nearest_to_its_limit(found: list[Found]) -> None:
    for health, brief, *_ in found:
        near, expected = nearness(sure(health.report)), {alarm.name for alarm in health.alarms}
        if not expected & near.keys():
            expected = {max(near, key=near.__getitem__)}
        parameters = {one.name for one in brief.parameters}
        assert parameters | {f"level:{one.channel}" for one in brief.levels} == expected - {"stream-lost"}
        assert {one.name for one in sure(brief.verdict).current} == parameters
        assert {one.name for one in brief.detectable} <= parameters
    shown = Health.model_validate(example(Health))
    seen = sure(shown.report).model_copy(
        update={"natural_frequencies": (NaturalFrequency.model_validate(example(NaturalFrequency)),)}
    )
    brief = sure(overview(shown.model_copy(update={"report": seen})).report)
    assert (brief.opinions, brief.equations, brief.natural_frequencies, sure(brief.verdict).candidates) == ((),) * 4


def test_the_page_and_the_service_agree_on_nearness_to_limits(found: list[Found]) -> None:
    calm = [(health, whole) for health, _, whole, _ in found if not health.alarms]
    assert len(calm) > 1000
    for health, whole in calm:
        near = nearness(sure(health.report))
        first = max(near, key=near.__getitem__)
        assert whole["nearness"] == pytest.approx(near[first], rel=1e-12)
        series = str(whole["series"])
        assert first == (series if whole["quantity"] == "parameter" else f"level:{series.partition(':')[0]}")


def test_a_narrow_interval_is_not_rounded_to_zero(tmp_path: Path) -> None:
    script = tmp_path / "ask.js"
    figures = STATES.with_name("figures.js").as_uri()
    script.write_text(
        f'import {{ within }} from "{figures}";\n'
        "console.log([0.0006, 0.00039, 0.0000241].map((error) => within(-0.19999, error)).join());"
    )
    done = run_deno(tmp_path, "run", str(script))
    assert done.stdout == "−20.0 % ± 0.1 %,−19.999 % ± 0.039 %,−19.9990 % ± 0.0024 %\n", done.stderr


def test_dates_along_an_axis_have_the_order_of_other_dates(tmp_path: Path) -> None:
    script = tmp_path / "ask.js"
    figures = STATES.with_name("figures.js").as_uri()
    script.write_text(
        "globalThis.localStorage = { getItem: () => null };\n"
        f'const {{ ticks }} = await import("{figures}");\n'
        "console.log(JSON.stringify([ticks([null, 1796014440, 1796014500], 60), ticks([1795996800], 86400)]));"
    )
    done = run_deno(tmp_path, "run", "--allow-read", str(script))
    assert json.loads(done.stdout) == [["", "04:54\n11-30", "04:55"], ["\n11-30"]], done.stderr


def test_an_alarm_raised_before_the_oldest_event_loaded_is_on_the_time_line(tmp_path: Path) -> None:
    script, module = tmp_path / "ask.js", STATES.parents[1] / "alarms" / "alarm-time-line.js"
    script.write_text(
        "globalThis.localStorage = { getItem: () => null };\n"
        f'const {{ spells }} = await import("{module.as_uri()}");\n'
        'const events = (...kinds) => kinds.map((kind, at) => ({ kind, time_ns: 10 * at, severity: "danger" }));\n'
        'const asked = [["shelved", "cleared"], ["shelved", "escalated", "cleared"], ["raised", "cleared"]];\n'
        "const told = asked.map((kinds) => spells(events(...kinds), -5, 90));\n"
        "console.log(JSON.stringify(told.map((bars) => bars.map((one) => [one.from, one.to, one.severity]))));"
    )
    done = run_deno(tmp_path, "run", "--allow-read", str(script))
    assert json.loads(done.stdout or "0") == [
        [[-5, 10, "danger"]],
        [[-5, 10, "alert"], [10, 20, "danger"]],
        [[0, 10, "danger"]],
    ], done.stderr
