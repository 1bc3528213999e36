"""Measures what the event stream of a plant costs: bytes, and processor time without HTTP.

Run: ``python benchmarks/event_stream.py HEALTH`` (a minute) with the answer of ``GET …/health`` in a file. 500 machines
publish such a health every 5 s, in batches of 25 four times per second, to various numbers of listeners.
"""

import argparse
import asyncio
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rotorwatch.records.health import Health
from service.delivery.event_feed import EventFeed

MACHINES, TICK, TICK_S, SECONDS = 500, 25, 0.25, 8.0


def speaking(feed: EventFeed, healths: list[Health], ended: threading.Event) -> None:
    """Publish the health of machines as the service does, until `ended` is set."""
    at = 0
    while not ended.wait(TICK_S):
        for health in healths[at : at + TICK]:
            feed.health(health)
            time.sleep(0.001)
        at = (at + TICK) % len(healths)


async def measured(healths: list[Health], listeners: int, whole: Any) -> tuple[float, float]:
    """Processor load as a fraction of a core, and bytes per second of one stream."""
    feed, ended, heard = EventFeed(), threading.Event(), 0
    places = {f"{one.site}/{one.machine}": one for one in healths}
    logs: Any = dict.fromkeys(places, SimpleNamespace(last_sequence=-1))

    async def admitted() -> bool:
        return True

    async def listen() -> None:
        nonlocal heard
        async for text in feed.follow(logs, dict.fromkeys(places, -1), admitted, places.__getitem__, whole):
            heard += len(text)

    thread = threading.Thread(target=speaking, args=(feed, healths, ended))
    thread.start()
    tasks = [asyncio.create_task(listen()) for _ in range(listeners)]
    await asyncio.sleep(MACHINES / TICK * TICK_S + 3.0)  # skips the initial messages
    before_s, begin_s, before = time.process_time(), time.monotonic(), heard
    await asyncio.sleep(SECONDS)
    length_s = time.monotonic() - begin_s
    found = (time.process_time() - before_s) / length_s, (heard - before) / length_s / max(listeners, 1)
    ended.set()
    thread.join()
    for task in tasks:
        task.cancel()
    return found


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("health", type=Path)
    told = Health.model_validate_json(parser.parse_args().health.read_bytes())
    healths = [told.model_copy(update={"site": f"s{at // 25}", "machine": f"m{at}"}) for at in range(MACHINES)]
    print("| listeners | detail | % of a core | MB/s of a stream |\n|---|---|---|---|")
    for listeners in (0, 1, 20):
        for detail, whole in (("whole", None), ("overview", frozenset[str]())):
            share, rate = asyncio.run(measured(healths, listeners, whole))
            print(f"| {listeners} | {detail} | {100 * share:.1f} | {rate / 1e6:.3f} |", flush=True)


if __name__ == "__main__":
    main()
