"""Which measured quantity each motion is formed from.

Displacement, velocity and acceleration of a place are one motion. Correlated under a smooth kernel over lags, a
derivative is moved to the kernel, so that one of the three suffices. It cannot be integrated that way: where a place
has a velocity or an acceleration alone, the whole row is differentiated, once or twice, which leaves it as true as it
was.
"""

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["ORDERS", "Formation", "Motion", "Source", "formation_of", "lowest", "not_measured", "state_of"]

ORDERS = ("", "_dot", "_ddot")
"""Endings of the state variable's name by order of the derivative that is measured."""

_PLACES = {
    "y1": "bearing, horizontal",
    "y2": "disc, horizontal",
    "z1": "bearing, vertical",
    "z2": "disc, vertical",
    "psi": "tilt of the disc, horizontal",
    "phi": "tilt of the disc, vertical",
}


@dataclass(frozen=True, slots=True)
class Motion:
    """A derivative of a coordinate.

    Attributes
    ----------
    coordinate : str
        ``y1``, ``y2``, ``z1``, ``z2``, ``psi`` or ``phi``.
    order : int
        Of the derivative.
    factor : float
        Its weight in a sum.
    """

    coordinate: str
    order: int
    factor: float = 1.0


@dataclass(frozen=True, slots=True)
class Source:
    """A measured state and the derivative of it that stands on the kernel."""

    state: str
    derivatives: int
    factor: float


@dataclass(frozen=True, slots=True)
class Formation:
    """How the terms of a row are formed.

    Attributes
    ----------
    raised : int
        How often the whole row is differentiated.
    terms : tuple of tuple of Source
        What each term is the sum of.
    """

    raised: int
    terms: tuple[tuple[Source, ...], ...]

    @property
    def states(self) -> tuple[str, ...]:
        """Measured states that are used."""
        return tuple(sorted({source.state for term in self.terms for source in term}))

    @property
    def deepest(self) -> int:
        """Most derivatives on a kernel."""
        return max(source.derivatives for term in self.terms for source in term)


def state_of(coordinate: str, order: int) -> str:
    """Name of the state variable that measures a derivative of a coordinate."""
    return coordinate + ORDERS[order]


def _measured(coordinate: str, states: Sequence[str]) -> list[int]:
    return [order for order in range(len(ORDERS)) if state_of(coordinate, order) in states]


def lowest(coordinate: str, states: Sequence[str]) -> int | None:
    """Lowest derivative of a coordinate that is measured; None if none is."""
    orders = _measured(coordinate, states)
    return orders[0] if orders else None


def not_measured(motions: Sequence[Motion], states: Sequence[str]) -> str:
    """Sentence that says what is missing for some motions; empty if nothing is."""
    coordinates = dict.fromkeys(motion.coordinate for motion in motions)
    missing = [_described(coordinate) for coordinate in coordinates if not _measured(coordinate, states)]
    return f"not measured: {'; '.join(missing)}" if missing else ""


def _described(coordinate: str) -> str:
    kinds = "angle, rate or acceleration" if coordinate in ("psi", "phi") else "displacement, velocity or acceleration"
    return f"{_PLACES[coordinate]} ({kinds})"


def formation_of(terms: Sequence[Sequence[Motion]], states: Sequence[str]) -> Formation:
    """Choose how to form the terms of a row.

    The row is differentiated as rarely as possible. Then every motion is taken from the highest measured derivative
    that does not exceed it: what needs not be differentiated is not made noisier.

    Parameters
    ----------
    terms : sequence of sequences of Motion
        Motions of each term; every one's coordinate is measured (see `not_measured`).
    states : sequence of str
        What is measured.
    """
    motions = [motion for term in terms for motion in term]
    raised = max(max(0, _measured(motion.coordinate, states)[0] - motion.order) for motion in motions)
    formed = []
    for term in terms:
        sources = []
        for motion in term:
            order = motion.order + raised
            nearest = max(one for one in _measured(motion.coordinate, states) if one <= order)
            sources.append(Source(state_of(motion.coordinate, nearest), order - nearest, motion.factor))
        formed.append(tuple(sources))
    return Formation(raised, tuple(formed))
