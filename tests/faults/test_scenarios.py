"""One row of the table of faults as a regression test; ``python -m tests.faults`` carries out all of them."""

import re

import pytest

from tests.faults.faults import ROWS
from tests.faults.measure import PAGE, carried_out


@pytest.mark.slow
def test_a_locked_history_costs_no_more_than_the_table_says() -> None:
    (row,) = (one for one in ROWS if one.name == "The history is locked by another program")
    outcome = carried_out(row, seed=11)
    assert outcome.wrong == ()
    assert outcome.unaccounted == 0
    assert outcome.orders > 0
    assert outcome.recovered_s


def test_the_page_has_every_row_in_both_tables() -> None:
    named = re.findall(r"^\| ([^|]+) \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert [name for name in named if name != "what happens"] == 2 * [row.name for row in ROWS]
