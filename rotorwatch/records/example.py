"""A valid JSON object of a record, for documents and tests."""

import json
from typing import get_args, get_origin

from pydantic import BaseModel

__all__ = ["example"]


def example(model: type[BaseModel]) -> dict[str, object]:
    """Build one valid JSON object of a model out of the examples of its fields."""
    return {name: _field_example(field.examples, field.annotation) for name, field in model.model_fields.items()}


def _field_example(examples: list[object] | None, annotation: object) -> object:
    if examples:
        return json.loads(json.dumps(examples[0]))
    item = next((part for part in get_args(annotation) if part is not Ellipsis), annotation)
    if not (isinstance(item, type) and issubclass(item, BaseModel)):
        raise TypeError(f"no example for {annotation}")
    return [example(item)] if get_origin(annotation) is tuple else example(item)
