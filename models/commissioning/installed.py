"""What a machine is monitored with: its file, and what was trained and commissioned for it."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from models.commissioning.commissioned import FILE, Commissioned, load_commissioned
from models.diagnosis.networks.bundle import Bundle, load_bundle
from models.errors import BundleError
from models.machine import Machine, MachineFile

__all__ = ["Installed", "install"]

_MANIFEST = "manifest.json"


@dataclass(frozen=True, slots=True)
class Installed:
    """One machine and all that its monitor knows of it.

    Attributes
    ----------
    bundle : Bundle or None
        Trained networks.
    commissioned : Commissioned or None
        What was learned on the healthy machine.
    """

    machine: MachineFile
    bundle: Bundle | None = None
    commissioned: Commissioned | None = None

    @property
    def known(self) -> Machine | None:
        """The machine with all its parameters, given or identified; None where only a baseline is known."""
        if self.commissioned is not None:
            return self.commissioned.completed(self.machine)
        return self.machine if isinstance(self.machine, Machine) else None

    @property
    def identity(self) -> str | None:
        """Changes with anything that was trained or commissioned; None where there is neither."""
        parts = [part.identity for part in (self.bundle, self.commissioned) if part is not None]
        if len(parts) < 2:
            return parts[0] if parts else None
        return hashlib.sha256(" ".join(parts).encode()).hexdigest()[:12]


def install(machine: MachineFile, bundle: str | Path | None) -> Installed:
    """Load what a machine is monitored with.

    Parameters
    ----------
    bundle : str or Path, optional
        Shipped bundle by name, or directory of a trained or commissioned one.

    Raises
    ------
    BundleError
        If it is damaged or of another machine, or if the machine's parameters are not known and it was not
        commissioned.
    """
    place = f"{machine.site}/{machine.name}"
    directory = None if bundle is None else Path(bundle)
    if directory is not None and (directory / FILE).is_file():
        commissioned = load_commissioned(directory, machine)
        known = commissioned.completed(machine)
        networks = load_bundle(directory, known) if known is not None and (directory / _MANIFEST).is_file() else None
        return Installed(machine, networks, commissioned)
    if not isinstance(machine, Machine):
        raise BundleError(
            f"{place}: its machine file does not give all parameters of the rotor, so it must be commissioned from "
            f"healthy recordings first (rotortrain commission); {_found(directory)}"
        )
    return Installed(machine, None if bundle is None else load_bundle(bundle, machine))


def _found(directory: Path | None) -> str:
    return "no bundle is named for it" if directory is None else f"{directory} is not a commissioned bundle"
