"""Recordings as one stream, and the player: order, repetitions, seeking, pausing, stopping."""

import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from models.errors import MachineFileError, RecordingError
from models.signals.recording import RecordedMessage
from rotorwatch.records.replays import ReplayProgress
from service.recordings.replay.console import obey
from service.recordings.replay.player import Control, PlayPlan, play
from service.recordings.replay.source import RecordingSource, parse_moment
from tests.service.rig.live import until
from tests.service.rig.replaying import write
from tests.sure import sure

SECOND = 10**9
KEY = "rotorwatch/demo/lab/stream"


def message(at_s: float, key: str = KEY, payload: bytes | None = None) -> RecordedMessage:
    text = str(at_s).encode() if payload is None else payload
    return RecordedMessage(key, text, b"", "text/plain", round(at_s * SECOND), round(at_s * SECOND))


def tens(path: Path, begin: int, end: int) -> Path:
    return write(path, [message(at / 10) for at in range(begin, end)])


def times(source: RecordingSource, **where: int) -> list[float]:
    return [one.log_time_ns / SECOND for one in source.messages({KEY}, **where)]


class Taker:
    """Collects replayed messages and runs an action at one of them."""

    def __init__(self, at_s: float = -1.0, action: Callable[[], object] = lambda: None) -> None:
        self.messages: list[RecordedMessage] = []
        self._at_s = at_s
        self._action = action

    def put(self, message: RecordedMessage) -> None:
        self.messages.append(message)
        if message.log_time_ns == round(self._at_s * SECOND):
            self._at_s = -1.0
            self._action()

    @property
    def times(self) -> list[float]:
        return [one.log_time_ns / SECOND for one in self.messages]


def test_files_are_read_in_order_of_time(tmp_path: Path) -> None:
    late, early = tens(tmp_path / "a.mcap", 20, 30), tens(tmp_path / "b.mcap", 10, 20)
    source = RecordingSource([late, early, late])
    assert source.paths == (early, late)
    assert times(source) == [at / 10 for at in range(10, 30)]
    assert times(source, from_ns=15 * SECOND // 10, to_ns=22 * SECOND // 10) == [at / 10 for at in range(15, 22)]
    assert (source.span().start_ns, source.span().end_ns) == (SECOND, 29 * SECOND // 10)


def test_messages_in_two_files_are_read_once(tmp_path: Path) -> None:
    """A capture around an alarm repeats part of the files that it was taken from."""
    files = [tens(tmp_path / "a.mcap", 10, 20), tens(tmp_path / "b.mcap", 15, 25), tens(tmp_path / "c.mcap", 22, 30)]
    assert times(RecordingSource(files)) == [at / 10 for at in range(10, 30)]
    source = RecordingSource([write(tmp_path / "d.mcap", [message(1.0), message(1.0)])])
    assert times(source) == [1.0, 1.0]


def test_a_machine_must_be_named_if_there_are_several(tmp_path: Path) -> None:
    both = write(
        tmp_path / "a.mcap", [message(1.0), message(1.1, "rotorwatch/demo/pump/stream"), message(1.2, "other")]
    )
    source = RecordingSource([both])
    assert [keys.machine for keys in source.machines] == ["lab", "pump"]
    with pytest.raises(MachineFileError, match="machines with sample blocks: demo/lab, demo/pump; name one"):
        source.machine()
    assert source.machine("demo/pump").stream == source.machine("rotorwatch/demo/pump/stream").stream
    with pytest.raises(MachineFileError, match=r"no sample blocks of demo/fan; .* demo/lab, demo/pump"):
        source.machine("demo/fan")


def test_the_descriptor_at_a_time_is_the_latest_before_it(tmp_path: Path) -> None:
    key = "rotorwatch/demo/lab/descriptor"
    said = [message(at, key, str(at).encode()) for at in (1.0, 2.0, 3.0)]
    source = RecordingSource([write(tmp_path / "a.mcap", [message(0.5), *said])])
    for before_s, expected in ((None, b"1.0"), (0, b"1.0"), (2.5, b"2.0"), (9, b"3.0")):
        found = source.descriptor(source.machine(), None if before_s is None else round(before_s * SECOND))
        assert sure(found).payload == expected


@pytest.mark.parametrize("missing", ["absent.mcap", "text.mcap", "empty.mcap: contains no message"])
def test_files_that_are_not_recordings_are_refused(tmp_path: Path, missing: str) -> None:
    (tmp_path / "text.mcap").write_text("no recording", encoding="utf-8")
    write(tmp_path / "empty.mcap", [])
    others = [] if "empty" in missing else [tens(tmp_path / "a.mcap", 1, 2)]
    with pytest.raises(RecordingError, match=missing):
        RecordingSource([*others, tmp_path / missing.partition(":")[0]])


def test_times_are_parsed_in_several_forms() -> None:
    assert parse_moment("+90s", SECOND, "--from") == 91 * SECOND
    assert parse_moment("1970-01-01T01:00:00+01:00", 5, "--from") == 0
    assert parse_moment("1970-01-01T00:00:00.000001", 5, "--from") == 1000
    assert parse_moment("123ns", 5, "--from") == 123
    for text in ("yesterday", "-5", "", "nan", "1e3"):
        with pytest.raises(MachineFileError, match="--to is"):
            parse_moment(text, 0, "--to")


def plan(pace: float | None = None, from_s: float = 0.0, to_s: float = 100.0) -> PlayPlan:
    return PlayPlan({KEY}, pace, round(from_s * SECOND), round(to_s * SECOND))


@pytest.mark.parametrize(
    ("at_s", "order", "where", "expected"),
    [
        (1.0, lambda control: control.seek_by(5.0), plan(), (*range(11), *range(60, 100))),
        (2.0, lambda control: control.seek(SECOND), plan(pace=1000.0), (*range(21), *range(10, 100))),
        (4.0, lambda control: control.seek_by(-60.0), plan(from_s=3.0, to_s=5.0), (*range(30, 41), *range(30, 50))),
        (4.0, lambda control: control.seek_by(60.0), plan(from_s=3.0, to_s=5.0), (*range(30, 41),)),
        (1.0, lambda control: control.stop("enough"), plan(), (*range(11),)),
    ],
    ids=["forward", "back", "before the beginning", "after the end", "stopped"],
)
def test_seek_and_stop_take_effect_at_the_next_message(
    tmp_path: Path, at_s: float, order: Callable[[Control], object], where: PlayPlan, expected: tuple[int, ...]
) -> None:
    source, control = RecordingSource([tens(tmp_path / "a.mcap", 0, 100)]), Control()
    taker = Taker(at_s, lambda: order(control))
    assert play(source, taker.put, where, control) == len(expected)
    assert taker.times == [at / 10 for at in expected]
    assert control.reason == ("enough" if control.stopped else "")


def test_a_paused_replay_reports_seeks_and_does_not_end_at_the_end(tmp_path: Path) -> None:
    source, control = RecordingSource([tens(tmp_path / "a.mcap", 0, 100)]), Control()
    taker, told = Taker(2.0, control.pause), list[ReplayProgress]()
    thread = threading.Thread(target=play, args=(source, taker.put, plan(to_s=10.0), control, told.append), daemon=True)
    thread.start()
    until(lambda: bool(told) and told[-1].paused, "the pause")
    assert told[-1].position_ns == 2 * SECOND
    for place_s in (10, 9):
        control.seek(place_s * SECOND)
        until(partial(lambda place_ns: told[-1].position_ns == place_ns, place_s * SECOND), "the place")
        assert told[-1].paused
    control.resume()
    thread.join()
    assert taker.times == [at / 10 for at in (*range(21), *range(90, 100))]


def test_a_paused_replay_waits_and_its_clock_stops() -> None:
    control = Control()
    control.pause()
    now_s = control.now_s()
    control.pause()
    assert control.now_s() == now_s
    assert control.paused
    control.seek(5)  # is accepted all the same
    assert not control.wait_until(None)
    assert control.take_seek() == 5
    assert control.take_seek() is None
    control.resume()
    assert control.wait_until(now_s)
    control.stop()
    assert not control.wait_until(None)


def test_text_commands_control_a_replay() -> None:
    control = Control()
    control.at(10 * SECOND)
    for order in ("fly", "pause now", "seek", "seek soon", "seek +x", "seek 1e5", ""):
        assert not obey(control, order)
    assert obey(control, "pause\n")
    assert control.paused
    assert obey(control, "resume")
    assert not control.paused
    assert obey(control, "seek -2.5")
    assert obey(control, "seek +1")  # relative to the pending seek, not to the current position
    assert control.take_seek() == 85 * SECOND // 10
    assert obey(control, "seek 42")
    assert control.take_seek() == 42
    assert obey(control, "stop")
    assert control.stopped
