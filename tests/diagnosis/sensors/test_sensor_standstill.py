"""A machine that stands, starts or stops: what its sensors then show is no fault, or may be none."""

from dataclasses import replace

import numpy as np
import pytest

from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.window.moments import plan_for
from models.machine import load_machine
from tests.diagnosis.sensors.test_sensor_checks import column, found_in, only, plan_of, recorded, windows_of


@pytest.mark.parametrize("backwards", [False, True])
def test_an_angle_that_stands_still_only_while_the_machine_starts_or_stops_is_not_lost(backwards: bool) -> None:
    """Against a reference that is lost for as long, at the same vibration."""
    rate_hz, samples = plan_of("lab").rate_hz, recorded("lab", 1).copy()
    time_s = np.arange(len(samples)) / rate_hz
    starting = np.where(time_s < 4.0, 0, np.minimum((time_s - 4.0) / 7.0, 1))  # 1 s in the first hop, 7 s of run-up
    speed_hz = 22.0 * (starting[::-1] if backwards else starting)
    samples[:, -1] = 2 * np.pi * np.cumsum(speed_hz) / rate_hz % (2 * np.pi)
    assert not [one.text for one in found_in(samples) if "stood still" in one.text]
    samples[:, -1] = 2 * np.pi * 22.0 * time_s % (2 * np.pi)
    lost = slice(round(4.0 * rate_hz), round(6.0 * rate_hz))
    samples[lost, -1] = samples[lost.start, -1]
    assert "stood still for 2 s" in only(found_in(samples)).text


def test_noise_alone_may_be_a_machine_at_a_standstill() -> None:
    """Without a shaft angle, and before the machine has run, nothing else tells."""
    plan, rng = plan_for(load_machine("lab"), lagged=False), np.random.default_rng(3)
    noise = rng.standard_normal((round(63 * plan.rate_hz), len(plan.states))) * recorded("lab", 1)[:, :-1].std(axis=0)
    (window,) = windows_of(replace(plan, angle_column=None), noise)
    found = sensor_findings(window, None, load_machine("lab").sensors)
    assert {one.kind for one in found} == {"incoherent"}
    assert all(one.text.endswith("or the machine stands, as no rotation is found") for one in found)
    shaken = recorded("lab", 1)[:, :-1].copy()
    shaken[:, column("y1")] = noise[: len(shaken), column("y1")]
    (window,) = windows_of(replace(plan, angle_column=None), shaken)
    assert not any("stands" in one.text for one in sensor_findings(window, None, load_machine("lab").sensors))
