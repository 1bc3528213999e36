"""Selects the samples of an answer: those a monitor holds now, those of recordings, or those of a replay."""

import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated

from fastapi import Depends, HTTPException, Query

from models.errors import RotorwatchError
from models.mistakes import form
from service.analysis.recorded import Held, Recorded, Sampled
from service.analysis.recorded_window import recorded_window
from service.analysis.snapshots.machine import LatestData, MachineSnapshots
from service.api.routes.recordings import found_recording
from service.api.routes.replays import installed_for, replayed_report
from service.api.views import ServiceView, time_query
from service.monitor.evaluators import evaluator_for
from service.monitor.reports import identity_of
from service.recordings.replay.jobs import RunningJob
from service.recordings.replay.source import RecordingSource
from service.stream.monitored import Monitored

_MOST_BYTES = 600_000_000
_PATIENCE_S = 10.0
_WINDOWS = 4
_SOURCES = 4
_ONE_AT_A_TIME = threading.Lock()
_NONE: list[str] = []
_Files = tuple[tuple[Path, int], ...]

_NAME = form(r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,199}\.mcap$", "a file name that ends in .mcap")
Recordings = Annotated[
    list[Annotated[str, Query(pattern=_NAME)]],
    Query(
        alias="recording",
        max_length=12,
        description="file name of a recording of this machine to read; may be repeated",
    ),
]
_Replay = Annotated[
    str | None,
    Query(
        pattern=form("^[0-9a-f]{12}$", "the id of a replay, such as 4dedec2483d3"),
        description="id of a replay of this machine, whose recordings, machine file and readings are used",
    ),
]
_From = Annotated[int | None, time_query("only recorded samples from this time on")]
_To = Annotated[int | None, time_query("only recorded samples before this time")]
_End = Annotated[int | None, time_query("end of the recorded samples to use")]


@dataclass(frozen=True, slots=True)
class Chosen:
    """Selection of samples; live ones if neither recordings nor a replay are given."""

    recordings: tuple[str, ...] = ()
    replay: str | None = None
    since_ns: int | None = None
    until_ns: int | None = None

    @property
    def recorded(self) -> bool:
        """Whether recorded rather than live samples are selected."""
        return bool(self.recordings) or self.replay is not None


def _chosen_window(recording: Recordings = _NONE, replay: _Replay = None, until_ns: _End = None) -> Chosen:
    """Query arguments that select a window. Raises HTTPException 422 if they contradict each other."""
    return _chosen_samples(recording, replay, None, until_ns)


def _chosen_samples(
    recording: Recordings = _NONE, replay: _Replay = None, since_ns: _From = None, until_ns: _To = None
) -> Chosen:
    if recording and replay is not None:
        raise HTTPException(422, "replay: is given beside recording, expected one of them")
    found = Chosen(tuple(dict.fromkeys(recording)), replay, since_ns, until_ns)
    for name, value in (("since_ns", since_ns), ("until_ns", until_ns)):
        if value is not None and not found.recorded:
            raise HTTPException(422, f"{name}: needs recorded samples, so name a recording or a replay")
    return found


ChosenWindow = Annotated[Chosen, Depends(_chosen_window)]
ChosenSamples = Annotated[Chosen, Depends(_chosen_samples)]


class SampleReader:
    """Reads recorded samples for one caller at a time; thread-safe."""

    def __init__(self, service: ServiceView) -> None:
        self._service = service
        self._windows: OrderedDict[object, tuple[MachineSnapshots, LatestData]] = OrderedDict()

    @contextmanager
    def samples(self, view: Monitored, chosen: Chosen, reach_s: float | None = None) -> Iterator[Sampled]:
        """The selected samples; without `Chosen.since_ns`, those of the last `reach_s` before `Chosen.until_ns`.

        Raises
        ------
        RotorwatchError
            If there are no samples.
        HTTPException
            If there is no such recording or replay, or too much data would be read.
        """
        if not chosen.recorded:
            if not view.latest.blocks:
                raise RotorwatchError("no samples have come in")
            yield Held(view.machine, view.latest.blocks)
            return
        found = self._files(view, chosen)
        since_ns, until_ns = chosen.since_ns, chosen.until_ns
        if since_ns is None and until_ns is not None and reach_s is not None:
            since_ns = max(0, until_ns - round(reach_s * 1e9))
        with _taking_turns():
            source = _source(found)
            _check_size(source, since_ns, until_ns)
            keys = source.machine(view.machine.title)
            from_, to = (None if time_ns is None else f"{time_ns}ns" for time_ns in (since_ns, until_ns))
            yield Recorded(source, keys, *source.between(from_, to, keys))

    def window(self, view: Monitored, chosen: Chosen) -> tuple[MachineSnapshots, LatestData]:
        """The selected window, and the object that makes its snapshots; the last few recorded windows are cached.

        Raises HTTPException as `samples` does.
        """
        if not chosen.recorded:
            return view.snapshots, view.latest
        replay = None if chosen.replay is None else self._replay(view, chosen.replay)
        asked = (view.machine.title, chosen, None if replay is None else replay.view.state)
        found = self._files(view, chosen)
        with _taking_turns():
            kept = self._windows.pop(asked, None) or self._read(view, chosen, replay, found)
            self._windows[asked] = kept
            while len(self._windows) > _WINDOWS:
                self._windows.popitem(last=False)
            return kept

    def _read(
        self, view: Monitored, chosen: Chosen, replay: RunningJob | None, found: _Files
    ) -> tuple[MachineSnapshots, LatestData]:
        installed, report, until_ns = view.snapshots.installed, None, chosen.until_ns
        if replay is not None and replay.view.mode == "offline":
            installed = installed_for(replay)
            report = None if until_ns is None else replayed_report(replay, until_ns)
        try:
            source = _source(found)
            if until_ns is not None:
                _check_size(source, until_ns - round(installed.machine.window.length_s * 1e9), until_ns)
            lagged = evaluator_for(installed).needs_lags
            data = recorded_window(source, installed.machine, view.machine.title, until_ns, report, lagged=lagged)
        except RotorwatchError as error:
            data = LatestData(lacking=str(error))
        return MachineSnapshots(installed, identity_of(installed)), data

    def _files(self, view: Monitored, chosen: Chosen) -> _Files:
        ids = [f"{view.machine.title}/{name}" for name in chosen.recordings]
        if chosen.replay is not None:
            ids = list(self._replay(view, chosen.replay).view.recordings)
        found = [found_recording(self._service.catalogue, one) for one in dict.fromkeys(ids)]
        return tuple((one.path, one.size_bytes) for one in found)

    def _replay(self, view: Monitored, replay_id: str) -> RunningJob:
        found = self._service.replays.found(replay_id)
        machine = found.view.recordings[0].rpartition("/")[0]
        if machine != view.machine.title:
            raise HTTPException(422, f"replay: {replay_id} is of {machine}, expected one of {view.machine.title}")
        return found


@contextmanager
def _taking_turns() -> Iterator[None]:
    if not _ONE_AT_A_TIME.acquire(timeout=_PATIENCE_S):
        raise HTTPException(503, "recordings are being read for another caller; try again")
    try:
        yield
    finally:
        _ONE_AT_A_TIME.release()


@lru_cache(maxsize=_SOURCES)
def _source(files: _Files) -> RecordingSource:
    """Recordings with their indexes, which are read once; file sizes are part of the cache key, to detect changes."""
    return RecordingSource([path for path, _ in files])


def _check_size(source: RecordingSource, since_ns: int | None, until_ns: int | None) -> None:
    size = sum(path.stat().st_size for path in source.paths_between(since_ns, until_ns))
    if size > _MOST_BYTES:
        most = f"expected at most {_MOST_BYTES / 1e6:.0f} MB at once"
        raise HTTPException(422, f"recording: {size / 1e6:.0f} MB, {most}")
