"""Which machine file and trained networks a recording is evaluated with."""

from importlib.resources import files
from pathlib import Path

from models.commissioning.commissioned import Installed, install
from models.errors import MachineFileError
from models.machine import MachineFile, load_machine_file
from models.mistakes import changed, checked, parse_toml
from models.signals.keys import MachineKeys

_LONGEST_LINE = 500


def choose_machine(keys: MachineKeys, wanted: str | None, changes: str = "") -> Installed:
    """Load the machine file, and what was trained or commissioned, for a recorded machine.

    `wanted` is ``FILE`` or ``FILE@BUNDLE``, shipped names or paths. Without it, the shipped machine with the recorded
    site and name is taken, with its shipped networks. `changes` are TOML that overrides fields of the machine file.

    Raises
    ------
    MachineFileError
        If the file cannot be used, or none was named and no shipped machine fits.
    BundleError
        If the bundle cannot be used, or the machine needs one that was commissioned.
    """
    if wanted is not None:
        before, found, name = wanted.partition(".toml@")  # the name of a folder may hold an @ as well
        if found or before.endswith(".toml"):
            file = before + found.removesuffix("@")
        else:
            file, _, name = wanted.partition("@")
        return install(load_machine_file(file, changes), name or None)
    for path in _shipped_files():
        machine = load_machine_file(path)
        if (machine.site, machine.name) == (keys.site, keys.machine):
            return install(load_machine_file(path, changes), path.stem if is_shipped_bundle(path.stem) else None)
    shipped = ", ".join(path.stem for path in _shipped_files())
    raise MachineFileError(
        f"the recording is of {keys.site}/{keys.machine}, and none of the shipped machines ({shipped}) has this site "
        "and name: name its machine file, as --machine FILE or --machine FILE@BUNDLE"
    )


def check_sent(text: str, changes: str, recorded: str) -> None:
    """Check the text of a machine file that is to be used for a recorded machine.

    Raises
    ------
    MachineFileError
        Naming the field, the value found and what was expected; also if it is of another machine than ``site/name``.
    """
    place = "machine_file"
    for number, line in enumerate(text.splitlines(), start=1):
        if len(line) > _LONGEST_LINE:  # reading it may take long: as the square of the length
            raise MachineFileError(
                f"{place}: line {number} has {len(line)} characters, at most {_LONGEST_LINE} are read"
            )
    machine = checked(MachineFile, changed(parse_toml(text, place), changes), place)
    if machine.title != recorded:
        raise MachineFileError(f"{place}: of {machine.title}, the recordings are of {recorded}")


def is_shipped_machine(name: str) -> bool:
    """Whether a machine file of this name is shipped."""
    return name in {path.stem for path in _shipped_files()}


def is_shipped_bundle(name: str) -> bool:
    """Whether trained networks of this name are shipped."""
    folder = Path(str(files("models"))) / "bundles"
    return name in {path.name for path in folder.iterdir() if (path / "manifest.json").is_file()}


def _shipped_files() -> list[Path]:
    return sorted((Path(str(files("models"))) / "machines").glob("*.toml"))
