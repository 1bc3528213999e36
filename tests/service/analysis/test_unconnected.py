"""An unconnected sensor is shown as missing data, not as zeros; other sensors are shown as usual."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models.commissioning.commissioned import Installed, install
from models.errors import RotorwatchError
from models.signals.block import SampleBlock
from rotorwatch.records.health import Report
from service.analysis.figures.run_up import centreline, polar
from service.analysis.figures.style import Look
from service.analysis.past import Past
from service.analysis.recorded import Held, Sampled
from service.analysis.recorded_window import recorded_window
from service.analysis.snapshots.machine import LatestData
from service.analysis.snapshots.orbit import orbit_snapshot
from service.analysis.snapshots.plots import (
    centreline_series,
    full_spectrum_snapshot,
    vector_series,
    waterfall_snapshot,
    waveform_snapshot,
)
from service.analysis.snapshots.window import correlation_snapshot, spectrum_snapshot
from service.monitor.evaluators import evaluator_for
from service.monitor.monitor import MachineMonitor
from service.runtime.remote import latest_from_bytes, latest_to_bytes
from service.stream.worker import held_now
from tests.service.analysis.snapshotting import snapshots_of
from tests.service.monitor.test_monitor_missing import KIT, RIG
from tests.service.rig.live import START_NS, scenario_blocks
from tests.service.rig.replaying import recorded, recording
from tests.service.rig.watching import feed, held
from tests.sure import sure

NAMES = [one.name for one in KIT.sensors]
SECONDS = 30.0


@cache
def dead(
    *names: str, between_s: tuple[float, float] = (0.0, SECONDS), value: float = np.nan
) -> tuple[SampleBlock, ...]:
    return tuple(held(scenario_blocks(SECONDS), [NAMES.index(name) for name in names], value, *between_s))


@cache
def evaluated(*names: str, **how: Any) -> tuple[MachineMonitor, list[Report]]:
    """A monitor after the stream of `dead`, and its reports."""
    monitor = MachineMonitor(install(KIT, None))
    return monitor, feed(monitor, dead(*names, **how))[0]


def held_by(monitor: MachineMonitor) -> LatestData:
    return held_now(monitor.window, monitor.health(), monitor.blocks)


def read_from(folder: Path, stream: Sequence[SampleBlock], report: Report | None = None) -> tuple[LatestData, Sampled]:
    """A recording and its latest window."""
    data = recorded(recording(folder / "made.mcap", stream, KIT))
    lagged = evaluator_for(Installed(KIT)).needs_lags
    return recorded_window(data.source, KIT, "demo/lab", None, report, lagged=lagged), data


def shown(way: str, folder: Path, *names: str, **how: Any) -> tuple[LatestData, Sampled]:
    """Data held by a monitor, or read from its recording."""
    if way == "recorded":
        return read_from(folder, dead(*names, **how))
    data = held_by(evaluated(*names, **how)[0])
    data = latest_from_bytes(latest_to_bytes(data)) if way == "of another process" else data
    return data, Held(KIT, data.blocks)


SENT_AS_NAN = "no data of z1: sent as NaN, not connected"


@pytest.mark.parametrize(
    ("way", "how", "said"),
    [
        *((way, {}, SENT_AS_NAN) for way in ("live", "of another process", "recorded")),
        *((way, {"value": 100.0}, "z1: repeated the value 100 µm") for way in ("live", "recorded")),
    ],
)
def test_a_dead_or_stuck_channel_is_shown_as_no_data(way: str, how: Any, said: str, tmp_path: Path) -> None:
    data, samples = shown(way, tmp_path, "z1", **how)
    made = snapshots_of(KIT)
    spectra, correlations = spectrum_snapshot(made, data), correlation_snapshot(made, data)
    orbits = orbit_snapshot(made, data, 4)
    assert spectra.reason.startswith(said)
    assert {correlations.reason, orbits.reason} == {spectra.reason}
    assert {spectra.theory.nominal_reason, correlations.theory.nominal_reason} == {spectra.reason}
    density = {one.channel: one for one in spectra.densities}
    assert set(density["z1"].measured) == {None}
    assert density["z1"].rms is None
    assert None not in density["y1"].measured
    for pair in correlations.pairs:
        assert (None in pair.measured) == ("z1" in (pair.first, pair.second))
    assert [(one.location, one.path is not None) for one in orbits.orbits] == [("disc", True)]
    if said == SENT_AS_NAN:
        assert {one.location for one in full_spectrum_snapshot(samples).places} == {"disc"}
        wave = waveform_snapshot(samples, samples.channels(["y1", "z1"]), 4, None)
        assert [one.channel for one in wave.waveforms] == ["y1"]
        assert said in wave.reason
        assert [one.name for one in samples.chosen(())] == ["y1", "y2", "z2"]
        with pytest.raises(RotorwatchError, match=said):
            samples.chosen(["y1", "z1"])
        with pytest.raises(RotorwatchError, match=said):
            waterfall_snapshot(samples, samples.channels(["z1"])[0], "time")


def test_a_stuck_channel_has_no_levels() -> None:
    _, reports = evaluated("z1", value=100.0)
    assert reports[-1].filled == 1
    for report in reports:
        levels = {one.channel: one for one in report.levels}
        assert not levels["z1"].values()
        assert sure(levels["y1"].overall) > 0
        assert levels["y1"].s_max is None


@pytest.mark.parametrize("way", ["live", "recorded"])
@pytest.mark.parametrize(
    ("how", "said"),
    [({}, "no data of theta"), ({"between_s": (20.0, SECONDS), "value": 1.0}, "theta: the shaft angle stood still")],
    ids=["missing", "stopped"],
)
def test_without_a_turning_angle_a_machine_has_no_speed_rather_than_0(
    way: str, how: Any, said: str, tmp_path: Path
) -> None:
    data, samples = shown(way, tmp_path, "theta", **how)
    orbits, spectra = orbit_snapshot(snapshots_of(KIT), data, 4), spectrum_snapshot(snapshots_of(KIT), data)
    assert (orbits.speed_rad_s, spectra.speed_rad_s, spectra.rotation_hz) == (None, None, None)
    assert [one.ellipse for one in orbits.orbits] == [None, None]
    assert said in orbits.reason
    if not how:
        assert waveform_snapshot(samples, samples.channels(["y1"]), 4, None).speed_rad_s is None


def test_a_dead_casing_sensor_does_not_hide_theory() -> None:
    monitor = MachineMonitor(install(RIG, None))
    for block in scenario_blocks(SECONDS):
        gap = np.full((len(block.samples), 1), np.nan, np.float32)
        monitor.step(replace(block, samples=np.hstack([block.samples.astype(np.float32), gap])))
    spectra = spectrum_snapshot(snapshots_of(RIG), held_by(monitor))
    assert spectra.reason == "no data of DE-H: sent as NaN, not connected"
    assert (spectra.theory.nominal_reason, spectra.theory.estimated_reason) == ("", "")
    assert {one.nominal is not None for one in spectra.densities} == {True}


def past(**how: Any) -> Past:
    """The history of a machine whose probe z1 dies, see `dead`."""
    return Past(KIT, KIT.title, "the history", tuple(evaluated("z1", **how)[1]), ())


def test_plots_of_the_history_show_the_other_sensors() -> None:
    history = past()
    centre = centreline_series(history)
    assert [one.location for one in centre.places] == ["disc"]
    assert centre.reason == "no mean positions at the bearing"
    vectors = vector_series(history, history.channels(["y1", "z1"]), 1, 8, None)
    assert vectors.speeds_rad_s[-1] == pytest.approx(138.2, rel=0.01)
    assert [one.channel for one in vectors.channels] == ["y1"]
    assert vectors.reason == "no amplitude and phase of 1x of z1"


def test_plots_of_the_history_go_on_when_a_sensor_dies() -> None:
    """Each sensor ends where it died, and the others go on."""
    history = past(between_s=(27.0, SECONDS))
    centre = centreline_series(history)
    y1, z1 = vector_series(history, history.channels(["y1", "z1"]), 1, 8, None).channels
    assert None not in y1.amplitude
    assert z1.amplitude[0] is not None
    assert z1.amplitude[-1] is None
    assert centre.times_ns[-1] == (history.reports[-1].start_ns + history.reports[-1].end_ns) // 2
    bearing, disc = centre.places
    assert bearing.z_um[-1] is None
    assert None not in disc.y_um
    for figure in (polar(Look(), history, ["y1", "z1"], 1, 8, None), centreline(Look(), history, None, 1.0, None)):
        figure.canvas.draw()


def test_plots_begin_where_a_lost_angle_returns(tmp_path: Path) -> None:
    _, samples = shown("live", tmp_path, "theta", between_s=(22.0, 23.0))
    assert samples.from_ns == START_NS + 23 * 10**9
    wave = waveform_snapshot(samples, samples.channels(["y1"]), 4, None)
    assert wave.revolutions == 4
    assert wave.speed_rad_s == pytest.approx(138.2, rel=0.01)
    assert vector_series(samples, samples.channels(["y1"]), 1, 8, None).speeds_rad_s[-1] == wave.speed_rad_s


def test_a_recorded_window_with_a_missing_channel_is_shown_as_live(tmp_path: Path) -> None:
    monitor, reports = evaluated("z1", between_s=(12.0, 13.0))
    data, _ = read_from(tmp_path, dead("z1", between_s=(12.0, 13.0)), reports[-1])
    now, then = (spectrum_snapshot(snapshots_of(KIT), one) for one in (held_by(monitor), data))
    assert now.reason == then.reason == SENT_AS_NAN
    for one, other in zip(now.densities, then.densities, strict=True):
        assert (one.rms is None) == (other.rms is None) == (one.channel == "z1")
        assert one.rms is None or one.rms == pytest.approx(other.rms, rel=1e-4)


def test_with_only_the_angle_connected_there_is_nothing_to_plot(tmp_path: Path) -> None:
    _, samples = shown("recorded", tmp_path, *NAMES[:-1])
    with pytest.raises(RotorwatchError, match=r"no data of y1, z1, .*: sent as NaN"):
        samples.chosen(())
    with pytest.raises(RotorwatchError, match="no data of y1, z1"):
        full_spectrum_snapshot(samples)
