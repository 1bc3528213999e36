"""A damped rotor with displacements of its disc alone, where other causes look like changes of parameters."""

import pytest

from models.commissioning.commissioned import Installed
from models.machine import Machine, load_machine
from models.physics.rotor import PARAMETERS
from service.monitor.monitor import MachineMonitor
from simulator.scenario import Event
from tests.service.rig.watching import feed
from tests.windows import healthy_blocks

SEED = 3


def damped() -> Machine:
    fields = load_machine("lab").model_dump(exclude_unset=True)
    fields["sensors"] = [one for one in fields["sensors"] if one["name"] in {"y2", "z2", "theta"}]
    for name in ("c_by_N_s_per_m", "c_bz_N_s_per_m"):
        fields["rotor"][name] *= 2
    return Machine.model_validate(fields)


@pytest.mark.parametrize(
    ("event", "told"),
    [
        (Event(at_s=60.0, anomaly="added_mass", size=0.2), True),
        (Event(at_s=60.0, parameter="k_by", relative_change=-0.2), False),
    ],
)
def test_a_name_has_low_confidence_only_if_a_heavier_disc_explains_the_data_as_well(
    event: Event, *, told: bool
) -> None:
    _, events = feed(MachineMonitor(Installed(damped())), healthy_blocks(damped(), 135.0, SEED, event, block_s=1.0))
    raised = {one.alarm.name: one for one in events if one.kind == "raised" and one.alarm.name in PARAMETERS}
    assert raised
    assert told or set(raised) == {event.parameter}
    assert {one.alarm.low_confidence for one in raised.values()} == {told}
    assert all("the disc's mass" in one.text for one in raised.values()) or not told
