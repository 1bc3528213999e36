"""What time it is for a machine's thread."""

import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Clocks:
    """The computer's clocks; a test puts others in."""

    monotonic_s: Callable[[], float] = time.monotonic  # seconds that only pass
    utc_ns: Callable[[], int] = time.time_ns  # time of day


COMPUTER = Clocks()
