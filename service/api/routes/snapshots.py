"""Snapshots of the latest or a recorded window over HTTP, and values of plots of samples, history or recordings.

Snapshots are correlations and spectra with theory, and orbits. They are cached, because many pages show the same
machine.
"""

import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeVar

from fastapi import FastAPI, HTTPException, Query, Request
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel

from models.errors import RotorwatchError
from rotorwatch.records.plots import (
    CentrelineSeries,
    FullSpectrumSnapshot,
    VectorSeries,
    WaterfallSnapshot,
    WaveformSnapshot,
)
from rotorwatch.records.snapshots import CorrelationSnapshot, OrbitSnapshot, SpectrumSnapshot, Units
from service.access.guard import Guard
from service.access.problems import problem_answer, responses, written
from service.analysis.past import Past
from service.analysis.recorded import Sampled
from service.analysis.snapshots import plots
from service.analysis.snapshots.channels import SnapshotError, chosen_channels
from service.analysis.snapshots.machine import LatestData
from service.analysis.snapshots.orbit import orbit_snapshot
from service.analysis.snapshots.window import correlation_snapshot, spectrum_snapshot
from service.api.samples import Chosen, ChosenSamples, ChosenWindow, Recordings, SampleReader
from service.api.views import PLACE, InPath, SinceNs, UntilNs
from service.stream.monitored import Monitored

_MOST = 64
_MOST_REVOLUTIONS = 64
_SAMPLES_HOLD_S = 1.0
_MOST_REPORTS = 400
_SOON_S = 120.0
"""Data read before a chosen end time, s: enough for the newest revolutions and seconds."""
_NO_ANGLE = "the shaft angle is not measured (keyphasor), and without it vibration has no phase"
_NONE: list[str] = []

_First = Annotated[list[str], Query(max_length=64, description="channel i of a pair, by name; may be repeated")]
_Second = Annotated[
    list[str],
    Query(max_length=64, description="channel j of each pair, as many as `first`; each with itself if left out"),
]
_Channels = Annotated[list[str], Query(alias="channel", max_length=64, description="name; may be repeated")]
_Units = Annotated[Units, Query(description="units of the values, the channels' own or SI")]
_Revolutions = Annotated[
    int, Query(ge=0, le=_MOST_REVOLUTIONS, description="newest revolutions to show sample by sample as well")
]
_Shown = Annotated[
    list[str], Query(alias="channel", max_length=64, description="name; may be repeated; all displacements if left out")
]
_Order = Annotated[int, Query(ge=1, le=3, description="multiple of running speed; the history has phases of 1 and 2")]
_EachRevolutions = Annotated[
    int,
    Query(ge=1, le=1000, description="revolutions per vector of a recording; the history has one vector per window"),
]
_SlowRoll = Annotated[
    float | None,
    Query(gt=0, le=1e6, description="rpm up to which the mean vector of a recording is subtracted as run-out"),
]
_Values = TypeVar("_Values", WaveformSnapshot, FullSpectrumSnapshot, WaterfallSnapshot, VectorSeries, CentrelineSeries)


@dataclass(slots=True)
class _Kept:
    lock: threading.Lock = field(default_factory=threading.Lock)
    body: bytes | None = None
    mark: object = None  # `LatestData.mark` of the data that it was made from
    newest_ns: int | None = None  # start of their newest block
    made_s: float = 0.0


class WindowAnswers:
    """Cache of answers that are valid until another window is evaluated; thread-safe."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._kept: dict[Hashable, _Kept] = {}  # least recently requested first

    def of(
        self, question: Hashable, data: LatestData, make: Callable[[], BaseModel], *, of_samples: bool = False
    ) -> Response:
        """Return the cached answer if it is still valid, else make it.

        An answer `of_samples` contains the newest samples; it is valid for one second only, and not across a gap.
        """
        with self._lock:
            kept = self._kept[question] = self._kept.pop(question) if question in self._kept else _Kept()
            while len(self._kept) > _MOST:
                del self._kept[next(iter(self._kept))]
        with kept.lock:
            now_s, mark = self._clock(), data.mark()
            late = of_samples and (
                now_s - kept.made_s > _SAMPLES_HOLD_S
                or kept.newest_ns is None
                or not data.blocks
                or data.blocks[0].start_ns > kept.newest_ns
            )
            if kept.body is None or kept.mark != mark or late:
                kept.body = make().model_dump_json().encode()
                kept.mark, kept.made_s = mark, now_s
                kept.newest_ns = data.blocks[-1].start_ns if data.blocks else None
            return Response(kept.body, media_type="application/json")


def add_snapshot_routes(app: FastAPI, reader: SampleReader, guard: Guard) -> None:
    """Add the routes."""

    @app.exception_handler(SnapshotError)
    async def refused(request: Request, error: Exception) -> JSONResponse:
        return problem_answer(request, 422, str(error))

    common: dict[str, Any] = {"tags": ["snapshots"], "dependencies": [guard.read]}
    answers = WindowAnswers()

    @app.get(f"{PLACE}/correlations", **written(CorrelationSnapshot, 404, 422), **common)
    def correlations(
        view: InPath, chosen: ChosenWindow, first: _First = _NONE, second: _Second = _NONE, units: _Units = "channel"
    ) -> Response:
        """Correlation functions of the latest or a recorded window, with theory; a few pairs by default."""
        shown, data = reader.window(view, chosen)
        asked = ("correlations", view, chosen, tuple(first), tuple(second), units)
        return answers.of(asked, data, lambda: correlation_snapshot(shown, data, first, second, units))

    @app.get(f"{PLACE}/spectra", **written(SpectrumSnapshot, 404, 422), **common)
    def spectra(
        view: InPath,
        chosen: ChosenWindow,
        channel: _Channels = _NONE,
        first: _First = _NONE,
        second: _Second = _NONE,
        from_hz: Annotated[float | None, Query(ge=0, le=1e6, description="only frequencies from here on")] = None,
        to_hz: Annotated[float | None, Query(ge=0, le=1e6, description="only frequencies up to here")] = None,
        units: _Units = "channel",
    ) -> Response:
        """Power spectral densities and cross-spectra of the latest or a recorded window, with theory."""
        band = None if from_hz is None and to_hz is None else (from_hz or 0.0, 1e6 if to_hz is None else to_hz)
        if band is not None and not band[0] < band[1]:
            raise HTTPException(422, f"to_hz: {band[1]:g} is not above from_hz {band[0]:g}")
        shown, data = reader.window(view, chosen)
        asked = ("spectra", view, chosen, tuple(channel), tuple(first), tuple(second), band, units)
        return answers.of(asked, data, lambda: spectrum_snapshot(shown, data, channel, first, second, band, units))

    @app.get(f"{PLACE}/orbits", **written(OrbitSnapshot, 404, 422), **common)
    def orbits(
        view: InPath, chosen: ChosenWindow, revolutions: _Revolutions = 0, units: _Units = "channel"
    ) -> Response:
        """Orbits at running speed of the latest or a recorded window, and revolutions as measured."""
        shown, data = reader.window(view, chosen)
        asked = ("orbits", view, chosen, revolutions, units)
        return answers.of(
            asked, data, lambda: orbit_snapshot(shown, data, revolutions, units), of_samples=revolutions > 0
        )


def _made(
    reader: SampleReader,
    view: Monitored,
    chosen: Chosen,
    kind: type[_Values],
    make: Callable[[Any], _Values],
    reach_s: float | None = None,
    *,
    of_history: bool = False,
    **asked: Any,
) -> _Values:
    """Make a plot's values from samples or the history; if that is impossible, return the reason with `asked`.

    Without recordings, the values are those of the newest samples or, `of_history`, of the history, thinned out.
    """
    source = "recordings" if chosen.recorded else "history" if of_history else "newest samples"
    try:
        if of_history and not chosen.recorded:
            between = chosen.since_ns, chosen.until_ns
            return make(Past.of(view.machine, view.history.report_log, *between, _MOST_REPORTS))
        with reader.samples(view, chosen, reach_s) as data:
            values = make(data)
        reason = "" if chosen.recorded else view.latest.why_lost
        return values.model_copy(update={"reason": "; ".join(filter(None, (values.reason, reason)))})
    except SnapshotError:
        raise
    except RotorwatchError as error:
        site, machine = view.machine.site, view.machine.name
        return kind(site=site, machine=machine, source=source, reason=str(error), **asked)


def add_plot_routes(app: FastAPI, reader: SampleReader, guard: Guard) -> None:
    """Add the routes."""
    common: dict[str, Any] = {"tags": ["snapshots"], "dependencies": [guard.read]}

    @app.get(f"{PLACE}/waveforms", responses=responses(WaveformSnapshot, 404, 422), **common)
    def waveforms(
        view: InPath,
        chosen: ChosenWindow,
        channel: _Shown = _NONE,
        revolutions: Annotated[int, Query(ge=1, le=_MOST_REVOLUTIONS, description="newest revolutions to show")] = 8,
    ) -> WaveformSnapshot:
        """The newest revolutions of channels, sample by sample, with the phase reference's pulses."""
        names = [one.name for one in chosen_channels(view.machine, channel)]
        window = view.latest.window
        speed = None if window is None or chosen.recorded else window.speed_rad_s

        def made(found: Sampled) -> WaveformSnapshot:
            return plots.waveform_snapshot(found, found.channels(names), revolutions, speed)

        return _made(reader, view, chosen, WaveformSnapshot, made, _SOON_S)

    @app.get(f"{PLACE}/full-spectra", responses=responses(FullSpectrumSnapshot, 404, 422), **common)
    def full_spectra(view: InPath, chosen: ChosenWindow) -> FullSpectrumSnapshot:
        """Full spectra of the newest seconds: forward and reverse precession at each place with two displacements."""
        return _made(reader, view, chosen, FullSpectrumSnapshot, plots.full_spectrum_snapshot, _SOON_S)

    @app.get(f"{PLACE}/waterfalls", responses=responses(WaterfallSnapshot, 404, 422), **common)
    def waterfalls(
        view: InPath,
        chosen: ChosenSamples,
        channel: Annotated[
            str | None, Query(max_length=64, description="name of the channel; the first vibration channel if left out")
        ] = None,
        over: Annotated[Literal["time", "speed"], Query(description="rows by time or by speed")] = "time",
    ) -> WaterfallSnapshot:
        """Spectra of one channel, one after the other, over time or speed."""
        shown = chosen_channels(view.machine, [] if channel is None else [channel])

        def made(found: Sampled) -> WaterfallSnapshot:
            if not shown:
                raise RotorwatchError("no channel measures a vibration")
            return plots.waterfall_snapshot(found, found.channels([shown[0].name])[0], over)

        return _made(reader, view, chosen, WaterfallSnapshot, made, over=over)

    @app.get(f"{PLACE}/vectors", responses=responses(VectorSeries, 404, 422), **common)
    def vectors(
        view: InPath,
        channel: _Shown = _NONE,
        order: _Order = 1,
        since_ns: SinceNs = None,
        until_ns: UntilNs = None,
        revolutions: _EachRevolutions = 8,
        slow_roll_rpm: _SlowRoll = None,
        recording: Recordings = _NONE,
    ) -> VectorSeries:
        """Amplitude and phase at an order over time and speed (Bode, polar), from the history or recordings."""
        names = [one.name for one in chosen_channels(view.machine, channel)]

        def made(found: Sampled | Past) -> VectorSeries:
            if not found.has_angle:
                raise RotorwatchError(_NO_ANGLE)
            return plots.vector_series(found, found.channels(names), order, revolutions, slow_roll_rpm)

        if slow_roll_rpm is not None and not recording:
            raise HTTPException(422, "slow_roll_rpm: needs samples, so name a recording")
        chosen = Chosen(tuple(recording), None, since_ns, until_ns)
        return _made(reader, view, chosen, VectorSeries, made, of_history=True, order=order)

    @app.get(f"{PLACE}/centrelines", responses=responses(CentrelineSeries, 404, 422), **common)
    def centrelines(
        view: InPath, since_ns: SinceNs = None, until_ns: UntilNs = None, recording: Recordings = _NONE
    ) -> CentrelineSeries:
        """Average position of the shaft over time and speed, from the history or recordings."""
        chosen = Chosen(tuple(recording), None, since_ns, until_ns)
        return _made(reader, view, chosen, CentrelineSeries, plots.centreline_series, of_history=True)
