"""One picture: from the recordings it is made of to the file it is written to."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from matplotlib.figure import Figure

from models.errors import MachineFileError, RecordingError
from models.signals.keys import MachineKeys
from rotorwatch.records.alarms import AlarmEventData
from service.analysis.plots.correlation import correlations_of, latest_window
from service.analysis.plots.correlation_figure import paint_correlations
from service.analysis.plots.orbit import read_orbits
from service.analysis.plots.orbit_figure import paint_orbits
from service.analysis.plots.spectrum import Scaling, read_spectrum, read_waterfall
from service.analysis.plots.spectrum_figure import paint_cascade, paint_map, paint_spectrum
from service.analysis.plots.stretches import RecordedStream
from service.analysis.plots.style import Look, draw
from service.analysis.plots.trend import read_trend, recorded_alarms, trend_machine
from service.analysis.plots.trend_figure import paint_trend
from service.recordings.replay.choice import choose_machine
from service.recordings.replay.source import RecordingSource, parse_moment

__all__ = ["Kind", "PlotRequest", "draw_plot"]

Kind = Literal["trend", "correlation", "orbit", "spectrum", "waterfall"]


@dataclass(frozen=True, slots=True)
class PlotRequest:
    """What is to be drawn.

    Attributes
    ----------
    files : tuple of Path
        Recordings.
    kind : str
    out : Path
        Picture; its suffix, .png or .svg, is the format.
    key : str or None
        ``SITE/MACHINE``, where the recordings hold several.
    from_, to, at : str or None
        Times of the data, as `parse_moment` takes them; `at` is where the latest data end.
    machine : str or None
        ``FILE`` or ``FILE@BUNDLE`` for trends and correlations.
    channels : tuple of str
        For spectra.
    revolutions : int
        Of an orbit.
    window_s, resolution_hz : float
        Of a spectrum.
    scaling : str
        ``amplitude`` or ``density``.
    log : bool
        Whether amplitudes are on a logarithmic scale.
    to_hz : float or None
        Highest frequency shown; None is as far as there is something to be seen.
    over_speed, cascade : bool
        For waterfalls: over the speed and not time; lines and not colours.
    look : Look
    """

    files: tuple[Path, ...]
    kind: Kind
    out: Path
    key: str | None = None
    from_: str | None = None
    to: str | None = None
    at: str | None = None
    machine: str | None = None
    channels: tuple[str, ...] = ()
    revolutions: int = 8
    window_s: float = 20.0
    resolution_hz: float = 0.5
    scaling: Scaling = "amplitude"
    log: bool = False
    to_hz: float | None = None
    over_speed: bool = False
    cascade: bool = False
    look: Look = field(default_factory=Look)


def draw_plot(request: PlotRequest) -> None:
    """Read, compute, draw, write.

    Raises
    ------
    RotorwatchError
        If a file cannot be used, or there is nothing to be seen; the message says what was looked for.
    """
    try:
        source = RecordingSource(request.files)
    except RecordingError as error:
        raise MachineFileError(str(error)) from error  # a file that cannot be used is exit code 2
    keys = (trend_machine if request.kind == "trend" else RecordingSource.machine)(source, request.key)
    from_ns, to_ns = _limits(request, source, keys)
    if request.kind == "trend":
        trend = read_trend(source, keys, request.machine, from_ns, to_ns)
        draw(request.out, request.look, lambda look: paint_trend(trend, look))
        return
    name = f"{keys.site}/{keys.machine}"
    if request.kind == "correlation":
        installed = choose_machine(keys, request.machine)
        machine, bundle = installed.known, installed.bundle
        if machine is None or bundle is None:
            raise MachineFileError(
                "correlations are compared with what trained networks predict: name a bundle that has networks, as "
                "--machine FILE@BUNDLE (one that was commissioned without the rotor's parameters has none)"
            )
        found = correlations_of(latest_window(source, keys, machine, from_ns, to_ns), machine, bundle)
        networks = bundle.identity
        draw(request.out, request.look, lambda look: paint_correlations(found, name, networks, look))
        return
    stream = RecordedStream(source, keys, from_ns, to_ns)
    if request.kind == "orbit":
        orbits = read_orbits(stream, request.revolutions)
        draw(request.out, request.look, lambda look: paint_orbits(orbits, name, look))
        return
    draw(request.out, request.look, _spectra(request, stream, recorded_alarms(source, keys, from_ns, to_ns)))


def _spectra(
    request: PlotRequest, stream: RecordedStream, alarms: tuple[AlarmEventData, ...]
) -> Callable[[Look], Figure]:
    channels = stream.channels(request.channels) or stream.displacements
    if not channels:
        raise MachineFileError(f"{stream.name} measures no displacement: name channels with --channel")
    rate_hz = stream.descriptor.rate_hz
    up_to_hz = None if request.to_hz is None else min(request.to_hz, rate_hz / 2)
    if request.to_hz is not None and request.to_hz < 4 * request.resolution_hz:
        raise MachineFileError(
            f"--to-hz is {request.to_hz:g}, expected at least four lines of --resolution {request.resolution_hz:g} Hz"
        )
    log = request.log
    if request.kind == "spectrum":
        spectrum = read_spectrum(stream, channels, request.window_s, request.resolution_hz, request.scaling)
        return lambda look: paint_spectrum(spectrum, stream.name, look, log=log, up_to_hz=up_to_hz)
    if len(request.channels) > 1:
        raise MachineFileError(f"--channel: a waterfall is of one channel, found {', '.join(request.channels)}")
    waterfall = read_waterfall(stream, channels[0], request.window_s, request.resolution_hz, request.scaling)
    paint = paint_cascade if request.cascade else paint_map
    return lambda look: paint(
        waterfall, stream.name, look, alarms, over_speed=request.over_speed, log=log, up_to_hz=up_to_hz
    )


def _limits(request: PlotRequest, source: RecordingSource, keys: MachineKeys) -> tuple[int, int]:
    from_ns, to_ns = source.between(request.from_, request.to, keys)
    if request.at is None:
        return from_ns, to_ns
    at_ns = parse_moment(request.at, source.span(keys).start_ns, "--at")
    if not from_ns < at_ns:
        raise MachineFileError(f"--at {request.at}: nothing was recorded before that, from {request.from_ or 0} on")
    return from_ns, min(to_ns, at_ns)
