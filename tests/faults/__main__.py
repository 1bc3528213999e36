"""Carries out every row with some seeds, and writes the page: ``python -m tests.faults`` (half an hour)."""

import argparse
import os
import sys
from concurrent.futures import ThreadPoolExecutor

from tests.faults.faults import ROWS, Row
from tests.faults.measure import PAGE, Outcome, carried_out, written


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0], prog="python -m tests.faults")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--rows", nargs="+", default=[""], help="only rows in whose names one of these texts is")
    parser.add_argument("--at-once", type=int, default=2, help="rows that are carried out beside each other")
    parser.add_argument("--write", action="store_true", help="write docs/reliability.md; needs all rows")
    given = parser.parse_args()
    rows = [row for row in ROWS if any(text.lower() in row.name.lower() for text in given.rows)]
    if given.write and len(rows) != len(ROWS):
        parser.error("--write needs all rows")
    loads = [os.getloadavg()[0]]
    found: dict[str, list[Outcome]] = {row.name: [] for row in rows}

    def run(row: Row, seed: int) -> None:
        outcome = carried_out(row, seed)
        found[row.name].append(outcome)
        loads.append(os.getloadavg()[0])
        sys.stdout.write(f"{row.name} (seed {seed}): {outcome}\n")
        sys.stdout.flush()

    with ThreadPoolExecutor(given.at_once) as pool:
        for one in [pool.submit(run, row, seed) for seed in given.seeds for row in rows]:
            one.result()
    wrong = [f"{name}: {text}" for name, outcomes in found.items() for one in outcomes for text in one.wrong]
    sys.stdout.write("".join(f"{line}\n" for line in wrong) or "everything was as the table says\n")
    if given.write:
        PAGE.write_text(written(PAGE.read_text(encoding="utf-8"), found, given.seeds, loads), encoding="utf-8")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
