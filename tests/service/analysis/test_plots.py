"""What plots of recordings show: orbits, spectra, correlations and trends, mostly before drawing."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import imread
from matplotlib.text import Text

from models.commissioning.commissioned import install
from models.diagnosis.networks.bundle import load_bundle
from models.errors import MachineFileError, RotorwatchError
from models.signals.block import FloatArray
from models.signals.recording import RecordedMessage
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmEventData
from rotorwatch.records.example import example
from rotorwatch.records.health import MEASURES, Report
from rotorwatch.records.levels import LevelLimits
from service.analysis.correlation import correlations_of, latest_window
from service.analysis.figures.spectrum import Lines, spectrum, waterfall
from service.analysis.figures.style import Look, as_dates, draw
from service.analysis.figures.trend import paint_trend
from service.analysis.orbit import read_orbits
from service.analysis.spectrum import read_spectrum, read_waterfall, shown_as
from service.analysis.trend import TrendSeries, read_trend, trend_of
from service.recordings.replay.offline import OfflineReplay
from service.recordings.replay.source import RecordingSource
from simulator.scenario import parse_fault
from tests.service.analysis.snapshotting import quiet, unbalance_um
from tests.service.rig.live import LAB, START_NS, scenario_blocks
from tests.service.rig.replaying import S, made, recorded, recording, write


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Healthy for 62 s, then half of the vertical bearing damping more."""
    return recording(
        tmp_path_factory.mktemp("plots") / "faulty.mcap", scenario_blocks(102.0, parse_fault("c_bz=0.5@62"))
    )


@pytest.fixture(scope="module")
def lines(faulty: Path) -> list[dict[str, object]]:
    """Output of an offline replay of it, with networks."""
    found: list[dict[str, object]] = []
    source = RecordingSource([faulty])
    OfflineReplay(source, LAB.keys, install(LAB, "lab"), lambda line: found.append(json.loads(line))).run()
    return found


@pytest.fixture(scope="module")
def computed(faulty: Path) -> TrendSeries:
    return read_trend(recorded(faulty))


def reports_of(lines: list[dict[str, object]]) -> list[Report]:
    return [Report.model_validate(line["message"]) for line in lines if line["topic"] == LAB.keys.report]


def test_the_orbit_of_a_simulated_unbalance_is_the_ellipse_of_the_equations_of_motion(tmp_path: Path) -> None:
    found = read_orbits(recorded(recording(tmp_path / "unbalance.mcap", quiet()[:120])), 8)
    W, q_um = LAB.operation.speed_rad_s, unbalance_um()
    assert [orbit.location for orbit in found.orbits] == ["bearing", "disc"]
    assert found.speed_rad_s == pytest.approx(W, rel=1e-4)
    assert found.end_ns - found.start_ns == pytest.approx(8 * 2e9 * np.pi / W, rel=1e-4)
    for orbit, y, z in zip(found.orbits, q_um[[0, 1]], q_um[[3, 4]], strict=True):
        assert orbit.ellipse.y == pytest.approx(y, rel=2e-3)
        assert orbit.ellipse.z == pytest.approx(z, rel=2e-3)
        circle = np.exp(1j * np.linspace(0, 2 * np.pi, 20_000))
        radius = np.hypot(np.real(y * circle), np.real(z * circle))
        assert 2 * orbit.ellipse.semi_major == pytest.approx(2 * radius.max(), rel=2e-3)
        assert 2 * orbit.ellipse.semi_minor == pytest.approx(2 * radius.min(), rel=2e-3)
        assert np.ptp(orbit.y_um) == pytest.approx(2 * abs(y), rel=5e-3)
        assert orbit.ellipse.precession == "forward"
        assert orbit.marks_um.shape == (9, 2)  # pulses at the beginning, at the end, and in between
        assert orbit.marks_um == pytest.approx(np.tile([y.real, z.real], (9, 1)), abs=0.01 * abs(y))


def test_orbits_need_the_requested_revolutions_without_a_gap(tmp_path: Path) -> None:
    signals = {"theta": lambda t: (2 * np.pi * 20.0 * t + 1) % (2 * np.pi), "y1": lambda t: t}
    data = made(tmp_path, signals, 4.0, without=[34])
    assert read_orbits(data, 9).revolutions == 9
    with pytest.raises(RotorwatchError, match=r"--revolutions is 10, but only 9 whole revolutions"):
        read_orbits(data, 10)


@pytest.mark.parametrize(
    ("off_line", "name", "stated", "factor"),
    [(0.0, "y2", "µm pp", 2.0), (0.5, "y2", "µm pp", 2.0), (0.25, "y2_dot", "mm/s rms", 0.5**0.5)],
)
def test_a_sine_reads_its_amplitude_in_the_quantitys_unit_within_scalloping(
    tmp_path: Path, off_line: float, name: str, stated: str, factor: float
) -> None:
    """Displacement peak to peak, velocity rms."""
    hz, amplitude = 50.0 + 0.5 * off_line, 12.0
    stream = made(tmp_path, {name: lambda t: amplitude * np.sin(2 * np.pi * hz * t) + 900}, 21.0)
    found = read_spectrum(stream, stream.channels([name]), 20.0, 0.5, "amplitude")
    scalloping = abs(np.sinc(off_line) / (1 - off_line**2))  # of the Hann window
    assert found.values[0].max() == pytest.approx(factor * amplitude * scalloping, rel=1e-3)
    assert found.frequencies_hz[found.values[0].argmax()] == pytest.approx(hz, abs=0.251)
    assert (found.averages, found.resolution_hz) == (19, 0.5)
    assert (found.start_ns, found.end_ns) == (START_NS + 1 * S, START_NS + 21 * S)
    density = read_spectrum(stream, stream.channels([name]), 20.0, 0.5, "density")
    assert density.values[0].sum() * 0.5 == pytest.approx(amplitude**2 / 2, rel=1e-3)
    panel = spectrum(Look(), stream, [name], Lines(20.0, 0.5, "amplitude", log=False)).axes[0]
    assert panel.get_ylabel() == stated
    fall = read_waterfall(stream, stream.channels([name])[0], 4.0, 0.5, "amplitude")
    assert fall.values.max() == pytest.approx(factor * amplitude * scalloping, rel=1e-3)


def test_displacement_is_shown_peak_to_peak_and_velocity_rms() -> None:
    factors = {"y1": {"m": 2e6, "mm": 2e3, "mil": 2.0}, "y1_dot": {"m/s": 1e3 * 0.5**0.5, "in/s": 0.5**0.5}}
    said = []
    for name, units in factors.items():
        for unit, expected in units.items():
            channel = next(one for one in LAB.sensors if one.name == name).model_copy(update={"unit": unit})
            text, factor = shown_as(channel, "amplitude")
            said.append(text)
            assert factor == pytest.approx(expected)
    assert said == ["µm pp", "µm pp", "mil pp", "mm/s rms", "in/s rms"]


def test_axes_of_spectra_cover_the_harmonics_and_not_drift(tmp_path: Path) -> None:
    """Slow drift, and nothing above the second harmonic: neither sets the limits of the axes."""
    signals = {
        "theta": lambda t: (2 * np.pi * 20.0 * t) % (2 * np.pi),
        "y1": lambda t: 3000 * np.sin(0.3 * t) + 10 * np.sin(2 * np.pi * 20.0 * t) + 4 * np.sin(2 * np.pi * 40.0 * t),
    }
    stream = made(tmp_path, signals, 30.0)
    for log in (False, True):
        panel = spectrum(Look(), stream, ["y1"], Lines(20.0, 0.5, "amplitude", log)).axes[0]
        assert panel.get_xlim() == (1.0, 80.0)  # from two lines, where the window passes no mean, to 4×
        assert panel.get_ylim()[1] > 20
    low, high = spectrum(Look(), stream, ["y1"], Lines(20.0, 0.5, "amplitude", log=True)).axes[0].get_ylim()
    assert high / low < 10**5
    lines = Lines(4.0, 0.5, "amplitude", log=True)
    for cascade in (False, True):
        axes = waterfall(Look(), stream, ["y1"], lines, over_speed=False, cascade=cascade).axes[0]
        assert axes.get_xlim() == (1.0, 80.0)
    wide = spectrum(Look(), stream, ["y1"], Lines(20.0, 0.5, "amplitude", False, 500.0)).axes[0]
    assert wide.get_xlim() == (1.0, 500.0)


def test_every_line_of_a_wide_band_is_visible_in_a_waterfall(tmp_path: Path) -> None:
    """There are eight lines per pixel."""
    tones_hz = np.arange(60.0, 760.0, 70.5)
    signals = {"y1": lambda t: np.sin(2 * np.pi * tones_hz[:, None] * t).sum(axis=0)}
    stream = made(tmp_path, signals, 12.0)
    lines = Lines(4.0, 0.5, "amplitude", log=True)
    picture = tmp_path / "fall.png"
    look = Look(size_in=(3.0, 2.5))
    draw(picture, look, lambda: waterfall(look, stream, ["y1"], lines, over_speed=False, cascade=False))
    pixels = imread(picture)
    map_only = pixels[pixels.shape[0] // 2, : round(0.75 * pixels.shape[1]), :3]  # without the colour bar
    bright = (map_only[:, 0] > 0.8) & (map_only[:, 2] < 0.5)
    assert np.count_nonzero(np.diff(bright.astype(int)) == 1) == tones_hz.size


def test_spectra_do_not_reach_across_gaps(tmp_path: Path) -> None:
    """A step across the gap would be broadband; segments on either side do not contain it."""
    stream = made(tmp_path, {"y1": lambda t: np.where(t > 4.05, 1000.0, 0.0)}, 10.0, without=[40])
    found = read_spectrum(stream, stream.channels(["y1"]), 10.0, 1.0, "amplitude")
    assert found.values.max() < 1e-9
    assert found.averages == 7 + 10  # 4.0 s and 5.9 s in halves of a second
    assert np.isnan(found.speed_rad_s) or found.speed_rad_s == 0
    with pytest.raises(RotorwatchError, match=r"needs 10 s without a gap, .* in the last 10 s is 5.9 s"):
        read_spectrum(stream, stream.channels(["y1"]), 10.0, 0.1, "amplitude")
    with pytest.raises(MachineFileError, match="--window is 1 s, expected at least 2 s"):
        read_spectrum(stream, stream.channels(["y1"]), 1.0, 0.5, "amplitude")


def test_a_waterfall_follows_a_run_up_over_time_and_speed(tmp_path: Path) -> None:
    def turns(t: FloatArray) -> FloatArray:  # 10 Hz to 40 Hz in 60 s
        return 10 * t + 0.25 * t**2

    signals = {
        "theta": lambda t: (2 * np.pi * turns(t)) % (2 * np.pi),
        "y1": lambda t: 5 * np.cos(2 * np.pi * turns(t)),
    }
    stream = made(tmp_path, signals, 60.0, without=range(300, 330))
    found = read_waterfall(stream, stream.channels(["y1"])[0], 2.0, 0.5, "amplitude")
    assert found.values.shape[0] == 15 + 13  # 3 s are missing, and the rest is too short for a segment
    strongest_hz = found.frequencies_hz[found.values.argmax(axis=1)]
    middle_s = ((found.start_ns + found.end_ns) / 2 - START_NS) / S
    assert strongest_hz == pytest.approx(10 + 0.5 * middle_s, abs=0.76)
    assert found.speed_rad_s / (2 * np.pi) == pytest.approx(10 + 0.5 * middle_s, abs=0.01)
    edges, spectra = found.over_speed()
    known = np.isfinite(spectra[:, 0])
    slow_hz, fast_hz = edges[:-1][known] / (2 * np.pi), edges[1:][known] / (2 * np.pi)
    strongest_hz = found.frequencies_hz[spectra[known].argmax(axis=1)]
    assert (strongest_hz > slow_hz - 0.76).all()
    assert (strongest_hz < fast_hz + 0.76).all()
    slowest, *_, fastest = (edges[:-1] + edges[1:]) / 2
    assert (slowest, fastest) == pytest.approx((found.speed_rad_s[0], found.speed_rad_s[-1]))


def test_correlation_panels_agree_with_the_report(faulty: Path, lines: list[dict[str, object]]) -> None:
    report = [one for one in reports_of(lines) if one.equations][3]
    window = latest_window(recorded(faulty, seconds=(0, (report.end_ns - START_NS) / S + 1)), LAB)
    panels = correlations_of(window, LAB, load_bundle("lab", LAB))
    assert (window.start_ns, window.end_ns) == (report.start_ns, report.end_ns)
    by_number = {panel.reading.equation: panel for panel in panels}
    assert list(by_number) == [equation.equation for equation in report.equations]
    for panel, said in zip(panels, report.equations, strict=True):
        if not said.evaluable:
            assert (panel.curves, panel.reading.reason) == ((), said.reason)
            continue
        residual = np.concatenate([curve.residual for curve in panel.curves])
        assert np.mean(residual**2) == pytest.approx(said.msd, rel=1e-12)
        assert (panel.reading.msd, panel.reading.msd_healthy) == (said.msd, said.msd_healthy)
        measured = np.concatenate([curve.measured for curve in panel.curves])
        assert np.sqrt(np.mean(measured**2)) == pytest.approx(1.0)  # over the target's rms
    assert by_number["30"].reading.reason.startswith("not measured: psi_dot")
    assert [curve.label for curve in by_number["28"].curves] == ["y1", "y2", "z1", "z2"]
    assert by_number["28"].x[[0, -1]] == pytest.approx([0.010, 0.125])
    assert by_number["29"].x.size == 16
    # Each curve is the window's own correlation of its reference with the target.
    lags = window.lags_s >= 0.0099
    for curve in panels[0].curves:
        i, j = window.states.index(f"{curve.label}_dot"), window.states.index("y1_dot")
        assert np.corrcoef(curve.measured, window.correlation[lags, i, j])[0, 1] == pytest.approx(1.0)


def test_a_computed_trend_agrees_with_the_reports(computed: TrendSeries, lines: list[dict[str, object]]) -> None:
    found, reports = computed, reports_of(lines)
    assert found.end_ns.tolist() == [report.end_ns for report in reports]
    assert (found.states, found.limits) == (tuple(report.state for report in reports), LAB.alarms)
    for name, (field, _) in MEASURES.items():
        known = [getattr(report, field) for report in reports]
        np.testing.assert_array_equal(found.measures[name], np.array(known, dtype=np.float64))
    alarms = [AlarmCloudEvent.model_validate(line["message"]) for line in lines if "alarm" in str(line["topic"])]
    assert [alarm.time_ns for alarm in found.alarms] == [alarm.data.time_ns for alarm in alarms]
    assert found.alarms[0].name == "c_bz"
    for trend in found.parameters:
        for number, report in enumerate(reports):
            verdict = report.verdict
            shown = report.parameters if verdict is None or verdict.settled else verdict.current
            values = [reading for reading in shown if reading.name == trend.name and reading.interval_95]
            if values and values[0].interval_95 is not None:
                assert trend.change[number] == values[0].relative_change
                assert (trend.low[number], trend.high[number]) == values[0].interval_95
            else:
                assert np.isnan(trend.change[number])
    last = {trend.name: trend for trend in found.parameters}["c_bz"]
    assert last.low[-1] < 0.5 < last.high[-1]


def test_a_trend_of_a_publisher_restarted_earlier_in_time_shows_the_later_run(lines: list[dict[str, object]]) -> None:
    reports = reports_of(lines)
    again = [one.model_copy(update={"end_ns": one.end_ns - 22 * S}) for one in reports]
    before = [one.end_ns for one in reports if one.end_ns < again[0].end_ns]
    found = trend_of([*reports, *again, again[-1]], (), None, "")
    assert found.end_ns.tolist() == [*before, *(one.end_ns for one in again)]


def test_a_trend_shows_levels_beyond_their_limits_beside_the_overall_one(lines: list[dict[str, object]]) -> None:
    *reports, last = reports_of(lines)
    limit = LevelLimits(measure="x2", alert=3.5, source="commissioned", state="alert", text="2x 4")
    first = last.levels[0].model_copy(update={"x2": 4.0, "limits": (limit,)})
    found = trend_of(
        [*reports, last.model_copy(update={"levels": (first, *last.levels[1:])})], (), None, "", levels=True
    )
    assert [one.title for one in found.levels[:3]] == ["y1   overall, µm pp", "y1   2x, µm pp", "y2   overall, µm pp"]
    assert (found.levels[1].level[-1], found.levels[1].alert[-1]) == (4.0, 3.5)
    far = (replace(found.levels[1], alert=10 * found.levels[1].alert),)  # outside the axis
    for levels, limits in ((found.levels[1:2], ["alert limit"]), (found.levels[:1], []), (far, [])):
        figure = paint_trend(Look(), replace(found, levels=levels, parameters=(), limits=LAB.alarms, alarms=()))
        assert [one.get_text() for legend in figure.legends for one in legend.get_texts()] == limits
        assert 3 <= sum(0 <= tick <= figure.axes[1].get_ylim()[1] for tick in figure.axes[1].get_yticks()) <= 5


def test_a_trend_of_recorded_reports_needs_no_samples(
    tmp_path: Path, computed: TrendSeries, lines: list[dict[str, object]]
) -> None:
    """Recorded reports are shown unchanged; a machine file asks for new ones, which need samples."""
    messages = []
    for number, line in enumerate(lines):
        text = json.dumps(line["message"]).encode()
        messages.append(RecordedMessage(str(line["topic"]), text, b"", "application/json", START_NS + number, START_NS))
    messages.append(RecordedMessage(LAB.keys.report, b"{}", b"", "application/json", START_NS + 1000, START_NS))
    path = write(tmp_path / "reports.mcap", [*messages, *messages[:3]])
    source = RecordingSource([path])
    assert source.machine(reports=True) == LAB.keys
    found = read_trend(recorded(path))
    assert (found.origin, found.limits) == ("as recorded", LAB.alarms)
    assert found.end_ns.tolist() == computed.end_ns.tolist()
    assert [alarm.time_ns for alarm in found.alarms] == [alarm.time_ns for alarm in computed.alarms]
    for one, other in zip(found.parameters, computed.parameters, strict=True):
        np.testing.assert_array_equal(one.change, other.change)
        np.testing.assert_array_equal(one.high, other.high)
    levels = read_trend(recorded(path), levels=True)
    assert (levels.parameters, levels.levels[0].title) == ((), "y1   overall, µm pp")  # instead of parameters
    assert all(np.isfinite(one.level).all() and np.isnan(one.danger).all() for one in levels.levels)
    with pytest.raises(RotorwatchError, match="no sample blocks to compute them from"):
        read_trend(recorded(path), "lab")
    with pytest.raises(MachineFileError, match="machines with reports or sample blocks: demo/lab"):
        source.machine("demo/fan", reports=True)


def test_names_of_alarms_in_a_trend_do_not_overlap(computed: TrendSeries) -> None:
    event, first_ns = AlarmEventData.model_validate(example(AlarmEventData)), int(computed.end_ns[0])
    named = [("k_by", 1), ("data-gap", 1), ("level:VE-1X", 2), ("level:VE-1Y", 2), ("model", 4), ("stream-lost", 38)]
    alarms = tuple(event.model_copy(update={"name": name, "time_ns": first_ns + at * S}) for name, at in named)
    figure = paint_trend(Look(), replace(computed, alarms=alarms))
    FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    for axes in figure.axes:
        titles = [one for one in axes.get_children() if isinstance(one, Text) and one not in axes.texts]
        texts = [one for one in (*axes.texts, *titles) if one.get_text()]
        boxes = [one.get_window_extent() for one in texts]
        for at, box in enumerate(boxes):
            assert not box.count_overlaps(boxes[:at]), texts[at].get_text()
    assert sum(len(axes.texts) for axes in figure.axes) == len(named)


def test_recordings_days_apart_fill_the_time_axis_of_a_trend(computed: TrendSeries) -> None:
    """Formerly each was a line of no width."""
    half = len(computed.end_ns) // 2
    later = computed.end_ns + np.where(np.arange(len(computed.end_ns)) < half, 0, 3 * 86_400 * S)
    figure = paint_trend(Look(), replace(computed, end_ns=later, alarms=()))
    figure.draw_without_rendering()
    for axes in figure.axes:
        fraction = (axes.transData + axes.transAxes.inverted()).transform
        at = fraction(np.column_stack([as_dates(later), np.zeros(len(later))]))[:, 0]
        assert at[half] - at[half - 1] < 0.05
        assert np.ptp(at) > 0.9
        assert np.all(np.diff(np.delete(np.diff(at), half - 1)) < 1e-6)  # equal steps in either recording
    assert [one.get_text().split("\n")[1] for one in figure.axes[-1].get_xticklabels()] == [
        "01 Jan 2026",
        "04 Jan 2026",
    ]


def test_a_trend_without_readings_is_refused_with_a_reason(faulty: Path) -> None:
    filling = read_trend(recorded(faulty, seconds=(0, 30)))
    assert (filling.parameters, len(filling.levels)) == ((), 8)
    bare = [Report.model_validate(example(Report) | {"levels": [], "parameters": [], "verdict": None, "reason": ""})]
    with pytest.raises(RotorwatchError, match=r"neither parameter nor level was read .*: 1 reports, while the window"):
        trend_of(bare, (), None, "as recorded")
