"""Messages made to cost more than they weigh."""

import json
from pathlib import Path

import pytest
import structlog

from models.signals.wire import BLOCK_ENCODING
from service.descriptor import MOST_BYTES, MOST_DIFFERENCES, descriptor_mismatch
from tests.service.live import LAB, Feed, endpoint, open_session, service, until
from tests.service.test_alarm_trouble import bench

KB = 1024


def empty_channels(count: int) -> bytes:
    fields = LAB.descriptor.model_dump(mode="json") | {"channels": [{}] * count}
    return json.dumps(fields).encode()


def other_names(length: int) -> bytes:
    fields = LAB.descriptor.model_dump(mode="json")
    channels = [one | {"name": "n" * length + one["name"]} for one in fields["channels"]]
    return json.dumps(fields | {"site": "s" * length, "channels": channels}).encode()


@pytest.mark.parametrize(
    "announced",
    [empty_channels(300_000), empty_channels(10_000), other_names(3_000), b"[" * 60_000, b'"' + b"x" * 60_000],
)
def test_a_descriptor_is_answered_in_few_words(announced: bytes) -> None:
    said = descriptor_mismatch(announced, LAB)
    assert 1 <= len(said) <= MOST_DIFFERENCES + 1
    assert sum(map(len, said)) < 20 * KB
    if len(announced) > MOST_BYTES:
        assert said == (f"descriptor has {len(announced)} bytes, expected at most {MOST_BYTES}",)


def test_a_flood_of_descriptors_is_logged_now_and_then(tmp_path: Path) -> None:
    with bench(tmp_path) as at, structlog.testing.capture_logs() as lines:
        for number in range(200):
            at.worker.descriptor(other_names(number + 1))
        assert len([line for line in lines if "differences" in line]) <= 2


def test_health_stays_small_whatever_is_sent() -> None:
    address = endpoint()
    with service(address) as (_, worker), open_session(address) as session:
        feed = Feed(session)
        feed.put_good()
        feed.put_raw(b"", b"", "text/" + "x" * 200)
        feed.put_raw(b"", b"", f"{BLOCK_ENCODING};" + "y" * 200)
        payload, header = b"\0" * 7200, b"\0" * 32
        feed.put_raw(payload, header, f"{BLOCK_ENCODING};" + "z" * 200)
        feed.put(feed.block(), "h" * 200)
        session.put(LAB.keys.descriptor, empty_channels(300_000))
        until(lambda: sum(worker.health().quality.refused_blocks.values()) == 4, "refusals")
        until(lambda: worker.health().stream.descriptor_mismatch != (), "the descriptor")
        assert len(worker.health().model_dump_json()) < 100 * KB
