"""Healthy recordings of the shipped rotor kit, and machine files that omit part of what is known."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from models.commissioning.commission import Commissioning, commission
from models.commissioning.commissioned import HealthyEntry
from models.commissioning.healthy import HealthyRecording, healthy_from_blocks
from models.diagnosis.window.statistics import WindowStatistics, window_statistics
from models.machine import Machine, MachineFile, load_machine
from models.signals.block import FloatArray, SampleBlock
from models.signals.channels import Sensor
from simulator.scenario import Event
from tests.windows import healthy_blocks

LAB = load_machine("lab")
_PHYSICS = ("rotor", "operation", "condition")
_UNKNOWN = ("k_by_N_per_m", "k_bz_N_per_m", "c_by_N_s_per_m", "c_bz_N_s_per_m", "e_m")


def _less(machine: Machine) -> tuple[MachineFile, MachineFile]:
    fields = machine.model_dump()
    rotor = {name: value for name, value in fields["rotor"].items() if name not in _UNKNOWN}
    without = {name: value for name, value in fields.items() if name not in _PHYSICS}
    return MachineFile.model_validate(without), MachineFile.model_validate(without | {"rotor": rotor})


NOTHING, PARTIAL = _less(LAB)
"""The rotor kit with only channels and sampling, and with masses and shaft as well."""


def elsewhere(machine: MachineFile) -> MachineFile:
    """The machine with its sensors on the casing, where they measure no modelled motion."""
    moved = [
        one if one.quantity == "shaft_angle" else one.model_copy(update={"location": "casing"})
        for one in machine.sensors
    ]
    return machine.model_copy(update={"sensors": tuple(moved)})


def mounted(machine: Machine, at: dict[str, tuple[float, float]]) -> Machine:
    """The machine with the probe pairs named by their first state (``y1``) turned to these angles in degrees."""
    fields = machine.model_dump()
    for sensor in fields["sensors"]:
        for first, angles in at.items():
            pair = (first, first.replace("y", "z"))
            if sensor["name"] in pair:
                number = pair.index(sensor["name"])
                sensor |= {"direction": "XY"[number], "angle_deg": angles[number]}
    return Machine.model_validate(fields)


@cache
def stream(duration_s: float, seed: int, *events: Event) -> tuple[SampleBlock, ...]:
    return healthy_blocks(LAB, duration_s, seed, *events)


def samples_of(stream_: Sequence[SampleBlock]) -> FloatArray:
    return np.asarray(np.concatenate([block.samples for block in stream_]), dtype=np.float64)


def with_samples(stream_: Sequence[SampleBlock], samples: FloatArray) -> list[SampleBlock]:
    found, at = [], 0
    for block in stream_:
        n_samples = block.samples.shape[0]
        part = samples[at : at + n_samples].astype(np.float32)
        found.append(replace(block, samples=part))
        at += n_samples
    return found


def factored(machine: MachineFile, stream_: Sequence[SampleBlock], **factors: float) -> list[SampleBlock]:
    """The machine's blocks with channels multiplied by factors."""
    return with_samples(stream_, samples_of(stream_) * [factors.get(sensor.name, 1.0) for sensor in machine.sensors])


def with_sensors(
    machine: MachineFile, stream_: Sequence[SampleBlock], kept: Callable[[Sensor], bool]
) -> tuple[MachineFile, list[SampleBlock]]:
    """The machine and its blocks, reduced to the sensors to keep."""
    columns = [number for number, sensor in enumerate(machine.sensors) if kept(sensor)]
    sensors = tuple(machine.sensors[number] for number in columns)
    blocks_ = [replace(block, samples=block.samples[:, columns]) for block in stream_]
    return machine.model_copy(update={"sensors": sensors}), blocks_


def no_velocity(sensor: Sensor) -> bool:
    return sensor.quantity != "velocity"


def without_angle(stream_: Sequence[SampleBlock]) -> list[SampleBlock]:
    return with_sensors(LAB, stream_, lambda sensor: sensor.name != "theta")[1]


def blind(machine: MachineFile, times: float = 1.0) -> MachineFile:
    """The machine without its shaft angle, and with the unbalance in its file multiplied by `times`."""
    assert machine.rotor is not None
    e_m = machine.rotor.e_m
    rotor = machine.rotor.model_copy(update={"e_m": None if e_m is None else times * e_m})
    sensors = tuple(one for one in LAB.sensors if one.name != "theta")
    return machine.model_copy(update={"sensors": sensors, "rotor": rotor, "operation": LAB.operation})


def humming(
    stream_: Sequence[SampleBlock], line_hz: float, bearing_m: float = 60e-6, disc_m: float = 60e-6
) -> list[SampleBlock]:
    """The blocks with the floor shaken by another machine."""
    samples = samples_of(stream_)
    turned = 2 * np.pi * line_hz * np.arange(len(samples)) / LAB.rate_hz
    for column, channel in enumerate(LAB.sensors[:8]):
        moved_m = bearing_m if channel.location == "bearing" else disc_m
        hum = 2 * np.pi * line_hz * np.cos(turned) if channel.quantity == "velocity" else np.sin(turned)
        samples[:, column] += moved_m * hum / channel.to_si
    return with_samples(stream_, samples)


def with_lines(stream_: Sequence[SampleBlock], parts: Mapping[float, float], order: float = 0.0) -> list[SampleBlock]:
    """The blocks with lines: `parts` maps Hz to parts of each channel's rms; that at `order` has part 0.05."""
    samples = samples_of(stream_)
    spread, at_s = samples[:, :8].std(axis=0), np.arange(len(samples)) / LAB.rate_hz
    phases = np.random.default_rng(5200).uniform(0, 2 * np.pi, 8)
    for line_hz, part in parts.items():
        samples[:, :8] += part * spread * np.sin(2 * np.pi * line_hz * at_s[:, np.newaxis] + phases)
    if order:
        samples[:, :8] += 0.05 * spread * np.sin(order * samples[:, 8:9] + phases)
    return with_samples(stream_, samples)


def recording(machine: MachineFile, stream_: Sequence[SampleBlock], name: str = "healthy.mcap") -> HealthyRecording:
    return healthy_from_blocks(name, machine, stream_)


def windows_of(recorded: HealthyRecording) -> tuple[WindowStatistics, ...]:
    """Full windows that do not overlap, gaps left out."""
    length = recorded.plan.hops
    return tuple(
        window_statistics(recorded.plan, stretch[start : start + length])
        for stretch in recorded.stretches
        for start in range(0, len(stretch) - length + 1, length)
    )


def healthy(machine: MachineFile, duration_s: float, seed: int, name: str = "healthy.mcap") -> HealthyRecording:
    return recording(machine, stream(duration_s, seed), name)


def commissioned(machine: MachineFile, *recordings: HealthyRecording, wished: float | None = None) -> Commissioning:
    entries = [
        HealthyEntry(
            name=one.name, sha256="0" * 64, start_ns=one.hops[0].start_ns, end_ns=one.hops[-1].end_ns,
            used_s=one.duration_s, gaps=one.gaps,
        )
        for one in recordings
        if one.hops
    ]  # fmt: skip
    return commission(machine, recordings, entries, wished=wished)


def told_of(made: Commissioning, check: str) -> tuple[str, str, str]:
    """Verdict, text and advice of one check."""
    return next((one.verdict, one.text, one.advice) for one in made.report.checks if one.name == check)
