"""``rotorwatch plot``: pictures of recordings."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import typer

from models.errors import MachineFileError
from service.commands.running import FromOption, ToOption, exit_codes, one_blas_thread

__all__ = ["register"]

_SIZE = re.compile(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)")
_ONLY_FOR: dict[str, tuple[str, ...]] = {
    "--at": ("correlation", "orbit", "spectrum"),
    "--machine": ("trend", "correlation"),
    "--channel": ("spectrum", "waterfall"),
    "--window": ("spectrum", "waterfall"),
    "--resolution": ("spectrum", "waterfall"),
    "--density": ("spectrum", "waterfall"),
    "--scale": ("spectrum", "waterfall"),
    "--to-hz": ("spectrum", "waterfall"),
    "--revolutions": ("orbit",),
    "--axis": ("waterfall",),
    "--cascade": ("waterfall",),
}


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(plot)


def plot(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings (.mcap), in any order.")],
    kind: Annotated[
        Literal["trend", "correlation", "orbit", "spectrum", "waterfall"], typer.Option("--kind", help="What to show.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Picture to write: .png or .svg.")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a picture that is there already.")] = False,
    key: Annotated[
        str | None,
        typer.Option("--key", metavar="SITE/MACHINE", help="Which machine, if the recordings hold several."),
    ] = None,
    from_: FromOption = None,
    to: ToOption = None,
    at: Annotated[
        str | None,
        typer.Option("--at", metavar="TIME", help="Correlation, orbit, spectrum: the latest up to here. Else the end."),
    ] = None,
    machine: Annotated[
        str | None,
        typer.Option(
            "--machine",
            metavar="FILE[@BUNDLE]",
            help="Trend, correlation: evaluate with this machine file, and after @ its bundle. If left out, "
            "the shipped machine with the recorded site and name; and a trend shows the recorded reports, if any.",
        ),
    ] = None,
    channel: Annotated[
        list[str] | None,
        typer.Option(
            "--channel",
            metavar="NAME",
            help="Spectrum (repeatable): all displacements if left out. Waterfall: the first displacement.",
        ),
    ] = None,
    revolutions: Annotated[
        int | None, typer.Option("--revolutions", min=1, max=1000, help="Orbit: how many, 8 if left out.")
    ] = None,
    window: Annotated[
        float | None,
        typer.Option("--window", metavar="S", help="Spectrum: seconds it is taken over, 20; waterfall: of each, 4."),
    ] = None,
    resolution: Annotated[
        float | None, typer.Option("--resolution", metavar="HZ", help="Distance of the lines of a spectrum, 0.5 Hz.")
    ] = None,
    density: Annotated[
        bool,
        typer.Option("--density", help="Power spectral density, not amplitudes (displacement p-p, others rms)."),
    ] = False,
    scale: Annotated[
        Literal["log", "linear"] | None,
        typer.Option("--scale", help="Of a spectrum; linear for amplitudes, log for densities and colours."),
    ] = None,
    to_hz: Annotated[
        float | None,
        typer.Option(
            "--to-hz",
            metavar="HZ",
            help="Highest frequency shown; else as far as there is anything, 4× at least.",
        ),
    ] = None,
    axis: Annotated[
        Literal["time", "speed"] | None, typer.Option("--axis", help="Waterfall: over time, or over the speed.")
    ] = None,
    cascade: Annotated[bool, typer.Option("--cascade", help="Waterfall: lines instead of colours.")] = False,
    title: Annotated[str | None, typer.Option("--title", help="Instead of the picture's own.")] = None,
    size: Annotated[
        str | None, typer.Option("--size", metavar="WxH", help="Width and height in inches, such as 10x6.")
    ] = None,
    dpi: Annotated[float, typer.Option("--dpi", min=30, max=600, help="Pixels per inch of a PNG.")] = 120.0,
) -> None:
    """Draw what is in recordings: PNG or SVG by the end of the name. Needs matplotlib: the extra "plots".

    Times are UTC, and those of the data, however fast they were recorded. The same input gives the same file.

    [bold]Examples[/bold]

    What changed, and when:
    [cyan]rotorwatch plot monday.mcap --kind trend --out trend.png[/cyan]

    What the equations' networks expected in the window that ends 170 s after the start:
    [cyan]rotorwatch plot monday.mcap --kind correlation --at 170 --out correlation.svg[/cyan]

    Orbits, spectra up to 100 Hz, and a run-up over the speed:
    [cyan]rotorwatch plot monday.mcap --kind orbit --revolutions 4 --out orbit.png[/cyan]
    [cyan]rotorwatch plot monday.mcap --kind spectrum --channel y2 --to-hz 100 --out spectrum.png[/cyan]
    [cyan]rotorwatch plot runup.mcap --kind waterfall --axis speed --out runup.png[/cyan]
    """
    with exit_codes():
        one_blas_thread()
        given = {
            "--at": at, "--machine": machine, "--channel": channel, "--window": window, "--resolution": resolution,
            "--density": density, "--scale": scale, "--to-hz": to_hz, "--revolutions": revolutions, "--axis": axis,
            "--cascade": cascade,
        }  # fmt: skip
        _check(kind, given, out, overwrite)
        for name, number in (("--window", window), ("--resolution", resolution), ("--to-hz", to_hz)):
            if number is not None and not 0 < number < 1e9:
                raise MachineFileError(f"{name} is {number:g}, expected a number above 0")
        _need_matplotlib()
        from service.analysis.plots.request import PlotRequest, draw_plot  # noqa: PLC0415  # keeps --help quick
        from service.analysis.plots.style import Look  # noqa: PLC0415

        draw_plot(
            PlotRequest(
                files=tuple(files),
                kind=kind,
                out=out,
                key=key,
                from_=from_,
                to=to,
                at=at,
                machine=machine,
                channels=tuple(channel or ()),
                revolutions=revolutions or 8,
                window_s=window or (20.0 if kind == "spectrum" else 4.0),
                resolution_hz=resolution or 0.5,
                scaling="density" if density else "amplitude",
                log=(density or (kind == "waterfall" and not cascade)) if scale is None else scale == "log",
                to_hz=to_hz,
                over_speed=axis == "speed",
                cascade=cascade,
                look=Look(title, _inches(size), dpi),
            )
        )
        typer.echo(str(out))


def _check(kind: str, given: Mapping[str, object], out: Path, overwrite: bool) -> None:
    for name, value in given.items():
        if value and kind not in _ONLY_FOR[name]:
            raise MachineFileError(f"{name} makes sense only with --kind {' or '.join(_ONLY_FOR[name])}")
    if out.suffix.lower() not in (".png", ".svg"):
        raise MachineFileError(f"--out is {out}, expected a name that ends in .png or .svg")
    if out.exists() and not overwrite:
        raise MachineFileError(f"{out}: exists already; --overwrite replaces it")


def _inches(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    found = _SIZE.fullmatch(text)
    width, height = (float(found[1]), float(found[2])) if found else (0.0, 0.0)
    if not (2 <= width <= 60 and 2 <= height <= 60):
        raise MachineFileError(f"--size is {text!r}, expected width x height in inches, 2 to 60, such as 10x6")
    return width, height


def _need_matplotlib() -> None:
    try:
        import matplotlib  # noqa: F401, PLC0415  # an extra that may be missing
    except ImportError as error:
        raise MachineFileError(
            "plots need the package matplotlib, which is not installed: pip install 'rotorwatch[plots]'"
        ) from error
