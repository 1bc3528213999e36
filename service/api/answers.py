"""Answers about a window, made once for all who ask the same: many pages show the same machine."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from fastapi.responses import Response
from pydantic import BaseModel
from starlette.datastructures import URL

from service.analysis.snapshots.heading import LatestData

_MOST = 64
_SAMPLES_HOLD_S = 1.0


@dataclass(slots=True)
class _Kept:
    lock: threading.Lock = field(default_factory=threading.Lock)
    data: LatestData | None = None
    made_s: float = 0.0
    body: bytes = b""


class WindowAnswers:
    """Answers that hold until another window is evaluated; any thread may ask."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._kept: dict[str, _Kept] = {}  # in the order in which they were asked for

    def of(self, url: URL, data: LatestData, make: Callable[[], BaseModel], *, of_samples: bool = False) -> Response:
        """What is kept if it still holds, else what is made.

        Parameters
        ----------
        of_samples : bool
            Whether the newest samples are in it: then it holds for a second only.
        """
        question = f"{url.path}?{url.query}"
        with self._lock:
            kept = self._kept[question] = self._kept.pop(question) if question in self._kept else _Kept()
            while len(self._kept) > _MOST:
                del self._kept[next(iter(self._kept))]
        with kept.lock:
            late = of_samples and self._clock() - kept.made_s > _SAMPLES_HOLD_S
            if kept.data is None or late or not data.goes_on_from(kept.data, samples=of_samples):
                kept.made_s = self._clock()
                kept.body = make().model_dump_json().encode()
                kept.data = replace(data, blocks=data.blocks[-1:])
            return Response(kept.body, media_type="application/json")
