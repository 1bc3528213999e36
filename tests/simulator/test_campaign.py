"""Windows drawn at random: reproducible, independent, and in the condition that was asked for."""

from models.machine import load_machine
from simulator.campaign import Draw, Purpose, draw_condition

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
