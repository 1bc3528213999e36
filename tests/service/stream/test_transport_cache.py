"""What a publisher keeps and what it sends meet without a hole, also when live blocks overtake those that are kept."""

import json
import threading
import time

import pytest
import zenoh
import zenoh.ext

from models.signals.link import LinkSettings
from service.stream.inbox import RawBlock
from tests.loopback import session_of
from tests.service.rig.live import LAB, endpoint, until
from tests.service.stream.test_transport import machine_link

KEPT, LIVE = 300, 60
SIZE = 30_000


@pytest.mark.parametrize("wait", [True, False], ids=["batch run", "live machine"])
def test_kept_and_live_blocks_arrive_each_once(wait: bool) -> None:
    address = endpoint()
    patience = {"transport/link/tx/queue/congestion_control/block/wait_before_close": json.dumps(60_000_000)}
    seen: list[int] = []
    begun = threading.Event()

    def take(block: RawBlock) -> None:
        begun.set()
        seen.append(int.from_bytes(block.payload[:4], "little"))
        time.sleep(0.001)  # slow enough for live blocks to arrive in between

    with session_of(LinkSettings(connect=(address,)), **patience) as session:
        publisher = zenoh.ext.declare_advanced_publisher(
            session,
            LAB.keys.stream,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.DATA_HIGH,
            cache=zenoh.ext.CacheConfig(max_samples=KEPT),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=0.2, sporadic_heartbeat=None),
            publisher_detection=True,
        )
        for number in range(KEPT):
            publisher.put(number.to_bytes(4, "little") * (SIZE // 4))
        with machine_link(address, take, wait=wait):
            until(begun.is_set, "first block")
            for number in range(KEPT, KEPT + LIVE):
                publisher.put(number.to_bytes(4, "little") * (SIZE // 4))
            until(lambda: len(set(seen)) == KEPT + LIVE, "all blocks")
        publisher.undeclare()  # type: ignore[no-untyped-call]
    assert sorted(seen) == list(range(KEPT + LIVE))
