"""The equation table: the compatibility equations (28)-(31) as data.

Each is one row of the equation of motion, correlated with a measured reference. For every lag beyond the excitation's
memory its target correlation is a fixed combination of its inputs, and only the equation's *own* parameters can change
that combination: this locates a fault. Two additions to the printed equations make that exact without tilt sensors: all
measured displacements serve as references, and the correlation of the disc's acceleration eliminates the tilt through
row 2 (`docs/method.md`). Equation 29 uses the phase reference itself as reference, so that the stochastic excitation
drops out at every lag.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from models.errors import EstimationError
from models.machine import Machine
from models.physics.response import balance, synchronous_response
from models.physics.rotor import RotorParameters, changed
from models.signals.block import ComplexArray, FloatArray

_REFERENCES = ("y1", "y2", "z1", "z2")
_ANGLES = np.arange(16) * (2 * np.pi / 16)


@dataclass(frozen=True, slots=True)
class StatisticsView:
    """The statistics that an equation needs, of a whole window or, with one more axis, of each hop in it."""

    states: tuple[str, ...]  # measured states, naming rows and columns of the correlations
    correlation: FloatArray  # (…, n_lags, n, n), stochastic part at the lags that the networks use
    synchronous: ComplexArray | None  # (…, n), rotation-synchronous vectors
    speed_rad_s: float  # speed Ω


@dataclass(frozen=True, slots=True)
class EquationRows:
    """Training or evaluation rows of one equation, one per lag and reference, after the leading axes of the view."""

    inputs: FloatArray  # (…, n_rows, n_inputs)
    target: FloatArray  # (…, n_rows)
    # (…, n_rows, n_parameters): derivative of the target with respect to the relative change of each own parameter
    signatures: FloatArray

    @property
    def norm(self) -> float:
        """Root mean square of the target; the relation is homogeneous, so dividing by it removes the level."""
        return float(np.sqrt(np.mean(self.target**2)))


@dataclass(frozen=True, slots=True)
class Term:
    """One correlation R_ij(τ), of a reference i with a response j."""

    response: str  # state j
    # Whether the reference is the rate ẏ instead of the displacement y of the reference channel.
    rate_reference: bool = False
    times_speed: bool = False  # whether the term is multiplied by Ω (gyroscopic)

    @property
    def name(self) -> str:
        """Name as in the paper, with i for the reference: ``R[i,y1]``, ``R[i',y1']``."""
        response = self.response.replace("_dot", "'")
        factor = "Ω·" if self.times_speed else ""
        return f"{factor}R[{'i' + chr(39) if self.rate_reference else 'i'},{response}]"


@dataclass(frozen=True, slots=True)
class Equation:
    """An equation between correlations of the stochastic part (28, 30, 31)."""

    # The paper's number, and a short description.
    number: str
    title: str
    target: Term
    inputs: tuple[Term, ...]
    # For each own parameter, a function from the rotor to the coefficients of the inputs that the parameter scales.
    signatures: Mapping[str, Callable[[RotorParameters], tuple[float, ...]]]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Own parameters."""
        return tuple(self.signatures)

    @property
    def kept_nominal(self) -> tuple[str, ...]:
        """Parameters that do not vary in its training windows."""
        return self.parameters

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs in order."""
        return tuple(term.name for term in self.inputs)

    @property
    def channels(self) -> tuple[str, ...]:
        """Measured states that it needs: references and their rates first, then other states of its terms."""
        needed = [name for reference in _REFERENCES for name in (reference, f"{reference}_dot")]
        needed += [term.response for term in (self.target, *self.inputs)]
        return tuple(dict.fromkeys(needed))

    def rows(self, view: StatisticsView, machine: Machine) -> EquationRows:
        """Rows of one view, SI units."""
        index, terms = {name: position for position, name in enumerate(view.states)}, (*self.inputs, self.target)
        references = [[index[f"{one}_dot" if term.rate_reference else one] for term in terms] for one in _REFERENCES]
        rows = view.correlation[..., references, [index[term.response] for term in terms]]
        rows = rows.reshape(*rows.shape[:-3], -1, len(terms))  # lags, and references for each
        speed_ratio = view.speed_rad_s / machine.operation.speed_rad_s
        rows *= [speed_ratio if term.times_speed else 1.0 for term in terms]
        coefficients = np.array([function(machine.rotor) for function in self.signatures.values()])
        return EquationRows(rows[..., :-1], rows[..., -1], rows[..., :-1] @ coefficients.T)


@dataclass(frozen=True, slots=True)
class SynchronousEquation:
    """Equation (29) with the phase reference n(t) as reference.

    Rows 2, 3, 5 and 6 give the disc's synchronous vector from the bearing's vectors and e, Y2 = α(Ω) Y1 + β(Ω) jZ1 +
    γ(Ω) e with real α, β, γ, and the same for jZ2 with Y1 and jZ1 exchanged. Powers of Ω among the inputs let the
    network follow the coefficients through the speed range. Both planes and all shaft angles Ωτ serve as rows; the
    bearings' stiffness and damping do not occur.

    The printed equation has the disc's acceleration as target and its displacement as input. In the synchronous part
    one is -Ω² times the other, so a network with both predicts the target without e: it reads -2 % for -20 %.
    """

    number: str
    title: str
    parameters: tuple[str, ...] = ("e",)
    # The shaft occurs in this row, too (k22, k23).
    kept_nominal: tuple[str, ...] = ("e", "EI")
    input_names: tuple[str, ...] = (
        "R[n,y1]", "Ω²R[n,y1]", "Ω⁴R[n,y1]", "Ω²R[n,z1]", "Ω²R[n,n]", "Ω⁴R[n,n]", "Ω⁶R[n,n]"
    )  # fmt: skip
    channels: tuple[str, ...] = (*_REFERENCES, "theta")

    def rows(self, view: StatisticsView, machine: Machine) -> EquationRows:
        """Rows of one view, SI units.

        Raises
        ------
        EstimationError
            Without a phase reference.
        """
        if view.synchronous is None:
            raise EstimationError(f"{machine.name}: equation 29 without a phase reference")
        y1, y2, z1, z2 = (view.synchronous[..., view.states.index(name), np.newaxis] for name in _REFERENCES)
        speed2 = (view.speed_rad_s / machine.operation.speed_rad_s) ** 2
        turn = np.exp(1j * _ANGLES)
        R_nn = np.real(np.exp(1j * machine.operation.unbalance_phase_rad) * turn) / 2

        def correlation(vector: ComplexArray) -> FloatArray:
            return np.asarray(np.real(vector * turn) / 2, dtype=np.float64)

        e = speed2 * machine.rotor.e_m * R_nn
        planes = []
        for own, other, disc in ((y1, 1j * z1, y2), (1j * z1, y1, 1j * z2)):
            R = correlation(own)
            columns = (R, speed2 * R, speed2**2 * R, speed2 * correlation(other), e, speed2 * e, speed2**2 * e)
            planes.append((np.stack(np.broadcast_arrays(*columns), axis=-1), correlation(disc)))
        inputs, target = (np.concatenate(parts, axis=R.ndim - 1) for parts in zip(*planes, strict=True))
        response = _disc_response_to_e(machine.rotor, view.speed_rad_s)
        signatures = np.tile(response * R_nn, 2)[:, None]
        return EquationRows(inputs, target, np.broadcast_to(signatures, (*target.shape, 1)))

    def taken_for(self, machine: Machine) -> Mapping[str, float]:
        """Relative change of e that is read per relative change of another parameter, here the shaft's EI."""
        rotor, speed = machine.rotor, machine.operation.speed_rad_s
        q1, q2 = synchronous_response(changed(rotor, {"EI": _STEP}), speed)
        moved = (q1 - 1j * q2)[: len(q1) // 2]
        dynamic, force = balance(rotor, speed)
        foreign = np.linalg.solve(dynamic[np.ix_(_DISC, _DISC)], (dynamic @ moved - force)[_DISC])
        mean = float((foreign[0] + 1j * foreign[2]).real) / 2  # Y2 and jZ2, as in the rows
        return {"EI": mean / _STEP / _disc_response_to_e(rotor, speed)}


_DISC, _STEP = [1, 2, 4, 5], 0.01


def _disc_response_to_e(rotor: RotorParameters, speed_rad_s: float) -> float:
    """Derivative of Y2 with respect to the relative change of e for given bearing motion, m (real by symmetry)."""
    dynamic, force = balance(rotor, speed_rad_s)
    return float(np.linalg.solve(dynamic[np.ix_(_DISC, _DISC)], force[_DISC])[0].real)


def _over_mass(place: int, name: str, rotor: RotorParameters) -> tuple[float, ...]:
    """A bearing parameter over the mass m1 at one of four inputs; not a lambda, so that networks can be pickled."""
    share = float(getattr(rotor, name)) / rotor.m1_kg
    return tuple(share if at == place else 0.0 for at in range(4))


def _shaft_over_inertia(rotor: RotorParameters) -> tuple[float, ...]:
    """Coefficients of y1, y2 and psi in row 3; the gyroscopic input does not scale with the shaft."""
    L = rotor.shaft_length_m
    b, c = 6 * rotor.EI_N_m2 / L**2, 4 * rotor.EI_N_m2 / L
    return (b / rotor.I2_kg_m2, -b / rotor.I2_kg_m2, c / rotor.I2_kg_m2, 0.0)


EQUATIONS: tuple[Equation | SynchronousEquation, ...] = (
    Equation(
        number="28",
        title="bearing, horizontal",
        target=Term("y1_dot", rate_reference=True),
        inputs=(Term("y1"), Term("y2"), Term("y1_dot"), Term("y2_dot", rate_reference=True)),
        signatures={"k_by": partial(_over_mass, 0, "k_by_N_per_m"), "c_by": partial(_over_mass, 2, "c_by_N_s_per_m")},
    ),
    SynchronousEquation(number="29", title="unbalance at the disc"),
    Equation(
        number="30",
        title="disc tilt and shaft",
        target=Term("psi_dot", rate_reference=True),
        inputs=(Term("y1"), Term("y2"), Term("psi"), Term("phi_dot", times_speed=True)),
        signatures={"EI": _shaft_over_inertia},
    ),
    Equation(
        number="31",
        title="bearing, vertical",
        target=Term("z1_dot", rate_reference=True),
        inputs=(Term("z1"), Term("z2"), Term("z1_dot"), Term("z2_dot", rate_reference=True)),
        signatures={"k_bz": partial(_over_mass, 0, "k_bz_N_per_m"), "c_bz": partial(_over_mass, 2, "c_bz_N_s_per_m")},
    ),
)
"""The equations in the paper's order; adding a row here is all it takes."""


def missing(equation: Equation | SynchronousEquation, measured: tuple[str, ...]) -> tuple[str, ...]:
    """Channels that an equation needs and that are not measured, with ``theta`` for the phase reference."""
    return tuple(name for name in equation.channels if name not in measured)
