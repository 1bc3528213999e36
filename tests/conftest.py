"""Makes the checkout importable before `tests/service`, whose name would otherwise hide the package `service`."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))
