"""What ``rotortrain commission`` does: read recordings, learn, train, write the bundle, print the verdict."""

import hashlib
import shutil
from collections.abc import Sequence
from pathlib import Path

import typer
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from models.commissioning.commission import Commissioning, CommissioningReport, commission
from models.commissioning.commissioned import FILE, Commissioned, HealthyEntry, load_commissioned
from models.commissioning.healthy import HealthyRecording, read_healthy
from models.diagnosis.networks.bundle import MANIFEST, load_bundle
from models.errors import BundleError, MachineFileError
from models.machine import Machine, MachineFile, load_machine_file
from simulator.commands import labelled_bars
from simulator.commission.page import write_report
from simulator.commission.verdict import (
    VERDICT_TEXT,
    budget_sentences,
    dominant,
    growth_sentence,
    headline,
    next_steps,
    parameter_value,
    percent,
    smallest_change,
)

_COLOURS = {"commissioned": "bold green", "passed": "green", "limited": "bold yellow", "refused": "bold red"}
_WIDE = 100


def print_report(report: CommissioningReport, console: Console | None = None) -> None:
    """Print verdict, checks and parameters, by default on the terminal, for which 80 columns suffice."""
    console = Console(highlight=False) if console is None else console
    verdict = Text(headline(report))
    verdict.highlight_words([VERDICT_TEXT[report.verdict]], style=_COLOURS[report.verdict])
    console.print(verdict)
    console.print(Text(f"knowledge level {report.level.value}: {report.level_text}"))
    checks = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    checks.add_column(no_wrap=True)
    checks.add_column(max_width=20 if console.width < _WIDE else None)
    checks.add_column(ratio=1)
    for check in report.checks:
        checks.add_row(Text(check.verdict, style=_COLOURS[check.verdict]), Text(check.name), Text(check.text))
    console.print(checks)
    if report.parameters:
        console.print(_parameters(report))
        for sentence in budget_sentences(report):
            console.print(Text(sentence))
    if report.levels:
        console.print(Text(growth_sentence(report)))
    console.print(Text("\nWhat to do next", style="bold"))
    for number, step in enumerate(next_steps(report), start=1):
        console.print(Padding(Text(f"{number}. {step}"), (0, 0, 0, 2)))


def _parameters(report: CommissioningReport) -> Table:
    identified = any(one.identified is not None for one in report.parameters)
    table = Table(
        box=None,
        padding=(0, 2, 0, 0),
        title="standard error of one window and of the commissioning; smallest change found",
        title_justify="left",
        title_style="",
    )
    table.add_column("parameter", no_wrap=True)
    if identified:
        table.add_column("identified", justify="right")
    for head in ("window", "commissioning"):
        table.add_column(head, justify="right", no_wrap=True)
    table.add_column("dominant")
    for head in ("loss", "gain"):
        table.add_column(head, justify="right")
    for one in report.parameters:
        cells = ["not readable"]
        if one.evaluable:
            value = "" if one.identified is None else parameter_value(one.name, one.identified)
            errors = ["–" if error is None else percent(error) for error in (one.window_error, one.commissioning_error)]
            cells = [*([value] if identified else []), *errors, dominant(one), *smallest_change(one)]
        table.add_row(*map(Text, (one.name, *cells)))
    return table


def commission_machine(
    name: str,
    healthy: Sequence[Path],
    out: Path,
    *,
    first_s: float | None,
    wished: float | None,
    why: str,
    networks: bool,
    n_windows: int,
    n_draws: int,
    seed: int,
    processes: int,
) -> bool:
    """Commission a machine, write its bundle, and say whether it was commissioned; if not, the report says why.

    Only the first seconds of every recording are used, if `first_s` is given. If `out` holds a commissioning already,
    `why` must say why it is made again. Networks are trained only if the parameters are known.

    Raises
    ------
    RotorwatchError
        If machine file, recordings or directory cannot be used.
    """
    machine, names = load_machine_file(name), [path.name for path in healthy]
    for path in healthy:
        if names.count(path.name) > 1:  # names identify the recordings in the report and in the bundle
            raise MachineFileError(f"--healthy {path}: two recordings are called {path.name}, expected different names")
    replaces = _load_replaced(out, machine, why)
    with labelled_bars() as progress:
        recordings = []
        for number, path in enumerate(healthy, start=1):
            recordings.append(read_healthy(path, machine, first_s))
            progress("reading recordings", number, len(healthy))
        entries = [_entry(path, one) for path, one in zip(healthy, recordings, strict=True) if one.hops]
        made = commission(machine, recordings, entries, wished=wished, replaces=replaces, why=why, progress=progress)
    _write(out, made, replaces)
    page = write_report(out, made.report, recordings, machine=machine, commissioned=made.commissioned)
    print_report(made.report)
    if made.commissioned is not None and made.machine is not None and networks:
        from simulator.training.command import train_for  # noqa: PLC0415  # needs torch, nothing else here does

        train_for(made.machine, out, n_windows, n_draws, seed, processes)
    typer.echo(f"report: {page}")
    if made.commissioned is not None:
        typer.echo(f"bundle: {out}   (rotorwatch run --machine {name}@{out})")
    return made.commissioned is not None


def _load_replaced(out: Path, machine: MachineFile, why: str) -> Commissioned | None:
    """Load the commissioning that is replaced, if there is one; this needs a reason, so that none is by accident."""
    if not (out / FILE).is_file():
        return None
    try:
        before = load_commissioned(out, machine, same_description=False)
    except BundleError as error:
        raise BundleError(f"{error}; give another directory with --out") from error
    if not why:
        raise MachineFileError(
            f"{out} holds version {before.version} of the commissioning of {before.site}/{before.machine}: say why "
            'it is replaced, such as --why "bearing exchanged", or give another directory with --out'
        )
    return before


def _remove_networks(out: Path, machine: Machine) -> str:
    """Remove networks that are damaged or not the machine's: with them beside its commissioning no monitor would start.

    Returns what is wrong with them; empty if they stay, or there are none.
    """
    if not (out / MANIFEST).exists():
        return ""
    try:
        load_bundle(out, machine)
    except BundleError as error:
        if isinstance(error.__cause__, OSError) and not isinstance(error.__cause__, FileNotFoundError):
            raise  # they may be the machine's
        (out / MANIFEST).unlink()
        return str(error)
    return ""


def _entry(path: Path, recording: HealthyRecording) -> HealthyEntry:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    start_ns, end_ns, used_s = recording.hops[0].start_ns, recording.hops[-1].end_ns, recording.duration_s
    return HealthyEntry(
        name=path.name, sha256=digest, start_ns=start_ns, end_ns=end_ns, used_s=used_s, gaps=recording.gaps
    )


def _write(out: Path, made: Commissioning, replaces: Commissioned | None) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        if made.commissioned is None:
            return
        if replaces is not None:
            shutil.copyfile(out / FILE, out / f"commissioned-{replaces.version}.json")
        if made.machine is not None and (why := _remove_networks(out, made.machine)):
            typer.echo(f"the networks that were there cannot be used and were removed: {why}")
        draft = out / (FILE + ".new")  # the old file stays intact until the new one is complete
        draft.write_text(made.commissioned.model_dump_json(indent=1) + "\n", encoding="utf-8")
        draft.replace(out / FILE)
    except OSError as error:
        raise BundleError(f"{out}: cannot be written ({error.strerror})") from error
