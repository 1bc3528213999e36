"""The demo with shorter intervals between its events: ``python -m tests.service.commands.quick_demo``."""

import sys

from service.commands import demo
from service.commands.rotorwatch import app

if __name__ == "__main__":
    demo._HEALTHY_S, demo._BROKEN_S, demo._REPAIRED_S = 65.0, 45.0, 45.0
    app(["demo", *sys.argv[1:]])
