"""A baseline as JSON: some hundred numbers and no code, restored to the last bit.

Numbers are written with as many digits as it takes to read the same number back, so that a restored baseline gives the
same diagnoses as the one that was stored.
"""

import json
from collections.abc import Callable
from dataclasses import asdict
from typing import Annotated, Literal, Self, TypeVar

import numpy as np
from pydantic import BaseModel, Field, model_validator

from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.growth import Growth
from models.diagnosis.baseline.learned import Baseline, HeldOutReading, LeftOut
from models.diagnosis.baseline.relation import Relation
from models.diagnosis.baseline.unbalance import SynchronousVectors

_Number = Annotated[float, Field(allow_inf_nan=False)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Vector = tuple[_Number, ...]
_Matrix = tuple[_Vector, ...]
_Kind = TypeVar("_Kind")


class RelationRecord(BaseModel, extra="forbid", frozen=True, strict=True):
    """One learned row."""

    row: str
    states: tuple[str, ...] = Field(min_length=1)
    references: tuple[str, ...] = Field(min_length=1)
    coefficients: _Vector = Field(min_length=1)
    covariance: _Matrix
    misfit: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    degrees_of_freedom: int = Field(ge=1)
    allowance: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 1.0
    # What older records lack is left out where it says nothing: their commissionings keep their identity.
    lag_from_s: float = Field(default=0.0, ge=0, allow_inf_nan=False, exclude_if=lambda lag_s: lag_s == 0)

    @model_validator(mode="after")
    def _square(self) -> Self:
        _check_covariance(f"covariance of row {self.row}", self.covariance, len(self.coefficients))
        return self


class RotationRecord(BaseModel, extra="forbid", frozen=True, strict=True):
    """Synchronous vectors at one speed."""

    coordinates: tuple[str, ...] = Field(min_length=1)
    vectors: _Vector
    covariance: _Matrix
    speed_rad_s: _Number
    absolute: bool = True

    @model_validator(mode="after")
    def _square(self) -> Self:
        size = 2 * len(self.coordinates)
        if len(self.vectors) != size:
            raise ValueError(f"{len(self.vectors)} numbers in vectors, {size} are expected of {len(self.coordinates)}")
        _check_covariance("covariance of the rotation", self.covariance, size)
        return self


class _AgreementRecord(BaseModel, extra="forbid", frozen=True, strict=True):
    """A healthy window's reading of one parameter against the others."""

    parameter: str
    change: _Number
    standard_error: _Positive


class _LeftOutRecord(BaseModel, extra="forbid", frozen=True, strict=True):
    """A healthy window against the others."""

    row: str
    window: int = Field(ge=0)
    condition: str
    agreements: tuple[_AgreementRecord, ...]
    misfit: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    degrees_of_freedom: int = Field(ge=1)


class GrowthRecord(BaseModel, extra="forbid", frozen=True, strict=True):
    """How a row's stiffness grows with the motion."""

    power: _Positive
    slope: _Number
    standard_error: Annotated[float, Field(ge=0, allow_inf_nan=False)]


class BaselineRecord(BaseModel, extra="forbid", frozen=True, strict=True):
    """What was learned on a healthy machine, as plain numbers."""

    format: Literal[1] = 1
    relations: tuple[RelationRecord | None, ...]  # one for each learned row, or null
    reasons: tuple[str, ...]  # why there is none
    covariance: _Matrix  # of the coefficients of all rows
    rotations: tuple[RotationRecord, ...]  # synchronous vectors by speed
    duration_s: _Positive
    consistency: tuple[_LeftOutRecord, ...] = ()  # healthy windows against each other
    # Cross-spectra of what the rows leave over, by bands; empty where the healthy recordings had several forces.
    force: tuple[_Matrix, ...] = Field(default=(), exclude_if=lambda bands: not bands)
    # Of each learned row, or null; empty in older records.
    growth: tuple[GrowthRecord | None, ...] = Field(default=(), exclude_if=lambda rows: not rows)

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if len(self.relations) != len(self.reasons):
            raise ValueError(f"{len(self.relations)} relations have {len(self.reasons)} reasons")
        for relation, reason in zip(self.relations, self.reasons, strict=True):
            if (relation is None) == (reason == ""):
                raise ValueError("a relation is there, or a reason why not; never both or neither")
        if self.growth and len(self.growth) != len(self.relations):
            raise ValueError(f"{len(self.relations)} relations have {len(self.growth)} growths")
        _check_covariance("covariance of the coefficients", self.covariance, len(self.covariance))
        for band in self.force:
            _check_covariance("spectra of the force", band, len(self.relations))
        return self

    @classmethod
    def of(cls, baseline: Baseline) -> Self:
        """Record of a baseline.

        Raises
        ------
        pydantic.ValidationError
            If a number in it is not finite.
        """
        return cls.model_validate_json(json.dumps(asdict(baseline), default=lambda numbers: numbers.tolist()))

    def diagnostician(self) -> BaselineDiagnostician:
        """What reads windows against it."""
        return BaselineDiagnostician(self.baseline())

    def baseline(self) -> Baseline:
        """The baseline, to the last bit."""
        return Baseline(
            relations=tuple(
                None if one is None else _with_arrays(Relation, one, "coefficients", "covariance")
                for one in self.relations
            ),
            reasons=self.reasons,
            covariance=np.array(self.covariance, dtype=np.float64),
            rotations=tuple(_with_arrays(SynchronousVectors, one, "vectors", "covariance") for one in self.rotations),
            duration_s=self.duration_s,
            consistency=tuple(
                LeftOut(**dict(one) | {"agreements": tuple(HeldOutReading(**dict(each)) for each in one.agreements)})
                for one in self.consistency
            ),
            force=np.array(self.force, dtype=np.float64) if self.force else np.zeros((0, 0, 0)),
            growth=tuple(None if one is None else Growth(**dict(one)) for one in self.growth),
        )


def _check_covariance(what: str, matrix: _Matrix, size: int) -> None:
    if len(matrix) != size or any(len(row) != size for row in matrix):
        raise ValueError(f"{what}: not {size} by {size}")
    if any(matrix[i][i] < 0 for i in range(size)):
        raise ValueError(f"{what}: a value on the diagonal is negative")


def _with_arrays(kind: Callable[..., _Kind], record: BaseModel, *arrays: str) -> _Kind:
    fields = dict(record)
    return kind(**fields | {name: np.array(fields[name], dtype=np.float64) for name in arrays})
