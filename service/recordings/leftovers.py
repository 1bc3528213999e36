"""``.part`` files that a killed recorder left: each is completed as far as it can be read."""

import fcntl
import os
import shutil
from pathlib import Path

from models.errors import RecordingError
from models.signals.recording import Salvage, salvage_recording, writing
from service.recordings.catalogue import PART, SUFFIX

DAMAGED = ".damaged"
LOCK = ".lock"
_LONGEST_S = 60.0  # from the last message to the last write of the file: a recorder writes every second


def lock(folder: Path) -> int:
    """Make sure that only one recorder writes into a folder; closing the returned descriptor releases the folder.

    Raises
    ------
    RecordingError
        If another recorder writes there, or the folder cannot be written.
    """
    with writing(folder):
        descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        raise RecordingError(f"{folder}: another recorder writes here") from error
    return descriptor


def is_locked(folder: Path) -> bool:
    """Whether a recorder writes into the folder at present."""
    try:
        descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def leftovers(folder: Path, writing_now: Path | None = None) -> list[Path]:
    """Incomplete files of a folder, oldest first, without the one that is being written."""
    try:
        return sorted(path for path in folder.glob(f"*{SUFFIX}{PART}") if path != writing_now and path.is_file())
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be listed ({error.strerror or error})") from error


def recover_leftover(part: Path) -> Salvage | None:
    """Complete what a crash left; None if there is no room for the copy at present.

    ``NAME.mcap`` gets everything that can be read; ``NAME.mcap.part`` goes if no more than its unfinished end was lost,
    and is renamed to ``NAME.mcap.damaged`` otherwise.

    Raises
    ------
    RecordingError
        If nothing can be read of it, or its name is taken; the file is then renamed to ``NAME.mcap.damaged``. Also if
        the copy cannot be written; the file then stays.
    """
    target = part.with_name(part.name.removesuffix(PART))
    with writing(part):
        if shutil.disk_usage(part.parent).free < 2 * part.stat().st_size:
            return None
    try:
        salvage = salvage_recording(part, target)
    except RecordingError as error:
        if error.__cause__ is None:  # not the disk's fault: it would be the same the next time
            _set_aside(part)
        raise
    if salvage.damaged_chunks or salvage.unnamed_messages:
        _set_aside(part)
    else:
        with writing(part):
            part.unlink()
    return salvage


def loss_text(salvage: Salvage) -> str:
    """Say in a sentence what a recovery lost."""
    if salvage.complete:
        return "nothing was lost: the file had been completed, only its name was missing"
    texts = []
    if salvage.damaged_chunks:
        texts.append(f"{salvage.damaged_chunks} damaged chunks in its middle")
    if salvage.unnamed_messages:
        texts.append(f"{salvage.unnamed_messages} messages whose key stood in a damaged chunk")
    texts.append(f"{salvage.lost_bytes} bytes that cannot be read")
    if salvage.unaccounted_s < _LONGEST_S:
        texts.append(
            f"what was still in memory: the file was last written {salvage.unaccounted_s:.3f} s after its last "
            "readable message, and up to 1 s more was waiting"
        )
    else:
        texts.append(
            "what was still in memory: how much is not known, because the file was written long after the times in it, "
            "as an import or a copy is"
        )
    return "lost: " + "; ".join(texts)


def _set_aside(part: Path) -> None:
    with writing(part):
        part.replace(part.with_name(part.name.removesuffix(PART) + DAMAGED))
