"""Logging to standard error: structlog for our own lines, and the same formatter for the standard library's loggers."""

import logging
import sys
import time
from collections.abc import Callable

import structlog
from structlog.typing import FilteringBoundLogger, Processor

from service.settings.service import LogSettings

_QUIET_S = 10.0


def configure_logging(settings: LogSettings) -> None:
    """Set up the process's logging; call it once, at start-up."""
    shared: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    final: list[Processor] = [structlog.stdlib.ProcessorFormatter.remove_processors_meta]
    if settings.format == "json":
        final += [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
    else:
        final.append(
            structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback)
        )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(structlog.stdlib.ProcessorFormatter(foreign_pre_chain=shared, processors=final))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(settings.level.upper())
    # Libraries log warnings and errors only.
    for name in ("uvicorn", "uvicorn.error", "uvicorn.access", "asyncio", "httpx", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    # Uvicorn warns of every request that is not HTTP, which anybody can send: once a minute is enough.
    minute = Limiter(quiet_s=60.0)
    logging.getLogger("uvicorn.error").filters[:] = [
        lambda record: record.levelno >= logging.ERROR or minute.admit(str(record.msg)) is not None
    ]
    structlog.configure(
        processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
        cache_logger_on_first_use=False,
    )


def logger(**context: str) -> FilteringBoundLogger:
    """Return a logger whose lines carry `context`."""
    bound: FilteringBoundLogger = structlog.get_logger("rotorwatch", **context)
    return bound


class Limiter:
    """Leaves at least `quiet_s` between two log lines of a kind, and counts those withheld."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, quiet_s: float = _QUIET_S) -> None:
        self._clock, self._quiet_s = clock, quiet_s
        self._next_s: dict[str, float] = {}
        self._withheld: dict[str, int] = {}

    def admit(self, kind: str) -> int | None:
        """Number of lines of this kind withheld since the last one, or None if this one must be withheld too."""
        now_s = self._clock()
        if now_s < self._next_s.get(kind, float("-inf")):
            self._withheld[kind] = self._withheld.get(kind, 0) + 1
            return None
        self._next_s[kind] = now_s + self._quiet_s
        return self._withheld.pop(kind, 0)

    def say(self, kind: str, write: Callable[..., object], text: str, /, **details: object) -> None:
        """Write a line unless it must be withheld, with the number of lines of its kind withheld before it."""
        if (withheld := self.admit(kind)) is not None:
            write(text, **details, **({"withheld": withheld} if withheld else {}))
