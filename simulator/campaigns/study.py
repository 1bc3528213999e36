"""The paper's study, done again: its eight fault conditions, cutoffs and noise levels, before all diagnosticians.

Everything is judged twice: on faulty runs that share their noise realisations with the healthy runs the networks were
trained on, as the paper evidently had it, and on independent realisations. The operating condition is the same in both:
one source of fixed direction and level, fixed speed, the paper's four cutoffs.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeVar

from pydantic import BaseModel, ConfigDict

from models.diagnosis.networks.paper import PAPER_EQUATIONS, PaperHealthy, calibrate_paper
from models.diagnosis.networks.paper_training import train_paper_network
from simulator.campaigns.pool import done_in
from simulator.campaigns.rates import Rate
from simulator.campaigns.study_windows import (
    CONDITIONS,
    EQUATIONS,
    Judged,
    Run,
    StudyPlan,
    judge,
    own_equations,
    simulate,
)
from simulator.training.draws import Purpose, with_tilt

__all__ = ["REALISATIONS", "Realisation", "Study", "StudyCell", "run_study"]

_STRICT = ConfigDict(extra="forbid", frozen=True)
_T = TypeVar("_T")

Realisation = Literal["shared", "independent"]
REALISATIONS: tuple[Realisation, ...] = ("shared", "independent")

_NOISE_CUTOFF_HZ = 100.0


class StudyCell(BaseModel):
    """One fault condition at one cutoff and noise level.

    Attributes
    ----------
    realisation : str
        ``shared`` with the training windows, or ``independent``.
    condition : int
        Number in `simulator.campaigns.study_windows.CONDITIONS`.
    cutoff_hz, noise_relative : float
    named : dict
        Method to the equations it named in every window; None where it could not judge the window.
    msd : dict
        Method to equation to the MSD of every window, in units of the target's mean square.
    """

    model_config = _STRICT

    realisation: Realisation
    condition: int
    cutoff_hz: float
    noise_relative: float
    named: dict[str, tuple[tuple[str, ...] | None, ...]]
    msd: dict[str, dict[str, tuple[float, ...]]]

    @property
    def own(self) -> tuple[str, ...]:
        """Equations that a right location names."""
        return own_equations(CONDITIONS[self.condition])


class Study(BaseModel):
    """All numbers of the study, and what they were made with."""

    model_config = _STRICT

    machine: str
    bundle: str
    seed: int
    windows: int
    training_windows: int
    calibration_windows: int
    false_alarm_rate: float
    speed_rpm: float
    direction: tuple[float, ...]
    force_rms_N: dict[str, float]
    limits: dict[str, dict[str, float]]
    faults: tuple[StudyCell, ...]
    noise: tuple[StudyCell, ...]

    @property
    def methods(self) -> tuple[str, ...]:
        """Who judged, the paper's networks first."""
        return tuple(self.faults[0].named)

    def cells(self, realisation: Realisation, condition: int) -> tuple[StudyCell, ...]:
        """Cells of one fault condition, by cutoff."""
        return tuple(cell for cell in self.faults if (cell.realisation, cell.condition) == (realisation, condition))

    def naming(self, realisation: Realisation, condition: int, method: str, equation: str) -> Rate:
        """Share of windows, over all cutoffs, in which a method names an equation."""
        verdicts = [named for cell in self.cells(realisation, condition) for named in cell.named[method]]
        return Rate.of_counts(sum(named is not None and equation in named for named in verdicts), len(verdicts))

    def found(self, realisation: Realisation, method: str) -> Rate:
        """Share of changed equations that are named, over the eight fault conditions."""
        hits = [
            named is not None and equation in named
            for cell, named in self._verdicts(realisation, method)
            for equation in cell.own
        ]
        return Rate.of_counts(sum(hits), len(hits))

    def wrong(self, realisation: Realisation, method: str) -> Rate:
        """Share of windows in the eight fault conditions in which an unchanged equation is named."""
        misses = [
            named is not None and not set(named) <= set(cell.own) for cell, named in self._verdicts(realisation, method)
        ]
        return Rate.of_counts(sum(misses), len(misses))

    def false_alarms(self, realisation: Realisation, method: str) -> Rate:
        """Share of healthy windows in which any equation is named."""
        named = [bool(one) for cell in self.cells(realisation, 0) for one in cell.named[method]]
        return Rate.of_counts(sum(named), len(named))

    def refused(self, method: str) -> int:
        """Windows that a method could not judge."""
        return sum(named is None for cell in (*self.faults, *self.noise) for named in cell.named[method])

    def exact(self, realisation: Realisation, method: str) -> Rate:
        """Share of windows in the eight fault conditions in which exactly the changed equations are named."""
        hits = [
            named is not None and set(named) == set(cell.own) for cell, named in self._verdicts(realisation, method)
        ]
        return Rate.of_counts(sum(hits), len(hits))

    def _verdicts(self, realisation: Realisation, method: str) -> list[tuple[StudyCell, tuple[str, ...] | None]]:
        return [
            (cell, named)
            for condition in CONDITIONS[1:]
            for cell in self.cells(realisation, condition.number)
            for named in cell.named[method]
        ]


def run_study(plan: StudyPlan, processes: int, progress: Callable[[str, int, int], None]) -> Study:
    """Simulate, train the paper's networks, set their limits, and judge every window.

    Parameters
    ----------
    plan : StudyPlan
    processes : int
    progress : callable
        Called with what is being done, how much is done, and how much there is.

    Raises
    ------
    EstimationError
        If there are too few calibration windows for the declared rate.
    """
    rig = with_tilt(plan.machine)
    low = plan.noise_levels[0]
    own = {cutoff: [(Purpose.TRAINING, n, r) for r in range(plan.windows)] for n, cutoff in enumerate(plan.cutoffs_hz)}
    training_runs = [Run(0, cutoff, low, realisation) for cutoff, all_of in own.items() for realisation in all_of]
    calibration_runs = [
        Run(0, plan.cutoffs_hz[n % len(plan.cutoffs_hz)], low, (Purpose.CALIBRATION, n))
        for n in range(plan.calibration_windows)
    ]
    keys = [*_fault_keys(plan), *_noise_keys(plan)]
    with ProcessPoolExecutor(processes) as pool:

        def over(label: str, function: Callable[[Run], _T], runs: Sequence[Run]) -> list[_T]:
            return done_in(pool, function, runs, partial(progress, label), chunk=4)

        training = over("training windows", partial(simulate, plan), training_runs)
        networks = tuple(train_paper_network(equation, training, rig, plan.seed) for equation in PAPER_EQUATIONS)
        calibration = over("calibration windows", partial(simulate, plan), calibration_runs)
        limits: dict[str, PaperHealthy] = {
            # Who compares with the very runs that were trained on finds the largest healthy deviation among those.
            "shared": calibrate_paper(networks, training, rig, 1 / (len(training) + 1)),
            "independent": calibrate_paper(networks, calibration, rig, plan.false_alarm_rate),
        }
        runs = [run for n, key in enumerate(keys) for run in _runs(plan, n, key, own[key.cutoff_hz])]
        judged = over("windows judged", partial(judge, plan, networks, limits), runs)
    cells = tuple(_cell(key, judged[n * plan.windows : (n + 1) * plan.windows]) for n, key in enumerate(keys))
    n_faults = sum(1 for _ in _fault_keys(plan))
    return Study(
        machine=plan.machine.name,
        bundle=plan.bundle.identity,
        seed=plan.seed,
        windows=plan.windows,
        training_windows=len(training),
        calibration_windows=len(calibration),
        false_alarm_rate=plan.false_alarm_rate,
        speed_rpm=plan.machine.operation.speed_rpm,
        direction=plan.direction,
        force_rms_N={f"{cutoff:g}": plan.source(cutoff).force_rms_N for cutoff in plan.cutoffs_hz},
        limits={name: dict(zip(EQUATIONS, limit.threshold, strict=True)) for name, limit in limits.items()},
        faults=cells[:n_faults],
        noise=cells[n_faults:],
    )


@dataclass(frozen=True, slots=True)
class _Key:
    realisation: Realisation
    condition: int
    cutoff_hz: float
    noise_relative: float


def _fault_keys(plan: StudyPlan) -> Iterator[_Key]:
    for realisation in REALISATIONS:
        for condition in CONDITIONS:
            for cutoff_hz in plan.cutoffs_hz:
                yield _Key(realisation, condition.number, cutoff_hz, plan.noise_levels[0])


def _noise_keys(plan: StudyPlan) -> Iterator[_Key]:
    cutoff_hz = min(plan.cutoffs_hz, key=lambda cutoff: abs(cutoff - _NOISE_CUTOFF_HZ))
    for realisation in REALISATIONS:
        for noise_relative in plan.noise_levels:
            yield _Key(realisation, 0, cutoff_hz, noise_relative)


def _runs(plan: StudyPlan, number: int, key: _Key, own: list[tuple[Purpose, int, int]]) -> list[Run]:
    """Windows of a cell: the training's realisations again, or ones that no other cell has."""
    if key.realisation == "independent":
        own = [(Purpose.EVALUATION, number, r) for r in range(plan.windows)]
    return [Run(key.condition, key.cutoff_hz, key.noise_relative, realisation) for realisation in own]


def _cell(key: _Key, judged: Sequence[Judged]) -> StudyCell:
    measured = {method: tuple(equations) for method, equations in judged[0].msd.items()}
    return StudyCell(
        realisation=key.realisation,
        condition=key.condition,
        cutoff_hz=key.cutoff_hz,
        noise_relative=key.noise_relative,
        named={method: tuple(one.named[method] for one in judged) for method in judged[0].named},
        msd={
            method: {equation: tuple(one.msd[method][equation] for one in judged) for equation in equations}
            for method, equations in measured.items()
        },
    )
