"""What several modules of tests of the service ask for by the same name; a module may still say its own."""

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
    """Of an argument or an answer of the HTTP API.

    They are the same for every service that a test starts, and making them was two fifths of the computing of a start.
    """
    key = (kind.__origin__, f"{kind.__metadata__} {more}")
    if key not in _ADAPTERS:
        _ADAPTERS[key] = TypeAdapter(kind, **more)
    return _ADAPTERS[key]


fastapi._compat.v2.TypeAdapter = _adapter  # type: ignore[attr-defined, assignment]


@pytest.fixture(scope="module")
def browser() -> Iterator["Browser"]:
    from tests.service.api.page.browsing import chromium  # noqa: PLC0415  # only who looks at pages waits for the library

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
