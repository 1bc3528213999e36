"""Machines to commission: finite elements, and the shipped ones with their parameters kept secret.

A subject gives healthy windows of one commissioning, which has one source of one cutoff and level, and single windows
of later days, each with a cutoff, level, noise and direction of its own. All are independent realisations, and no two
purposes share a random number.
"""

import hashlib
import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from benchmarks.finite_elements.machines import ROTORS, rotor_named
from benchmarks.finite_elements.observed import WindowSizes, machine_of, plan, sampled, windows_of
from benchmarks.finite_elements.rotor import BeamRotor
from benchmarks.finite_elements.scenes import COMMISSIONED, SceneRange, SourceLayout, drawn_condition
from models.commissioning.commissioned import KnowledgeLevel
from models.commissioning.identified import identify
from models.commissioning.levels import learned_baseline
from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.readings import Diagnosis, Diagnostician
from models.diagnosis.verdict.stretch import determined, with_shared_error
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import ConditionRange, Machine, MachineFile, load_machine
from models.signals.block import FloatArray
from simulator.training.draws import Draw, Layout, Purpose, simulate_window

SHIPPED = ("lab", "heavy", "light")
SUBJECTS: tuple[str, ...] = (*(rotor.name for rotor in ROTORS), *SHIPPED)
"""Machines of another model class first, then the shipped ones."""

_COMMISSIONED_CUTOFFS_HZ = (40.0, 160.0)
_OTHER_CUTOFF = math.log(1.25)
_SPEED_TOLERANCE = 0.01
_SETTLING_S = 0.1
_ALIKE = (1.35, 1.65)
"""Level of a rotor with cubic stiffness, within a tenth of the commissioned one: at another level its stiffness is
another one, which is no fault and no error of reading."""
_GEOMETRY = ("m1_kg", "m2_kg", "I2_kg_m2", "I2p_kg_m2", "shaft_length_m", "shaft_diameter_m", "shaft_E_Pa")


def subject_named(name: str) -> "Shipped | Beam":
    """Look a machine of `SUBJECTS` up; a KeyError if it is not among them."""
    return Shipped(load_machine(name)) if name in SHIPPED else Beam(rotor_named(name))


@dataclass(frozen=True, slots=True)
class _Compared:
    """Windows compared with a machine's theory, each from a cold start: no two share their condition."""

    machine: Machine
    shared: FloatArray | None

    @property
    def by(self) -> str:
        return "likelihood"

    def diagnose(self, window: WindowStatistics) -> Diagnosis:
        read = determined(LikelihoodFit(self.machine).diagnose(window), window, self.machine.window.length_s)
        return read if self.shared is None else with_shared_error(read, self.shared)


@lru_cache(maxsize=2)
def commissioned(
    name: str, level: KnowledgeLevel, seed: int, number: int, healthy: int
) -> tuple[Diagnostician | str, tuple[WindowStatistics, ...]]:
    """Commission a subject on healthy windows of one recording with what its file tells; or why that cannot be."""
    subject = subject_named(name)
    file, windows = subject.file(level), subject.healthy(seed, number, healthy)
    assert file is not None  # noqa: S101  # no cell asks for a level that a subject has no file of
    try:
        if level is KnowledgeLevel.NONE:
            return BaselineDiagnostician(learned_baseline(windows, ["recording 1"] * healthy)), windows
        if isinstance(file, Machine):
            return _Compared(file, None), windows
        identified = identify(file, windows)
        return _Compared(identified.machine, identified.covariance), windows
    except EstimationError as error:
        return f"not commissioned: {error}", windows


def _generator(name: str, seed: int, commissioning: int, *which: int) -> np.random.Generator:
    """Random numbers of a commissioning (1, ...) or of a window of a later day (2, ...)."""
    own = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big")
    return np.random.default_rng([seed, own, commissioning, *which])


def _commissioned_cutoff(name: str, seed: int, commissioning: int) -> float:
    low, high = np.log(_COMMISSIONED_CUTOFFS_HZ)
    return float(np.exp(_generator(name, seed, commissioning, 1, 1).uniform(low, high)))


def _other_cutoff(limits: tuple[float, float], commissioned: float, rng: np.random.Generator) -> float:
    """A cutoff that is at least a quarter off the commissioned one."""
    while True:
        cutoff_hz = float(rng.uniform(*limits))
        if abs(math.log(cutoff_hz / commissioned)) > _OTHER_CUTOFF:
            return cutoff_hz


@dataclass(frozen=True, slots=True)
class Beam:
    """A rotor of finite elements; it has a machine file at level none alone."""

    rotor: BeamRotor

    def file(self, level: KnowledgeLevel) -> MachineFile | None:
        """Machine file at a level of knowledge; None where there is none."""
        return machine_of(self.rotor, WindowSizes()) if level is KnowledgeLevel.NONE else None

    def healthy(self, seed: int, commissioning: int, count: int) -> tuple[WindowStatistics, ...]:
        """Windows of 60 s of one commissioning, which do not overlap."""
        cutoff_hz = _commissioned_cutoff(self.rotor.name, seed, commissioning)
        rng = _generator(self.rotor.name, seed, commissioning, 1)
        limits = replace(COMMISSIONED, cutoff_hz=(cutoff_hz, cutoff_hz))
        return self._windows(SourceLayout.ONE_SOURCE, limits, {}, rng, count)

    def later(
        self, seed: int, commissioning: int, cell: int, number: int, changes: dict[str, float]
    ) -> tuple[WindowStatistics, float]:
        """One window of 60 s, and the cutoff of its excitation, Hz."""
        rng = _generator(self.rotor.name, seed, commissioning, 2, cell, number)
        other = _commissioned_cutoff(self.rotor.name, seed, commissioning)
        cutoff_hz = _other_cutoff(SceneRange().cutoff_hz, other, rng)
        layout = SourceLayout.INDEPENDENT if number % 2 else SourceLayout.ONE_SOURCE
        limits = replace(SceneRange(), cutoff_hz=(cutoff_hz, cutoff_hz))
        if not self.rotor.linear:
            limits = replace(limits, stochastic_to_1x=_ALIKE)
        return self._windows(layout, limits, changes, rng, 1)[0], cutoff_hz

    def _windows(
        self, layout: SourceLayout, limits: SceneRange, changes: dict[str, float], rng: np.random.Generator, count: int
    ) -> tuple[WindowStatistics, ...]:
        condition = drawn_condition(self.rotor, layout, limits, changes, rng)
        sizes = plan(self.rotor, WindowSizes())
        duration_s = (sizes.preamble + count * sizes.hops * sizes.hop) / sizes.rate_hz + _SETTLING_S
        return tuple(windows_of(sampled(self.rotor, condition, duration_s, int(rng.integers(2**62))), sizes)[:count])


@dataclass(frozen=True, slots=True)
class Shipped:
    """A shipped machine, in windows of 60 s."""

    machine: Machine

    def file(self, level: KnowledgeLevel) -> MachineFile | None:
        """Machine file at a level of knowledge; None where there is none."""
        machine = _within(self.machine, self.machine.condition)
        if level is KnowledgeLevel.FULL:
            return machine
        content = machine.model_dump(mode="json", exclude={"rotor", "operation", "condition"})
        if level is KnowledgeLevel.PARTIAL:
            content["rotor"] = machine.rotor.model_dump(include=set(_GEOMETRY))
        return MachineFile.model_validate(content)

    def healthy(self, seed: int, commissioning: int, count: int) -> tuple[WindowStatistics, ...]:
        """Windows of 60 s of one commissioning, which do not overlap."""
        cutoff_hz = _commissioned_cutoff(self.machine.name, seed, commissioning)
        rng = _generator(self.machine.name, seed, commissioning, 1)
        limits = ConditionRange(
            cutoff_hz=(cutoff_hz, cutoff_hz), stochastic_to_1x=(1.5, 1.5), noise_relative=(0.02, 0.02)
        )
        machine, own = _within(self.machine, limits), int(rng.integers(2**62))
        draw = Draw(machine, own, Purpose.TRAINING, layout=Layout.ONE_SOURCE, fixed_condition=True)
        return tuple(simulate_window(draw, number) for number in range(1, count + 1))

    def later(
        self, seed: int, commissioning: int, cell: int, number: int, changes: dict[str, float]
    ) -> tuple[WindowStatistics, float]:
        """One window of 60 s, and the cutoff of its excitation, Hz."""
        rng = _generator(self.machine.name, seed, commissioning, 2, cell, number)
        own, other = self.machine.condition, _commissioned_cutoff(self.machine.name, seed, commissioning)
        cutoff_hz = _other_cutoff(own.cutoff_hz, other, rng)
        machine = _within(self.machine, own.model_copy(update={"cutoff_hz": (cutoff_hz, cutoff_hz)}))
        own_seed, layout = int(rng.integers(2**62)), Layout(number % 2)
        draw = Draw(machine, own_seed, Purpose.EVALUATION, faults=changes, layout=layout)
        return simulate_window(draw, number), cutoff_hz


def _within(machine: Machine, limits: ConditionRange) -> Machine:
    """The machine in windows of 60 s, at its commissioned speed, with other ranges of the condition."""
    window = machine.window.model_copy(update={"length_s": 60.0, "max_span_s": 90.0})
    operation = machine.operation.model_copy(update={"speed_tolerance": _SPEED_TOLERANCE})
    return machine.model_copy(update={"window": window, "operation": operation, "condition": limits})
