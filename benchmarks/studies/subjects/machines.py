"""Machines to commission: finite-element rotors, and the shipped machines with or without their parameters.

A subject provides healthy windows of a commissioning, with one source of one cutoff and level, and single windows of
later days, each with its own cutoff, level, noise and direction. All are independent realisations with independent
random numbers.
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
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.machine import ConditionRange, Machine, MachineFile, load_machine
from models.signals.block import FloatArray
from simulator.training.draws import Draw, Layout, Purpose, simulate_window

SHIPPED = ("lab", "heavy", "light")
SUBJECTS: tuple[str, ...] = (*(rotor.name for rotor in ROTORS), *SHIPPED)
"""Machines of another model class first, then the shipped ones."""

_OTHER_CUTOFF = math.log(1.25)
_SETTLING_S = 0.1
ALIKE = (1.35, 1.65)
"""Excitation level within 10 % of the commissioned one: at another level a rotor with cubic stiffness has another
stiffness, which is neither a fault nor a reading error, and levels would rightly alarm."""
_GEOMETRY = ("m1_kg", "m2_kg", "I2_kg_m2", "I2p_kg_m2", "shaft_length_m", "shaft_diameter_m", "shaft_E_Pa")


def commissioned_cutoff_hz(rng: np.random.Generator) -> float:
    """Draw the cutoff of the excitation during commissioning, Hz."""
    return float(np.exp(rng.uniform(np.log(40.0), np.log(160.0))))


def in_condition(machine: Machine, limits: ConditionRange) -> Machine:
    """The machine at its commissioned speed (within 1 %), with other ranges of the condition."""
    operation = machine.operation.model_copy(update={"speed_tolerance": 0.01})
    return machine.model_copy(update={"operation": operation, "condition": limits})


def in_one_condition(machine: Machine, cutoff_hz: float, level: tuple[float, float] = ALIKE) -> Machine:
    """The machine in one condition with a fixed cutoff, as during commissioning."""
    noise = (0.02, 0.02)
    limits = ConditionRange(cutoff_hz=(cutoff_hz, cutoff_hz), stochastic_to_1x=level, noise_relative=noise)
    return in_condition(machine, limits)


def drawn_in_one_condition(machine: Machine, rng: np.random.Generator, at: int) -> Draw:
    """Streams in one condition of a commissioning: one source if `at` is even, independent sources if odd."""
    drawn = in_one_condition(machine, commissioned_cutoff_hz(rng))
    own = int(rng.integers(2**62))
    return Draw(drawn, own, Purpose.EVALUATION, layout=Layout(at % 2), fixed_condition=True)


def without_parameters(machine: Machine, level: KnowledgeLevel = KnowledgeLevel.NONE) -> MachineFile:
    """The machine's file at knowledge level none or partial."""
    content = machine.model_dump(mode="json", exclude={"rotor", "operation", "condition"})
    if level is KnowledgeLevel.PARTIAL:
        content["rotor"] = machine.rotor.model_dump(include=set(_GEOMETRY))
    return MachineFile.model_validate(content)


@dataclass(frozen=True, slots=True)
class StudiedMachine:
    """A finite-element or shipped machine to commission, and non-overlapping windows of 60 s."""

    rotor: BeamRotor | Machine

    def file(self, level: KnowledgeLevel) -> MachineFile | None:
        """Machine file at a knowledge level; None if there is none: finite-element rotors only have level none."""
        if isinstance(self.rotor, BeamRotor):
            return machine_of(self.rotor, WindowSizes()) if level is KnowledgeLevel.NONE else None
        if level is KnowledgeLevel.FULL:
            return in_condition(self.rotor, self.rotor.condition)
        return without_parameters(self.rotor, level)

    def healthy(self, seed: int, commissioning: int, count: int) -> tuple[WindowStatistics, ...]:
        """Windows of one commissioning."""
        cutoff_hz = commissioned_cutoff_hz(self._generator(seed, commissioning, 1, 1))
        rng = self._generator(seed, commissioning, 1)
        if isinstance(self.rotor, BeamRotor):
            limits = replace(COMMISSIONED, cutoff_hz=(cutoff_hz, cutoff_hz))
            return _of_beam(self.rotor, SourceLayout.ONE_SOURCE, limits, {}, rng, count)
        machine, own = in_one_condition(self.rotor, cutoff_hz, (1.5, 1.5)), int(rng.integers(2**62))
        draw = Draw(machine, own, Purpose.TRAINING, layout=Layout.ONE_SOURCE, fixed_condition=True)
        return tuple(simulate_window(draw, number) for number in range(1, count + 1))

    def later(
        self, seed: int, commissioning: int, cell: int, number: int, changes: dict[str, float]
    ) -> tuple[WindowStatistics, float]:
        """One window, and the cutoff of its excitation, Hz, at least a factor of 1.25 from the commissioned one."""
        rng = self._generator(seed, commissioning, 2, cell, number)
        scene = SceneRange() if isinstance(self.rotor, BeamRotor) else self.rotor.condition
        cutoff_hz = commissioned_hz = commissioned_cutoff_hz(self._generator(seed, commissioning, 1, 1))
        while abs(math.log(cutoff_hz / commissioned_hz)) <= _OTHER_CUTOFF:
            cutoff_hz = float(rng.uniform(*scene.cutoff_hz))
        if isinstance(self.rotor, BeamRotor):
            limits = replace(SceneRange(), cutoff_hz=(cutoff_hz, cutoff_hz))
            if not self.rotor.linear:
                limits = replace(limits, stochastic_to_1x=ALIKE)
            beam_layout = SourceLayout.INDEPENDENT if number % 2 else SourceLayout.ONE_SOURCE
            return _of_beam(self.rotor, beam_layout, limits, changes, rng, 1)[0], cutoff_hz
        drawn = self.rotor.condition.model_copy(update={"cutoff_hz": (cutoff_hz, cutoff_hz)})
        machine, own = in_condition(self.rotor, drawn), int(rng.integers(2**62))
        draw = Draw(machine, own, Purpose.EVALUATION, faults=changes, layout=Layout(number % 2))
        return simulate_window(draw, number), cutoff_hz

    def _generator(self, seed: int, commissioning: int, *which: int) -> np.random.Generator:
        """Random numbers of a commissioning (1, ...) or of a window of a later day (2, ...)."""
        own = int.from_bytes(hashlib.sha256(self.rotor.name.encode()).digest()[:4], "big")
        return np.random.default_rng([seed, own, commissioning, *which])


def _of_beam(
    rotor: BeamRotor,
    layout: SourceLayout,
    limits: SceneRange,
    changes: dict[str, float],
    rng: np.random.Generator,
    count: int,
) -> tuple[WindowStatistics, ...]:
    condition = drawn_condition(rotor, layout, limits, changes, rng)
    sizes = plan(rotor, WindowSizes())
    duration_s = (sizes.preamble + count * sizes.hops * sizes.hop) / sizes.rate_hz + _SETTLING_S
    return tuple(windows_of(sampled(rotor, condition, duration_s, int(rng.integers(2**62))), sizes)[:count])


def subject_named(name: str) -> StudiedMachine:
    """Look up a machine of `SUBJECTS`; raises KeyError if there is none of this name."""
    return StudiedMachine(load_machine(name) if name in SHIPPED else rotor_named(name))


@dataclass(frozen=True, slots=True)
class _Compared:
    """The likelihood without state from earlier windows, because no two windows share a condition."""

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
    """Commission a subject on healthy windows of one recording at a knowledge level; a text says why it is refused."""
    subject = subject_named(name)
    file, windows = subject.file(level), subject.healthy(seed, number, healthy)
    assert file is not None  # noqa: S101  # no cell asks for a level that a subject has no file of
    try:
        if level is KnowledgeLevel.NONE:
            return BaselineDiagnostician(learned_baseline(windows, ["recording 1"] * healthy)), windows
        if isinstance(file, Machine):
            return _Compared(file, None), windows
        identified = identify(file, windows, lambda *_: None, "Eq. 27", sized=False)
        return _Compared(identified.machine, identified.covariance), windows
    except EstimationError as error:
        return f"not commissioned: {error}", windows
