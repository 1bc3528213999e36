"""Carries out a row with one seed, measures its cost, checks what must hold, and writes both into the page."""

import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from subprocess import SubprocessError

from tests.faults.faults import ROWS, Row
from tests.faults.rig import BLOCK_S, Plant, plant
from tests.service.rig.live import ROOT

PAGE = ROOT / "docs" / "reliability.md"
_SLACK_S = 1.0


@dataclass(frozen=True, slots=True)
class Outcome:
    missing_s: float
    unaccounted: int | None
    orders: int
    lost_orders: int
    doubled: int
    stated_s: tuple[float, ...]
    recovered_s: tuple[float, ...]
    wrong: tuple[str, ...]


def carried_out(row: Row, seed: int) -> Outcome:
    # A short path: it becomes that of a mounted file system.
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        try:
            with plant(Path(folder), seed, row.prepare) as at:
                row.run(at)
                at.wait_for_orders(1)
                return _outcome(at)
        except (AssertionError, OSError, SubprocessError) as error:
            return Outcome(0.0, None, 0, 0, 0, (), (), (str(error) or repr(error),))


def _outcome(at: Plant) -> Outcome:
    at.rest_from_work()
    unaccounted = at.unaccounted()
    heard = list(at.heard)  # before the log is read, which holds them earlier
    log = at.log()
    at.note()
    lost = [one for one in at.answered if one not in log]
    unheard = [one for one in heard if one not in log]
    doubled = len(log) - len({one[1:] for one in log})
    faults = {
        f"{at.missing_s:g} s of data are missing": at.missing_s > (at.away_s + _SLACK_S if at.away_s else 0.0),
        f"{at.dropped} blocks were dropped": at.dropped and not at.away_s,
        f"{unaccounted} blocks are unaccounted for": unaccounted,
        f"{len(lost)} orders are lost": lost and not at.orders_may_be_lost,
        f"{len(unheard)} events were heard and are not in the log": unheard and not at.orders_may_be_lost,
        f"{doubled} events are in the log twice": doubled,
    }
    return Outcome(
        missing_s=round(at.missing_s / BLOCK_S) * BLOCK_S, unaccounted=unaccounted, orders=len(at.answered),
        lost_orders=len(lost), doubled=doubled, stated_s=tuple(at.stated_s), recovered_s=tuple(at.recovered_s),
        wrong=tuple(text for text, holds in faults.items() if holds),
    )  # fmt: skip


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
    """The page with the outcomes of every row, by its name, and the load averages during the run."""
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
