"""Types of the numbers and arrays in a stored baseline: finite, with their sign and shape validated."""

from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, FiniteFloat, GetPydanticSchema
from pydantic_core import core_schema as cs

from models.signals.block import FloatArray

Positive = Annotated[FiniteFloat, Field(gt=0)]
NotNegative = Annotated[FiniteFloat, Field(ge=0)]
_Rows = tuple[tuple[FiniteFloat, ...], ...]


def _array(rows: tuple[Any, ...]) -> FloatArray:
    return np.array(rows, dtype=np.float64)


def _square(rows: _Rows) -> _Rows:
    if any(len(row) != len(rows) for row in rows):
        raise ValueError(f"not {len(rows)} by {len(rows)}")
    if any(row[at] < 0 for at, row in enumerate(rows)):
        raise ValueError("a value on the diagonal is negative")
    return rows


def _cube(bands: tuple[_Rows, ...]) -> FloatArray:
    first = len(bands[0]) if bands else 0
    if other := next((len(rows) for rows in bands if len(rows) != first), 0):
        raise ValueError(f"a band is {other} by {other}, the first {first} by {first}")
    return np.array(bands, dtype=np.float64).reshape(len(bands), first, first)


def _stored(kind: object, made: Callable[[Any], FloatArray] = _array) -> GetPydanticSchema:
    """An array in the program, nested numbers in JSON."""
    numbers = Annotated[kind, AfterValidator(made)]  # type: ignore[valid-type]
    array, saved = cs.is_instance_schema(np.ndarray), cs.plain_serializer_function_ser_schema(np.ndarray.tolist)
    return GetPydanticSchema(lambda _, handler: cs.json_or_python_schema(handler(numbers), array, serialization=saved))


Vector = Annotated[FloatArray, _stored(tuple[FiniteFloat, ...])]
Covariance = Annotated[FloatArray, _stored(Annotated[_Rows, AfterValidator(_square)])]
Spectra = Annotated[FloatArray, _stored(tuple[Annotated[_Rows, AfterValidator(_square)], ...], _cube)]
