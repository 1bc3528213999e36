"""The first row of the table of faults, so that none of it rots; ``python -m tests.faults`` carries out all of them."""

import re

import pytest

from tests.faults.measure import carried_out
from tests.faults.page import PAGE
from tests.faults.scenarios import ROWS


@pytest.mark.slow
def test_a_killed_publisher_costs_no_more_than_the_table_says() -> None:
    outcome = carried_out(ROWS[0], seed=11)
    assert outcome.wrong == ()
    assert outcome.orders > 0
    assert outcome.recovered_s


def test_the_page_has_every_row_in_both_tables() -> None:
    named = re.findall(r"^\| ([^|]+) \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert [name for name in named if name != "what happens"] == 2 * [row.name for row in ROWS]
