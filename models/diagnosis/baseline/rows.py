"""Table of the rows of motion by which a machine without parameters is read.

The table drives the rest of this package: a row added here is learned, read, stored and reported without a change
elsewhere. The sum of the equations of motion of bearing and disc contains no shaft force and no tilt. Divided by the
bearing's stiffness to ground k,

    y1 + (c/k) ẏ1 + (m2/k) ÿ2 + (m1/k) ÿ1 + s (y2 - y1) = f / k,

where s is zero on the six-degree-of-freedom machine and allows for a shaft that is also held elsewhere.

Displacement, velocity and acceleration of a place are one motion. When a correlation is smoothed with a kernel over
lags, derivatives can be moved to the kernel, so one of the three suffices. Integration is not possible that way: if
only a velocity or an acceleration is measured at a place, the whole row is differentiated once or twice and still
holds.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

from models.physics.rotor import PARAMETERS

ORDERS = ("", "_dot", "_ddot")  # endings of the state variable's name by order of the derivative that is measured

PLACES = {"y1": "bearing, horizontal", "y2": "disc, horizontal", "z1": "bearing, vertical", "z2": "disc, vertical"}


@dataclass(frozen=True, slots=True)
class Motion:
    """A derivative of a coordinate."""

    coordinate: str  # ``y1``, ``y2``, ``z1`` or ``z2``
    order: int  # of the derivative
    factor: float = 1.0  # its weight in a sum


@dataclass(frozen=True, slots=True)
class Source:
    """A measured state, and the number of its derivatives that are moved to the kernel."""

    state: str
    derivatives: int
    factor: float


@dataclass(frozen=True, slots=True)
class Formation:
    """How the terms of a row are formed."""

    raised: int  # how often the whole row is differentiated
    terms: tuple[tuple[Source, ...], ...]  # the summands of each term

    @property
    def states(self) -> tuple[str, ...]:
        """Measured states that are used."""
        return tuple(sorted({source.state for term in self.terms for source in term}))

    @property
    def deepest(self) -> int:
        """Largest number of derivatives of a kernel."""
        return max(source.derivatives for term in self.terms for source in term)


def state_of(coordinate: str, order: int) -> str:
    """Name of the state variable that measures a derivative of a coordinate."""
    return coordinate + ORDERS[order]


def _measured(coordinate: str, states: Sequence[str]) -> list[int]:
    return [order for order in range(len(ORDERS)) if state_of(coordinate, order) in states]


def lowest(coordinate: str, states: Sequence[str]) -> int | None:
    """Lowest derivative of a coordinate that is measured; None if none is."""
    return next(iter(_measured(coordinate, states)), None)


def not_measured(motions: Sequence[Motion], states: Sequence[str]) -> str:
    """Sentence on the coordinates of these motions that are not measured; empty if all are."""
    coordinates = dict.fromkeys(motion.coordinate for motion in motions)
    places = [PLACES[coordinate] for coordinate in coordinates if not _measured(coordinate, states)]
    missing = "; ".join(f"{place} (displacement, velocity or acceleration)" for place in places)
    return f"not measured: {missing}" if missing else ""


def formation_of(terms: Sequence[Sequence[Motion]], states: Sequence[str]) -> Formation:
    """Choose how to form the terms of a row, each the sum of motions whose coordinates are measured (`not_measured`).

    The row is differentiated as few times as possible. Then every motion is formed from the highest measured derivative
    that does not exceed it, because each differentiation amplifies noise.
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


@dataclass(frozen=True, slots=True)
class Term:
    """One term of a row: motions that share a coefficient."""

    motions: tuple[Motion, ...]  # their weighted sum
    # Prior standard deviation of the coefficient; None without a prior.
    spread: float | None = None
    in_units_of: int | None = None  # term whose coefficient is the unit of `spread` and `about`
    about: float = 0.0  # prior mean of the coefficient
    without: float | None = None  # for an optional term: prior standard deviation if the relation holds without it


@dataclass(frozen=True, slots=True)
class Own:
    """A parameter that a row reads."""

    parameter: str  # one of ``models.physics.rotor.PARAMETERS``
    terms: tuple[int, ...] = ()  # terms whose coefficients are proportional to it
    # Factor on the standard error if one source moves everything: all channels are then coherent, and as the same force
    # drives the omitted parts of the machine, their effect does not average out. Measured on finite-element rotors
    # (decision 0012).
    one_source: float = 1.0
    # Standard error of a relative change due to omitted parts of the machine, whose effect differs under another force;
    # for a relation learned in one condition (decision 0012). Under the commissioned force, `one_source` is not applied
    # and `elsewhere` only to a stiffness, as a bearing is never quite linear.
    elsewhere: float = 0.0
    always: bool = False  # whether `elsewhere` is applied under the commissioned force, too
    # Standard error of the logarithm of a change, relative to that logarithm: the relation stands for omitted parts of
    # the machine, too, so that a stiffness is in units of more or less than the bearing's own (decision 0012).
    of_size: float = 0.0


@dataclass(frozen=True, slots=True)
class Row:
    """One row of motion."""

    name: str  # unique in the table
    number: str  # the paper's equations
    title: str  # short description for texts
    terms: tuple[Term, ...]  # the first is the target: its coefficient is one
    own: tuple[Own, ...]  # parameters that it reads; a change of the first is relative to the scale of the row
    # For a row evaluated on the rotation-synchronous vectors, name of the row whose coefficients it uses; empty for a
    # row learned on the stochastic part.
    rests_on: str = ""

    @property
    def n_coefficients(self) -> int:
        """Number of coefficients to learn."""
        return len(self.terms) - 1

    @property
    def motions(self) -> tuple[Motion, ...]:
        """All motions of all terms."""
        return tuple(motion for term in self.terms for motion in term.motions)


def _bearing(plane: str, number: str, direction: str) -> Row:
    one, two = f"{plane}1", f"{plane}2"
    terms = (
        Term((Motion(one, 0),)),
        Term((Motion(one, 1),)),
        Term((Motion(two, 2),)),
        # mass that moves with the bearing, from next to nothing to that of the disc
        Term((Motion(one, 2),), spread=0.4, in_units_of=2, about=0.4),
        Term((Motion(two, 0), Motion(one, 0, -1.0)), spread=0.5, without=0.02),
    )
    own = (
        Own(f"k_b{plane}", (0,), elsewhere=0.005, always=True, of_size=0.15),
        Own(f"c_b{plane}", (1,), one_source=1.6, elsewhere=0.03),
    )
    return Row(plane, number, f"bearing and disc, {direction}", terms, own)


def _unbalance(bearing: Row) -> Row:
    number, title = f"{bearing.number} at the speed", f"unbalance force through {bearing.title}"
    own = (Own("e", one_source=1.4),)
    return Row(f"{bearing.name} 1x", number, title, bearing.terms, own, rests_on=bearing.name)


_BEARINGS = _bearing("y", "28 + 29", "horizontal"), _bearing("z", "31 + 29 in z", "vertical")
ROWS: tuple[Row, ...] = (*_BEARINGS, *map(_unbalance, _BEARINGS))
"""The rows that can be learned from a recording alone."""


def _coupled(row: Row) -> Row:
    one = {"y": "z1", "z": "y1"}[row.name[0]]
    across = Term((Motion(one, 0),), spread=1.0), Term((Motion(one, 1),), spread=1.0, in_units_of=1)
    return replace(row, terms=(*row.terms, *across))


COUPLED_ROWS = tuple(_coupled(row) for row in ROWS)
"""The same rows for a bearing whose force has a component across its motion, as with an oil film or a gear mesh."""


def learned_rows(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Rows that are learned on the stochastic part of the signals."""
    return tuple(row for row in rows if not row.rests_on)


def consecutive(sizes: Iterable[int]) -> tuple[slice, ...]:
    """Slice of each part, for example the coefficients of one row, in the vector of all parts."""
    return tuple(slice(a, b) for a, b in pairwise(accumulate(sizes, initial=0)))


def parameters_of(rows: Sequence[Row] = ROWS) -> tuple[str, ...]:
    """Parameters that rows read, in the order of ``models.physics.rotor.PARAMETERS``."""
    read = {own.parameter for row in rows for own in row.own}
    return tuple(name for name in PARAMETERS if name in read)


def evaluable_rows(states: Sequence[str], has_phase_reference: bool) -> list[tuple[Row, str]]:
    """Every row with the reason why it cannot be evaluated with these sensors; empty if it can.

    `has_phase_reference` is also true if the speed is estimated from the 1x line in the vibration.
    """
    found = []
    for row in ROWS:
        reasons = [not_measured(row.motions, states)]
        if row.rests_on and not has_phase_reference:
            reasons.append("no phase reference, and no speed to look for in the vibration")
        found.append((row, "; ".join(filter(None, reasons))))
    return found
