"""What a machine is monitored with: its machine file, and the bundle learned on the healthy machine, as JSON.

::

    my-machine/
    ├── commissioned.json     this file: level, conditions, baseline or identified rotor, references of the sensors
    ├── manifest.json         networks trained for the machine, if its parameters are known (optional)
    ├── weights.safetensors
    ├── report.html           for people
    └── report.json           the same figures for programs

A commissioning never changes: a new one is a new version, which names the one that it replaces, and why.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator

from models.diagnosis.baseline.rows import evaluable_rows
from models.diagnosis.baseline.stored import Baseline
from models.diagnosis.misfit import HealthyMisfit
from models.diagnosis.modes import HealthyModes
from models.diagnosis.networks.bundle import MANIFEST, Bundle, load_bundle
from models.diagnosis.sensors.reference import Naming, SensorReference
from models.diagnosis.shape import HealthyShape
from models.diagnosis.window.excluded import KnownLine
from models.diagnosis.window.moments import states_of
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import BundleError
from models.levels.reference import LevelReference
from models.machine import Machine, MachineFile
from models.mistakes import mistakes
from models.physics.rotor import PARAMETERS
from models.signals.block import FloatArray

# Fields of masses and shaft, which cannot be identified together with stiffness and damping.
_GEOMETRY = ("m1_kg", "m2_kg", "I2_kg_m2", "I2p_kg_m2", "shaft_length_m", "shaft_diameter_m", "shaft_E_Pa")


class KnowledgeLevel(StrEnum):
    """How much of a machine's physics its machine file gives."""

    FULL = "full"
    PARTIAL = "partial"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Knowledge:
    """Knowledge level of a machine, and the reason for it."""

    level: KnowledgeLevel
    text: str  # reason, in a sentence


def knowledge_of(machine: MachineFile) -> Knowledge:
    """Determine the knowledge level that a machine file allows.

    Examples
    --------
    >>> from models.machine import load_machine_file
    >>> knowledge_of(load_machine_file("lab")).level.value
    'full'
    """
    rotor, level = machine.rotor, KnowledgeLevel.NONE
    if not states_of(machine):
        lacks = "no channel is at bearing or disc, in y or z" if machine.holds_band else "snapshots are too short"
        text = f"{lacks}: vibration levels are learned, and nothing is diagnosed"
    elif isinstance(machine, Machine):
        level, text = KnowledgeLevel.FULL, "the machine file gives all parameters of the rotor"
    elif rotor is None:
        text = "the machine file has no [rotor]: everything is learned from the recordings"
        if all(reason for _, reason in evaluable_rows(states_of(machine), has_phase_reference=True)):
            text = (
                "the machine file has no [rotor], and these sensors allow no equation: no part is diagnosed, each "
                "channel is only compared with its own healthy form"
            )
    elif lacking := [name for name in _GEOMETRY if name in rotor.unknown]:
        text = (
            f"[rotor] lacks {', '.join(lacking)}: without masses and shaft it cannot be used at all, and everything is "
            "learned from the recordings"
        )
    elif rotor.unknown:
        level, names = KnowledgeLevel.PARTIAL, ", ".join(rotor.unknown)
        text = f"[rotor] gives masses and shaft; stiffness, damping and unbalance are identified, as it lacks {names}"
    else:
        tables = [f"[{name}]" for name in ("operation", "condition") if getattr(machine, name) is None]
        level = KnowledgeLevel.PARTIAL
        text = (
            f"[rotor] is complete, but without {' and '.join(tables)} nothing can be simulated: stiffness, damping and "
            "unbalance are identified from the recordings"
        )
    return Knowledge(level, text)


_RPM = 30 / np.pi
SPEED_MARGIN = 0.05  # relations do not depend on the speed, but a bearing's oil film and the unbalance response do
# Random vibration this many times below or above the commissioned range is another regime: a stopped drive, a loose
# mounting, a bearing lifted through its clearance.
LEVEL_MARGIN = 10.0
_Positive = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class OperatingRange(BaseModel, extra="forbid", frozen=True):
    """Speeds and levels of random vibration in the healthy windows."""

    speed_rpm: tuple[_Positive, _Positive] | None = Field(
        default=None, description="slowest and fastest mean speed of a window; none without a speed"
    )
    rms: dict[str, tuple[_Positive, _Positive]] = Field(
        description="measured state to the smallest and largest rms of its random part in a window, SI"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name, (low, high) in (("speed_rpm", self.speed_rpm or (0.0, 0.0)), *self.rms.items()):
            if low > high:
                raise ValueError(f"{name} is ({low}, {high}), expected from ≤ to")
        return self

    @classmethod
    def of(cls, windows: Sequence[WindowStatistics]) -> "OperatingRange":
        """Range of healthy windows."""
        speeds = [window.speed_rad_s * _RPM for window in windows if np.isfinite(window.speed_rad_s)]
        rms = np.array([_rms(window) for window in windows])
        ranges = zip(rms.min(axis=0).tolist(), rms.max(axis=0).tolist(), strict=True)
        of_states = dict(zip(windows[0].states, ranges, strict=True))
        return cls(speed_rpm=(min(speeds), max(speeds)) if speeds else None, rms=of_states)

    def outside(self, window: WindowStatistics, naming: Naming) -> str:
        """Why a window is outside the commissioned conditions; empty if it is inside."""
        if self.speed_rpm is not None and np.isfinite(window.speed_rad_s):
            low, high = self.speed_rpm
            rpm = window.speed_rad_s * _RPM
            if not low * (1 - SPEED_MARGIN) <= rpm <= high * (1 + SPEED_MARGIN):
                seen = f"{low:.0f} rpm" if f"{low:.0f}" == f"{high:.0f}" else f"{low:.0f} to {high:.0f} rpm"
                return f"speed is {rpm:.0f} rpm, commissioned at {seen} ± {SPEED_MARGIN:.0%}"
        for name, value in zip(window.states, _rms(window).tolist(), strict=True):
            if name not in self.rms:
                continue
            low, high = self.rms[name]
            if not low / LEVEL_MARGIN <= value <= high * LEVEL_MARGIN:
                found, least, most = (naming.value(name, each) for each in (value, low, high))
                return (
                    f"random vibration of {naming.name(name)} is {found} rms, commissioned at {least} to {most}, and "
                    f"up to {LEVEL_MARGIN:g} times less or more"
                )
        return ""


def _rms(window: WindowStatistics) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.sqrt(np.maximum(np.diag(window.correlation[0]), 0.0))


FILE = "commissioned.json"
_Finite = Annotated[float, Field(allow_inf_nan=False)]
_DESCRIBED = {"sensors", "rate_hz", "window", "rotor", "operation", "condition", "schedule"}
Gyroscopic = Literal["Eq. 27", "opposite"]


class HealthyEntry(BaseModel, extra="forbid", frozen=True):
    """One healthy recording that was used."""

    name: str
    sha256: str = Field(description="of the file")
    start_ns: int = Field(description="time of the first sample used")
    end_ns: int
    used_s: float = Field(gt=0, description="data without gaps and refused blocks")
    gaps: int = Field(ge=0)


class IdentifiedRecord(BaseModel, extra="forbid", frozen=True):
    """A rotor whose stiffness, damping and unbalance were identified."""

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


class ConditionBaseline(BaseModel, extra="forbid", frozen=True):
    """A baseline and the conditions it was learned in."""

    conditions: OperatingRange
    baseline: Baseline

    @field_validator("baseline")
    @classmethod
    def _can_be_read_back(cls, baseline: Baseline) -> Baseline:
        """Refuse numbers that are not finite: those of a baseline that has just been learned are not checked before."""
        return Baseline.model_validate_json(json.dumps(baseline.model_dump()))


class Commissioned(BaseModel, extra="forbid", frozen=True):
    """Everything that a machine's monitor compares later data with."""

    format: Literal[1] = 1
    site: str
    machine: str
    described: dict[str, Any] = Field(description="the parts of the machine file it holds for")
    level: KnowledgeLevel
    version: int = Field(ge=1)
    replaces: str | None = Field(default=None, description="identity of the version before")
    why: str = Field(default="", description="why it was commissioned again")
    recordings: tuple[HealthyEntry, ...] = Field(min_length=1)
    conditions: OperatingRange
    identified: IdentifiedRecord | None = Field(
        default=None, description="level partial; level full without a shaft angle, of the unbalance alone"
    )
    # Not stored if None, so that bundles made without it keep their identity.
    misfit: HealthyMisfit | None = Field(
        default=None,
        exclude_if=lambda found: found is None,
        description="levels full and partial: of the healthy windows",
    )
    gyroscopic: Gyroscopic = Field(
        default="Eq. 27",
        exclude_if=lambda found: found == "Eq. 27",
        description="levels full and partial: sense of the gyroscopic moments",
    )
    lines: tuple[KnownLine, ...] = Field(
        default=(),
        exclude_if=lambda found: not found,
        description="steady lines of the healthy windows, which neither theory nor a relation explains; of an earlier "
        "version at levels full and partial alone",
    )
    baselines: tuple[ConditionBaseline, ...] = Field(
        default=(), description="level none: one for all conditions, or one for each speed where they differ"
    )
    shape: HealthyShape | None = Field(default=None, description="where no equation can be evaluated, or beside it")
    modes: HealthyModes | None = Field(
        default=None,
        exclude_if=lambda found: found is None,
        description="level none: where the stiffness of a plane is read badly or not at all",
    )
    sensors: SensorReference | None = None
    levels: LevelReference | None = Field(default=None, description="vibration levels of the healthy machine")

    @model_validator(mode="after")
    def _of_its_level(self) -> Self:
        if self.level is KnowledgeLevel.PARTIAL and self.identified is None:
            raise ValueError("level is partial, but there is no identified rotor")
        if self.level is KnowledgeLevel.NONE and not self.baselines and self.shape is None and self.levels is None:
            raise ValueError("level is none, but there is neither a baseline, nor a healthy shape, nor levels")
        return self

    @property
    def identity(self) -> str:
        """Twelve hexadecimal digits that change with any content."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:12]

    def completed(self, machine: MachineFile) -> Machine | None:
        """The machine with its identified parameters filled in; None at level none."""
        if self.identified is None:
            return machine if isinstance(machine, Machine) and self.level is KnowledgeLevel.FULL else None
        return Machine.model_validate(machine.model_dump(mode="json") | self.identified.machine)


def in_sense(machine: Machine, sense: Gyroscopic) -> Machine:
    """The machine with gyroscopic moments of this sense: the opposite one is a negative polar moment of inertia.

    In the sense of Eq. (27), as interpreted here, natural frequencies of forward whirl fall with the speed, whereas
    those of a real rotor rise; see ``docs/decisions/0049-the-sense-of-the-gyroscopic-moments.md``.
    """
    if sense == "Eq. 27":
        return machine
    rotor = machine.rotor.model_copy(update={"I2p_kg_m2": -machine.rotor.I2p_kg_m2})
    return machine.model_copy(update={"rotor": rotor})


def described(machine: MachineFile) -> dict[str, Any]:
    """The parts of a machine file that must not change after commissioning, as plain JSON."""
    return machine.model_dump(mode="json", include=_DESCRIBED)


def load_commissioned(directory: Path, machine: MachineFile, *, same_description: bool = True) -> Commissioned:
    """Load a commissioned bundle and check that it belongs to a machine.

    With `same_description`, channels, window and physics must be the same as when it was commissioned.

    Raises
    ------
    BundleError
        If it is missing, damaged, or does not fit the machine; the message says what is wrong.
    """
    path = directory / FILE
    try:
        found = Commissioned.model_validate_json(path.read_bytes())
    except OSError as error:
        raise BundleError(f"{path}: not a commissioned bundle: {error.strerror}") from error
    except ValidationError as error:
        # A program has written it: where a field might belong instead is of no use, nor is the same of every channel.
        unknown = [one["loc"] for one in error.errors() if one["type"] == "extra_forbidden"]
        if unknown:
            raise BundleError(
                f"{path}: of another version of the program, which knew {'.'.join(map(str, unknown[0]))}: use the "
                "version that commissioned the machine, or a newer one, or commission it again"
            ) from error
        told = "; ".join(text for _, text in mistakes(error, Commissioned))
        raise BundleError(f"{path}: damaged, or of another version: {told}") from error
    if (found.site, found.machine) != (machine.site, machine.name):
        raise BundleError(f"{path}: commissioned for {found.site}/{found.machine}, not for {machine.title}")
    now = described(machine)
    different = [name for name in sorted(now) if now[name] != found.described.get(name)]
    if same_description and different:
        left_out = " (what [window] leaves out may be chosen otherwise since)"
        raise BundleError(
            f"{path}: {', '.join(different)} in the machine file of {machine.title} differ from what was "
            f"commissioned{left_out if 'window' in different else ''}: commission the machine again"
        )
    return found


@dataclass(frozen=True, slots=True)
class Installed:
    """A machine file with all that was trained or commissioned for the machine."""

    machine: MachineFile
    bundle: Bundle | None = None  # trained networks
    commissioned: Commissioned | None = None  # references learned on the healthy machine

    @property
    def known(self) -> Machine | None:
        """The machine with all its parameters, given or identified; None if it lacks some or has only levels."""
        if not states_of(self.machine):
            return None
        if self.commissioned is not None:
            known = self.commissioned.completed(self.machine)
            return None if known is None else in_sense(known, self.commissioned.gyroscopic)
        return self.machine if isinstance(self.machine, Machine) else None

    @property
    def watching(self) -> bool:
        """Whether only levels can be watched, because the machine is neither known nor commissioned."""
        return self.commissioned is None and self.known is None

    @property
    def thorough(self) -> bool:
        """Whether the healthy machine's signs of contact, or its lines, are known, so that new ones can be detected."""
        if self.commissioned is None:
            return self.known is not None  # by theory
        levels = self.commissioned.levels
        return levels is not None and any(state.contact or state.lines for state in levels.states)

    @property
    def lines(self) -> tuple[KnownLine, ...]:
        """Lines of the healthy machine that theory does not explain."""
        return () if self.commissioned is None else self.commissioned.lines

    @property
    def identity(self) -> str | None:
        """Hexadecimal digits that change with anything trained or commissioned; None if there is neither."""
        parts = [part.identity for part in (self.bundle, self.commissioned) if part is not None]
        if len(parts) < 2:
            return parts[0] if parts else None
        return hashlib.sha256(" ".join(parts).encode()).hexdigest()[:12]


def install(machine: MachineFile, bundle: str | Path | None) -> Installed:
    """Load what a machine is monitored with; if it is neither known nor commissioned, only its levels are watched.

    The bundle is a shipped one by its name, or the directory of a trained or commissioned one.

    Raises
    ------
    BundleError
        If it is damaged or of another machine.
    """
    directory = None if bundle is None else Path(bundle)
    if directory is not None and (directory / FILE).is_file():
        commissioned = load_commissioned(directory, machine)
        known = commissioned.completed(machine)
        networks = load_bundle(directory, known) if known is not None and (directory / MANIFEST).is_file() else None
        return Installed(machine, networks, commissioned)
    if directory is None:
        return Installed(machine)
    if (directory / "report.json").is_file() and not (directory / MANIFEST).is_file():
        raise BundleError(f"{directory}: this commissioning was refused; {directory / 'report.html'} says why")
    if not isinstance(machine, Machine):
        what = "is not a commissioned bundle" if directory.is_dir() else "is no folder, expected a commissioned bundle"
        raise BundleError(
            f"{machine.title}: {directory} {what}; its machine file does not give all parameters of the rotor, which a "
            "trained one needs; commission it from healthy recordings (rotortrain commission), or name no bundle: then "
            "its vibration levels are watched"
        )
    return Installed(machine, load_bundle(directory, machine))
