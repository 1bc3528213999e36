"""What a person sees in a browser: a real Chromium opens the pages of a running, guarded service.

The browser is what ``ROTORWATCH_CHROMIUM`` names, or the system's own; no registry of Python packages has one that is
kept up to date, so where there is none, these tests are skipped (what is asked of browsers is tested without one in
``test_access_http.py``). To keep what was seen: ``ROTORWATCH_SCREENSHOTS=FOLDER``.
"""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Error, HttpCredentials, Page, sync_playwright

from service.access.scopes import Scope
from service.runtime import Runtime
from tests.service.monitored import GUARDED, fed, token

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
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
SCREENSHOTS = os.environ.get("ROTORWATCH_SCREENSHOTS")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    path = os.environ.get("ROTORWATCH_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:  # a fresh machine has none, and it takes an administrator to install one
        pytest.skip(f"no browser: ROTORWATCH_CHROMIUM is not set, and none of {', '.join(NAMES)} is there")
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=path, args=FLAGS, timeout=PATIENCE_MS) as found,
    ):
        yield found


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runtime]:
    with fed(tmp_path_factory.mktemp("machine"), GUARDED) as (running, _):
        yield running


def kept(page: Page, name: str) -> None:
    if SCREENSHOTS:
        page.screenshot(path=Path(SCREENSHOTS) / f"{name}.png", full_page=True)


def test_a_browser_asks_for_the_token_and_shows_the_machine(browser: Browser, runtime: Runtime) -> None:
    url = runtime.http_url
    with browser.new_page() as stranger, stranger.expect_response(url + "/") as refused:
        with pytest.raises(Error, match="ERR_INVALID_AUTH_CREDENTIALS"):  # it asked, and nobody gave a password
            stranger.goto(url)
        assert refused.value.status == 401
        asked = [one["value"].split()[0] for one in refused.value.headers_array() if one["name"] == "www-authenticate"]
        assert asked == ["Bearer", "Basic"]
    given = HttpCredentials(username="anybody", password=token(runtime, Scope.READ, name="screen"), origin=url)
    with browser.new_context(http_credentials=given) as context:
        context.set_default_timeout(PATIENCE_MS)
        page = context.new_page()
        shown = page.goto(url)
        assert shown is not None
        assert shown.status == 200
        page.get_by_role("heading", name="demo/lab").wait_for()
        kept(page, "front")


def test_the_page_of_the_api_works_without_anything_from_elsewhere(browser: Browser, runtime: Runtime) -> None:
    url = runtime.http_url
    given = HttpCredentials(username="anybody", password=token(runtime, Scope.READ, name="reader"), origin=url)
    asked: list[str] = []
    faults: list[str] = []
    with browser.new_context(http_credentials=given) as context:
        context.set_default_timeout(PATIENCE_MS)
        page = context.new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.goto(f"{url}/docs")
        page.get_by_role("heading", name="rotorwatch").wait_for()
        kept(page, "docs")
        page.locator("#operations-machines-machines").get_by_role("button").first.click()
        page.get_by_role("button", name="Execute").click()
        shown = page.locator("#operations-machines-machines .live-responses-table")
        shown.get_by_text("200", exact=True).first.wait_for()
        assert '"machine": "lab"' in shown.inner_text()
        kept(page, "docs-tried")
    assert len(asked) >= 5
    assert all(one.startswith((f"{url}/", "data:", "blob:")) for one in asked), asked
    assert not faults
