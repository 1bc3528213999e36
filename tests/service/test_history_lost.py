"""A history that is locked at the end, deleted, replaced or damaged: it is said, and monitoring goes on."""

import sqlite3
from pathlib import Path

from tests.service.live import endpoint, machine_file
from tests.service.test_survives import PATIENT, running


def test_a_monitor_that_could_not_write_the_last_of_it_says_what_is_lost(tmp_path: Path) -> None:
    with running(tmp_path, endpoint(), machine_file(tmp_path, PATIENT)) as at:
        at.url()
        blocker = sqlite3.connect(tmp_path / "history.sqlite", isolation_level=None)  # does not let go of the file
        blocker.execute("BEGIN IMMEDIATE")
        assert at.stop() == 1
        blocker.close()
        (said,) = [line for line in at.errors().splitlines() if line.startswith("could not be written")]
        assert "demo/lab: the state to go on from" in said
        assert "database is locked" in said
