"""``rotorwatch plot``: pictures of recordings, a command for each kind."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from models.errors import MachineFileError
from service.commands.running import Commands, FromOption, ToOption, finite, prepare_numerics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from service.analysis.figures.spectrum import Lines
    from service.analysis.figures.style import Look
    from service.analysis.past import Past
    from service.analysis.recorded import Recorded

_SIZE = re.compile(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)")
_SPEEDS = re.compile(r"(\d+(?:\.\d+)?)-(\d+(?:\.\d+)?)")
commands = typer.Typer(name="plot", cls=Commands, no_args_is_help=True, rich_markup_mode="rich")

_AtOption = Annotated[
    str | None, typer.Option("--at", metavar="TIME", help="Use data up to this time; else up to the end.")
]
_WindowOption = Annotated[float, typer.Option("--window", metavar="S", help="Seconds of data used.")]
_ResolutionOption = Annotated[float, typer.Option("--resolution", metavar="HZ", help="Line spacing.")]
_DensityOption = Annotated[
    bool, typer.Option("--density", help="Power spectral density, not amplitudes (displacement pp, others rms).")
]
_ToHzOption = Annotated[
    float | None,
    typer.Option(
        "--to-hz", metavar="HZ", help="Highest frequency shown; if left out, as far as there is content, at least 4×."
    ),
]
_ChannelsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--channel",
        metavar="NAME",
        help="Repeatable; all of the first quantity measured if left out, displacements before velocities.",
    ),
]
_PlaceOption = Annotated[
    str | None, typer.Option("--place", metavar="NAME", help="Place of the probes; all places if left out.")
]
_OrderOption = Annotated[int, typer.Option("--order", min=1, max=3, help="Multiple of running speed: 1, 2 or 3.")]
_EachOption = Annotated[int, typer.Option("--revolutions", min=1, max=1000, help="Revolutions averaged per point.")]
_SlowRollOption = Annotated[
    float | None,
    typer.Option("--slow-roll", metavar="RPM", help="Subtract the mean vector up to this speed (run-out)."),
]


@commands.callback()
def _describe() -> None:
    """Draw recordings as PNG or SVG, by the end of the file name. Needs matplotlib (the extra "plots").

    Times are UTC, and those of the data, however fast they were recorded. The same input gives the same file.

    [bold]Examples[/bold]

    What changed, and when:
    [cyan]rotorwatch plot trend monday.mcap --out trend.png[/cyan]

    What the equations' networks predicted for the window that ends 170 s after the start:
    [cyan]rotorwatch plot correlation monday.mcap --at 170 --out correlation.svg[/cyan]

    Orbits, spectra up to 100 Hz, and a run-up over the speed:
    [cyan]rotorwatch plot orbit monday.mcap --revolutions 4 --out orbit.png[/cyan]
    [cyan]rotorwatch plot spectrum monday.mcap --channel y2 --to-hz 100 --out spectrum.png[/cyan]
    [cyan]rotorwatch plot waterfall runup.mcap --axis speed --out runup.png[/cyan]
    """


@dataclass(frozen=True, kw_only=True)
class _Picture:
    """Options that all pictures have in common."""

    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="FILE...", help="Recordings (.mcap), in any order.", show_default=False),
    ] = None
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Picture to write: .png or .svg.")]
    history: Annotated[
        Path | None,
        typer.Option(
            "--history",
            metavar="FILE",
            help="Settings (TOML) of a monitor: plot its history instead of recordings. For trend, bode, polar "
            "and centreline.",
        ),
    ] = None
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing picture.")] = False
    key: Annotated[
        str | None, typer.Option("--key", metavar="SITE/MACHINE", help="Which machine, if the recordings have several.")
    ] = None
    from_: FromOption = None
    to: ToOption = None
    title: Annotated[str | None, typer.Option("--title", help="Title, instead of the default one.")] = None
    size: Annotated[
        str | None, typer.Option("--size", metavar="WxH", help="Width and height in inches, such as 10x6.")
    ] = None
    dpi: Annotated[float, typer.Option("--dpi", min=30, max=600, callback=finite, help="Pixels per inch of a PNG.")] = (
        120.0
    )

    def check(self) -> None:
        """Refuse an output that cannot be written, before anything is computed."""
        if self.out.suffix.lower() not in (".png", ".svg"):
            raise MachineFileError(f"--out is {self.out}, expected a name that ends in .png or .svg")
        if self.out.exists() and not self.overwrite:
            raise MachineFileError(f"{self.out}: already exists; --overwrite replaces it")
        try:
            import matplotlib  # noqa: F401, PLC0415  # an extra that may be missing
        except ImportError as error:
            raise MachineFileError(
                "plots need the package matplotlib, which is not installed: pip install 'rotorwatch[plots]'"
            ) from error

    def recorded(self, at: str | None = None, *, reports: bool = False) -> "Recorded":
        """The recorded data to be drawn."""
        from service.analysis.recorded import Recorded  # noqa: PLC0415  # keeps --help quick

        if self.history is not None:
            raise MachineFileError("--history: this picture needs samples, which a history lacks; name recordings")
        if not self.files:
            raise MachineFileError("no recordings are named: expected FILE...")
        found = Recorded.find(self.files, self.key, (self.from_, self.to), at, reports=reports)
        if not reports and found.lacking:
            typer.echo(found.lacking, err=True)
        return found

    def known(self, *, reports: bool = False) -> "Recorded | Past":
        """The recorded data to be drawn, or those of the history."""
        if self.history is None:
            return self.recorded(reports=reports)
        if self.files:
            raise MachineFileError("both recordings and --history are given, expected one of them")
        from service.analysis.past import Past  # noqa: PLC0415

        return Past.find(self.history, self.key, (self.from_, self.to))

    @property
    def look(self) -> "Look":
        """Options that concern the picture itself."""
        from service.analysis.figures.style import Look  # noqa: PLC0415

        return Look(self.title, self._inches(), self.dpi)

    def _inches(self) -> tuple[float, float] | None:
        if self.size is None:
            return None
        found = _SIZE.fullmatch(self.size)
        width, height = (float(found[1]), float(found[2])) if found else (0.0, 0.0)
        if not (2 <= width <= 60 and 2 <= height <= 60):
            raise MachineFileError(f"--size is {self.size!r}, expected width x height in inches, 2 to 60, such as 10x6")
        return width, height


def _kind(paint: Callable[..., "Figure"]) -> None:
    """Add a command for a kind of picture: the common options, passed as one `_Picture`, and its own."""
    shared = signature(_Picture).parameters

    def command(**given: Any) -> None:
        prepare_numerics()
        picture = _Picture(**{name: given.pop(name) for name in shared})
        picture.check()
        from service.analysis.figures.style import draw  # noqa: PLC0415

        draw(picture.out, picture.look, partial(paint, picture, **given))
        typer.echo(str(picture.out))

    (files, out, *others), (_, *own) = shared.values(), signature(paint).parameters.values()
    options = [one.replace(kind=Parameter.KEYWORD_ONLY) for one in (files, out, *own, *others)]
    command.__signature__ = signature(command).replace(parameters=options)  # type: ignore[attr-defined]  # typer's view
    commands.command(paint.__name__.replace("_", "-"), help=paint.__doc__)(command)


@_kind
def trend(
    picture: _Picture,
    machine: Annotated[
        str | None,
        typer.Option(
            metavar="FILE[@BUNDLE]",
            help="Evaluate again with this machine file, and after @ its bundle. If left out, the recorded reports are "
            "shown; without any, those of the shipped machine with the recorded site and name.",
        ),
    ] = None,
    levels: Annotated[
        bool, typer.Option("--levels", help="Vibration levels and their limits, even where parameters were read.")
    ] = False,
) -> "Figure":
    """Every parameter's change with its 95 % interval over time, or vibration levels; state, alarms and speed."""
    from service.analysis.figures.trend import trend as read  # noqa: PLC0415

    return read(picture.look, picture.known(reports=True), machine, levels=levels)


@_kind
def correlation(
    picture: _Picture,
    at: _AtOption = None,
    machine: Annotated[
        str | None,
        typer.Option(
            metavar="FILE[@BUNDLE]",
            help="Machine file, and after @ the bundle with the networks. If left out, the shipped machine with the "
            "recorded site and name.",
        ),
    ] = None,
) -> "Figure":
    """Correlations of one window against what the networks predict, equation by equation."""
    from service.analysis.figures.correlation import correlation as read  # noqa: PLC0415

    return read(picture.look, picture.recorded(at), machine)


@_kind
def orbit(
    picture: _Picture,
    at: _AtOption = None,
    revolutions: Annotated[int, typer.Option(min=1, max=1000, help="How many.")] = 8,
) -> "Figure":
    """The shaft's path at bearing and disc, as measured and at running speed alone."""
    from service.analysis.figures.samples import orbit as read  # noqa: PLC0415

    return read(picture.look, picture.recorded(at), revolutions)


@_kind
def spectrum(
    picture: _Picture,
    at: _AtOption = None,
    channel: _ChannelsOption = None,
    window: _WindowOption = 20.0,
    resolution: _ResolutionOption = 0.5,
    density: _DensityOption = False,
    scale: Annotated[
        Literal["log", "linear"] | None, typer.Option(help="Linear for amplitudes, log for densities.")
    ] = None,
    to_hz: _ToHzOption = None,
) -> "Figure":
    """Amplitudes or power spectral density of channels, 1× and 2× marked."""
    from service.analysis.figures.spectrum import spectrum as read  # noqa: PLC0415

    lines = _lines(window, resolution, to_hz, density=density, log=density if scale is None else scale == "log")
    return read(picture.look, picture.recorded(at), channel or (), lines)


@_kind
def waterfall(
    picture: _Picture,
    channel: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="If left out, the first displacement, velocity or acceleration."),
    ] = None,
    window: Annotated[float, typer.Option(metavar="S", help="Seconds of data per spectrum.")] = 4.0,
    resolution: _ResolutionOption = 0.5,
    density: _DensityOption = False,
    scale: Annotated[
        Literal["log", "linear"] | None,
        typer.Option(help="Scale of colours or heights; if left out, log for colours and densities."),
    ] = None,
    to_hz: _ToHzOption = None,
    axis: Annotated[Literal["time", "speed"], typer.Option(help="Over time, or over the speed.")] = "time",
    cascade: Annotated[bool, typer.Option("--cascade", help="Lines instead of colours.")] = False,
) -> "Figure":
    """Spectra of one channel over time, or over speed in a run-up."""
    from service.analysis.figures.spectrum import waterfall as read  # noqa: PLC0415

    log = density or not cascade if scale is None else scale == "log"
    lines = _lines(window, resolution, to_hz, density=density, log=log)
    return read(picture.look, picture.recorded(), channel or (), lines, over_speed=axis == "speed", cascade=cascade)


@_kind
def waveform(
    picture: _Picture,
    at: _AtOption = None,
    channel: _ChannelsOption = None,
    window: Annotated[
        float | None, typer.Option(metavar="S", help="Seconds shown; as long as 8 revolutions if left out.")
    ] = None,
) -> "Figure":
    """Samples of channels over time, with the keyphasor's pulses."""
    from service.analysis.figures.samples import waveform as read  # noqa: PLC0415

    _positive("--window", window)
    return read(picture.look, picture.recorded(at), channel or (), window)


@_kind
def full_spectrum(
    picture: _Picture,
    at: _AtOption = None,
    place: _PlaceOption = None,
    window: _WindowOption = 20.0,
    resolution: _ResolutionOption = 0.5,
    scale: Annotated[Literal["log", "linear"], typer.Option(help="Scale of amplitudes.")] = "linear",
    to_hz: _ToHzOption = None,
    axis: Annotated[Literal["hz", "orders"], typer.Option(help="Frequencies, or multiples of running speed.")] = "hz",
) -> "Figure":
    """Forward and reverse precession of the shaft at a place, from its displacements in y and z."""
    from service.analysis.figures.spectrum import full_spectrum as read  # noqa: PLC0415

    lines = _lines(window, resolution, to_hz, density=False, log=scale == "log")
    return read(picture.look, picture.recorded(at), place, lines, orders=axis == "orders")


@_kind
def centreline(
    picture: _Picture,
    place: _PlaceOption = None,
    window: Annotated[float, typer.Option(metavar="S", help="Seconds of data per mean.")] = 1.0,
    clearance: Annotated[
        float | None, typer.Option(metavar="UM", help="Diametral clearance, µm: its circle, start at the bottom.")
    ] = None,
) -> "Figure":
    """Mean position of the shaft across the bearing, from gaps in y and z, over speed or time."""
    from service.analysis.figures.run_up import centreline as read  # noqa: PLC0415

    _positive("--window", window)
    _positive("--clearance", clearance)
    return read(picture.look, picture.known(), place, window, clearance)


@_kind
def bode(
    picture: _Picture,
    channel: _ChannelsOption = None,
    order: _OrderOption = 1,
    revolutions: _EachOption = 16,
    slow_roll: _SlowRollOption = None,
    speeds: Annotated[
        str | None,
        typer.Option(metavar="RPM-RPM", help="Without a keyphasor: range to search for the speed. Gives no phase."),
    ] = None,
) -> "Figure":
    """Amplitude and phase lag of 1x over the speed, from a run-up or coast-down."""
    from service.analysis.figures.run_up import bode as read  # noqa: PLC0415

    return read(picture.look, picture.known(), channel or (), order, revolutions, slow_roll, _speeds(speeds))


@_kind
def polar(
    picture: _Picture,
    channel: _ChannelsOption = None,
    order: _OrderOption = 1,
    revolutions: _EachOption = 16,
    slow_roll: _SlowRollOption = None,
) -> "Figure":
    """Amplitude and phase lag of 1x as vectors in the plane, with speeds; the lag counts against the rotation."""
    from service.analysis.figures.run_up import polar as read  # noqa: PLC0415

    return read(picture.look, picture.known(), channel or (), order, revolutions, slow_roll)


def _lines(window_s: float, resolution_hz: float, to_hz: float | None, *, density: bool, log: bool) -> "Lines":
    from service.analysis.figures.spectrum import Lines  # noqa: PLC0415

    for name, number in (("--window", window_s), ("--resolution", resolution_hz), ("--to-hz", to_hz)):
        _positive(name, number)
    return Lines(window_s, resolution_hz, "density" if density else "amplitude", log, to_hz)


def _speeds(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    found = _SPEEDS.fullmatch(text)
    if not found or not 0 < float(found[1]) < float(found[2]):
        raise MachineFileError(f"--speeds is {text!r}, expected the slowest and the fastest, rpm, such as 600-3000")
    return float(found[1]), float(found[2])


def _positive(name: str, number: float | None) -> None:
    if number is not None and not 0 < number < 1e9:
        raise MachineFileError(f"{name} is {number:g}, expected a number above 0 and below 1e9")
