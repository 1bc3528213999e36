"""A baseline as JSON: a few hundred numbers, no code, back again bit for bit."""

from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.learned import Baseline
from models.diagnosis.baseline.relation import Relation
from models.diagnosis.baseline.unbalance import Rotation
from models.signals.block import FloatArray

__all__ = ["BaselineRecord", "RelationRecord", "RotationRecord"]

_STRICT = ConfigDict(extra="forbid", frozen=True)
_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Vector = tuple[_Finite, ...]
_Matrix = tuple[_Vector, ...]


def _vector(values: FloatArray) -> _Vector:
    return tuple(values.tolist())


def _matrix(values: FloatArray) -> _Matrix:
    return tuple(tuple(row) for row in values.tolist())


def _check_square(name: str, matrix: _Matrix, size: int) -> None:
    if len(matrix) != size or any(len(row) != size for row in matrix):
        raise ValueError(f"{name} is not {size} by {size}")


class RelationRecord(BaseModel):
    """One relation, see `models.diagnosis.baseline.relation.Relation`."""

    model_config = _STRICT

    row: str
    states: tuple[str, ...]
    references: tuple[str, ...]
    coefficients: _Vector
    covariance: _Matrix
    misfit: float = Field(ge=0, allow_inf_nan=False)
    degrees_of_freedom: int = Field(ge=1)

    @model_validator(mode="after")
    def _sized(self) -> Self:
        _check_square("covariance", self.covariance, len(self.coefficients))
        return self


class RotationRecord(BaseModel):
    """Synchronous vectors at one speed, see `models.diagnosis.baseline.unbalance.Rotation`."""

    model_config = _STRICT

    coordinates: tuple[str, ...]
    vectors: _Vector
    covariance: _Matrix
    speed_rad_s: float = Field(gt=0, allow_inf_nan=False)

    @model_validator(mode="after")
    def _sized(self) -> Self:
        size = 2 * len(self.coordinates)
        if len(self.vectors) != size:
            raise ValueError(f"vectors are {len(self.vectors)}, expected {size}")
        _check_square("covariance", self.covariance, size)
        return self


class BaselineRecord(BaseModel):
    """A baseline, see `models.diagnosis.baseline.learned.Baseline`."""

    model_config = _STRICT

    relations: tuple[RelationRecord | None, ...]
    reasons: tuple[str, ...]
    covariance: _Matrix
    rotations: tuple[RotationRecord, ...]
    duration_s: float = Field(gt=0, allow_inf_nan=False)

    @model_validator(mode="after")
    def _sized(self) -> Self:
        if len(self.reasons) != len(self.relations):
            raise ValueError(f"reasons are {len(self.reasons)}, expected {len(self.relations)}")
        _check_square("covariance", self.covariance, len(self.covariance))
        return self

    @classmethod
    def of(cls, baseline: Baseline) -> "BaselineRecord":
        """What a baseline looks like on disk."""
        return cls(
            relations=tuple(None if one is None else _relation(one) for one in baseline.relations),
            reasons=baseline.reasons,
            covariance=_matrix(baseline.covariance),
            rotations=tuple(
                RotationRecord(
                    coordinates=one.coordinates,
                    vectors=_vector(one.vectors),
                    covariance=_matrix(one.covariance),
                    speed_rad_s=one.speed_rad_s,
                )
                for one in baseline.rotations
            ),
            duration_s=baseline.duration_s,
        )

    def baseline(self) -> Baseline:
        """The baseline it describes."""
        return Baseline(
            relations=tuple(
                None
                if one is None
                else Relation(
                    one.row,
                    one.states,
                    one.references,
                    np.array(one.coefficients, dtype=np.float64),
                    np.array(one.covariance, dtype=np.float64),
                    one.misfit,
                    one.degrees_of_freedom,
                )
                for one in self.relations
            ),
            reasons=self.reasons,
            covariance=np.array(self.covariance, dtype=np.float64),
            rotations=tuple(
                Rotation(
                    one.coordinates,
                    np.array(one.vectors, dtype=np.float64),
                    np.array(one.covariance, dtype=np.float64),
                    one.speed_rad_s,
                )
                for one in self.rotations
            ),
            duration_s=self.duration_s,
        )

    def diagnostician(self) -> BaselineDiagnostician:
        """What reads windows against it."""
        return BaselineDiagnostician(self.baseline())


def _relation(relation: Relation) -> RelationRecord:
    return RelationRecord(
        row=relation.row,
        states=relation.states,
        references=relation.references,
        coefficients=_vector(relation.coefficients),
        covariance=_matrix(relation.covariance),
        misfit=relation.misfit,
        degrees_of_freedom=relation.degrees_of_freedom,
    )
