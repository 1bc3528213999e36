"""Stored output of the monitor: every later version gives the same, or states a reason for the difference.

With ``ROTORWATCH_PIN=1`` in its environment, a test that compares stores what it finds.
"""

import gzip
import json
import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

_FOLDER = Path(__file__).parent
_NEAR, _NEAR_ZERO = 1e-3, 1e-6
"""Other processors round the last digits differently, and a recording's samples are single precision: that moves a
relative change by some 1e-8 and a ``z``, which is one over its error, by some 1e-5.
"""
_COARSE = {"z": 1e-3, "deg": 1e-3}
"""Absolute tolerances of values around zero, by the last part of their name."""


def differences(name: str, lines: Sequence[str]) -> list[str]:
    """Where JSON lines differ from those stored under a name; floats may differ in their fourth digit."""
    path = _FOLDER / f"{name}.jsonl.gz"
    if os.environ.get("ROTORWATCH_PIN"):
        path.write_bytes(gzip.compress("".join(f"{line}\n" for line in lines).encode(), mtime=0))
    kept = gzip.decompress(path.read_bytes()).decode().splitlines()
    if len(kept) != len(lines):
        return [f"{len(lines)} lines instead of {len(kept)}"]
    return [
        found
        for number, (old, new) in enumerate(zip(kept, lines, strict=True), 1)
        for found in _between(json.loads(old), json.loads(new), f"line {number}")
    ]


def _between(old: Any, new: Any, where: str) -> list[str]:
    if isinstance(old, dict) and isinstance(new, dict) and list(old) == list(new):
        # The identity of a bundle depends on its every bit.
        keys = [key for key in old if key != "bundle"]
        return [found for key in keys for found in _between(old[key], new[key], f"{where}.{key}")]
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        pairs = enumerate(zip(old, new, strict=True))
        return [found for number, (a, b) in pairs for found in _between(a, b, f"{where}[{number}]")]
    if isinstance(old, float) and isinstance(new, float):
        near_zero = _COARSE.get(re.split("[._]", where.rstrip("[0123456789]"))[-1], _NEAR_ZERO)
        if math.isclose(old, new, rel_tol=_NEAR, abs_tol=near_zero):
            return []
    return [] if type(old) is type(new) and old == new else [f"{where}: {new!r} instead of {old!r}"]
