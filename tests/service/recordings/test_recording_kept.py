"""Which recordings are kept or dropped, and what the catalogue finds and refuses to find."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.signals.recording import RecordedMessage, RecordingWriter, read_recording, salvaged_messages
from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.example import example
from service.history.records import StoredEvent, StoreError
from service.recordings.catalogue import (
    PART,
    AlarmMark,
    Catalogue,
    Recording,
    alarm_mark,
    decide,
    kept_reasons,
    name_of,
    recent_messages,
    recorded_files,
)
from service.recordings.recorder import MachineRecorder
from service.runtime.runtime import Runtime
from service.settings.service import RecordingSettings
from tests.service.history.test_store import alarm_event
from tests.service.rig.live import (
    LAB,
    PATIENT,
    Feed,
    endpoint,
    feeding,
    machine_file,
    open_session,
    program,
    scenario_blocks,
    settings,
    until,
    worker_of,
)
from tests.service.rig.replaying import recording
from tests.service.runtime.test_survives import do, log
from tests.service.runtime.test_survives import running as monitor_running
from tests.sure import sure

NS = 1_000_000_000
NOW_NS = 1_795_271_130 * NS  # 2026-11-21 14:25:30 UTC
DAY_NS = 86_400 * NS
SAID = AlarmCloudEvent.model_validate(example(AlarmCloudEvent))
ALARM = RecordedMessage(
    LAB.keys.alarm_event, SAID.model_dump_json().encode(), b"", "application/cloudevents+json", NOW_NS, NOW_NS
)
EVENT = alarm_event(0, kind=SAID.data.kind.value, text=SAID.model_dump_json(), recorded_ns=NOW_NS)


def stored(start_s: float, size_mb: float = 100.0, name: str = "", complete: bool = True) -> Recording:
    """Five minutes that begin so many seconds before or after now."""
    start_ns = NOW_NS + round(start_s * NS)
    file = name or name_of(start_ns) + ("" if complete else ".part")
    return Recording(
        id=f"demo/lab/{file}", site="demo", machine="lab", path=Path("/recordings/demo/lab") / file, start_ns=start_ns,
        end_ns=start_ns + 300 * NS, messages=9, size_bytes=round(size_mb * 1e6), complete=complete, kept_because="",
        problem="",
    )  # fmt: skip


def limits(**fields: float) -> RecordingSettings:
    return RecordingSettings.model_validate({"directory": "/recordings", "rotate_mb": 10, **fields})


def names(recordings: list[Recording]) -> list[str]:
    return [one.path.name for one in recordings]


def test_old_files_are_dropped_but_not_unfinished_or_renamed_ones() -> None:
    files = [stored(-3 * 86_400, 0.001), stored(-86_400, 0.001)]
    _, dropped = decide(files, [], limits(keep_days=2), NOW_NS)
    assert [(one.path.name, why) for one, why in dropped] == [
        (name_of(NOW_NS - 3 * DAY_NS), "older than keep_days = 2")
    ]
    files = [stored(-9 * 86_400, complete=False), stored(-9 * 86_400, name="bearing-test.mcap"), stored(-9 * 86_400)]
    _, dropped = decide(files, [], limits(), NOW_NS)
    assert [one for one, _ in dropped] == files[2:]


def test_files_around_an_alarm_have_limits_of_their_own() -> None:
    files = [stored(300.0 * n) for n in range(10)]
    mark = AlarmMark(NOW_NS + 1650 * NS, "raised: k_by")  # in the middle of file 5
    kept, dropped = decide(
        files, [mark], limits(keep_gb=0.1, alarm_before_s=400, alarm_after_s=200, alarm_keep_gb=0.5), NOW_NS
    )
    # 1250 to 1850 s: from file 4 (1200 to 1500 s) to file 6 (1800 to 2100 s); of the others the newest fills 0.1 GB.
    assert sorted(kept) == names(files[4:7])
    assert kept[files[4].path.name] == "2026-11-21 14:53:00 UTC raised: k_by"
    assert dropped == [(one, "beyond keep_gb = 0.1") for one in (*files[:4], *files[7:9])]


def test_files_around_alarms_are_limited_in_size_and_age() -> None:
    files = [stored(300.0 * n) for n in range(10)]
    marks = [AlarmMark(one.start_ns, "raised") for one in files]
    kept, dropped = decide(files, marks, limits(alarm_keep_gb=0.35), NOW_NS)
    assert sorted(kept) == names(files[7:])
    assert [why for _, why in dropped] == ["beyond alarm_keep_gb = 0.35"] * 7
    kept, dropped = decide(files, marks, limits(alarm_keep_days=1), NOW_NS + 2 * DAY_NS)
    assert (len(dropped), kept) == (10, {})


@given(
    sizes=st.lists(st.floats(0.1, 300.0), max_size=30),
    alarms=st.lists(st.integers(-2000, 10_000), max_size=5),
    keep_gb=st.floats(0.1, 2.0),
    alarm_keep_gb=st.floats(0.1, 2.0),
)
def test_limits_hold_and_no_file_is_dropped_without_need(
    sizes: list[float], alarms: list[int], keep_gb: float, alarm_keep_gb: float
) -> None:
    files = [stored(300.0 * n, size) for n, size in enumerate(sizes)]
    marks = [AlarmMark(NOW_NS + s * NS, "raised") for s in alarms]
    settings = limits(keep_gb=keep_gb, alarm_keep_gb=alarm_keep_gb)
    kept, dropped = decide(files, marks, settings, NOW_NS)
    gone = {one.id for one, _ in dropped}

    def near(one: Recording) -> bool:
        return any(one.start_ns - 600 * NS <= mark.time_ns <= one.end_ns + 600 * NS for mark in marks)

    assert set(kept) == {one.path.name for one in files if near(one) and one.id not in gone}
    for group, limit in (([f for f in files if near(f)], alarm_keep_gb), ([f for f in files if not near(f)], keep_gb)):
        left = [one for one in group if one.id not in gone]
        assert sum(one.size_bytes for one in left) <= limit * 1e9
        assert left == group[len(group) - len(left) :]  # always the oldest first
        if len(left) < len(group):
            assert sum(one.size_bytes for one in [group[-len(left) - 1], *left]) > limit * 1e9


def test_the_mark_of_an_alarm_event_has_its_text_or_its_name_if_unreadable() -> None:
    assert alarm_mark(EVENT) == AlarmMark(EVENT.recorded_ns, f"{SAID.data.kind}: {SAID.data.text}")
    for text in ("", "[]", '{"data": 1}', "null"):
        assert alarm_mark(replace(EVENT, text=text)) == AlarmMark(EVENT.recorded_ns, f"{SAID.data.kind}: {EVENT.alarm}")


FEW = {"rotate_mb": 0.1, "keep_gb": 0.0007, "alarm_keep_gb": 1.0, "alarm_before_s": 700, "alarm_after_s": 400}


def record_files(
    directory: Path, first: int, last: int, events: tuple[StoredEvent, ...] = (), away: bool = False
) -> Path:
    """Record one file of 0.3 MB per five minutes, numbered from now on."""
    settings = RecordingSettings.model_validate({"directory": str(directory), **FEW})

    def committed(since_ns: int) -> tuple[StoredEvent, ...]:
        if away:
            raise StoreError("the database is away")
        return tuple(event for event in events if event.recorded_ns >= since_ns)

    recorder = MachineRecorder(LAB, settings, committed, now_ns=lambda: NOW_NS + 3600 * NS)
    rng = np.random.default_rng(first)
    for number in range(first, last):
        time_ns = NOW_NS + 300 * number * NS
        recorder.put(RecordedMessage(LAB.keys.stream, rng.bytes(300_000), b"", "x", time_ns, time_ns))
    recorder.start()
    recorder.stop()
    assert recorder.status().problem == ""
    return recorder.folder


def at_file(number: int) -> StoredEvent:
    return replace(EVENT, recorded_ns=NOW_NS + 300 * number * NS)


def numbers(folder: Path) -> list[int]:
    """Numbers of the files of `record_files` that are there."""
    return [n for n in range(30) if (folder / name_of(NOW_NS + 300 * n * NS)).exists()]


def test_the_recorder_keeps_files_around_an_alarm_when_it_drops_others(tmp_path: Path) -> None:
    events = (at_file(2),)
    folder = record_files(tmp_path, 0, 3, events=events)
    assert numbers(folder) == [0, 1, 2]
    folder = record_files(tmp_path, 3, 12, events=events)
    assert numbers(folder) == [0, 1, 2, 3, 10, 11]
    stated = json.loads((folder / "kept.json").read_text(encoding="utf-8"))
    assert sorted(stated["kept"]) == [name_of(NOW_NS + 300 * n * NS) for n in range(4)]
    assert (stated["alarm_before_s"], stated["alarm_after_s"]) == (700, 400)
    for one in Catalogue(tmp_path).recordings():
        kept = one.path.name in stated["kept"]
        assert ("2026-11-21 14:35:30 UTC raised: ALERT" in one.kept_because) == kept


@pytest.mark.parametrize("lost", ["history", "database", "kept.json"])
def test_kept_files_stay_when_the_history_or_kept_json_is_lost(tmp_path: Path, lost: str) -> None:
    folder = record_files(tmp_path, 0, 3, events=(at_file(1),))
    before = kept_reasons(folder)
    assert len(before) == 3
    if lost == "kept.json":
        (folder / lost).write_text("[broken", encoding="utf-8")
        assert kept_reasons(folder) == {}
    events = (at_file(1),) if lost == "kept.json" else ()
    record_files(tmp_path, 20, 29, events=events, away=lost == "database")
    assert kept_reasons(folder) == before
    assert numbers(folder)[:3] == [0, 1, 2]


def test_a_clock_set_forward_drops_nothing_for_a_day(tmp_path: Path) -> None:
    passed_s, set_days = 0.0, 0

    def now_ns() -> int:
        return NOW_NS + round((passed_s + 86_400 * set_days) * NS)

    recorder = MachineRecorder(
        LAB, RecordingSettings(directory=str(tmp_path), rotate_s=60), lambda _: (), lambda: passed_s, now_ns
    )

    def names() -> list[str]:
        return [one.path.name for one in Catalogue(tmp_path).recordings()]

    def closed(count: int) -> list[str]:
        nonlocal passed_s
        recorder.put(RecordedMessage(LAB.keys.stream, b"x", b"", "x", now_ns(), now_ns()))
        until(lambda: recorder.status().file != "", "a file")
        passed_s += 61.0
        until(lambda: recorder.status().files == count, "a closed file")
        return names()

    recorder.start()
    (first,) = closed(1)
    set_days = 400
    assert first in closed(2)
    assert first in closed(3)
    passed_s += 86_400.0
    closed(4)
    until(lambda: first not in names(), "the oldest file dropped")  # after the file was closed
    recorder.stop()


@contextmanager
def recorded(folder: Path) -> Iterator[tuple[Runtime, Feed]]:
    """A monitor that records, and closes a file after a second."""
    kept = RecordingSettings(directory=str(folder / "kept"), rotate_s=1.0)
    with feeding(settings(endpoint(), machine_file(folder, PATIENT), recording=kept)) as found:
        yield found


def test_a_monitor_keeps_recordings_only_for_its_own_alarms(tmp_path: Path) -> None:
    folder = tmp_path / "kept" / "demo" / "lab"
    with recorded(tmp_path) as (runtime, feed):
        worker = worker_of(runtime)
        recorder = sure(worker.recorder)

        def closed(count: int) -> bool:
            feed.session.put(LAB.keys.alarm_event, ALARM.payload, encoding=ALARM.encoding)
            feed.put_good()
            return recorder.status().files >= count

        until(lambda: closed(2), "two files with forged alarms in them")
        assert worker.history.events() == ()
        assert kept_reasons(folder) == {}
        feed.sequence, feed.start_ns = feed.sequence + 50, feed.start_ns + 5 * NS  # a gap, which raises an alarm

        def raised() -> bool:
            feed.put_good()
            return worker.history.last_sequence >= 0

        until(raised, "an alarm of the monitor's own")
    kept = kept_reasons(folder)
    assert len(kept) == recorder.status().files
    assert all("raised: " in why and SAID.data.text not in why for why in kept.values())


@pytest.mark.slow
def test_a_separate_recorder_keeps_recordings_only_for_alarms_in_the_history(tmp_path: Path) -> None:
    address, folder = endpoint(), tmp_path / "kept" / "demo" / "lab"
    with monitor_running(tmp_path, address, machine_file(tmp_path, PATIENT)) as monitor:
        monitor.url()
        plan = ["--config", str(tmp_path / "monitor.toml"), "--out", str(tmp_path / "kept")]
        history = f"sqlite:///{tmp_path / 'history.sqlite'}"

        def record(kind: str) -> dict[str, str]:
            """Record until an alarm event arrives; return the reasons for files kept afterwards."""
            command = ("service", "record", *plan, "--json")
            with (
                program(tmp_path, *command, ROTORWATCH_HISTORY__URL=history) as recorder,
                open_session(address, "client") as session,
            ):
                recorder.wait_for("}\n")
                before = recorder.latest()["received"]
                if kind == "forged":
                    session.put(LAB.keys.alarm_event, ALARM.payload, encoding=ALARM.encoding)
                else:
                    do(monitor, "shelve", "model", "normal", duration_s=3600)
                until(lambda: recorder.latest()["received"] > before, "the message")
                assert recorder.stop() == 0
            newest = max(folder.glob("*.mcap"))
            assert any(read_recording(newest, keys=[LAB.keys.alarm_event]))
            return kept_reasons(folder)

        assert record("forged") == {}
        assert log(monitor) == []
        kept = record("own")
        assert kept
        assert all("shelved: " in why for why in kept.values())


def write(path: Path, count: int = 3) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with RecordingWriter(path) as writer:
        for number in range(count):
            writer.write(RecordedMessage("k", b"data", b"", "x", NOW_NS + number, NOW_NS))
    return path


def test_the_catalogue_lists_complete_unfinished_and_damaged_recordings(tmp_path: Path) -> None:
    assert Catalogue(tmp_path / "none").recordings() == ()
    write(tmp_path / "a" / "m2" / name_of(NOW_NS))
    write(tmp_path / "a" / "m1" / name_of(NOW_NS, 2))
    write(tmp_path / "a" / "m1" / name_of(NOW_NS), 5)
    write(tmp_path / "b" / "m1" / "import.mcap", 0)
    part = tmp_path / "b" / "m1" / (name_of(NOW_NS) + ".part")
    part.write_bytes(b"unfinished")
    broken = tmp_path / "b" / "m2" / name_of(NOW_NS)
    broken.parent.mkdir()
    broken.write_bytes(b"not a recording")
    for other in ("notes.txt", ".hidden.mcap", "x.mcap.damaged", "kept.json"):
        (tmp_path / "b" / "m1" / other).write_text("x", encoding="utf-8")
    catalogue = Catalogue(tmp_path)
    found = {one.id: one for one in catalogue.recordings()}
    stamp = "20261121T142530Z"
    assert list(found) == [
        f"a/m1/{stamp}.mcap", f"a/m1/{stamp}_002.mcap", f"a/m2/{stamp}.mcap", f"b/m1/{stamp}.mcap.part",
        "b/m1/import.mcap", f"b/m2/{stamp}.mcap",
    ]  # fmt: skip
    first = found[f"a/m1/{stamp}.mcap"]
    assert (first.start_ns, first.end_ns, first.messages, first.complete) == (NOW_NS, NOW_NS + 4, 5, True)
    assert first.size_bytes == first.path.stat().st_size
    unfinished = found[f"b/m1/{stamp}.mcap.part"]
    assert (unfinished.start_ns, unfinished.messages, unfinished.complete) == (NOW_NS, None, False)
    assert "not a recording (MCAP)" in found[f"b/m2/{stamp}.mcap"].problem
    assert [one.id for one in catalogue.recordings(machine="m2")] == [f"a/m2/{stamp}.mcap", f"b/m2/{stamp}.mcap"]
    assert [one.id for one in catalogue.recordings("a", "m2")] == [f"a/m2/{stamp}.mcap"]
    assert catalogue.recordings("a", "..") == ()
    assert all(catalogue.find(key) == one for key, one in found.items())


def test_a_changed_file_is_read_again(tmp_path: Path) -> None:
    path = write(tmp_path / "s" / "m" / "x.mcap")
    catalogue = Catalogue(tmp_path)
    assert catalogue.recordings()[0].messages == 3
    path.unlink()
    assert catalogue.recordings() == ()
    assert catalogue.find("s/m/x.mcap") is None
    write(path, 50)
    assert catalogue.recordings()[0].messages == 50


@pytest.fixture
def with_secret(tmp_path: Path) -> Catalogue:
    """A directory with one recording, and with links to another one outside it."""
    write(tmp_path / "recordings" / "s" / "m" / "good.mcap")
    secret = write(tmp_path / "s" / "m" / "secret.mcap")
    inside = tmp_path / "recordings"
    (inside / "s" / "m" / "link.mcap").symlink_to(secret)
    (inside / "s" / "linked").symlink_to(secret.parent, target_is_directory=True)
    (inside / "linked").symlink_to(tmp_path / "s", target_is_directory=True)
    (inside / "s" / "m" / "folder.mcap").mkdir()
    os.mkfifo(inside / "s" / "m" / "pipe.mcap")
    return Catalogue(inside)


@pytest.mark.parametrize(
    "name",
    [
        *("../s/m/secret.mcap", "s/m/../../../s/m/secret.mcap", "s/../../s/m/secret.mcap", "s/m/..", "../m/good.mcap"),
        *("./s/m/good.mcap", "s/m/./good.mcap", "s//m/good.mcap", "/s/m/good.mcap", "s/m/good.mcap/", ""),
        *("s\\m\\good.mcap", "s/m/good.mcap\n", "s/m/good.mcap\0", "%2e%2e/m/good.mcap"),
        *("s/m/link.mcap", "s/linked/secret.mcap", "linked/m/secret.mcap", "s/m/folder.mcap", "s/m/pipe.mcap"),
        *("s/m/none.mcap", "s/m/.lock", "s/m/kept.json"),
    ],
)
def test_no_id_leads_outside_the_directory(with_secret: Catalogue, name: str) -> None:
    assert with_secret.find(name) is None


def test_links_are_not_listed(with_secret: Catalogue) -> None:
    (good,) = with_secret.recordings()
    assert with_secret.find("s/m/good.mcap") == good
    assert len(list(read_recording(good.path))) == 3


@pytest.mark.parametrize("when", ["before", "while"])
def test_a_part_file_completed_meanwhile_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str) -> None:
    complete = recording(tmp_path / "run.mcap", scenario_blocks(3.0))
    expected = list(read_recording(complete, keys={LAB.keys.stream}))
    part = complete.rename(complete.with_name(complete.name + PART))
    files = recorded_files(tmp_path)
    assert files == (part,)

    def completed(path: Path) -> Iterator[RecordedMessage]:
        part.rename(complete)
        return salvaged_messages(path)

    if when == "before":
        part.rename(complete)
    else:
        monkeypatch.setattr("service.recordings.catalogue.salvaged_messages", completed)
    assert list(recent_messages(files, LAB.keys.stream, 0)) == expected
