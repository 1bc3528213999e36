"""Values of plots over HTTP: of the newest samples, the history, or recordings."""

from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar

from fastapi import FastAPI, HTTPException, Query

from models.errors import RotorwatchError
from rotorwatch.records.plots import (
    CentrelineSeries,
    FullSpectrumSnapshot,
    VectorSeries,
    WaterfallSnapshot,
    WaveformSnapshot,
)
from service.access.guard import Guard
from service.access.problems import responses
from service.analysis.past import Past
from service.analysis.recorded import Sampled
from service.analysis.snapshots.channels import SnapshotError, chosen_channels
from service.analysis.snapshots.orbit import MOST_REVOLUTIONS
from service.analysis.snapshots.plots import (
    centreline_series,
    full_spectrum_snapshot,
    vector_series,
    waterfall_snapshot,
    waveform_snapshot,
)
from service.api.samples import Chosen, ChosenSamples, ChosenWindow, Recordings, SampleReader
from service.api.views import PLACE, InPath, SinceNs, UntilNs
from service.stream.monitored import Monitored

_MOST_REPORTS = 400
_SOON_S = 120.0
"""Data read before a chosen end time, s: enough for the newest revolutions and seconds."""
_NO_ANGLE = "the shaft angle is not measured (keyphasor), and without it vibration has no phase"

_NONE: list[str] = []

_Channels = Annotated[
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
            return make(data)
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
        channel: _Channels = _NONE,
        revolutions: Annotated[int, Query(ge=1, le=MOST_REVOLUTIONS, description="newest revolutions to show")] = 8,
    ) -> WaveformSnapshot:
        """The newest revolutions of channels, sample by sample, with the phase reference's pulses."""
        names = [one.name for one in chosen_channels(view.machine, channel)]
        window = view.latest.window
        speed = None if window is None or chosen.recorded else window.speed_rad_s

        def made(found: Sampled) -> WaveformSnapshot:
            return waveform_snapshot(found, found.channels(names), revolutions, speed)

        return _made(reader, view, chosen, WaveformSnapshot, made, _SOON_S)

    @app.get(f"{PLACE}/full-spectra", responses=responses(FullSpectrumSnapshot, 404, 422), **common)
    def full_spectra(view: InPath, chosen: ChosenWindow) -> FullSpectrumSnapshot:
        """Full spectra of the newest seconds: forward and reverse precession at each place with two displacements."""
        return _made(reader, view, chosen, FullSpectrumSnapshot, full_spectrum_snapshot, _SOON_S)

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
            return waterfall_snapshot(found, found.channels([shown[0].name])[0], over)

        return _made(reader, view, chosen, WaterfallSnapshot, made, over=over)

    @app.get(f"{PLACE}/vectors", responses=responses(VectorSeries, 404, 422), **common)
    def vectors(
        view: InPath,
        channel: _Channels = _NONE,
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
            return vector_series(found, found.channels(names), order, revolutions, slow_roll_rpm)

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
        return _made(reader, view, chosen, CentrelineSeries, centreline_series, of_history=True)
