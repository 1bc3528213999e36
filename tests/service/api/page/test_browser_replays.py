"""Recordings in a browser: found on a time line, replayed with another limit, inspected window by window."""

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from models.machine import load_machine
from rotorwatch.records.replays import ReplayJob, ReplayReportList
from rotorwatch.records.snapshots import OrbitSnapshot, SpectrumSnapshot
from service.runtime.runtime import Runtime, running
from service.settings.service import RecordingSettings
from simulator.scenario import parse_fault
from tests.service.api.page.browsing import kept, looking, unreached, violations
from tests.service.rig.live import QUICK, START_NS, endpoint, machine_file, scenario_blocks, send, settings, until
from tests.service.rig.monitored import PLACE, answered, client
from tests.service.rig.replaying import recording

ID = "demo/lab/20260101T000000Z.mcap"
SECONDS, FAULT_S = 80.0, 30.0
pytestmark = pytest.mark.usefixtures("replays_at_once")
# A slow network: the first seek takes longer than all later requests.
_LATE_FIRST_SEEK = """() => {
    const ask = window.fetch;
    let late = 1000;
    window.moved = 0;
    window.fetch = async (...asked) => {
        if (!String(asked[0]).endsWith("/seek")) return ask(...asked);
        const wait = late;
        late = 0;
        await new Promise((go) => setTimeout(go, wait));
        return ask(...asked).finally(() => { window.moved += 1; });
    };
}"""


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runtime]:
    """A machine that has had a fault, and the recording of it."""
    folder = tmp_path_factory.mktemp("recordings")
    blocks = scenario_blocks(SECONDS, parse_fault(f"k_by=-0.33@{FAULT_S:g}"))
    file = machine_file(tmp_path_factory.mktemp("machine"), *QUICK)
    recording(folder / ID, blocks, load_machine(file))
    address = endpoint()
    kept_in = RecordingSettings(directory=str(folder), keep_days=36_500.0)
    with running(settings(address, file, when_full="wait", recording=kept_in)) as started:
        send(address, blocks, load_machine(file))
        worker = started.machines()[0]
        until(lambda: worker.health().quality.accepted_blocks == len(blocks), "all blocks")
        yield started


def chosen(page: Page, url: str) -> None:
    """Open the view of recordings and choose those around the alarm."""
    page.goto(f"{url}/#/recordings")
    page.get_by_role("button", name=re.compile("Choose ten minutes before and after .*k_by")).click()
    expect(page.locator("replay-order")).to_contain_text("1 recording of demo/lab")
    expect(page.get_by_role("checkbox", name="20260101T000000Z.mcap")).to_be_checked()


def test_no_recording_is_not_shown_before_the_list_has_loaded(browser: Browser, runtime: Runtime) -> None:
    url = runtime.http_url
    held: dict[str, Route] = {}

    def hold(route: Route) -> None:
        held["events" if "/events" in route.request.url else "recordings"] = route

    with looking(browser, url) as page:
        page.add_init_script("delete window.SharedWorker")  # its requests cannot be routed
        page.route("**/api/v1/events?*", hold)
        page.route("**/recordings?site=*", hold)
        page.goto(f"{url}/#/recordings/demo/lab")
        expect(page.get_by_label("Machine", exact=True)).to_have_text("demo/lab")
        held["events"].continue_()
        expect(page.get_by_role("link", name="Alarms 1")).to_be_visible()  # the machine has arrived on the stream
        page.wait_for_timeout(200)
        expect(page.locator("recordings-view")).not_to_contain_text("No recording")
        held["recordings"].continue_()
        expect(page.locator("recording-table")).to_contain_text("20260101T000000Z.mcap")
        replays = page.locator("replay-list")
        expect(replays).to_contain_text("since the service started")
        load, cut = "document.querySelector('replay-list').load();", "window.fetch = () => Promise.reject('cut');"
        page.evaluate(f"() => {{ const real = window.fetch; {cut} {load} window.fetch = real; }}")
        expect(replays).to_contain_text("the monitor does not answer")
        page.evaluate(load)
        expect(replays).to_contain_text("since the service started")  # again, although the list has not changed


def test_a_recording_is_replayed_with_other_settings_and_browsed_by_window(browser: Browser, runtime: Runtime) -> None:
    url = runtime.http_url
    with looking(browser, url) as page:
        chosen(page, url)
        kept(page, "recordings-light")
        with page.expect_download() as download:
            page.get_by_role("link", name="Download 20260101T000000Z.mcap").click()
        assert download.value.suggested_filename == "20260101T000000Z.mcap"
        page.get_by_label("On-delay, s").fill("10")
        page.get_by_role("button", name="Start replay").click()
        view = page.locator("replay-view")
        expect(view.get_by_role("status").first).to_contain_text("Finished")
        expect(page.locator(".replay-banner")).to_contain_text("REPLAY of demo/lab. Nothing in this view is live")
        expect(view).to_contain_text("alarms.on_delay_s = 10")

        # With twice the live on-delay; windows are full from the twentieth second on.
        events = page.locator("alarm-comparison tbody tr")
        expect(events.first).to_contain_text(re.compile(r"changed by −\d"))  # no hyphen, as in the text itself
        expect(events.filter(has_text="raised")).to_have_count(1)
        expect(events.filter(has_text="raised")).to_contain_text(re.compile("k_by.*both, 5 s later in this replay"))
        expect(page.locator("state-strip tbody tr")).not_to_have_count(0)
        expect(page.locator("replay-parameters canvas")).to_have_count(6)
        window = page.locator("offline-result .window")
        scrub = page.get_by_role("slider", name="Window")
        scrub.focus()
        page.keyboard.press("Home")
        expect(scrub).to_have_attribute("aria-valuetext", re.compile("^window 1 of .*, warming$"))
        expect(window).to_contain_text("No alarm raised in the replay by then")
        page.keyboard.press("End")
        expect(window.locator("state-mark.alert")).to_be_visible()
        expect(window).to_contain_text("Raised in the replay by then: k_by (alert, −")
        expect(page.locator("parameter-table tr.alert")).to_contain_text("bearing stiffness, horizontal")
        page.keyboard.press("ArrowLeft")
        last = int(scrub.get_attribute("max") or 0)
        expect(scrub).to_have_attribute("aria-valuetext", re.compile(f"^window {last} of {last + 1},"))
        page.keyboard.press("Home")
        expect(page.locator("parameter-table tr.alert")).to_have_count(0)
        page.get_by_role("button", name="alarm event ▸").click()
        expect(window).to_contain_text("Raised in the replay by then: k_by")
        replayed = page.url
        kept(page, "replay-light")
        assert not violations(page)
        assert not unreached(page)

        chosen(page, url)
        page.get_by_label("Alert when a parameter has changed by more than, %").fill("80")
        page.get_by_label("Lines that override").fill("alarms.limits.danger_above = 0.9")
        text = Path(runtime.settings.machines[0].file).read_bytes()
        sent = page.get_by_label("Or a file from this computer")
        sent.set_input_files({"name": "calm.toml", "mimeType": "application/toml", "buffer": text})
        expect(page.get_by_label(re.compile("^Machine file"))).to_be_disabled()
        kept(page, "replay-order-file")
        page.get_by_role("button", name="Start replay").click()
        expect(page.locator(".replay-banner")).to_contain_text(
            "with another machine file, calm.toml. Nothing in this view is live"
        )
        expect(view.get_by_role("status").first).to_contain_text("raised at the end: none")
        expect(page.locator("alarm-comparison tbody tr").first).to_contain_text("live only")
        page.get_by_label("Beside it").select_option(index=1)
        expect(page.locator("alarm-comparison tbody tr").first).to_contain_text("the other replay only")

    with browser.new_page() as page:  # whose console reports the refused request
        chosen(page, url)
        page.get_by_label("Alert when a parameter has changed by more than, %").fill("80")
        page.get_by_role("button", name="Start replay").click()
        expect(page.locator("replay-order [role=alert]")).to_contain_text("Not started. changes: ")
        expect(page.locator("replay-order [role=alert]")).to_contain_text("raise_above < danger_above")
    with looking(browser, url) as page:  # opened in the background, and looked at later
        page.add_init_script("Object.defineProperty(document, 'hidden', {get: () => !window.looks})")
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.goto(replayed)
        expect(page.locator("replay-view")).to_have_count(1)
        page.wait_for_timeout(500)
        assert not [one for one in asked if "/replays" in one and not one.endswith(".js")]
        page.evaluate("window.looks = true; document.dispatchEvent(new Event('visibilitychange'))")
        expect(page.locator("replay-view").get_by_role("status").first).to_contain_text("Finished")
    with looking(browser, url, phone=True, dark=True) as page:
        for name, address in (("replay", replayed), ("recordings", f"{url}/#/recordings")):
            page.goto(address)
            there = "replay-levels canvas" if name == "replay" else "recording-table tbody tr"
            expect(page.locator(there).first).to_be_visible()
            if name == "replay":
                expect(page.locator("parameter-table tr.alert, alarm-comparison tbody tr")).to_have_count(2)
                scrub = page.get_by_role("slider", name="Window")
                scrub.focus()
                page.mouse.wheel(0, 3000)
                until(partial(page.evaluate, "scrollY > 1500"), "the page to scroll")
                tall = page.locator(".replay-banner").evaluate("one => one.getBoundingClientRect().bottom")
                # The slider stays visible below the banner, however many lines that has.
                assert scrub.evaluate("one => one.getBoundingClientRect().top") >= tall > 0
                page.evaluate("scrollTo(0, 0)")
            kept(page, f"{name}-dark-phone")
            assert not violations(page)
            assert page.evaluate("document.documentElement.scrollWidth") == 390


# Drag the slider over all windows up to one.
_DRAGGED = """(scrub, to) => {
    for (let at = 0; at <= to; at += 1) {
        scrub.value = String(at);
        scrub.dispatchEvent(new Event("input"));
    }
}"""
ORBITS, SPECTRUM = "Orbits of this window", "Spectrum of this window"
FOLDS = (
    ORBITS, SPECTRUM, "Waveform at its end", "Full spectrum at its end", "Correlations and residuals of the equations",
)  # fmt: skip


def unfolded(page: Page, *headings: str) -> None:
    for heading in headings:
        page.locator("window-plots summary").filter(has_text=heading).press(
            "Enter"
        )  # not by mouse: the page may shift meanwhile


def diameters(snapshot: OrbitSnapshot) -> list[float]:
    """Long axes of the orbits, as the page writes them."""
    return [2 * one.ellipse.semi_major for one in snapshot.orbits if one.ellipse is not None]


def test_orbits_and_spectra_are_those_of_the_selected_window(browser: Browser, runtime: Runtime) -> None:
    url = runtime.http_url
    with client(runtime) as http:
        answer = http.post("/api/v1/replays", json={"recordings": [ID]}).raise_for_status()
        job_id = ReplayJob.model_validate_json(answer.content).id

        def state() -> str:
            return ReplayJob.model_validate_json(http.get(f"/api/v1/replays/{job_id}").content).state

        until(lambda: state() == "finished", "end of the replay")
        listed = http.get(f"/api/v1/replays/{job_id}/reports", params={"limit": 1000})
        reports = answered(listed, ReplayReportList).reports
        early = max(at for at, one in enumerate(reports) if one.filled == 1 and one.end_ns < START_NS + FAULT_S * 1e9)

        def asked_of(at: int) -> dict[str, str | int]:
            return {"replay": job_id, "until_ns": reports[at].end_ns}

        with looking(browser, url) as page:
            asked: list[str] = []
            page.on("request", lambda request: asked.append(request.url.partition(PLACE)[2]))
            page.goto(f"{url}/#/replays/{job_id}")
            scrub = page.get_by_role("slider", name="Window")
            expect(page.locator("window-plots summary")).to_have_count(len(FOLDS))
            scrub.focus()
            page.keyboard.press("ArrowLeft")
            page.wait_for_timeout(1000)
            assert not [one for one in asked if one.startswith(("/orbits", "/spectra", "/correlations", "/waveforms"))]
            unfolded(page, ORBITS, SPECTRUM)
            orbits, spectrum = page.locator("window-plots orbit-plot"), page.locator("window-plots spectrum-plot")
            expect(spectrum).to_contain_text("Replay, window")
            seen: dict[int, list[str]] = {}
            for at in (early, len(reports) - 1):
                asked.clear()
                scrub.evaluate(_DRAGGED, at)
                api = answered(http.get(f"{PLACE}/orbits", params=asked_of(at)), OrbitSnapshot)
                for drawn, long in zip(orbits.locator("figcaption").all(), diameters(api), strict=True):
                    expect(drawn).to_contain_text(f" {float(f'{long:.3g}'):g} × ")
                expect(orbits).to_contain_text("Replay, window 2026-01-01 00:00:")
                expect(orbits.locator("ellipse.nominal")).to_have_count(len(diameters(api)))
                expect(orbits.locator("ellipse.estimated")).to_have_count(len(diameters(api)))
                density = answered(http.get(f"{PLACE}/spectra", params=asked_of(at)), SpectrumSnapshot).densities[0]
                # The element's label has the level of the density drawn.
                expect(spectrum.locator("line-chart")).to_have_attribute(
                    "aria-label", f"spectrum of {density.channel}, rms {float(f'{density.rms or 0:.3g}'):g}"
                )
                expect(spectrum).to_contain_text("Replay, window 2026-01-01 00:00:")
                # Nothing is requested for windows that the slider passes over.
                assert len([one for one in asked if one.startswith("/spectra")]) == 1
                seen[at] = orbits.locator("figcaption").all_inner_texts()
                kept(page, f"replay-window-{at}")
            assert seen[early] != seen[len(reports) - 1]
            unfolded(page, *FOLDS[2:])
            expect(page.locator("window-plots waveform-plot")).to_contain_text(
                "Replay; recordings, 8 revolutions of 2026"
            )
            expect(page.locator("window-plots full-spectrum-plot")).to_contain_text("Replay; recordings, 2026")
            expect(page.locator("window-plots correlation-plot")).to_contain_text("Replay, window 2026-01-01 00:00:")
            assert not violations(page)
            kept(page, "replay-window-all")
        with looking(browser, url, phone=True, dark=True) as page:
            page.clock.install()
            # An empty response; a refusal would be an error on the console too.
            page.route("**/spectra?*", lambda route: route.fulfill(json={}))
            page.goto(f"{url}/#/replays/{job_id}")
            expect(page.locator("window-plots summary")).to_have_count(len(FOLDS))
            unfolded(page, *FOLDS)
            expect(page.locator("window-plots spectrum-plot")).to_contain_text("undefined")
            page.unroute("**/spectra?*")
            page.clock.fast_forward(16_000)
            expect(page.locator("window-plots canvas")).to_have_count(8)
            kept(page, "replay-window-dark-phone")
            assert not violations(page)
            assert page.evaluate("document.documentElement.scrollWidth") == 390


def test_a_paced_replay_is_paused_moved_and_stopped(browser: Browser, runtime: Runtime) -> None:
    url = runtime.http_url
    with looking(browser, url) as page, client(runtime) as http:
        chosen(page, url)
        page.get_by_label("How").select_option("paced")
        page.get_by_label("Seconds of data per second").fill("0.1")  # slow, so that it does not end by itself
        page.get_by_role("button", name="Start replay").click()
        control = page.locator("paced-control")
        expect(control).to_contain_text("rotorwatch run --namespace replay/")
        job_id = page.url.rpartition("/")[2]

        def job() -> ReplayJob:
            return ReplayJob.model_validate_json(http.get(f"/api/v1/replays/{job_id}").raise_for_status().content)

        def position_s() -> float:
            progress = job().progress
            return -1.0 if progress is None else (progress.position_ns - START_NS) / 1e9

        until(lambda: position_s() >= 0, "the first block")
        control.get_by_role("button", name="Pause").click()
        expect(control.get_by_role("button", name="Resume")).to_be_visible()
        assert job().state == "paused"
        slider = control.get_by_role("slider")
        expect(slider).to_have_attribute("aria-valuetext", re.compile("00:00:00"))
        slider.focus()
        page.evaluate(_LATE_FIRST_SEEK)
        page.keyboard.press("End")
        page.keyboard.press("PageDown")
        control.get_by_role("button", name="Resume").click()
        until(lambda: bool(page.evaluate("window.moved == 2")), "both orders to move")
        until(lambda: 0.85 * SECONDS < position_s() < 0.95 * SECONDS, "a tenth before the end")
        control.get_by_role("button", name="Pause").click()
        expect(control).to_contain_text("It stands at 2026-01-01 00:01:")
        expect(slider).to_have_attribute("aria-valuetext", re.compile("^2026-01-01 00:01:"))
        control.get_by_role("button", name="− 10 s").click()
        expect(slider).to_have_attribute("aria-valuetext", re.compile("^2026-01-01 00:01:0"))
        unfolded(page, ORBITS, SPECTRUM, FOLDS[4])
        expect(page.locator("window-plots orbit-plot")).to_contain_text("Replay, window 2026-01-01 00:00:4")
        expect(page.locator("window-plots orbit-plot ellipse.nominal")).to_have_count(2)
        expect(page.locator("window-plots spectrum-plot")).to_contain_text("evaluated by an offline replay alone")
        expect(page.locator("window-plots correlation-plot")).to_contain_text("a paced replay evaluates nothing")
        kept(page, "replay-paced")
        assert not violations(page)
        page.get_by_role("button", name="Stop").click()
        expect(page.locator("replay-view").get_by_role("status").first).to_contain_text("Stopped")
        assert job().state == "stopped"
        assert len(runtime.machines()[0].history.events(limit=100)) < 5  # nothing of it was live
