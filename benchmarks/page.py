"""What the page costs: a browser with a plant of many machines, and a monitor with many pages.

Run: ``python benchmarks/page.py`` (about six minutes, with a Chromium, or what ``ROTORWATCH_CHROMIUM`` names),
``--small`` for a minute.

Plant: for each number of machines, all in one run, a server tells the page of each machine's health in batches. *Batch*
is the processor time of the browser's main thread, over the number of batches: reading, elements, style, layout and
painting. *Longest* is its longest task. Then the view is scrolled from top to bottom while batches come (*frames*:
median, 95 % and longest); *questions* are those for lines, before that and while it is scrolled.

Monitor: for each number of pages that show the machine, the monitor's processor time, and how much later than at the
earliest a window's report arrives at somebody who follows the event stream (median and largest).
"""

import argparse
import json
import os
import shutil
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
from page_plant import Plant, told
from playwright.sync_api import Browser, CDPSession, sync_playwright
from running_monitor import PLACE, Monitor, monitor

NAMES = ("chromium", "chromium-browser", "google-chrome")
TICKS = os.sysconf("SC_CLK_TCK")
WATCH = """() => {
  window.longest = 0;
  const note = (one) => { window.longest = Math.max(window.longest, one.duration); };
  new PerformanceObserver((list) => list.getEntries().forEach(note)).observe({ type: "longtask" });
}"""
SCROLL = """async () => {
  const frame = () => new Promise(requestAnimationFrame);
  const gaps = [], end = document.documentElement.scrollHeight - innerHeight;
  let before = await frame();
  for (let at = 0; at <= end; at += 60) {
    scrollTo(0, at);
    const now = await frame();
    gaps.push(now - before);
    before = now;
  }
  return gaps.sort((one, other) => one - other);
}"""


@contextmanager
def chromium() -> Iterator[Browser]:
    """The browser that there is."""
    path = os.environ.get("ROTORWATCH_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)))
    flags = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    with sync_playwright() as playwright, playwright.chromium.launch(executable_path=path, args=flags) as found:
        yield found


def busy_s(session: CDPSession) -> float:
    """Processor time of the page's main thread."""
    metrics = session.send("Performance.getMetrics")["metrics"]
    return float(next(one["value"] for one in metrics if one["name"] == "TaskDuration"))


def plant(browser: Browser, machines: int, seconds: float) -> None:
    """One line about a plant."""
    with told(Plant(machines, max(1, machines // 25), 0.2)) as served, browser.new_context() as context:
        page = context.new_page()
        begin_s = time.monotonic()
        page.goto(served.url)
        page.locator("machine-tile").nth(machines - 1).wait_for(state="attached", timeout=60_000)
        first_s = time.monotonic() - begin_s
        page.wait_for_timeout(3000)
        page.evaluate(WATCH)
        session = context.new_cdp_session(page)
        session.send("Performance.enable", {"timeDomain": "threadTicks"})  # what else the computer does, left out
        before_s, batches = busy_s(session), served.told
        page.wait_for_timeout(1000 * seconds)
        batch_ms = 1000 * (busy_s(session) - before_s) / (served.told - batches)
        longest_ms = page.evaluate("longest")
        standing = len(served.asked)
        begin_s = time.monotonic()
        gaps = page.evaluate(SCROLL)
        scrolled_s = time.monotonic() - begin_s
        print(
            f"| {machines} | {first_s:.2f} | {served.batch} | {batch_ms:.1f} | {longest_ms or '< 50'} "
            f"| {statistics.median(gaps):.0f}, {gaps[int(0.95 * len(gaps))]:.0f}, {gaps[-1]:.0f} | {scrolled_s:.1f} "
            f"| {standing}, {len(served.asked) - standing} |",
            flush=True,
        )


def processor_s(one: Monitor) -> float:
    """Processor time that the monitor has taken."""
    fields = Path(f"/proc/{one.process.pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def arrivals(one: Monitor, ended: threading.Event, found: list[tuple[int, float]]) -> None:
    """End of each window, and when its report arrived."""
    seen = -1
    with httpx.stream("GET", f"{one.url}/api/v1/events", timeout=60, trust_env=False) as answer:
        for line in answer.iter_lines():
            if ended.is_set():
                return
            if line.startswith("data: {") and '"report"' in line:
                report = json.loads(line[6:]).get("report")
                if report and report["end_ns"] > seen:
                    seen = report["end_ns"]
                    found.append((seen, time.time()))


def pages(browser: Browser, one: Monitor, count: int, seconds: float) -> tuple[float, float, list[float]]:
    """Share of a core, seconds until a page shows the machine, and lateness of reports with so many pages open."""
    heard: list[tuple[int, float]] = []
    ended = threading.Event()
    listener = threading.Thread(target=arrivals, args=(one, ended, heard))
    first_s = float("nan")
    with browser.new_context() as context:
        for _ in range(count):
            page = context.new_page()
            begin_s = time.monotonic()
            page.goto(f"{one.url}/#/machines/{PLACE}")
            page.locator("parameter-table table").wait_for(timeout=120_000)
            first_s = time.monotonic() - begin_s
        time.sleep(10)
        listener.start()
        before_s, begin_s = processor_s(one), time.monotonic()
        while time.monotonic() - begin_s < seconds:
            if context.pages:
                context.pages[0].wait_for_timeout(500)
            else:
                time.sleep(0.5)
        share = (processor_s(one) - before_s) / (time.monotonic() - begin_s)
        ended.set()
        listener.join()
    return share, first_s, [arrived - end_ns / 1e9 for end_ns, arrived in heard[1:]]


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--small", action="store_true", help="fewer machines and pages, for seconds")
    small = parser.parse_args().small
    with chromium() as browser:
        print(
            "| machines | first view, s | in a batch | batch, ms | longest, ms | frames, ms | scrolled, s | questions |"
        )
        print("|---|---|---|---|---|---|---|---|")
        for machines in (25, 50) if small else (50, 500):
            plant(browser, machines, 5.0 if small else 20.0)
        print("\n| pages | % of a core | of which a page | first view, s | reports | later than the earliest, s |")
        print("|---|---|---|---|---|---|")
        with tempfile.TemporaryDirectory() as folder, monitor(Path(folder), 1024, {}) as one:
            time.sleep(20 if small else 70)  # the window is full
            # Without pages before and after: what else the computer does changes.
            counts = (0, 1) if small else (0, 1, 20, 0)
            measured = [(count, *pages(browser, one, count, 15.0 if small else 60.0)) for count in counts]
            earliest_s = min(late for _, _, _, lates in measured for late in lates)
            base = statistics.mean(share for count, share, _, _ in measured if not count)
            for count, share, first_s, lates in measured:
                each = f"{100 * (share - base) / count:.2f}" if count else ""
                late = [one - earliest_s for one in lates]
                latest = f"{statistics.median(late):.2f}, {max(late):.2f}"
                print(f"| {count} | {100 * share:.1f} | {each} | {first_s:.2f} | {len(late)} | {latest} |")


if __name__ == "__main__":
    main()
