"""Examples in docstrings give the output they show.

Only modules with an example are imported; pytest's own collection would load all of them in each worker.
"""

import doctest
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SHOWING = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for room in ("models", "rotorwatch", "service", "simulator")
    for path in sorted((ROOT / room).rglob("*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("name", SHOWING)
def test_docstring_examples_give_the_output_they_show(name: str) -> None:
    assert not doctest.testmod(import_module(name)).failed
