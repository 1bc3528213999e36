"""Fixtures shared by several test modules of the service; a module may override them."""

import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import fastapi._compat.v2
import pytest
from pydantic import TypeAdapter

from service.history.store import Store
from tests.service.rig.guarded import Guarded, guarded
from tests.service.rig.postgres import KINDS, database_url, opened
from tests.service.rig.preloaded import Piped

if TYPE_CHECKING:
    from playwright.sync_api import Browser

_ADAPTERS: dict[tuple[object, str], TypeAdapter[Any]] = {}


def _adapter(kind: Any, **more: Any) -> TypeAdapter[Any]:
    """Cached adapter of an argument or a response of the HTTP API.

    They are the same in every service that a test starts, and building them was two fifths of the CPU time of a start.
    """
    key = (kind.__origin__, f"{kind.__metadata__} {more}")
    if key not in _ADAPTERS:
        _ADAPTERS[key] = TypeAdapter(kind, **more)
    return _ADAPTERS[key]


fastapi._compat.v2.TypeAdapter = _adapter  # type: ignore[attr-defined, assignment]


@pytest.fixture(scope="module")
def browser() -> Iterator["Browser"]:
    from tests.service.api.page.browsing import chromium  # noqa: PLC0415  # only tests of the page wait for the library

    with chromium() as found:
        yield found


@pytest.fixture
def monitor(tmp_path: Path) -> Iterator[Guarded]:
    with guarded(tmp_path) as running:
        yield running


@pytest.fixture(params=KINDS)
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return database_url(request.param, tmp_path)


@pytest.fixture
def store(url: str) -> Iterator[Store]:
    with opened(url) as made:
        yield made


@pytest.fixture
def replays_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replays that a service of this process starts need import nothing first, see `tests.service.rig.preloaded`."""
    started = SimpleNamespace(**{**vars(subprocess), "Popen": Piped})
    monkeypatch.setattr("service.recordings.replay.jobs.subprocess", started)
