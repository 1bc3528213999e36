"""``rotorwatch size``: estimates the resources that a plant needs, from measured costs."""

import dataclasses
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from service.commands.running import finite, prepare_numerics

if TYPE_CHECKING:  # imports numpy and scipy, which would delay --help
    from service.history.records import Retention
    from service.runtime.sizing import Costs, Kind, Size

commands = typer.Typer()
_PREFIXES = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"))


@commands.command()
def size(
    machines: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of machines.")],
    channels: Annotated[int, typer.Option(min=1, max=1000, help="Per machine, shaft angle included.")] = 9,
    rate: Annotated[
        float, typer.Option(metavar="HZ", min=1.0, max=1e6, help="Samples per second and channel.")
    ] = 2000.0,
    hop: Annotated[float, typer.Option(metavar="S", min=0.1, help="Seconds between reports.")] = 5.0,
    levels_only: Annotated[
        bool, typer.Option("--levels-only", help="Only watch vibration levels; diagnose nothing.")
    ] = False,
    networks: Annotated[bool, typer.Option(help="Trained networks in addition to the likelihood.")] = True,
    cores: Annotated[int, typer.Option(min=1, max=1024, help="Per computer.")] = 8,
    busy: Annotated[
        float, typer.Option(min=0.05, max=1.0, callback=finite, help="Part of the cores that may be used on average.")
    ] = 0.6,
    reports_days: Annotated[float | None, typer.Option(metavar="DAYS", help="How long reports are kept.")] = None,
    readings_days: Annotated[
        float | None, typer.Option(metavar="DAYS", help="How long single readings are kept.")
    ] = None,
    keep_days: Annotated[
        float | None, typer.Option(metavar="DAYS", help="How long recordings without an alarm are kept.")
    ] = None,
    keep_gb: Annotated[
        float | None, typer.Option(metavar="GB", help="Most kept of these recordings per machine.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The figures of all machines, for another program.")] = False,
) -> None:
    """Estimate what a plant needs: processor, memory, disk, network, processes and computers.

    The estimate rests on figures measured on simulated machines and a model between them, both shown with the result.
    Retention times are the defaults unless given. The page, the API and other programs need resources in addition.

    [bold]Examples[/bold]

    [cyan]rotorwatch size --machines 200 --channels 12 --rate 4000 --no-networks[/cyan]
    [cyan]rotorwatch size --machines 500 --channels 4 --rate 1000 --levels-only[/cyan]
    """
    prepare_numerics()
    from models.mistakes import checked  # noqa: PLC0415  # keeps --help quick
    from service.history.records import Retention  # noqa: PLC0415
    from service.runtime.sizing import Kind, load_costs, sized  # noqa: PLC0415
    from service.settings.service import RecordingSettings  # noqa: PLC0415

    days = {"reports_days": reports_days, "readings_days": readings_days, "keep_days": keep_days, "keep_gb": keep_gb}
    given = {name: value for name, value in days.items() if value is not None}
    retention = checked(Retention, {n: value for n, value in given.items() if n in Retention.model_fields}, "arguments")
    recording = checked(
        RecordingSettings, {n: value for n, value in given.items() if n in RecordingSettings.model_fields}, "arguments"
    )
    costs = load_costs()
    of_kind = {"channels": channels, "rate_hz": rate, "hop_s": hop, "diagnosed": not levels_only}
    kind = checked(Kind, of_kind | {"networks": networks and not levels_only}, "arguments")
    found = sized(costs, kind, machines, retention=retention, recording=recording, cores=cores, busy=busy)
    if as_json:
        told = {"kind": kind.model_dump(), **dataclasses.asdict(found), "outside": costs.outside(kind)}
        typer.echo(json.dumps(told, indent=2))
        return
    for line in _lines(costs, kind, found, retention, cores, busy):
        typer.echo(line)


def _lines(
    costs: "Costs", kind: "Kind", found: "Size", retention: "Retention", cores: int, busy: float
) -> Iterator[str]:
    """The result as lines of text, at most 80 characters wide."""
    diagnosed = "diagnosed, networks" if kind.networks else "diagnosed, no networks"
    made = diagnosed if kind.diagnosed else "levels only"
    stream = f"{kind.channels} channel{'s' * (kind.channels > 1)} at {kind.rate_hz:g} Hz"
    yield f"{stream}, a report every {kind.hop_s:g} s, {made}"
    yield ""
    yield f"{'':38}{'one machine':>16}{f'all {found.machines}':>18}"

    def row(what: str, of_all: float, unit: str) -> str:
        return f"{what:<38}{_amount(of_all / found.machines, unit):>16}{_amount(of_all, unit):>18}"

    history = f"{retention.reports_days:g} and {retention.readings_days:g} days"
    yield row("processor", found.cores, "cores")
    yield row("  recorders, where one records", found.recording_cores, "cores")
    yield row("memory", found.memory_mb * 1e6, "B")
    yield row("network, samples in", found.network_in_mb_s * 1e6, "B/s")
    yield row("  reports out, each subscriber", found.network_out_mb_s * 1e6, "B/s")
    yield row("history, written to the disk", found.history_written_gb_day * 1e9, "B/day")
    yield row(f"  its size ({history})", found.history_gb * 1e9, "B")
    yield row("recordings, written to the disk", found.recorded_gb_day * 1e9, "B/day")
    yield row(f"  their size ({found.recordings_days:.3g} days)", found.recordings_gb * 1e9, "B")
    yield row("  kept for alarms, at most", found.alarm_recordings_gb * 1e9, "B")
    yield ""
    yield f"processes     {f'{found.shards} ([shards] count) beside the one that serves' if found.shards else 'one'}"
    yield f"computers     {found.computers} with {cores} cores, {busy:.0%} busy at most on average"
    if found.machine_core > busy:
        yield f"One machine takes {found.machine_core:.2g} cores, and a process uses one: choose a longer hop or fewer"
        yield "channels."
    yield ""
    yield f"Measured on {costs.computer}, {costs.machines} machines in a process,"
    yield f"rotorwatch {costs.version}. From these {len(costs.cases)} kinds of machines the model deviates by at most"
    off = {what: f"{costs.deviation(what):.0%}" for what in ("processor_ms", "memory_mb", "written_kb")}
    yield f"{off['processor_ms']} (processor), {off['memory_mb']} (memory), {off['written_kb']} (written to the disk)."
    for what in costs.outside(kind):
        yield f"OUTSIDE of what was measured: {what}"


def _amount(value: float, unit: str) -> str:
    """Format a number to about three digits with its unit; bytes get a decimal prefix."""
    if unit.startswith("B"):
        value, unit = next(
            ((value / size, f"{prefix}{unit}") for size, prefix in _PREFIXES if value >= size), (value, unit)
        )
    digits = 0 if value >= 100 else 1 if value >= 10 else 2 if value >= 1 else 4
    return f"{value:.{digits}f} {unit}"
