"""Makes the checkout importable before `tests/service`, whose name would otherwise hide the package `service`.

And keeps what programs leave behind by default out of the home of whoever runs the tests.
"""

import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))


@pytest.fixture(autouse=True, scope="session")
def _state_folder() -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="rotorwatch-state-") as folder:
        os.environ["XDG_STATE_HOME"] = folder
        yield
        del os.environ["XDG_STATE_HOME"]
