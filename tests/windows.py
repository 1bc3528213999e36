"""Samples of a simulated machine, windows of a stream of blocks, as a monitor makes them, and their theory."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import scipy.linalg

from models.diagnosis.window.moments import Plan, plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine, MachineFile
from models.signals.block import FloatArray, SampleBlock
from simulator.scenario import Event, load_scenario
from simulator.stream import blocks
from tests.sure import sure


def healthy_blocks(
    machine: Machine, duration_s: float, seed: int, *events: Event, **how: Any
) -> tuple[SampleBlock, ...]:
    """Blocks of the machine in the shipped healthy scenario with these events; `how` is for `blocks`."""
    scenario, _ = load_scenario("healthy")
    scenario = scenario.overridden(duration_s=duration_s, seed=seed, faults=events)
    return tuple(block for block, _ in blocks(scenario, machine, **how))


def healthy_samples(machine: Machine, duration_s: float, seed: int, *events: Event) -> FloatArray:
    return np.concatenate([one.samples for one in healthy_blocks(machine, duration_s, seed, *events, block_s=1.0)])


def correlation(A: FloatArray, covariance: FloatArray, lag_s: float) -> FloatArray:
    """R(τ) = E{x(t) xᵀ(t+τ)} = R(0) e^{Aᵀτ} for τ ≥ 0 (Eq. 18); shape (n, n)."""
    return np.asarray(covariance @ scipy.linalg.expm(A.T * lag_s), dtype=np.float64)


def full_windows(window: SlidingWindow, stream: Iterable[SampleBlock]) -> Iterator[WindowStatistics]:
    for block in stream:
        for _ in window.feed(window.plan.to_si(block.samples), block.start_ns):
            full = window.statistics()
            if full is not None:
                yield full


def fed(plan: Plan, samples: FloatArray) -> SlidingWindow:
    """The sliding window after these samples, in the units of the machine, fed as one piece."""
    window = SlidingWindow(plan)
    tuple(window.feed(plan.to_si(samples), 0))
    return window


def statistics(machine: MachineFile, samples: FloatArray) -> WindowStatistics:
    return sure(fed(plan_for(machine), samples).statistics())


def last_window(plan: Plan, stream: Iterable[SampleBlock]) -> WindowStatistics:
    window = SlidingWindow(plan)
    for block in stream:
        tuple(window.feed(plan.to_si(block.samples), block.start_ns))
    return sure(window.statistics())
