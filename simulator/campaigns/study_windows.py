"""One window of the paper's study: operating condition, realisation, and what every diagnostician makes of it."""

from dataclasses import dataclass, replace

import numpy as np

from models.diagnosis.moments import plan_for
from models.diagnosis.networks.bundle import Bundle
from models.diagnosis.networks.paper import (
    PAPER_EQUATIONS,
    PaperDiagnostician,
    PaperHealthy,
    PaperNetwork,
)
from models.diagnosis.readings import Diagnosis
from models.diagnosis.window import SlidingWindow, WindowStatistics
from models.machine import Machine
from models.physics.lyapunov import stochastic_covariance, synchronous_response
from models.physics.matrices import STATE_INDEX
from simulator.campaigns.opinions import diagnosticians, named_parameters, opinion_of
from simulator.scenario import Event, NamedSource, Scenario, Sensors
from simulator.stream import blocks
from simulator.training.draws import Purpose, with_tilt

__all__ = [
    "CONDITIONS",
    "CUTOFFS_HZ",
    "EQUATIONS",
    "NOISE_LEVELS",
    "FaultCondition",
    "Judged",
    "Run",
    "StudyPlan",
    "judge",
    "own_equations",
    "simulate",
]

CUTOFFS_HZ = (25.0, 50.0, 100.0, 200.0)
"""Cutoffs of the excitation; the paper's own four (its Table 3) are lost."""

NOISE_LEVELS = (0.01, 0.02, 0.03, 0.04, 0.05)
"""Coloured noise at the sensors in parts of each channel's rms (§4.2.3)."""

EQUATIONS = tuple(equation.number for equation in PAPER_EQUATIONS)
_OWN = {name: equation.number for equation in PAPER_EQUATIONS for name in equation.parameters}
_NOISE_CORNER_HZ = 200.0
_BLOCK_S = 5.0


@dataclass(frozen=True, slots=True)
class FaultCondition:
    """One row of the paper's Table 2: its number, its name there, and the change in physical parameters."""

    number: int
    name: str
    faults: dict[str, float]


CONDITIONS: tuple[FaultCondition, ...] = (
    FaultCondition(0, "healthy", {}),
    FaultCondition(1, "k11", {"k_by": -0.2}),
    FaultCondition(2, "c11", {"c_by": -0.2}),
    FaultCondition(3, "c44", {"c_bz": -0.2}),
    FaultCondition(4, "e", {"e": 0.2}),
    FaultCondition(5, "c11 + c44", {"c_by": -0.2, "c_bz": -0.2}),
    FaultCondition(6, "k11 + k44", {"k_by": -0.2, "k_bz": -0.2}),
    FaultCondition(7, "e + c44", {"e": 0.2, "c_bz": -0.2}),
    FaultCondition(8, "e + c11", {"e": 0.2, "c_by": -0.2}),
)
"""Healthy, and the paper's eight, each change 20 %."""


def own_equations(condition: FaultCondition) -> tuple[str, ...]:
    """Equations that contain a changed parameter: what a right location names."""
    named = {_OWN[name] for name in condition.faults}
    return tuple(number for number in EQUATIONS if number in named)


@dataclass(frozen=True, slots=True)
class StudyPlan:
    """What to run.

    Attributes
    ----------
    machine : Machine
    bundle : Bundle
        With the machine's trained networks.
    seed : int
    windows : int
        Realisations per cell; as many training windows for each cutoff.
    calibration_windows : int
        Independent healthy windows that set the limits of the paper's MSD.
    false_alarm_rate : float
        Declared, per window over all parameters or equations together.
    cutoffs_hz, noise_levels : tuple of float
    """

    machine: Machine
    bundle: Bundle
    seed: int
    windows: int
    calibration_windows: int
    false_alarm_rate: float = 0.01
    cutoffs_hz: tuple[float, ...] = CUTOFFS_HZ
    noise_levels: tuple[float, ...] = NOISE_LEVELS

    @property
    def direction(self) -> tuple[float, ...]:
        """S of Eq. 15: all six degrees of freedom alike, the tilts with a lever arm of a third of the shaft."""
        lever = self.machine.rotor.shaft_length_m / 3
        equal = np.array([1, 1, lever, 1, 1, lever])
        return tuple((equal / np.linalg.norm(equal)).tolist())

    def source(self, cutoff_hz: float) -> NamedSource:
        """The source, so loud that the healthy disc moves as much stochastically as at 1x."""
        speed = self.machine.operation.speed_rad_s
        unit = NamedSource.model_validate(
            {"name": "source", "cutoff_hz": cutoff_hz, "direction": self.direction, "force_rms_N": 1.0}
        )
        variance = np.diag(stochastic_covariance(self.machine.rotor, speed, (unit,)))
        q1, q2 = synchronous_response(self.machine.rotor, speed)
        disc = [STATE_INDEX["y2"], STATE_INDEX["z2"]]
        level = float(np.sqrt(np.sum(q1[disc] ** 2 + q2[disc] ** 2) / 2 / np.sum(variance[disc])))
        return unit.model_copy(update={"force_rms_N": level})


@dataclass(frozen=True, slots=True)
class Run:
    """One window to simulate.

    Attributes
    ----------
    condition : int
        Number in `CONDITIONS`.
    cutoff_hz, noise_relative : float
    realisation : tuple of int
        All that decides its random numbers, beside the plan's seed.
    """

    condition: int
    cutoff_hz: float
    noise_relative: float
    realisation: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Judged:
    """What the diagnosticians made of one window.

    Attributes
    ----------
    named : dict of str to (tuple of str or None)
        Method to the equations whose parameters it names; None where it could not judge the window.
    msd : dict of str to dict of str to float
        Method to equation to mean squared deviation, for the methods that have one.
    """

    named: dict[str, tuple[str, ...] | None]
    msd: dict[str, dict[str, float]]


def simulate(plan: StudyPlan, run: Run) -> WindowStatistics:
    """Simulate one window, tilt included: equation 30 needs it, and the machine's own channels stay what they are."""
    rig = with_tilt(plan.machine)
    sizes = plan_for(rig)
    scenario = Scenario(
        name=f"study {run.condition} {run.realisation}",
        machine=rig.name,
        seed=int(np.random.default_rng([plan.seed, *run.realisation]).integers(2**62)),
        duration_s=(sizes.preamble + sizes.hops * sizes.hop) / rig.rate_hz,
        sources=(plan.source(run.cutoff_hz),),
        sensors=Sensors(noise_relative=run.noise_relative, noise_corner_hz=_NOISE_CORNER_HZ),
        events=tuple(
            Event(at_s=0, parameter=name, relative_change=change)
            for name, change in CONDITIONS[run.condition].faults.items()
        ),
    )
    window = SlidingWindow(sizes)
    for block, _ in blocks(scenario, rig, block_s=_BLOCK_S):
        for _ in window.feed(sizes.to_si(block.samples), block.start_ns):
            pass
    statistics = window.statistics()
    if statistics is None:
        raise AssertionError("the scenario lasts one window by construction")
    return statistics


def judge(plan: StudyPlan, networks: tuple[PaperNetwork, ...], limits: dict[str, PaperHealthy], run: Run) -> Judged:
    """Simulate one window and ask every diagnostician.

    Parameters
    ----------
    plan : StudyPlan
    networks : tuple of PaperNetwork
    limits : dict of str to PaperHealthy
        For each kind of realisation; runs of the training's own realisations are held to ``shared``.
    run : Run
    """
    whole = simulate(plan, run)
    machine = plan.machine
    seen = _seen_by(machine, whole)
    shared = run.realisation[0] == Purpose.TRAINING
    paper = PaperDiagnostician(machine, networks, limits["shared" if shared else "independent"])
    opinion = paper.diagnose(whole)
    named: dict[str, tuple[str, ...] | None] = {"paper": paper.flagged_equations(opinion)}
    msd = {"paper": _deviations(opinion)}
    for one in diagnosticians(machine, plan.bundle):
        # Equation 30 needs tilt; the others judge by the machine's own channels.
        other = opinion_of(one, whole if one.by == "relation" else seen)
        parameters = named_parameters(other, plan.false_alarm_rate)
        named[one.by] = None if parameters is None else _equations_of(parameters)
        if other is not None and other.equations:
            msd[one.by] = _deviations(other)
    return Judged(named, msd)


def _deviations(diagnosis: Diagnosis) -> dict[str, float]:
    return {reading.equation: reading.msd for reading in diagnosis.equations if reading.msd is not None}


def _equations_of(parameters: tuple[str, ...]) -> tuple[str, ...]:
    """Equations that contain any of the parameters."""
    equations = {_OWN[name] for name in parameters}
    return tuple(number for number in EQUATIONS if number in equations)


def _seen_by(machine: Machine, window: WindowStatistics) -> WindowStatistics:
    """The window as the machine's own channels see it, without what was simulated besides."""
    keep = [n for n, name in enumerate(window.states) if name in machine.descriptor.states]
    q, hop_q = window.synchronous, window.hop_synchronous
    return replace(
        window,
        states=tuple(window.states[n] for n in keep),
        correlation=window.correlation[:, keep][:, :, keep],
        hop_correlation=window.hop_correlation[:, :, keep][:, :, :, keep],
        spectrum=window.spectrum[:, keep][:, :, keep],
        synchronous=None if q is None else q[keep],
        hop_synchronous=None if hop_q is None else hop_q[:, keep],
    )
