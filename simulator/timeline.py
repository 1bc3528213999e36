"""A scenario's events as conditions that hold from one sample to the next.

A ramp becomes a staircase of 0.1 s steps, each at the value of the ramp in the middle of the step::

    value                 ┌──  end
                       ┌──┘
                    ┌──┘
    start ──────────┘
                    at_s   at_s + ramp_s
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import count, takewhile
from typing import get_args

from models.machine import Machine
from models.physics.rotor import PARAMETERS
from simulator.scenario import ANOMALIES, SENSOR_FAULTS_WITH_VALUE, Event, NamedSource, Rub, Scenario, SensorFault

RAMP_STEP_S = 0.1  # length of the steps a ramp is made of
# Active faults of one sensor: kind to value, None where the kind has no value; a swap is "swapped with NAME".
SensorFaults = Mapping[str, float | None]
SWAPPED_WITH = "swapped with "  # how the kind of a swap begins
_Target = tuple[str, ...]
_Values = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Condition:
    """Parameters, speed, excitation and anomalies of the plant, from one change to the next."""

    relative_changes: Mapping[str, float]  # every diagnosed parameter's change from the original machine
    speed_rpm: float
    sources: tuple[NamedSource, ...]  # always as many and in the same order, so that the state carries over
    excitation_level: float = 1.0  # factor on the white noise that drives all sources
    # Size of each fault that no parameter describes, by kind; kinds of size 0 are left out.
    anomalies: Mapping[str, float] = field(default_factory=dict)
    rub: Rub | None = None  # where the disc may touch the casing


@dataclass(frozen=True, slots=True)
class Timeline:
    """Everything that happens, by sample number."""

    conditions: tuple[tuple[int, Condition], ...]  # ascending, the first at 0; each holds from its sample on
    sensor_faults: Mapping[str, tuple[tuple[int, SensorFaults], ...]]  # ascending; channels without events are absent
    # When a truth record is due: at the start, at every change, and every second during a ramp.
    truth: tuple[tuple[int, tuple[str, ...]], ...]


def compile_timeline(scenario: Scenario, machine: Machine) -> Timeline:
    """Turn a scenario's events into conditions by sample number.

    The machine's nominal speed holds until an event changes it; events start at the nearest sample of its rate.
    """
    rate_hz = machine.rate_hz
    events = sorted(scenario.events, key=lambda event: event.at_s)  # stable: equal times keep the file's order
    plant_events = [event for event in events if event.sensor is None]
    return Timeline(
        conditions=_conditions(plant_events, scenario, machine.operation.speed_rpm, rate_hz),
        sensor_faults={
            channel.name: _sensor_faults(
                [event for event in events if event.sensor == channel.name],
                scenario.sensors.settings(channel).noise_relative,
                rate_hz,
            )
            for channel in machine.sensors
            if any(event.sensor == channel.name for event in events)
        },
        truth=_truth_times(events, rate_hz),
    )


def _conditions(
    events: list[Event], scenario: Scenario, speed_rpm: float, rate_hz: float
) -> tuple[tuple[int, Condition], ...]:
    values: dict[_Target, _Values] = {("parameter", name): (0.0,) for name in PARAMETERS}
    values["speed_rpm",] = (speed_rpm,)
    values["excitation_level",] = (1.0,)
    values |= {("anomaly", kind): (0.0,) for kind in ANOMALIES}
    for source in scenario.sources:
        values["source", source.name, "cutoff_hz"] = (source.cutoff_hz,)
        values["source", source.name, "force_rms_N"] = (source.force_rms_N,)
        values["source", source.name, "direction"] = source.direction
    changes = _steps(values, [(event, *_plant_target(event)) for event in events], rate_hz)
    conditions = [(0, _condition(values, scenario))]
    for sample, due in _by_sample(changes):
        values.update(due)
        conditions.append((sample, _condition(values, scenario)))
    return tuple(conditions[1:] if len(conditions) > 1 and conditions[1][0] == 0 else conditions)


def _condition(values: Mapping[_Target, _Values], scenario: Scenario) -> Condition:
    def current(source: NamedSource) -> NamedSource:
        (cutoff_hz,), (force_rms_N,), direction = (
            values["source", source.name, field] for field in ("cutoff_hz", "force_rms_N", "direction")
        )
        return source.model_copy(update={"cutoff_hz": cutoff_hz, "force_rms_N": force_rms_N, "direction": direction})

    return Condition(
        relative_changes={name: values["parameter", name][0] for name in PARAMETERS},
        speed_rpm=values["speed_rpm",][0],
        sources=tuple(current(source) for source in scenario.sources),
        excitation_level=values["excitation_level",][0],
        anomalies={kind: values["anomaly", kind][0] for kind in ANOMALIES if values["anomaly", kind][0]},
        rub=scenario.rub,
    )


def _plant_target(event: Event) -> tuple[_Target, _Values]:
    if event.parameter is not None and event.relative_change is not None:
        return ("parameter", event.parameter), (event.relative_change,)
    for name in ("speed_rpm", "excitation_level"):
        value = getattr(event, name)
        if value is not None:
            return (name,), (value,)
    if event.anomaly is not None and event.size is not None:
        return ("anomaly", event.anomaly), (event.size,)
    for name in ("cutoff_hz", "force_rms_N"):
        value = getattr(event, name)
        if value is not None:
            return ("source", str(event.source), name), (value,)
    return ("source", str(event.source), "direction"), event.direction or ()


def _steps(
    start: Mapping[_Target, _Values], events: list[tuple[Event, _Target, _Values]], rate_hz: float
) -> dict[_Target, list[tuple[int, _Values]]]:
    """Staircase of each target; a later event cuts off an unfinished ramp and starts from its present value."""
    steps: dict[_Target, list[tuple[int, _Values]]] = {}
    for event, target, end in events:
        first = round(event.at_s * rate_hz)
        kept = [step for step in steps.get(target, []) if step[0] < first]
        begin = (kept[-1][1] if kept else ()) or start.get(target, ())
        steps[target] = kept + [(sample, _between(begin, end, part)) for sample, part in _ramp(event, rate_hz)]
    return steps


def _by_sample(steps: Mapping[_Target, list[tuple[int, _Values]]]) -> list[tuple[int, dict[_Target, _Values]]]:
    due: dict[int, dict[_Target, _Values]] = {}
    for target, staircase in steps.items():
        for sample, value in staircase:
            due.setdefault(sample, {})[target] = value
    return sorted(due.items(), key=lambda entry: entry[0])


def _ramp(event: Event, rate_hz: float) -> list[tuple[int, float]]:
    """Sample numbers at which the steps of a change begin, and the fraction of the change reached there."""
    stairs: dict[int, float] = {}
    begins_s = (number * RAMP_STEP_S for number in count())
    for begin_s in takewhile(lambda begin_s: begin_s < event.ramp_s - 1e-9, begins_s):
        end_s = min(begin_s + RAMP_STEP_S, event.ramp_s)
        stairs[round((event.at_s + begin_s) * rate_hz)] = (begin_s + end_s) / 2 / event.ramp_s
    stairs[round((event.at_s + event.ramp_s) * rate_hz)] = 1.0
    return list(stairs.items())


def _between(begin: _Values, end: _Values, part: float) -> _Values:
    if part == 1.0:
        return end
    return tuple(b + (e - b) * part for b, e in zip(begin, end, strict=True))


def _sensor_faults(events: list[Event], noise_relative: float, rate_hz: float) -> tuple[tuple[int, SensorFaults], ...]:
    """Active faults of one sensor by sample number; a kind that is not active has no values."""
    neutral: dict[_Target, _Values] = {("offset",): (0.0,), ("gain",): (1.0,), ("noise_relative",): (noise_relative,)}
    kinds = {kind for kind in get_args(SensorFault) if kind not in ("none", "swapped")}
    kinds |= {_kind(event) for event in events if event.sensor_fault == "swapped"}
    changes: list[tuple[Event, _Target, _Values]] = []
    for event in events:
        if event.sensor_fault == "none":
            changes += [(event, (kind,), ()) for kind in sorted(kinds)]
        else:
            changes.append((event, (_kind(event),), (event.value_SI or 0.0,)))
    steps = _steps(neutral, changes, rate_hz)
    states: list[tuple[int, SensorFaults]] = []
    active: dict[str, float | None] = {}
    for sample, due in _by_sample(steps):
        for (kind,), value in due.items():
            active.pop(kind, None)
            if value:
                active[kind] = value[0] if kind in SENSOR_FAULTS_WITH_VALUE else None
        states.append((sample, dict(active)))
    return tuple(states)


def _kind(event: Event) -> str:
    return str(event.sensor_fault) if event.swapped_with is None else f"{SWAPPED_WITH}{event.swapped_with}"


def _truth_times(events: list[Event], rate_hz: float) -> tuple[tuple[int, tuple[str, ...]], ...]:
    due: dict[int, set[str]] = {0: set()}
    for event in events:
        for seconds in (*range(math.ceil(event.ramp_s)), event.ramp_s):
            due.setdefault(round((event.at_s + seconds) * rate_hz), set())
    for sample, names in due.items():
        names.update(
            _label(event)
            for event in events
            if round(event.at_s * rate_hz) <= sample < round((event.at_s + event.ramp_s) * rate_hz)
        )
    return tuple((sample, tuple(sorted(names))) for sample, names in sorted(due.items()))


def _label(event: Event) -> str:
    if event.speed_rpm is not None:
        return "speed"
    if event.excitation_level is not None:
        return "excitation_level"
    return str(event.parameter or event.source or event.sensor or event.anomaly)
