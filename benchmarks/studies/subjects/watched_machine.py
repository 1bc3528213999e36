"""Streams of a machine of any model class in one commissioning: healthy, and with a fault from some time on."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks.finite_elements import observed
from benchmarks.finite_elements.assembly import ComplexArray, Equations, assemble, probed
from benchmarks.finite_elements.machines import rotor_named
from benchmarks.finite_elements.observed import RATE_HZ, RunCondition, sampled
from benchmarks.finite_elements.rotor import BeamRotor
from benchmarks.finite_elements.scenes import COMMISSIONED, SourceLayout, drawn_condition
from benchmarks.studies.subjects.fault_kinds import ANOTHER, CRACK, MOTIONS, RUBS, Change, Rotor, Seen, as_simulated
from benchmarks.studies.subjects.machines import (
    ALIKE,
    SHIPPED,
    SUBJECTS,
    commissioned_cutoff_hz,
    drawn_in_one_condition,
    subject_named,
)
from models.commissioning.commissioned import KnowledgeLevel
from models.errors import EstimationError
from models.machine import Machine, MachineFile, load_machine
from models.physics.response import stochastic_covariance
from models.physics.rotor import STATE_INDEX, M_matrix, P_matrix, Q_matrix
from models.signals.block import FloatArray, SampleBlock
from models.signals.channels import Channel, Quantity
from simulator.scenario import Event, Rub, Scenario
from simulator.stream import blocks
from simulator.training.draws import draw_condition

CONDITIONS = 3
_HEALTHY, AFTER = 4.1, 2.5  # length of a healthy recording, and of a stream after the onset of a fault, windows
_RUBBING = 6.0  # length of a stream after the onset of a rub, windows: a light one takes four to be found
_BEFORE_S = 10.0
"""Healthy time before a fault, once the window (or the reference windows of a machine not commissioned) is full."""
_BLOCK_S = 0.5


def displacement_response(equations: Equations, kept: Sequence[int], f: FloatArray) -> ComplexArray:
    """Frequency response of displacements to forces at the coordinates `kept`, m/N, shape (n_frequencies, n, n)."""
    roots, shapes = np.linalg.eig(equations.A)
    inputs = np.vstack([np.zeros((len(equations.M), len(kept))), np.linalg.inv(equations.M)[:, kept]])
    drive = np.linalg.solve(shapes, inputs.astype(np.complex128))
    factors = 1 / (2j * np.pi * f[:, None] - roots)
    pairs = (shapes[kept][:, None, :] * drive.T[None, :, :]).reshape(len(kept) ** 2, -1)
    return np.asarray((factors @ pairs.T).reshape(len(f), len(kept), len(kept)), dtype=np.complex128)


@dataclass(frozen=True, slots=True)
class Subject:
    """A machine of one model class in one commissioning: file, healthy streams, later streams."""

    name: str
    level: KnowledgeLevel
    seed: int
    number: int
    always: Change = as_simulated  # effect that is always present, in healthy recordings too
    windows: int = 1  # full windows before a fault begins

    @property
    def file(self) -> MachineFile:
        """Machine file with what the monitor knows."""
        if self.level is KnowledgeLevel.FULL:
            return load_machine(self.name)
        file = subject_named(self.name).file(self.level)
        assert file is not None  # noqa: S101  # no study asks for a level that a machine has no file of
        return file

    def healthy(self, condition: int) -> Iterator[SampleBlock]:
        """Blocks of a healthy recording in one of the conditions."""
        rotor, seen = self._moved(condition, 1, _HEALTHY * self._window_s, "")
        return _blocks(self.file, self.always(rotor, seen, self._rng(2)))

    def condition(self, at: int) -> int:
        """Condition of the stream with fault number `at`."""
        return (at + self.number) % CONDITIONS

    def faulty(self, at: int, name: str, change: Change) -> Iterator[SampleBlock]:
        """Stream `at`, in which a fault begins; rubs and cracks are simulated by `name`, others applied by `change`."""
        lasts_s = (_RUBBING if name in RUBS else AFTER) * self._window_s
        rotor, seen = self._moved(self.condition(at), 2 + at, self.begins_s + lasts_s, name)
        seen = self.always(rotor, seen, self._rng(2))
        changed = change(rotor, seen, self._rng(1, at))
        first = round(self.begins_s * rotor.rate_hz)
        joined = (np.concatenate([getattr(seen, name)[:first], getattr(changed, name)[first:]]) for name in _FIELDS)
        return _blocks(self.file, Seen(*joined))

    @property
    def _window_s(self) -> float:
        return self.file.window.length_s

    @property
    def begins_s(self) -> float:
        """Time at which a fault begins, s."""
        return self.windows * self._window_s + _BEFORE_S

    def _rng(self, *purpose: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, SUBJECTS.index(self.name), self.number, *purpose])

    def _moved(self, condition: int, realisation: int, seconds: float, fault: str) -> tuple[Rotor, Seen]:
        rng = self._rng(0, condition)
        if self.name in SHIPPED:
            machine = load_machine(self.name)
            if fault == ANOTHER:
                machine = _another(machine, rng)
            draw = drawn_in_one_condition(machine, rng, condition)
            scenario = draw_condition(draw, realisation).overridden(duration_s=seconds)
            return _of_shipped(machine, _speed_rad_s(scenario), _samples(machine, scenario, fault, self.begins_s))
        cutoff_hz = commissioned_cutoff_hz(rng)
        layout = SourceLayout.INDEPENDENT if condition % 2 else SourceLayout.ONE_SOURCE
        scene = replace(COMMISSIONED, cutoff_hz=(cutoff_hz, cutoff_hz), stochastic_to_1x=ALIKE)
        beam = rotor_named(self.name)
        ran = drawn_condition(beam, layout, scene, {}, rng)
        return _of_beam(beam, ran, seconds, [self.seed, self.number, condition, realisation])


def _another(machine: Machine, rng: np.random.Generator) -> Machine:
    """A machine with another rotor: both masses, inertia and length off by 30 to 60 %."""
    parts = ("m1_kg", "m2_kg", "I2_kg_m2", "shaft_length_m")
    off = {name: 1 + rng.choice([-1, 1]) * float(rng.uniform(0.3, 0.6)) for name in parts}
    off["I2p_kg_m2"] = off["I2_kg_m2"]
    update = {name: factor * getattr(machine.rotor, name) for name, factor in off.items()}
    return machine.model_copy(update={"rotor": machine.rotor.model_copy(update=update)})


def _of_beam(beam: BeamRotor, ran: RunCondition, seconds: float, seed: list[int]) -> tuple[Rotor, Seen]:
    found = sampled(beam, ran, seconds, seed)
    K, C = beam.bearings[0].coefficients(ran.speed_rad_s)
    response = partial(displacement_response, assemble(beam, ran.speed_rad_s), list(probed(beam)))
    both = float(np.trace(K)) / 2, float(np.trace(C)) / 2
    speed_hz = ran.speed_rad_s / (2 * np.pi)
    return Rotor(speed_hz, RATE_HZ, response, both), Seen(found[:, :4], found[:, 4:8], found[:, 8])


def _of_shipped(machine: Machine, speed_rad_s: float, samples: FloatArray) -> tuple[Rotor, Seen]:
    si = samples * np.array([one.to_si for one in machine.sensors])
    columns = {(one.quantity, one.location, one.direction): n for n, one in enumerate(machine.sensors)}
    motion, rate = (
        si[:, [columns[quantity, *at] for at in MOTIONS]] for quantity in (Quantity.DISPLACEMENT, Quantity.VELOCITY)
    )
    angle = si[:, columns[Quantity.SHAFT_ANGLE, "shaft", "rotation"]]
    rotor = machine.rotor
    kept = [STATE_INDEX[name] for name in ("y1", "y2", "z1", "z2")]
    equations = Equations(M_matrix(rotor), P_matrix(rotor, speed_rad_s), Q_matrix(rotor))
    response = partial(displacement_response, equations, kept)
    both = (rotor.k_by_N_per_m + rotor.k_bz_N_per_m) / 2, (rotor.c_by_N_s_per_m + rotor.c_bz_N_s_per_m) / 2
    return Rotor(speed_rad_s / (2 * np.pi), machine.rate_hz, response, both), Seen(motion, rate, angle)


def _speed_rad_s(scenario: Scenario) -> float:
    return next(event.speed_rpm for event in scenario.events if event.speed_rpm) * np.pi / 30


_FIELDS = ("displacement", "velocity", "angle_rad")


def _samples(machine: Machine, scenario: Scenario, fault: str, begins_s: float) -> FloatArray:
    """Samples of the scenario, with a rub or crack from `begins_s` on, halved until the machine is stable."""
    size, rub = 0.3, None
    if fault in RUBS:
        size, clearance = RUBS[fault]
        variance = np.diag(stochastic_covariance(machine.rotor, _speed_rad_s(scenario), scenario.sources))
        radial = float(np.sqrt(variance[STATE_INDEX["y2"]] + variance[STATE_INDEX["z2"]]))
        rub = Rub(clearance_m=clearance * radial * np.hypot(1, 1 / ALIKE[0]))
    while True:
        events = scenario.events
        if fault in RUBS or fault == CRACK:
            events += (Event(at_s=begins_s, anomaly="rub" if rub else "crack", size=size),)
        ran = scenario.model_copy(update={"rub": rub, "events": events})
        try:
            return np.concatenate([one.samples for one, _ in blocks(ran, machine, _BLOCK_S)]).astype(np.float64)
        except EstimationError:
            if events is scenario.events:
                raise
            size /= 2


def _blocks(file: MachineFile, seen: Seen) -> Iterator[SampleBlock]:
    samples = np.column_stack([_column(one, seen) for one in file.sensors])
    return observed.blocks(samples, file.descriptor, _BLOCK_S)


def _column(channel: Channel, seen: Seen) -> FloatArray:
    if channel.quantity is Quantity.SHAFT_ANGLE:
        return seen.angle_rad
    of = seen.displacement if channel.quantity is Quantity.DISPLACEMENT else seen.velocity
    return of[:, MOTIONS.index((channel.location, channel.direction))]
