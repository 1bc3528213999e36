"""Readings of a window packed into one value, and when they are added to buckets."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from service.history.machine import MachineStore
from service.history.records import Retention, Step, StoredReading
from service.history.store import Store
from service.history.tables import buckets, machines
from service.history.windows import READING, add_up, packed, singles, unpacked
from tests.service.history.test_store import T0
from tests.service.rig.postgres import executed, opened

NS = 1_000_000_000
BUCKET = 600 * NS
NUMBER = st.floats(allow_nan=False, width=64)
WINDOW = st.lists(
    st.tuples(st.integers(0, 2**31 - 1), NUMBER, NUMBER | st.just(math.nan)), max_size=5, unique_by=lambda each: each[0]
)


def commit(lab: MachineStore, *times_s: float, value: float = 1.0) -> None:
    """One step with a window at each time, of two series."""
    ends = [T0 + round(time_s * NS) for time_s in times_s]
    readings = tuple(StoredReading(end, "parameter", name, value, None) for end in ends for name in ("e", "k_by"))
    assert lab.commit(Step(readings=readings))


def stored(store: Store) -> tuple[list[int], int]:
    """Starts of the buckets there are, in buckets since the first, and up to which window readings are in them."""
    with store.database.reading() as connection:
        starts = connection.scalars(buckets.select().with_only_columns(buckets.c.start_ns).order_by(buckets.c.start_ns))
        numbers = connection.scalars(machines.select().with_only_columns(machines.c.bucketed))
        return [(start - T0) // BUCKET for start in starts], numbers.one()


def counts(lab: MachineStore, points: int = 100) -> list[int]:
    return [each.count for each in lab.downsampled(quantity="parameter", names=["e"], points=points)]


@given(st.lists(WINDOW, max_size=4))
def test_readings_are_unpacked_as_they_were_packed(windows: list[list[tuple[int, float, float]]]) -> None:
    arrays = [np.array(each, READING) for each in windows]
    places, found = unpacked([packed(each) for each in arrays], READING)
    assert found.tobytes() == b"".join(each.tobytes() for each in arrays)
    assert places.tolist() == [place for place, each in enumerate(windows) for _ in each]


@pytest.mark.parametrize("first", [-3, 0])
def test_readings_are_summed_by_place_and_series(first: int) -> None:
    readings = np.zeros(6, READING)
    readings["series_id"], readings["value"] = 1_000_000 * np.array([0, 1, 0, 1, 0, 1]), range(1, 7)
    places, made = add_up(singles(readings), first + np.array([0, 0, 0, 1, 1, 1]))
    assert places.tolist() == [first, first, first + 1, first + 1]
    assert made["series_id"].tolist() == [0, 1_000_000] * 2
    assert (made["count"].tolist(), made["total"].tolist()) == ([2, 1, 1, 2], [4.0, 2.0, 5.0, 10.0])


def test_windows_are_added_to_a_bucket_when_the_next_one_begins(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.history.windows._SINGLE", 0)
    lab = store.machine("demo", "lab")
    commit(lab, 10)
    commit(lab, 20)
    assert stored(store) == ([], 0)
    assert counts(lab) == [2]
    commit(lab, 599, 600)
    assert stored(store) == ([0], 3)
    commit(lab, 605)
    assert counts(lab) == [3, 2]
    commit(lab, 30)  # a clock that was set back
    assert stored(store) == ([0, 1], 5)
    commit(lab, 40, 1800, 1900, 3000)
    assert stored(store) == ([0, 1, 3], 9)
    assert counts(lab) == [5, 2, 2, 1]
    commit(lab, 3001, value=math.inf)  # is kept, but part of no mean
    commit(lab, 3600)
    assert stored(store) == ([0, 1, 3, 5], 11)
    assert (counts(lab), counts(lab, points=1)) == ([5, 2, 2, 1, 1], [11])
    assert [one.value for one in lab.readings(quantity="parameter", name="e")] == [1.0] * 10 + [math.inf, 1.0]
    store.reduction.run(T0 + 1000 * 86_400 * NS)
    assert (counts(lab), lab.downsampled(quantity="parameter", points=1)[0].mean) == ([5, 2, 2, 1, 1], 1.0)


def test_a_trend_begins_with_the_first_reading_and_ends_with_the_newest_window(store: Store) -> None:
    lab = store.machine("demo", "lab")
    for time_s in range(0, 100, 10):
        commit(lab, time_s)
    found = lab.downsampled(quantity="parameter", names=["e"], since_ns=T0 - 3600 * NS, points=10)
    assert [one.count for one in found] == [1] * 10
    assert found[0].start_ns == T0
    latest = lab.latest("parameter", "e", span_ns=30 * NS, points=4)
    assert [round((one.start_ns - T0) / NS) for one in latest] == [60, 68, 75, 83]
    assert sum(one.count for one in latest) == 4
    assert lab.latest("parameter", "nothing", span_ns=30 * NS, points=4) == ()
    assert store.machine("demo", "none").latest("parameter", "e", span_ns=30 * NS, points=4) == ()


def test_a_coarse_query_over_many_windows_uses_buckets(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.history.windows._SINGLE_FOR_COARSE", 100)
    lab = store.machine("demo", "lab")
    commit(lab, *range(0, 7200, 60))
    commit(lab, 7260)
    lengths = {
        points: {one.length_ns // NS for one in lab.downsampled(quantity="parameter", names=["e"], points=points)}
        for points in (6, 24, 25)
    }
    assert lengths == {6: {1800}, 24: {600}, 25: {290}}
    assert [sum(counts(lab, points)) for points in (6, 24, 25)] == [121] * 3
    monkeypatch.setattr("service.history.windows._SINGLE_FOR_COARSE", 121)
    assert lab.downsampled(quantity="parameter", names=["e"], points=24)[0].length_ns == 7260 * NS // 24 + 1


def test_readings_count_once_when_the_bucket_length_changes(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.history.windows._SINGLE", 0)
    for number, bucket_s in enumerate((600, 60, 600)):
        with opened(url, Retention(bucket_s=bucket_s)) as store:
            lab = store.machine("demo", "lab")
            for time_s in range(5, 300, 50):
                commit(lab, 300 * number + time_s)
            assert sum(counts(lab)) == 6 * (number + 1)


def test_a_window_with_damaged_readings_is_skipped_and_logged(store: Store, url: str) -> None:
    lab = store.machine("demo", "lab")
    for time_s in (10, 20, 30):
        commit(lab, time_s)
    executed(url, "UPDATE windows SET readings = :damaged WHERE number = 2", damaged=b"(\xb5/\xfd no such frame")
    with capture_logs() as lines:
        commit(lab, 700)
    assert ["the readings of a window are damaged" in line["event"] for line in lines] == [True]
    assert stored(store) == ([0], 3)
    assert [one.number for one in lab.readings(quantity="parameter", name="e")] == [1, 3, 4]
    assert sum(counts(lab)) == 3


def test_a_sparse_series_is_found_page_by_page(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.history.machine._AT_ONCE", 2)
    lab = store.machine("demo", "lab")
    for number in range(12):
        commit(lab, number)
        if number % 5 == 1:
            assert lab.commit(Step(readings=(StoredReading(T0 + number, "misfit", "z", float(number), None),)))
    first = lab.readings(quantity="misfit", name="z", limit=2)
    assert [one.value for one in first] == [1.0, 6.0]
    assert [one.value for one in lab.readings(quantity="misfit", name="z", after=first[-1].number)] == [11.0]
    assert lab.readings(quantity="misfit", name="y") == ()
