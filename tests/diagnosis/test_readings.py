"""What a reading says of itself."""

import re
from pathlib import Path

import pytest
from scipy.stats import norm

import models
import service
import simulator
from models.diagnosis.readings import Z95


def test_ninety_five_per_cent_is_one_number_everywhere() -> None:
    assert pytest.approx(norm.ppf(0.975), abs=1e-6) == Z95
    folders = [Path(package.__path__[0]) for package in (models, service, simulator)]
    written = [
        file.name
        for folder in folders
        for file in folder.rglob("*.py")
        if re.search(r"(?<![\w, .])1\.96\d* ?\*|= ?1\.96|\b1\.9599", file.read_text(encoding="utf-8"))
    ]
    assert written == ["readings.py"]
