"""A run-up in closed form: a circular orbit with run-out, of a shaft that climbs in its bearing."""

import numpy as np

from models.signals.block import FloatArray
from models.signals.channels import Channel
from tests.service.rig.live import LAB
from tests.service.rig.replaying import machine_blocks

SECONDS = 20.0
FROM_HZ, TO_HZ = 15.0, 35.0
SHAFT_UM, RUNOUT_UM, LAG = 20.0, 300.0, np.radians(40.0)
CHANNELS: tuple[Channel, ...] = tuple(one for one in LAB.sensors if one.name in ("y1", "z1"))


def angle(t: FloatArray) -> FloatArray:
    """Shaft angle during a run-up from 15 to 35 Hz."""
    return np.asarray(2 * np.pi * (FROM_HZ * t + (TO_HZ - FROM_HZ) / SECONDS * t**2 / 2))


BLOCKS = machine_blocks(
    {
        "theta": lambda t: angle(t) % (2 * np.pi),
        "y1": lambda t: SHAFT_UM * np.cos(angle(t) - LAG) + RUNOUT_UM,
        "z1": lambda t: SHAFT_UM * np.sin(angle(t) - LAG) - 4 * t,
    },
    SECONDS,
)
