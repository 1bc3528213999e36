"""The commissioned bundle: what was learned on a healthy machine, in one JSON file. No code in it, no pickle.

::

    my-machine/
    ├── commissioned.json     this file: level, conditions, baseline or identified rotor, references of the sensors
    ├── manifest.json         networks trained for the machine, where its parameters are known (optional)
    ├── weights.safetensors
    ├── report.html           for people
    └── report.json           the same figures for programs

A commissioning is frozen: another one is another version, which names what it replaces and why.
"""

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from models.commissioning.conditions import OperatingRange
from models.commissioning.knowledge import KnowledgeLevel
from models.diagnosis.baseline.stored import BaselineRecord
from models.diagnosis.fallback.shape import HealthyShape
from models.diagnosis.sensors.reference import SensorReference
from models.errors import BundleError
from models.machine import Machine, MachineFile
from models.mistakes import mistakes
from models.physics.parameters import PARAMETERS
from models.signals.block import FloatArray

__all__ = [
    "FILE",
    "Commissioned",
    "ConditionBaseline",
    "IdentifiedRecord",
    "RecordingEntry",
    "described",
    "load_commissioned",
]

FILE = "commissioned.json"
_STRICT = ConfigDict(extra="forbid", frozen=True)
_Finite = Annotated[float, Field(allow_inf_nan=False)]
_DESCRIBED = {"sensors", "rate_hz", "window", "rotor", "operation", "condition"}


class RecordingEntry(BaseModel):
    """One healthy recording that was used."""

    model_config = _STRICT

    name: str
    sha256: str = Field(description="of the file")
    start_ns: int = Field(description="time of the first sample used")
    end_ns: int
    used_s: float = Field(gt=0, description="data without gaps and refused blocks")
    gaps: int = Field(ge=0)


class IdentifiedRecord(BaseModel):
    """A rotor whose stiffness, damping and unbalance were identified."""

    model_config = _STRICT

    machine: dict[str, Any] = Field(description="rotor, operation and condition as in a machine file")
    names: tuple[str, ...] = Field(description="parameters that were identified")
    covariance: tuple[tuple[_Finite, ...], ...] = Field(description="shared by all later readings, of all parameters")

    @model_validator(mode="after")
    def _square(self) -> Self:
        n = len(PARAMETERS)
        if len(self.covariance) != n or any(len(row) != n for row in self.covariance):
            raise ValueError(f"covariance is not {n} by {n}")
        unknown = set(self.names) - set(PARAMETERS)
        if unknown:
            raise ValueError(f"names {sorted(unknown)} are not among {', '.join(PARAMETERS)}")
        return self

    def matrix(self) -> FloatArray:
        """`covariance` as an array, shape (6, 6)."""
        return np.array(self.covariance, dtype=np.float64)


class ConditionBaseline(BaseModel):
    """A baseline and the conditions it was learned in."""

    model_config = _STRICT

    conditions: OperatingRange
    baseline: BaselineRecord


class Commissioned(BaseModel):
    """What a machine's monitor compares later data with."""

    model_config = _STRICT

    format: Literal[1] = 1
    site: str
    machine: str
    described: dict[str, Any] = Field(description="the parts of the machine file it holds for")
    level: KnowledgeLevel
    version: int = Field(ge=1)
    replaces: str | None = Field(default=None, description="identity of the version before")
    why: str = Field(default="", description="why it was commissioned again")
    recordings: tuple[RecordingEntry, ...] = Field(min_length=1)
    conditions: OperatingRange
    identified: IdentifiedRecord | None = Field(default=None, description="level partial")
    baselines: tuple[ConditionBaseline, ...] = Field(
        default=(), description="level none: one for all conditions, or one for each speed where they differ"
    )
    shape: HealthyShape | None = Field(default=None, description="where no equation can be evaluated, or beside it")
    sensors: SensorReference | None = None

    @model_validator(mode="after")
    def _of_its_level(self) -> Self:
        if self.level is KnowledgeLevel.PARTIAL and self.identified is None:
            raise ValueError("level is partial, but there is no identified rotor")
        if self.level is KnowledgeLevel.NONE and not self.baselines and self.shape is None:
            raise ValueError("level is none, but there is neither a baseline nor a healthy shape")
        return self

    @property
    def identity(self) -> str:
        """Twelve hexadecimal digits that change with anything in it."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:12]

    def completed(self, machine: MachineFile) -> Machine | None:
        """The machine with its identified parameters filled in; None where nothing but a baseline is known."""
        if isinstance(machine, Machine) and self.level is KnowledgeLevel.FULL:
            return machine
        if self.identified is None:
            return None
        return Machine.model_validate(machine.model_dump(mode="json") | self.identified.machine)


def described(machine: MachineFile) -> dict[str, Any]:
    """The parts of a machine file that a commissioning holds for, as plain JSON."""
    return json.loads(json.dumps(machine.model_dump(mode="json", include=_DESCRIBED)))  # type: ignore[no-any-return]


def load_commissioned(directory: Path, machine: MachineFile, *, same_description: bool = True) -> Commissioned:
    """Load what was commissioned and check that it belongs to a machine.

    Parameters
    ----------
    directory : Path
        The bundle.
    same_description : bool
        Whether channels, window and physics must be as they were.

    Raises
    ------
    BundleError
        Naming what is missing, damaged or different.
    """
    path = directory / FILE
    try:
        found = Commissioned.model_validate_json(path.read_bytes())
    except OSError as error:
        raise BundleError(f"{path}: not a commissioned bundle: {error.strerror}") from error
    except ValidationError as error:
        told = "; ".join(text for _, text in mistakes(error, Commissioned))
        raise BundleError(f"{path}: damaged, or of another version: {told}") from error
    if (found.site, found.machine) != (machine.site, machine.name):
        raise BundleError(
            f"{path}: commissioned for {found.site}/{found.machine}, not for {machine.site}/{machine.name}"
        )
    now = described(machine)
    different = [name for name in sorted(now) if now[name] != found.described.get(name)]
    if same_description and different:
        raise BundleError(
            f"{path}: {', '.join(different)} in the machine file of {machine.site}/{machine.name} differ from what was "
            "commissioned: commission the machine again"
        )
    return found
