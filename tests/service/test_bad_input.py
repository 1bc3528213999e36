"""Every reason for refusing a block, sent over a real session to a running service, which must carry on."""

import json
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from models.ingest import Reason
from models.signals.block import SampleBlock
from models.signals.wire import BLOCK_ENCODING, encode_block
from service.runtime import Runtime
from service.stream.worker import MachineWorker
from tests.service.live import LAB, Feed, endpoint, open_session, service, until

HASH = LAB.descriptor.schema_hash


def with_nan(block: SampleBlock) -> SampleBlock:
    samples = block.samples.copy()
    samples[12, 3] = np.nan
    return SampleBlock(block.start_ns, block.sequence, block.run, block.rate_hz, samples)


def raw(feed: Feed, *, payload: bytes | None = None, header: bytes | None = None, encoding: str | None = None) -> None:
    good = encode_block(feed.block(), HASH)
    feed.put_raw(
        good[0] if payload is None else payload,
        good[1] if header is None else header,
        good[2] if encoding is None else encoding,
    )


BAD: dict[str, tuple[Reason, Callable[[Feed], None], str]] = {
    "empty": (Reason.MALFORMED, lambda feed: raw(feed, payload=b""), "payload has 0 bytes, expected 7200"),
    "no header": (Reason.MALFORMED, lambda feed: raw(feed, header=b""), "header (attachment) has 0 bytes, expected 32"),
    "cut off": (Reason.MALFORMED, lambda feed: raw(feed, payload=bytes(7199)), "payload has 7199 bytes"),
    "other encoding": (Reason.MALFORMED, lambda feed: raw(feed, encoding="text/plain"), "encoding 'text/plain' is not"),
    "noise as header": (Reason.MALFORMED, lambda feed: raw(feed, header=bytes(range(200, 232))), "header field dtype"),
    "JSON": (Reason.MALFORMED, lambda feed: raw(feed, payload=b'{"y1": 1}', header=b""), "header (attachment)"),
    "not Arrow": (
        Reason.MALFORMED,
        lambda feed: raw(feed, payload=b"x" * 99, encoding="application/vnd.apache.arrow.stream"),
        "Arrow stream",
    ),
    "hash": (Reason.CHANNELS, lambda feed: feed.put(feed.block(), "0123456789ab"), f"expected {HASH}"),
    "channel missing": (
        Reason.CHANNELS,
        lambda feed: feed.put(feed.block(samples=feed.samples()[:, :8]), ""),
        "has 8 channels, expected 9",
    ),
    "rate": (Reason.RATE, lambda feed: feed.put(feed.block(rate_hz=2048.0)), "has rate_hz 2048, expected 2000"),
    "too long": (
        Reason.SHAPE,
        lambda feed: feed.put(feed.block(samples=feed.samples(5000))),
        "has 5000 samples (2.5 s)",
    ),
    "NaN": (Reason.NOT_FINITE, lambda feed: feed.put(with_nan(feed.block())), "channel z1_dot: sample 12 is nan"),
    "repeated": (
        Reason.OVERLAP,
        lambda feed: feed.put(feed.block(sequence=feed.sequence - 1, start_ns=feed.start_ns - 300_000_000)),
        "a repetition or out of order",
    ),
    "two versions": (
        Reason.CONFLICT,
        lambda feed: feed.put(feed.block(sequence=feed.sequence - 1, start_ns=feed.start_ns - 100_000_000)),
        "came in two versions",
    ),
    "number skipped": (Reason.SEQUENCE, lambda feed: feed.put(feed.block(sequence=feed.sequence + 5)), "sequence is"),
    "clock set back": (
        Reason.PAST,
        lambda feed: feed.put(feed.block(start_ns=feed.start_ns - 60_000_000_000)),
        "60 s before what was received",
    ),
    "clock far ahead": (
        Reason.FUTURE,
        lambda feed: feed.put(feed.block(start_ns=feed.start_ns + 7200_000_000_000)),
        "lies 7200 s ahead, expected at most 3600 s",
    ),
}


@pytest.fixture(scope="module")
def fed() -> Iterator[tuple[Runtime, MachineWorker, Feed]]:
    address = endpoint()
    with service(address) as (runtime, worker), open_session(address) as session:
        feed = Feed(session)
        feed.put_good()
        until(lambda: worker.health().quality.accepted_blocks > 0, "first block")
        yield runtime, worker, feed


def test_every_reason_is_covered() -> None:
    assert {reason for reason, _, _ in BAD.values()} == set(Reason)


@pytest.mark.parametrize("name", BAD)
def test_refused_explained_and_carried_on(fed: tuple[Runtime, MachineWorker, Feed], name: str) -> None:
    runtime, worker, feed = fed
    reason, put_bad, text = BAD[name]
    before = worker.health().quality
    put_bad(feed)
    until(lambda: worker.health().quality.refused_blocks != before.refused_blocks, "refusal")
    refused = worker.health().quality
    assert refused.refused_blocks == before.refused_blocks | {reason: before.refused_blocks.get(reason, 0) + 1}
    assert text in refused.last_refusal
    assert refused.last_refusal.startswith("demo/lab: ")
    assert refused.accepted_blocks == before.accepted_blocks
    feed.put_good()
    until(lambda: worker.health().quality.accepted_blocks == before.accepted_blocks + 1, "good block after the bad one")
    after = worker.health().quality
    assert after.gaps == before.gaps
    assert after.last_refusal == refused.last_refusal
    assert worker.errors == 0
    assert runtime.readiness().ready


def test_a_flood_of_rubbish_leaves_the_service_standing(fed: tuple[Runtime, MachineWorker, Feed]) -> None:
    runtime, worker, feed = fed
    before = worker.health().quality
    rng = np.random.default_rng(11)
    for _ in range(300):
        feed.put_raw(rng.bytes(int(rng.integers(0, 9000))), rng.bytes(32), f"{BLOCK_ENCODING};{HASH}")
    feed.put_good()
    until(lambda: worker.health().quality.accepted_blocks == before.accepted_blocks + 1, "good block after the flood")
    after = worker.health().quality
    assert sum(after.refused_blocks.values()) == sum(before.refused_blocks.values()) + 300
    assert worker.errors == 0
    assert runtime.readiness().ready


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"rate_hz": 2048.0}, "rate_hz is 2048.0, expected 2000.0"),
        ({"dtype": "float64"}, "dtype is 'float64', expected 'float32'"),
        ({"machine": "pump"}, "machine is 'pump', expected 'lab'"),
        ({"channels": None}, "channels.2.unit (y1_dot) is 'm/s', expected 'mm/s'"),
        ({"rate_hz": "fast"}, "descriptor cannot be read: rate_hz"),
    ],
)
def test_descriptor_that_differs_is_named(
    fed: tuple[Runtime, MachineWorker, Feed], change: dict[str, object], named: str
) -> None:
    _, worker, feed = fed
    announced = LAB.descriptor.model_dump(mode="json")
    if "channels" in change:
        announced["channels"][2]["unit"] = "m/s"
    else:
        announced |= change
    feed.session.put(LAB.keys.descriptor, json.dumps(announced))
    until(lambda: any(named in text for text in worker.health().stream.descriptor_mismatch), named)
    feed.session.put(LAB.keys.descriptor, LAB.descriptor.model_dump_json())
    until(lambda: worker.health().stream.descriptor_mismatch == (), "end of the mismatch")
