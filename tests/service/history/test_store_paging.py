"""Pages joined together give every entry once and in order, whatever the clock did and whatever the filter."""

import uuid
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rotorwatch.records.history import Reading
from service.history.records import Step, StoredEvent, StoredReading, StoredReport
from service.history.store import Store
from tests.service.history.test_store import alarm_event
from tests.service.rig.postgres import KINDS, database_url, opened

_T = TypeVar("_T")
# Few different times: repetitions and steps back happen all the time.
TIMES = st.lists(st.integers(0, 12), max_size=25)
BOUND = st.none() | st.integers(0, 13)
LIMIT = st.integers(1, 7)


@pytest.fixture(scope="module", params=KINDS)
def store(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    folder: Path = tmp_path_factory.mktemp("store")
    with opened(database_url(request.param, folder)) as made:
        yield made


def pages(fetch: Callable[[int | None], Sequence[_T]], number: Callable[[_T], int], limit: int) -> list[_T]:
    found: list[_T] = []
    cursor: int | None = None
    while page := fetch(cursor):
        assert len(page) <= limit
        found.extend(page)
        cursor = number(page[-1])
    return found


def within(times: Sequence[int], since: int | None, until: int | None) -> list[int]:
    return [
        place
        for place, time in enumerate(times)
        if (since is None or time >= since) and (until is None or time < until)
    ]


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(times=TIMES, cuts=st.lists(st.integers(0, 25), max_size=3), since=BOUND, until=BOUND, limit=LIMIT)
def test_pages_give_every_entry_once_in_order(
    store: Store, times: list[int], cuts: list[int], since: int | None, until: int | None, limit: int
) -> None:
    lab = store.machine("demo", uuid.uuid4().hex)
    edges = sorted({0, len(times), *(min(cut, len(times)) for cut in cuts)})
    kinds = [
        {
            "alarm": ("e", "model")[n % 2],
            "kind": ("raised", "cleared")[n % 3 // 2],
            "severity": ("alert", "danger")[n % 5 // 4],
        }
        for n in range(len(times))
    ]
    events = [alarm_event(n, time_ns=time, **kinds[n]) for n, time in enumerate(times)]
    reports = [StoredReport(0, time, "healthy", 1.0, f"{n}") for n, time in enumerate(times)]
    readings = [StoredReading(time, "misfit", "z", float(n), None) for n, time in enumerate(times)]
    for first, last in pairwise(edges):
        part = slice(first, last)
        others = tuple(StoredReading(each.end_ns, "parameter", "e", 0.0, None) for each in readings[part])
        assert lab.commit(Step(tuple(reports[part]), others + tuple(readings[part]), tuple(events[part])))
    chosen = within(times, since, until)

    def older(before: int | None) -> tuple[tuple[int, StoredReport], ...]:
        return lab.reports(since_ns=since, until_ns=until, before=before, limit=limit)

    def later(after: int | None) -> tuple[Reading, ...]:
        return lab.readings(quantity="misfit", name="z", since_ns=since, until_ns=until, after=after, limit=limit)

    def forth(after: int | None) -> tuple[StoredEvent, ...]:
        return lab.events(after=after, since_ns=since, until_ns=until, limit=limit, **wanted)

    def back(before: int | None) -> tuple[StoredEvent, ...]:
        return lab.events(before=before, since_ns=since, until_ns=until, limit=limit, newest_first=True)

    assert [report for _, report in pages(older, lambda row: row[0], limit)] == [reports[n] for n in chosen[::-1]]
    singles = pages(later, lambda reading: reading.number, limit)
    assert [(one.end_ns, one.value) for one in singles] == [(readings[n].end_ns, readings[n].value) for n in chosen]
    wanted: dict[str, Any]
    for wanted in ({"alarm": "e"}, {"kind": "cleared"}, {"alarm": "e", "kind": "raised", "severity": "danger"}):
        found = [events[n] for n in chosen if wanted.items() <= kinds[n].items()]
        assert pages(forth, lambda event: event.sequence, limit) == found
        assert forth(2**63 - 1) == ()
    assert pages(back, lambda event: event.sequence, limit) == [events[n] for n in chosen[::-1]]
