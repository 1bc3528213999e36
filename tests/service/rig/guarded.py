"""A small application with access control, a real server and a real store, for the tests of access."""

import base64
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import httpx
import uvicorn
from fastapi import APIRouter, FastAPI, Request
from fastapi.responses import HTMLResponse
from pydantic import BaseModel

from rotorwatch.records.history import AuditRecord
from service.access.audit import AuditNote
from service.access.guard import Guard
from service.access.problems import add_problems
from service.access.scopes import Caller, Scope
from service.access.tls import server_arguments
from service.access.tokens import new_token
from service.api.routes.tokens import add_session_routes, add_token_routes
from service.history.records import TokenRecord
from service.history.store import Store
from service.settings.access import AccessSettings
from tests.service.rig import monitored
from tests.service.rig.postgres import opened

JSON = {"content-type": "application/json"}


class Shelving(BaseModel):
    reason: str


@dataclass(slots=True)
class Clock:
    now_s: float = 1000.0

    def __call__(self) -> float:
        return self.now_s


@dataclass(slots=True)
class Guarded:
    """A running application and what it did."""

    url: str
    store: Store
    guard: Guard
    app: FastAPI
    clock: Clock
    done: list[str] = field(default_factory=list)

    def client(self, token: str = "", **arguments: Any) -> httpx.Client:
        headers = {"authorization": f"Bearer {token}"} if token else {}
        return httpx.Client(base_url=self.url, trust_env=False, headers=headers, timeout=180.0, **arguments)

    def token(self, *scopes: Scope, name: str = "ops", days: int | None = None, now_ns: int | None = None) -> str:
        return self.issue(*scopes, name=name, days=days, now_ns=now_ns)[1]

    def issue(
        self, *scopes: Scope, name: str = "ops", days: int | None = None, now_ns: int | None = None
    ) -> tuple[TokenRecord, str]:
        record, text = new_token(name, scopes, now_ns=time.time_ns() if now_ns is None else now_ns, days=days)
        self.store.tokens.add(record)
        return record, text

    def entries(self) -> list[AuditRecord]:
        return list(reversed(self.store.audit.entries(limit=1000)))


def application(guard: Guard, done: list[str]) -> FastAPI:
    """Routes of every kind; `done` records which of them ran."""
    app = FastAPI(dependencies=[guard.gate], openapi_url=None, docs_url=None, redoc_url=None)
    add_problems(app)

    @app.get("/healthz")
    def healthz() -> bool:
        return True

    @app.get("/readyz", dependencies=[guard.read])
    def readyz() -> bool:
        return True

    @app.get("/docs", dependencies=[guard.read], response_class=HTMLResponse)
    def page() -> str:
        return "<!doctype html><title>t</title>"

    @app.get("/health")
    def health(caller: Annotated[Caller, guard.read]) -> dict[str, str]:
        return {"name": caller.name, "address": caller.address}

    alarms = APIRouter(prefix="/alarms", dependencies=[guard.read])

    @alarms.post("/{alarm}/shelve")
    def shelve(request: Request, alarm: str, body: Shelving, caller: Annotated[Caller, guard.operate]) -> str:
        request.state.audit = AuditNote("shelve", "demo/lab", alarm, body.reason)
        done.append(f"shelve {alarm} {caller.name}")
        return "shelved"

    @alarms.get("")
    def listed() -> list[str]:
        return []

    app.include_router(alarms)
    add_session_routes(app, guard)
    add_token_routes(app, guard)

    @app.delete("/machine", dependencies=[guard.configure])
    def remove() -> str:
        done.append("remove")
        return "removed"

    @app.post("/broken", dependencies=[guard.operate])
    def broken() -> str:
        raise RuntimeError("rw_broken inside")

    @app.post("/large")
    async def large(request: Request, _: Annotated[Caller, guard.operate]) -> int:
        return len(await request.body())

    @app.get("/forgotten")
    def forgotten() -> str:
        done.append("forgotten")
        return "forgotten"

    @app.post("/forgotten")
    def forgotten_too() -> str:
        done.append("forgotten")
        return "forgotten"

    return app


@contextmanager
def served(app: FastAPI, host: str = "127.0.0.1", **arguments: Any) -> Iterator[str]:
    """Serve an application on a free port; its URL."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.create_server((host, 0), family=family)
    # Without it the end of every response waits 40 ms for the peer's acknowledgement.
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    config = uvicorn.Config(app, log_config=None, access_log=False, lifespan="off", **arguments)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    thread.start()
    scheme = "https" if config.is_ssl else "http"
    try:
        yield f"{scheme}://{f'[{host}]' if ':' in host else host}:{listening.getsockname()[1]}"
    finally:
        server.should_exit = True
        server.force_exit = True
        thread.join(180)
        listening.close()
        assert not thread.is_alive()


@contextmanager
def guarded(
    folder: Path, access: AccessSettings | None = None, build: Callable[[Guard, list[str]], FastAPI] = application
) -> Iterator[Guarded]:
    """The application of `build` behind its guard, with a store in `folder`."""
    access = access or AccessSettings()
    with opened(f"sqlite:///{folder / 'history.sqlite'}") as store:
        clock, done = Clock(), list[str]()
        guard = Guard(store.tokens, store.audit, access, "127.0.0.1", monotonic=clock)
        app = build(guard, done)
        guard.protect(app)
        with served(app, **server_arguments(access)) as url:
            yield Guarded(url, store, guard, app, clock, done)


def basic(token: str, user: str = "x") -> dict[str, str]:
    return {"authorization": "Basic " + base64.b64encode(f"{user}:{token}".encode()).decode()}


def problem(answer: httpx.Response, status: int) -> str:
    return monitored.problem(answer, status).detail
