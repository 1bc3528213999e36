"""Waveforms, full spectra, centrelines and run-ups against closed forms, as values and as drawn."""

from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes
from scipy.signal import cont2discrete, lfilter

from models.errors import MachineFileError, RotorwatchError
from models.signals.block import FloatArray
from models.signals.channels import Channel
from service.analysis.figures.run_up import bode, centreline, polar
from service.analysis.figures.samples import waveform
from service.analysis.figures.spectrum import Lines, full_spectrum, spectrum
from service.analysis.figures.style import Look
from service.analysis.orbit import in_planes, orbit_pairs, recorded_pairs
from service.analysis.recorded import Recorded
from service.analysis.runup import read_centreline, read_run_up
from service.analysis.spectrum import read_full_spectrum
from tests.commissioning.rotor_kit import mounted
from tests.service.rig.live import LAB, START_NS
from tests.service.rig.replaying import S, machine_blocks, made, recorded, recording, without_angle

RATE_HZ = LAB.rate_hz
Signals = dict[str, Callable[[FloatArray], FloatArray]]


def turning(hz: float, sense: int = 1) -> Callable[[FloatArray], FloatArray]:
    return lambda t: (sense * 2 * np.pi * hz * t) % (2 * np.pi)


@pytest.mark.parametrize(("sense", "orders"), [(1, False), (-1, True)])
def test_a_circle_is_one_line_and_an_ellipse_two_in_full_spectra(tmp_path: Path, sense: int, orders: bool) -> None:
    """A circle of radius 20 µm; an ellipse with half axes of 30 and 10 µm, the sum and difference of two circles."""
    angle = 2 * np.pi * 20.0
    signals: Signals = {
        "theta": turning(20.0, sense),
        "y1": lambda t: 20 * np.cos(angle * t) + 300,
        "z1": lambda t: sense * 20 * np.sin(angle * t) - 200,
        "y2": lambda t: 30 * np.cos(angle * t),
        "z2": lambda t: sense * 10 * np.sin(angle * t),
    }
    data = made(tmp_path, signals, 21.0)
    found = read_full_spectrum(data, recorded_pairs(data), 20.0, 0.5, orders=orders)
    one = 1.0 if orders else 20.0
    forward, reverse = (int(np.argmin(np.abs(found.lines - at))) for at in (one, -one))
    assert found.values_um[0, forward] == pytest.approx(40, rel=1e-3)
    assert found.values_um[1, [forward, reverse]] == pytest.approx([40, 20], rel=1e-3)
    elsewhere = np.abs(found.lines - one) > 2.5 * found.resolution
    assert found.values_um[0, elsewhere].max() < 0.05
    assert found.useful == pytest.approx(4 * one)


def test_labels_of_orders_do_not_overlap_in_a_wide_band(tmp_path: Path) -> None:
    """20 and 40 Hz are ten pixels apart, on either side."""
    circle = {"theta": turning(20.0), "y1": lambda t: np.cos(125.7 * t), "z1": lambda t: np.sin(125.7 * t)}
    data, lines = made(tmp_path, circle, 21.0), Lines(20.0, 0.5, "amplitude", log=False, to_hz=900.0)
    figures = full_spectrum(Look(), data, "bearing", lines, orders=False), spectrum(Look(), data, ["y1"], lines)
    for figure, names in zip(figures, (["1×", "2×", "−1×", "−2×"], ["1×", "2×"]), strict=True):
        FigureCanvasAgg(figure)
        figure.draw_without_rendering()
        texts = [one for one in figure.axes[0].texts if "×" in one.get_text()]
        assert sorted(one.get_text() for one in texts) == names
        boxes = [one.get_window_extent() for one in texts]
        assert not any(box.count_overlaps(boxes[:at]) for at, box in enumerate(boxes))


def test_labels_of_a_centreline_that_does_not_move_do_not_overlap(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    noise = {"theta": turning(20.0), **{name: lambda t: rng.normal(0, 0.1, t.size) for name in ("y1", "z1")}}
    figure = drawn(centreline(Look(), made(tmp_path, noise, 60.0), "bearing", 1.0, None))
    FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    boxes = [one.get_window_extent() for one in figure.axes[0].texts]
    assert not any(box.count_overlaps(boxes[:at]) for at, box in enumerate(boxes))


def test_orders_stay_sharp_while_the_speed_changes(tmp_path: Path) -> None:
    """From 20 to 30 Hz in 20 s: over frequencies the line is smeared, over orders it is not."""

    def angle(t: FloatArray) -> FloatArray:
        return np.asarray(2 * np.pi * (20 * t + 0.25 * t**2))

    signals: Signals = {
        "theta": lambda t: angle(t) % (2 * np.pi),
        "y1": lambda t: 20 * np.cos(angle(t)),
        "z1": lambda t: 20 * np.sin(angle(t)),
    }
    data = made(tmp_path, signals, 20.0)
    pairs = recorded_pairs(data, "bearing")
    assert read_full_spectrum(data, pairs, 20.0, 0.5, orders=True).values_um.max() == pytest.approx(40, rel=5e-3)
    assert read_full_spectrum(data, pairs, 20.0, 0.5, orders=False).values_um.max() < 20


def test_full_spectra_need_two_directions_and_orders_need_rotation(tmp_path: Path) -> None:
    data = made(tmp_path, {"y1": lambda t: np.sin(300 * t)}, 5.0)
    with pytest.raises(MachineFileError, match="--place is 'DE', where demo/lab has no displacements in y"):
        recorded_pairs(data, "DE")
    with pytest.raises(RotorwatchError, match="--axis orders needs a shaft that turns, and it stands still"):
        read_full_spectrum(data, recorded_pairs(data), 4.0, 0.5, orders=True)


def test_probes_at_an_angle_are_turned_to_y_and_z() -> None:
    """Probes 45° to the left and right of the top, in different units; and a pair in y and z."""
    left, right, y, z = (
        Channel(name=name, quantity="displacement", location=place, direction=name[-1], unit=unit, angle_deg=angle)
        for name, place, unit, angle in (
            ("DE-L", "DE", "um", 135.0), ("DE-R", "DE", "mm", 45.0),
            ("N-y", "NDE", "um", None), ("N-z", "NDE", "um", None),
        )
    )  # fmt: skip
    pairs = orbit_pairs([left, right, y, z])
    assert sorted(sorted((one.name, other.name)) for one, other in pairs) == [["DE-L", "DE-R"], ["N-y", "N-z"]]
    angle = np.linspace(0, 6, 50)
    shaft = {"y": 30 * np.cos(angle), "z": 10 * np.sin(angle)}
    shown = {
        left: (-shaft["y"] + shaft["z"]) / np.sqrt(2),
        right: (shaft["y"] + shaft["z"]) / np.sqrt(2) / 1000,
        y: shaft["y"],
        z: shaft["z"],
    }
    samples = np.stack([shown[one] for pair in pairs for one in pair], axis=1)
    for found, expected in zip(in_planes(samples, pairs), shaft.values(), strict=True):
        assert found == pytest.approx(np.stack([expected, expected], axis=1))


def test_the_start_of_a_centreline_fits_beside_probes_at_an_angle(tmp_path: Path) -> None:
    turned = mounted(LAB, {"y1": (45.0, 135.0), "y2": (45.0, 135.0)})
    sensors = tuple(one.model_copy(update={"name": f"VT-{one.name}"}) for one in turned.sensors)
    turned = turned.model_copy(update={"sensors": sensors})
    signals: Signals = {name: lambda t: -1015.0 + 5.0 * np.sin(t) for name in ("y1", "z1", "y2", "z2")}
    data = recorded(recording(tmp_path / "made.mcap", machine_blocks(signals, 20.0), turned))
    figure = drawn(centreline(Look(), data, None, 1.0, None))
    figure.draw_without_rendering()
    texts = [(axes, text) for axes in figure.axes for text in axes.texts if text.get_text().startswith("start: ")]
    assert len(texts) == 2
    for axes, text in texts:
        assert text.get_window_extent().x1 < axes.get_window_extent().x1


CRITICAL_HZ, DAMPING, RATE_HZ_PER_S = 25.0, 0.05, 0.5


@cache
def jeffcott() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Angle, y and z of a disc on a massless shaft, 10 µm out of balance at angle 0, run from 10 to 40 Hz.

    Solved in time: x'' + 2ζωx' + ω²x = e(Ω² cos θ + Ω' sin θ) in y; in z a quarter turn of the shaft later.
    """
    t = np.arange(round(60.0 * RATE_HZ)) / RATE_HZ
    theta = 2 * np.pi * (10 * t + RATE_HZ_PER_S / 2 * t**2)
    speed, change = 2 * np.pi * (10 + RATE_HZ_PER_S * t), 2 * np.pi * RATE_HZ_PER_S
    w = 2 * np.pi * CRITICAL_HZ
    system = ([1.0], [1.0, 2 * DAMPING * w, w**2])
    numerator, denominator, _ = cont2discrete(system, 1 / RATE_HZ, "foh")  # type: ignore[call-overload]  # stub without lists
    y, z = (
        lfilter(numerator[0], denominator, 10 * (speed**2 * one + change * other))
        for one, other in ((np.cos(theta), np.sin(theta)), (np.sin(theta), -np.cos(theta)))
    )
    return theta, np.asarray(y), np.asarray(z)


@pytest.fixture(scope="module", params=[1, -1])
def run_up(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[int, Recorded]:
    sense, (theta, y, z) = request.param, jeffcott()
    signals: Signals = {"theta": lambda _: (sense * theta) % (2 * np.pi), "y2": lambda _: y, "z2": lambda _: sense * z}
    return sense, made(tmp_path_factory.mktemp("runup"), signals, 60.0)


def test_a_run_up_shows_the_critical_speed_of_a_simple_rotor(run_up: tuple[int, Recorded]) -> None:
    """Amplitude e r²/√((1-r²)² + (2ζr)²), greatest at r = 1/√(1-2ζ²), and a lag of 90° at r = 1.

    The sweep, 0.5 Hz/s, delays both by about its rate over ζω, 0.06 Hz: hence 1 % of the speed, and 3 % of the height.
    """
    sense, data = run_up
    found = read_run_up(data, data.channels(["y2", "z2"]), 1, 4)
    hz = np.abs(found.speed_rad_s) / (2 * np.pi)
    assert (found.direction, found.units) == (sense, ("µm pp", "µm pp"))
    top = found.amplitude.argmax(axis=0)
    assert hz[top] == pytest.approx(CRITICAL_HZ / np.sqrt(1 - 2 * DAMPING**2), rel=0.01)
    assert found.amplitude.max(axis=0) == pytest.approx(20 / (2 * DAMPING * np.sqrt(1 - DAMPING**2)), rel=0.03)
    lag = np.unwrap(np.radians(found.lag_deg), axis=0)
    for number, before in ((0, 0.0), (1, sense * np.pi / 2)):  # z is a quarter turn after y, or before it
        turned = lag[:, number] - before
        turned -= 2 * np.pi * np.round(turned[0] / (2 * np.pi))
        assert np.interp(np.pi / 2, turned, hz) == pytest.approx(CRITICAL_HZ, rel=0.01)
        assert turned[hz > 38].mean() == pytest.approx(np.pi, abs=0.15)
        assert turned[hz < 11].mean() == pytest.approx(0, abs=0.15)
    far = found.amplitude[np.abs(hz - 35).argmin(), 0]
    r = 35 / CRITICAL_HZ
    assert far == pytest.approx(20 * r**2 / np.hypot(1 - r**2, 2 * DAMPING * r), rel=0.03)


def drawn(figure: Figure) -> Figure:
    figure.canvas.draw()
    return figure


def test_a_polar_plot_counts_the_lag_against_the_rotation_from_the_sensor(run_up: tuple[int, Recorded]) -> None:
    """At resonance y lags 90°: the high spot is a quarter turn against the rotation from the sensor y."""
    sense, data = run_up
    for name, sensor in (("y2", 0.0), ("z2", np.pi / 2)):
        axes = drawn(polar(Look(), data, [name], 1, 4, None)).axes[0]
        assert isinstance(axes, PolarAxes)
        assert axes.get_theta_offset() == pytest.approx(sensor)
        assert axes.get_theta_direction() == -sense
        lag, amplitude = (np.asarray(values, dtype=np.float64) for values in axes.lines[0].get_data())
        high_spot = sensor - sense * lag[amplitude.argmax()]
        # On the machine both probes see the same spot: a quarter turn behind the heavy one, which is at angle 0.
        assert np.cos(high_spot + sense * np.pi / 2) == pytest.approx(1, abs=0.02)
        speeds = [float(text.get_text()) for text in axes.texts]
        assert len(speeds) > 5
        assert any(abs(one - 60 * CRITICAL_HZ) < 60 for one in speeds)


def test_a_bode_plot_marks_the_greatest_amplitude(run_up: tuple[int, Recorded]) -> None:
    lower, upper = drawn(bode(Look(), run_up[1], ["y2"], 1, 4, None)).axes
    assert lower.get_ylabel() == "1× amplitude, µm pp"
    top, bottom = upper.get_ylim()
    assert top > bottom  # lag grows downwards
    assert lower.get_title(loc="right").startswith("greatest: 2")


@pytest.mark.parametrize("plot", [bode, polar])
def test_the_heading_fits_above_a_single_channel(run_up: tuple[int, Recorded], plot: Callable[..., Figure]) -> None:
    figure = drawn(plot(Look(), run_up[1], ["y2"], 1, 4, None))
    widest = max(text.get_window_extent().x1 for text in figure.texts)
    assert widest < figure.bbox.x1


def test_the_slow_roll_vector_is_subtracted(tmp_path: Path) -> None:
    """A shaft with 3 µm of run-out, and 10 µm of vibration half a turn later at high speed."""

    def fast(t: FloatArray) -> FloatArray:
        return np.asarray(t > 10.0, dtype=np.float64)

    def angle(t: FloatArray) -> FloatArray:
        return np.asarray(2 * np.pi * (4.0 * t + 16.0 * fast(t) * (t - 10.0)))

    signals: Signals = {
        "theta": lambda t: angle(t) % (2 * np.pi),
        "y1": lambda t: 3 * np.cos(angle(t)) - 10 * fast(t) * np.cos(angle(t)),
    }
    data = made(tmp_path, signals, 20.0)
    channels = data.channels(["y1"])
    raw, less = (read_run_up(data, channels, 1, 8, slow) for slow in (None, 300.0))
    assert (raw.amplitude[-1, 0], less.amplitude[-1, 0]) == pytest.approx((14, 20), rel=1e-3)
    assert less.lag_deg[-1, 0] == pytest.approx(180, abs=0.5)
    assert less.amplitude[0, 0] < 0.05
    with pytest.raises(RotorwatchError, match="--slow-roll is 100 rpm, but the slowest is 240 rpm"):
        read_run_up(data, channels, 1, 8, 100.0)


def test_vectors_at_an_order_are_not_affected_by_other_orders(tmp_path: Path) -> None:
    """Whatever the number of revolutions; and no point spans a gap."""
    turn = 2 * np.pi * 20.0
    amplitudes = {1: 10.0, 2: 4.0, 3: 2.0}
    signals: Signals = {
        "theta": turning(20.0),
        "y1": lambda t: 100 + np.sum([a * np.cos(k * turn * t - 0.5 * k) for k, a in amplitudes.items()], axis=0),
    }
    data = made(tmp_path, signals, 12.0, without=[55])
    for order, revolutions in product(amplitudes, (1, 2, 5, 20)):
        found = read_run_up(data, data.channels(["y1"]), order, revolutions)
        assert found.amplitude == pytest.approx(2 * amplitudes[order], rel=2e-3)
        assert found.lag_deg == pytest.approx(np.degrees(0.5 * order), abs=0.5)
        assert found.speed_rad_s == pytest.approx(turn, rel=1e-3)
        assert not ((found.time_ns > START_NS + 5.5 * S) & (found.time_ns < START_NS + 5.6 * S)).any()


def test_without_a_keyphasor_the_speed_is_tracked_in_the_vibration_without_phase(tmp_path: Path) -> None:
    """1× of 20 µm in noise, from 15 to 30 Hz; noise alone has no speed."""
    noise = np.random.default_rng(3).normal(size=round(60 * RATE_HZ))

    def rising(t: FloatArray) -> FloatArray:
        turned = 15 * t + 0.125 * t**2
        return np.asarray(noise[: t.size] + 20 * np.cos(2 * np.pi * turned))

    data = recorded(without_angle(tmp_path / "plain.mcap", machine_blocks({"y2": rising}, 60.0)))
    channels = data.channels(["y2"])
    with pytest.raises(MachineFileError, match="without it vibration has no phase, and the speed"):
        read_run_up(data, channels, 1, 8)
    found = read_run_up(data, channels, 1, 8, between_rpm=(600, 2400))
    middle_s = (found.time_ns - START_NS) / S
    assert found.time_ns.size == 30
    assert found.speed_rad_s / (2 * np.pi) == pytest.approx(15 + 0.25 * middle_s, rel=2e-3)
    assert found.amplitude == pytest.approx(40, rel=0.02)
    figure = drawn(bode(Look(), data, ["y2"], 1, 8, None, (600, 2400)))
    assert [axes.get_ylabel() for axes in figure.axes] == ["1× amplitude, µm pp"]
    with pytest.raises(MachineFileError, match="--slow-roll needs phases"):
        read_run_up(data, channels, 1, 8, 500.0, (600, 2400))
    quiet = machine_blocks({"y2": lambda t: noise[: t.size]}, 20.0)
    data = recorded(without_angle(tmp_path / "noise.mcap", quiet))
    with pytest.raises(RotorwatchError, match="no line between 600 and 2400 rpm stands out"):
        read_run_up(data, channels, 1, 8, between_rpm=(600, 2400))


@pytest.mark.parametrize("keyphasor", [True, False])
def test_a_centreline_is_the_mean_of_the_gap_readings(tmp_path: Path, keyphasor: bool) -> None:
    """A shaft that rises by 3 µm/s and moves sideways by 1 µm/s during a run-up, vibrating by 50 µm.

    Over whole revolutions the vibration has no mean; over seconds a part of a revolution remains.
    """

    def angle(t: FloatArray) -> FloatArray:
        return np.asarray(2 * np.pi * (2.2 * t + 0.5 * t**2))

    signals: Signals = {
        "y1": lambda t: -400 + t + 50 * np.cos(angle(t)),
        "z1": lambda t: -600 + 3 * t + 50 * np.sin(angle(t)),
    }
    if keyphasor:
        signals["theta"] = lambda t: angle(t) % (2 * np.pi)
        data = made(tmp_path, signals, 20.0)
    else:
        data = recorded(without_angle(tmp_path / "plain.mcap", machine_blocks(signals, 20.0)))
    found = read_centreline(data, recorded_pairs(data, "bearing"), 2.0)
    middle_s = (found.time_ns - START_NS) / S
    assert middle_s == pytest.approx(np.arange(1, 20, 2), abs=0.25)
    leaks = 2.0 if keyphasor else 10.0  # the speed changes within revolutions, too
    assert found.y_um[:, 0] == pytest.approx(-400 + middle_s, abs=leaks)
    assert found.z_um[:, 0] == pytest.approx(-600 + 3 * middle_s, abs=leaks)
    assert found.y_um[-4:, 0] == pytest.approx(-400 + middle_s[-4:], abs=0.3 if keyphasor else 2.0)
    axes, bar = drawn(centreline(Look(), data, "bearing", 2.0, 100.0)).axes
    if keyphasor:
        assert found.speed_rad_s / (2 * np.pi) == pytest.approx(2.2 + np.arange(1, 20, 2), rel=0.01)
    assert bar.get_ylabel() == ("speed, rpm" if keyphasor else "time after the start, s")
    assert f"start: y1 {found.y_um[0, 0]:.4g} µm, z1 {found.z_um[0, 0]:.4g} µm" in axes.texts[0].get_text()
    assert axes.get_xlim()[0] < -50 < 50 < axes.get_xlim()[1]  # the whole clearance
    with pytest.raises(RotorwatchError, match="1 stretches of 20 s of demo/lab without a gap, expected at least 2"):
        read_centreline(data, recorded_pairs(data, "bearing"), 20.0)


@pytest.mark.parametrize(("window_s", "shown_ms"), [(0.25, 250.0), (None, 400.0)])
def test_a_waveform_has_the_unit_of_its_channel_and_a_mark_at_each_pulse(
    tmp_path: Path, window_s: float | None, shown_ms: float
) -> None:
    """20 revolutions a second: 8 of them last 0.4 s."""
    signals: Signals = {
        "theta": turning(20.0),
        "y1": lambda t: 7 * np.cos(2 * np.pi * 20 * t) + 500,
        "y2_dot": lambda t: 3 * np.sin(2 * np.pi * 20 * t),
    }
    data = made(tmp_path, signals, 5.0)
    first, second = drawn(waveform(Look(), data, ["y1", "y2_dot"], window_s)).axes
    assert (first.get_ylabel(), second.get_ylabel()) == ("µm", "mm/s")
    assert second.get_xlim() == pytest.approx((0, shown_ms), abs=0.5)
    assert first.get_title(loc="right").startswith("14 µm pp     4.95 µm rms     about a mean of 500 µm")
    time_ms, values = (np.asarray(one, dtype=np.float64) for one in first.lines[1].get_data())
    assert np.diff(time_ms) == pytest.approx(50.0, abs=0.01)
    assert values == pytest.approx(7, rel=1e-3)


def test_a_waveform_is_interrupted_at_a_gap(tmp_path: Path) -> None:
    data = made(tmp_path, {"y1": lambda t: np.sin(9 * t)}, 3.0, without=[25])
    axes = drawn(waveform(Look(), data, ["y1"], 1.0)).axes[0]
    starts = [float(np.asarray(line.get_xdata())[0]) for line in axes.lines[0:4:2]]
    assert starts == pytest.approx([0, 600])
