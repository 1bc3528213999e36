"""What ``rotortrain commission`` does: read healthy recordings, learn, train where it can, write the bundle."""

import hashlib
import shutil
from collections.abc import Sequence
from pathlib import Path

import typer

from models.commissioning.commission import Commissioning, commission
from models.commissioning.commissioned import FILE, Commissioned, RecordingEntry, load_commissioned
from models.commissioning.healthy import HealthyRecording, read_healthy
from models.errors import BundleError, MachineFileError
from models.machine import MachineFile, load_machine_file
from simulator.commission.console import print_report
from simulator.commission.page import write_report
from simulator.training.progress import labelled_bars

__all__ = ["commission_machine"]

_KEPT = "commissioned-{version}.json"


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
    """Commission a machine and write its bundle.

    Parameters
    ----------
    name : str
        Machine file.
    healthy : sequence of Path
        Recordings.
    out : Path
        Directory of the bundle.
    first_s : float, optional
        Use only the first seconds of every recording.
    wished : float, optional
        Relative change that shall be found.
    why : str
        Why the machine is commissioned again; needed where `out` holds a commissioning already.
    networks : bool
        Whether to train networks, too, where the parameters are known.
    n_windows, n_draws, seed, processes
        For training.

    Returns
    -------
    bool
        Whether the machine was commissioned; if not, the report says why.

    Raises
    ------
    RotorwatchError
        If machine file, recordings or directory cannot be used.
    """
    machine = load_machine_file(name)
    _check_names(healthy)
    replaces = _before(out, machine, why)
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
        typer.echo(f"bundle: {out}   (rotorwatch replay REC --offline --machine {name}@{out})")
    return made.commissioned is not None


def _check_names(paths: Sequence[Path]) -> None:
    """Recordings are told apart by their file names, in the report and in the bundle."""
    names = [path.name for path in paths]
    for path in paths:
        if names.count(path.name) > 1:
            raise MachineFileError(f"--healthy {path}: two recordings are called {path.name}, expected different names")


def _before(out: Path, machine: MachineFile, why: str) -> Commissioned | None:
    """The commissioning that is replaced; replacing one is said, never by accident."""
    if not (out / FILE).is_file():
        return None
    try:
        before = load_commissioned(out, machine, same_description=False)
    except BundleError as error:
        raise BundleError(f"{error}; give another directory with --out") from error
    if not why:
        raise MachineFileError(
            f"{out} holds version {before.version} of the commissioning of {before.site}/{before.machine}: say why it "
            'is replaced, as --why "bearing exchanged", or give another directory with --out'
        )
    return before


def _entry(path: Path, recording: HealthyRecording) -> RecordingEntry:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    hops = recording.hops
    return RecordingEntry(
        name=path.name,
        sha256=digest,
        start_ns=hops[0].start_ns,
        end_ns=hops[-1].end_ns,
        used_s=recording.duration_s,
        gaps=recording.gaps,
    )


def _write(out: Path, made: Commissioning, replaces: Commissioned | None) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        if made.commissioned is None:
            return
        if replaces is not None:
            shutil.copyfile(out / FILE, out / _KEPT.format(version=replaces.version))
        (out / FILE).write_text(made.commissioned.model_dump_json(indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise BundleError(f"{out}: cannot be written ({error.strerror})") from error
