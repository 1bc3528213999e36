"""Measures what the page costs: in a browser with a plant of many machines, and in a monitor with many pages.

Run: ``python benchmarks/page.py`` (about eight minutes, with a Chromium, or the one in ``ROTORWATCH_CHROMIUM``),
``--small`` for three.

Plant: for each number of machines, all in one run, a server sends the page the health of machines in batches. *Batch*
is the processor time of the browser's main thread per batch: parsing, elements, style, layout and painting. *Longest*
is its longest task. Then the view is scrolled from top to bottom while batches arrive (*frames*: median, 95 % and
longest); *questions* are the requests for spark lines before and during scrolling.

Monitor: the requests that a page repeats while it shows the machine are recorded with the browser, which is then
closed. For each number of simulated browsers that repeat these requests and hold an event stream each, the monitor's
processor time, the data rate of each stream, and the delay of reports at a follower of the event stream are measured,
relative to the earliest (median and largest). Nothing is drawn meanwhile, so only the monitor can get slower.
"""

import argparse
import http.client
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
from capacity import Process
from page_plant import Plant, told
from playwright.sync_api import Browser, CDPSession, sync_playwright
from running_monitor import PLACE, Monitor, monitor

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
EVERY_S = 15.0
STREAM = f"/api/v1/events?detail=overview&in_full={PLACE}"
MANY_STREAMS = {"ROTORWATCH_ACCESS__LIMITS__STREAMS_PER_CALLER": "100"}
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
    """Launch the installed Chromium, or the one named in ``ROTORWATCH_CHROMIUM``."""
    path = os.environ.get("ROTORWATCH_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)))
    flags = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    with sync_playwright() as playwright, playwright.chromium.launch(executable_path=path, args=flags) as found:
        yield found


def busy_s(session: CDPSession) -> float:
    """Processor time of the page's main thread."""
    metrics = session.send("Performance.getMetrics")["metrics"]
    return float(next(one["value"] for one in metrics if one["name"] == "TaskDuration"))


def plant(browser: Browser, machines: int, seconds: float) -> None:
    """Measure the page with a plant, and print a line."""
    with told(Plant(machines, max(1, machines // 25), 0.2)) as served, browser.new_context() as context:
        page = context.new_page()
        begin_s = time.monotonic()
        page.goto(served.url)
        page.locator("machine-tile").nth(machines - 1).wait_for(state="attached", timeout=60_000)
        first_s = time.monotonic() - begin_s
        page.wait_for_timeout(3000)
        page.evaluate(WATCH)
        session = context.new_cdp_session(page)
        session.send("Performance.enable", {"timeDomain": "threadTicks"})  # excludes other load of the computer
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


def arrivals(one: Monitor, ended: threading.Event, found: list[tuple[int, float]]) -> None:
    """Append the end of each window, ns, and the arrival time of its report, s, to `found`."""
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


def asked_again(browser: Browser, one: Monitor) -> list[str]:
    """Paths that a page requests every 15 s while it shows the machine."""
    asked: list[str] = []
    with browser.new_context() as context:
        page = context.new_page()
        page.on("request", lambda request: asked.append(request.url.removeprefix(one.url)))
        page.goto(f"{one.url}/#/machines/{PLACE}")
        page.locator("parameter-table table").wait_for(timeout=120_000)
        page.wait_for_timeout(1000)
        asked.clear()
        page.wait_for_timeout(1000 * EVERY_S)
    return sorted({url.partition("?")[0]: url for url in asked if url.startswith("/api/")}.values())


def asking(one: Monitor, paths: list[str], phase_s: float, ended: threading.Event) -> None:
    """Repeat a page's requests every 15 s, until `ended` is set."""
    connection = http.client.HTTPConnection(one.url.removeprefix("http://"), timeout=60)
    wait_s = phase_s
    while not ended.wait(wait_s):
        begin_s = time.monotonic()
        for path in paths:
            connection.request("GET", path)
            connection.getresponse().read()
        connection.close()  # the monitor would close it before the next request
        wait_s = EVERY_S - (time.monotonic() - begin_s)


def hearing(one: Monitor, ended: threading.Event, heard: list[int]) -> None:
    """Follow the event stream as a page does, and append the number of bytes of each line to `heard`."""
    connection = http.client.HTTPConnection(one.url.removeprefix("http://"), timeout=60)
    connection.request("GET", STREAM)
    answer = connection.getresponse()
    while answer.status == httpx.codes.OK and not ended.is_set():
        heard.append(len(answer.readline()))
    connection.close()


def pages(one: Monitor, paths: list[str], count: int, seconds: float) -> tuple[float, float, list[float]]:
    """Fraction of a core, bytes per second of a stream, and delays of reports, s, with `count` pages."""
    arrived: list[tuple[int, float]] = []
    heard: list[int] = []
    ended = threading.Event()
    listener = threading.Thread(target=arrivals, args=(one, ended, arrived))
    threads = [threading.Thread(target=hearing, args=(one, ended, heard)) for _ in range(count)]
    phases = [EVERY_S * at / max(count, 1) for at in range(count)]
    threads += [threading.Thread(target=asking, args=(one, paths, phase_s, ended)) for phase_s in phases]
    for each in (listener, *threads):
        each.start()
    time.sleep(EVERY_S)  # skips the initial requests, which are not repeated
    process = Process(one.process.pid)
    before_s, before, begin_s = process.cpu_s(), sum(heard), time.monotonic()
    arrived.clear()
    time.sleep(seconds)
    length_s = time.monotonic() - begin_s
    share, rate = (process.cpu_s() - before_s) / length_s, (sum(heard) - before) / length_s / max(count, 1)
    found = [at_s - end_ns / 1e9 for end_ns, at_s in arrived]
    ended.set()
    for each in (listener, *threads):
        each.join()
    return share, rate, found


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--small", action="store_true", help="fewer machines and pages for some seconds")
    small = parser.parse_args().small
    with chromium() as browser:
        print(
            "| machines | first view, s | in a batch | batch, ms | longest, ms | frames, ms | scrolled, s | questions |"
        )
        print("|---|---|---|---|---|---|---|---|")
        for machines in (25, 50) if small else (50, 500):
            plant(browser, machines, 5.0 if small else 20.0)
        with tempfile.TemporaryDirectory() as folder, monitor(Path(folder), 1024, MANY_STREAMS) as one:
            time.sleep(20 if small else 70)  # the window is full
            paths = asked_again(browser, one)
            browser.close()
            print(
                "\nevery 15 s a page asks for", ", ".join(path.rpartition("/")[2].partition("?")[0] for path in paths)
            )
            print(
                "\n| pages | % of a core | of which a page | kB/s of a stream | reports | later than the earliest, s |"
            )
            print("|---|---|---|---|---|---|")
            # Without pages both first and last, because other load of the computer changes.
            counts = (0, 1) if small else (0, 1, 20, 0)
            measured = [(count, *pages(one, paths, count, 15.0 if small else 60.0)) for count in counts]
            earliest_s = min(late for _, _, _, lates in measured for late in lates)
            base = statistics.mean(share for count, share, _, _ in measured if not count)
            for count, share, rate, lates in measured:
                each = f"{100 * (share - base) / count:.2f}" if count else ""
                late = [one - earliest_s for one in lates]
                latest = f"{statistics.median(late):.2f}, {max(late):.2f}"
                print(f"| {count} | {100 * share:.1f} | {each} | {rate / 1e3:.1f} | {len(late)} | {latest} |")


if __name__ == "__main__":
    main()
