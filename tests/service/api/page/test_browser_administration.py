"""The administration view in a browser: tokens, audit log, and the state of the service."""

import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from rotorwatch.records.example import example
from rotorwatch.records.monitor import MachineReadiness, Readiness, WebhookList
from service.access.scopes import Scope
from service.runtime.runtime import Runtime
from tests.service.api.page.browsing import PATIENCE_MS, kept, looking, unreached, violations
from tests.service.rig.monitored import GUARDED, fed, token

OLD = 60
"""Older entries of the audit log, more than a page."""


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runtime]:
    with fed(tmp_path_factory.mktemp("machine"), GUARDED) as (running, feed):
        feed.put_good()
        for number in range(OLD):
            running.store.audit.append(
                number, 200, actor="anna", address="", method="POST", path="/api/v1/x", action="reset",
                machine="demo/lab", alarm="k_by", reason="long ago",
            )  # fmt: skip
        yield running


def sign_in(page: Page, url: str, text: str, view: str) -> None:
    page.goto(f"{url}/#/{view}")
    page.get_by_label("Access token").fill(text)
    page.keyboard.press("Enter")


def test_empty_sections_keep_their_headings(browser: Browser, tmp_path: Path) -> None:
    with fed(tmp_path) as (running, _), looking(browser, running.http_url) as page:
        page.goto(f"{running.http_url}/#/administration")
        for heading in ("Access tokens", "Webhooks", "Audit log"):
            expect(page.get_by_role("heading", name=heading, exact=True)).to_be_visible()
        expect(page.locator("token-list")).to_contain_text("There are no tokens.")
        assert not violations(page)
        with browser.new_page() as other:  # whose console reports the refused request
            other.goto(f"{running.http_url}/#/recordings")
            expect(other.locator("recordings-view")).to_contain_text("the settings name no directory for them")
            for element in ("replay-order", "recording-line", "recording-table", "recordings-view .tools select"):
                expect(other.locator(element).first).to_be_hidden()


def test_a_token_is_created_used_to_sign_in_and_revoked(browser: Browser, runtime: Runtime) -> None:
    url = runtime.http_url
    faults: list[str] = []
    with browser.new_context(viewport={"width": 1360, "height": 850}) as context, browser.new_context() as other:
        for one in (context, other):
            one.set_default_timeout(PATIENCE_MS)
        page, second = context.new_page(), other.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        second.on("pageerror", lambda error: faults.append(str(error)))
        chief = token(runtime, Scope.READ, Scope.CONFIGURE, name="chief")
        sign_in(page, url, chief, "administration")
        expect(page.locator("token-list tr", has_text="chief")).to_contain_text("(yours)")
        expect(page.get_by_label("operate")).to_be_disabled()  # a scope that the user lacks

        page.get_by_label("Name, as shown in the audit log").fill("screen <b>1</b>")
        page.get_by_role("button", name="Create token").click()
        made = page.get_by_label("New token")
        expect(made).to_have_value(re.compile(r"rw_[0-9A-Za-z]{12}_[0-9A-Za-z]{43}"))
        text = made.input_value()
        kept(page, "administration-made")
        page.get_by_role("button", name="Hide").click()
        expect(made).to_have_count(0)
        assert text not in page.content()

        sign_in(second, url, text, "administration")
        expect(second.locator("header")).to_contain_text("screen <b>1</b>")
        expect(second.locator("administration-view")).to_contain_text("This needs the scope configure")
        expect(second.get_by_role("link", name="Administration")).to_have_count(0)
        page.reload()
        row = page.locator("token-list tr", has_text="screen <b>1</b>")
        expect(row).to_contain_text("valid")
        expect(row).not_to_contain_text("not since the monitor started")
        row.get_by_role("button", name="Revoke").click()
        page.get_by_role("dialog").get_by_role("button", name="Revoke").click()
        expect(row).to_contain_text("revoked")
        second.goto(f"{url}/#/alarms")
        second.reload()
        expect(second.locator("sign-in")).to_be_visible()

        page.reload()
        log = page.locator("audit-log tbody tr")
        token_id = text[3:15]
        for action, outcome in (("revoke-token", "done (200)"), ("create-token", "done (201)")):
            entry = log.filter(has_text=action)
            expect(entry).to_have_count(1)  # start and outcome are one entry
            expect(entry).to_contain_text(outcome)
            expect(entry).to_contain_text(token_id)
        assert text[16:] not in page.content()
        expect(page.locator("service-load tbody tr")).to_contain_text("demo/lab")
        expect(page.locator("history-status")).to_contain_text("kept for 14 days")
        expect(page.locator("webhook-list")).to_contain_text("The settings name no webhook")
        expect(page.locator("settings-list tr", has_text="[queue] when_full")).to_be_visible()
        page.get_by_role("button", name="Older").click()
        expect(log.filter(has_text="long ago")).to_have_count(OLD)
        page.route("**/api/v1/webhooks", lambda route: route.fulfill(json=example(WebhookList)))
        stuck = example(MachineReadiness) | {
            "trouble": "no window has been evaluated for two hops",
            "queue_blocks": 412,
        }
        unready = example(Readiness) | {"ready": False, "reasons": ["demo/lab: stuck"], "machines": [stuck]}
        page.route("**/readyz", lambda route: route.fulfill(status=503, json=unready))
        page.reload()
        for element, texts in {
            "webhook-list": ("pager", "https://pager.example", "503 Service Unavailable (1 failed in all)", "00:02:25"),
            "service-load": ("Not ready.", "demo/lab: stuck", "412", "no window has been evaluated for two hops"),
        }.items():
            for told in texts:
                expect(page.locator(element)).to_contain_text(told)
        for kind, width, dark in (("light", 1360, False), ("dark phone", 390, True)):
            page.set_viewport_size({"width": width, "height": 850})
            page.emulate_media(color_scheme="dark" if dark else "light")
            kept(page, f"administration-{kind}")
            assert not violations(page)
            assert not unreached(page)
            assert page.evaluate("document.documentElement.scrollWidth") == width
        page.locator("token-list tr", has_text="chief").get_by_role("button", name="Revoke").click()
        expect(page.get_by_role("dialog")).to_contain_text("you will be signed out immediately")
        page.get_by_role("dialog").get_by_role("button", name="Cancel").click()
        expect(page.get_by_role("dialog")).to_have_count(0)
    assert not faults
    with httpx.Client(base_url=url, trust_env=False, headers={"authorization": f"Bearer {chief}"}) as http:
        assert http.get("/api/v1/tokens").status_code == 200
