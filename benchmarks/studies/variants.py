"""Variants of the relation networks' equations, as data: what each row of the ablation switches on or off."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial

import numpy as np

from models.diagnosis.networks.equations import EQUATIONS, Equation, EquationRows, StatisticsView, SynchronousEquation
from models.diagnosis.networks.relation import Network, window_view
from models.diagnosis.window import WindowStatistics
from models.machine import Machine
from models.signals.block import FloatArray

__all__ = [
    "VARIANTS",
    "LinearRelation",
    "Measure",
    "Reader",
    "Variant",
    "VariantEquation",
    "as_seen",
    "equation_numbered",
    "linear_fit",
    "variant_equation",
]


class Measure(StrEnum):
    """What is made of the residual."""

    MSD = "mean squared deviation"
    PROJECTION = "projection on the signatures"
    OWN_ERROR = "projection in block standard errors"


class Reader(StrEnum):
    """Who reads the window."""

    PAPER = "paper"
    NETWORK = "network"
    LINEAR = "linear fit"
    SHIPPED = "shipped network"
    AMORTISED = "amortised network"
    LIKELIHOOD = "likelihood"


@dataclass(frozen=True, slots=True)
class Variant:
    """One row of the table, and what of it is switched on."""

    group: str
    label: str
    equations: tuple[str, ...] = ("28", "31")
    """Equations it exists for."""
    reader: Reader = Reader.NETWORK
    synchronous_out: bool = True
    long_lags: bool = True
    """Lags from ``lag_from_s`` on, not from zero."""
    normalised: bool = True
    """Every window divided by the rms of its target."""
    every_reference: bool = True
    """All measured displacements as references, not y1 alone."""
    tilt_out: bool = True
    """The disc's acceleration among the inputs."""
    speed_powers: bool = True
    """Powers of Ω among the inputs of equation 29."""
    varied: bool = True
    """Trained on windows in which everything else varies, not on one condition."""
    measure: Measure = Measure.OWN_ERROR

    @property
    def network_key(self) -> "Variant":
        """The same for all variants that share a trained network."""
        return replace(self, group="", label="", equations=(), measure=Measure.MSD)


_PRINTED = Variant(
    "one after the other", "as printed", ("28", "29", "31"), Reader.PAPER,
    synchronous_out=False, long_lags=False, normalised=False, every_reference=False, tilt_out=False, varied=False,
    measure=Measure.MSD,
)  # fmt: skip
_OUT = replace(_PRINTED, label="+ synchronous part removed", equations=("28", "31"), reader=Reader.NETWORK)
_OUT = replace(_OUT, synchronous_out=True)
_LAGS = replace(_OUT, label="+ lags beyond the excitation's memory", long_lags=True)
_NORMALISED = replace(_LAGS, label="+ every window normalised", normalised=True)
_REFERENCES = replace(_NORMALISED, label="+ all measured references", every_reference=True)
_TILT = replace(_REFERENCES, label="+ tilt eliminated", tilt_out=True)
_VARIED = replace(_TILT, label="+ trained while everything else varies", varied=True)
_PROJECTED = replace(_VARIED, label="+ projection on the signatures", measure=Measure.PROJECTION)
_PRESENT = replace(_PROJECTED, label="+ block standard error (the present one)", measure=Measure.OWN_ERROR)

_ALL = ("28", "29", "31")
_29 = replace(_VARIED, equations=("29",))


def _without(label: str, equations: tuple[str, ...] = ("28", "31"), **off: object) -> Variant:
    return replace(_PRESENT, group="the present one without", label=label, equations=equations, **off)  # type: ignore[arg-type]


def _beside(label: str, reader: Reader, *, varied: bool = True) -> Variant:
    return replace(_PRESENT, group="in its place", label=label, equations=_ALL, reader=reader, varied=varied)


VARIANTS: tuple[Variant, ...] = (
    _PRINTED,
    _OUT,
    _LAGS,
    _NORMALISED,
    _REFERENCES,
    _TILT,
    replace(_29, label="+ phase reference as the reference", varied=False, speed_powers=False),
    replace(_29, label="+ powers of Ω among the inputs", varied=False),
    replace(_VARIED, equations=_ALL),
    replace(_PROJECTED, equations=_ALL),
    replace(_PRESENT, equations=_ALL),
    _without("synchronous part removed", synchronous_out=False),
    _without("lags beyond the excitation's memory", long_lags=False),
    _without("normalisation", normalised=False),
    _without("all references (y1 alone)", every_reference=False),
    _without("tilt eliminated", tilt_out=False),
    _without("powers of Ω among the inputs", ("29",), speed_powers=False),
    _without("varied training (one condition)", _ALL, varied=False),
    _without("projection (MSD)", _ALL, measure=Measure.MSD),
    _without("block standard error", _ALL, measure=Measure.PROJECTION),
    _beside("as printed, trained while everything else varies", Reader.PAPER),
    _beside("linear fit", Reader.LINEAR),
    _beside("linear fit, one condition", Reader.LINEAR, varied=False),
    _beside("shipped relation network", Reader.SHIPPED),
    _beside("amortised network", Reader.AMORTISED),
    _beside("likelihood", Reader.LIKELIHOOD),
)
"""The rows of the table."""


class _LevelRows(EquationRows):
    """Rows that are not divided by their own target."""

    __slots__ = ()

    @property
    def norm(self) -> float:
        """The rows come in units of the training windows' target."""
        return 1.0


@dataclass(frozen=True, slots=True)
class VariantEquation(Equation):
    """Equation 28 or 31 with the first few of its references y1, y2, z1, z2.

    A `unit` takes the place of every window's own norm in target, inputs and signatures.
    """

    references: int = 4
    unit: float | None = None

    def rows(self, view: StatisticsView, machine: Machine) -> EquationRows:
        """Rows of one view, one per lag and reference kept."""
        rows = Equation.rows(self, view, machine)
        kept = np.arange(rows.target.size).reshape(-1, 4)[:, : self.references].ravel()
        parts = (rows.inputs[kept], rows.target[kept], rows.signatures[kept])
        if self.unit is None:
            return EquationRows(*parts)
        return _LevelRows(*(part / self.unit for part in parts))


@dataclass(frozen=True, slots=True)
class _FixedSpeedEquation(SynchronousEquation):
    """Equation 29 without powers of Ω among its inputs."""

    def rows(self, view: StatisticsView, machine: Machine) -> EquationRows:
        """Rows of one view."""
        rows = SynchronousEquation.rows(self, view, machine)
        speed2 = (view.speed_rad_s / machine.operation.speed_rad_s) ** 2
        inputs = rows.inputs[:, (0, 3, 4)] / np.array([1.0, speed2, speed2])
        return EquationRows(inputs, rows.target, rows.signatures)


@dataclass(frozen=True, slots=True)
class LinearRelation(Network):
    """A linear map in the network's place; `W2` and `b2` alone are used."""

    def __call__(self, inputs: FloatArray) -> FloatArray:
        """Output for each row of inputs, shape (n_rows,)."""
        return np.asarray(inputs / self.input_scale @ self.W2 + self.b2[0], dtype=np.float64)


def linear_fit(
    equation: Equation | SynchronousEquation, windows: Sequence[WindowStatistics], machine: Machine
) -> Network:
    """Least squares on the rows that a network would be trained on."""
    rows = [equation.rows(window_view(window, machine), machine) for window in windows]
    inputs = np.concatenate([row.inputs / row.norm for row in rows])
    target = np.concatenate([row.target / row.norm for row in rows])
    scale = np.sqrt(np.mean(inputs**2, axis=0))
    design = np.column_stack([inputs / scale, np.ones(target.size)])
    weights = np.linalg.lstsq(design, target, rcond=None)[0]
    none = np.zeros(0)
    return LinearRelation(scale, none, none, weights[:-1], weights[-1:])


def equation_numbered(number: str) -> Equation | SynchronousEquation:
    """The equation with the paper's number."""
    return next(equation for equation in EQUATIONS if equation.number == number)


def _first(function: Callable[..., tuple[float, ...]], count: int, rotor: object) -> tuple[float, ...]:
    return function(rotor)[:count]


def variant_equation(variant: Variant, number: str) -> Equation | SynchronousEquation:
    """The variant's equation, still without a unit."""
    equation = equation_numbered(number)
    if isinstance(equation, SynchronousEquation):
        kind = SynchronousEquation if variant.speed_powers else _FixedSpeedEquation
        return kind(equation.number, equation.title)
    count = len(equation.inputs) if variant.tilt_out else len(equation.inputs) - 1
    return VariantEquation(
        number=equation.number,
        title=equation.title,
        target=equation.target,
        inputs=equation.inputs[:count],
        signatures={name: partial(_first, function, count) for name, function in equation.signatures.items()},
        references=4 if variant.every_reference else 1,
    )


def as_seen(variant: Variant, window: WindowStatistics) -> WindowStatistics:
    """The window with the rotation-synchronous part put back where the variant does not remove it (Eqs. 17-18)."""
    if variant.synchronous_out or window.synchronous is None:
        return window
    q = window.synchronous
    turn = np.exp(1j * window.speed_rad_s * window.lags_s)
    part = 0.5 * np.real(np.conj(q)[None, :, None] * q[None, None, :] * turn[:, None, None])
    hops = window.hop_correlation
    return replace(window, correlation=window.correlation + part, hop_correlation=hops + part if hops.size else hops)
