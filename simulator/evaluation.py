"""Evaluation of the diagnosticians on windows that neither training nor calibration saw.

Every cell is one true change in one layout of the excitation, on independent realisations in conditions drawn at
random. A reading counts as detected when it lies more than a threshold of standard errors from nominal; the threshold
follows from the declared false-alarm rate per window over all parameters together.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np
import scipy.stats
from pydantic import BaseModel, ConfigDict

from models.diagnosis.bundle import Bundle
from models.diagnosis.likelihood import LikelihoodFit
from models.diagnosis.networks import read_equation
from models.diagnosis.readings import ParameterReading
from models.diagnosis.spectral_model import STRUCTURAL
from models.errors import EstimationError
from models.machine import Machine
from models.physics.parameters import PARAMETERS
from simulator.campaign import Draw, Layout, Purpose, simulate_window

__all__ = ["Cell", "Rate", "Reading", "cells", "evaluate_cell", "threshold_for"]

_STRICT = ConfigDict(extra="forbid", frozen=True)


class Rate(BaseModel):
    """A rate with its 95 % Clopper-Pearson interval."""

    model_config = _STRICT

    count: int
    of: int
    rate: float
    low: float
    high: float

    @classmethod
    def of_counts(cls, count: int, of: int) -> "Rate":
        """Rate of `count` in `of` independent windows."""
        low = 0.0 if count == 0 else float(scipy.stats.beta.ppf(0.025, count, of - count + 1))
        high = 1.0 if count == of else float(scipy.stats.beta.ppf(0.975, count + 1, of - count))
        return cls(count=count, of=of, rate=count / of, low=low, high=high)


class Reading(BaseModel):
    """How one diagnostician read one parameter in a cell: relative changes, spread as a robust standard deviation."""

    model_config = _STRICT

    by: str
    parameter: str
    not_evaluable: int
    truth: float
    median: float
    spread: float
    standard_error: float
    covered: Rate
    detected: Rate


class Cell(BaseModel):
    """One true change in one layout."""

    model_config = _STRICT

    faults: dict[str, float]
    layout: str
    windows: int
    readings: tuple[Reading, ...]


def threshold_for(false_alarm_rate: float) -> float:
    """Standard errors that a healthy window exceeds in any parameter with the given probability (Bonferroni)."""
    return float(scipy.stats.norm.isf(false_alarm_rate / 2 / len(PARAMETERS)))


def cells(fault_size: float) -> Iterator[tuple[dict[str, float], Layout]]:
    """Return the standard cells: healthy, and each parameter changed (e up, the rest down), in both layouts."""
    for layout in Layout:
        yield {}, layout
        for name in PARAMETERS:
            yield {name: fault_size if name == "e" else -fault_size}, layout


def evaluate_cell(
    machine: Machine,
    bundle: Bundle,
    faults: dict[str, float],
    layout: Layout,
    *,
    stream: int,
    n_windows: int,
    seed: int,
    false_alarm_rate: float,
    processes: int,
    progress: Callable[[int], None] = lambda _: None,
) -> Cell:
    """Evaluate one cell.

    Parameters
    ----------
    machine : Machine
    bundle : Bundle
    faults : dict of str to float
        True relative changes.
    layout : Layout
    stream : int
        Number of the cell; part of every window's seed.
    n_windows, seed : int
    false_alarm_rate : float
        Per window, over all parameters together.
    processes : int
    progress : callable
        Called with 1 for each finished window.
    """
    draw = Draw(machine, seed, Purpose.EVALUATION, stream, faults=faults, layout=layout)
    read = partial(_read_window, draw, bundle)
    results = []
    with ProcessPoolExecutor(processes) as pool:
        for readings in pool.map(read, range(n_windows), chunksize=2):
            results.append(readings)
            progress(1)
    threshold = threshold_for(false_alarm_rate)
    summaries = [
        _summary([readings[position] for readings in results], faults, threshold) for position in range(len(results[0]))
    ]
    return Cell(faults=faults, layout=layout.name.lower(), windows=n_windows, readings=tuple(summaries))


def _read_window(draw: Draw, bundle: Bundle, number: int) -> tuple[ParameterReading, ...]:
    window = simulate_window(draw, number)
    try:
        estimate = LikelihoodFit(draw.machine).fit(window)
    except EstimationError as error:  # a refused window is a result: it is counted
        readings = [ParameterReading(name, "likelihood", reason=str(error)) for name in (*STRUCTURAL, "e")]
    else:
        readings = [
            ParameterReading(name, "likelihood", float(change), float(deviation))
            for name, change, deviation in zip(estimate.names, estimate.change, estimate.standard_error, strict=True)
        ]
    for network in bundle.networks:
        readings += read_equation(network, window, draw.machine).parameters
    return tuple(readings)


def _summary(readings: list[ParameterReading], faults: dict[str, float], threshold: float) -> Reading:
    """Summarise one parameter over the evaluated windows; rates are of those."""
    truth = faults.get(readings[0].name, 0.0)
    refused = sum(reading.change is None for reading in readings)
    if refused == len(readings):
        raise EstimationError(f"no window of a cell could be evaluated: {readings[0].reason}")
    readings = [reading for reading in readings if reading.change is not None]
    change = np.array([reading.change for reading in readings], dtype=np.float64)
    error = np.array([reading.standard_error for reading in readings], dtype=np.float64)
    median = float(np.median(change))
    n = len(readings)
    return Reading(
        by=readings[0].by,
        parameter=readings[0].name,
        not_evaluable=refused,
        truth=truth,
        median=median,
        spread=float(1.4826 * np.median(np.abs(change - median))),
        standard_error=float(np.median(error)),
        covered=Rate.of_counts(int(np.sum(np.abs(change - truth) <= 1.96 * error)), n),
        detected=Rate.of_counts(int(np.sum(np.abs(change) > threshold * error)), n),
    )
