"""An unconnected sensor is shown as missing data, not as zeros; other sensors are shown as usual."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from models.commissioning.commissioned import Installed, install
from models.errors import RotorwatchError
from models.signals.block import SampleBlock
from service.analysis.past import Past
from service.analysis.recorded import Held, Sampled
from service.analysis.recorded_window import recorded_window
from service.analysis.snapshots.machine import LatestData
from service.analysis.snapshots.plots import (
    centreline_series,
    full_spectrum_snapshot,
    vector_series,
    waterfall_snapshot,
    waveform_snapshot,
)
from service.monitor.evaluators import evaluator_for
from service.monitor.monitor import MachineMonitor
from service.runtime.remote import latest_from_bytes, latest_to_bytes
from service.stream.worker import held_now
from tests.service.analysis.snapshotting import snapshots_of
from tests.service.monitor.test_monitor_missing import KIT, RIG
from tests.service.rig.live import START_NS, scenario_blocks
from tests.service.rig.replaying import recorded, recording

NAMES = [one.name for one in KIT.sensors]
SECONDS = 30.0


@cache
def dead(*names: str, between_s: tuple[float, float] = (0.0, SECONDS)) -> tuple[SampleBlock, ...]:
    lacking = np.isin(NAMES, names)
    from_ns, to_ns = (START_NS + round(one * 1e9) for one in between_s)
    return tuple(
        replace(one, samples=np.where(lacking & (from_ns <= one.start_ns < to_ns), np.nan, one.samples))
        for one in scenario_blocks(SECONDS)
    )


def shown(way: str, folder: Path, *names: str) -> tuple[LatestData, Sampled]:
    """Data held by a monitor, or read from its recording."""
    if way != "recorded":
        monitor = MachineMonitor(install(KIT, None))
        for block in dead(*names):
            monitor.step(block)
        held = held_now(monitor.window, monitor.health(), monitor.blocks)
        held = latest_from_bytes(latest_to_bytes(held)) if way == "of another process" else held
        return held, Held(KIT, held.blocks)
    data = recorded(recording(folder / "made.mcap", dead(*names), KIT))
    lagged = evaluator_for(Installed(KIT)).needs_lags
    return recorded_window(data.source, KIT, "demo/lab", None, None, lagged=lagged), data


@pytest.mark.parametrize("way", ["live", "of another process", "recorded"])
def test_a_dead_channel_is_shown_as_no_data(way: str, tmp_path: Path) -> None:
    data, samples = shown(way, tmp_path, "z1")
    said = "no data of z1: sent as NaN, not connected"
    made = snapshots_of(KIT)
    spectra, correlations, orbits = made.spectra(data), made.correlations(data), made.orbits(data, 4)
    assert (spectra.reason, correlations.reason, orbits.reason) == (said, said, said)
    assert {spectra.theory.nominal_reason, correlations.theory.nominal_reason} == {said}
    density = {one.channel: one for one in spectra.densities}
    assert set(density["z1"].measured) == {None}
    assert density["z1"].rms is None
    assert None not in density["y1"].measured
    for pair in correlations.pairs:
        assert (None in pair.measured) == ("z1" in (pair.first, pair.second))
    assert [(one.location, one.path is not None) for one in orbits.orbits] == [("disc", True)]
    places = {one.location for one in full_spectrum_snapshot(samples).places}
    assert places == {"disc"}
    wave = waveform_snapshot(samples, samples.channels(["y1", "z1"]), 4, None)
    assert [one.channel for one in wave.waveforms] == ["y1"]
    assert said in wave.reason
    assert [one.name for one in samples.chosen(())] == ["y1", "y2", "z2"]
    with pytest.raises(RotorwatchError, match=said):
        samples.chosen(["y1", "z1"])
    with pytest.raises(RotorwatchError, match=said):
        waterfall_snapshot(samples, samples.channels(["z1"])[0], "time")


def test_a_dead_casing_sensor_does_not_hide_theory() -> None:
    monitor = MachineMonitor(install(RIG, None))
    for block in scenario_blocks(SECONDS):
        gap = np.full((len(block.samples), 1), np.nan, np.float32)
        monitor.step(replace(block, samples=np.hstack([block.samples.astype(np.float32), gap])))
    spectra = snapshots_of(RIG).spectra(held_now(monitor.window, monitor.health(), monitor.blocks))
    assert spectra.reason == "no data of DE-H: sent as NaN, not connected"
    assert (spectra.theory.nominal_reason, spectra.theory.estimated_reason) == ("", "")
    assert {one.nominal is not None for one in spectra.densities} == {True}


def test_plots_of_the_history_show_the_other_sensors() -> None:
    monitor = MachineMonitor(install(KIT, None))
    reports = tuple(report for block in dead("z1") for report in monitor.step(block).windows)
    past = Past(KIT, KIT.title, "the history", reports, ())
    assert [one.location for one in centreline_series(past).places] == ["disc"]
    vectors = vector_series(past, past.channels(["y1"]), 1, 8, None)
    assert vectors.speeds_rad_s[-1] == pytest.approx(138.2, rel=0.01)


@pytest.mark.parametrize("way", ["live", "recorded"])
def test_without_its_angle_a_machine_has_no_speed_rather_than_0(way: str, tmp_path: Path) -> None:
    data, samples = shown(way, tmp_path, "theta")
    orbits = snapshots_of(KIT).orbits(data, 4)
    assert orbits.speed_rad_s is None
    assert [one.ellipse for one in orbits.orbits] == [None, None]
    assert "no data of theta" in orbits.reason
    assert waveform_snapshot(samples, samples.channels(["y1"]), 4, None).speed_rad_s is None


def test_plots_begin_where_a_lost_angle_returns() -> None:
    monitor = MachineMonitor(install(KIT, None))
    for block in dead("theta", between_s=(22.0, 23.0)):
        monitor.step(block)
    samples = Held(KIT, monitor.blocks)
    assert samples.from_ns == START_NS + 23 * 10**9
    wave = waveform_snapshot(samples, samples.channels(["y1"]), 4, None)
    assert wave.revolutions == 4
    assert wave.speed_rad_s == pytest.approx(138.2, rel=0.01)
    assert vector_series(samples, samples.channels(["y1"]), 1, 8, None).speeds_rad_s[-1] == wave.speed_rad_s


def test_a_recorded_window_with_a_missing_channel_is_shown_as_live(tmp_path: Path) -> None:
    blocks, monitor = dead("z1", between_s=(12.0, 13.0)), MachineMonitor(install(KIT, None))
    for block in blocks:
        monitor.step(block)
    live = held_now(monitor.window, monitor.health(), monitor.blocks)
    source = recorded(recording(tmp_path / "made.mcap", blocks, KIT)).source
    lagged = evaluator_for(Installed(KIT)).needs_lags
    data = recorded_window(source, KIT, "demo/lab", None, monitor.health().latest, lagged=lagged)
    now, then = (snapshots_of(KIT).spectra(one) for one in (live, data))
    assert now.reason == then.reason == "no data of z1: sent as NaN, not connected"
    for one, other in zip(now.densities, then.densities, strict=True):
        assert (one.rms is None) == (other.rms is None) == (one.channel == "z1")
        assert one.rms is None or one.rms == pytest.approx(other.rms, rel=1e-4)


def test_with_only_the_angle_connected_there_is_nothing_to_plot(tmp_path: Path) -> None:
    _, samples = shown("recorded", tmp_path, *NAMES[:-1])
    with pytest.raises(RotorwatchError, match=r"no data of y1, z1, .*: sent as NaN"):
        samples.chosen(())
    with pytest.raises(RotorwatchError, match="no data of y1, z1"):
        full_spectrum_snapshot(samples)
