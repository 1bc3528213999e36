"""Faults found by vibration levels: doubled levels on machines of every kind, and a defect of a rolling bearing.

Streams are fed to the monitor block by block, and the alarms that it raises are counted.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.studies.reporting import results as r
from benchmarks.studies.reporting.results import Goal, Record, Table, Value
from benchmarks.studies.reporting.study import Cell, Options, Study
from benchmarks.studies.subjects.fault_kinds import Rotor, Seen, as_simulated, line
from benchmarks.studies.subjects.level_streams import KINDS, At, Defect, Gains, drawn, generator, steady
from benchmarks.studies.subjects.machines import SHIPPED, SUBJECTS
from benchmarks.studies.subjects.watched import Raised, commissioned, raised
from benchmarks.studies.subjects.watched_machine import CONDITIONS, Subject
from models.alarm_names import LEVEL
from models.commissioning.commissioned import Installed, KnowledgeLevel
from models.signals.block import FloatArray
from service.monitor.monitor import MachineMonitor

_FIRST_WINDOWS = 5  # windows of the reference of a machine that was not commissioned
_DOUBLED = ("overall", "1x", "2x")  # their index is part of the seed
_IN_NOISE = "2x, within the noise"
_KNOWN_ERRORS = 10.0  # least 2x in the reference, in standard errors of one window, i.e. known to 10 %; less is noise
_BEARING, _IN_SNAPSHOTS = "accelerometers, 12.8 kHz", "accelerometers, 12.8 kHz, 0.1 s every 10 s"
_BEARING_WINDOW_S = 20.0


# Doublings


def _outcome(doubled: str, step_s: float, length_s: float, of: Iterable[Raised], channel: str = "") -> dict[str, Value]:
    """Alarms raised within two windows after a doubling, and whether any was raised before."""
    found = list(of)
    after = [one for one in found if step_s < one.at_s <= step_s + 2 * length_s]
    of_level = [one for one in after if one.name.startswith(LEVEL + channel)]
    return {
        "doubled": doubled,
        "any": bool(after),
        "level": bool(of_level),
        "delay_s": after[0].at_s - step_s if after else None,
        "early": any(one.at_s <= step_s for one in found),
        "first": after[0].name if after else "",
    }


def _doublings(options: Options, machine: str, case: int, _: None, number: int) -> Iterator[dict[str, Value]]:
    """Three streams of one machine, which differ in the level that doubles at one of its sensors."""
    kind = replace(KINDS[machine], window_s=20.0) if options.small else KINDS[machine]
    scene = drawn(kind, generator(options.seed, case, number, At.CONDITION))
    length_s = scene.machine.window.length_s
    for at, doubled in enumerate(_DOUBLED):
        rng = generator(options.seed, case + 10 * (at + 1), number, At.EVALUATION)
        step_s = (_FIRST_WINDOWS + float(rng.uniform(1, 2))) * length_s
        channel = int(rng.integers(2))
        course = partial(_stepped, doubled, step_s, channel)
        monitor = MachineMonitor(Installed(scene.machine))
        stream = scene.blocks(rng, step_s + 2 * length_s + 1, course)
        yield _outcome(doubled, step_s, length_s, raised(monitor, stream), scene.machine.sensors[channel].name)


def _stepped(doubled: str, step_s: float, channel: int, t: FloatArray) -> Gains:
    """Gains of lines and noise; the step takes effect at the first block that starts after `step_s`."""
    lines, noise = np.ones((3, 2)), np.ones(2)
    if t[0] >= step_s:
        lines[{"overall": slice(None), "1x": slice(0, 1), "2x": slice(1, 2)}[doubled], channel] = 2.0
        noise[channel] = 2.0 if doubled == "overall" else 1.0
    return Gains(lines, noise)


def _rotor_doublings(options: Options, machine: str, case: int, _: None, number: int) -> Iterator[dict[str, Value]]:
    """One commissioning of a rotor, and up to three streams watched with it.

    A force at the bearing causes 2x motion of 0.1 to 1 times its 1x, in healthy recordings too.
    """
    name, level = machine.split(", level ")
    rng = generator(options.seed, case, number, At.CONDITION)
    part, start_rad = float(np.exp(rng.uniform(np.log(0.1), 0.0))), float(rng.uniform(0, 2 * np.pi))
    force = np.array([1, 0, 1, 0]) * (rng.standard_normal(4) + 1j * rng.standard_normal(4))

    def with_2x(rotor: Rotor, seen: Seen, _: np.random.Generator) -> Seen:
        return line(rotor, seen, 2.0, force, part, start_rad)

    # The theory of a linear rotor has no 2x, and a machine with 2x is refused.
    known = level == KnowledgeLevel.FULL.value
    subject = Subject(name, KnowledgeLevel(level), options.seed, number, as_simulated if known else with_2x)
    changes = {"overall": _doubled_overall, "1x": _doubled_1x} | ({} if known else {"2x": with_2x})
    together = commissioned(subject.file, *map(subject.healthy, range(CONDITIONS)))
    for at, (doubled, change) in enumerate(changes.items()):
        installed = together
        if isinstance(installed, str):  # the conditions are inconsistent: commission on one alone
            installed = commissioned(subject.file, subject.healthy(subject.condition(at)))
        if isinstance(installed, str):
            yield {"doubled": doubled, "refused": installed}
            continue
        found = raised(MachineMonitor(installed), subject.faulty(at, doubled, change))
        seen = _IN_NOISE if doubled == "2x" and _errors_of_2x(installed) < _KNOWN_ERRORS else doubled
        yield _outcome(seen, subject.begins_s, subject.file.window.length_s, found)


def _doubled_overall(_rotor: Rotor, seen: Seen, _rng: np.random.Generator) -> Seen:
    return seen.plus(seen.displacement, seen.velocity)


def _doubled_1x(_rotor: Rotor, seen: Seen, _rng: np.random.Generator) -> Seen:
    turning = np.exp(1j * seen.angle_rad)[:, None]
    more = [2 * (turning * (x * turning.conj()).mean(axis=0)).real for x in (seen.displacement, seen.velocity)]
    return seen.plus(*more)


def _errors_of_2x(installed: Installed) -> float:
    """Largest 2x of any sensor in the healthy reference, in standard errors of one window."""
    assert installed.commissioned is not None  # noqa: S101  # for the type checker
    reference = installed.commissioned.levels
    states = () if reference is None else reference.states
    return max(
        one["x2"].mean / one["x2"].error
        for state in states
        for one in state.levels.values()
        if "x2" in one and one["x2"].error
    )


# A rolling bearing


def _bearing(options: Options, machine: str, case: int, _: None, number: int) -> Iterator[dict[str, Value]]:
    """A bearing defect that grows until the first alarm, or until its impacts reach twenty times the healthy rms."""
    rng = generator(options.seed, case, number, At.CONDITION)
    kind = replace(KINDS["accelerometers, speed in the machine file"], rate_hz=12800.0, window_s=_BEARING_WINDOW_S)
    if machine == _IN_SNAPSHOTS:
        kind = replace(kind, schedule=(0.1, 10.0))
    scene = drawn(kind, rng)
    # The growth is slower in proportion to the length of the window.
    length_s = scene.machine.window.length_s
    slower = length_s / _BEARING_WINDOW_S
    defect = Defect(
        begins_s=(_FIRST_WINDOWS + float(rng.uniform(1, 2)) * (3 if options.small else 10)) * length_s,
        growth_s=slower * (60.0 if options.small else 600.0),
        rolling_hz=scene.speed_hz * float(rng.uniform(3, 6)),
        resonance_hz=float(rng.uniform(3000, 5000)),
        damping=float(rng.uniform(0.01, 0.05)),
    )
    own = generator(options.seed, case, number, At.EVALUATION)
    stream = replace(scene, defect=defect).blocks(own, defect.begins_s + defect.growth_s + length_s, steady)
    first = next(raised(MachineMonitor(Installed(scene.machine)), stream), None)
    early = first is not None and first.at_s <= defect.begins_s
    ratio = None if first is None or early else defect.overall(first.at_s)
    yield {
        "early": early,
        "ratio": ratio,
        "found": ratio is not None and ratio < 2,
        "first": "" if first is None else first.name,
    }


# Tables and goals


def _of(topic: str) -> Callable[[Sequence[Record]], list[Record]]:
    return partial(r.where, topic=topic)


_TABLES = (
    Table(
        "levels-doubling",
        ("machine", "doubled"),
        {
            "any alarm": r.share("any"),
            "alarm of the level": r.share("level"),
            "delay, median s": r.middle("delay_s"),
            "alarm before": r.share("early"),
            "commissioning refused": lambda rows: r.rate("refused" in row for row in rows),
        },
        _of("doubling"),
        "A doubling, and whether an alarm was raised within two windows:",
    ),
    Table(
        "levels-bearing",
        ("machine",),
        {
            "first alarm while the overall is below twice the healthy one": r.share("found"),
            "overall over the healthy one at the alarm, median": r.middle("ratio"),
            "alarm before the defect": r.share("early"),
        },
        _of("bearing"),
        "A rolling bearing whose defect grows:",
    ),
)


def _goals(records: Sequence[Record]) -> Iterator[Goal]:
    doublings = [row for row in _of("doubling")(records) if row["doubled"] != _IN_NOISE]
    yield r.at_least("a doubling raises an alarm within two windows", r.share("any")(doublings), 0.995)
    yield r.at_most("an alarm before the doubling", r.share("early")(doublings), 0.0)
    bearing = _of("bearing")(records)
    yield r.at_least("a bearing's defect found below twice the healthy overall", r.share("found")(bearing), 0.95)
    yield r.at_most("an alarm before the defect begins", r.share("early")(bearing), 0.0)


def levels(options: Options) -> Study:
    """Vibration levels on streams."""
    rotors = [f"{name}, level {level}" for name in SHIPPED for level in ("full", "none")]
    rotors += [f"{name}, level none" for name in SUBJECTS if name not in SHIPPED]
    plan = [("doubling", _doublings, machine, 14.0) for machine in KINDS]
    plan += [("doubling", _rotor_doublings, machine, 1.0) for machine in (rotors[1:2] if options.small else rotors)]
    plan += [("bearing", _bearing, machine, 25.0) for machine in (_BEARING, _IN_SNAPSHOTS)]
    cells = tuple(
        Cell(
            {"topic": topic, "machine": machine},
            max(1, round(options.windows * (1.0 if options.small else weight))),
            partial(measure, options, machine, 100 * (at + 1)),
        )
        for at, (topic, measure, machine, weight) in enumerate(plan)
    )
    return Study(name="levels", cells=cells, tables=_TABLES, goals=_goals)
