"""A baseline as JSON: some hundred numbers and no code.

Numbers are written with as many digits as needed to read back the same bits, so that a restored baseline gives the same
diagnoses as the one that was stored.
"""

import json
from dataclasses import asdict
from typing import Literal, Self

from pydantic import BaseModel, Field, model_validator

from models.diagnosis.baseline.diagnostician import BaselineDiagnostician
from models.diagnosis.baseline.growth import Growth
from models.diagnosis.baseline.learned import NO_FORCE, Baseline, LeftOut
from models.diagnosis.baseline.numbers import Covariance, Positive, Spectra
from models.diagnosis.baseline.relation import Relation
from models.diagnosis.baseline.unbalance import SynchronousVectors


class BaselineRecord(BaseModel, extra="forbid", frozen=True, strict=True):
    """A `Baseline`, as plain numbers."""

    format: Literal[1] = 1
    relations: tuple[Relation | None, ...]  # one for each learned row, or null
    reasons: tuple[str, ...]  # why a row has no relation
    covariance: Covariance  # of the coefficients of all rows
    rotations: tuple[SynchronousVectors, ...]  # synchronous vectors by speed
    duration_s: Positive
    consistency: tuple[LeftOut, ...] = ()  # healthy windows against each other
    # Cross-spectra of the rows' residuals by bands; empty if the healthy recordings had several conditions.
    force: Spectra = Field(default_factory=NO_FORCE.copy, exclude_if=lambda bands: not len(bands))
    # One for each learned row, or null; empty in older records.
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
        return isinstance(other, BaselineRecord) and self.model_dump_json() == other.model_dump_json()

    def __hash__(self) -> int:
        return hash(self.model_dump_json())

    @classmethod
    def of(cls, baseline: Baseline) -> Self:
        """Make the record of a baseline.

        Raises
        ------
        pydantic.ValidationError
            If a number in it is not finite.
        """
        return cls.model_validate_json(json.dumps(asdict(baseline), default=lambda numbers: numbers.tolist()))

    def diagnostician(self) -> BaselineDiagnostician:
        """Diagnostician that reads windows against the baseline."""
        return BaselineDiagnostician(self.baseline())

    def baseline(self) -> Baseline:
        """The baseline, to the last bit."""
        return Baseline(**{name: value for name, value in self if name != "format"})
