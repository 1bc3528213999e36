"""Reproduction of the paper's study: its eight fault conditions, cutoffs and noise levels, with all diagnosticians.

Everything is evaluated twice: on faulty runs that share their noise realisations with the healthy training runs of the
networks, as evidently in the paper, and on independent realisations. The operating condition is the same in both: one
source of fixed direction and level, fixed speed, the paper's four cutoffs.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.studies.methods.paper import PAPER_EQUATIONS, PaperDiagnostician, train_paper_network
from benchmarks.studies.reporting import results as r
from benchmarks.studies.reporting.opinions import TITLES, Trained, made_with, named_in
from benchmarks.studies.reporting.results import Chart, Estimate, Record, Table, Value
from benchmarks.studies.reporting.study import Cell, Options, Over, Study
from models.diagnosis.verdict.isolation import isolate_window
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine
from simulator.scenario import Event, NamedSource, Scenario, Sensors
from simulator.training.draws import Purpose, scaled, simulate_scenario, with_tilt

_CUTOFFS_HZ = (25.0, 50.0, 100.0, 200.0)  # cutoffs of the excitation; the paper's own four (its Table 3) are lost
_NOISE_LEVELS = (0.01, 0.02, 0.03, 0.04, 0.05)  # coloured sensor noise over each channel's rms (§4.2.3)
_REALISATIONS = ("shared", "independent")
_NOISE_CORNER_HZ, _NOISE_CUTOFF_HZ = 200.0, 100.0
_EQUATIONS = tuple(equation.number for equation in PAPER_EQUATIONS)
_OWN = {name: equation.number for equation in PAPER_EQUATIONS for name in equation.parameters}

CONDITIONS: dict[str, dict[str, float]] = {
    "healthy": {},
    "k11": {"k_by": -0.2},
    "c11": {"c_by": -0.2},
    "c44": {"c_bz": -0.2},
    "e": {"e": 0.2},
    "c11 + c44": {"c_by": -0.2, "c_bz": -0.2},
    "k11 + k44": {"k_by": -0.2, "k_bz": -0.2},
    "e + c44": {"e": 0.2, "c_bz": -0.2},
    "e + c11": {"e": 0.2, "c_by": -0.2},
}
"""Healthy, and the paper's eight conditions by its names, each change 20 %; their index is part of the seed."""


def own_equations(parameters: Iterable[str]) -> tuple[str, ...]:
    """Equations that contain any of the parameters, i.e. those that a correct location names for changed parameters."""
    named = {_OWN[name] for name in parameters}
    return tuple(number for number in _EQUATIONS if number in named)


_Run = tuple[dict[str, float], float, float, tuple[int, ...]]
"""True changes, cutoff, Hz, relative noise, and the key that determines the random numbers together with the seed."""


def _source(machine: Machine, cutoff_hz: float) -> NamedSource:
    """One source acting equally on all six degrees of freedom, scaled so that the disc's rms equals that at 1x.

    It is S of Eq. 15; the level is that of the healthy machine, and tilts have a lever arm of a third of the shaft.
    """
    lever = machine.rotor.shaft_length_m / 3
    equal = np.array([1, 1, lever, 1, 1, lever])
    direction = tuple((equal / np.linalg.norm(equal)).tolist())
    unit = NamedSource.model_validate(
        {"name": "source", "cutoff_hz": cutoff_hz, "direction": direction, "force_rms_N": 1.0}
    )
    return scaled((unit,), 1.0, machine, {}, machine.operation.speed_rpm)[0]


def simulate(machine: Machine, seed: int, run: _Run) -> WindowStatistics:
    """Simulate one window with additional tilt channels, which equation 30 needs; other channels are unaffected."""
    faults, cutoff_hz, noise, realisation = run
    rig = with_tilt(machine)
    sizes = plan_for(rig)
    scenario = Scenario(
        name=f"study {realisation}",
        machine=rig.name,
        seed=int(np.random.default_rng([seed, *realisation]).integers(2**62)),
        duration_s=(sizes.preamble + sizes.hops * sizes.hop) / sizes.rate_hz,
        sources=(_source(machine, cutoff_hz),),
        sensors=Sensors(noise_relative=noise, noise_corner_hz=_NOISE_CORNER_HZ),
        events=tuple(Event(at_s=0, parameter=name, relative_change=change) for name, change in faults.items()),
    )
    return simulate_scenario(scenario, rig)


def _learn(
    machine: Machine, seed: int, windows: int, cutoffs: tuple[float, ...], options: Options, over: Over
) -> dict[str, PaperDiagnostician]:
    """Train the printed networks on healthy windows, and set the limits of their MSD for both kinds of realisation."""
    count = 9 if options.small else 199
    runs: list[_Run] = [
        ({}, cutoff, _NOISE_LEVELS[0], (Purpose.TRAINING, n, r))
        for n, cutoff in enumerate(cutoffs)
        for r in range(windows)
    ]
    training = over("training windows", partial(simulate, machine, seed), runs)
    rig = with_tilt(machine)
    networks = tuple(train_paper_network(equation, training, rig, seed) for equation in PAPER_EQUATIONS)
    runs = [({}, cutoffs[n % len(cutoffs)], _NOISE_LEVELS[0], (Purpose.CALIBRATION, n)) for n in range(count)]
    calibration = over("calibration windows", partial(simulate, machine, seed), runs)
    return {
        # If test runs share the training realisations, the limit is the largest deviation among the training runs.
        "shared": PaperDiagnostician.calibrated(networks, training, 1 / (len(training) + 1)),
        "independent": PaperDiagnostician.calibrated(networks, calibration, options.rate),
    }


def _measure(
    trained: Trained, options: Options, kind: str, run: _Run, learned: dict[str, PaperDiagnostician], number: int
) -> list[dict[str, Value]]:
    faults, cutoff_hz, noise, realisation = run
    run = (faults, cutoff_hz, noise, (*realisation, number))
    whole = simulate(trained.machine, options.seed, run)
    seen = _seen_by(trained.machine, whole)
    own = " ".join(own_equations(faults))
    paper = learned[kind]
    msd = paper.deviations(whole)
    found = [_row("paper", own, " ".join(paper.flagged(msd)), msd)]
    for one in trained.diagnosticians():
        try:
            # Equation 30 needs tilt; the likelihood and the amortised networks use the machine's own channels.
            opinion = one.diagnose(whole if one.by == "relation" else seen)
        except EstimationError:  # a refused window is a result: it is counted
            found.append(_row(one.by, own, None, {}))
            continue
        changed = isolate_window(opinion, options.rate).changed if opinion.evaluable else ()
        named = " ".join(own_equations(changed)) if opinion.evaluable else None
        found.append(_row(one.by, own, named, {read.equation: read.msd for read in opinion.equations}))
    return found


def _row(by: str, own: str, named: str | None, msd: Mapping[str, float | None]) -> dict[str, Value]:
    known = {f"msd {number}": one for number, one in msd.items() if one is not None}
    return {"method": by, "own": own, "named": named, **known}


def _seen_by(machine: Machine, window: WindowStatistics) -> WindowStatistics:
    """The window reduced to the machine's own channels."""
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


def _judged(records: Iterable[Record]) -> Iterator[Record]:
    for row in records:
        named, own = named_in(row), named_in(row, "own")
        changed = row["condition"] != "healthy"
        yield {
            **row,
            "method": TITLES[str(row["method"])],
            "exact": row["named"] is not None and named == own if changed else None,
            "wrong": not named <= own if changed else None,
            "flagged": None if changed else bool(named),
            **{f"({number})": number in named for number in _EQUATIONS},
            **{f"own ({number})": number in named if number in own else None for number in _EQUATIONS},
        }


def _eight(records: Sequence[Record]) -> Iterator[Record]:
    return _judged(r.where(records, part="conditions"))


def _msd(number: str, level: float) -> r.Of[float | None]:
    return r.statistic(f"msd {number}", lambda found: np.quantile(found, level))


_TABLES = (
    Table(
        "reproduction",
        ("realisation", "method"),
        {
            "exactly the changed equations": r.share("exact"),
            "changed equations named": lambda rows: r.rate(
                row[f"own ({n})"] for row in rows for n in _EQUATIONS if row[f"own ({n})"] is not None
            ),
            "an unchanged one named": r.share("wrong"),
            "healthy windows flagged": r.share("flagged"),
        },
        _eight,
        "Who finds what, over the eight conditions and all cutoffs:",
    ),
    Table(
        "reproduction-equations",
        ("realisation", "method", "condition", "own"),
        {f"({number}) named": r.share(f"({number})") for number in _EQUATIONS},
        _eight,
    ),
    Table(
        "reproduction-noise",
        ("realisation", "method", "noise"),
        {"healthy windows flagged": r.share("flagged")},
        lambda records: _judged(r.where(records, part="noise")),
    ),
    Table(
        "reproduction-msd",
        ("part", "realisation", "method", "condition", "cutoff_hz", "noise"),
        {
            f"({number}) MSD, {100 * level:g} %": _msd(number, level)
            for number in _EQUATIONS
            for level in (0.05, 0.5, 0.95)
        },
        partial(r.where, method=("paper", "relation")),
    ),
)


def _charts(records: Sequence[Record]) -> Iterator[Chart]:
    """The paper's Figs. 5 and 6: MSD of every printed network over the cutoff, for every condition."""
    for realisation in _REALISATIONS:
        rows = r.where(records, part="conditions", method="paper", realisation=realisation)
        groups = r.grouped(rows, "condition", "cutoff_hz")
        panels = r.panels(
            (str(condition), f"equation {number}", [(f"{cutoff_hz:g}", _band(number, group))])
            for (condition, cutoff_hz), group in groups.items()
            for number in _EQUATIONS
        )
        text = f"MSD of the networks as printed, {realisation} realisations: median and 5–95 % of the windows"
        yield Chart(f"reproduction-msd-{realisation}", text, panels, "cutoff of the excitation, Hz",
                    "MSD, of the target's mean square", log=True)  # fmt: skip


def _band(number: str, rows: Sequence[Record]) -> Estimate:
    low, middle, high = (_msd(number, level)(rows) or 0.0 for level in (0.05, 0.5, 0.95))
    return Estimate(middle, low, high, len(rows))


def reproduction(options: Options) -> Study:
    """The paper's eight conditions, evaluated by its own networks and all diagnosticians."""
    trained = Trained.named(options.machine)
    cutoffs = _CUTOFFS_HZ[1:3] if options.small else _CUTOFFS_HZ
    noises = _NOISE_LEVELS[::4] if options.small else _NOISE_LEVELS
    noise_hz = min(cutoffs, key=lambda cutoff: abs(cutoff - _NOISE_CUTOFF_HZ))
    plan = [
        ("conditions", kind, name, cutoff, noises[0])
        for kind in _REALISATIONS
        for name in CONDITIONS
        for cutoff in cutoffs
    ]
    plan += [("noise", kind, "healthy", noise_hz, noise) for kind in _REALISATIONS for noise in noises]
    cells = []
    for at, (part, kind, name, cutoff, noise) in enumerate(plan):
        # Either the realisations of the training, or realisations of this cell only.
        own = (Purpose.TRAINING, cutoffs.index(cutoff)) if kind == "shared" else (Purpose.EVALUATION, at)
        measure = partial(_measure, trained, options, kind, (CONDITIONS[name], cutoff, noise, own))
        keys: dict[str, Value] = {"part": part, "realisation": kind, "condition": name}
        cells.append(Cell(keys | {"cutoff_hz": cutoff, "noise": noise}, options.windows, measure))
    return Study(
        name="reproduction",
        cells=tuple(cells),
        learn=partial(_learn, trained.machine, options.seed, options.windows, cutoffs, options),
        tables=_TABLES,
        charts=_charts,
        made_with={**made_with([trained]), "windows": str(options.windows)},
    )
