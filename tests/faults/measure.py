"""Carries out a row with one seed, and says what it cost and what did not hold."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from subprocess import SubprocessError

from tests.faults.rig import BLOCK_S, Plant, plant
from tests.faults.scenarios import Row

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
    heard = list(at.heard)  # before the log is read, in which they have been for long
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
