"""Which messages a simulated machine sends: the same for the network and for a recording."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from models.machine import MachineFile
from models.signals.block import SampleBlock
from models.signals.wire import encode_arrow, encode_block
from simulator.truth import TruthRecord

__all__ = ["JSON_ENCODING", "BlockEncoding", "BlockStream", "RunSummary", "block_message", "descriptor_payload"]

JSON_ENCODING = "application/json"

BlockEncoding = Literal["raw", "arrow"]

BlockStream = Iterator[tuple[SampleBlock, tuple[TruthRecord, ...]]]
"""What `simulator.stream.blocks` returns."""


@dataclass(frozen=True, slots=True)
class RunSummary:
    """What has been sent or recorded so far.

    Attributes
    ----------
    data_s : float
        Data seconds in these blocks.
    elapsed_s : float
        Seconds since the first block.
    truth : TruthRecord or None
        The latest one.
    heard : bool or None
        Whether somebody subscribes to the stream; None as long as it is not known, and for a recording.
    """

    blocks: int = 0
    data_s: float = 0.0
    elapsed_s: float = 0.0
    truth: TruthRecord | None = None
    heard: bool | None = None

    @property
    def pace(self) -> float:
        """Data seconds per second."""
        return self.data_s / self.elapsed_s if self.elapsed_s > 0 else 0.0


def block_message(block: SampleBlock, schema_hash: str, encoding: BlockEncoding) -> tuple[bytes, bytes, str]:
    """Payload, attachment and encoding string of a block."""
    return encode_block(block, schema_hash) if encoding == "raw" else encode_arrow(block, schema_hash)


def descriptor_payload(machine: MachineFile) -> bytes:
    """Encode the channel descriptor as JSON."""
    return machine.descriptor.model_dump_json().encode()
