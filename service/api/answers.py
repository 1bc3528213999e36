"""Answers about a window, made once for all who ask the same: many pages show the same machine."""

import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

from fastapi.responses import Response
from pydantic import BaseModel

from service.analysis.snapshots.heading import LatestData

_MOST = 64
_SAMPLES_HOLD_S = 1.0


@dataclass(slots=True)
class _Kept:
    lock: threading.Lock = field(default_factory=threading.Lock)
    body: bytes | None = None
    mark: object = None  # of what it was made
    newest_ns: int | None = None  # and the newest samples then
    made_s: float = 0.0


class WindowAnswers:
    """Answers that hold until another window is evaluated; any thread may ask."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._kept: dict[Hashable, _Kept] = {}  # in the order in which they were asked for

    def of(
        self, question: Hashable, data: LatestData, make: Callable[[], BaseModel], *, of_samples: bool = False
    ) -> Response:
        """What is kept if it still holds, else what is made.

        Parameters
        ----------
        of_samples : bool
            Whether the newest samples are in it: then it holds for a second only, and not across a gap.
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
