"""Sensor faults on a healthy machine: named, attributed to data health, or mistaken for a fault of the machine."""

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial

import numpy as np

from benchmarks.studies.reporting import results as r
from benchmarks.studies.reporting.opinions import opinion
from benchmarks.studies.reporting.results import Goal, Record, Table, Value
from benchmarks.studies.reporting.study import Cell, Options, Study
from benchmarks.studies.subjects.machines import SHIPPED, commissioned, subject_named
from models.commissioning.commissioned import KnowledgeLevel
from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.reference import SensorReference, learn_sensor_reference
from models.machine import Machine
from models.physics.rotor import STATE_INDEX
from models.signals.channels import Channel, Quantity, state_name
from simulator.plant import theoretical_moments
from simulator.scenario import Event, Scenario
from simulator.timeline import compile_timeline
from simulator.training.draws import Draw, Layout, Purpose, draw_condition, simulate_scenario

_FAULTS = {
    "healthy": ("none (healthy)", ""),
    "gain": ("gain ± 10–30 %", "gain"),
    "drift": ("gain drifting by ± 10–30 %", "gain"),
    "offset": ("offset of 3–10 rms", "offset"),
    "stuck": ("stuck", "stuck"),
    "clip": ("clipped at 1–2 rms", "clipped"),
    "delay": ("delay of 1–5 ms", "delay"),
    "swapped": ("swapped with another channel", "swapped"),
}
"""Fault of one channel: text, and kind as named by the sensor checks; its index is part of the seed."""
_LEVELS = (KnowledgeLevel.NONE, KnowledgeLevel.FULL)


@lru_cache(maxsize=2)
def _reference(name: str, level: KnowledgeLevel, seed: int, healthy: int) -> SensorReference:
    return learn_sensor_reference(commissioned(name, level, seed, 0, healthy)[1])


def _measure(
    options: Options, name: str, level: KnowledgeLevel, fault: str, _learned: None, number: int
) -> list[dict[str, Value]]:
    made_with = (name, level, options.seed, 2 if options.small else 6)
    reference, (diagnostician, _) = _reference(*made_with), commissioned(*made_with[:3], 0, made_with[3])
    assert not isinstance(diagnostician, str)  # noqa: S101  # a shipped machine can be commissioned
    file = subject_named(name).file(KnowledgeLevel.FULL)
    assert isinstance(file, Machine)  # noqa: S101  # a shipped machine is known
    at = list(_FAULTS).index(fault)
    draw = Draw(file, options.seed, Purpose.EVALUATION, stream=900 + at, layout=Layout(number % 2))
    scenario = draw_condition(draw, number)
    event, channel, size = _event(fault, file, scenario, np.random.default_rng([options.seed, at, number]))
    if event is not None:
        scenario = scenario.model_copy(update={"events": (*scenario.events, event)})
    window = simulate_scenario(scenario, file)
    findings = sensor_findings(window, reference, file.sensors)
    state = "" if channel is None else state_name(channel)
    known: dict[str, Value] = {
        "state": state,
        "size": size,
        "found": " ".join(dict.fromkeys(found.kind for found in findings)),
        "right": any(found.kind == _FAULTS[fault][1] and state in found.states for found in findings),
    }
    # Blamed is what is named instead of a sensor fault; that dead sensors and drifts leave a diagnosis does not count.
    return [known if findings else known | opinion(diagnostician, window, (0.01,))]


def _event(
    fault: str, machine: Machine, scenario: Scenario, rng: np.random.Generator
) -> tuple[Event | None, Channel | None, float]:
    """The event of a fault, its channel, and its size in the unit of its kind."""
    if fault == "healthy":
        return None, None, 0.0
    channels = [channel for channel in machine.sensors if channel.quantity is not Quantity.SHAFT_ANGLE]
    channel = channels[int(rng.integers(len(channels)))]
    at_s = 0.0 if rng.random() < 0.5 else float(rng.uniform(0.1, 0.6)) * scenario.duration_s
    sign = 1.0 if rng.random() < 0.5 else -1.0
    condition = compile_timeline(scenario, machine).conditions[-1][1]
    rms = float(np.sqrt(np.diag(theoretical_moments(machine, condition)))[STATE_INDEX[state_name(channel)]])
    fields: dict[str, object] = {"at_s": at_s, "sensor": channel.name, "sensor_fault": fault}
    size = 0.0
    match fault:
        case "gain" | "drift":
            size = sign * float(rng.uniform(0.1, 0.3))
            fields |= {"sensor_fault": "gain", "value_SI": 1 + size}
            fields |= {"at_s": 0.0, "ramp_s": scenario.duration_s} if fault == "drift" else {}
        case "offset":
            size = sign * float(rng.uniform(3.0, 10.0))
            fields["value_SI"] = size * rms
        case "clip":
            size = float(rng.uniform(1.0, 2.0))
            fields["value_SI"] = size * rms
        case "delay":
            size = float(rng.uniform(0.001, 0.005))
            fields["value_SI"] = size
        case "swapped":
            others = [one for one in channels if (one.quantity, one.unit) == (channel.quantity, channel.unit)]
            others.remove(channel)
            fields["swapped_with"] = others[int(rng.integers(len(others)))].name
    return Event.model_validate(fields), channel, size


def _judged(records: Sequence[Record]) -> Iterator[Record]:
    """Records with the outcome of every window; a parameter named while outside the model does not count as blamed."""
    for row in records:
        blamed = bool(row.get("named")) and not row.get("outside")
        yield {**row, "data": bool(row["found"]), "blamed": blamed, "at fault": row["fault"] != _FAULTS["healthy"][0]}


_COLUMNS = {
    "fault and channel named": r.share("right"),
    "said to be the data": r.share("data"),
    "machine blamed": r.share("blamed"),
}


def _goals(records: Sequence[Record]) -> Iterator[Goal]:
    rows, by = list(_judged(records)), ("machine", "fault", "level")
    healthy, faulty = ([row for row in rows if row["at fault"] is one] for one in (False, True))
    yield r.within("a healthy sensor said to be at fault", r.each(healthy, by, r.share("data")), 0.0, 0.01)
    yield r.within("a faulty sensor taken for a fault of the machine", r.each(faulty, by, r.share("blamed")), 0.0, 0.01)


def sensors(options: Options) -> Study:
    """A fault of one channel of a healthy machine."""
    cells = tuple(
        Cell(
            {"machine": name, "level": level.value, "fault": text},
            options.windows,
            partial(_measure, options, name, level, fault),
        )
        for name in options.machines_among(SHIPPED, "lab")
        for level in _LEVELS
        for fault, (text, _) in _FAULTS.items()
    )
    return Study(
        name="sensors",
        cells=cells,
        tables=(
            Table("sensors", ("machine", "level", "fault"), _COLUMNS, _judged),
            Table(
                "sensors-by-fault",
                ("fault",),
                {
                    # Sensors are checked before the machine is read: both levels have the same findings.
                    **{name: r.among(of, level=KnowledgeLevel.FULL) for name, of in list(_COLUMNS.items())[:2]},
                    **{f"machine blamed, {level}": r.among(r.share("blamed"), level=level) for level in _LEVELS},
                },
                _judged,
                "All machines:",
            ),
        ),
        goals=_goals,
    )
