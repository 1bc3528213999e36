"""Signals stop the programs at any moment, also in the middle of a wait or while they load."""

import os
import signal
import subprocess
import sys

import pytest

from service.terminal.stopping import stop_request

# Every line that the main thread runs during the wait, inside the standard library too, is interrupted by the signal.
_SCRIPT = """
import signal, sys
from {module} import {name}

def interrupt(frame, event, argument):
    signal.raise_signal(signal.SIGTERM)
    return interrupt

with {name}() as stop:
    sys.settrace(interrupt)
    stop.wait(0.0)
    sys.settrace(None)
    print(stop.wait(60.0))
"""


@pytest.mark.parametrize(
    ("module", "name"), [("service.terminal.stopping", "stop_request"), ("simulator.rotorsim", "_stop_on_signal")]
)
def test_a_signal_in_the_middle_of_a_wait_stops(module: str, name: str) -> None:
    script = _SCRIPT.format(module=module, name=name)
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60.0, check=True)
    assert run.stdout == "True\n"


@pytest.mark.parametrize(("ignored", "stopped"), [(False, True), (True, False)], ids=["terminal", "nohup"])
def test_closing_the_terminal_requests_a_stop_unless_it_is_ignored(ignored: bool, stopped: bool) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
    try:
        with stop_request() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert stop.wait(1.0) is stopped
    finally:
        signal.signal(signal.SIGHUP, before)


_LOADING = """
import signal, sys
from service.__main__ import main

def interrupt(frame, event, argument):
    if frame.f_code.co_filename.endswith("service/commands/rotorwatch.py"):
        signal.raise_signal(signal.SIGINT)

sys.settrace(interrupt)
main()
"""


def test_an_interrupt_while_the_program_loads_ends_it_quietly() -> None:
    run = subprocess.run([sys.executable, "-c", _LOADING], capture_output=True, text=True, timeout=60.0, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (130, "", "")
