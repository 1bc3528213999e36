"""A real Chromium that opens the page of a running service, and a plant to show.

The browser is the one in ``ROTORWATCH_CHROMIUM``, or the system's own; no Python package provides one that is kept up
to date, so without one these tests are skipped (``test_access_http.py`` tests the access of browsers without one).
To keep screenshots: ``ROTORWATCH_SCREENSHOTS=FOLDER``.
"""

import json
import os
import shutil
import subprocess
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from deno import find_deno_bin
from playwright.sync_api import Browser, HttpCredentials, Page, Route, expect, sync_playwright

from service.runtime.runtime import Runtime, running
from service.settings.service import MachineEntry
from simulator.scenario import parse_fault
from tests.service.rig.live import LAB, SHORT, Feed, endpoint, machine_file, open_session, scenario_blocks, settings

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = [
    "--no-sandbox",  # tests may run as root
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
PATIENCE_MS = 120_000.0
FAULT_AT, SEEN_AT = 400, 700
VIEWS = {"plant": "", "machine": "machines/demo/lab", "alarms": "alarms", "why": "why/demo/lab/k_by"}
SCREENSHOTS = os.environ.get("ROTORWATCH_SCREENSHOTS")
RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]


@contextmanager
def chromium() -> Iterator[Browser]:
    path = os.environ.get("ROTORWATCH_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:  # a fresh machine has none, and it takes an administrator to install one
        pytest.skip(f"no browser: ROTORWATCH_CHROMIUM is not set, and none of {', '.join(NAMES)} is there")
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(
            executable_path=Path(__file__).with_name("chromium"),
            args=FLAGS,
            env={**os.environ, "ROTORWATCH_CHROMIUM": path},
            timeout=PATIENCE_MS,
        ) as found,
    ):
        expect.set_options(timeout=PATIENCE_MS)  # for all tests of this process
        yield found


@dataclass(slots=True)
class Plant:
    """A machine with data, as fast as they are accepted up to a block and then slowly; and one without data."""

    runtime: Runtime
    feed: Feed
    until: int = 300
    cut: threading.Event = field(default_factory=threading.Event)
    heard: list[str] = field(default_factory=list)  # on the topic of alarm events

    def run(self) -> None:
        for number, block in enumerate(scenario_blocks(100.0, parse_fault(f"k_by=-0.33@{FAULT_AT / 10}"))):
            self.feed.put(block)
            if self.cut.wait(0.0 if number < self.until else 1.0):
                return


@contextmanager
def plant_running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    """Machine lab with a fault to come, and spare without data."""
    entries = []
    for name in ("lab", "spare"):
        quiet = ("[operation]", "[ingest]\nno_data_after_s = 6.0\n\n[operation]")
        changes = (*SHORT, quiet, ('name = "lab"', f'name = "{name}"'))
        entries.append(MachineEntry(file=machine_file(tmp_path_factory.mktemp(name), *changes)))
    address = endpoint()
    plan = settings(address, when_full="wait", machines=tuple(entries))
    with running(plan) as runtime, open_session(address) as session:
        made = Plant(runtime, Feed(session, LAB))
        session.declare_subscriber(LAB.keys.alarm_event, lambda sample: made.heard.append(sample.payload.to_string()))
        thread = threading.Thread(target=made.run)
        thread.start()
        yield made
        made.cut.set()
        thread.join()


@contextmanager
def looking(
    browser: Browser, url: str, *, phone: bool = False, dark: bool = False, given: HttpCredentials | None = None
) -> Iterator[Page]:
    """A page in a browser of its own, which must have no errors and no requests to other hosts."""
    asked: list[str] = []
    faults: list[str] = []
    with browser.new_context(
        viewport={"width": 390, "height": 844} if phone else {"width": 1360, "height": 850},
        is_mobile=phone,
        color_scheme="dark" if dark else "light",
        http_credentials=given,
    ) as context:
        context.set_default_timeout(PATIENCE_MS)
        page = context.new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: faults.append(str(error)))
        yield page
    assert asked
    assert all(one.startswith((f"{url}/", "data:", "blob:")) for one in asked), asked
    assert not faults


def kept(page: Page, name: str) -> None:
    if SCREENSHOTS:
        page.screenshot(path=Path(SCREENSHOTS) / f"{name}.png", full_page=True)


def tell_instead(page: Page, *healths: Mapping[str, Any]) -> None:
    """Replace the event stream of a page with these health messages, after which it ends."""

    def instead(route: Route) -> None:
        told = "".join(f"event: health\ndata: {json.dumps(health)}\n\n" for health in healths)
        named = ",".join(f"{health['site']}/{health['machine']}=-1" for health in healths)
        route.fulfill(body=f"id: {named}\nevent: start\ndata: {{}}\n\n{told}", content_type="text/event-stream")

    page.add_init_script("delete window.SharedWorker")  # its requests cannot be routed
    page.route("**/api/v1/events?*", instead)


def run_deno(folder: Path, *arguments: str, given: str = "") -> subprocess.CompletedProcess[str]:
    """Run a command of Deno, which brings TypeScript, without any downloads."""
    quiet = {"DENO_DIR": str(folder / "cache"), "DENO_NO_UPDATE_CHECK": "1", "NO_COLOR": "1"}
    command, *rest = arguments
    words = [find_deno_bin(), command, "--no-remote", "--quiet", *rest]
    return subprocess.run(words, input=given, env=os.environ | quiet, capture_output=True, text=True, check=False)


def violations(page: Page) -> list[str]:
    """Violations of WCAG 2.2 AA on the page found by axe-core.

    If there are any, check again a second later from the top of the page: while plots appear, and under bars that stay
    in place during scrolling, controls overlap for a moment.
    """
    if not page.evaluate("'axe' in window"):
        page.evaluate(files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8"))
    # Details on rules that hold take as long as the check itself: only one place each is reported.
    options = {"runOnly": RULES, "resultTypes": ["violations"]}
    found: dict[str, Any] = page.evaluate("options => axe.run(document, options)", options)
    if found["violations"]:
        page.evaluate("scrollTo(0, 0)")
        page.wait_for_timeout(1000)
        found = page.evaluate("options => axe.run(document, options)", options)
    assert len(found["passes"]) > 10
    return [
        f"{rule['id']}: {node['html'][:200]}: {node['failureSummary']}"
        for rule in found["violations"]
        for node in rule["nodes"]
    ]


def unreached(page: Page) -> list[str]:
    """Controls that the Tab key does not reach, or that do not show their focus."""
    wrong: list[str] = []
    page.evaluate(
        "[document.activeElement.blur(), window.getSelection().removeAllRanges(), window.reached = new Map()]"
    )
    for _ in range(500):
        page.keyboard.press("Tab")
        told: str | None = page.evaluate(_FOCUSED)
        if told is None:
            break
        if told:
            wrong.append(f"no outline: {told}")
    left: list[str] = page.evaluate(_LEFT)
    return wrong + [f"not reached: {one}" for one in left]


_FOCUSED = """() => {
  const one = document.activeElement, style = getComputedStyle(one);
  const known = one.outerHTML.slice(0, 300);
  if (window.reached.has(one)) return null;
  window.reached.set(one, known);
  const shown = one === document.body || (style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 2);
  return shown ? "" : known;
}"""
_LEFT = """() => [...document.querySelectorAll("a[href], button, input, select, textarea, summary, [tabindex='0']")]
  .filter((one) => one.checkVisibility({ visibilityProperty: true }) && one.getClientRects().length && !one.disabled)
  .map((one) => one.outerHTML.slice(0, 300))
  .filter((known) => ![...window.reached.values()].includes(known))"""
