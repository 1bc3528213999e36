"""Takes the documents' pictures of the page: a real monitor of three simulated rotors, one losing bearing stiffness.

Run: ``python benchmarks/screenshots.py [FOLDER]`` (two minutes, with a Chromium, or the one in ``ROTORWATCH_CHROMIUM``;
FOLDER is ``docs/figures`` by default).
"""

import argparse
import io
import json
import os
import re
import tempfile
from pathlib import Path

from page import chromium
from PIL import Image
from playwright.sync_api import Page
from running_monitor import PLACE, Monitor, monitor, serving, started

#: Path of each view, selector of an element that is present when it is complete, and height of its picture, px.
VIEWS = {
    "plant": ("", "machine-tile.alert spark-line polyline", 460),
    "machine": (f"machines/{PLACE}", "spectrum-plot canvas", 935),
    "alarms": ("alarms", "alarm-history table", 530),
    "why": (f"why/{PLACE}/k_by", "why-view canvas", 1250),
    "recordings": (f"recordings/{PLACE}", "recording-table table", 755),
    "replay": (f"recordings/{PLACE}", "recording-table table", 1100),
    "administration": ("administration", "service-load table", 900),
}
FAULT = "k_by=-0.25@140"
WIDTH, MOST_BYTES, PACE = 1280, 150_000, "6"
WAIT_MS = 240_000
SCRUBBER = 130  # height of the fixed parts above the window of a replay, px


def picture(page: Page, at: Path, height: int, top: str = "body") -> None:
    """Save a picture from the element `top` on, with as many colours as `MOST_BYTES` allows."""
    page.set_viewport_size({"width": WIDTH, "height": height})
    page.wait_for_timeout(1500)
    above = 0 if top == "body" else SCRUBBER
    page.locator(top).first.evaluate(f"one => scrollTo(0, one.getBoundingClientRect().top + scrollY - {above})")
    shot = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    for colours in (256, 128, 64, 32):
        shot.quantize(colours, dither=Image.Dither.NONE).save(at, optimize=True)
        if at.stat().st_size <= MOST_BYTES:
            break
    print(f"{at}: {at.stat().st_size / 1000:.0f} kB")


def look(one: Monitor, folder: Path) -> None:
    """Save a picture of every view once the fault is found."""
    with chromium() as browser:
        page = browser.new_page(viewport={"width": WIDTH, "height": 900}, color_scheme="light")
        page.set_default_timeout(WAIT_MS)
        page.goto(f"{one.url}/#/")
        page.locator("machine-tile.alert").wait_for()
        page.wait_for_timeout(20_000)
        for name, (path, there, height) in VIEWS.items():
            page.goto(f"{one.url}/#/{path}")
            if name == "plant":
                page.reload()  # updates the spark lines
            page.locator(there).first.wait_for()
            if name == "replay":
                page.get_by_role("button", name=re.compile("Choose ten minutes before and after .*k_by")).click()
                page.get_by_label("On-delay, s").fill("20")
                page.get_by_role("button", name="Start replay").click()
                page.locator("replay-parameters canvas").first.wait_for()
                page.get_by_role("slider", name="Window").focus()
                page.keyboard.press("End")
            picture(page, folder / f"page-{name}.png", height)
            if name == "replay":
                for plot in ("orbit-plot", "spectrum-plot"):
                    page.locator(f"window-plots plot-fold[shows='plots/{plot}'] summary").click()
                page.locator("window-plots canvas").first.wait_for()
                picture(page, folder / "page-replay-window.png", 900, "window-plots")


def sign_in(temporary: Path, folder: Path) -> None:
    """Save a picture of the sign-in view of a monitor that requires a token."""
    settings = {
        "ROTORWATCH_MACHINES": json.dumps([{"file": "lab"}]),
        "ROTORWATCH_LINK": json.dumps({"listen": ["tcp/127.0.0.1:0"]}),
        "ROTORWATCH_HTTP__PORT": "0",
        "ROTORWATCH_HISTORY__URL": f"sqlite:///{temporary}/guarded.sqlite",
    }
    with serving(temporary, os.environ | settings) as (_, url), chromium() as browser:
        page = browser.new_page(viewport={"width": WIDTH, "height": 900}, color_scheme="light")
        page.goto(f"{url}/#/")
        page.get_by_label("Access token").wait_for(timeout=WAIT_MS)
        picture(page, folder / "page-sign-in.png", 400)


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).parents[1] / "docs" / "figures")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        machines = [{"file": "lab", "bundle": "lab"}, {"file": "heavy"}, {"file": "light"}]
        settings = {
            "ROTORWATCH_MACHINES": json.dumps(machines),
            "ROTORWATCH_RECORDING": json.dumps({"directory": f"{temporary}/recordings", "rotate_s": 15}),
        }
        publish = ["--pace", PACE, "--duration", "900"]
        with monitor(Path(temporary), 1024, settings, *publish, "--fault", FAULT, "--seed", "2") as one:
            send = ["simulator.rotorsim", "publish", "--connect", one.endpoint, *publish, "--machine"]
            quiet = Path(os.devnull)
            others = [started([*send, name], quiet, quiet, dict(os.environ)) for name in ("heavy", "light")]
            try:
                look(one, folder)
            finally:
                for each in others:
                    each.terminate()
                    each.wait(60)
        sign_in(Path(temporary), folder)


if __name__ == "__main__":
    main()
