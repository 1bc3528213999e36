"""Variants of the relation networks' equations for the ablation study: the ingredients that each one has."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum, unique
from functools import partial

import numpy as np

from models.diagnosis.networks.equations import Equation, EquationRows, StatisticsView, SynchronousEquation
from models.diagnosis.networks.relation import Network, equation_by_number, window_view
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine
from models.signals.block import FloatArray


class Measure(StrEnum):
    """Measure computed from the residual."""

    MSD = "mean squared deviation"
    PROJECTION = "projection on the signatures"
    OWN_ERROR = "projection in block standard errors"


@unique
class Reader(StrEnum):
    """Method that reads the window; the last three are diagnosticians, by name."""

    PAPER = "paper"
    NETWORK = "trained network"
    LINEAR = "linear fit"
    SHIPPED = "relation"
    AMORTISED = "network"
    LIKELIHOOD = "likelihood"


_ALL, _BEARING = ("28", "29", "31"), ("28", "31")


@dataclass(frozen=True, slots=True)
class Variant:
    """One row of the table: the equations for which it exists, and its ingredients."""

    group: str
    label: str
    equations: tuple[str, ...]
    has: frozenset[str]  # names from `_INGREDIENTS`
    measure: Measure = Measure.OWN_ERROR
    reader: Reader = Reader.NETWORK

    @property
    def network_key(self) -> "Variant":
        """Key that is the same for all variants that share a trained network."""
        return replace(self, group="", label="", equations=(), measure=Measure.MSD)


_INGREDIENTS = {
    "synchronous": "synchronous part removed",
    "lags": "lags beyond the excitation's memory",  # from ``lag_from_s`` on, not from zero
    "normalised": "every window normalised",  # divided by the rms of its target
    "references": "all measured references",  # displacements, not y1 alone
    "tilt": "tilt eliminated",  # the disc's acceleration among the inputs
    "powers": "powers of Ω among the inputs",  # of equation 29
    "varied": "trained while everything else varies",  # not on one condition
}
_EVERYTHING = frozenset(_INGREDIENTS)


def _one_after_the_other() -> Iterator[Variant]:
    group, has = "one after the other", frozenset({"powers"})
    yield Variant(group, "as printed", _ALL, has, Measure.MSD, Reader.PAPER)
    for name in ("synchronous", "lags", "normalised", "references", "tilt"):
        has |= {name}
        yield Variant(group, f"+ {_INGREDIENTS[name]}", _BEARING, has, Measure.MSD)
    yield Variant(group, "+ phase reference as the reference", ("29",), has - {"powers"}, Measure.MSD)
    yield Variant(group, f"+ {_INGREDIENTS['powers']}", ("29",), has, Measure.MSD)
    yield Variant(group, f"+ {_INGREDIENTS['varied']}", _ALL, _EVERYTHING, Measure.MSD)
    yield Variant(group, "+ projection on the signatures", _ALL, _EVERYTHING, Measure.PROJECTION)
    yield Variant(group, "+ block standard error (the present one)", _ALL, _EVERYTHING)


def _without() -> Iterator[Variant]:
    group = "the present one without"
    other = {"normalised": "normalisation", "references": "all references (y1 alone)"}
    other["varied"] = "varied training (one condition)"
    only = {"powers": ("29",), "varied": _ALL}
    for name, label in _INGREDIENTS.items():
        yield Variant(group, other.get(name, label), only.get(name, _BEARING), _EVERYTHING - {name})
    yield Variant(group, "projection (MSD)", _ALL, _EVERYTHING, Measure.MSD)
    yield Variant(group, "block standard error", _ALL, _EVERYTHING, Measure.PROJECTION)


def _in_its_place() -> Iterator[Variant]:
    for label, reader, has in (
        ("as printed, trained while everything else varies", Reader.PAPER, _EVERYTHING),
        ("linear fit", Reader.LINEAR, _EVERYTHING),
        ("linear fit, one condition", Reader.LINEAR, _EVERYTHING - {"varied"}),
        ("shipped relation network", Reader.SHIPPED, _EVERYTHING),
        ("amortised network", Reader.AMORTISED, _EVERYTHING),
        ("likelihood", Reader.LIKELIHOOD, _EVERYTHING),
    ):
        measure = Measure.MSD if reader is Reader.PAPER else Measure.OWN_ERROR
        yield Variant("in its place", label, _ALL, has, measure, reader)


VARIANTS: tuple[Variant, ...] = (*_one_after_the_other(), *_without(), *_in_its_place())  # the rows of the table


class _LevelRows(EquationRows):
    """Rows that are not normalised by the rms of their own target."""

    __slots__ = ()

    @property
    def norm(self) -> float:
        """1, because the rows are already in units of the training windows' target."""
        return 1.0


@dataclass(frozen=True, slots=True)
class VariantEquation(Equation):
    """Equation 28 or 31 with the first `references` of its references y1, y2, z1, z2.

    If `unit` is given, it replaces every window's own norm in target, inputs and signatures.
    """

    references: int = 4
    unit: float | None = None

    def rows(self, view: StatisticsView, machine: Machine) -> EquationRows:
        """Rows of one view, one for each lag and reference used."""
        rows = Equation.rows(self, view, machine)
        kept = np.arange(rows.target.shape[-1]).reshape(-1, 4)[:, : self.references].ravel()
        parts = (rows.inputs[..., kept, :], rows.target[..., kept], rows.signatures[..., kept, :])
        if self.unit is None:
            return EquationRows(*parts)
        return _LevelRows(*(part / self.unit for part in parts))


@dataclass(frozen=True, slots=True)
class _FixedSpeedEquation(SynchronousEquation):
    """Equation 29 without powers of Ω among its inputs."""

    def rows(self, view: StatisticsView, machine: Machine) -> EquationRows:
        rows = SynchronousEquation.rows(self, view, machine)
        speed2 = (view.speed_rad_s / machine.operation.speed_rad_s) ** 2
        inputs = rows.inputs[..., (0, 3, 4)] / np.array([1.0, speed2, speed2])
        return EquationRows(inputs, rows.target, rows.signatures)


@dataclass(frozen=True, slots=True)
class LinearRelation(Network):
    """A linear map that replaces the network; only `W2` and `b2` are used."""

    def __call__(self, inputs: FloatArray) -> FloatArray:
        """Output for each row of inputs, shape (…, n_rows)."""
        return np.asarray(inputs / self.input_scale @ self.W2 + self.b2[0], dtype=np.float64)


def linear_fit(
    equation: Equation | SynchronousEquation, windows: Sequence[WindowStatistics], machine: Machine
) -> Network:
    """Least-squares fit to the rows on which a network would be trained."""
    rows = [equation.rows(window_view(window, machine), machine) for window in windows]
    inputs = np.concatenate([row.inputs / row.norm for row in rows])
    target = np.concatenate([row.target / row.norm for row in rows])
    scale = np.sqrt(np.mean(inputs**2, axis=0))
    design = np.column_stack([inputs / scale, np.ones(target.size)])
    weights = np.linalg.lstsq(design, target, rcond=None)[0]
    none = np.zeros(0)
    return LinearRelation(scale, none, none, weights[:-1], weights[-1:])


def _first(function: Callable[..., tuple[float, ...]], count: int, rotor: object) -> tuple[float, ...]:
    return function(rotor)[:count]


def variant_equation(variant: Variant, number: str) -> Equation | SynchronousEquation:
    """The variant's equation, without `unit`."""
    equation = equation_by_number(number)
    if isinstance(equation, SynchronousEquation):
        kind = SynchronousEquation if "powers" in variant.has else _FixedSpeedEquation
        return kind(equation.number, equation.title)
    count = len(equation.inputs) if "tilt" in variant.has else len(equation.inputs) - 1
    return VariantEquation(
        number=equation.number,
        title=equation.title,
        target=equation.target,
        inputs=equation.inputs[:count],
        signatures={name: partial(_first, function, count) for name, function in equation.signatures.items()},
        references=4 if "references" in variant.has else 1,
    )


def as_seen(variant: Variant, window: WindowStatistics) -> WindowStatistics:
    """The window with the synchronous part added back if the variant does not remove it (Eqs. 17-18)."""
    if "synchronous" in variant.has or window.synchronous is None:
        return window
    q = window.synchronous
    turn = np.exp(1j * window.speed_rad_s * window.lags_s)
    part = 0.5 * np.real(np.conj(q)[None, :, None] * q[None, None, :] * turn[:, None, None])
    hops = window.hop_correlation
    return replace(window, correlation=window.correlation + part, hop_correlation=hops + part if hops.size else hops)
