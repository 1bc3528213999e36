"""What a reading says of itself."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

import models
import service
import simulator
from models.diagnosis.readings import Z95, parameter_reading, possible_reading
from models.errors import EstimationError


@pytest.mark.parametrize("change", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_none_is_no_reading(change: float) -> None:
    reading = possible_reading("k_by", "relation", change, 0.1)
    assert (reading.relative_change, reading.standard_error, reading.interval_95) == (None, None, None)
    assert reading.reason
    with pytest.raises(EstimationError, match="k_by"):
        parameter_reading("k_by", "likelihood", change, 0.1)


def test_a_reading_without_an_error_has_no_interval() -> None:
    reading = parameter_reading("e", "likelihood", 0.1, np.inf)
    assert (reading.relative_change, reading.standard_error, reading.interval_95, reading.z) == (0.1, None, None, None)
    sharp = parameter_reading("e", "likelihood", 0.1, 0.0)
    assert (sharp.interval_95, sharp.z) == ((0.1, 0.1), None)


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
