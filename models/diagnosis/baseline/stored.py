"""The baseline of a machine without parameters, and its JSON: some hundred numbers and no code.

Numbers are written with as many digits as needed to read back the same bits, so that a restored baseline gives the same
diagnoses as the one that was stored.
"""

from dataclasses import dataclass
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, model_validator

from models.diagnosis.baseline.conditions import Growth
from models.diagnosis.baseline.numbers import Covariance, NotNegative, Positive, Spectra
from models.diagnosis.baseline.relation import Relation
from models.diagnosis.baseline.rows import COUPLED_ROWS, ROWS, Row, learned_rows
from models.diagnosis.baseline.unbalance import SynchronousVectors
from models.signals.block import FloatArray


@dataclass(frozen=True, slots=True)
class HeldOutReading:
    """One parameter of one healthy window, read against the relation learned in the other conditions."""

    parameter: str
    # Relative change and its standard error, including the relation's error.
    change: FiniteFloat
    standard_error: Positive

    @property
    def z(self) -> float:
        """Change in standard errors: standard normal if one relation holds for all."""
        return self.change / self.standard_error


@dataclass(frozen=True, slots=True)
class LeftOut:
    """One healthy window of one row, read against the relation learned in the other conditions."""

    row: str  # name of the row
    window: Annotated[int, Field(ge=0)]  # number of the window, from 0
    condition: str  # condition of the window
    agreements: tuple[HeldOutReading, ...]  # one for each of the row's own parameters
    misfit: NotNegative  # χ² of the residual per degree of freedom
    degrees_of_freedom: Annotated[int, Field(ge=1)]


NO_FORCE: FloatArray = np.zeros((0, 0, 0))


class Baseline(BaseModel, extra="forbid", frozen=True, strict=True):
    """Everything learned on a healthy machine."""

    format: Literal[1] = 1
    relations: tuple[Relation | None, ...]  # one for each learned row of the table; None if it has no relation
    reasons: tuple[str, ...]  # why a row has no relation; empty if it has one
    # (n, n): of the coefficients of all rows one after the other; zero for rows without a relation
    covariance: Covariance
    # Synchronous vectors of the healthy machine, one for each distinct speed, slowest first.
    rotations: tuple[SynchronousVectors, ...]
    duration_s: Positive  # length of the healthy data
    # Every healthy window of every row, read against the relation learned in the other conditions.
    consistency: tuple[LeftOut, ...] = ()
    # (n_bands, n_rows, n_rows): force that the relations were learned under (`force_spectrum`); empty with several
    # conditions, or if a row has no relation
    force: Spectra = Field(default_factory=NO_FORCE.copy, exclude_if=lambda bands: not len(bands))
    # Growth of the stiffness of each learned row with the motion; None if unknown, empty in older records.
    growth: tuple[Growth | None, ...] = Field(default=(), exclude_if=lambda rows: not rows)

    @model_validator(mode="after")
    def _complete(self) -> Self:
        n = len(self.relations)
        if len(self.reasons) != n:
            raise ValueError(f"{n} relations have {len(self.reasons)} reasons")
        if any(
            (relation is None) == (reason == "") for relation, reason in zip(self.relations, self.reasons, strict=True)
        ):
            raise ValueError("a relation is there, or a reason why not; never both or neither")
        if self.growth and len(self.growth) != n:
            raise ValueError(f"{n} relations have {len(self.growth)} growths")
        sizes = [
            (f"covariance of row {one.row}", one.covariance, one.coefficients.size) for one in self.relations if one
        ]
        for one in self.rotations:
            size = 2 * len(one.coordinates)
            if one.vectors.size != size:
                raise ValueError(
                    f"{one.vectors.size} numbers in vectors, {size} are expected of {len(one.coordinates)}"
                )
            sizes.append(("covariance of the rotation", one.covariance, size))
        for what, matrix, size in (*sizes, *(("spectra of the force", band, n) for band in self.force)):
            if len(matrix) != size:
                raise ValueError(f"{what}: not {size} by {size}")
        return self

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Baseline) and self.model_dump_json() == other.model_dump_json()

    def __hash__(self) -> int:
        return hash(self.model_dump_json())

    @property
    def without_force(self) -> Self:
        """The same without the force: readings get the errors of other conditions, whatever moves the machine."""
        return self.model_copy(update={"force": NO_FORCE})

    @property
    def rows(self) -> tuple[Row, ...]:
        """The shipped table of rows that the baseline was learned with."""
        n_coupled = sum(row.n_coefficients for row in learned_rows(COUPLED_ROWS))
        return COUPLED_ROWS if len(self.covariance) == n_coupled else ROWS
