"""The log of alarms read by those who may not write it."""

from functools import partial
from pathlib import Path

import pytest

from service.history.records import Retention, Step, StoreError
from service.history.shared import committed_events
from service.history.store import Store
from tests.service.postgres import KINDS, database_url
from tests.service.test_store import alarm_event


@pytest.mark.parametrize("kind", KINDS)
def test_who_may_not_write_reads_what_was_committed(kind: str, tmp_path: Path) -> None:
    url = database_url(kind, tmp_path)
    store = Store(url, Retention())
    store.open()
    lab, pump = store.machine("demo", "lab"), store.machine("demo", "pump")
    events = tuple(alarm_event(number) for number in range(4))
    lab.commit(Step(events=events))
    pump.commit(Step(events=events[:1]))
    for read in (store.alarms.since, partial(committed_events, url)):
        assert read("demo", "lab", events[1].recorded_ns) == events[1:]
        assert read("demo", "pump", 0) == events[:1]
        assert read("demo", "fan", 0) == ()
    store.close()


def test_a_history_that_is_only_looked_into_is_not_made(tmp_path: Path) -> None:
    file = tmp_path / "history.sqlite"
    with pytest.raises(StoreError, match="unable to open"):
        committed_events(f"sqlite:///{file}", "demo", "lab", 0)
    assert not file.exists()
