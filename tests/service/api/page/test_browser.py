"""The page in a browser: a real Chromium opens the views of a running service."""

import re
from collections.abc import Iterator
from typing import Any
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest
from playwright.sync_api import Browser, HttpCredentials, Route, expect

from rotorwatch.records.example import example
from rotorwatch.records.fields import EXAMPLE_NS
from rotorwatch.records.health import Health
from rotorwatch.records.history import ReadingBucket
from rotorwatch.records.levels import ChannelLevels, LevelGrowth, LevelLimits
from rotorwatch.records.windows import NaturalFrequency, SensorFault, Shape
from service.access.scopes import Scope
from service.runtime.runtime import Runtime
from tests.service.api.page.browsing import (
    PATIENCE_MS,
    SEEN_AT,
    VIEWS,
    Plant,
    kept,
    looking,
    plant_running,
    tell_instead,
    unreached,
    violations,
)
from tests.service.rig.live import until
from tests.service.rig.monitored import GUARDED, PLACE, client, fed, token
from tests.sure import sure


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runtime]:
    with fed(tmp_path_factory.mktemp("machine"), GUARDED) as (running, _):
        yield running


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    with plant_running(tmp_path_factory) as made:
        yield made


def test_a_signed_in_user_sees_machines_until_signing_out(browser: Browser, runtime: Runtime) -> None:
    url = runtime.http_url
    with browser.new_context() as context:
        context.set_default_timeout(PATIENCE_MS)
        page = context.new_page()
        page.goto(f"{url}/#/alarms")
        said = page.locator("sign-in [role=status]")
        expect(said).to_contain_text("an access token is needed")
        expect(page.locator("sign-in code")).to_have_text("rotorwatch token create NAME --scope read --scope operate")
        page.get_by_label("Access token").fill("rw_wrong")
        page.get_by_role("button", name="Sign in").click()
        expect(said).to_contain_text("not valid")
        assert not violations(page)
        kept(page, "sign-in")
        page.get_by_label("Access token").fill(token(runtime, Scope.READ, Scope.OPERATE, name="screen"))
        page.keyboard.press("Enter")
        expect(page.locator("alarms-view")).to_contain_text("No alarm is raised")
        expect(page.locator("header")).to_contain_text("screen")
        assert page.evaluate("document.cookie") == ""
        page.reload()
        expect(page.locator("sign-in")).to_have_count(0)
        page.goto(f"{url}/#/")
        page.get_by_text("1 without data").click()
        page.get_by_role("heading", name="demo/lab").wait_for()
        others = [context.new_page() for _ in range(6)]  # more than a caller's streams and a browser's connections
        for other in others:
            other.goto(url)
            expect(other.locator(".apart summary")).to_have_text("1 without data")
        page.get_by_role("button", name="Sign out").click()
        expect(said).to_have_text("Signed out.")
        for other in others:
            expect(other.locator("sign-in")).to_be_visible()
        assert not context.cookies()
        page.reload()
        expect(page.locator("sign-in")).to_be_visible()
        expect(page.locator("machine-tile")).to_have_count(0)


def test_a_fault_is_shown_explained_and_acknowledged(browser: Browser, plant: Plant) -> None:
    url = plant.runtime.http_url
    with looking(browser, url) as page, looking(browser, url) as second, client(plant.runtime) as http:
        shown = sure(page.goto(url))
        policy = shown.headers["content-security-policy"]
        assert "default-src 'none'; script-src 'self'; style-src 'self';" in policy
        assert "unsafe" not in policy
        tile = page.locator("machine-tile[place='demo/lab']")
        expect(tile.locator("state-mark")).to_have_text("healthy")
        expect(page.locator(".apart summary")).to_have_text("1 without data")
        second.goto(f"{url}/#/alarms")
        plant.until = SEEN_AT

        expect(tile.locator("state-mark.alert")).to_be_visible()
        expect(tile).to_contain_text("bearing stiffness, horizontal")
        expect(page).to_have_title(re.compile(r"^\(\d of \d\) rotorwatch$"))
        tile.get_by_role("link").click()
        row = page.locator("parameter-table tr", has_text="k_by")
        expect(row).to_have_class("alert")
        read = row.locator("td").nth(1).inner_text()
        assert -0.4 < float(read.replace("−", "-").removesuffix(" %")) / 100 < -0.25
        assert page.locator("parameter-table tr.alert").count() == 1
        part = page.locator("rotor-drawing .part.alert")
        expect(part).to_have_count(1)
        expect(part).to_contain_text(re.compile(r"k_by ▲ alert−\d\d\.\d % ± \d\.\d %"))
        expect(page.locator("rotor-drawing .sensor")).to_have_count(4)
        assert page.locator("machine-facts").count() == 0
        page.get_by_text("Machine file", exact=True).click()
        expect(page.locator("machine-facts")).to_contain_text("rotor.k_by_N_per_m50000")
        expect(page.locator("parameter-trend canvas")).to_have_count(6)
        expect(page.locator("spectrum-plot canvas")).to_be_visible()
        name = page.locator("spectrum-plot .u-series:visible th", has_text="measured").first
        # Without a pointer there is no value, so nothing announces one.
        assert name.evaluate("one => getComputedStyle(one, '::after').content") == "none"
        page.locator("spectrum-plot .u-over").hover()
        expect(page.locator("spectrum-plot .uplot.away")).to_have_count(0)
        assert name.evaluate("one => getComputedStyle(one, '::after').content") == '":"'
        expect(page.get_by_role("img", name="orbit at the bearing")).to_be_visible()

        level = page.locator("level-table tr", has_text="y1").first
        in_um = float(level.locator("td").nth(2).inner_text())
        page.get_by_role("button", name="µm, mm/s").click()
        expect(level).to_contain_text("mil pp")
        assert float(level.locator("td").nth(2).inner_text()) == pytest.approx(in_um / 25.4, rel=0.3)  # data go on
        expect(page.get_by_role("img", name="orbit at the bearing")).to_contain_text("mil")
        page.get_by_role("button", name="mil, in/s").click()

        seen = second.locator("alarm-list tr", has_text="k_by")
        expect(seen).to_contain_text("unacknowledged")
        page.locator("alarm-list tr", has_text="k_by").get_by_role("link", name="Why?").click()
        why = page.locator("why-view")
        expect(why.get_by_role("heading", level=1)).to_have_text("bearing stiffness, horizontal")
        said = r"^bearing stiffness, horizontal changed by −3\d\.\d % ± \d\.\d % since 2026-01-01 00:00:[34]\d UTC"
        expect(why.locator(".verdict")).to_contain_text(re.compile(said))
        weighed = why.locator("table", has_text="What else was considered").locator("tbody tr")
        expect(weighed.first).to_contain_text(re.compile("^bearing stiffness, horizontal.*%"))
        expect(weighed.filter(has_text="nothing changed")).to_contain_text("< 0.1 %")
        expect(why.locator("before-after svg.orbit")).to_have_count(2)
        expect(why.locator("canvas")).to_have_count(3)
        expect(why.locator("figcaption", has_text="Correlation of")).to_contain_text("standard errors apart")
        assert [len(re.findall(rb"/Type\s*/Page[^s]", page.pdf(format=one))) for one in ("A4", "Letter")] == [1, 1]
        why.get_by_role("button", name="Acknowledge").click()
        expect(seen.get_by_role("button", name="Acknowledge")).to_have_count(0)
        assert http.get(f"{PLACE}/alarms/k_by").json()["state"] == "acknowledged"
        until(lambda: "acknowledged by anonymous" in " ".join(plant.heard), "acknowledgement on the topic")
        expect(why.locator("alarm-list")).to_contain_text("acknowledged")

        second.route("**/evidence*", _as_an_earlier_version_kept_it)
        second.goto(f"{url}/#/why/demo/lab/k_by")
        expect(second.locator("before-after .note")).to_have_text(re.compile("^Correlation functions were not kept"))
        second.route("**/evidence*", _of_a_damaged_bearing)
        second.reload()
        expect(second.locator("why-view tr.danger")).to_have_text("envelope– m/s² rms0.3 m/s² rmsdanger limit 0.2")
        expect(second.locator(".verdict")).to_have_text(re.compile(r"; 2026-01-01 00:0\d:\d\d UTC(; .+[^.])?\.$"))

        plant.cut.set()
        page.goto(f"{url}/#/")
        expect(tile.locator("state-mark")).to_have_text(["alert", "no data"])
        expect(page.locator("alarm-strip")).to_contain_text("stream lost")
        expect(tile.locator(".worst")).to_contain_text("bearing stiffness, horizontal")
        page.goto(f"{url}/#/machines/demo/lab")
        expect(page.locator("machine-view .head")).to_contain_text("last known: alert")
    with client(plant.runtime) as http:
        _two_operators(browser, plant, http)
    broken: list[str] = []
    for kind, phone, dark in (("light", False, False), ("dark phone", True, True)):
        with looking(browser, url, phone=phone, dark=dark) as page:
            for view, path in VIEWS.items():
                page.goto(f"{url}/#/{path}")
                told = page.locator(f"{view}-view" if view != "alarms" else "alarms-view alarm-list")
                expect(told).to_contain_text("lab")
                if view == "machine":
                    expect(page.locator("spectrum-plot canvas")).to_be_visible()
                kept(page, f"{view}-{kind}")
                broken += [f"{view}, {kind}: {one}" for one in violations(page)]
                broken += [f"{view}: {one}" for one in unreached(page)] if kind == "light" else []
                assert page.evaluate("document.documentElement.scrollWidth") == (390 if phone else 1360)
                assert page.evaluate("document.querySelector('header').offsetHeight") < 100
                if phone:  # also on a small phone, or a large screen at 400 % zoom
                    page.set_viewport_size({"width": 320, "height": 844})
                    assert page.evaluate("document.documentElement.scrollWidth") == 320, view
                    page.set_viewport_size({"width": 390, "height": 844})
                ground = page.evaluate("getComputedStyle(document.documentElement).backgroundColor")
                assert (int(re.findall(r"\d+", ground)[0]) < 80) is dark
    assert not broken, "\n".join(broken)


def test_everything_in_a_report_is_on_the_machines_page(browser: Browser, plant: Plant) -> None:
    url = plant.runtime.http_url
    told: dict[str, Any] = dict(example(Health))
    report: dict[str, Any] = told["report"] | {
        "state": "watching", "suspect": "a rub at the bearing", "level_growth": example(LevelGrowth),
        "sensors": [example(SensorFault)], "shapes": [example(Shape)],
        "natural_frequencies": [example(NaturalFrequency)],
    }  # fmt: skip
    report["opinions"][0]["agreement"][0]["verdict"] = "disagree"
    told |= {"report": report, "reason": "<b>reason</b> & more"}

    growing = report["levels"][0] | {"channel": "DE-H"}
    sensor = {"name": "DE-H", "quantity": "acceleration", "location": "DE", "direction": "H", "unit": "m/s2"}
    read = [
        example(ReadingBucket) | {"name": "DE-H:overall", "start_ns": EXAMPLE_NS - (3 - at) * 10**10, "mean": 0.3 + at}
        for at in range(4)
    ]
    file = {"description": "", "rotor": None, "operation": None, "sensors": [sensor]}
    with looking(browser, url) as page:
        tell_instead(page, told)
        page.goto(f"{url}/#/machines/demo/lab")
        view = page.locator("machine-view")
        expect(view).to_contain_text("<b>reason</b> & more")
        verdict = report["verdict"]
        growth = report["level_growth"]["text"]
        quality = told["quality"]
        for text in (
            *(verdict["text"], "Best explained by: a rub at the bearing.", report["sensors"][0]["text"]),
            *(
                report["shapes"][0]["text"],
                report["natural_frequencies"][0]["text"],
                growth[1:],
                quality["last_refusal"],
                quality["last_gap"],
            ),
            *("not-finite 3", told["restart"], "1320 rpm", "0.4 standard deviations", "zone", "detectable", "relation"),
            *(told["alarms"][0]["text"], "−24.7 %", "disagrees"),
        ):
            expect(view).to_contain_text(text)
        expect(page.locator(".banner")).to_contain_text("No connection to the monitor since")  # the stream has ended
        page.route("**/recordings-view.js", lambda route: route.fulfill(body="throw 0", content_type="text/javascript"))
        page.get_by_role("link", name="Recordings").click()
        expect(page.locator("main")).to_contain_text("There is no connection to the monitor")
    told["report"] = report | {"parameters": [], "verdict": None, "levels": [growing], "speed_rad_s": 3.3e-5}
    told["alarms"] = [told["alarms"][0] | {"name": "level:DE-H", "severity": "danger"}]
    with looking(browser, url) as page:
        tell_instead(page, told)
        page.route("**/configuration", lambda route: route.fulfill(json={"file": file}))
        page.route("**/readings?*", lambda route: route.fulfill(json={"buckets": read}))
        page.add_init_script(_WRITTEN)
        page.goto(f"{url}/#/machines/demo/lab")
        trend = page.locator("level-trend")
        expect(trend.locator("figcaption")).to_contain_text("rigid: A to 1.4, B to 2.8, C to 4.5 m/s² rms, D beyond")
        expect(trend).to_contain_text("the band reaches from the lowest to the highest. Zones and limits are")
        expect(trend.locator(".u-legend")).to_contain_text(re.compile(r"time\s*2026-01-01 00:03:25 UTC\s*mean\s*3.3"))
        assert {"zone A", "zone B", "zone C", "zone D", "alert", "danger"} <= set(page.evaluate("window.written"))
        fold = page.locator("level-table summary")
        fold.press("Enter")
        growing["kurtosis"] = 17.3
        expect(page.locator("level-table")).to_contain_text("17.3")
        expect(fold).to_be_focused()
        expect(page.locator("level-table details")).to_have_attribute("open", "")
        expect(page.locator("data-quality")).to_contain_text("speed0 rpm")
        expect(page.locator("rotor-drawing .sensor.danger")).to_contain_text("DE-H ◆ danger")
        expect(page.locator("rotor-drawing svg")).to_contain_text(re.compile(r"[\d.]+ (mm/s|m/s²) rms"))
    told |= {"alarms": [], "state": "not-evaluable"}
    with looking(browser, url) as page:
        tell_instead(page, told)
        page.goto(f"{url}/#/")
        expect(page.locator("machine-tile .worst")).to_have_text("<b>reason</b> & more")  # not one of its levels
    told |= {"report": None, "filled": 0.0, "stream": told["stream"] | {"silent": True, "silent_since_ns": None}}
    with looking(browser, url) as page:
        tell_instead(page, told)
        page.goto(f"{url}/#/machines/demo/lab")
        expect(page.locator("data-quality")).to_contain_text("window0 % fullblocks")  # no time that is not known
        expect(page.locator("data-quality")).not_to_contain_text("silent")


def test_a_view_that_loads_late_does_not_replace_a_newer_one(browser: Browser, plant: Plant) -> None:
    url = plant.runtime.http_url
    late = "await new Promise((come) => { globalThis.letCome = come; document.body.id = 'comes' });"
    with looking(browser, url) as page:
        page.route(
            "**/machine-view.js",
            lambda route: route.fulfill(body=late + route.fetch().text(), content_type="text/javascript"),
        )
        page.goto(f"{url}/#/machines/demo/lab")
        expect(page.locator("main")).to_have_text("Loading …")
        expect(page.locator("body#comes")).to_be_visible()
        page.get_by_role("link", name="Plant").click()
        expect(page.locator("plant-view")).to_be_visible()
        page.evaluate("letCome(), customElements.whenDefined('machine-view').then(() => null)")
        page.wait_for_timeout(200)
        expect(page.locator("plant-view")).to_be_visible()
        page.go_back()
        expect(page.locator("machine-view h1")).to_have_text("demo/lab")


def test_removed_and_unknown_machines_are_not_shown(browser: Browser, plant: Plant) -> None:
    url = plant.runtime.http_url
    told = [{**dict(example(Health)), "machine": name} for name in ("lab", "spare")]
    with looking(browser, url) as page:
        tell_instead(page, *told)
        page.goto(f"{url}/#/machines/demo/nowhere")
        expect(page.locator("machine-view")).to_contain_text("no machine of this name")
        page.goto(f"{url}/#/")
        expect(page.locator("machine-tile")).to_have_count(2)
        tell_instead(page, told[0])  # the stream reconnects, as after a restart
        expect(page.locator("machine-tile")).to_have_count(1)
        expect(page.get_by_role("link", name="Alarms 1")).to_be_visible()


def test_the_longest_names_fit_a_phone(browser: Browser, plant: Plant) -> None:
    told = {**dict(example(Health)), "site": "Compressor" * 6, "machine": "BoilerFeed" * 6}
    with browser.new_context(viewport={"width": 390, "height": 844}) as context:
        page = context.new_page()
        tell_instead(page, told)
        place = f"{told['site']}/{told['machine']}"
        views = {"": "alarm-strip li", "alarms": "alarms-view option", f"machines/{place}": "machine-view h1 small"}
        for view, there in views.items():
            page.goto(f"{plant.runtime.http_url}/#/{view}")
            expect(page.locator(there).first).to_be_attached()
            assert page.evaluate("document.documentElement.scrollWidth") == 390


def test_machines_are_grouped_by_site_and_only_visible_trends_loaded(browser: Browser, plant: Plant) -> None:
    url = plant.runtime.http_url
    asked: list[list[str]] = []

    def health(number: int) -> dict[str, object]:
        place = {"site": f"site-{number // 40}", "machine": f"m{number}"}
        state: dict[str, object] = {"state": "healthy" if number < 119 else "no-data", "alarms": []}
        return {**dict(example(Health)), **place, **(state if number != 70 else {})}

    def lines(route: Route) -> None:
        asked.append(parse_qs(urlsplit(route.request.url).query)["of"])
        route.fulfill(json={"trends": [{"starts_ns": [1, 2, 3], "means": [0.0, 1.0, 0.5]}] * len(asked[-1])})

    with looking(browser, url) as page:
        tell_instead(page, *map(health, range(120)))
        page.route("**/api/v1/trends?*", lines)
        page.goto(url)
        sites, tiles = page.locator("site-section"), page.locator("machine-tile")
        expect(tiles).to_have_count(120)
        expect(page.locator("site-section h2")).to_have_text(["site-1", "site-0", "site-2"])
        expect(sites.first.locator("summary")).to_contain_text("40 machines, 1 abnormal")
        expect(sites.last.locator("summary")).to_contain_text("40 machines, 1 without data")
        expect(tiles.first).to_have_attribute("place", "site-1/m70")
        expect(tiles.first.locator("polyline")).to_be_attached()
        assert 1 <= sum(map(len, asked)) < 60
        page.get_by_label("Order").select_option("by name")
        expect(tiles.first).to_have_attribute("place", "site-0/m0")
        sites.nth(1).locator("summary").click()
        expect(tiles).to_have_count(80)
        expect(sites.nth(1).locator("state-mark")).to_have_text("alert")  # of the folded site
        page.reload()
        expect(tiles).to_have_count(80)
        expect(tiles.first).to_have_attribute("place", "site-0/m0")
        page.get_by_label("Search machines").fill("m70")
        expect(sites).to_have_count(1)
        assert not violations(page)


def _as_an_earlier_version_kept_it(route: Route) -> None:
    told = route.fetch().json()
    for picture in filter(None, (told["before"], told["raised"], told["settled"])):
        del picture["correlations"]
    route.fulfill(json=told)


def _of_a_damaged_bearing(route: Route) -> None:
    told = route.fetch().json()
    limit = example(LevelLimits) | {
        "measure": "envelope",
        "alert": None,
        "fall": None,
        "danger": 0.2,
        "state": "danger",
    }
    for picture in filter(None, (told["raised"], told["settled"])):
        picture["report"]["levels"] = [example(ChannelLevels) | {"channel": "DE-H", "limits": [limit]}]
    route.fulfill(json=told | {"name": "level:DE-H"})


_WRITTEN = """
const fill = CanvasRenderingContext2D.prototype.fillText;
window.written = [];
CanvasRenderingContext2D.prototype.fillText = function (text, ...rest) {
  window.written.push(text);
  fill.call(this, text, ...rest);
};
"""  # texts on charts, which are not in the document


def _two_operators(browser: Browser, plant: Plant, http: httpx.Client) -> None:
    """The second operator gets a notice; a viewer without rights has no buttons."""
    url = plant.runtime.http_url

    def overtaken(route: Route) -> None:
        order = {"reason": "I was first", "expected_state": "acknowledged"}
        assert http.post(f"{PLACE}/alarms/k_by/shelve", json=order).status_code == 200
        route.continue_()

    with browser.new_context() as context:
        context.set_default_timeout(PATIENCE_MS)
        page = context.new_page()
        page.route("**/shelve", overtaken)
        page.goto(f"{url}/#/alarms")
        row = page.locator("alarm-list tr", has_text="k_by")
        shelve = row.get_by_role("button", name="Shelve")
        shelve.focus()
        page.keyboard.press("Enter")
        expect(page.get_by_label("Reason")).to_be_focused()
        assert not violations(page)
        page.keyboard.press("Escape")
        expect(page.get_by_role("dialog")).to_have_count(0)
        expect(shelve).to_be_focused()
        shelve.click()
        page.get_by_label("Reason").fill("cable is replaced")
        page.get_by_role("dialog").get_by_role("button", name="Shelve").click()
        expect(page.locator("alarm-list [role=status]")).to_contain_text("not done.")
        expect(row).to_contain_text("I was first")
        row.get_by_role("button", name="Unshelve").click()
        expect(row.get_by_role("button", name="Unshelve")).to_have_count(0)
        expect(page.get_by_role("img", name=re.compile("^k_by was raised once"))).to_be_visible()
        page.unroute("**/shelve")
        page.get_by_label("Order").select_option("first-out")
        expect(page.locator("alarm-list tbody tr")).to_have_text([re.compile("k_by"), re.compile("stream-lost")])
        assert page.locator("alarm-list").get_by_role("link", name="Why?").count() == 1  # stream-lost has no window
        for box in page.locator("alarm-list").get_by_role("checkbox").all():
            box.check()
        kept(page, "alarms-chosen")
        page.get_by_role("button", name="Shelve … (2)").click()
        page.get_by_label("Reason").fill("the whole plant is down")
        page.get_by_role("dialog").get_by_role("button", name="Shelve").click()
        told = re.compile("bearing stiffness.*: shelved.* stream.*: shelved")
        expect(page.locator("alarm-list [role=status]")).to_contain_text(told)
        page.route("**/caller", lambda route: route.fulfill(json={"name": "viewer", "scopes": ["read"]}))
        page.reload()
        expect(row).to_be_visible()
        expect(page.locator("alarms-view .note").first).to_contain_text("operate")
        assert row.get_by_role("button").count() == 0


def test_the_api_page_works_without_other_hosts(browser: Browser, runtime: Runtime) -> None:
    url = runtime.http_url
    given = HttpCredentials(username="anybody", password=token(runtime, Scope.READ, name="reader"), origin=url)
    with looking(browser, url, given=given) as page:
        page.goto(f"{url}/docs")
        page.get_by_role("heading", name="rotorwatch").wait_for()
        kept(page, "docs")
        page.locator("#operations-machines-machines").get_by_role("button").first.click()
        page.get_by_role("button", name="Execute").click()
        shown = page.locator("#operations-machines-machines .live-responses-table")
        shown.get_by_text("200", exact=True).first.wait_for()
        assert '"machine": "lab"' in shown.inner_text()
        kept(page, "docs-tried")
