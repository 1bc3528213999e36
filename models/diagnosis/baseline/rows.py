"""The rows of motion that a machine without parameters is read by, as a table.

Everything else in this room is driven by it: a row that is added here is learned, read, stored and reported without a
change elsewhere. The sum of the rows of bearing and disc holds no shaft force and no tilt. Divided by the bearing's
stiffness to ground,

    y1 + (c/k) ẏ1 + (m2/k) ÿ2 + (m1/k) ÿ1 + s (y2 - y1) = f / k,

where s is zero on the six-degree-of-freedom machine and takes up a shaft that is held elsewhere too.

Displacement, velocity and acceleration of a place are one motion. Correlated under a smooth kernel over lags, a
derivative is moved to the kernel, so that one of the three suffices. It cannot be integrated that way: where a place
has a velocity or an acceleration alone, the whole row is differentiated, once or twice, which leaves it as true as it
was.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from models.physics.rotor import PARAMETERS

ORDERS = ("", "_dot", "_ddot")  # endings of the state variable's name by order of the derivative that is measured

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
    """A derivative of a coordinate."""

    coordinate: str  # ``y1``, ``y2``, ``z1``, ``z2``, ``psi`` or ``phi``
    order: int  # of the derivative
    factor: float = 1.0  # its weight in a sum


@dataclass(frozen=True, slots=True)
class Source:
    """A measured state and the derivative of it that stands on the kernel."""

    state: str
    derivatives: int
    factor: float


@dataclass(frozen=True, slots=True)
class Formation:
    """How the terms of a row are formed."""

    raised: int  # how often the whole row is differentiated
    terms: tuple[tuple[Source, ...], ...]  # what each term is the sum of

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
    """Choose how to form the terms of a row, each the sum of motions whose coordinates are measured (`not_measured`).

    The row is differentiated as rarely as possible. Then every motion is taken from the highest measured derivative
    that does not exceed it: what needs not be differentiated is not made noisier.
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


_NO_PHASE = "no phase reference, and no speed to look for in the vibration"


@dataclass(frozen=True, slots=True)
class Term:
    """One term of a row: motions that share a coefficient."""

    motions: tuple[Motion, ...]  # their weighted sum
    # Standard deviation expected beforehand of the coefficient; None where nothing is expected.
    spread: float | None = None
    in_units_of: int | None = None  # term whose coefficient `spread` and `about` are multiples of
    about: float = 0.0  # value expected beforehand
    without: float | None = None  # expected spread of a term that is left out wherever the relation holds without it
    times_speed: bool = False  # whether the coefficient is proportional to the speed (gyroscopic terms)


@dataclass(frozen=True, slots=True)
class Own:
    """A parameter that a row reads."""

    parameter: str  # one of ``models.physics.rotor.PARAMETERS``
    terms: tuple[int, ...] = ()  # terms whose coefficients are proportional to it
    # Whether these terms have the sign of the first one, as a stiffness and a damping do; a fit of the other sign has
    # not determined them.
    resists: bool = True
    # Factor on the standard error where one source moves everything: all channels are then coherent, what the row
    # leaves out of the machine is driven by the same force as what it holds, and is not averaged away. Measured on
    # finite-element rotors (decision 0012).
    one_source: float = 1.0
    # Standard error of a relative change, from what the row leaves out of the machine, which pulls otherwise where
    # another force moves it; of a relation learned in one condition (decision 0012). Neither it nor `one_source` is
    # taken where the force is still the commissioned one, but for a stiffness: a bearing is never quite linear.
    elsewhere: float = 0.0
    always: bool = False  # whether `elsewhere` is taken there, too


@dataclass(frozen=True, slots=True)
class Row:
    """One row of motion."""

    name: str  # unique in the table
    number: str  # the paper's equations
    title: str  # what it is about
    terms: tuple[Term, ...]  # the first is the target: its coefficient is one
    own: tuple[Own, ...]  # what it reads. A change of the first is relative to the scale of the row
    # Name of the row whose coefficients it uses, for a row that is evaluated on the rotation-synchronous vectors; empty
    # for one that is learned on the stochastic part.
    rests_on: str = ""

    @property
    def synchronous(self) -> bool:
        """Whether it is evaluated on the rotation-synchronous vectors."""
        return bool(self.rests_on)

    @property
    def n_coefficients(self) -> int:
        """Coefficients to learn."""
        return len(self.terms) - 1

    @property
    def needs_speed(self) -> bool:
        """Whether it cannot be evaluated without a phase reference."""
        return self.synchronous or any(term.times_speed for term in self.terms)

    @property
    def motions(self) -> tuple[Motion, ...]:
        """All motions of all terms."""
        return tuple(motion for term in self.terms for motion in term.motions)


def _bearing_and_disc(plane: str) -> tuple[Term, ...]:
    one, two = f"{plane}1", f"{plane}2"
    return (
        Term((Motion(one, 0),)),
        Term((Motion(one, 1),)),
        Term((Motion(two, 2),)),
        # what moves with the bearing, from next to nothing to as much as the disc
        Term((Motion(one, 2),), spread=0.4, in_units_of=2, about=0.4),
        Term((Motion(two, 0), Motion(one, 0, -1.0)), spread=0.5, without=0.02),
    )


def _bearing(plane: str, number: str, direction: str) -> Row:
    own = (
        Own(f"k_b{plane}", (0,), elsewhere=0.005, always=True),
        Own(f"c_b{plane}", (1,), one_source=1.6, elsewhere=0.03),
    )
    return Row(plane, number, f"bearing and disc, {direction}", _bearing_and_disc(plane), own)


def _unbalance(bearing: Row) -> Row:
    name, number, title = (
        f"{bearing.name} 1x",
        f"{bearing.number} at the speed",
        f"unbalance force through {bearing.title}",
    )
    return Row(name, number, title, bearing.terms, (Own("e", one_source=1.4),), rests_on=bearing.name)


_BEARINGS = _bearing("y", "28 + 29", "horizontal"), _bearing("z", "31 + 29 in z", "vertical")
ROWS: tuple[Row, ...] = (*_BEARINGS, *map(_unbalance, _BEARINGS))
"""The rows that can be learned from a recording alone."""


def _coupled(row: Row) -> Row:
    one = {"y": "z1", "z": "y1"}[row.name[0]]
    across = Term((Motion(one, 0),), spread=1.0), Term((Motion(one, 1),), spread=1.0, in_units_of=1)
    return replace(row, terms=(*row.terms, *across))


COUPLED_ROWS = tuple(_coupled(row) for row in ROWS)
"""The same for a bearing whose force has a part across its motion, as that of an oil film or of a mesh has."""


def parameters_of(rows: Sequence[Row] = ROWS) -> tuple[str, ...]:
    """Parameters that rows read, in the order of ``models.physics.rotor.PARAMETERS``."""
    read = {own.parameter for row in rows for own in row.own}
    return tuple(name for name in PARAMETERS if name in read)


def evaluable_rows(states: Sequence[str], has_phase_reference: bool) -> list[tuple[Row, str]]:
    """Every row with the reason why it cannot be evaluated with these sensors; empty if it can.

    A speed that the vibration's own line is looked for at serves as phase reference, too.
    """
    found = []
    for row in ROWS:
        reasons = [not_measured(row.motions, tuple(states))]
        if row.needs_speed and not has_phase_reference:
            reasons.append(_NO_PHASE)
        found.append((row, "; ".join(reason for reason in reasons if reason)))
    return found
