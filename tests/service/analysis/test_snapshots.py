"""Snapshots of a live machine: what was measured beside what theory predicts."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from pydantic import BaseModel
from scipy.signal import oaconvolve

from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine
from models.physics.excitation import Source, expanded_A, expanded_B
from models.physics.response import stationary_covariance
from models.physics.rotor import STATE_INDEX, changed
from models.signals.block import SampleBlock
from models.signals.channels import state_name
from rotorwatch.records.example import example
from rotorwatch.records.snapshots import CorrelationSnapshot, OrbitSnapshot, SpectrumSnapshot
from service.analysis.prediction import Prediction, predict
from service.analysis.snapshots.channels import SnapshotError
from service.analysis.snapshots.machine import LatestData
from service.analysis.snapshots.orbit import orbit_snapshot
from service.analysis.snapshots.window import correlation_snapshot, spectrum_snapshot
from service.api.routes.snapshots import WindowAnswers
from simulator.scenario import Event
from tests.commissioning.rotor_kit import LAB, NOTHING, stream
from tests.service.analysis.snapshotting import (
    K_BY,
    NAMES,
    SECONDS,
    SEED,
    by_plane,
    latest,
    numbers,
    snapshots_of,
    synthetic,
    window_of,
)
from tests.sure import sure
from tests.windows import correlation


@pytest.mark.parametrize("lagged", [True, False])
def test_nominal_theory_fits_a_healthy_machine_and_not_a_faulty_one(lagged: bool) -> None:
    snapshot = correlation_snapshot(snapshots_of(LAB), latest(lagged=lagged))
    assert (snapshot.reason, snapshot.theory.nominal_reason, snapshot.theory.estimated_reason) == ("", "", "")
    assert snapshot.method == ("samples" if lagged else "spectrum")
    assert len(snapshot.lags_s) == 126
    assert [(pair.first, pair.second) for pair in snapshot.pairs] == [
        *((name, name) for name in ("y1", "z1", "y2", "z2")),
        *(("y1", "y2"), ("z1", "z2"), ("y1", "z1"), ("y2", "z2")),
    ]
    for pair in snapshot.pairs:
        assert pair.unit == "um^2"
        assert pair.nominal_z is not None
        assert max(pair.nominal_z, sure(pair.estimated_z)) < 2.5
        z = (numbers(pair.measured) - numbers(pair.nominal)) / numbers(pair.standard_error)
        assert np.abs(z).max() < 5
        assert np.sqrt(np.mean(z**2)) == pytest.approx(pair.nominal_z, rel=1e-3)
    snapshot = correlation_snapshot(snapshots_of(LAB), latest(K_BY, lagged=lagged))
    changes = {change.name: change.relative_change for change in snapshot.theory.changes}
    assert changes["k_by"] == pytest.approx(-0.3, abs=0.02)
    for pair in by_plane(snapshot, "y"):
        assert sure(pair.nominal_z) > 8
        assert sure(pair.estimated_z) < 2.5
    for pair in by_plane(snapshot, "z"):
        assert sure(pair.nominal_z) < 2.5


@pytest.mark.parametrize("faults", [(), (K_BY,)])
def test_predicted_correlations_solve_the_lyapunov_equation(faults: tuple[Event, ...]) -> None:
    """All quantities at all lags, with the simulator's true sources: the rest is the error of their estimates."""
    data = latest(*faults)
    window = sure(data.window)
    sources = tuple(Source(cutoff_hz=90.0, direction=tuple(np.eye(6)[dof]), force_rms_N=0.47) for dof in (0, 1, 3, 4))
    rotor = changed(LAB.rotor, {"k_by": -0.3} if faults else {})
    A = expanded_A(rotor, window.speed_rad_s, sources)
    covariance = stationary_covariance(A, expanded_B(sources))
    names = [channel.name for channel in LAB.sensors if channel.name != "theta"]
    first, second = (list(column) for column in zip(*[(one, other) for one in names for other in names], strict=True))
    snapshot = correlation_snapshot(snapshots_of(LAB), data, first, second, units="SI")
    row = {channel.name: STATE_INDEX[state_name(channel)] for channel in LAB.sensors if channel.name != "theta"}
    exact = np.stack([correlation(A, covariance, lag_s) for lag_s in snapshot.lags_s])
    rms = np.sqrt(np.diag(covariance))
    for pair in snapshot.pairs:
        i, j = row[pair.first], row[pair.second]
        predicted = numbers(pair.estimated if faults else pair.nominal)
        assert predicted == pytest.approx(exact[:, i, j], abs=0.04 * rms[i] * rms[j]), (pair.first, pair.second)
    assert {pair.unit for pair in snapshot.pairs} == {"m^2", "m*m/s", "m/s*m", "(m/s)^2"}


def test_correlations_from_spectra_lack_the_power_outside_the_band() -> None:
    """At lag zero by the stated amount, at no lag by more than 3 %; standard errors are of the same size."""
    made = snapshots_of(LAB)
    whole, band = (correlation_snapshot(made, latest(lagged=lagged)) for lagged in (True, False))
    assert whole.lags_s == band.lags_s
    assert whole.band_hz is None
    assert band.band_hz == pytest.approx((2.9, 150.1))
    power = {pair.first: numbers(pair.measured)[0] for pair in whole.pairs if pair.first == pair.second}
    for one, other in zip(whole.pairs, band.pairs, strict=True):
        rms2 = np.sqrt(power[one.first] * power[one.second])
        difference = (numbers(one.measured) - numbers(other.measured)) / rms2
        assert other.outside_band == pytest.approx(difference[0], abs=1e-4)
        assert one.outside_band is None
        assert np.abs(difference).max() < 0.03
        ratio = numbers(other.standard_error) / numbers(one.standard_error)
        assert 0.6 < np.median(ratio) < 1.7


def test_short_segments_do_not_reduce_correlations() -> None:
    """Segments of half a second, lags up to a quarter of them: the taper alone would remove a third."""
    window = LAB.window.model_copy(update={"segment_s": 0.5})
    machine = NOTHING.model_copy(update={"sensors": LAB.sensors[:2], "window": window})
    made = snapshots_of(machine)
    whole, band = (
        correlation_snapshot(made, LatestData(window_of(machine, stream(SECONDS, SEED), lagged=lagged), 1.0))
        for lagged in (True, False)
    )
    late = np.array(whole.lags_s) > 0.08
    for one, other in zip(whole.pairs[:2], band.pairs[:2], strict=True):
        measured, from_spectra = numbers(one.measured)[late], numbers(other.measured)[late]
        slope = float(measured @ from_spectra / (measured @ measured))
        assert slope == pytest.approx(1.0, abs=0.06)


def test_standard_errors_from_spectra_agree_with_the_scatter_of_windows() -> None:
    """Coloured noise in 25 windows: scatter of the estimates against their stated errors."""
    shorter = LAB.window.model_copy(update={"length_s": 30.0})
    machine = NOTHING.model_copy(update={"sensors": LAB.sensors[:2], "window": shorter})
    rng = np.random.default_rng(3)
    values, errors = [], []
    for _ in range(25):
        white = rng.standard_normal((round(33 * LAB.rate_hz), 2))
        smooth = oaconvolve(white, np.hanning(40)[:, None], "same", axes=0)
        blocks_ = synthetic({"y1": smooth[:, 0], "z1": smooth[:, 0] + smooth[:, 1]})
        window = window_of(machine, blocks_, lagged=False)
        (pair,) = correlation_snapshot(snapshots_of(NOTHING), LatestData(window, 1.0), ["y1"], ["z1"]).pairs
        values.append(numbers(pair.measured))
        errors.append(numbers(pair.standard_error))
    ratio = np.std(values, axis=0, ddof=1) / np.mean(errors, axis=0)
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.15)


def test_densities_scatter_around_theory_with_their_degrees_of_freedom() -> None:
    snapshot = spectrum_snapshot(snapshots_of(LAB), latest(K_BY), [name for name in NAMES if name != "theta"])
    assert snapshot.left_out_hz is not None
    frequencies_hz = np.array(snapshot.frequencies_hz)
    assert (frequencies_hz[0], frequencies_hz[-1], frequencies_hz.size) == (3.0, 150.0, 736)
    assert snapshot.rotation_hz == pytest.approx(22.0, abs=1e-3)
    compared = (frequencies_hz < snapshot.left_out_hz[0]) | (frequencies_hz > snapshot.left_out_hz[1])
    for density in snapshot.densities:
        measured, expected = numbers(density.measured)[compared], numbers(density.estimated)[compared]
        ratio = measured / expected
        assert ratio.mean() == pytest.approx(1.0, abs=0.03)
        assert ratio.var() * sure(snapshot.degrees_of_freedom) / 2 == pytest.approx(1.0, abs=0.25)
        low, high = sure(snapshot.interval_95)
        assert np.mean((measured * low < expected) & (expected < measured * high)) == pytest.approx(0.95, abs=0.03)
        whole = numbers(density.measured).sum() * 0.2
        assert density.rms == pytest.approx(np.sqrt(whole), rel=1e-5)
    of = {density.channel: density for density in snapshot.densities}
    near_mode = (frequencies_hz > 20) & (frequencies_hz < 28) & compared
    excess = numbers(of["y1"].measured)[near_mode] / numbers(of["y1"].nominal)[near_mode]
    assert excess.mean() > 1.5  # the resonance has come down
    unmoved = numbers(of["z1"].measured)[near_mode] / numbers(of["z1"].nominal)[near_mode]
    assert unmoved.mean() == pytest.approx(1.0, abs=0.1)


def test_densities_are_in_units_of_the_channel_or_si() -> None:
    made, data = snapshots_of(LAB), latest()
    own, si = (
        spectrum_snapshot(made, data, ["y1", "y1_dot"], ["y1"], ["y1_dot"], units=units) for units in ("channel", "SI")
    )
    assert [density.unit for density in own.densities] == ["um^2/Hz", "(mm/s)^2/Hz"]
    assert [density.unit for density in si.densities] == ["m^2/Hz", "(m/s)^2/Hz"]
    assert numbers(own.densities[0].measured) == pytest.approx(1e12 * numbers(si.densities[0].measured), rel=1e-5)
    assert numbers(own.densities[1].nominal) == pytest.approx(1e6 * numbers(si.densities[1].nominal), rel=1e-5)
    assert (own.cross[0].unit, si.cross[0].unit) == ("um*mm/s/Hz", "m*m/s/Hz")
    # A velocity leads its displacement by 90°, and is coherent with it.
    assert np.median(numbers(own.cross[0].phase_deg)) == pytest.approx(90, abs=1)
    assert np.median(numbers(own.cross[0].coherence)) > 0.9


def test_coherence_and_phase_of_a_delayed_channel() -> None:
    """z1 is y1 two samples later; y2 has nothing in common with it."""
    rng = np.random.default_rng(8)
    white = rng.standard_normal((round(71 * LAB.rate_hz), 2))
    stream_ = synthetic({"y1": white[:, 0], "z1": np.roll(white[:, 0], 2), "y2": white[:, 1]})
    machine = NOTHING.model_copy(update={"sensors": tuple(c for c in LAB.sensors if c.name in ("y1", "z1", "y2"))})
    snapshot = spectrum_snapshot(
        snapshots_of(machine), LatestData(window_of(machine, stream_), 1.0), (), ["y1", "y1"], ["z1", "y2"]
    )
    late, foreign = snapshot.cross
    frequencies_hz = np.array(snapshot.frequencies_hz)
    assert numbers(late.phase_deg) == pytest.approx(-360 * frequencies_hz * 2 / LAB.rate_hz, abs=1.0)
    assert numbers(late.coherence).min() > 0.99
    beyond = np.mean(numbers(foreign.coherence) > sure(snapshot.coherence_95))
    assert beyond == pytest.approx(0.05, abs=0.03)
    # One-sided density of white noise of unit variance, in the band and everywhere: 2 / rate.
    assert numbers(snapshot.densities[0].measured).mean() == pytest.approx(2 / LAB.rate_hz, rel=0.03)
    assert late.nominal_magnitude is None


def test_a_wide_band_is_averaged_into_fewer_lines() -> None:
    window = LAB.window.model_copy(update={"band_hz": (3.0, 500.0)})
    machine = NOTHING.model_copy(update={"sensors": LAB.sensors[:1], "window": window})
    rng = np.random.default_rng(4)
    stream_ = synthetic({"y1": rng.standard_normal(round(71 * LAB.rate_hz))})
    snapshot = spectrum_snapshot(snapshots_of(machine), LatestData(window_of(machine, stream_), 1.0))
    assert snapshot.averaged_lines == 3
    assert snapshot.line_spacing_hz == pytest.approx(0.6)
    assert len(snapshot.frequencies_hz) == 828
    assert np.diff(snapshot.frequencies_hz) == pytest.approx(0.6, abs=1e-3)
    measured = numbers(snapshot.densities[0].measured)
    assert measured.var() / measured.mean() ** 2 * sure(snapshot.degrees_of_freedom) / 2 == pytest.approx(1.0, abs=0.2)


def test_a_part_of_the_band_can_be_selected() -> None:
    made = snapshots_of(LAB)
    part, whole = (
        spectrum_snapshot(made, latest(), ["y2"], band_hz=(25.0, 35.0)),
        spectrum_snapshot(made, latest(), ["y2"]),
    )
    assert (part.frequencies_hz[0], part.frequencies_hz[-1]) == (25.0, 35.0)
    at = whole.frequencies_hz.index(25.0)
    count = len(part.frequencies_hz)
    assert part.densities[0].measured == whole.densities[0].measured[at : at + count]
    nominal = numbers(whole.densities[0].nominal)[at : at + count]
    assert numbers(part.densities[0].nominal) == pytest.approx(nominal, rel=1e-4)
    with pytest.raises(SnapshotError, match=r"band is 200 to 300 Hz, expected at least 0\.4 Hz within 3 to 150"):
        spectrum_snapshot(made, latest(), ["y2"], band_hz=(200.0, 300.0))


def test_without_known_parameters_there_is_no_theory() -> None:
    reason = "the machine's parameters are not known, so there is no theory to predict from"
    data, made = LatestData(latest().window, 1.0, (), "", stream(SECONDS, SEED)[-20:]), snapshots_of(NOTHING)
    correlations, spectra, orbits = (
        correlation_snapshot(made, data),
        spectrum_snapshot(made, data, (), ["y1"]),
        orbit_snapshot(made, data, 2),
    )
    known = correlation_snapshot(snapshots_of(LAB), latest())
    assert [pair.measured for pair in correlations.pairs] == [pair.measured for pair in known.pairs]
    for snapshot in (correlations, spectra, orbits):
        theory = snapshot.theory
        assert (snapshot.reason, theory.nominal_reason, theory.estimated_reason) == ("", reason, reason)
    assert {(pair.nominal, pair.estimated, pair.nominal_z) for pair in correlations.pairs} == {(None, None, None)}
    assert {(density.nominal, density.estimated) for density in spectra.densities} == {(None, None)}
    assert {(orbit.nominal, orbit.estimated) for orbit in orbits.orbits} == {(None, None)}
    assert all(orbit.ellipse is not None and orbit.path is not None for orbit in orbits.orbits)


@pytest.mark.parametrize(("elsewhere", "held"), [("bearing", ["y2", "z2"]), ("bearing disc", [])])
def test_channels_at_places_outside_the_model_have_only_levels(elsewhere: str, held: list[str]) -> None:
    moved = tuple(
        one.model_copy(update={"location": "DE"}) if one.location in elsewhere.split() else one
        for one in NOTHING.sensors
    )
    machine = NOTHING.model_copy(update={"sensors": moved})
    data = LatestData(window_of(machine, stream(SECONDS, SEED)), 1.0, (), "", ())
    made = snapshots_of(machine)
    spectra, correlations = spectrum_snapshot(made, data), correlation_snapshot(made, data)
    assert [one.channel for one in spectra.densities] == held
    assert {name for pair in correlations.pairs for name in (pair.first, pair.second)} == set(held)
    assert all(("only levels are watched" in one.reason) is not bool(held) for one in (spectra, correlations))
    for refused in (
        lambda: spectrum_snapshot(made, data, ["y1"]),
        lambda: correlation_snapshot(made, data, ["y1"], ["y1"]),
    ):
        with pytest.raises(SnapshotError, match="of y1 only levels are watched"):
            refused()


def test_a_window_not_evaluated_has_only_nominal_theory() -> None:
    why = "demo/lab: gain of y1 is 20 % lower than when it was commissioned"
    data = LatestData(latest().window, 1.0, (), why)
    snapshot = correlation_snapshot(snapshots_of(LAB), data)
    assert (snapshot.theory.nominal_reason, snapshot.theory.estimated_reason) == ("", why)
    assert snapshot.theory.changes == ()
    assert all(pair.estimated is None and pair.estimated_z is None for pair in snapshot.pairs)
    assert all(pair.nominal_z is not None and pair.nominal_z < 2.5 for pair in snapshot.pairs)
    unsaid = spectrum_snapshot(snapshots_of(LAB), LatestData(latest().window, 1.0))
    assert unsaid.theory.estimated_reason == "no parameter was read in this window"


def test_before_the_first_window_only_paths_of_orbits_are_shown() -> None:
    data = LatestData(None, 0.25, (), "", stream(SECONDS, SEED)[:20])
    made = snapshots_of(LAB)
    correlations, spectra, orbits = (
        correlation_snapshot(made, data),
        spectrum_snapshot(made, data),
        orbit_snapshot(made, data, 35),
    )
    for snapshot in (correlations, spectra, orbits):
        assert snapshot.reason == "demo/lab: no window of 60 s is full yet, 25% of one is there"
        assert (snapshot.start_ns, snapshot.end_ns, snapshot.speed_rad_s) == (None, None, None)
        assert snapshot.filled == 0.25
    assert (correlations.pairs, spectra.densities) == ((), ())
    assert orbits.revolutions == 35
    assert all(orbit.path is not None and orbit.ellipse is None for orbit in orbits.orbits)


def test_a_stuck_channel_has_no_theory_and_no_coherence() -> None:
    stream_ = [
        SampleBlock(b.start_ns, b.sequence, b.run, b.rate_hz, np.where(np.array(NAMES) == "y1", 5.0, b.samples))
        for b in stream(SECONDS, SEED)
    ]
    data = LatestData(window_of(LAB, stream_), 1.0, (), "y1 is stuck")
    snapshot = correlation_snapshot(snapshots_of(LAB), data)
    assert snapshot.theory.nominal_reason.startswith("demo/lab: no fluctuation in y1")
    assert snapshot.theory.estimated_reason == "y1 is stuck"
    assert set(snapshot.pairs[0].measured) <= {0.0, -0.0}
    assert snapshot.pairs[0].nominal is None
    (cross,) = json.loads(spectrum_snapshot(snapshots_of(LAB), data, (), ["y1"], ["y2"]).model_dump_json())["cross"]
    assert cross["coherence"][0] is None


def test_channels_are_chosen_by_name_and_velocities_by_default_without_displacements() -> None:
    made = snapshots_of(LAB)
    pairs = correlation_snapshot(made, latest(), ["z2", "y1"]).pairs
    assert [(pair.first, pair.second) for pair in pairs] == [("z2", "z2"), ("y1", "y1")]
    with pytest.raises(SnapshotError, match="channel is 'q'"):
        spectrum_snapshot(made, latest(), ["q"])
    rates = NOTHING.model_copy(update={"sensors": tuple(c for c in LAB.sensors if c.quantity == "velocity")})
    data = LatestData(window_of(rates, stream(SECONDS, SEED)), 1.0)
    snapshot = spectrum_snapshot(snapshots_of(rates), data)
    assert [density.channel for density in snapshot.densities] == ["y1_dot", "z1_dot", "y2_dot", "z2_dot"]
    assert (snapshot.rotation_hz, snapshot.left_out_hz) == (None, None)
    orbits = orbit_snapshot(snapshots_of(rates), data)
    assert orbits.orbits == ()
    assert orbits.reason.endswith("measured displacements: none")
    assert orbits.path_reason == orbits.reason  # nothing of revolutions that nobody can see


def test_the_theory_of_a_window_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[WindowStatistics] = []

    def counted(known: Machine | None, window: WindowStatistics, *rest: object) -> Prediction:
        asked.append(window)
        return predict(known, window, *rest)  # type: ignore[arg-type]  # handed on as they came

    monkeypatch.setattr("service.analysis.prediction.predict", counted)
    made = snapshots_of(LAB)
    first = correlation_snapshot(made, latest())
    spectrum_snapshot(made, latest())
    assert correlation_snapshot(made, latest()) == first
    assert len(asked) == 1
    correlation_snapshot(made, latest(K_BY))
    assert len(asked) == 2


def test_an_answer_on_a_window_is_made_once_for_equal_requests() -> None:
    now_s, made, fails = 0.0, 0, False
    answers, subject = WindowAnswers(lambda: now_s), snapshots_of(LAB)

    def asked(data: LatestData, question: str = "", **of: bool) -> tuple[int, bytes]:
        def make() -> OrbitSnapshot:
            nonlocal made
            made += 1
            if fails:
                raise SnapshotError("not now")
            return orbit_snapshot(subject, data)

        before = made
        body = answers.of(question, data, make, **of).body
        return made - before, bytes(body)

    data = latest()
    later = replace(data, blocks=data.blocks[1:])
    count, body = asked(data)
    assert count == 1
    assert OrbitSnapshot.model_validate_json(body) == orbit_snapshot(subject, data)
    assert asked(later) == (0, body)
    assert asked(replace(data, filled=0.9))[0] == 1
    assert asked(latest(K_BY))[0] == 1
    # Samples arrive continuously; answers with samples are made once a second.
    assert [asked(one, "newest", of_samples=True)[0] for one in (data, later, data)] == [1, 0, 0]
    now_s, fails = 1.1, True
    for _ in range(2):  # an older answer is no longer used
        with pytest.raises(SnapshotError):
            asked(later, "newest", of_samples=True)
    fails = False
    assert asked(later, "newest", of_samples=True)[0] == asked(latest(K_BY), "newest", of_samples=True)[0] == 1
    assert asked(latest(K_BY))[0] == 0
    for number in range(64):
        asked(data, f"{number} revolutions")
    assert asked(latest(K_BY))[0] == 1  # not kept for ever


@pytest.mark.parametrize("model", [CorrelationSnapshot, SpectrumSnapshot, OrbitSnapshot])
def test_snapshots_are_read_back_from_json(model: type[BaseModel]) -> None:
    """Every field has an example; JSON is read back unchanged; no number is NaN or infinite."""
    model.model_validate(example(model))
    lab = snapshots_of(LAB)
    made: dict[type[BaseModel], Callable[[LatestData], BaseModel]] = {
        CorrelationSnapshot: partial(correlation_snapshot, lab),
        SpectrumSnapshot: partial(spectrum_snapshot, lab, first=["y1"], second=["y2"]),
        OrbitSnapshot: partial(orbit_snapshot, lab, revolutions=8),
    }
    for data in (latest(), LatestData()):
        snapshot = made[model](data)
        text = snapshot.model_dump_json()
        assert model.model_validate_json(text) == snapshot
        json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} in JSON"))


def test_without_samples_there_are_no_revolutions() -> None:
    none = orbit_snapshot(snapshots_of(LAB), LatestData(None, 0.0, (), "", ()), 20)
    assert (none.revolutions, none.path_reason) == (0, "no samples have come in")
    assert all(orbit.path is None for orbit in none.orbits)
