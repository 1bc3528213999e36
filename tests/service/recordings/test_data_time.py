"""Times are data times: streams that came faster than real time, and restarted publishers."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from models.signals.block import SampleBlock
from models.signals.recording import RecordedMessage, read_recording
from models.signals.wire import decode_block
from rotorwatch.records.replays import ReplayProgress
from service.analysis.recorded import Recorded
from service.analysis.spectrum import read_spectrum, read_waterfall
from service.recordings.replay.player import Control, PlayPlan, play
from service.recordings.replay.source import RecordingSource, data_start_ns
from tests.service.rig.live import LAB, START_NS, scenario_blocks
from tests.service.rig.replaying import hurried, recording, split, write

S = 10**9


@pytest.fixture(scope="module")
def blocks() -> list[SampleBlock]:
    return scenario_blocks(40.0)


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory, blocks: list[SampleBlock]) -> Path:
    return recording(tmp_path_factory.mktemp("slow") / "same.mcap", blocks)


@pytest.fixture(scope="module")
def quick(slow: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recorded in 2 s, years later."""
    return hurried(slow, tmp_path_factory.mktemp("quick") / "same.mcap")


@pytest.fixture(scope="module")
def twice(tmp_path_factory: pytest.TempPathFactory, blocks: list[SampleBlock]) -> Path:
    """A run of 30 s, then a second one that begins 10 s after the start of the first."""
    again = [replace(one, run=9, sequence=number) for number, one in enumerate(blocks[100:250])]
    messages = [
        message
        for path in (
            recording(tmp_path_factory.mktemp("first") / "a.mcap", blocks[:300]),
            recording(tmp_path_factory.mktemp("second") / "b.mcap", again),
        )
        for message in read_recording(path)
    ]
    ordered = [replace(one, log_time_ns=START_NS + number * S // 10) for number, one in enumerate(messages)]
    return write(tmp_path_factory.mktemp("twice") / "twice.mcap", ordered)


def starts_s(source: RecordingSource, **limits: int) -> list[float]:
    found = source.messages({LAB.keys.stream}, **limits)
    return [(decode_block(one.payload, one.attachment, one.encoding).start_ns - START_NS) / S for one in found]


def stream_of(path: Path) -> Recorded:
    source = RecordingSource([path])
    return Recorded(source, LAB.keys, *source.between(None, None))


def test_a_source_selects_by_data_time(quick: Path, tmp_path: Path) -> None:
    for files in ([quick], split(quick, tmp_path, 150)):
        source = RecordingSource(files)
        assert (source.span().start_ns, source.span().end_ns) == (START_NS, START_NS + 40 * S)
        assert starts_s(source, from_ns=START_NS + 12 * S, to_ns=START_NS + 15 * S) == [n / 10 for n in range(120, 150)]
        assert source.between("12", "2026-01-01T00:00:15Z") == (START_NS + 12 * S, START_NS + 15 * S)


def test_messages_between_blocks_take_the_time_of_their_block(quick: Path, tmp_path: Path) -> None:
    """A descriptor before the first block, a report after one, and a message of no machine."""
    messages = list(read_recording(quick))
    late = messages[200].log_time_ns
    report = RecordedMessage(LAB.keys.report, b"{}", b"", "application/json", late, late)
    other = replace(report, key="weather")
    source = RecordingSource([write(tmp_path / "more.mcap", [*messages[:201], report, other, *messages[201:]])])
    timed = {message.key: time_ns for time_ns, message in source.timed() if message.key != LAB.keys.stream}
    assert timed == {LAB.keys.descriptor: START_NS, LAB.keys.report: START_NS + round(19.9 * S), "weather": late}


def test_reports_without_samples_have_data_times(tmp_path: Path) -> None:
    said = [
        RecordedMessage(LAB.keys.report, json.dumps({"end_ns": START_NS + at * S}).encode(), b"", "", at, at)
        for at in (60, 65, 70)
    ]
    source = RecordingSource([write(tmp_path / "reports.mcap", said)])
    assert list(source.messages(from_ns=START_NS + 60 * S, to_ns=START_NS + 70 * S)) == said[1:]
    assert source.span().end_ns == START_NS + 70 * S


def test_a_recording_of_two_overlapping_runs_has_the_span_of_both(twice: Path) -> None:
    source = RecordingSource([twice])
    span = source.span(LAB.keys)
    assert ((span.start_ns - START_NS) / S, (span.end_ns - START_NS) / S) == (0, 30)
    assert ((span.first_ns - START_NS) / S, (span.newest_ns - START_NS) / S) == (0, 25)
    assert starts_s(source, from_ns=START_NS + 24 * S, to_ns=START_NS + 26 * S) == pytest.approx(
        [*(n / 10 for n in range(240, 260)), *(n / 10 for n in range(240, 250))]
    )


@pytest.mark.parametrize(
    ("name", "latest_s", "averages", "hop_s", "starts_s"),
    [
        ("slow", (20, 40), 19, 4, range(0, 40, 4)), ("quick", (20, 40), 19, 4, range(0, 40, 4)),
        ("twice", (10, 25), None, 5, range(0, 25, 5)),
    ],
)  # fmt: skip
def test_spectra_are_of_the_latest_data_and_of_the_later_of_two_runs(
    name: str, latest_s: tuple[int, int], averages: int | None, hop_s: float, starts_s: range,
    request: pytest.FixtureRequest,
) -> None:  # fmt: skip
    stream = stream_of(request.getfixturevalue(name))
    found = read_spectrum(stream, stream.chosen(()), 20.0, 0.5, "amplitude")
    assert ((found.start_ns - START_NS) / S, (found.end_ns - START_NS) / S) == latest_s
    assert found.averages == (averages or found.averages)
    fall = read_waterfall(stream, stream.chosen(())[0], hop_s, 0.5, "amplitude")
    assert ((fall.start_ns - START_NS) / S).tolist() == list(starts_s)


class Timed(Control):
    """Does not wait, but notes how long it would have waited."""

    def __init__(self) -> None:
        super().__init__()
        self.due_s: list[float] = []

    def wait_until(self, deadline_s: float | None, on_pause: Callable[[], None] | None = None) -> bool:
        self.due_s.append(deadline_s or 0.0)
        return super().wait_until(None, on_pause)

    def now_s(self) -> float:
        return 100.0


def played(path: Path, **limits: int) -> tuple[list[float], list[ReplayProgress]]:
    source, control, progress = RecordingSource([path]), Timed(), list[ReplayProgress]()
    span = source.span()
    where = {"from_ns": span.start_ns, "to_ns": span.end_ns + 1} | limits
    play(source, lambda _: None, PlayPlan({LAB.keys.stream}, 2.0, **where), control, progress.append)
    return [due_s - 100.0 for due_s in control.due_s], progress


def test_a_paced_replay_follows_data_time(quick: Path) -> None:
    due_s, progress = played(quick, from_ns=START_NS + 10 * S, to_ns=START_NS + 100 * S)
    assert due_s == pytest.approx([number / 20 for number in range(300)])
    assert (progress[0].fraction, progress[-1].fraction) == (0.0, 1.0)


def test_a_paced_replay_does_not_wait_at_a_restart_or_a_long_gap_in_the_data(
    twice: Path, blocks: list[SampleBlock], tmp_path: Path
) -> None:
    due_s, _ = played(twice)
    assert due_s[:300] == pytest.approx([number / 20 for number in range(300)])
    assert due_s[299:310] == pytest.approx([due_s[299]] * 11)
    assert due_s[-1] == pytest.approx((299 + 139) / 20)
    day = [replace(one, start_ns=one.start_ns + 86_400 * S) for one in blocks[10:20]]
    due_s, _ = played(recording(tmp_path / "night.mcap", [*blocks[:10], *day]))
    assert due_s == pytest.approx([*(n / 20 for n in range(10)), *(n / 20 for n in range(9, 19))])


@pytest.mark.parametrize("end", ["1e999", "NaN", "[" * 50_000, "9" * 4000, "-1", '"soon"'])
def test_a_report_without_a_valid_time_has_no_data_time(end: str) -> None:
    odd = RecordedMessage(LAB.keys.report, f'{{"end_ns": {end}}}'.encode(), b"", "", 5, 5)
    assert data_start_ns(odd) is None
