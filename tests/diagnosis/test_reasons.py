"""Reasons why something is not evaluated: the value that they quote is beyond the limit that they quote."""

import re
from dataclasses import replace

import numpy as np
import pytest

from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.misfit import AlternativeTest, Goodness
from models.diagnosis.networks.amortised import NetworkDiagnostician
from models.diagnosis.networks.bundle import load_bundle
from models.diagnosis.readings import Diagnosis, beyond, parameter_reading, possible_reading
from models.diagnosis.verdict.stretch import determined
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError, UnexplainedError
from models.machine import load_machine
from models.physics.rotor import impossible
from service.monitor.known_machine import KnownMachineEvaluator
from simulator.training.draws import Draw, Layout, Purpose, simulate_window
from tests.sure import sure

MACHINE = load_machine("lab")
_NUMBER = r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?"


@pytest.fixture(scope="module")
def window() -> WindowStatistics:
    return simulate_window(Draw(MACHINE, 7_700_041, Purpose.EVALUATION, 0, layout=Layout.INDEPENDENT), 0)


def assert_beyond(sentence: str) -> None:
    """The last number before "limit" or "at most" ("at least") is more (less) than the one after it, as printed."""
    found = re.search(rf"({_NUMBER})\D*?(limit|at most|at least)\D*? ({_NUMBER})", sentence)
    assert found, sentence
    value, side, limit = float(found[1]), found[2], float(found[3])
    assert value < limit if side == "at least" else value > limit, sentence


def reason_of(window: WindowStatistics) -> str:
    try:
        return LikelihoodFit(MACHINE).diagnose(window).unexplained
    except UnexplainedError as error:
        return str(error)


def mixed(window: WindowStatistics, share: float) -> WindowStatistics:
    """The window with the spectrum of its first channel modulated over frequency."""
    spectrum = window.spectrum.copy()
    spectrum[:, 0, 0] *= 1 + share * np.cos(0.3 * np.arange(len(spectrum)))
    return replace(window, spectrum=spectrum)


def test_numbers_are_printed_beyond_their_limits() -> None:
    rng = np.random.default_rng(1)
    for limit in (0.2, 5.0, 20.0, 34.5, 100.0):
        for excess in 10.0 ** rng.uniform(-9, 3, 50):
            for value in (limit * (1 + excess), limit / (1 + excess)):
                text, printed = beyond(value, limit)
                assert float(printed) == limit
                assert (float(text) > limit) == (value > limit)
                assert float(text) != limit


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_window_that_is_far_from_theory_says_by_how_much(window: WindowStatistics, share: float) -> None:
    assert_beyond(reason_of(mixed(window, share)))


def test_a_parameter_far_from_nominal_says_how_far(window: WindowStatistics) -> None:
    softer = MACHINE.rotor.model_copy(update={"c_by_N_s_per_m": MACHINE.rotor.c_by_N_s_per_m * 8})
    with pytest.raises(UnexplainedError) as caught:
        LikelihoodFit(MACHINE.model_copy(update={"rotor": softer})).diagnose(window)
    assert_beyond(str(caught.value))


def test_a_window_of_mostly_noise_states_how_much(window: WindowStatistics) -> None:
    """Every motion is mostly white, consistently in displacement and velocity."""
    w, states = 2 * np.pi * window.frequencies_hz, list(window.states)
    spectrum = 0.01 * window.spectrum
    for at, name in enumerate(states):
        if name.endswith("_dot"):
            continue
        rate = states.index(f"{name}_dot")
        density = window.spectrum[:, at, at].real.mean()
        spectrum[:, at, at] += 1.0001 * density
        spectrum[:, rate, rate] += 1.0001 * density * w**2
        spectrum[:, rate, at] += 1j * w * density
        spectrum[:, at, rate] -= 1j * w * density
    reason = reason_of(replace(window, spectrum=spectrum))
    assert "noise" in reason
    assert_beyond(reason)


def test_a_rotor_in_noisy_sensors_is_read(window: WindowStatistics) -> None:
    """Three times as much noise as motion, but independent in each sensor."""
    noise = 3 * np.einsum("fii->i", window.spectrum).real / len(window.spectrum)
    assert reason_of(replace(window, spectrum=window.spectrum + np.diag(noise))) == ""


def test_a_misfit_without_visible_rotor_motion_is_unexplained(window: WindowStatistics) -> None:
    """Each sensor has independent noise of ten times its motion, and more of it in a part of the band."""
    noise = 100 * np.diag(np.einsum("fii->i", window.spectrum).real / len(window.spectrum))
    more = np.where(np.abs(window.frequencies_hz - 70) < 5, 3.0, 1.0)[:, None, None]
    gain = np.where(np.arange(len(window.states)) == 0, 1.1, 1.0)
    seen, drowned = (
        LikelihoodFit(MACHINE).diagnose(replace(window, spectrum=spectrum))
        for spectrum in (window.spectrum * np.outer(gain, gain), window.spectrum + noise)
    )
    assert sure(seen.misfit_z) > 4
    assert not seen.unexplained
    assert not drowned.unexplained  # nothing contradicts the rotor: its parameters are only vague
    assert_beyond(reason_of(replace(window, spectrum=window.spectrum + noise * more)))


def test_an_imprecise_reading_states_its_error(window: WindowStatistics) -> None:
    for error in (0.2001, 0.204, 0.5, 3.0):
        vague = Diagnosis("likelihood", (parameter_reading("k_by", "likelihood", 0.1, error),))
        assert_beyond(determined(vague, window, 60.0).parameters[0].reason)


@pytest.mark.parametrize(
    ("name", "change", "error", "read"), [("e", 7.0, 0.3, True), ("e", 0.9, 0.3, False), ("k_by", 7.0, 0.3, False)]
)
def test_an_unbalance_that_is_many_times_the_nominal_one_is_read(
    window: WindowStatistics, name: str, change: float, error: float, read: bool
) -> None:
    """Its error grows in proportion, and would otherwise hide the largest unbalances."""
    diagnosis = Diagnosis("likelihood", (parameter_reading(name, "likelihood", change, error),))
    assert [one.name for one in determined(diagnosis, window, 60.0).evaluable] == [name] * read


@pytest.mark.parametrize(
    ("mean", "spread"), [*((mean, 0.0) for mean in (0.5, 0.948, 1.052, 2.0)), (1.0, 0.1501), (1.0, 0.2), (1.0, 0.6)]
)
def test_a_speed_out_of_range_or_unsteady_is_stated_with_its_limit(
    window: WindowStatistics, mean: float, spread: float
) -> None:
    tolerance, nominal = MACHINE.operation.speed_tolerance, MACHINE.operation.speed_rad_s
    turning = replace(window, speed_rad_s=nominal * (1 + (mean - 1) * max(1.0, tolerance / 0.05)))
    if spread:
        turning = replace(turning, speed_range=(nominal * (1 - spread / 2), nominal * (1 + spread / 2)))
    with pytest.raises(EstimationError) as caught:
        KnownMachineEvaluator(MACHINE, None).evaluate(turning)
    assert_beyond(str(caught.value))


def test_networks_give_one_reason_with_its_limit_for_an_unknown_window(window: WindowStatistics) -> None:
    networks = sure(load_bundle("lab", MACHINE).amortised)
    diagnostician = NetworkDiagnostician(MACHINE, networks)
    spectrum = window.spectrum.copy()
    spectrum[:, :2, :2] *= np.exp(2 * np.sin(0.1 * np.arange(len(spectrum))))[:, None, None]
    reasons = {one.reason for one in diagnostician.diagnose(replace(window, spectrum=spectrum)).parameters}
    assert len(reasons) == 1
    assert_beyond(reasons.pop())


@pytest.mark.parametrize("change", [-1.0, -1.004, -4.7])
def test_physically_impossible_changes_are_no_reading(change: float) -> None:
    for name in ("k_by", "e"):
        reading = possible_reading(name, "relation", change, 0.1)
        assert reading.relative_change is None
        assert reading.reason == impossible(change, "distance" if name == "e" else "stiffness")


def test_physically_impossible_suspects_are_not_named() -> None:
    """A one-step size that only shows that the change is not small is left out; the name may remain."""

    def suspect(name: str, change: float, z: float = 20.0) -> str:
        return Goodness(9.0, (AlternativeTest(name, z, change), AlternativeTest("gain of y1", 6.0, 0.1)), 2).suspect

    assert suspect("mass of the disc", -4.7) == suspect("gain of z2", -1.372) == ""
    assert suspect("inertia of the disc", 4.96) == "inertia of the disc"
    assert suspect("mass of the disc", 0.07) == "mass of the disc (+7.0%)"
    assert suspect("shaft stiffer in y than in z", 1.2) == ""
    assert suspect("shaft stiffer in y than in z", -0.0003) == ""  # no machine is built that exactly
    assert suspect("mass of the disc", 0.07, z=4.0) == "gain of y1 (+10.0%)"
    assert suspect("delay of y1", -4e-5) == "delay of y1 (-40 µs)"
    assert suspect("delay of y1", 1e-6) == ""
    assert suspect("delay of y1", 2e-3) == "delay of y1"


def test_suspects_must_explain_part_of_the_misfit_and_more_if_unexplained() -> None:
    delay = AlternativeTest("delay of y1", 20.0, 4e-5)
    mostly, partly, hardly = (Goodness(9.0, (delay,), 2, excess) for excess in (1000.0, 2000.0, 5000.0))
    assert mostly.suspected(unexplained=True) == "delay of y1 (+40 µs)"
    assert not partly.suspected(unexplained=True)
    assert partly.suspected(unexplained=False) == "delay of y1 (+40 µs)"
    assert not hardly.suspected(unexplained=False)  # a whirl, for example, of which a delay explains a hundredth
    assert Goodness(4.5, (), 1).misfit_z == pytest.approx(4.5)
