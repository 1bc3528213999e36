"""Run-out, the vector of a probe at slow roll, is subtracted from 1x, in its level and in the diagnosis."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.levels.judgement import LevelJudge
from models.levels.measures import WindowLevels
from models.machine import Machine, MachineFile, load_machine, load_machine_file
from models.signals.block import FloatArray
from rotorwatch.records.levels import ChannelLevels
from tests.sure import sure
from tests.windows import fed, healthy_samples

PROBE = {"quantity": "displacement", "location": "DE", "unit": "mm"}
RUNOUT = {"slow_roll_um_pp": 12.0, "slow_roll_phase_lag_deg": 250.0}
PUMP: dict[str, Any] = {
    "site": "s", "name": "pump", "rate_hz": 1024.0, "dtype": "float64",
    "window": {"length_s": 16.0, "hop_s": 4.0, "segment_s": 2.0, "max_span_s": 20.0, "lag_step_s": 1 / 1024},
    "sensors": [
        PROBE | {"name": "VE-1X", "direction": "X", **RUNOUT},
        PROBE | {"name": "VE-1Y", "direction": "Y"},
        {"name": "KPH", "quantity": "shaft_angle", "location": "shaft", "direction": "rotation", "unit": "rad"},
    ],
}  # fmt: skip


def at_1x(um_pp: float, lag_deg: float, theta: FloatArray, turned: int) -> FloatArray:
    """Displacement in mm whose positive peak comes when the shaft has turned by the lag."""
    return np.asarray(um_pp / 2000 * np.cos(theta - turned * np.radians(lag_deg)))


def window_of(machine: MachineFile, samples: FloatArray) -> SlidingWindow:
    return fed(plan_for(machine, levels=True, lagged=False), samples)


def levels(machine: MachineFile, samples: FloatArray) -> tuple[WindowLevels, tuple[ChannelLevels, ...]]:
    window = window_of(machine, samples)
    found, plan = sure(window.levels()), window.plan
    channels = [machine.sensors[column] for column in plan.columns]
    return found, LevelJudge(sure(plan.levels), channels, machine.levels).judge(found, None)


@pytest.mark.parametrize("turned", [1, -1])
@pytest.mark.parametrize("lag_deg", [0.0, 30.0, 120.0, 250.0, 300.0])
def test_subtracting_the_slow_roll_vector_recovers_the_vibration(turned: int, lag_deg: float) -> None:
    machine = MachineFile.model_validate(PUMP)
    theta = turned * 2 * np.pi * 25 * np.arange(20 * 1024) / 1024
    both = at_1x(40, lag_deg, theta, turned) + at_1x(12, 250, theta, turned)
    rest = 0.003 * np.cos(3.7 * theta)
    _, (x, y) = levels(machine, np.column_stack([both + rest, both + rest, theta % (2 * np.pi)]))
    assert x.x1 == pytest.approx(40e-3, rel=1e-3)
    assert (sure(x.x1_phase_lag_deg) - lag_deg + 180) % 360 - 180 == pytest.approx(0, abs=0.1)
    vector = 40 * np.exp(-1j * np.radians(lag_deg)) + 12 * np.exp(-1j * np.radians(250))
    assert y.x1 == pytest.approx(abs(vector) / 1000, rel=1e-3)  # no slow roll is given for it
    assert y.x1_phase_lag_deg == pytest.approx(-np.degrees(np.angle(vector)) % 360, abs=0.1)
    # All but the 1x vector is as measured, including the vibration without 1x.
    for measure in ("overall", "peak", "not_x1", "x2", "crest"):
        assert getattr(x, measure) == getattr(y, measure)
    assert x.not_x1 == pytest.approx(0.003 / np.sqrt(2), rel=0.01)


@cache
def simulated() -> tuple[Machine, FloatArray]:
    machine = load_machine("lab").model_copy(update={"dtype": "float64"})
    return machine, healthy_samples(machine, 64.0, 31_207)


def with_slow_roll(machine: Machine, **more: dict[str, object]) -> Machine:
    fields = machine.model_dump()
    for sensor in fields["sensors"]:
        if sensor["name"] == "y1":
            sensor |= {"slow_roll_um_pp": 16.0, "slow_roll_phase_lag_deg": 75.0}
        sensor.update(more.get(sensor["name"], {}))
    return Machine.model_validate(fields)


def statistics(machine: Machine, samples: FloatArray) -> WindowStatistics:
    return sure(window_of(machine, samples).statistics())


def with_run_out(samples: FloatArray) -> FloatArray:
    seen = samples.copy()
    seen[:, 0] += 1000 * at_1x(16, 75, samples[:, -1], 1)
    return seen


def test_sensors_are_judged_without_run_out_compensation() -> None:
    machine, samples = simulated()
    compensated, measured = (statistics(one, with_run_out(samples)) for one in (with_slow_roll(machine), machine))
    assert abs(sure(compensated.synchronous)[0] - sure(measured.synchronous)[0]) == pytest.approx(8e-6)
    assert np.array_equal(compensated.spectrum, measured.spectrum)
    assert np.array_equal(sure(compensated.as_mounted.synchronous), sure(measured.synchronous))
    assert sensor_findings(compensated, None, machine.sensors) == sensor_findings(measured, None, machine.sensors)


def test_run_out_of_probes_at_an_angle_is_subtracted_as_mounted() -> None:
    machine, samples = simulated()
    angles: dict[str, dict[str, object]] = {
        "y1": {"angle_deg": 45.0, "direction": "X"},
        "z1": {"angle_deg": 135.0, "direction": "Y"},
    }
    turned, seen = with_slow_roll(machine, **angles), samples.copy()
    seen[:, 0], seen[:, 1] = (samples[:, 0] + samples[:, 1]) / 2**0.5, (samples[:, 1] - samples[:, 0]) / 2**0.5
    expected = sure(statistics(machine, samples).synchronous)
    found = sure(statistics(turned, with_run_out(seen)).synchronous)
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


def test_a_slow_roll_vector_does_not_change_the_stream() -> None:
    machine, _ = simulated()
    compensated = with_slow_roll(machine)
    assert compensated.descriptor == machine.descriptor
    assert load_machine("lab").model_dump() == load_machine_file("lab").model_dump()
    assert "slow_roll" not in machine.model_dump_json()
    assert Machine.model_validate(compensated.model_dump()) == compensated


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"slow_roll_um_pp": 5.0}, "VE-1X: slow_roll_um_pp is given without slow_roll_phase_lag_deg"),
        ({"slow_roll_phase_lag_deg": 5.0}, "VE-1X: slow_roll_phase_lag_deg is given without slow_roll_um_pp"),
        (
            RUNOUT | {"quantity": "velocity", "unit": "mm/s"},
            "VE-1X: slow_roll_um_pp is 12, but run-out is that of a displacement, and this measures velocity",
        ),
        (RUNOUT | {"slow_roll_um_pp": -1.0}, "slow_roll_um_pp"),
        (RUNOUT | {"slow_roll_phase_lag_deg": 400.0}, "slow_roll_phase_lag_deg"),
    ],
)
def test_invalid_slow_roll_vectors_are_refused(fields: dict[str, object], says: str) -> None:
    probe = {"name": "VE-1X", "direction": "X"} | PROBE | fields
    with pytest.raises(ValidationError, match=says):
        MachineFile.model_validate(PUMP | {"sensors": [probe, *PUMP["sensors"][1:]]})


def test_a_slow_roll_vector_without_a_phase_reference_is_refused() -> None:
    says = "VE-1X has a slow-roll vector, and no sensor measures the shaft angle: without a phase reference"
    with pytest.raises(ValidationError, match=says):
        MachineFile.model_validate(PUMP | {"sensors": PUMP["sensors"][:2]})
