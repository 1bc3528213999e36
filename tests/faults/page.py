"""Writes what was measured into docs/reliability.md."""

import re
from collections.abc import Mapping, Sequence

from tests.faults.measure import Outcome
from tests.faults.scenarios import ROWS
from tests.service.rig.live import ROOT

PAGE = ROOT / "docs" / "reliability.md"


def _span(values: Sequence[float], digits: int = 1) -> str:
    if not values:
        return "–"
    low, high = f"{min(values):.{digits}f}", f"{max(values):.{digits}f}"
    return low if low == high else f"{low}–{high}"


def _row(name: str, outcomes: Sequence[Outcome]) -> str:
    kept = [one for one in outcomes if one.orders]
    missing = _span([one.missing_s for one in kept])
    lost, orders = sum(one.lost_orders for one in kept), sum(one.orders for one in kept)
    stated = _span([value for one in kept for value in one.stated_s])
    recovered = _span([value for one in kept for value in one.recovered_s])
    return f"| {name} | {missing} | {lost} of {orders} | {stated} | {recovered} |\n"


def written(page: str, found: Mapping[str, Sequence[Outcome]], seeds: Sequence[int], loads: Sequence[float]) -> str:
    """The page with the outcomes of every row, by its name, and load averages of the computer in the course of it."""
    outcomes = [one for each in found.values() for one in each]
    compared = [one.unaccounted for one in outcomes if one.unaccounted is not None]
    wrong = "".join(
        f"- **Not as in the first table**, in {sum(bool(one.wrong) for one in each)} of {len(each)} runs of *{name}*: "
        f"{'; '.join(text for one in each for text in one.wrong)}.\n"
        for name, each in found.items()
        if any(one.wrong for one in each)
    )
    runs = f"{len(ROWS)} faults, seeds {', '.join(map(str, seeds))}, {len(outcomes)} runs"
    for place, text in (
        (r"\d+ faults, seeds [\d, ]+, \d+ runs", runs),
        (r"(?<=During this run )\d+ to \d+", f"{min(loads):.0f} to {max(loads):.0f}"),
        (
            r"(?<=over after, s \|\n\|---\|---\|---\|---\|---\|\n)(\|.*\n)+",
            "".join(_row(*each) for each in found.items()),
        ),
        (r"\d+ runs, \d+ blocks unaccounted for", f"{len(compared)} runs, {sum(compared)} blocks unaccounted for"),
        (r"(?<=in the log twice: )\d+", f"{sum(one.doubled for one in outcomes)}"),
        (r"(?<=until recovery\.\n)(- \*\*Not as .*\n)*", wrong),
    ):
        (at,) = re.finditer(place, page)
        page = page[: at.start()] + text + page[at.end() :]
    return page
