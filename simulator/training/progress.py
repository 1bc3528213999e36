"""Progress bars of training, commissioning and the studies, on stderr: stdout is for results."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

__all__ = ["bars", "labelled_bars"]


def bars(*, remaining: bool = False) -> Progress:
    """Bars that are not started yet, with the time taken and, if wanted, the time that remains."""
    columns: list[ProgressColumn] = [
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    ]
    if remaining:
        columns.append(TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True))


@contextmanager
def labelled_bars(*, remaining: bool = False) -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar for every label that progress is told of.

    Parameters
    ----------
    remaining : bool
        Also show the time that remains.

    Yields
    ------
    callable
        Takes what is being done, how much of it is done, and how much there is.
    """
    with bars(remaining=remaining) as shown:
        tasks: dict[str, TaskID] = {}

        def progress(label: str, done: int, total: int) -> None:
            if label not in tasks:
                tasks[label] = shown.add_task(label, total=total)
            shown.update(tasks[label], completed=done)

        yield progress
