"""What was recorded before a monitor ended, while the recorder of the next one tidies up."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from models.signals.recording import RecordedMessage, read_recording
from models.signals.salvage import salvaged_messages
from service.recordings.catalogue import PART
from service.recordings.recent import recent_messages, recorded_files
from tests.service.live import LAB, scenario_blocks
from tests.service.replaying import recording


@pytest.mark.parametrize("when", ["before", "while"])
def test_a_part_that_is_completed_meanwhile_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str) -> None:
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
        monkeypatch.setattr("service.recordings.recent.salvaged_messages", completed)
    assert list(recent_messages(files, LAB.keys.stream, 0)) == expected
