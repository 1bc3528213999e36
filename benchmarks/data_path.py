"""Measures the processing time of the data path's stages for one machine, as ratios to a yardstick in the same run.

Run: ``python -m benchmarks.data_path``. The yardstick is the Fourier transform that the cross-spectra need at least
(one real FFT per segment and channel); absolute times depend on the computer, ratios much less.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.studies.subjects.machines import without_parameters
from benchmarks.studies.subjects.watched import commissioned
from models.commissioning.commissioned import Installed
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.networks.amortised import NetworkDiagnostician
from models.diagnosis.networks.bundle import load_bundle
from models.diagnosis.networks.relation import RelationDiagnostician
from models.diagnosis.window.moments import hop_moments, plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.levels.judgement import LevelJudge
from models.levels.measures import WindowLevels, hop_levels
from models.levels.reference import learn_levels
from models.signals.waveform import waveform_of
from service.monitor.monitor import MachineMonitor
from simulator.scenario import load_scenario
from simulator.stream import blocks

REPETITIONS = 5
DATA_S = 180.0


def median_s(work: Callable[[], object], count: int, repetitions: int = REPETITIONS) -> float:
    """Median over repetitions of the time per item, if `work` handles `count` items."""
    times = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        work()
        times.append((time.perf_counter() - begin) / count)
    return statistics.median(times)


def main() -> None:
    """Measure and print."""
    scenario, machine = load_scenario("healthy")
    scenario = scenario.overridden(seed=1, duration_s=DATA_S)
    stream = [block for block, _ in blocks(scenario, machine)]
    bundle, plan = load_bundle("lab", machine), plan_for(machine, levels=True)
    window, untouched = SlidingWindow(plan), replace(plan, thorough=False)
    windows: list[WindowStatistics] = []
    measures: list[WindowLevels] = []
    samples = np.concatenate([plan.to_si(block.samples) for block in stream])
    for _ in window.feed(samples, 0):
        full, loud = window.statistics(), window.levels()
        if full is not None and loud is not None:
            windows.append(full)
            measures.append(loud)
    piece = samples[: plan.preamble + plan.hop]
    level = piece[:, : len(plan.states)].mean(axis=0)
    rows = np.ascontiguousarray(piece.T)  # as in the moments
    seen, angle, measured = waveform_of(rows[:-1, -plan.hop :].T), rows[-1, -plan.hop :], plan.levels
    assert measured is not None  # noqa: S101  # planned above
    taper = np.hanning(plan.segment + 1)[:-1] / np.sqrt(3 / 8 * plan.segment * plan.rate_hz)
    spectrum = np.fft.rfft(seen[1] * taper)  # as in the moments: here a hop equals a segment
    channels = [machine.sensors[column] for column in plan.columns]
    judge = LevelJudge(measured, channels, machine.levels)
    healthy = learn_levels("commissioned", [channel.name for channel in channels], measures)
    fit, relation = LikelihoodFit(machine), RelationDiagnostician(machine, bundle.networks)
    if bundle.amortised is None:
        raise SystemExit("the shipped bundle has no amortised networks: train it again")
    amortised = NetworkDiagnostician(machine, bundle.amortised)
    fit.diagnose(windows[0])
    following = LikelihoodFit(machine, follow=True)
    following.diagnose(windows[0])

    def yardstick() -> None:
        half = plan.segment // 2
        for number in range(plan.hop // half):
            np.fft.rfft(piece[number * half : number * half + plan.segment], axis=0)

    def often(work: Callable[[], object]) -> float:
        return median_s(lambda: [work() for _ in range(100)], 100)

    def whole_s(installed: Installed) -> float:
        """Time per hop once the window is full."""
        monitor = MachineMonitor(installed)
        for block in stream[: len(stream) // 2]:
            monitor.step(block)
        return median_s(lambda: [monitor.step(block) for block in stream[len(stream) // 2 :]], hops, repetitions=1)

    hops = round(DATA_S / 2 / machine.window.hop_s)
    known = Installed(machine, bundle)
    unknown = commissioned(without_parameters(machine), stream)
    if isinstance(unknown, str):
        raise SystemExit(unknown)
    costs = {
        "Fourier transforms alone (yardstick)": median_s(yardstick, 1),
        "moments of a hop": median_s(lambda: hop_moments(plan, piece, level, 0), 1),
        "  without contact": median_s(lambda: hop_moments(untouched, piece, level, 0), 1),
        "  of which levels of the hop": often(lambda: hop_levels(measured, *seen, angle, spectrum)),
        "levels of a window": often(lambda: window.levels(errors=False)),
        "  judged, known machine": often(lambda: judge.judge(measures[-1], None)),
        "  judged against commissioning": often(lambda: judge.judge(measures[-1], healthy)),
        "statistics of a window": median_s(window.statistics, 1),
        "likelihood, warm": median_s(lambda: [fit.diagnose(one) for one in windows], len(windows)),
        "likelihood, followed": median_s(lambda: [following.diagnose(one) for one in windows], len(windows)),
        "amortised networks, all four": median_s(lambda: [amortised.diagnose(one) for one in windows], len(windows)),
        "relation networks 28, 29, 31": median_s(lambda: [relation.diagnose(one) for one in windows], len(windows)),
        "whole data path, per hop": statistics.median(whole_s(known) for _ in range(REPETITIONS)),
        "  without parameters, commissioned": statistics.median(whole_s(unknown) for _ in range(REPETITIONS)),
    }
    base = costs["Fourier transforms alone (yardstick)"]
    print(f"{machine.name}: {machine.rate_hz:g} Hz, {len(machine.sensors)} channels, hop {machine.window.hop_s:g} s")
    for name, seconds in costs.items():
        print(f"  {name:<40} {1e3 * seconds:8.2f} ms   {seconds / base:8.1f} x")
    print(f"  real time / whole data path: {machine.window.hop_s / costs['whole data path, per hop']:.0f}")


if __name__ == "__main__":
    main()
