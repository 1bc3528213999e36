"""Publishes a simulated stream over Zenoh; the only module of the simulator that does.

::

    waiting for a subscriber ──> sending ──> draining ──> closed
                │                   │
                └──── stop ─────────┴─────────────────────^

An unpaced stream that waited for its subscriber waits again if it is lost, so that it can fetch what it missed.
Draining matters because closing a Zenoh session discards what has not been delivered yet: several megabytes after an
unpaced run.
"""

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Event
from typing import NamedTuple

import zenoh
import zenoh.ext

from models.errors import MachineFileError, RotorwatchError
from models.machine import MachineFile
from models.signals.link import LinkSettings
from simulator.stream import JSON_ENCODING, BlockEncoding, BlockStream, RunSummary, block_message, descriptor_payload

_CACHE_BLOCKS = 1200  # two minutes in blocks of 0.1 s: a window, and the time that a monitor takes to come back
_CACHE_TRUTH = 100
_HEARTBEAT_S = 0.5
_POLL_S = 0.02
_SUBSCRIBER_CHECK_S = 2.0
_BLOCKED_US = 20_000_000


class PublishError(RotorwatchError):
    """The stream could not be published: no session, or no subscriber in time."""


@dataclass(frozen=True, slots=True)
class PublishSettings:
    """How to publish."""

    link: LinkSettings
    pace: float | None = 1.0  # data seconds per second; None is as fast as the subscribers take it
    encoding: BlockEncoding = "raw"
    wait_for_subscriber_s: float | None = None  # hold the first block back until someone subscribes, at most this long
    # How long the session stays open after the last block, so that a subscriber can fetch what it missed.
    linger_s: float = 2.0
    drain_s: float = 60.0  # how long a monitor may take to catch up with an unpaced stream before the session closes


def publish(
    machine: MachineFile,
    stream: BlockStream,
    settings: PublishSettings,
    *,
    stop: Event | None = None,
    on_block: Callable[[RunSummary], None] | None = None,
) -> RunSummary:
    """Publish descriptor, truth and blocks of one machine until the stream ends or `stop` is set.

    Blocks go out when their last sample would have been taken, so that pace 1 behaves like a real machine. The stream
    is not advanced before a subscriber is there, if one is waited for; without a pace, that holds for every block. When
    `stop` is set, publishing ends before the next block and the session closes at once.

    Raises
    ------
    MachineFileError
        If an endpoint is malformed, or a password, certificate or key cannot be used.
    PublishError
        If the session cannot be opened, or nobody subscribed in time.
    """
    stop = Event() if stop is None else stop
    with _session(settings) as session, _declared(session, machine, settings.pace) as outlets:
        # The advanced publisher does not say whether it has subscribers; a plain one on the same key does.
        probe = session.declare_publisher(machine.keys.stream)

        def wait_for_subscriber() -> None:
            timeout_s, began_s = settings.wait_for_subscriber_s, time.monotonic()
            while timeout_s is not None and not _heard(probe) and not stop.wait(_POLL_S):
                if time.monotonic() - began_s > timeout_s:
                    why = ""
                    if session.info.peers_zid() or session.info.routers_zid():
                        why = ": is a monitor of this machine there, and may this program publish it?"
                    elif settings.link.connect:
                        why = f": {settings.link.refusal()}"
                    raise PublishError(f"nobody subscribed to {machine.keys.stream} within {timeout_s:g} s{why}")

        def held() -> BlockStream:
            for item in stream:
                wait_for_subscriber()
                yield item

        wait_for_subscriber()
        outlets.descriptor.put(descriptor_payload(machine))
        summary = _send(outlets, probe, machine, stream if settings.pace else held(), settings, stop, on_block)
        if settings.pace is None and not stop.is_set():
            wait_for_subscriber()
            # Wait until the monitor has received everything: a query of lower priority leaves after all blocks, and the
            # monitor's side handles one link in order. Without a monitor there is no answer and no waiting.
            for _ in session.get(machine.keys.health, priority=zenoh.Priority.DATA_LOW, timeout=settings.drain_s):
                pass
        probe.undeclare()  # type: ignore[no-untyped-call]
        stop.wait(settings.linger_s)
        return summary


class _Outlets(NamedTuple):
    stream: zenoh.ext.AdvancedPublisher
    descriptor: zenoh.ext.AdvancedPublisher
    truth: zenoh.ext.AdvancedPublisher


def _session(settings: PublishSettings) -> zenoh.Session:
    items = settings.link.zenoh_items()
    if settings.pace is None:
        # By default Zenoh closes the connection to a subscriber that blocks for five seconds; a monitor that evaluates
        # an unpaced stream may need longer.
        items["transport/link/tx/queue/congestion_control/block/wait_before_close"] = str(_BLOCKED_US)
    config = zenoh.Config()
    for path, value in items.items():
        try:
            config.insert_json5(path, value)
        except zenoh.ZError as error:
            # Endpoints are the only text of the user that Zenoh may refuse; a password is never shown.
            shown = f" = {value}" if path.endswith("endpoints") else ""
            reason = re.sub(r"\s*at \S+\.rs:\d+\.?", "", str(error))  # without the source lines of the library
            raise MachineFileError(f"link setting {path}{shown} is refused: {reason}") from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        link = settings.link
        ends = f"listen {list(link.listen)}, connect {list(link.connect)}"
        raise PublishError(f"no Zenoh session ({ends}): {link.explain(str(error))}") from error


@contextmanager
def _declared(session: zenoh.Session, machine: MachineFile, pace: float | None) -> Iterator[_Outlets]:
    keys, descriptor = machine.keys, descriptor_payload(machine)
    # A real machine never waits for its monitor: a block that finds the queue full is dropped, and the subscriber
    # fetches it from the cache. Without a pace there is nothing to fall behind, and a cache of any size would overflow:
    # there a slow subscriber slows the publisher down instead.
    congestion = zenoh.CongestionControl.BLOCK if pace is None else zenoh.CongestionControl.DROP

    def outlet(key: str, cache: int) -> zenoh.ext.AdvancedPublisher:
        return zenoh.ext.declare_advanced_publisher(
            session,
            key,
            encoding=JSON_ENCODING,
            congestion_control=congestion,
            priority=zenoh.Priority.DATA_HIGH,
            cache=zenoh.ext.CacheConfig(max_samples=cache),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None),
            publisher_detection=True,
        )

    def answer(query: zenoh.Query) -> None:
        query.reply(keys.descriptor, descriptor, encoding=JSON_ENCODING)

    outlets = _Outlets(outlet(keys.stream, _CACHE_BLOCKS), outlet(keys.descriptor, 1), outlet(keys.truth, _CACHE_TRUTH))
    declared: list[zenoh.ext.AdvancedPublisher | zenoh.Queryable[None] | zenoh.LivelinessToken]
    declared = [*outlets, session.declare_queryable(keys.descriptor, answer)]
    declared.append(session.liveliness().declare_token(keys.publisher_alive))
    try:
        yield outlets
    finally:
        for item in reversed(declared):
            item.undeclare()  # type: ignore[no-untyped-call]


def _heard(probe: zenoh.Publisher) -> bool:
    return bool(probe.matching_status.matching)  # type: ignore[attr-defined]  # the stub says bool


def _send(
    outlets: _Outlets,
    probe: zenoh.Publisher,
    machine: MachineFile,
    stream: BlockStream,
    settings: PublishSettings,
    stop: Event,
    on_block: Callable[[RunSummary], None] | None,
) -> RunSummary:
    schema_hash = machine.descriptor.schema_hash
    summary = RunSummary()
    first_ns: int | None = None
    begin = time.monotonic()
    look_s, heard = _SUBSCRIBER_CHECK_S, None
    for block, truth in stream:
        first_ns = block.start_ns if first_ns is None else first_ns
        data_s = (block.end_ns - first_ns) / 1e9
        payload, attachment, encoding = block_message(block, schema_hash, settings.encoding)
        if settings.pace is not None:
            stop.wait(max(0.0, begin + data_s / settings.pace - time.monotonic()))
        if stop.is_set():
            break
        for entry in truth:
            outlets.truth.put(entry.model_dump_json())
        outlets.stream.put(payload, attachment=attachment or None, encoding=encoding)
        elapsed_s = time.monotonic() - begin
        if elapsed_s >= look_s:
            look_s, heard = elapsed_s + _SUBSCRIBER_CHECK_S, _heard(probe)
        latest = truth[-1] if truth else summary.truth
        summary = RunSummary(summary.blocks + 1, data_s, elapsed_s, latest, heard)
        if on_block is not None:
            on_block(summary)
    return summary
