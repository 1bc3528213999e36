"""``rotorwatch import`` and ``rotorwatch export``: recordings from and to files of other programs."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from models.errors import MachineFileError
from service.commands.running import FromOption, prepare_numerics

commands = typer.Typer()
_LISTED = 5


@commands.command("import")
def import_(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="CSV, Parquet, NumPy .npz, MATLAB .mat, HDF5, WAV, UFF 58, TDMS or MF4 file, or a folder of them.",
        ),
    ],
    mapping: Annotated[Path, typer.Option(metavar="FILE", help="Mapping of columns to channels and units (TOML).")],
    machine: Annotated[str, typer.Option(metavar="FILE", help="Machine file, or name of a shipped one.")],
    out: Annotated[Path, typer.Option(metavar="RECORDING", help="Recording to write (.mcap).")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing recording.")] = False,
) -> None:
    """Turn measurements from another program into a recording.

    Units, rate and time are checked, and faults are reported with row and column. Gaps stay gaps. The files of a
    folder, such as snapshots, are joined in the order of their times, which are in their names (20260131T120000), in
    the files, or follow from the mapping's start and the machine's schedule. Files of a folder that cannot be read are
    left out and named, with exit code 1.

    Empty cells and NaN are refused, unless the mapping says time.not_finite = "missing", which keeps the other channels
    where a probe was dead, or "gap", which leaves such rows out.

    [bold]Example[/bold]

    [cyan]rotorwatch import run7.csv --mapping run7.toml --machine pump-7.toml --out run7.mcap[/cyan]
    """
    prepare_numerics()
    from models.machine import load_machine_file  # noqa: PLC0415  # keeps --help quick
    from service.interchange.importing import import_file, summary_lines  # noqa: PLC0415
    from service.interchange.mapping import load_mapping  # noqa: PLC0415

    if out.is_file() and not overwrite:
        raise MachineFileError(f"{out}: already exists; --overwrite replaces it")
    described = load_machine_file(machine)
    done = import_file(source, load_mapping(mapping, described), described, out, overwrite=overwrite)
    for line in summary_lines(done):
        typer.echo(line)
    for fault in done.unusable:
        typer.echo(f"left out: {fault}", err=True)
    if done.unusable:
        raise typer.Exit(1)


@commands.command()
def export(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="RECORDING...", help="Recordings (.mcap); several are joined in time.")
    ],
    to: Annotated[Literal["parquet", "csv", "mat"], typer.Option(help="Format.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="File to write.")],
    what: Annotated[
        Literal["stream", "reports", "alarms"], typer.Option(help="Samples, reports or alarm events.")
    ] = "stream",
    key: Annotated[
        str | None, typer.Option("--key", "--machine", metavar="SITE/MACHINE", help="Which machine, if several.")
    ] = None,
    from_: FromOption = None,
    to_time: Annotated[
        str | None, typer.Option("--to-time", metavar="TIME", help="Data before this time; same format.")
    ] = None,
    si: Annotated[bool, typer.Option("--si", help="Samples in SI units instead of those of the channels.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Write samples, reports or alarms of recordings for MATLAB, pandas, Excel and others.

    Columns state their units, times are nanoseconds since 1970 (UTC), and gaps stay gaps.

    [bold]Examples[/bold]

    [cyan]rotorwatch export run7.mcap --to parquet --out run7.parquet[/cyan]

    The second minute as text, in m and m/s:
    [cyan]rotorwatch export run7.mcap --to csv --out minute.csv --si --from 60 --to-time 120[/cyan]
    """
    prepare_numerics()
    from service.interchange.exported import Selection  # noqa: PLC0415  # keeps --help quick
    from service.interchange.exporting import export as write  # noqa: PLC0415
    from service.recordings.replay.source import RecordingSource, parse_moment  # noqa: PLC0415

    source = RecordingSource(recordings)
    keys = source.machine(key, reports=True)
    from_ns, to_ns = (
        None if text is None else parse_moment(text, source.span(keys).start_ns, option)
        for text, option in ((from_, "--from"), (to_time, "--to-time"))
    )
    table = write(Selection(source, keys, from_ns, to_ns, si), what, to, out, overwrite=overwrite)
    typer.echo(f"{out}: {table.rows} rows, {len(table.schema)} columns")
    for text in table.skipped[:_LISTED]:
        typer.echo(f"left out: {text}", err=True)
    if len(table.skipped) > _LISTED:
        typer.echo(f"left out: {len(table.skipped) - _LISTED} more", err=True)
