"""Makes the checkout importable before `tests/service`, whose name would otherwise hide the package `service`.

It also keeps the state that programs store by default out of the home of whoever runs the tests.
"""

import gc
import os
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

import execnet.gateway_io
import httpx
import hypothesis
import pytest
import structlog
import typer.testing
from _pytest.assertion import rewrite

ROOT = Path(__file__).parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))


# A run that a shell has put into the background ignores Ctrl-C, and so would all programs that tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)
# The time of an example depends on what else the computer does, not on the code.
hypothesis.settings.register_profile(
    "any computer", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("any computer")
# As in the programs: by default, the library prints every local variable, arrays included, which takes seconds.
structlog.configure(
    processors=[
        structlog.processors.add_log_level,
        structlog.dev.ConsoleRenderer(colors=False, exception_formatter=structlog.dev.plain_traceback),
    ]
)
# A client reads all the certificates this computer trusts, 20 ms of computing, even if it only uses HTTP.
httpx._transports.default.create_ssl_context = cache(httpx.create_ssl_context)  # type: ignore[attr-defined]
# A program's commands are put together once, as in a process of its own, and not for every command line.
typer.testing._get_command = cache(typer.testing._get_command)  # type: ignore[attr-defined]

_LONGEST = (
    "test_commissioned", "test_fleet", "test_left_open", "test_speed_changes", "test_levels",
    "test_monitor_missing", "test_browser", "test_commission_page", "test_overload", "test_likelihood", "test_monitor",
    "test_refused", "test_shards", "test_monitor_standstill", "test_window_again", "test_training",
    "test_lines_of_an_unknown_rotor", "test_monitor_dead", "test_checkpoint", "test_browser_replays", "test_baseline",
    "test_bundle", "test_openapi", "test_store_failing", "test_sequential", "test_sensor_checks",
    "test_baseline_coupling", "test_hosts", "test_tutorial", "test_commission_cli",
    "test_unbalance", "test_browser_plots", "test_hostile_messages", "test_lines", "test_following", "test_fallback",
    "test_plots_cli", "test_baseline_force", "test_installation_cli", "test_replay_cli",
    "test_import_properties", "test_conditions", "test_replay_network", "test_demo", "test_history_lost", "test_pins",
    "test_browser_administration", "test_packages", "test_paper", "test_scenarios", "test_recorded_windows",
    "test_page_types", "test_evidence", "test_survives",
)  # fmt: skip
"""Modules that take long for the number of their tests, longest first."""


def pytest_xdist_setupnodes(config: pytest.Config) -> None:
    """Fork workers, so that they start at once, and compile modules once instead of in each worker."""
    from tests.forked_workers import ForkedIO  # noqa: PLC0415  # nobody else needs it

    execnet.gateway_io.Popen2IOMaster = ForkedIO  # type: ignore[assignment, misc]
    if sys.dont_write_bytecode:
        return
    for asked in config.args:
        place = Path(config.invocation_params.dir, asked.partition("::")[0])
        for module in place.glob("**/test_*.py") if place.is_dir() else [place]:
            _compile(module, config)


def _compile(module: Path, config: pytest.Config) -> None:
    """Store a module's code, with its assertions rewritten, where an import looks for it.

    This uses private functions of pytest, whose version is pinned in constraints.txt.
    """
    kept_in = rewrite.get_cache_dir(module)
    kept = kept_in / f"{module.stem}{rewrite.PYC_TAIL}"
    if module.is_file() and rewrite._read_pyc(module, kept) is None and rewrite.try_makedirs(kept_in):
        with suppress(SyntaxError):  # reported when the module is imported
            stat, code = rewrite._rewrite_test(module, config)
            rewrite._write_pyc(config.stash[rewrite.assertstate_key], code, stat, kept)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the slowest modules first, so that none is left alone at the end, then those with many tests."""
    tests = Counter(item.path for item in items)
    ranks = {name: rank for rank, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: (ranks.get(item.path.stem, len(ranks)), -tests[item.path]))
    gc.freeze()  # what is imported by now stays to the end and need not be scanned again and again
    gc.set_threshold(10_000, 20, 20)  # nor later objects as often, which took 5 % of the computing


@pytest.fixture(autouse=True, scope="session")
def _state_folder() -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="rotorwatch-state-") as folder:
        os.environ["XDG_STATE_HOME"] = folder
        yield
        del os.environ["XDG_STATE_HOME"]


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Clear the caches of a test module when it is done."""
    if not isinstance(item, pytest.Function) or (
        isinstance(nextitem, pytest.Function) and nextitem.module is item.module
    ):
        return
    for value in vars(item.module).values():
        if hasattr(value, "cache_clear") and value.__module__ == item.module.__name__:
            value.cache_clear()
