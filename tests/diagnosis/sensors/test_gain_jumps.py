"""Jumps of gain are found without a second sensor of the motion; modes and bearings look like none, nor like delays."""

import numpy as np
import pytest

from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.level import gain_jump
from models.diagnosis.sensors.reference import Naming, implicated
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine, load_machine
from simulator.scenario import Event, Scenario, Sensors
from simulator.stream import blocks
from tests.diagnosis.sensors.test_sensor_checks import of_displacements, plan_of, recorded, sources_along, windows_of


def of_rotor(rate_hz: float, speed_rpm: float, **rotor: float) -> Machine:
    """The rotor kit with another rotor, damped well enough for segments of 2 s."""
    lab = load_machine("lab")
    update = {
        "rate_hz": rate_hz,
        "operation": lab.operation.model_copy(update={"speed_rpm": speed_rpm}),
        "rotor": lab.rotor.model_copy(update=rotor),
        "window": lab.window.model_copy(update={"segment_s": 2.0}),
    }
    return lab.model_copy(update=update)


def windows_of_scenario(machine: Machine, scenario: Scenario) -> list[WindowStatistics]:
    plan = plan_for(machine, lagged=False)
    return windows_of(plan, np.concatenate([plan.to_si(block.samples) for block, _ in blocks(scenario, machine, 1.0)]))


@pytest.mark.parametrize(
    ("state", "why"), [("y1", "either its gain jumped or the stiffness of that bearing did"), ("y2", "its gain jumped")]
)
def test_a_gain_jump_at_a_bearing_alone_may_be_the_bearing_stiffness(state: str, why: str) -> None:
    plan, samples = plan_of("lab", displacements=True), of_displacements(recorded("lab", 1))
    samples[70_000:, plan.states.index(state)] *= 1.5
    (window,) = windows_of(plan, samples)
    (finding,) = gain_jump(window, Naming(()))
    assert finding.states == (state,)
    assert finding.text.endswith(why)


def test_a_bearing_that_shows_at_the_disc_alone_is_no_gain_jump() -> None:
    """Above resonance, a softer bearing changes the 1x of the disc while that of the bearing hardly moves."""
    machine = of_rotor(
        2048.0, 1876.583394, m1_kg=0.193875746, m2_kg=0.545391407, I2_kg_m2=3.23664333e-4, I2p_kg_m2=5.04428208e-4,
        shaft_length_m=0.104408486, shaft_diameter_m=5.31653611e-3, k_by_N_per_m=21054.97355,
        k_bz_N_per_m=16726.41468, c_by_N_s_per_m=24.5529016, c_bz_N_s_per_m=24.9332299, e_m=1.01900454e-5,
    )  # fmt: skip
    machine = machine.model_copy(
        update={"sensors": tuple(one for one in machine.sensors if one.quantity != "displacement")}
    )
    sources = sources_along(np.eye(6)[[0, 3, 1, 4]], 64.6097185, 0.0581542572)
    scenario = Scenario(
        machine="lab", seed=37, duration_s=66.0, sources=sources,
        sensors=Sensors(noise_relative=0.01099032, noise_corner_hz=256.0),
        events=(Event(at_s=42.0, parameter="k_bz", relative_change=-0.3),),
    )  # fmt: skip
    (window,) = windows_of_scenario(machine, scenario)
    assert not [*gain_jump(window, Naming(()))]


@pytest.mark.slow
def test_with_displacements_alone_a_gain_jump_in_one_channel_is_found() -> None:
    """Found where the 1x part stands out enough, and never attributed to another channel."""
    plan = plan_of("lab", displacements=True)
    found: list[float] = []
    for seed in (1, 23, 24):
        samples = of_displacements(recorded("lab", seed))
        (healthy,) = windows_of(plan, samples)
        assert sensor_findings(healthy) == ()
        samples[70_000:, plan.states.index("y2")] *= 0.7
        (window,) = windows_of(plan, samples)
        findings = sensor_findings(window)
        assert implicated(findings) <= {"y2"}
        found += [finding.value or 0.0 for finding in findings]
    assert len(found) >= 1
    np.testing.assert_allclose(found, -0.3, atol=0.1)


def test_a_mode_at_1x_under_one_source_is_no_delay() -> None:
    """What leaks from a mode into the bins beside it looks like cross-axis sensitivity, of hardly known size."""
    machine = of_rotor(
        1000.0, 595.7414887, m1_kg=0.96748409, m2_kg=1.63235276, I2_kg_m2=8.16828961e-3, I2p_kg_m2=1.46815640e-2,
        shaft_length_m=0.24440519, shaft_diameter_m=0.01139127, k_by_N_per_m=1.2 * 8712.931747,
        k_bz_N_per_m=1.2 * 9986.380855, c_by_N_s_per_m=18.04738909, c_bz_N_s_per_m=28.08358242, e_m=4.16782861e-5,
    )  # fmt: skip
    direction = np.array([[0.49981451, 0.78634276, 0.0, 0.26183574, 0.25158013, 0.0]])
    sources = sources_along(direction, 43.21970969, 0.17589793, order=1)
    sensors = Sensors(noise_relative=0.03995226, noise_corner_hz=125.0)
    scenario = Scenario(machine="lab", seed=93, duration_s=66.0, sources=sources, sensors=sensors)
    assert [sensor_findings(window) for window in windows_of_scenario(machine, scenario)] == [()]
