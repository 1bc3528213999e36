"""Snapshots of the latest or a recorded window over HTTP: correlations and spectra with theory, and orbits.

Answers are cached, because many pages show the same machine.
"""

import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Query, Request
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel

from rotorwatch.records.snapshots import CorrelationSnapshot, OrbitSnapshot, SpectrumSnapshot, Units
from service.access.guard import Guard
from service.access.problems import problem_answer, written
from service.analysis.snapshots.channels import SnapshotError
from service.analysis.snapshots.machine import LatestData
from service.analysis.snapshots.orbit import MOST_REVOLUTIONS
from service.api.samples import ChosenWindow, SampleReader
from service.api.views import PLACE, InPath

_MOST = 64
_SAMPLES_HOLD_S = 1.0
_NONE: list[str] = []

_First = Annotated[list[str], Query(max_length=64, description="channel i of a pair, by name; may be repeated")]
_Second = Annotated[
    list[str],
    Query(max_length=64, description="channel j of each pair, as many as `first`; each with itself if left out"),
]
_Channels = Annotated[list[str], Query(alias="channel", max_length=64, description="name; may be repeated")]
_Units = Annotated[Units, Query(description="units of the values, the channels' own or SI")]
_Revolutions = Annotated[
    int, Query(ge=0, le=MOST_REVOLUTIONS, description="newest revolutions to show sample by sample as well")
]


@dataclass(slots=True)
class _Kept:
    lock: threading.Lock = field(default_factory=threading.Lock)
    body: bytes | None = None
    mark: object = None  # `LatestData.mark` of the data that it was made from
    newest_ns: int | None = None  # start of their newest block
    made_s: float = 0.0


class WindowAnswers:
    """Cache of answers that are valid until another window is evaluated; thread-safe."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._kept: dict[Hashable, _Kept] = {}  # least recently requested first

    def of(
        self, question: Hashable, data: LatestData, make: Callable[[], BaseModel], *, of_samples: bool = False
    ) -> Response:
        """Return the cached answer if it is still valid, else make it.

        An answer `of_samples` contains the newest samples; it is valid for one second only, and not across a gap.
        """
        with self._lock:
            kept = self._kept[question] = self._kept.pop(question) if question in self._kept else _Kept()
            while len(self._kept) > _MOST:
                del self._kept[next(iter(self._kept))]
        with kept.lock:
            now_s, mark = self._clock(), data.mark()
            holds = kept.mark == mark and not (of_samples and self._is_late(kept, data, now_s))
            if kept.body is None or not holds:
                kept.body = make().model_dump_json().encode()
                kept.mark, kept.made_s = mark, now_s
                kept.newest_ns = data.blocks[-1].start_ns if data.blocks else None
            return Response(kept.body, media_type="application/json")

    @staticmethod
    def _is_late(kept: _Kept, data: LatestData, now_s: float) -> bool:
        oldest_ns = data.blocks[0].start_ns if data.blocks else None
        if now_s - kept.made_s > _SAMPLES_HOLD_S or kept.newest_ns is None or oldest_ns is None:
            return True
        return oldest_ns > kept.newest_ns


def add_snapshot_routes(app: FastAPI, reader: SampleReader, guard: Guard) -> None:
    """Add the routes."""

    @app.exception_handler(SnapshotError)
    async def refused(request: Request, error: Exception) -> JSONResponse:
        return problem_answer(request, 422, str(error))

    common: dict[str, Any] = {"tags": ["snapshots"], "dependencies": [guard.read]}
    answers = WindowAnswers()

    @app.get(f"{PLACE}/correlations", **written(CorrelationSnapshot, 404, 422), **common)
    def correlations(
        view: InPath, chosen: ChosenWindow, first: _First = _NONE, second: _Second = _NONE, units: _Units = "channel"
    ) -> Response:
        """Correlation functions of the latest or a recorded window, with theory; a few pairs by default."""
        shown, data = reader.window(view, chosen)
        asked = ("correlations", view, chosen, tuple(first), tuple(second), units)
        return answers.of(asked, data, lambda: shown.correlations(data, first, second, units))

    @app.get(f"{PLACE}/spectra", **written(SpectrumSnapshot, 404, 422), **common)
    def spectra(
        view: InPath,
        chosen: ChosenWindow,
        channel: _Channels = _NONE,
        first: _First = _NONE,
        second: _Second = _NONE,
        from_hz: Annotated[float | None, Query(ge=0, le=1e6, description="only frequencies from here on")] = None,
        to_hz: Annotated[float | None, Query(ge=0, le=1e6, description="only frequencies up to here")] = None,
        units: _Units = "channel",
    ) -> Response:
        """Power spectral densities and cross-spectra of the latest or a recorded window, with theory."""
        band = None if from_hz is None and to_hz is None else (from_hz or 0.0, 1e6 if to_hz is None else to_hz)
        if band is not None and not band[0] < band[1]:
            raise HTTPException(422, f"to_hz: {band[1]:g} is not above from_hz {band[0]:g}")
        shown, data = reader.window(view, chosen)
        asked = ("spectra", view, chosen, tuple(channel), tuple(first), tuple(second), band, units)
        return answers.of(asked, data, lambda: shown.spectra(data, channel, first, second, band, units))

    @app.get(f"{PLACE}/orbits", **written(OrbitSnapshot, 404, 422), **common)
    def orbits(
        view: InPath, chosen: ChosenWindow, revolutions: _Revolutions = 0, units: _Units = "channel"
    ) -> Response:
        """Orbits at running speed of the latest or a recorded window, and revolutions as measured."""
        shown, data = reader.window(view, chosen)
        asked = ("orbits", view, chosen, revolutions, units)
        return answers.of(asked, data, lambda: shown.orbits(data, revolutions, units), of_samples=revolutions > 0)
