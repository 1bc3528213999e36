"""Runs an archive of recordings through the monitor, each machine as a task on the computers of a Ray cluster."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from models.errors import RotorwatchError
from rotorwatch.records.replays import OfflineSummary
from service.recordings.replay.offline import OfflineReplay, choose_machine
from service.recordings.replay.source import RecordingSource


@dataclass(frozen=True, slots=True)
class MachineTask:
    """Recordings of one machine to be evaluated; files are at the same place on every computer."""

    title: str  # site/machine
    files: tuple[Path, ...]
    machine: str | None  # as `choose_machine` takes it
    changes: str
    from_ns: int
    to_ns: int


def evaluated(task: MachineTask) -> tuple[OfflineSummary, str]:
    """Summary and result lines of a machine."""
    source = RecordingSource(task.files)
    keys = source.machine(task.title)
    lines: list[str] = []
    installed = choose_machine(keys, task.machine, task.changes)
    run = OfflineReplay(source, keys, installed, lines.append, from_ns=task.from_ns, to_ns=task.to_ns)
    return run.run(), "".join(line + "\n" for line in lines)


def on_cluster(address: str, tasks: Sequence[MachineTask]) -> Iterator[tuple[OfflineSummary, str]]:
    """Yield what `evaluated` returns for every task, each as soon as it is there.

    Raises
    ------
    RotorwatchError
        If there is no cluster; or naming the machine that cannot be evaluated, and why.
    """
    # Not at the top: every worker imports this module, and this import takes as long as all that a worker needs.
    from service.runtime.fleet import imported_ray, join_cluster  # noqa: PLC0415

    ray = imported_ray()
    with ExitStack() as undo:
        join_cluster(address, undo)
        task_of = {ray.remote(evaluated).remote(task): task for task in tasks}
        waiting = list(task_of)
        while waiting:
            ready, waiting = ray.wait(waiting)
            for one in ready:
                try:
                    yield ray.get(one)
                except ray.exceptions.RayTaskError as error:
                    why = error.cause if isinstance(error.cause, RotorwatchError) else error
                    raise RotorwatchError(f"{task_of[one].title}: {why}") from error
                except ray.exceptions.RayError as error:
                    raise RotorwatchError(f"{task_of[one].title}: {error}") from error
