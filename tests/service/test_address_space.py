"""A limit on the address space (``ulimit -v``) that is too small is told as what it is."""

import subprocess
import sys

import pytest

from tests.service.live import ROOT, endpoint

LIMITED = ["sh", "-c", 'ulimit -v "$1"; shift; exec "$@"', "sh"]
MONITOR = ["-m", "service.rotorwatch", "run", "--http-port", "0", "--listen"]
PROGRAM = """
import threading
import typer
from service.commands.running import exit_codes

def main() -> None:
    with exit_codes():
        {}

typer.run(main)
"""
NO_MEMORY = "bytearray(2**34)"
NO_THREAD = "threading.stack_size(2**32); threading.Thread(target=print).start()"


def ended(limit_kb: int, *arguments: str) -> list[str]:
    """What a program says that has to end by itself."""
    command = [*LIMITED, str(limit_kb), sys.executable, *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=180, check=False)
    assert (done.returncode, done.stdout) == (1, ""), done
    return done.stderr.splitlines()


@pytest.mark.parametrize("limit_kb", [200_000, 400_000, 1_000_000])
def test_a_monitor_does_not_start_where_it_would_get_no_memory(limit_kb: int) -> None:
    (said,) = ended(limit_kb, *MONITOR, endpoint())
    assert "ulimit -v" in said
    assert f"{limit_kb * 1024 // 1_000_000} MB" in said
    assert "2000 MB" in said


@pytest.mark.parametrize("code", [NO_MEMORY, NO_THREAD])
def test_what_gets_no_memory_later_names_the_limit(code: str) -> None:
    (said,) = ended(2_500_000, "-c", PROGRAM.format(code))
    assert "ulimit -v" in said
    assert "2560 MB" in said
