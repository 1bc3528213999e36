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
from service.analysis.snapshots.run_up import centreline_series, vector_series
from service.analysis.snapshots.samples import full_spectrum_snapshot, waterfall_snapshot, waveform_snapshot
from service.api.samples import Chosen, ChosenSamples, ChosenWindow, Recordings, SampleReader
from service.api.views import PLACE, MachineName, ServiceView, SinceNs, SiteName, UntilNs, found_machine
from service.stream.monitored import Monitored

_MOST_REPORTS = 400
_SOON_S = 120.0
"""Before the end of a time that was chosen: the newest revolutions and seconds are in it."""
_NO_ANGLE = "the shaft angle is not measured (keyphasor), and without it vibration has no phase"

_NONE: list[str] = []

_Channels = Annotated[
    list[str], Query(alias="channel", max_length=64, description="by name; may be repeated; all displacements without")
]
_Order = Annotated[int, Query(ge=1, le=3, description="multiple of running speed; the history has phases of 1 and 2")]
_EachRevolutions = Annotated[
    int,
    Query(ge=1, le=1000, description="that each vector of a recording is of; windows of the history are as they are"),
]
_SlowRoll = Annotated[
    float | None,
    Query(gt=0, le=1e6, description="rpm up to which the mean vector of a recording is taken away, as run-out"),
]
_Values = TypeVar("_Values", WaveformSnapshot, FullSpectrumSnapshot, WaterfallSnapshot, VectorSeries, CentrelineSeries)


class _Data:
    """What values are made of: the newest samples, recordings, or the history of a machine."""

    def __init__(self, reader: SampleReader) -> None:
        self._reader = reader

    def of_samples(
        self,
        view: Monitored,
        chosen: Chosen,
        make: Callable[[Sampled], _Values],
        without: Callable[[str], _Values],
        reach_s: float | None = None,
    ) -> _Values:
        """What is made of samples; where there is nothing to make it of, why."""
        try:
            with self._reader.samples(view, chosen, reach_s) as data:
                return make(data)
        except SnapshotError:
            raise
        except RotorwatchError as error:
            return without(str(error))

    def of_past(  # what may be asked for
        self,
        view: Monitored,
        names: list[str],
        between: tuple[int | None, int | None],
        make: Callable[[Sampled | Past], _Values],
        without: Callable[[str], _Values],
    ) -> _Values:
        """What is made of recordings, or without names of the history, every so many windows of a long time."""
        if names:
            return self.of_samples(view, Chosen(tuple(names), None, *between), make, without)
        try:
            return make(Past.of(view.machine, view.history.report_log, *between, _MOST_REPORTS))
        except RotorwatchError as error:
            return without(str(error))


def add_plot_routes(app: FastAPI, service: ServiceView, reader: SampleReader, guard: Guard) -> None:
    """Add the routes."""
    data = _Data(reader)
    common: dict[str, Any] = {"tags": ["snapshots"], "dependencies": [guard.read]}
    _add_sample_routes(app, service, data, common)
    _add_speed_routes(app, service, data, common)


def _add_sample_routes(app: FastAPI, service: ServiceView, data: _Data, common: dict[str, Any]) -> None:
    @app.get(f"{PLACE}/waveforms", responses=responses(WaveformSnapshot, 404, 422), **common)
    def waveforms(
        site: SiteName,
        machine: MachineName,
        chosen: ChosenWindow,
        channel: _Channels = _NONE,
        revolutions: Annotated[int, Query(ge=1, le=MOST_REVOLUTIONS, description="newest revolutions to show")] = 8,
    ) -> WaveformSnapshot:
        """The newest revolutions of channels, sample by sample, with the phase reference's pulses."""
        view = found_machine(service, site, machine)
        names = [one.name for one in chosen_channels(view.machine, channel)]
        window = view.latest.window
        speed = None if window is None or chosen.recorded else window.speed_rad_s
        return data.of_samples(
            view,
            chosen,
            lambda found: waveform_snapshot(found, found.channels(names), revolutions, speed),
            lambda why: WaveformSnapshot(site=site, machine=machine, source=_source(chosen), reason=why),
            _SOON_S,
        )

    @app.get(f"{PLACE}/full-spectra", responses=responses(FullSpectrumSnapshot, 404, 422), **common)
    def full_spectra(site: SiteName, machine: MachineName, chosen: ChosenWindow) -> FullSpectrumSnapshot:
        """Full spectra of the newest seconds: forward precession and reverse, at each place with two displacements."""
        view = found_machine(service, site, machine)
        return data.of_samples(
            view,
            chosen,
            full_spectrum_snapshot,
            lambda why: FullSpectrumSnapshot(site=site, machine=machine, source=_source(chosen), reason=why),
            _SOON_S,
        )

    @app.get(f"{PLACE}/waterfalls", responses=responses(WaterfallSnapshot, 404, 422), **common)
    def waterfalls(
        site: SiteName,
        machine: MachineName,
        chosen: ChosenSamples,
        channel: Annotated[
            str | None, Query(max_length=64, description="by name; the first that vibrates without")
        ] = None,
        over: Annotated[Literal["time", "speed"], Query(description="what the rows go over")] = "time",
    ) -> WaterfallSnapshot:
        """Spectra of one channel, one after the other, over time or speed."""
        view = found_machine(service, site, machine)
        shown = chosen_channels(view.machine, [] if channel is None else [channel])

        def made(found: Sampled) -> WaterfallSnapshot:
            if not shown:
                raise RotorwatchError("no channel measures a vibration")
            return waterfall_snapshot(found, found.channels([shown[0].name])[0], over)

        return data.of_samples(
            view,
            chosen,
            made,
            lambda why: WaterfallSnapshot(site=site, machine=machine, source=_source(chosen), over=over, reason=why),
        )


def _add_speed_routes(app: FastAPI, service: ServiceView, data: _Data, common: dict[str, Any]) -> None:
    @app.get(f"{PLACE}/vectors", responses=responses(VectorSeries, 404, 422), **common)
    def vectors(
        site: SiteName,
        machine: MachineName,
        channel: _Channels = _NONE,
        order: _Order = 1,
        since_ns: SinceNs = None,
        until_ns: UntilNs = None,
        revolutions: _EachRevolutions = 8,
        slow_roll_rpm: _SlowRoll = None,
        recording: Recordings = _NONE,
    ) -> VectorSeries:
        """Amplitude and phase at an order over time and speed (Bode, polar), from the history or recordings."""
        view = found_machine(service, site, machine)
        names = [one.name for one in chosen_channels(view.machine, channel)]

        def made(found: Sampled | Past) -> VectorSeries:
            if not found.has_angle:
                raise RotorwatchError(_NO_ANGLE)
            return vector_series(found, found.channels(names), order, revolutions, slow_roll_rpm)

        def without(why: str) -> VectorSeries:
            return VectorSeries(site=site, machine=machine, source=_past(recording), order=order, reason=why)

        if slow_roll_rpm is not None and not recording:
            raise HTTPException(422, "slow_roll_rpm: needs samples, so name a recording")
        return data.of_past(view, recording, (since_ns, until_ns), made, without)

    @app.get(f"{PLACE}/centrelines", responses=responses(CentrelineSeries, 404, 422), **common)
    def centrelines(
        site: SiteName,
        machine: MachineName,
        since_ns: SinceNs = None,
        until_ns: UntilNs = None,
        recording: Recordings = _NONE,
    ) -> CentrelineSeries:
        """Where the shaft was on average, over time and speed, from the history or recordings."""
        view = found_machine(service, site, machine)

        return data.of_past(
            view,
            recording,
            (since_ns, until_ns),
            centreline_series,
            lambda why: CentrelineSeries(site=site, machine=machine, source=_past(recording), reason=why),
        )


def _source(chosen: Chosen) -> Literal["newest samples", "recordings"]:
    return "recordings" if chosen.recorded else "newest samples"


def _past(recording: list[str]) -> Literal["history", "recordings"]:
    return "recordings" if recording else "history"
