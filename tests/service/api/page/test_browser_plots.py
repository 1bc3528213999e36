"""The plots of a machine in a browser: loaded on opening, of live data and of recordings."""

import importlib
import re
from collections.abc import AsyncIterator, Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from models.machine import load_machine
from rotorwatch.records.example import example
from rotorwatch.records.health import Health
from rotorwatch.records.windows import SensorFault, UnbalanceVector
from service.runtime.runtime import Runtime
from tests.service.api.page.browsing import kept, looking, tell_instead, violations
from tests.service.rig.live import ROOT
from tests.service.rig.monitored import faulty
from tests.service.rig.replaying import recording
from tests.service.rig.run_up import BLOCKS

#: Element, what it asks for, what is drawn, and what it says of that.
PLOTS = (
    (
        "waveform-plot", "waveforms", "canvas",
        r"^Newest samples, 8 revolutions of 2026-01-01 00:01:17 UTC, 0\.36\d? s, d",
    ),
    (
        "vector-plot", "vectors", "canvas, svg",
        r"^1× of y1, history, \d+ vectors of a window each.*1320 rpm.* over time$",
    ),
    ("waterfall-plot", "waterfalls", "canvas", r"^Newest samples, 20 spectra of y1, .*strongest shade is \d+ µm pp"),
    ("full-spectrum-plot", "full-spectra", "canvas", r"^Newest samples, .*, 19 averages"),
    ("centreline-plot", "centrelines", "svg", r"^History, \d+ mean positions"),
    ("correlation-plot", "correlations", "canvas", r"^Window .*without mean and 1×; distance from theory"),
)  # fmt: skip


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runtime]:
    folder = tmp_path_factory.mktemp("machine")
    recording(folder / "recordings" / "demo" / "lab" / "run-up.mcap", BLOCKS)
    with faulty(folder) as (running, _):
        yield running


def test_plots_load_when_opened_and_state_their_data(browser: Browser, runtime: Runtime) -> None:
    url = runtime.http_url
    with looking(browser, url) as page:
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url.partition("?")[0].rsplit("/", 1)[1]))
        page.goto(f"{url}/#/machines/demo/lab")
        expect(page.locator("parameter-forest circle.decides")).to_have_count(7)  # one of them in the key
        expect(page.locator("spectrum-plot canvas")).to_be_visible()
        expect(page.locator("spectrum-plot .note")).to_contain_text("1× is taken out")
        spectrum = page.locator("spectrum-plot")
        spectrum.get_by_label("Channel").select_option("y1_dot")  # not in the window's spectra
        expect(spectrum.locator(".note")).to_have_text(
            re.compile("^Amplitudes in the newest samples, .*mean of 20 spec")
        )
        expect(page.get_by_role("img", name="spectrum of y1_dot")).to_be_visible()
        assert not {route for _, route, _, _ in PLOTS if route != "waterfalls"} & set(asked)
        for element, route, drawn, said in PLOTS:
            page.locator(f'plot-fold[shows="plots/{element}"] summary').press("Enter")
            plot = page.locator(element)
            expect(plot.get_by_role("status")).to_have_text(re.compile(said))
            expect(plot.locator(drawn).first).to_be_visible()
            assert route in asked
        expect(page.get_by_role("table", name="Residuals")).to_contain_text("(28)")
        kept(page, "plots")
        assert not violations(page)

        vectors = page.locator("vector-plot")
        vectors.get_by_label("Samples of").select_option("run-up.mcap")
        expect(vectors.get_by_role("status")).to_have_text(re.compile("^1× of y1, recordings, .*of 8 revolutions each"))
        expect(vectors).to_contain_text("Phase lag over speed")
        waterfall = page.locator("waterfall-plot")
        waterfall.get_by_label("Over").select_option("speed")
        expect(waterfall.get_by_role("status")).to_have_text(re.compile("^Spectra over speed need a run-up"))
        waterfall.get_by_label("Samples of").select_option("run-up.mcap")
        expect(waterfall.locator(".up")).to_contain_text(re.compile(r"20\d\d rpm.*9\d\d rpm"))
        page.locator('plot-fold[shows="plots/full-spectrum-plot"] summary').press("Enter")
        expect(page.locator("full-spectrum-plot")).to_have_count(0)
        kept(page, "plots-recorded")
    with looking(browser, url, phone=True, dark=True) as page:
        page.goto(f"{url}/#/machines/demo/lab")
        for element, *_ in PLOTS:
            page.locator(f'plot-fold[shows="plots/{element}"] summary').press("Enter")
            expect(page.locator(f"{element} :is(canvas, svg)").first).to_be_visible()
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        assert not violations(page)
        kept(page, "plots-phone")


def test_the_drawing_rotates_the_unbalance_and_marks_a_faulty_sensor(browser: Browser, runtime: Runtime) -> None:
    """A shaft that turns from z to y; its heavy spot was at 30° and is a quarter turn further, at -60°."""
    told: dict[str, Any] = dict(example(Health))
    report: dict[str, Any] = told["report"]
    vector = example(UnbalanceVector) | {"turned_deg": 90.0, "turned_interval_95_deg": (88.5, 91.5)}
    late = report["parameters"][0] | {"name": "c_by"}
    unbalance = report["parameters"][0] | {"name": "e", "relative_change": 1.41, "vector": vector}
    told["report"] = report | {
        "speed_rad_s": -138.2,
        "parameters": [unbalance, late],
        "verdict": report["verdict"] | {"settled": False, "current": [unbalance]},
        "sensors": [example(SensorFault)],
    }
    told["alarms"] = [told["alarms"][0] | {"name": "e", "severity": "danger"}]
    file = load_machine("lab").model_dump(mode="json")
    file["operation"]["unbalance_phase_rad"] = 0.5235987755982988

    with looking(browser, runtime.http_url) as page:
        tell_instead(page, told)
        page.route("**/configuration", lambda route: route.fulfill(json={"file": file}))
        page.goto(f"{runtime.http_url}/#/machines/demo/lab")
        drawing = page.locator("rotor-drawing")
        expect(drawing.locator(".part.danger")).to_contain_text("e, unbalance ◆ danger+141.0 % ±")
        expect(drawing).to_contain_text("turned 90.0° ± 1.5°")
        angles = [
            float(re.findall(r"rotate\((.*)\)", drawing.locator(f"path.{kind}").get_attribute("transform") or "")[0])
            for kind in ("nominal", "now")
        ]
        assert angles == pytest.approx([-30.0, 60.0])  # on the screen angles count clockwise
        expect(drawing.locator("g.sensor.data-health")).to_contain_text("y1 ⬢ sensor at fault")
        expect(drawing.locator("g.part", has_text="c_by")).to_contain_text("too little data yet")


def test_a_tiles_trend_breaks_at_gaps_and_is_flat_below_detectable_changes(browser: Browser, runtime: Runtime) -> None:
    told = {"site": "demo", "machine": "lab", "quantity": "parameter", "name": "k_by", "length_ns": 10**9}
    told |= {"starts_ns": [at * 10**9 for at in (0, 1, 2, 4, 30, 60, 61)]}  # 4: one without a reading is no gap
    with looking(browser, runtime.http_url) as page:
        page.route("**/api/v1/trends?*", lambda route: route.fulfill(json={"trends": [told]}))
        page.goto(f"{runtime.http_url}/#/")
        for part, least, most in ((1.0, 20.0, 22.0), (1e-4, 0.0, 0.5)):
            told["means"] = [part * mean for mean in (0.0, 0.1, 0.2, 0.2, 0.3, 0.4, 0.5)]
            page.reload()
            lines = page.locator("spark-line polyline")
            expect(lines).to_have_count(3)
            points = [(line.get_attribute("points") or "").split() for line in lines.all()]
            assert [len(one) for one in points] == [4, 2, 2]  # the single one is a dot
            rise = float(points[0][0].partition(",")[2]) - float(points[2][1].partition(",")[2])
            assert least <= rise <= most  # of 22, the full height for detectable changes


@pytest.mark.long
def test_the_page_benchmark_measures_a_plant(
    browser: Browser, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    page = importlib.import_module("page")

    class AtOnce(page.Plant):  # type: ignore[misc, name-defined]  # imported at run time
        """Sends all machines in one piece, so that a busy browser shows all tiles at once."""

        async def events(self) -> AsyncIterator[str]:
            pieces = super().events()
            yield "".join([await anext(pieces) for _ in range(1 + self.machines)])
            async for piece in pieces:
                yield piece

    monkeypatch.setattr(page, "Plant", AtOnce)
    page.plant(browser, 5, 1.0)
    assert re.fullmatch(r"\| 5 \|.*\| 1, 0 \|\n", capsys.readouterr().out)  # all trends in one request
