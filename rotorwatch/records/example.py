"""A valid JSON object of a record, for documents and tests."""

import json
from functools import cache
from typing import get_args, get_origin

from pydantic import BaseModel


def example(model: type[BaseModel]) -> dict[str, object]:
    """Build one valid JSON object of a model out of the examples of its fields."""
    found: dict[str, object] = json.loads(_example_json(model))
    return found


@cache
def _example_json(model: type[BaseModel]) -> str:
    found = {name: _field_example(one.examples, one.annotation) for name, one in model.model_fields.items()}
    left_out = {name for name, one in model.model_fields.items() if one.exclude_if and one.exclude_if(found[name])}
    return json.dumps({name: value for name, value in found.items() if name not in left_out})


def _field_example(examples: list[object] | None, annotation: object) -> object:
    if examples:
        return examples[0]
    item = next((part for part in get_args(annotation) if part is not Ellipsis), annotation)
    if not (isinstance(item, type) and issubclass(item, BaseModel)):
        raise TypeError(f"no example for {annotation}")
    return [example(item)] if get_origin(annotation) is tuple else example(item)
