"""Programs that start at once: forked off a process that has imported their modules, which takes seconds each time.

Each is a process of its own with its own arguments, environment and output, and runs the program from its first line.
"""

import gc
import multiprocessing
import os
import resource
import runpy
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO

from tests.service.rig.hosts import move_to
from tests.sure import sure

_ROOT = Path(__file__).parents[3]

PROGRAMS = [
    *("service.runtime.runtime", "service.commands.rotorwatch", "simulator.rotorsim", "simulator.publisher"),
    *("models.signals.recording", "service.recordings.replay.offline", "service.terminal.stopping"),
    *("service.history.migrations", "pydantic.v1", "uvicorn.loops.asyncio", "uvicorn.lifespan.off", __name__),
]
"""Modules that the programs import."""
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(PROGRAMS)


class Preloaded:
    """``python -m ARGUMENTS``, as `subprocess.Popen` would start it."""

    def __init__(
        self,
        arguments: tuple[str, ...],
        cwd: Path,
        out: Path,
        err: Path,
        environment: dict[str, str],
        network: str = "",
    ) -> None:
        self.args = arguments
        self._begin(arguments, cwd, (Path(os.devnull), out, err), environment, network)

    def _begin(self, *arguments: object) -> None:
        self._process = CONTEXT.Process(target=_run, args=arguments)
        self._process.start()

    @property
    def pid(self) -> int:
        return sure(self._process.pid)

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired(self.args, sure(timeout))
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class Piped(Preloaded):
    """The same in a session of its own, with pipes, as a service starts ``PYTHON -m ARGUMENTS`` for a replay."""

    def __init__(
        self, command: Sequence[str], *, stdin: int, stdout: int, stderr: IO[bytes], start_new_session: bool
    ) -> None:
        assert stdin == stdout == subprocess.PIPE
        assert start_new_session
        self.args = tuple(command[2:])
        orders, to_it = CONTEXT.Pipe(duplex=False)
        from_it, lines = CONTEXT.Pipe(duplex=False)
        self.stdin: IO[bytes] = os.fdopen(os.dup(to_it.fileno()), "wb")
        self.stdout: IO[bytes] = os.fdopen(os.dup(from_it.fileno()), "rb")
        self._begin(self.args, Path.cwd(), (orders, lines, Path(stderr.name)), dict(os.environ))
        for end in (orders, to_it, from_it, lines):
            end.close()


def ran(
    *arguments: str | Path,
    cwd: Path = _ROOT,
    environment: dict[str, str] | None = None,
    out: Path | None = None,
    largest_file: int | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run ``python -m ARGUMENTS`` to its end, in the environment of the tests or in one of its own.

    Its output may go to a device. Files that it writes have at most `largest_file` bytes.
    """
    words = tuple(map(str, arguments))
    with tempfile.TemporaryDirectory() as folder:
        told, err = Path(folder, "out"), Path(folder, "err")
        told.touch()
        err.touch()
        process = Preloaded(words, cwd, out or told, err, dict(os.environ) if environment is None else environment)
        try:
            if largest_file is not None:
                resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (largest_file, largest_file))
            code = process.wait(600)
        finally:
            process.kill()
        return subprocess.CompletedProcess(
            words, code, told.read_text(encoding="utf-8"), err.read_text(encoding="utf-8")
        )


def rotorwatch(*arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command to its end, in a minimal environment."""
    clean = {"PATH": "/usr/bin:/bin", "COLUMNS": "200", **environment}
    return ran("service", *arguments, environment=clean)


def _run(
    arguments: tuple[str, ...],
    cwd: Path,
    ends: tuple[Path | Connection, ...],
    environment: dict[str, str],
    network: str = "",
) -> None:
    gc.freeze()  # garbage collection would copy shared pages
    if network:
        move_to(network)
    for number, end in enumerate(ends):
        if isinstance(end, Connection):
            os.dup2(end.fileno(), number)
            end.close()
        else:
            opened = os.open(end, os.O_RDWR | os.O_APPEND)
            os.dup2(opened, number)
            os.close(opened)
    if isinstance(ends[0], Connection):
        os.setsid()
        sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115  # which `multiprocessing` has closed
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    module, *sys.argv[1:] = arguments
    sys.modules.pop(module, None)
    runpy.run_module(module, run_name="__main__", alter_sys=True)
