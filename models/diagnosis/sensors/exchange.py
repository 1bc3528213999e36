"""Channels that changed places: the displacement of one place goes with the velocity of another."""

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from models.diagnosis.pairs import MotionPair, motion_pairs
from models.diagnosis.sensors.finding import Naming
from models.diagnosis.sensors.kinematics import Banded, banded, same
from models.diagnosis.sensors.reference import SensorReference
from models.diagnosis.window import WindowStatistics
from models.signals.block import FloatArray
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault

__all__ = ["BROKEN", "suspect_pairs", "swapped"]

BROKEN = 0.9
"""Two sensors of one motion that share less than this do not see the same motion."""
_SUSPECT = 0.985
"""Below this they may see each other's: two places of a stiff shaft move much alike."""
_RESTORED = 0.97
"""What every pair must share again after the exchange, unless less was usual when healthy."""
_CLEARLY = 5.0
"""How much smaller the exchange must make what the worse of the pairs does not share."""
_ALIKE = 0.25
"""Relative difference of rotation vectors that tells which of two exchanges restores the healthy pattern."""


def _usual(reference: SensorReference | None, first: str, second: str) -> float:
    known = None if reference is None else reference.pair(first, second)
    return 1.0 if known is None else known.same


def suspect_pairs(
    states: tuple[str, ...], bands: Mapping[MotionPair, Banded], reference: SensorReference | None
) -> list[MotionPair]:
    """Pairs that at any one time show less of the same motion than two sensors of one motion do."""
    return [
        pair
        for pair, own in bands.items()
        if same(own) < _SUSPECT * _usual(reference, states[pair.first], states[pair.second])
    ]


def swapped(
    window: WindowStatistics, broken: list[MotionPair], naming: Naming, reference: SensorReference | None
) -> tuple[list[SensorFault], set[MotionPair]]:
    """Find the exchange of two channels of one quantity that restores the pairs that are broken.

    Returns
    -------
    findings : list of SensorFault
    explained : set of MotionPair
        Pairs that need no other explanation.
    """
    findings: list[SensorFault] = []
    explained: set[MotionPair] = set()
    for one, other in combinations(broken, 2):
        if one.order != other.order or {one, other} & explained:
            continue
        crossed = (MotionPair(one.first, other.second, one.order), MotionPair(other.first, one.second, one.order))
        now = min(same(banded(window, pair)) for pair in (one, other))
        then = min(same(banded(window, pair)) for pair in crossed)
        usual = min(_usual(reference, window.states[p.first], window.states[p.second]) for p in (one, other))
        if then < _RESTORED * min(usual, 1.0) or 1 - now < _CLEARLY * (1 - then):
            continue
        explained |= {one, other}
        sides = [(one.first, other.first), (one.second, other.second)]
        guilty = _guilty(window, sides, broken, reference)
        columns = sides[guilty] if guilty is not None else (*sides[0], *sides[1])
        states = tuple(window.states[column] for column in columns)
        pairs = " and ".join(
            f"{naming.name(window.states[p.first])} moves like {naming.name(window.states[p.second])}" for p in crossed
        )
        either = (
            f"{naming.names(states)} are swapped"
            if guilty is not None
            else f"{naming.names(states[:2])} are swapped, or {naming.names(states[2:])}"
        )
        text = f"{either}: {pairs}, but not as they are connected (shared {then:.3f} crossed, {now:.3f} as connected)"
        findings.append(SensorFault(states=states, kind=FaultKind.SWAPPED, text=text, value=now))
    return findings, explained


def _guilty(
    window: WindowStatistics, sides: list[tuple[int, int]], broken: list[MotionPair], reference: SensorReference | None
) -> int | None:
    """Which side was exchanged: the one that breaks two pairs of a chain of three, or whose rotation is the other's."""
    for number, side in enumerate(sides):
        if all(sum(column in (pair.first, pair.second) for pair in broken) > 1 for column in side):
            return number
    chained = [any(column in _chain(window, number, column) for column in side) for number, side in enumerate(sides)]
    if chained.count(True) == 1:  # the other side has a third sensor that still agrees with it
        return chained.index(False)
    vectors = window.rotation_vectors
    if vectors is None or reference is None:
        return None
    sizes = np.abs(vectors).mean(axis=0)
    alike = [_exchanged(window, sizes, side, reference) for side in sides]
    return alike.index(True) if alike.count(True) == 1 else None


def _chain(window: WindowStatistics, side: int, column: int) -> set[int]:
    """Columns that share a pair with this one on the side away from the broken pair, and still agree."""
    found = set()
    for pair in motion_pairs(window.states):
        inner = pair.second if side == 0 else pair.first
        if inner == column and same(banded(window, pair)) > _RESTORED:
            found.add(column)
    return found


def _exchanged(window: WindowStatistics, sizes: FloatArray, side: tuple[int, int], reference: SensorReference) -> bool:
    """Whether the rotation's amplitudes at two channels are the healthy ones of each other and not their own."""
    known = [reference.channel(window.states[column]) for column in side]
    amplitudes = [None if one is None else one.rotation for one in known]
    first, second = amplitudes
    if not first or not second:
        return False
    seen = [float(sizes[column]) for column in side]
    own = max(abs(seen[0] / first - 1), abs(seen[1] / second - 1))
    crossed = max(abs(seen[0] / second - 1), abs(seen[1] / first - 1))
    return crossed < _ALIKE * own
