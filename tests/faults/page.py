"""Writes docs/reliability.md out of what was measured."""

from collections.abc import Mapping, Sequence

from tests.faults.measure import Outcome
from tests.faults.scenarios import ROWS, Row
from tests.service.rig.live import ROOT

PAGE = ROOT / "docs" / "reliability.md"

_HEAD = """# Reliability

What breaks around a monitor, what that costs, what the monitor says of it, and how long it takes until everything
is as before. Each fault was brought about with the programs as users start them: `rotorwatch run` with its history
in SQLite, `rotorsim publish` in real time, five blocks a second, both on one computer with two cores. Meanwhile an
operator shelved an alarm and ended that again, several times a second, and noted what was answered as done; a
listener on the network noted every alarm event.

This page is written by the run: `python -m tests.faults --write` ({rows} faults, seeds {seeds}, {runs} runs; the
moments differ from seed to seed). The figures are of that run, the least and the most. Times include the start of
programs, each of which computes for a few seconds. During this run {least:.0f} to {most:.0f} programs at a
time wanted to compute on the two cores (load average).

"""

_WORDS = """
- **Data missing**: what was not evaluated, in seconds of data, as the monitor states it (`missing_s`). Where one
  publisher and one monitor ran from beginning to end, what the publisher says it has sent was compared with what
  was evaluated and what is stated as missing: {compared} runs, {unaccounted} blocks unaccounted for.
- **Orders lost**: what operators were told is done and is not in the log of alarms afterwards, of so many orders.
- **Events doubled**: alarm events that are in the log twice: {doubled} in all runs.
- **Stated after**: from the fault until the monitor says so; the longest and shortest of all runs.
- **Over after**: from when the cause was gone (a program was started again, a lock let go of) until it was over.
{wrong}
## What can be relied on

- What was confirmed is in the history: no kill, no failing write and no full disk takes it away again, or puts it
  there twice.
- An alarm is published also while the history cannot be written. What operators do meanwhile is done, and waits in
  memory like everything else: a monitor that is killed before the history is back has lost it. `/readyz` says for
  how long that is so; look at it before you end a monitor.
- Blocks that were sent while the monitor was away come out of the publisher's cache. `rotorsim` keeps 1200;
  publishers of your own should keep as many as they send in the longest time in which a monitor may be away
  ([wire format](wire.md)). On a busy computer a new block may overtake those of the cache, which are then not
  fetched: the gap is stated, and the data are missing.
- A silent stream, a gap, a clock that was set and a second publisher are stated ([Alarms](alarms.md)).

What becomes of a damaged history, and how it is recovered, is said in [History](history.md); how receivers of
webhooks are told, in [Webhooks](webhooks.md).
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
    text += "| what happens | how it was done | what may be lost | what the monitor says | over when |\n"
    text += "|---|---|---|---|---|\n"
    text += "".join(f"| {row.name} | {row.done} | {row.lost} | {row.stated} | {row.recovery} |\n" for row in ROWS)
    text += "\nWhat was measured:\n\n"
    text += (
        "| what happens | data missing, s | orders lost | stated after, s | over after, s |\n|---|---|---|---|---|\n"
    )
    text += "".join(_row(row, found[row.name]) for row in ROWS)
    return text + _WORDS.format(
        compared=len(compared), unaccounted=sum(compared), doubled=sum(one.doubled for one in outcomes), wrong=said
    )
