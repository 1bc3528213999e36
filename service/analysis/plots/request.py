"""What pictures are made of: the recorded data of one machine in a stretch of time, and what is drawn of them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from models.errors import MachineFileError, RecordingError
from models.signals.channels import Channel
from models.signals.keys import MachineKeys
from service.analysis.plots.correlation import correlations_of, latest_window
from service.analysis.plots.correlation_figure import paint_correlations
from service.analysis.plots.excerpts import RecordedStream
from service.analysis.plots.orbit import read_orbits
from service.analysis.plots.orbit_figure import paint_orbits
from service.analysis.plots.spectrum import Scaling, read_spectrum, read_waterfall
from service.analysis.plots.spectrum_figure import paint_cascade, paint_map, paint_spectrum
from service.analysis.plots.style import Look
from service.analysis.plots.trend import read_trend, recorded_alarms, trend_machine
from service.analysis.plots.trend_figure import paint_trend
from service.recordings.replay.machine import choose_machine
from service.recordings.replay.source import RecordingSource, parse_moment

Paint = Callable[[Look], Figure]
"""Draws what was read; all functions here that return one raise `RotorwatchError` if there is nothing to be seen."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """Recorded data of one machine.

    Attributes
    ----------
    from_ns, to_ns : int
        Times of the data, from `from_ns` up to, and without, `to_ns`.
    """

    source: RecordingSource
    keys: MachineKeys
    from_ns: int
    to_ns: int

    @property
    def name(self) -> str:
        """``site/machine``."""
        return f"{self.keys.site}/{self.keys.machine}"

    @property
    def stream(self) -> RecordedStream:
        """The samples."""
        return RecordedStream(self.source, self.keys, self.from_ns, self.to_ns)


@dataclass(frozen=True, slots=True)
class Lines:
    """How spectra are taken and shown.

    Attributes
    ----------
    scaling : str
        ``amplitude`` or ``density``.
    log : bool
        Whether amplitudes are on a logarithmic scale.
    to_hz : float or None
        Highest frequency shown; None is as far as there is something to be seen.
    """

    window_s: float
    resolution_hz: float
    scaling: Scaling
    log: bool
    to_hz: float | None


def recorded(
    files: tuple[Path, ...],
    key: str | None,
    between: tuple[str | None, str | None],
    at: str | None = None,
    *,
    reports: bool = False,
) -> Recorded:
    """Find a machine's data in recordings.

    Parameters
    ----------
    key : str or None
        ``SITE/MACHINE``, where the recordings hold several.
    between : (str or None, str or None)
        From and to, times of the data as `parse_moment` takes them.
    at : str or None
        Where the latest data end.
    reports : bool
        Whether a machine of which only reports were recorded will do.

    Raises
    ------
    MachineFileError
        If a file or time cannot be used, or there is no such machine.
    """
    try:
        source = RecordingSource(files)
    except RecordingError as error:
        raise MachineFileError(str(error)) from error  # a file that cannot be used is exit code 2
    keys = (trend_machine if reports else RecordingSource.machine)(source, key)
    from_ns, to_ns = source.between(*between, keys)
    if at is not None:
        at_ns = parse_moment(at, source.span(keys).start_ns, "--at")
        if not from_ns < at_ns:
            raise MachineFileError(f"--at {at}: nothing was recorded before that, from {between[0] or 0} on")
        to_ns = min(to_ns, at_ns)
    return Recorded(source, keys, from_ns, to_ns)


def trend(data: Recorded, machine: str | None, *, levels: bool) -> Paint:
    """Parameters or levels over time, as recorded or with the machine file ``FILE[@BUNDLE]``."""
    found = read_trend(data.source, data.keys, machine, data.from_ns, data.to_ns, levels=levels)
    return lambda look: paint_trend(found, look)


def correlation(data: Recorded, choice: str | None) -> Paint:
    """Correlations of the latest window, with the shipped machine file or ``FILE[@BUNDLE]``."""
    installed = choose_machine(data.keys, choice)
    machine, bundle = installed.known, installed.bundle
    if machine is None or bundle is None:
        raise MachineFileError(
            "correlations are compared with what trained networks predict: name a bundle that has networks, as "
            "--machine FILE@BUNDLE (one that was commissioned without the rotor's parameters has none)"
        )
    window = latest_window(data.source, data.keys, machine, data.from_ns, data.to_ns)
    found = correlations_of(window, machine, bundle)
    return lambda look: paint_correlations(found, data.name, bundle.identity, look)


def orbit(data: Recorded, revolutions: int) -> Paint:
    """Orbits of the latest revolutions."""
    found = read_orbits(data.stream, revolutions)
    return lambda look: paint_orbits(found, data.name, look)


def spectrum(data: Recorded, channels: tuple[str, ...], lines: Lines) -> Paint:
    """Spectra of the latest seconds; of all displacements if no channel is named."""
    stream = data.stream
    chosen, up_to_hz = _chosen(stream, channels, lines)
    found = read_spectrum(stream, chosen, lines.window_s, lines.resolution_hz, lines.scaling)
    return lambda look: paint_spectrum(found, data.name, look, log=lines.log, up_to_hz=up_to_hz)


def waterfall(data: Recorded, channels: tuple[str, ...], lines: Lines, *, over_speed: bool, cascade: bool) -> Paint:
    """Spectra of one channel, the first displacement if none is named, over time or speed, as colours or as lines."""
    if len(channels) > 1:
        raise MachineFileError(f"--channel: a waterfall is of one channel, found {', '.join(channels)}")
    stream = data.stream
    chosen, up_to_hz = _chosen(stream, channels, lines)
    found = read_waterfall(stream, chosen[0], lines.window_s, lines.resolution_hz, lines.scaling)
    alarms = recorded_alarms(data.source, data.keys, data.from_ns, data.to_ns)
    paint = paint_cascade if cascade else paint_map
    return lambda look: paint(found, data.name, look, alarms, over_speed=over_speed, log=lines.log, up_to_hz=up_to_hz)


def _chosen(stream: RecordedStream, names: tuple[str, ...], lines: Lines) -> tuple[tuple[Channel, ...], float | None]:
    """Channels, and how far the spectra are shown."""
    channels = stream.channels(names) or stream.displacements
    if not channels:
        raise MachineFileError(f"{stream.name} measures no displacement: name channels with --channel")
    if lines.to_hz is None:
        return channels, None
    if lines.to_hz < 4 * lines.resolution_hz:
        raise MachineFileError(
            f"--to-hz is {lines.to_hz:g}, expected at least four lines of --resolution {lines.resolution_hz:g} Hz"
        )
    return channels, min(lines.to_hz, stream.descriptor.rate_hz / 2)
