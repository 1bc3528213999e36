"""Windows drawn at random: reproducible, independent, and in the condition that was asked for."""

import numpy as np
import pytest

from benchmarks.studies.subjects.unusual import Anomaly, Excitation, UnusualDraw
from models.errors import EstimationError
from models.machine import load_machine
from models.signals.block import FloatArray
from simulator.plant import rotor_in
from simulator.scenario import Event, Scenario
from simulator.stream import blocks
from simulator.timeline import compile_timeline
from simulator.training.draws import Draw, Layout, Purpose, draw_condition

LAB = load_machine("lab")


def test_a_fixed_condition_varies_nothing_but_the_realisation() -> None:
    draw = Draw(LAB, 11, Purpose.EVALUATION, kept_nominal=("e", "EI"), fixed_condition=True)
    first, second = draw_condition(draw, 0), draw_condition(draw, 1)
    apart = {"name", "seed"}
    assert first.model_dump(exclude=apart) == second.model_dump(exclude=apart)
    assert first.seed != second.seed
    free = Draw(LAB, 11, Purpose.EVALUATION, kept_nominal=("e", "EI"))
    assert first.model_dump(exclude={"seed"}) == draw_condition(free, 0).model_dump(exclude={"seed"})
    assert second.events != draw_condition(free, 1).events
    other = Draw(LAB, 11, Purpose.CALIBRATION, kept_nominal=("e", "EI"), fixed_condition=True)
    assert draw_condition(other, 1).seed != second.seed


def _samples(scenario: Scenario) -> FloatArray:
    return np.concatenate([block.samples for block, _ in blocks(scenario, LAB, block_s=1.0)]).astype(np.float64)


def _plain(**fields: object) -> UnusualDraw:
    return UnusualDraw(LAB, 12, Purpose.EVALUATION, layout=Layout.INDEPENDENT, **fields)  # type: ignore[arg-type]


@pytest.mark.parametrize("excitation", list(Excitation)[1:])
def test_another_excitation_changes_nothing_else(excitation: Excitation) -> None:
    usual, other = (draw_condition(_plain(excitation=e), 3) for e in (Excitation.SECOND_ORDER, excitation))
    apart = {"sources", "events"}
    assert usual.model_dump(exclude=apart) == other.model_dump(exclude=apart)
    assert other.events[: len(usual.events)] == usual.events
    assert [source.direction for source in usual.sources] == [source.direction for source in other.sources]
    orders, cutoffs = {source.order for source in other.sources}, {source.cutoff_hz for source in other.sources}
    expected = {Excitation.FIRST_ORDER: 1, Excitation.FOURTH_ORDER: 4}
    assert orders == {expected.get(excitation, 2)}
    assert len(cutoffs) == (4 if excitation is Excitation.OWN_CUTOFFS else 1)
    share = other.sources[0].hump_share
    assert 0.3 <= share <= 0.8 if excitation is Excitation.HUMP else share == 0
    assert (len(other.events) > len(usual.events)) == (excitation is Excitation.DRIFT)


def test_a_drifting_level_doubles_or_halves_the_vibration() -> None:
    """At once and in steps: rms of the last over that of the first tenth, about (0.5 or 2)^0.9."""
    machine = LAB.model_copy(update={"rotor": LAB.rotor.model_copy(update={"e_m": 1e-9})})
    drawn = {}
    for number in range(6):
        scenario = draw_condition(_plain(excitation=Excitation.DRIFT), number)
        levels = [event.excitation_level for event in scenario.events if event.excitation_level is not None]
        drawn[levels[-1], len(levels)] = scenario
    assert {end for end, _ in drawn} == {0.5, 2.0}
    assert {count for _, count in drawn} == {1, 8}
    for (end, _), scenario in drawn.items():
        # Forces as drawn, without unbalance or sensor noise: what is left is the excitation's level.
        quiet = scenario.model_copy(update={"sensors": scenario.sensors.model_copy(update={"noise_relative": 0.0})})
        z1 = np.concatenate([block.samples[:, 1] for block, _ in blocks(quiet, machine, block_s=1.0)])
        part = len(z1) // 10
        ratio = z1[-part:].std() / z1[:part].std()
        assert ratio == pytest.approx(end, rel=0.35)


def test_anomalies_have_their_effect() -> None:
    """20 s each, of the same noise: only the anomaly differs."""
    healthy = draw_condition(_plain(), 5)
    shown = {}
    for anomaly in Anomaly:
        scenario = draw_condition(_plain(anomaly=anomaly), 5)
        assert scenario.model_dump(exclude={"events", "rub"}) == healthy.model_dump(exclude={"events", "rub"})
        events = tuple(event.model_copy(update={"ramp_s": 0.0}) for event in scenario.events)
        shown[anomaly] = _samples(scenario.model_copy(update={"duration_s": 20.0, "events": events}))
    usual = shown[Anomaly.NONE]
    theta = usual[:, -1]

    def harmonic(samples: FloatArray, order: int) -> float:
        return float(np.abs(np.mean(samples[:, 5] * np.exp(-1j * order * theta))))  # z2

    radius = {anomaly: np.hypot(samples[:, 4], samples[:, 5]) for anomaly, samples in shown.items()}
    assert harmonic(shown[Anomaly.CRACK], 2) > 5 * harmonic(usual, 2)
    assert np.quantile(radius[Anomaly.RUB], 0.999) < np.quantile(radius[Anomaly.NONE], 0.999)
    assert harmonic(shown[Anomaly.ADDED_MASS], 1) > 1.01 * harmonic(usual, 1)
    factors = shown[Anomaly.GAIN_DRIFT].std(axis=0) / usual.std(axis=0)
    np.testing.assert_allclose(np.sort(factors), [*np.ones(8), 1.1], rtol=1e-3)


def test_a_crack_is_no_deeper_than_stable_operation_allows() -> None:
    light = load_machine("light")
    light = light.model_copy(update={"operation": light.operation.model_copy(update={"speed_tolerance": 0.0})})
    nominal = light.operation.model_copy(update={"speed_rpm": 1.11 * light.operation.speed_rpm})
    for machine, depth in ((light, 0.3), (light.model_copy(update={"operation": nominal}), 0.15)):
        scenario = draw_condition(
            UnusualDraw(machine, 12, Purpose.EVALUATION, anomaly=Anomaly.CRACK, anomaly_size=0.3), 0
        )
        assert [event.size for event in scenario.events if event.anomaly == "crack"] == [depth]
    deep = scenario.model_copy(update={"events": (*scenario.events, Event(at_s=0, anomaly="crack", size=0.3))})
    with pytest.raises(EstimationError, match=r"machine light: a crack of 0\.3 is unstable, the motion grows"):
        next(blocks(deep, machine))


def test_a_deposit_adds_mass_and_inertia_but_no_unbalance() -> None:
    condition = compile_timeline(draw_condition(_plain(anomaly=Anomaly.ADDED_MASS, anomaly_size=0.1), 5), LAB)
    rotor = rotor_in(LAB, condition.conditions[0][1])
    ratios = [getattr(rotor, name) / getattr(LAB.rotor, name) for name in ("m2_kg", "I2_kg_m2", "I2p_kg_m2", "e_m")]
    assert ratios == pytest.approx([1.1, 1.1, 1.1, 1 / 1.1])
