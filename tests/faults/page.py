"""Writes docs/reliability.md out of what was measured."""

from collections.abc import Mapping, Sequence

from tests.faults.measure import Outcome
from tests.faults.scenarios import ROWS, Row
from tests.service.rig.live import ROOT

PAGE = ROOT / "docs" / "reliability.md"

_HEAD = """# Reliability

This page lists what can fail around a monitor, what each failure costs, what the monitor says about it, and how long
recovery takes. Guarantees are at [the end](#what-can-be-relied-on).

Each fault was produced with the programs as users start them: `rotorwatch run` with its history in SQLite and
`rotorsim publish` in real time (five blocks a second), both on one computer with two cores. In the meantime an operator
shelved and unshelved an alarm several times a second and noted which requests were answered as done, and a listener on
the network noted every alarm event.

`python -m tests.faults --write` runs the faults and writes this page: {rows} faults, seeds {seeds}, {runs} runs, with
faults at other moments for each seed. Figures are the smallest and largest of that run. Times include program starts,
each of which computes for a few seconds. During this run {least:.0f} to {most:.0f} programs at a time competed for the
two cores (load average).

"""

_WORDS = """
- **Data missing**: seconds of data that were not evaluated, as the monitor states it (`missing_s`). Where one publisher
  and one monitor ran from beginning to end, the blocks that the publisher reports as sent were compared with those
  evaluated and stated as missing: {compared} runs, {unaccounted} blocks unaccounted for.
- **Actions lost**: operator actions that were answered as done but are not in the alarm log afterwards, out of all
  such actions.
- **Events doubled**: alarm events that are in the log twice: {doubled} in all runs.
- **Stated after**: time from the fault until the monitor reports it; shortest and longest of all runs.
- **Over after**: time from when the cause was removed (a program was restarted, a lock released) until recovery.
{wrong}
## What can be relied on

- Confirmed data are in the history: no kill, failing write or full disk removes or duplicates them.
- Alarms are published even while the history cannot be written. Operator actions take effect and wait in memory like
  everything else, so they are lost if the monitor is killed before the history is back. `/readyz` says whether this is
  the case; check it before you end a monitor.
- Blocks sent while the monitor was away are taken from the publisher's cache. `rotorsim` keeps 1200; your own
  publishers should keep as many as they send in the longest time that a monitor may be away ([wire format](wire.md)).
  On a busy computer a new block may overtake those of the cache, which are then not fetched: the gap is stated, and the
  data are missing.
- A silent stream, a gap, a clock that was set and a second publisher are reported ([Alarms](alarms.md)).

[History](history.md) says what happens to a damaged history and how to recover it; [Webhooks](webhooks.md) says how
delivery to receivers works.
"""


def _span(values: Sequence[float], digits: int = 1) -> str:
    if not values:
        return "–"
    low, high = f"{min(values):.{digits}f}", f"{max(values):.{digits}f}"
    return low if low == high else f"{low}–{high}"


def _row(row: Row, outcomes: Sequence[Outcome]) -> str:
    kept = [one for one in outcomes if one.orders]
    missing = _span([one.missing_s for one in kept])
    lost, orders = sum(one.lost_orders for one in kept), sum(one.orders for one in kept)
    stated = _span([value for one in kept for value in one.stated_s])
    recovered = _span([value for one in kept for value in one.recovered_s])
    return f"| {row.name} | {missing} | {lost} of {orders} | {stated} | {recovered} |\n"


def written(found: Mapping[str, Sequence[Outcome]], seeds: Sequence[int], loads: Sequence[float]) -> str:
    """Make the page.

    Parameters
    ----------
    found : mapping of str to sequence of Outcome
        Outcomes of every row, by its name.
    seeds : sequence of int
    loads : sequence of float
        Load averages of the computer in the course of it.
    """
    outcomes = [one for each in found.values() for one in each]
    compared = [one.unaccounted for one in outcomes if one.unaccounted is not None]
    said = "".join(
        f"- **Not as in the first table**, in {sum(bool(one.wrong) for one in each)} of {len(each)} runs of *{name}*: "
        f"{'; '.join(text for one in each for text in one.wrong)}.\n"
        for name, each in found.items()
        if any(one.wrong for one in each)
    )
    seeds_text = ", ".join(map(str, seeds))
    text = _HEAD.format(rows=len(ROWS), seeds=seeds_text, runs=len(outcomes), least=min(loads), most=max(loads))
    text += "| what happens | how it was produced | what may be lost | what the monitor says | over when |\n"
    text += "|---|---|---|---|---|\n"
    text += "".join(f"| {row.name} | {row.done} | {row.lost} | {row.stated} | {row.recovery} |\n" for row in ROWS)
    text += "\nWhat was measured:\n\n"
    text += (
        "| what happens | data missing, s | actions lost | stated after, s | over after, s |\n|---|---|---|---|---|\n"
    )
    text += "".join(_row(row, found[row.name]) for row in ROWS)
    return text + _WORDS.format(
        compared=len(compared), unaccounted=sum(compared), doubled=sum(one.doubled for one in outcomes), wrong=said
    )
