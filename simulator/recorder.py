"""Writes a simulated stream straight into a recording, at full speed."""

import time
from collections.abc import Callable
from pathlib import Path
from threading import Event

from models.machine import MachineFile
from models.signals.recording import RecordedMessage, RecordingWriter
from simulator.stream import JSON_ENCODING, BlockEncoding, BlockStream, RunSummary, block_message, descriptor_payload


def record(
    machine: MachineFile,
    stream: BlockStream,
    path: Path,
    *,
    encoding: BlockEncoding = "raw",
    overwrite: bool = False,
    stop: Event | None = None,
    on_block: Callable[[RunSummary], None] | None = None,
) -> RunSummary:
    """Record descriptor, truth and blocks under the keys a publisher would use.

    All times in the file are data time: a block is logged at the time of the sample after its last one, when a real
    machine could have sent it at the earliest. The file is ``.part`` until complete; when `stop` is set, it ends after
    the current block and is complete.

    Raises
    ------
    RecordingError
        If the file cannot be written.
    """
    keys, schema_hash = machine.keys, machine.descriptor.schema_hash
    begin = time.monotonic()
    summary = RunSummary()
    first_ns: int | None = None
    with RecordingWriter(path, overwrite=overwrite) as writer:
        for block, truth in stream:
            if first_ns is None:
                first_ns = block.start_ns
                descriptor = descriptor_payload(machine)
                writer.write(
                    RecordedMessage(keys.descriptor, descriptor, b"", JSON_ENCODING, block.start_ns, block.start_ns)
                )
            for entry in truth:
                payload = entry.model_dump_json().encode()
                writer.write(RecordedMessage(keys.truth, payload, b"", JSON_ENCODING, entry.time_ns, entry.time_ns))
            payload, attachment, block_encoding = block_message(block, schema_hash, encoding)
            writer.write(RecordedMessage(keys.stream, payload, attachment, block_encoding, block.end_ns, block.end_ns))
            summary = RunSummary(
                blocks=summary.blocks + 1,
                data_s=(block.end_ns - first_ns) / 1e9,
                elapsed_s=time.monotonic() - begin,
                truth=truth[-1] if truth else summary.truth,
            )
            if on_block is not None:
                on_block(summary)
            if stop is not None and stop.is_set():
                break
    return summary
