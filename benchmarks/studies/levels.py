"""What vibration levels find, and what they raise for nothing: doublings, varying excitation, a rolling bearing.

Streams are fed to the monitor itself, block by block, and what it raises is counted.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt
import scipy.stats

from benchmarks.studies import results as r
from benchmarks.studies.level_streams import KINDS, WINDOW, At, Defect, Gains, drawn, generator
from benchmarks.studies.results import Estimate, Goal, Record, Table, Value
from benchmarks.studies.study import Cell, Options, Study
from benchmarks.studies.watched import Raised, commissioned, raised
from models.alarm_names import LEVEL
from models.commissioning.commissioned import Installed
from models.diagnosis.verdict.calibration import MONTH_S
from models.machine import Machine, MachineFile, load_machine
from models.signals.block import FloatArray, SampleBlock
from models.signals.channels import Quantity
from service.monitor.monitor import MachineMonitor
from simulator.scenario import Event
from simulator.stream import blocks
from simulator.training.draws import Draw, Layout, Purpose, draw_condition

_LENGTH_S = WINDOW["length_s"]
_FIRST_S = 5 * _LENGTH_S + 2.0
"""The reference of a machine of which nothing is known, and what is needed before its first hop."""
_DOUBLED = ("overall", "1x", "2x")
"""Their place is part of the seed."""
_KITS = ("rotor kit, commissioned at level full", "rotor kit, commissioned at level none")
REFERENCES = ("first windows", "commissioned")
SPREADS, DRAWN = (0.1, 0.2), ("inside the reference's range", "same distribution")
VARYING = "velocity sensors, speed in the machine file"
_BEARING, _IN_SNAPSHOTS = "accelerometers, 12.8 kHz", "accelerometers, 12.8 kHz, 0.1 s every 10 s"
_KIT_BLOCK_S = 0.5

ComplexArray = npt.NDArray[np.complex128]


# Doublings


def _outcome(doubled: str, step_s: float, of: Iterable[Raised], channel: str = "") -> dict[str, Value]:
    """What was raised within two windows of a doubling, and whether anything was before."""
    found = list(of)
    after = [one for one in found if step_s < one.at_s <= step_s + 2 * _LENGTH_S]
    of_level = [one for one in after if one.name.startswith(LEVEL + channel)]
    return {
        "doubled": doubled,
        "any": bool(after),
        "level": bool(of_level),
        "delay_s": of_level[0].at_s - step_s if of_level else None,
        "early": any(one.at_s <= step_s for one in found),
        "first": after[0].name if after else "",
    }


def _doublings(options: Options, case: int, machine: str, number: int) -> Iterator[dict[str, Value]]:
    """One machine, in three streams of its own that differ in what doubles at one of its sensors."""
    scene = drawn(KINDS[machine], generator(options.seed, case, number, At.CONDITION))
    for at, doubled in enumerate(_DOUBLED):
        rng = generator(options.seed, case + 10 * (at + 1), number, At.EVALUATION)
        step_s = _FIRST_S + float(rng.uniform(1, 2)) * _LENGTH_S
        channel = int(rng.integers(2))
        course = partial(_stepped, doubled, step_s, channel)
        monitor = MachineMonitor(Installed(scene.machine))
        stream = scene.blocks(rng, step_s + 2 * _LENGTH_S + 1, course)
        yield _outcome(doubled, step_s, raised(monitor, stream), scene.machine.sensors[channel].name)


def _stepped(doubled: str, step_s: float, channel: int, t: FloatArray) -> Gains:
    """Gains of a step; it comes at the start of the first block after its time."""
    lines, noise = np.ones((3, 2)), np.ones(2)
    if t[0] >= step_s:
        lines[{"overall": slice(None), "1x": slice(0, 1), "2x": slice(1, 2)}[doubled], channel] = 2.0
        noise[channel] = 2.0 if doubled == "overall" else 1.0
    return Gains(lines, noise)


def _kit() -> Machine:
    machine = load_machine("lab")
    window = type(machine.window).model_validate(machine.window.model_dump() | WINDOW)
    return machine.model_copy(update={"window": window})


def _second_order(kit: Machine, speed_rad_s: float, healthy: Sequence[SampleBlock], ratio: complex) -> ComplexArray:
    """Amplitudes of 2x as of a misaligned coupling, for each column: the same part of 1x in every displacement."""
    samples = np.concatenate([block.samples for block in healthy])
    theta = next(n for n, one in enumerate(kit.sensors) if one.quantity is Quantity.SHAFT_ANGLE)
    once = 2 * np.abs((samples * np.exp(-1j * samples[:, theta, None])).mean(axis=0))
    found = np.zeros(len(kit.sensors), dtype=np.complex128)
    at = {(one.quantity, one.location, one.direction): n for n, one in enumerate(kit.sensors)}
    for (quantity, location, direction), column in at.items():
        if quantity is Quantity.DISPLACEMENT:
            found[column] = ratio * once[column]
            rate = at[Quantity.VELOCITY, location, direction]
            to_unit = kit.sensors[column].to_si / kit.sensors[rate].to_si
            found[rate] = 2j * speed_rad_s * found[column] * to_unit
    return found


def _with_2x(kit: Machine, stream: Iterable[SampleBlock], twice: ComplexArray, step_s: float) -> Iterator[SampleBlock]:
    """The stream with a line at 2x, twice as large from a time on."""
    theta = next(n for n, one in enumerate(kit.sensors) if one.quantity is Quantity.SHAFT_ANGLE)
    first_ns: int | None = None
    for block in stream:
        first_ns = block.start_ns if first_ns is None else first_ns
        gain = 2.0 if (block.start_ns - first_ns) / 1e9 >= step_s - 1e-6 else 1.0
        line = np.real(gain * twice * np.exp(2j * block.samples[:, theta, None].astype(np.float64)))
        yield replace(block, samples=(block.samples + line).astype(block.samples.dtype))


def _kit_doublings(options: Options, case: int, machine: str, number: int) -> Iterator[dict[str, Value]]:
    """One commissioning of the rotor kit in a condition of its own, and three streams against it."""
    kit = _kit()
    file: MachineFile = kit
    if machine.endswith("none"):
        known = kit.model_dump(mode="json", exclude={"rotor", "operation", "condition"})
        file = MachineFile.model_validate(known)
    draw = Draw(kit, options.seed, Purpose.EVALUATION, stream=9000 + case, layout=Layout.INDEPENDENT)
    condition = draw_condition(draw, number)
    speed_rad_s = next(event.speed_rpm for event in condition.events if event.speed_rpm) * np.pi / 30
    rng = generator(options.seed, case, number, At.CONDITION)
    ratio = complex(np.exp(rng.uniform(np.log(0.05), np.log(0.3)) + 2j * np.pi * rng.random()))

    def simulated(own: np.random.Generator, seconds: float, faults: Sequence[Event] = ()) -> Iterator[SampleBlock]:
        scenario = condition.overridden(seed=int(own.integers(2**62)), duration_s=seconds, faults=faults)
        return (block for block, _ in blocks(scenario, kit, block_s=_KIT_BLOCK_S))

    of_reference = generator(options.seed, case, number, At.REFERENCE)
    healthy = list(simulated(of_reference, (8 if options.small else 15) * _LENGTH_S + 5.0))
    twice = _second_order(kit, speed_rad_s, healthy, ratio)
    if file is kit:  # the theory of a linear rotor has no 2x, and is mostly refused where there is one
        twice = np.zeros_like(twice)
    installed = commissioned(file, _with_2x(kit, healthy, twice, np.inf))
    for at, doubled in enumerate(_DOUBLED[:2] if file is kit else _DOUBLED):
        if isinstance(installed, str):
            yield {"doubled": doubled, "refused": installed}
            continue
        own = generator(options.seed, case + 10 * (at + 1), number, At.EVALUATION)
        step_s = round(float(own.uniform(2, 3)) * _LENGTH_S / _KIT_BLOCK_S) * _KIT_BLOCK_S
        faults = [Event(at_s=step_s, parameter="e", relative_change=1.0)] if doubled != "2x" else []
        faults += [Event(at_s=step_s, excitation_level=2.0)] if doubled == "overall" else []
        stream = simulated(own, step_s + 2 * _LENGTH_S + 1, faults)
        changed = _with_2x(kit, stream, twice, np.inf if doubled == "1x" else step_s)
        yield _outcome(doubled, step_s, raised(MachineMonitor(installed), changed))


# Excitation that varies


def _varying(options: Options, case: int, reference: str, varied: str, number: int) -> Iterator[dict[str, Value]]:
    """A healthy machine whose noise has another level in every window, log-normal as it had in the reference."""
    spread = next(one for one in SPREADS if varied.startswith(f"{one:g}"))
    condition = generator(options.seed, case, number, At.CONDITION)
    scene = drawn(replace(KINDS[VARYING], rate_hz=1280.0), condition, noise_over_1x=(1.0, 3.0))
    learned, watched = (generator(options.seed, case, number, at) for at in (At.REFERENCE, At.EVALUATION))
    first = reference == "first windows"
    windows = 6 if first else 10 if options.small else 30
    seen = np.exp(spread * learned.standard_normal(windows))
    installed: Installed | str = Installed(scene.machine)
    seconds = _LENGTH_S * (20 if options.small else 270)
    known = seen[:5] if first else seen
    count = round(seconds / _LENGTH_S)
    later = np.exp(spread * watched.standard_normal(count))
    if varied.endswith(DRAWN[0]):
        later = watched.uniform(known.min(), known.max(), count)
    levels = later
    if first:
        levels = np.concatenate([seen, later])
        seconds += windows * _LENGTH_S
    else:
        healthy = scene.blocks(learned, windows * _LENGTH_S + 5.0, partial(_levelled, seen))
        installed = commissioned(scene.machine, healthy)
    if isinstance(installed, str):
        yield {"refused": installed}
        return
    found = list(raised(MachineMonitor(installed), scene.blocks(watched, seconds, partial(_levelled, levels))))
    yield {
        "hours": (seconds - (windows * _LENGTH_S if first else 0.0)) / 3600,
        "alarms": sum(one.name.startswith(LEVEL) for one in found),
        "other": sum(not one.name.startswith(LEVEL) for one in found),
    }


def _levelled(levels: FloatArray, t: FloatArray) -> Gains:
    level = float(levels[min(levels.size - 1, int(t[0] / _LENGTH_S))])
    return Gains(np.ones((3, 2)), np.full(2, level))


# A rolling bearing


def _bearing(options: Options, case: int, machine: str, number: int) -> Iterator[dict[str, Value]]:
    """A defect that grows until the first alarm, or until its impacts have twenty times the healthy rms."""
    rng = generator(options.seed, case, number, At.CONDITION)
    kind = replace(KINDS["accelerometers, speed in the machine file"], rate_hz=12800.0)
    if machine == _IN_SNAPSHOTS:
        kind = replace(kind, schedule=(0.1, 10.0))
    scene = drawn(kind, rng)
    # Everything goes on so many times more slowly where windows are longer.
    slower = scene.machine.window.length_s / _LENGTH_S
    defect = Defect(
        begins_s=slower * (_FIRST_S + float(rng.uniform(1, 2)) * (3 if options.small else 10) * _LENGTH_S),
        growth_s=slower * (60.0 if options.small else 600.0),
        rolling_hz=scene.speed_hz * float(rng.uniform(3, 6)),
        resonance_hz=float(rng.uniform(3000, 5000)),
        damping=float(rng.uniform(0.01, 0.05)),
    )
    own = generator(options.seed, case, number, At.EVALUATION)
    stream = replace(scene, defect=defect).blocks(own, defect.begins_s + defect.growth_s + slower * _LENGTH_S, _steady)
    first = next(raised(MachineMonitor(Installed(scene.machine)), stream), None)
    early = first is not None and first.at_s <= defect.begins_s
    ratio = None if first is None or early else defect.overall(first.at_s)
    yield {
        "early": early,
        "ratio": ratio,
        "found": ratio is not None and ratio < 2,
        "first": "" if first is None else first.name,
    }


def _steady(_: FloatArray) -> Gains:
    return Gains(np.ones((3, 2)), np.ones(2))


# What is added up


def _measure(options: Options, _: None, cell: Cell, number: int) -> list[dict[str, Value]]:
    topic, case = cell.given
    machine, varied = str(cell.keys["machine"]), str(cell.keys["excitation"])
    match topic:
        case "doubling":
            measured = _kit_doublings if machine in _KITS else _doublings
            return list(measured(options, case, machine, number))
        case "varying":
            return list(_varying(options, case, machine, varied, number))
    return list(_bearing(options, case, machine, number))


def _of(topic: str) -> Callable[[Sequence[Record]], list[Record]]:
    return partial(r.where, topic=topic)


def summed(column: str, rows: Sequence[Record]) -> float:
    """Sum of a column."""
    return float(r.floats(row.get(column) for row in rows).sum())


def per_month(rows: Sequence[Record]) -> Estimate | None:
    """Alarms per machine and month, with the exact interval of a Poisson count."""
    count, months = round(summed("alarms", rows)), summed("hours", rows) * 3600 / MONTH_S
    if not months:
        return None
    low = 0.0 if not count else float(scipy.stats.chi2.ppf(0.025, 2 * count)) / 2
    high = float(scipy.stats.chi2.ppf(0.975, 2 * count + 2)) / 2
    return Estimate(count / months, low / months, high / months, len(rows))


_TABLES = (
    Table(
        "levels-doubling",
        ("machine", "doubled"),
        {
            "any alarm": r.share("any"),
            "alarm of the level": r.share("level"),
            "delay of that, median s": r.middle("delay_s"),
            "alarm before": r.share("early"),
            "commissioning refused": lambda rows: r.rate("refused" in row for row in rows),
        },
        _of("doubling"),
        "A doubling, and whether an alarm was raised within two windows (40 s):",
    ),
    Table(
        "levels-varying",
        ("machine", "excitation"),
        {
            "hours": partial(summed, "hours"),
            "level alarms": partial(summed, "alarms"),
            "per machine and month": per_month,
            "other alarms": partial(summed, "other"),
        },
        _of("varying"),
        "Healthy machines whose excitation varies; spread of its logarithm, and what it is drawn from:",
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
    doublings, by = _of("doubling")(records), ("machine", "doubled")
    yield r.within("a doubling raises an alarm within two windows", r.each(doublings, by, r.share("any")), 0.95, 1.0)
    yield r.within("the alarm of the level does", r.each(doublings, by, r.share("level")), 0.95, 1.0)
    inside = [row for row in _of("varying")(records) if str(row["excitation"]).endswith(DRAWN[0])]
    yield r.at_most("level alarms per month, excitation inside the reference's range", per_month(inside), 1.0)
    bearing = _of("bearing")(records)
    yield r.at_least("a bearing's defect found below twice the healthy overall", r.share("found")(bearing), 0.95)
    yield r.at_most("an alarm before the defect begins", r.share("early")(bearing), 0.0)


def levels(options: Options) -> Study:
    """Vibration levels on streams."""
    plan: list[tuple[str, str, str, float]] = [
        *(("doubling", machine, "", 2.0) for machine in KINDS),
        *(("doubling", machine, "", 1.0) for machine in _KITS),
        *(("bearing", machine, "", 3.6) for machine in (_BEARING, _IN_SNAPSHOTS)),
        *(("varying", of, f"{spread:g}, {how}", 0.5) for of in REFERENCES for spread in SPREADS for how in DRAWN),
    ]
    cells = tuple(
        Cell(
            {"topic": topic, "machine": machine, "excitation": varied},
            max(1, round(options.windows * (1.0 if options.small else weight))),
            (topic, 100 * (at + 1)),
        )
        for at, (topic, machine, varied, weight) in enumerate(plan)
    )
    return Study(name="levels", cells=cells, measure=partial(_measure, options), tables=_TABLES, goals=_goals)
