"""Shared by the tests of snapshots: windows of the rotor kit as a monitor holds them."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt

from models.commissioning.commissioned import Installed
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import MachineFile
from models.physics.rotor import H_matrix, M_matrix, P_matrix, Q_matrix
from models.signals.block import FloatArray, SampleBlock
from rotorwatch.records.snapshots import CorrelationPair, CorrelationSnapshot
from service.analysis.snapshots.machine import LatestData, MachineSnapshots
from service.monitor.reports import Identity
from simulator.scenario import Event, load_scenario
from simulator.stream import blocks
from tests.commissioning.rotor_kit import LAB, stream
from tests.sure import sure
from tests.windows import full_windows

SEED = 7_700_011
SECONDS = 70.0
S = 10**9
K_BY = Event(at_s=0.0, parameter="k_by", relative_change=-0.3)
NAMES = [channel.name for channel in LAB.sensors]


def snapshots_of(machine: MachineFile) -> MachineSnapshots:
    return MachineSnapshots(
        Installed(machine), Identity(site="demo", machine="lab", bundle=None, machine_hash="9a0c41d27be8")
    )


def window_of(machine: MachineFile, stream_: Sequence[SampleBlock], *, lagged: bool = True) -> WindowStatistics:
    """The latest full window, as a monitor has it; columns are those of `machine`, by name."""
    columns = [NAMES.index(channel.name) for channel in machine.sensors]
    seen = (replace(block, samples=block.samples[:, columns]) for block in stream_)
    *_, latest = full_windows(SlidingWindow(plan_for(machine, lagged=lagged)), seen)
    return latest


@cache
def latest(*faults: Event, lagged: bool = True) -> LatestData:
    """Latest data of a monitor of the rotor kit after 70 s."""
    stream_ = stream(SECONDS, SEED, *faults)
    window = window_of(LAB, stream_, lagged=lagged)
    return LatestData(window, 1.0, LikelihoodFit(LAB).diagnose(window).parameters, "", stream_[-20:])


@cache
def quiet() -> tuple[SampleBlock, ...]:
    """The rotor kit with nothing but its unbalance."""
    scenario, machine = load_scenario("healthy")
    still = {"sources": (), "sensors": type(scenario.sensors)(), "duration_s": SECONDS}
    return tuple(block for block, _ in blocks(scenario.model_copy(update=still), machine))


def unbalance_um() -> npt.NDArray[np.complex128]:
    """Response to the unbalance by the equations of motion: y1, y2, psi, z1, z2, phi."""
    W, rotor = LAB.operation.speed_rad_s, LAB.rotor
    H = H_matrix(rotor, W)
    dynamic = -(W**2) * M_matrix(rotor) + 1j * W * P_matrix(rotor, W) + Q_matrix(rotor)
    return np.asarray(1e6 * np.linalg.solve(dynamic, H[:, 0] - 1j * H[:, 1]))


def numbers(series: Sequence[float | None] | None) -> FloatArray:
    return np.array([np.nan if value is None else value for value in sure(series)], dtype=np.float64)


def by_plane(snapshot: CorrelationSnapshot, plane: str) -> list[CorrelationPair]:
    return [pair for pair in snapshot.pairs if pair.first[0] == plane and pair.second[0] == plane]


def synthetic(signals: dict[str, FloatArray]) -> list[SampleBlock]:
    """Blocks of 0.1 s of the rotor kit with these samples, and zeros in other channels."""
    n_samples = next(iter(signals.values())).size
    samples = np.zeros((n_samples, len(NAMES)))
    for name, values in signals.items():
        samples[:, NAMES.index(name)] = values
    size = round(0.1 * LAB.rate_hz)
    return [
        SampleBlock(k * S // 10, k, 1, LAB.rate_hz, samples[k * size : (k + 1) * size])
        for k in range(n_samples // size)
    ]
