"""A mock monitor of any number of machines that only answers the page's requests, for measuring the browser alone."""

import asyncio
import copy
import itertools
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import uvicorn
from fastapi import FastAPI, Query
from fastapi.responses import StreamingResponse

from rotorwatch.records.example import example
from rotorwatch.records.health import Health
from service.analysis.overview import overview
from service.api.routes.page import add_page_routes

SITE = 25  # machines of one site
DAY_NS = 86_400_000_000_000


@dataclass(slots=True)
class Plant:
    """Machines that report in turns, a batch at a time."""

    machines: int
    batch: int
    every_s: float
    url: str = ""
    told: int = 0
    asked: list[int] = field(default_factory=list)

    def health(self, number: int) -> str:
        """Event with a machine's health; one machine in twenty is in alert."""
        told: dict[str, Any] = copy.deepcopy(dict(example(Health)))
        told |= {"site": f"site-{number // SITE:02d}", "machine": f"machine-{number:03d}"}
        for part in told["report"]["parameters"]:
            part["relative_change"] = np.random.default_rng().normal(0.0, 0.01)
        if number % 20:
            told |= {"state": "healthy", "alarms": []}
        return f"event: overview\ndata: {overview(Health.model_validate(told)).model_dump_json()}\n\n"

    async def events(self) -> AsyncIterator[str]:
        """Send the health of all machines, as the service does at the start, and then a batch every `every_s`."""
        yield "event: start\ndata: {}\n\n"
        for number in range(self.machines):
            yield self.health(number)
        turn = itertools.cycle(range(self.machines))
        while True:
            await asyncio.sleep(self.every_s)
            self.told += 1
            yield "".join(self.health(next(turn)) for _ in range(self.batch))

    def app(self) -> FastAPI:
        """Application with the routes that the page needs."""
        app = FastAPI()
        add_page_routes(app)

        @app.get("/api/v1/caller")
        def caller() -> dict[str, Any]:
            return {"name": "anonymous", "scopes": ["read"]}

        @app.get("/api/v1/events")
        async def events() -> StreamingResponse:
            return StreamingResponse(self.events(), media_type="text/event-stream")

        @app.get("/api/v1/trends")
        def trends(of: list[str] = Query()) -> dict[str, Any]:  # noqa: B008  # FastAPI's way to declare it
            self.asked.append(len(of))
            now_ns, step = time.time_ns(), DAY_NS // 48
            starts = [now_ns - (48 - at) * step for at in range(48)]
            return {"trends": [{"starts_ns": starts, "means": np.random.default_rng().random(48).tolist()} for _ in of]}

        return app


@contextmanager
def told(plant: Plant) -> Iterator[Plant]:
    """Serve the plant on loopback while the block runs."""
    server = uvicorn.Server(uvicorn.Config(plant.app(), host="127.0.0.1", port=0, log_level="error", lifespan="off"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.02)
    plant.url = f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    try:
        yield plant
    finally:
        server.force_exit = server.should_exit = True
        thread.join()
