"""Recordings that a monitor keeps."""

from pydantic import Field

from rotorwatch.records.fields import Record


class RecordingEntry(Record):
    """One recording."""

    id: str = Field(description="site, machine and file name", examples=["demo/lab/20260101T000000Z.mcap"])
    site: str = Field(description="site of the machine", examples=["demo"])
    machine: str = Field(description="name of the machine", examples=["lab"])
    start_ns: int = Field(description="when the first message was recorded", examples=[1767225600000000000])
    end_ns: int = Field(description="when the last message was recorded", examples=[1767225900000000000])
    messages: int | None = Field(description="number of messages; null if incomplete or damaged", examples=[3001])
    size_bytes: int = Field(description="size of the file", examples=[19231007])
    complete: bool = Field(
        description="false for a file that is being written, or was left by a crash", examples=[True]
    )
    kept_because: str = Field(description="alarm that keeps it longer; empty if none", examples=[""])
    problem: str = Field(description="why it cannot be read; empty if it can", examples=[""])
    data_start_ns: int | None = Field(
        default=None,
        description="time of the earliest data, from which a replay may begin; null if incomplete or damaged, and in "
        "a list unless requested with `data_times`",
        examples=[1767225600000000000],
    )
    data_end_ns: int | None = Field(default=None, description="end of the latest data", examples=[1767225900000000000])


class RecordingDetail(RecordingEntry):
    """One recording with its contents: messages by key, and the time span of the data."""

    keys: dict[str, int] = Field(
        description="messages by key; empty if incomplete or damaged", examples=[{"rotorwatch/demo/lab/stream": 3000}]
    )


class RecordingList(Record):
    """Recordings by site, machine and time."""

    recordings: tuple[RecordingEntry, ...] = Field(description="by site, machine and time")
