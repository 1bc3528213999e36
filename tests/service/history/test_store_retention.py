"""What is dropped and when; reduced readings agree with numpy."""

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from pydantic import ValidationError

from service.history.machine import MachineStore
from service.history.records import Dropped, Retention, Step, StoredBucket, StoredReading, StoredReport
from service.history.store import Store
from tests.service.history.test_store import AUDIT, T0, alarm_event
from tests.service.rig.postgres import KINDS, database_url, opened
from tests.sure import sure

NS = 1_000_000_000
DAY = 86_400 * NS
HOP = 5 * NS
RETENTION = Retention(reports_days=14, readings_days=90, bucket_s=600, buckets_days=1000)


@dataclass(slots=True)
class Clock:
    now_ns: int = field(default=T0)

    def __call__(self) -> int:
        return self.now_ns


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture(params=KINDS)
def store(request: pytest.FixtureRequest, tmp_path: Path, clock: Clock) -> Iterator[Store]:
    with opened(database_url(request.param, tmp_path), RETENTION, now_ns=clock) as made:
        yield made


@dataclass(frozen=True, slots=True)
class Written:
    """What was written: ends of windows, values and errors of two parameters."""

    ends: npt.NDArray[np.int64]
    values: dict[str, npt.NDArray[np.float64]]
    errors: dict[str, npt.NDArray[np.float64]]

    def part(self, chosen: slice | npt.NDArray[np.bool_]) -> "Written":
        values, errors = ({name: one[chosen] for name, one in each.items()} for each in (self.values, self.errors))
        return Written(self.ends[chosen], values, errors)


def write(lab: MachineStore, clock: Clock, hops: int, per_step: int = 40) -> Written:
    """Readings of many hops; the clock follows the data."""
    rng = np.random.default_rng(8)
    ends = T0 + HOP * np.arange(1, hops + 1) + rng.integers(0, NS, hops)
    values = {"k_by": rng.standard_normal(hops), "e": 1e6 + rng.standard_normal(hops)}
    errors = {"k_by": rng.uniform(0.01, 0.1, hops), "e": np.full(hops, np.nan)}
    errors["k_by"][::7] = np.nan
    for first in range(0, hops, per_step):
        chosen = range(first, min(first + per_step, hops))
        clock.now_ns = int(ends[chosen[-1]])
        readings = tuple(
            StoredReading(
                int(ends[n]), "parameter", name, float(values[name][n]),
                None if np.isnan(errors[name][n]) else float(errors[name][n]),
            )
            for n in chosen
            for name in values
        )  # fmt: skip
        reports = tuple(StoredReport(0, int(ends[n]), "healthy", 1.0, f"{n}") for n in chosen)
        assert lab.commit(Step(reports=reports, readings=readings))
    return Written(ends, values, errors)


def by_numpy(written: Written, name: str, places: npt.NDArray[np.int64], grid: StoredBucket) -> list[StoredBucket]:
    """Expected buckets on the grid of another one; `places` are the times that assign readings to buckets."""
    expected = []
    numbers = (places - grid.start_ns) // grid.length_ns
    for number in np.unique(numbers):
        inside = numbers == number
        value, error = written.values[name][inside], written.errors[name][inside]
        error = error[~np.isnan(error)]
        expected.append(
            StoredBucket(
                name=name, start_ns=int(grid.start_ns + number * grid.length_ns), length_ns=grid.length_ns,
                count=int(inside.sum()), minimum=float(value.min()), mean=float(value.mean()),
                maximum=float(value.max()),
                mean_standard_error=float(error.mean()) if len(error) else None,
            )
        )  # fmt: skip
    return expected


def assert_same(found: list[StoredBucket], expected: list[StoredBucket]) -> None:
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        exact = ("name", "start_ns", "length_ns", "count", "minimum", "maximum")
        assert [getattr(one, each) for each in exact] == [getattr(other, each) for each in exact]
        assert one.mean == pytest.approx(other.mean, rel=1e-12, abs=1e-12)
        assert one.mean_standard_error == (
            None if other.mean_standard_error is None else pytest.approx(other.mean_standard_error, rel=1e-12)
        )


def test_downsampling_agrees_with_numpy(store: Store, clock: Clock) -> None:
    lab = store.machine("demo", "lab")
    written = write(lab, clock, 600)
    for points in (1, 7, 300, 5000):
        found = lab.downsampled(quantity="parameter", points=points)
        assert [bucket.name for bucket in found] == sorted(bucket.name for bucket in found)
        for name in ("e", "k_by"):
            of_name = [bucket for bucket in found if bucket.name == name]
            assert len(of_name) <= points
            assert_same(of_name, by_numpy(written, name, written.ends, of_name[0]))
    # And between bounds, of one parameter.
    since, until = int(written.ends[100]), int(written.ends[500])
    found = lab.downsampled(quantity="parameter", names=["k_by"], since_ns=since, until_ns=until, points=11)
    part = written.part(slice(100, 500))
    assert found[0].start_ns == since
    assert_same(list(found), by_numpy(part, "k_by", part.ends, found[0]))
    assert lab.downsampled(quantity="parameter", names=["EI"]) == lab.downsampled(quantity="equation") == ()
    assert lab.downsampled(quantity="parameter", since_ns=until, until_ns=since) == ()


def test_reduced_and_remaining_readings_form_one_trend(store: Store, clock: Clock) -> None:
    lab = store.machine("demo", "lab")
    written = write(lab, clock, 1500)
    assert store.reduction.run(clock.now_ns) == Dropped()
    middle = int(written.ends[737])
    dropped = store.reduction.run(middle + 90 * DAY)
    assert dropped.windows == 720  # in steps of 40; the step of the window at that time is younger
    left = lab.readings(quantity="parameter", name="k_by", limit=5000)
    assert [reading.end_ns for reading in left] == list(written.ends[720:])
    for name in ("e", "k_by"):
        found = [bucket for bucket in lab.downsampled(quantity="parameter", points=1500) if bucket.name == name]
        assert {(bucket.length_ns, bucket.start_ns % (600 * NS)) for bucket in found} == {(600 * NS, 0)}
        assert sum(bucket.count for bucket in found) == 1500
        assert_same(found, by_numpy(written, name, written.ends, found[0]))
    # The rest is reduced in two parts that meet within a bucket; merged buckets agree as well.
    store.reduction.run(int(written.ends[1111]) + 90 * DAY)
    store.reduction.run(int(written.ends[-1]) + 90 * DAY + 1)
    assert not lab.readings(quantity="parameter", name="k_by")
    for name in ("e", "k_by"):
        found = [bucket for bucket in lab.downsampled(quantity="parameter", points=9) if bucket.name == name]
        assert len(found) <= 9
        starts = written.ends // (600 * NS) * (600 * NS)
        assert_same(found, by_numpy(written, name, starts, found[0]))


def test_a_trend_of_many_windows_uses_buckets(store: Store, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.history.windows._SINGLE", 100)
    lab = store.machine("demo", "lab")
    written = write(lab, clock, 1500)
    bounds = (None, int(written.ends[137])), (int(written.ends[137]), int(written.ends[1301])), (None, None)
    for since, until in (*bounds, (int(written.ends[137]), None)):
        inside = (written.ends >= (since or 0)) & (written.ends < (until or 2**63 - 1))
        part = written.part(inside)
        found = lab.downsampled(quantity="parameter", since_ns=since, until_ns=until, points=300)
        assert {(bucket.length_ns, bucket.start_ns % (600 * NS)) for bucket in found} == {(600 * NS, 0)}
        for name in ("e", "k_by"):
            of_name = [bucket for bucket in found if bucket.name == name]
            assert_same(of_name, by_numpy(part, name, part.ends, of_name[0]))
    few = lab.downsampled(
        quantity="parameter", since_ns=int(written.ends[0]), until_ns=int(written.ends[99]), points=33
    )
    assert few[0].start_ns == written.ends[0]


def test_everything_expires_except_alarm_events_and_audit_entries(store: Store, clock: Clock) -> None:
    lab = store.machine("demo", "lab")
    assert lab.commit(Step(events=(alarm_event(0),)))
    store.audit.append(**AUDIT)
    write(lab, clock, 1200, per_step=1200 // 8)
    written = T0 + 1200 * HOP + NS
    assert store.reduction.run(written + 13 * DAY) == Dropped()
    assert store.reduction.run(written + 14 * DAY) == Dropped(reports=1200)
    assert lab.reports() == ()
    assert store.reduction.run(written + 90 * DAY).windows == 1200
    n_buckets = len({bucket.start_ns for bucket in lab.downsampled(quantity="parameter", points=5000)})
    assert n_buckets > 0
    assert store.reduction.run(written + 999 * DAY) == Dropped()
    assert store.reduction.run(written + 1000 * DAY) == Dropped(buckets=n_buckets)
    assert (lab.downsampled(quantity="parameter"), lab.events()) == ((), (alarm_event(0),))
    assert len(store.audit.entries()) == 1


def test_a_clock_set_forward_drops_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.history.reduction._EVERY_S", 0.001)
    looked, clock = threading.Semaphore(0), Clock()

    def now_ns() -> int:
        looked.release()
        return clock()

    with opened(database_url("sqlite", tmp_path), RETENTION, now_ns=now_ns) as store:
        lab = store.machine("demo", "lab")
        write(lab, clock, 100)
        clock.now_ns += 400 * DAY
        for _ in range(100):
            assert looked.acquire(timeout=60.0)
        assert len(lab.readings(quantity="parameter", name="k_by", limit=1000)) == 100


def test_readings_written_during_a_reduction_are_kept(store: Store, clock: Clock) -> None:
    lab = store.machine("demo", "lab")
    write(lab, clock, 2000, per_step=400)
    stop, numbers = threading.Event(), iter(range(1_000_000))

    def feed() -> int:
        written = 0
        while not stop.is_set():
            clock.now_ns = T0 + 90 * DAY
            end_ns = clock.now_ns + next(numbers)
            assert lab.commit(Step(readings=(StoredReading(end_ns, "parameter", "k_by", 1.0, None),)))
            written += 1
        return written

    with ThreadPoolExecutor(1) as pool:
        feeding = pool.submit(feed)
        dropped = store.reduction.run(T0 + 91 * DAY)
        stop.set()
        fed = feeding.result()
    assert dropped.windows == 2000
    assert len(lab.readings(quantity="parameter", name="k_by", limit=1_000_000)) == fed
    total = sum(bucket.count for bucket in lab.downsampled(quantity="parameter", names=["k_by"], points=1000))
    assert total == 2000 + fed


@pytest.mark.parametrize(
    "fields", [{"reports_days": 0}, {"readings_days": -1}, {"bucket_s": 0}, {"bucket_s": 90_000}, {"keep": 1}]
)
def test_invalid_retention_settings_are_refused(fields: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        Retention.model_validate(fields)


def test_status_states_how_far_back_the_history_goes(store: Store) -> None:
    lab, idle = store.machine("demo", "lab"), store.machine("demo", "idle")
    assert idle.last_sequence == -1
    empty = store.status()
    assert [one.machine for one in empty.machines] == ["idle", "lab"]
    assert all(one.oldest_reading_ns is None for one in empty.machines)
    first, reported = T0 + HOP, T0 + 20 * DAY
    reading, report = StoredReading(first, "parameter", "e", 1.0, None), StoredReport(0, reported, "healthy", 1.0, "{}")
    assert lab.commit(Step(readings=(reading,), events=(alarm_event(0),)))
    assert lab.commit(Step(reports=(report,)))
    found = store.status()
    told = found.machines[1]
    assert (told.oldest_event_ns, told.oldest_report_ns) == (T0, reported)
    assert first - RETENTION.bucket_s * NS < sure(told.oldest_reading_ns) <= first
    assert found.machines[0] == empty.machines[0]
    assert (found.reports_days, found.readings_days, found.buckets_days) == (14.0, 90.0, 1000.0)
    assert found.size_bytes >= empty.size_bytes > 10_000
