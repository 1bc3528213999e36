"""Work for the worker processes of a campaign."""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

__all__ = ["done_in"]

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")


def done_in(
    pool: ProcessPoolExecutor,
    function: Callable[[_Task], _Result],
    tasks: Sequence[_Task],
    progress: Callable[[int, int], None],
    chunk: int,
) -> list[_Result]:
    """Results of all tasks, in their order.

    Parameters
    ----------
    pool : ProcessPoolExecutor
    function : callable
        At the top level of a module, or a `functools.partial` of such a one: it is sent to the processes.
    tasks : sequence
    progress : callable
        Called after every task with how many are done, and how many there are.
    chunk : int
        Tasks sent to a process at a time.
    """
    results = []
    for result in pool.map(function, tasks, chunksize=chunk):
        results.append(result)
        progress(len(results), len(tasks))
    return results
