"""Evaluation of the diagnosticians on windows that neither training nor calibration saw.

Every window becomes a record: what was true of it, what each diagnostician read, and how well anybody could have read
it. Records are kept one per line, so that a long evaluation can be stopped and carried on, and every figure on the
results page can be traced to its windows.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from time import process_time

import numpy as np
from pydantic import BaseModel, ConfigDict

from models.diagnosis.likelihood.bound import TrueCondition, cramer_rao
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.moments import plan_for
from models.diagnosis.networks.bundle import Bundle
from models.diagnosis.readings import Diagnosis, Diagnostician
from models.diagnosis.verdict.calibration import window_thresholds
from models.diagnosis.verdict.detectable import detectable_changes
from models.diagnosis.verdict.isolation import isolate_window
from models.diagnosis.verdict.stretch import stretch_of
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from models.physics.excitation import source_spectrum
from models.physics.matrices import STATE_INDEX
from simulator.campaigns.evaluation_cells import EvaluationCell, Topic
from simulator.campaigns.opinions import diagnosticians
from simulator.integrator import theoretical_rms
from simulator.scenario import Scenario
from simulator.timeline import Condition
from simulator.training.draws import Anomaly, Draw, Excitation, Layout, Purpose, draw_condition, simulate_scenario

__all__ = ["RATES", "Opinion", "WindowRecord", "evaluate_cells", "read_records", "true_condition"]

_STRICT = ConfigDict(extra="forbid", frozen=True)

RATES = (0.01, 0.001)
"""Declared false-alarm rates per window at which every opinion is judged."""

_OTHER_REALISATION = 7919
_LARGEST_LOSS = -0.9


class Opinion(BaseModel):
    """What one diagnostician said of one window; empty readings where it refused.

    Attributes
    ----------
    change, error : dict of str to float
        Relative changes and standard errors.
    named : tuple of tuple of str
        Parameters it says have changed, at each of `RATES`.
    outside : tuple of bool
        Whether it says that the window is outside the model, at each of `RATES`.
    low_confidence : bool
        Whether it says, at the first of `RATES`, that what it names should be believed with reserve.
    misfit_z : float or None
    suspect : str
    seconds : float
        Processor time.
    refused : str
        Why the window was not evaluated.
    """

    model_config = _STRICT

    change: dict[str, float] = {}
    error: dict[str, float] = {}
    named: tuple[tuple[str, ...], ...] = ()
    outside: tuple[bool, ...] = ()
    low_confidence: bool = False
    misfit_z: float | None = None
    suspect: str = ""
    seconds: float = 0.0
    refused: str = ""


class WindowRecord(BaseModel):
    """One evaluated window."""

    model_config = _STRICT

    cell: int
    topic: Topic
    number: int
    layout: Layout
    excitation: Excitation
    anomaly: Anomaly
    length_s: float
    truth: dict[str, float]
    cutoff_hz: float
    noise_relative: float
    bound: dict[str, float] = {}
    opinions: dict[str, Opinion]


def true_condition(scenario: Scenario, machine: Machine) -> TrueCondition:
    """What the scenario makes of the machine from its first sample on, as the bound needs it."""
    changes = {event.parameter: event.relative_change for event in scenario.events if event.parameter}
    speeds = [event.speed_rpm for event in scenario.events if event.speed_rpm is not None]
    truth = {name: float(change) for name, change in changes.items() if change is not None}
    rms = theoretical_rms(machine, Condition(truth, speeds[-1], scenario.sources))
    states = [STATE_INDEX[name] for name in plan_for(machine).states]
    low_hz, high_hz = machine.window.band_hz
    frequencies_hz = np.linspace(low_hz, high_hz, 64)
    corner_hz = scenario.sensors.noise_corner_hz
    memory = 0.0 if corner_hz is None else float(np.exp(-2 * np.pi * corner_hz / machine.rate_hz))
    density = (1 - memory**2) / np.abs(1 - memory * np.exp(-2j * np.pi * frequencies_hz / machine.rate_hz)) ** 2
    colour = np.stack([np.ones(64), np.log1p((frequencies_hz / (2 / 3 * high_hz)) ** 2)], axis=1)
    (level, exponent), *_ = np.linalg.lstsq(colour, np.log(density / machine.rate_hz), rcond=None)
    variance = (scenario.sensors.noise_relative * rms[states]) ** 2
    levels = np.zeros((6, 6))
    for source in scenario.sources:
        density = float(source_spectrum(np.array([1e-6]), source)[0])
        levels += np.outer(source.direction, source.direction) * density
    return TrueCondition(
        changes=truth,
        speed_rad_s=speeds[-1] * 2 * np.pi / 60,
        cutoff_hz=scenario.sources[0].cutoff_hz,
        levels=levels,
        noise=np.asarray(np.exp(level) * variance, dtype=np.float64),
        noise_colour=np.full(len(states), float(exponent)),
    )


def evaluate_cells(
    machine: Machine,
    bundle: Bundle | None,
    cells: Iterable[EvaluationCell],
    *,
    n_windows: int,
    seed: int,
    processes: int,
    kept: Path,
    progress: Callable[[EvaluationCell, int, int], None],
) -> None:
    """Evaluate cell after cell, appending to a file of records; what is there already is not done again.

    Parameters
    ----------
    machine : Machine
    bundle : Bundle or None
        Without it only the likelihood is evaluated.
    cells : iterable of EvaluationCell
    n_windows : int
        Windows of a cell of weight one.
    seed : int
    processes : int
    kept : Path
        JSON lines.
    progress : callable
        Called with the cell, its windows done and its windows in all.
    """
    done = {(record.cell, record.number) for record in read_records(kept)} if kept.exists() else set()
    with ProcessPoolExecutor(processes) as pool, kept.open("a", encoding="utf-8") as out:
        for index, cell in enumerate(cells):
            count = cell.count(n_windows)
            missing = [number for number in range(count) if (index, number) not in done]
            finished = count - len(missing)
            progress(cell, finished, count)
            work = partial(_record, machine, bundle, cell, index, seed)
            for record in pool.map(work, missing, chunksize=4):
                out.write(record.model_dump_json(exclude_defaults=True) + "\n")
                out.flush()
                finished += 1
                progress(cell, finished, count)


def read_records(path: Path) -> Iterator[WindowRecord]:
    """Read records back; a last line cut short by an interruption is left out."""
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.endswith("}"):
            yield WindowRecord.model_validate_json(line)


def _record(
    machine: Machine, bundle: Bundle | None, cell: EvaluationCell, index: int, seed: int, number: int
) -> WindowRecord:
    """Simulate one window and ask everybody."""
    if cell.length_s is not None:
        machine = _with_length(machine, cell.length_s)
    draw = Draw(
        machine,
        seed,
        Purpose.EVALUATION,
        index,
        faults=cell.faults,
        layout=cell.layout,
        excitation=cell.excitation,
        anomaly=cell.anomaly,
    )
    faults = dict(cell.faults)
    if cell.topic is Topic.DETECTABLE:
        faults = _quoted(draw, number)
        draw = Draw(machine, seed, Purpose.EVALUATION, index, faults=faults)
    scenario = draw_condition(draw, number)
    if cell.topic is Topic.DETECTABLE:
        scenario = scenario.model_copy(update={"seed": scenario.seed ^ _OTHER_REALISATION})
    window = simulate_scenario(scenario, machine)
    opinions: dict[str, Opinion] = {}
    everybody: tuple[Diagnostician, ...] = (LikelihoodFit(machine),)
    if bundle is not None and cell.length_s is None:
        everybody = diagnosticians(machine, bundle)
    for one in everybody:
        opinions[one.by] = _opinion(one, window)
    layout = Layout.INDEPENDENT if len(scenario.sources) > 1 else Layout.ONE_SOURCE
    bounded = cell.topic in {Topic.HEALTHY, Topic.LENGTH}
    states = window.states
    return WindowRecord(
        cell=index,
        topic=cell.topic,
        number=number,
        layout=layout,
        excitation=cell.excitation,
        anomaly=cell.anomaly,
        length_s=window.duration_s,
        truth=faults,
        cutoff_hz=scenario.sources[0].cutoff_hz,
        noise_relative=scenario.sensors.noise_relative,
        bound=cramer_rao(machine, states, true_condition(scenario, machine), window.duration_s) if bounded else {},
        opinions=opinions,
    )


def _opinion(one: Diagnostician, window: WindowStatistics) -> Opinion:
    started = process_time()
    try:
        diagnosis = one.diagnose(window)
    except EstimationError as error:  # a refused window is a result: it is counted
        return Opinion(refused=str(error), seconds=process_time() - started)
    seconds = process_time() - started
    if not diagnosis.evaluable:
        reasons = {reading.reason for reading in diagnosis.parameters}
        return Opinion(refused="; ".join(sorted(reasons)), seconds=seconds)
    verdicts = [isolate_window(diagnosis, rate) for rate in RATES]
    return Opinion(
        change={reading.name: _rounded(reading.change) for reading in diagnosis.evaluable},
        error={reading.name: _rounded(reading.standard_error) for reading in diagnosis.evaluable},
        named=tuple(verdict.changed for verdict in verdicts),
        outside=tuple(verdict.outside for verdict in verdicts),
        low_confidence=verdicts[0].low_confidence,
        misfit_z=None if diagnosis.misfit_z is None else round(diagnosis.misfit_z, 3),
        suspect=diagnosis.suspect,
        seconds=round(seconds, 5),
    )


def _rounded(value: float | None) -> float:
    return float(f"{value:.6g}")


def _quoted(draw: Draw, number: int) -> dict[str, float]:
    """Change of one parameter, drawn at random, that the likelihood quotes as just detectable in this condition."""
    diagnosis: Diagnosis = LikelihoodFit(draw.machine).diagnose(
        simulate_scenario(draw_condition(draw, number), draw.machine)
    )
    rng = np.random.default_rng([draw.seed, _OTHER_REALISATION, number])
    stretch = stretch_of(diagnosis, 0, 0)
    quoted = detectable_changes(stretch, window_thresholds(RATES[0], len(stretch.known)), draw.machine.window.length_s)
    one = quoted[int(rng.integers(len(quoted)))]
    # A loss of everything, quoted where not even that would be found for certain, cannot be simulated.
    return {one.name: one.gain if rng.random() < 0.5 or one.loss < _LARGEST_LOSS else one.loss}


def _with_length(machine: Machine, length_s: float) -> Machine:
    """The machine with another window length; the hop gives way where the window would hold fewer than four."""
    window = machine.window
    hop_s = window.hop_s if length_s >= 4 * window.hop_s else window.segment_s
    changed = window.model_copy(
        update={"length_s": round(length_s / hop_s) * hop_s, "hop_s": hop_s, "max_span_s": 2 * length_s}
    )
    return machine.model_copy(update={"window": changed})
