"""Windows of recordings: the same as in a monitor, and over HTTP, of recordings and of replays."""

from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from models.commissioning.commissioned import Installed, install
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import RotorwatchError
from models.machine import load_machine
from rotorwatch.records.health import Report
from rotorwatch.records.plots import FullSpectrumSnapshot, WaterfallSnapshot, WaveformSnapshot
from rotorwatch.records.replays import ReplayJob, ReplayReportList
from rotorwatch.records.snapshots import CorrelationSnapshot, OrbitSnapshot, SpectrumSnapshot
from service.analysis.recorded_window import recorded_window
from service.monitor.monitor import MachineMonitor
from service.recordings.replay.source import RecordingSource
from service.runtime.runtime import Runtime, running
from service.settings.service import RecordingSettings
from simulator.scenario import parse_fault
from tests.service.analysis.snapshotting import numbers
from tests.service.monitor.test_schedule import KIT, stream
from tests.service.rig.live import SHORT, START_NS, endpoint, machine_file, scenario_blocks, settings, until
from tests.service.rig.monitored import PLACE, answered, client, problem
from tests.service.rig.replaying import S, recording
from tests.sure import sure

SECONDS, FAULT_S = 55.0, 25.0
GAP = range(303, 306)
NAME = "20260101T000000Z.mcap"
REPLAYS = "/api/v1/replays"
pytestmark = pytest.mark.usefixtures("replays_at_once")


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> str:
    return machine_file(tmp_path_factory.mktemp("machine"), *SHORT)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, file: str) -> Path:
    """A recording of a machine that has a fault, and then a gap of three blocks."""
    made = tmp_path_factory.mktemp("recordings")
    blocks = list(scenario_blocks(SECONDS, parse_fault(f"k_by=-0.33@{FAULT_S:g}")))
    blocks = [one for number, one in enumerate(blocks) if number not in GAP]
    recording(made / "demo" / "lab" / NAME, blocks, load_machine(file))
    return made


def held_by_monitor(source: RecordingSource, installed: Installed) -> list[tuple[Report, WindowStatistics | None]]:
    """Every report with its window."""
    monitor = MachineMonitor(installed)
    held: list[tuple[Report, WindowStatistics | None]] = []
    for message in source.messages({source.machine("demo/lab").stream}):
        for step in monitor.step_payload(message.payload, message.attachment, message.encoding):
            held += [(one, monitor.window and monitor.window()) for one in step.windows]
    return held


def test_a_recorded_window_of_snapshots_equals_the_monitors(tmp_path: Path) -> None:
    source = RecordingSource([recording(tmp_path / NAME, stream()[: 9 * 40], KIT)])
    installed = install(KIT, None)
    report, window = held_by_monitor(source, installed)[-1]
    found = recorded_window(source, KIT, "demo/lab", report.end_ns, report, lagged=False)
    assert window is not None
    assert found.window is not None
    assert (found.filled, abs(found.window.start_ns - window.start_ns) < 1000) == (1.0, True)
    assert found.window.spectrum == pytest.approx(window.spectrum, rel=1e-9, abs=1e-30)


def test_a_recorded_window_equals_the_monitors(folder: Path, file: str) -> None:
    installed = install(load_machine(file), None)
    source = RecordingSource([folder / "demo" / "lab" / NAME])
    held = held_by_monitor(source, installed)
    whole = [number for number, (_, window) in enumerate(held) if window is not None]
    assert len(whole) > 3
    for number in (0, whole[0], whole[-1]):
        report, window = held[number]
        found = recorded_window(source, installed.machine, "demo/lab", report.end_ns, report, lagged=False)
        assert (found.filled, found.parameters) == (report.filled, report.parameters)
        assert (found.window is None) == (window is None)
        if window is not None and found.window is not None:
            assert abs(found.window.start_ns - window.start_ns) < 1000
            assert abs(found.window.end_ns - window.end_ns) < 1000
            assert found.window.spectrum == pytest.approx(window.spectrum, rel=1e-9, abs=1e-30)
            assert found.window.speed_rad_s == pytest.approx(window.speed_rad_s, rel=1e-12)
    before = recorded_window(source, installed.machine, "demo/lab", START_NS + round(FAULT_S * S), None, lagged=True)
    assert before.window is not None
    assert before.window.end_ns == START_NS + round(FAULT_S * S)
    assert before.window.correlation.shape[0] > 1
    other = installed.machine.model_copy(update={"rate_hz": 1000.0})
    with pytest.raises(RotorwatchError, match="at 2000 Hz, or other units; expected those of the machine file"):
        recorded_window(source, other, "demo/lab", None, None, lagged=False)


@pytest.fixture(scope="module")
def runtime(folder: Path, file: str) -> Iterator[Runtime]:
    kept = RecordingSettings(directory=str(folder), keep_days=36_500.0)
    with running(settings(endpoint(), file, recording=kept)) as started:
        yield started


@pytest.fixture(scope="module")
def http(runtime: Runtime) -> Iterator[httpx.Client]:
    with client(runtime) as found:
        yield found


def started(http: httpx.Client, **request: object) -> ReplayJob:
    answer = http.post(REPLAYS, json={"recordings": [f"demo/lab/{NAME}"], **request})
    return ReplayJob.model_validate_json(answer.raise_for_status().content)


def finished(http: httpx.Client, job: ReplayJob) -> ReplayJob:
    def now() -> ReplayJob:
        return ReplayJob.model_validate_json(http.get(f"{REPLAYS}/{job.id}").content)

    until(lambda: now().state == "finished", "end of the replay")
    return now()


def test_windows_of_a_replay_before_and_after_a_fault_over_http(http: httpx.Client) -> None:
    job = finished(http, started(http, changes=["alarms.on_delay_s = 5"]))
    listed = answered(http.get(f"{REPLAYS}/{job.id}/reports", params={"limit": 1000}), ReplayReportList).reports
    healthy = next(one for one in listed if one.filled == 1 and one.parameters)
    late = listed[-1]
    assert late.start_ns > START_NS + FAULT_S * S
    found = {}
    for report in (healthy, late):
        # JavaScript numbers hold these times to 256 ns.
        asked: dict[str, str | int] = {"replay": job.id, "until_ns": int(float(report.end_ns))}
        orbits = answered(http.get(f"{PLACE}/orbits", params={**asked, "revolutions": 8}), OrbitSnapshot)
        spectra = answered(http.get(f"{PLACE}/spectra", params=asked), SpectrumSnapshot)
        correlations = answered(http.get(f"{PLACE}/correlations", params=asked), CorrelationSnapshot)
        for one in (orbits, spectra, correlations):
            assert (one.end_ns, one.filled, one.reason) == (report.end_ns, 1.0, "")
            assert one.machine_hash == sure(job.summary).machine_hash  # that of the replay, with its changes
            read = {each.name: each.relative_change for each in report.parameters if each.relative_change is not None}
            stated = {each.name: each.relative_change for each in one.theory.changes}
            assert stated == pytest.approx(read, rel=1e-5)
        assert orbits.revolutions == 8
        assert report.end_ns - S < sure(orbits.path_start_ns) < report.end_ns
        waves = answered(http.get(f"{PLACE}/waveforms", params=asked), WaveformSnapshot)
        assert report.end_ns - S // 10 < sure(waves.end_ns) <= report.end_ns + 1000
        full = answered(http.get(f"{PLACE}/full-spectra", params=asked), FullSpectrumSnapshot)
        assert (full.source, full.reason) == ("recordings", "")
        found[report.end_ns] = orbits, spectra
    (first_orbits, first), (last_orbits, last) = found.values()
    for one, report in ((first_orbits, healthy), (last_orbits, late)):
        (x1,) = (each.x1 for each in report.levels if each.channel == "y1")
        assert 2 * sure(one.orbits[0].y).amplitude == pytest.approx(x1, rel=0.05)  # x1 is from hops
    assert np.abs(numbers(last.densities[0].measured) / numbers(first.densities[0].measured) - 1).max() > 0.5
    within: dict[str, str | int] = {"recording": NAME, "since_ns": healthy.start_ns, "until_ns": healthy.end_ns}
    rows = answered(http.get(f"{PLACE}/waterfalls", params=within), WaterfallSnapshot)
    assert healthy.start_ns <= sure(rows.start_ns) < sure(rows.end_ns) <= healthy.end_ns + S // 10


def test_windows_of_recordings_and_of_a_paced_replay_over_http(http: httpx.Client) -> None:
    def spectra(until_ns: int) -> SpectrumSnapshot:
        asked: dict[str, str | int] = {"recording": NAME, "until_ns": until_ns}
        return answered(http.get(f"{PLACE}/spectra", params=asked), SpectrumSnapshot)

    at = START_NS + 24 * S
    read = spectra(at)
    assert (read.end_ns, read.theory.nominal_reason) == (at, "")
    assert "evaluated by an offline replay alone" in read.theory.estimated_reason
    assert answered(http.get(f"{PLACE}/spectra"), SpectrumSnapshot).start_ns is None  # nothing is live
    assert "is full yet" in spectra(START_NS + S).reason
    never = answered(http.get(f"{PLACE}/orbits", params={"recording": NAME, "until_ns": 5}), OrbitSnapshot)
    assert "nothing was recorded in between" in never.reason
    paced = started(http, mode="paced", pace=0.1)
    of_paced: dict[str, str | int] = {"replay": paced.id, "until_ns": at}
    same = answered(http.get(f"{PLACE}/spectra", params=of_paced), SpectrumSnapshot)
    assert same.densities == read.densities
    http.delete(f"{REPLAYS}/{paced.id}").raise_for_status()


@pytest.mark.parametrize("name", ["orbits", "spectra", "correlations", "waveforms", "full-spectra", "waterfalls"])
def test_invalid_arguments_are_refused(http: httpx.Client, name: str) -> None:
    assert "until_ns: needs" in problem(http.get(f"{PLACE}/{name}?until_ns=5"), 422).detail
    assert "no replay" in problem(http.get(f"{PLACE}/{name}?replay=0123456789ab"), 404).detail
    problem(http.get(f"{PLACE}/{name}?replay=..%2F1"), 422)
    problem(http.get(f"{PLACE}/{name}?recording=other.mcap"), 404)
    both = problem(http.get(f"{PLACE}/{name}?replay=0123456789ab&recording={NAME}"), 422)
    assert "expected one of them" in both.detail
