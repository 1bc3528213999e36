"""Makes the checkout importable before `tests/service`, whose name would otherwise hide the package `service`.

And keeps what programs leave behind by default out of the home of whoever runs the tests.
"""

import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
import structlog

ROOT = Path(__file__).parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))


# A run that a shell has put into the background ignores Ctrl-C, and so would all programs that tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)
# How long an example takes says what else the computer does, and nothing of the code.
hypothesis.settings.register_profile(
    "any computer", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("any computer")
# As the programs show it: the library's own way prints every local variable, arrays included, which takes seconds.
structlog.configure(
    processors=[
        structlog.processors.add_log_level,
        structlog.dev.ConsoleRenderer(colors=False, exception_formatter=structlog.dev.plain_traceback),
    ]
)


@pytest.fixture(autouse=True, scope="session")
def _state_folder() -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="rotorwatch-state-") as folder:
        os.environ["XDG_STATE_HOME"] = folder
        yield
        del os.environ["XDG_STATE_HOME"]


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Let go of what a module of tests has simulated and remembered, when it is done."""
    if not isinstance(item, pytest.Function) or (
        isinstance(nextitem, pytest.Function) and nextitem.module is item.module
    ):
        return
    for value in vars(item.module).values():
        if hasattr(value, "cache_clear") and value.__module__ == item.module.__name__:
            value.cache_clear()
