"""Test workers forked from a process that has already imported what they and their programs import.

The imports take five seconds of computing, otherwise spent by every worker and by every process that starts programs.
"""

import atexit
import gc
import os
import sys
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from types import ModuleType

from execnet.gateway_base import ExecModel, Popen2IO

from tests.service.rig.preloaded import CONTEXT, PROGRAMS

CONTEXT.set_forkserver_preload(
    [
        *(*PROGRAMS, "tests.service.rig.live", "tests.interchange.material", "tests.faults.measure"),
        *("models.commissioning.commission", "service.analysis.figures.spectrum", "simulator.commission.page"),
        *("service.interchange.importing", "scipy.io", "scipy.optimize", "scipy.stats", "pyarrow.parquet"),
        *("h5py", "nptdms", "playwright.sync_api", "psycopg", "pytest", "pyuff", "trustme", "yaml"),
        *("hypothesis.extra.numpy", "schemathesis.specs.openapi.checks", "pandas", "benchmarks.studies.__main__"),
    ]
)


class ForkedIO(Popen2IO):
    """A forked worker and the pipes to it, in place of a new Python."""

    def __init__(self, _: list[str], execmodel: ExecModel) -> None:
        requests, to_worker = CONTEXT.Pipe(duplex=False)
        from_worker, answers = CONTEXT.Pipe(duplex=False)
        self.popen = CONTEXT.Process(target=_work, args=(requests, answers))
        self.popen.start()
        super().__init__(
            os.fdopen(os.dup(to_worker.fileno()), "wb"), os.fdopen(os.dup(from_worker.fileno()), "rb"), execmodel
        )
        for end in (requests, to_worker, from_worker, answers):
            end.close()

    def wait(self) -> int | None:
        self.popen.join()
        return self.popen.exitcode

    def kill(self) -> None:
        self.popen.kill()


def _work(requests: Connection, answers: Connection) -> None:
    gc.freeze()  # looking through what is shared would copy it
    for number, end in enumerate((requests, answers)):
        os.dup2(end.fileno(), number)
        end.close()
    # The programs a worker starts come from the same process, and import nothing of the worker.
    forkserver._forkserver.ensure_running = lambda: None  # type: ignore[method-assign]
    sys.modules["__main__"] = ModuleType("__main__")
    with open(0, encoding="utf-8", closefd=False) as stdin:
        exec(eval(stdin.readline()), {})  # noqa: S102, S307  # what execnet has a new Python do
    atexit._run_exitfuncs()
