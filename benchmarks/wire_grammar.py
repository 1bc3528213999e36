"""Generates messages for a monitor from valid ones by rules; the same number and seed give the same message.

::

    message -> block | descriptor | record | token | query | deletion | odd key
    block   -> raw | Arrow, with invalid fields, samples, metadata, types or bytes

There are three machines. The first has its own publisher, so blocks that the monitor might accept are not sent to it:
two publishers on one key would be a conflict, which the monitor reports. They are sent to the third. The second gets a
consistent stream with absurdly large or small samples at times, so that such windows are evaluated too. Messages that
cannot be a block are sent to any machine.
"""

import json
import struct
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any, Literal, TypeVar

import numpy as np
import pyarrow as pa

from models.errors import WireError
from models.ingest import Gate
from models.machine import Machine
from models.signals.block import SampleBlock
from models.signals.wire import ARROW_ENCODING, BLOCK_ENCODING, REPLAY_MARK, decode_block, encode_block
from rotorwatch.records.alarms import AlarmCloudEvent, AlarmStates
from rotorwatch.records.example import example
from rotorwatch.records.health import Health

GOOD_RUN = 7  # run number of the first machine's own publisher

_START_NS = 1_767_225_600_000_000_000
_STRETCH = 2000
_BLOCK_S = 0.5
_EVERY = 20  # every 20th message is the next block of the second machine

_BOUNDS = (7, 8, 15, 16, 31, 32, 53, 63, 64)
WHOLE = [0, 1, -1, *(sign * 2**bits + off for bits in _BOUNDS for sign in (1, -1) for off in (-1, 0, 1)), 10**30]
REAL = [0.0, -0.0, 5e-324, 1e-308, 1e-3, 0.99e-3, 1e6, 1.0000001e6, 1e-40, 3.4e38, 1.7e308]
REAL += [float("nan"), float("inf"), float("-inf")]
TEXTS = ["", " ", "\0", "9" * 4301, "-" + "9" * 400, "0x10", "1_000", "١٢٣", "ä€😀", "\u202e\u2066", "a" * 70_000]
TEXTS += ["nan", "1e400", "../../etc/passwd", "${x}", "'; DROP TABLE event; --", "%s%n", "\x1b[2J", "\ud7ff\uffff"]
ENCODINGS = ["", "text/plain", "application/json", ARROW_ENCODING, BLOCK_ENCODING, f"{BLOCK_ENCODING};", "\0"]
ENCODINGS += [
    "é" * 99,
    f"{BLOCK_ENCODING};{'f' * 200}",
    f"{BLOCK_ENCODING};a;b;c",
    BLOCK_ENCODING.upper(),
    f" {BLOCK_ENCODING}",
]

_HEADER = struct.Struct("<qQdBBHI")
_FIELDS = ("start_ns", "sequence", "rate_hz", "dtype", "channels", "run", "samples")
_WIDTHS = {"sequence": 64, "dtype": 8, "channels": 8, "run": 16, "samples": 32}

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Message:
    """An action on a Zenoh key: publish, delete, declare a liveliness token, or query."""

    number: int
    kind: str  # the rule that made it
    act: Literal["put", "delete", "declare", "ask"]
    key: str
    payload: bytes = b""
    attachment: bytes = b""
    encoding: str = ""  # the parameters, if it is a query


class Grammar:
    """Generates messages for three machines, all with the channels and the rate of the first."""

    def __init__(self, seed: int, first: Machine, second: Machine, third: Machine) -> None:
        self._seed = seed
        self._machines = (first, second, third)
        self._first, self._second, self._third = self._machines
        self._gate = Gate(first, partial=True)
        self._hashes = [machine.descriptor.schema_hash for machine in self._machines]
        self._descriptors = {one.keys.descriptor: one.descriptor.model_dump(mode="json") for one in self._machines}
        self._health = example(Health)
        self._alarms = {"event": example(AlarmCloudEvent), "state": example(AlarmStates)}
        self._noise = np.random.default_rng(seed).standard_normal((20_000, len(first.sensors)))
        self._rules: list[tuple[int, Callable[[_Dice, int], Message]]] = [
            (34, self._raw),
            (26, self._arrow),
            (8, self._descriptor),
            (6, self._record),
            (6, self._token),
            (10, self._query),
            (4, self._deletion),
            (6, self._odd_key),
        ]

    def message(self, number: int) -> Message:
        """Generate the message with a given number."""
        dice = _Dice(np.random.default_rng([self._seed, number]))
        if number % _EVERY == 0:
            return self._next_block(dice, number)
        ends = list(accumulate(weight for weight, _ in self._rules))
        _, rule = self._rules[bisect_right(ends, dice.below(ends[-1]))]
        return rule(dice, number)

    # Blocks

    def _samples(self, dice: "_Dice", n_samples: int) -> np.ndarray:
        at = dice.below(len(self._noise) - n_samples) if n_samples < len(self._noise) else 0
        samples: np.ndarray = self._noise[at : at + n_samples].astype(dice.one([np.float32, np.float64]))
        return samples

    def _next_block(self, dice: "_Dice", number: int) -> Message:
        """A block that continues the second machine's stream, with finite but possibly absurd samples."""
        sequence = number // _EVERY
        n_samples = round(_BLOCK_S * self._second.rate_hz)
        samples = self._samples(dice, n_samples)
        if number // _STRETCH % 2:
            with np.errstate(over="ignore"):
                size = samples.dtype.type(dice.one([0.0, 1e-300, 1e-30, 1e30, 1e150, 1e300]))
                samples = np.nan_to_num(samples * size)
            if dice.chance(0.3):
                samples[:, dice.below(samples.shape[1])] = dice.one([0.0, 1.0, 1e18, -1e30])
        start_ns = _START_NS + round(sequence * _BLOCK_S * 1e9)
        block = SampleBlock(start_ns, sequence, 1, self._second.rate_hz, samples)
        payload, attachment, encoding = encode_block(block, self._hashes[1])
        return Message(number, "next block", "put", self._second.keys.stream, payload, attachment, encoding)

    def _valid(self, dice: "_Dice", number: int) -> tuple[dict[str, Any], np.ndarray]:
        """Fields and samples of a block that one of the publishers might have sent."""
        n_samples = dice.one([1, 2, 199, 200, 200, 200, 201, 1000])
        samples = self._samples(dice, n_samples)
        at = dice.below(6000) if dice.chance(0.5) else number // _EVERY + dice.below(150)
        fields: dict[str, Any] = {
            "start_ns": _START_NS + round(at * _BLOCK_S * 1e9),
            "sequence": at,
            "rate_hz": self._first.rate_hz,
            "dtype": 1 if samples.dtype == np.float32 else 2,
            "channels": samples.shape[1],
            "run": dice.one([GOOD_RUN, GOOD_RUN, 1, 1, 1, 2, 3, dice.below(65536)]),
            "samples": n_samples,
        }
        return fields, samples

    def _spoil(self, dice: "_Dice", fields: dict[str, Any], samples: np.ndarray) -> np.ndarray:
        """Change some fields in place, and return the samples, possibly changed."""
        for _ in range(dice.one([0, 1, 1, 2, 3])):
            field = dice.one(_FIELDS)
            fields[field] = dice.one(REAL) if field == "rate_hz" else dice.one([*WHOLE, fields[field] + 1, 1000])
        if dice.chance(0.4):
            spoilt = samples.copy()
            with np.errstate(over="ignore"):
                value = samples.dtype.type(dice.one([*REAL, 1e30]))
            spoilt[dice.below(len(spoilt)) :, dice.below(spoilt.shape[1]) :] = value
            return spoilt
        return samples[:, : dice.below(samples.shape[1])] if dice.chance(0.1) else samples

    def _encoding(self, dice: "_Dice", kind: str) -> str:
        return kind + dice.one(["", ";", *(f";{one}" for one in self._hashes), REPLAY_MARK])

    def _raw(self, dice: "_Dice", number: int) -> Message:
        fields, samples = self._valid(dice, number)
        samples = self._spoil(dice, fields, samples)
        whole = {name: fields[name] % 2**bits for name, bits in _WIDTHS.items()}
        start_ns = (fields["start_ns"] + 2**63) % 2**64 - 2**63
        header = _HEADER.pack(*({**fields, **whole, "start_ns": start_ns}[name] for name in _FIELDS))
        payload = np.ascontiguousarray(samples).tobytes()
        encoding = self._encoding(dice, BLOCK_ENCODING)
        if dice.chance(0.15):
            header = dice.damaged(header)
        if dice.chance(0.15):
            payload = dice.damaged(payload)
        if dice.chance(0.1):
            encoding = dice.one(ENCODINGS)
        return self._block(dice, number, "raw", payload, header, encoding)

    def _arrow(self, dice: "_Dice", number: int) -> Message:
        fields, samples = self._valid(dice, number)
        samples = self._spoil(dice, fields, samples)
        metadata = [(name, repr(fields[name])) for name in ("start_ns", "sequence", "rate_hz", "run")]
        for _ in range(dice.one([0, 0, 1, 1, 2])):
            name = dice.one(metadata)[0] if metadata and dice.chance(0.8) else dice.one(TEXTS)
            change = dice.one(["drop", "double", "text", "number"])
            if change == "drop":
                metadata = [one for one in metadata if one[0] != name]
            elif change == "double":
                metadata.append((name, str(dice.one(WHOLE))))
            else:
                value = dice.one(TEXTS) if change == "text" else repr(dice.one([*WHOLE, *REAL]))
                metadata = [(key, value if key == name else old) for key, old in metadata]
        payload = arrow_stream(dice, samples, metadata)
        if dice.chance(0.4):
            payload = dice.damaged(payload)
        encoding = self._encoding(dice, ARROW_ENCODING)
        if dice.chance(0.05):
            encoding = dice.one(ENCODINGS)
        return self._block(dice, number, "arrow", payload, dice.some(32) if dice.chance(0.05) else b"", encoding)

    def _block(
        self, dice: "_Dice", number: int, kind: str, payload: bytes, attachment: bytes, encoding: str
    ) -> Message:
        """A message to the third machine if it might be accepted as a block, else to any machine."""
        streams = [machine.keys.stream for machine in self._machines]
        key = streams[-1]
        if not self._might_be_used(payload, attachment, encoding):
            key = dice.one([*streams * 8, f"{self._first.keys.root}/**", "rotorwatch/*/*/stream"])
        return Message(number, kind, "put", key, payload, attachment, encoding)

    def _might_be_used(self, payload: bytes, attachment: bytes, encoding: str) -> bool:
        try:
            block = decode_block(payload, attachment, encoding)
        except WireError:
            return False
        return self._gate.form(replace(block, schema_hash="")) is None  # another machine's may be right there

    # Other messages

    def _machine(self, dice: "_Dice") -> Machine:
        return dice.one(self._machines)

    def _descriptor(self, dice: "_Dice", number: int) -> Message:
        key = self._machine(dice).keys.descriptor
        payload = dice.spoilt_json(self._descriptors[key])
        return Message(number, "descriptor", "put", key, payload, encoding="application/json")

    def _record(self, dice: "_Dice", number: int) -> Message:
        """A record that only a monitor or the simulator should publish."""
        keys = self._machine(dice).keys
        key = dice.one([keys.alarm_event, keys.alarm_event, keys.alarm_state, keys.health, keys.report, keys.truth])
        record = self._alarms.get(key.rpartition("/")[2], self._health)
        return Message(number, "record", "put", key, dice.spoilt_json(record), encoding=dice.one(ENCODINGS))

    def _token(self, dice: "_Dice", number: int) -> Message:
        keys = self._machine(dice).keys
        known = [keys.publisher_alive, keys.monitor_alive, keys.replay_alive, f"{keys.root}/alive/x"]
        key = dice.one([*known * 2, self._advanced(dice, keys.stream), self._advanced(dice, keys.descriptor)])
        return Message(number, "token", "declare", key)

    @staticmethod
    def _advanced(dice: "_Dice", key: str) -> str:
        """A key on which Zenoh's advanced publishers announce themselves and their latest sequence number."""
        zid = dice.one(["0", "*", "zz", "f" * 32, "f" * 33, dice.some(dice.one([1, 8, 16])).hex().lstrip("0") or "1"])
        eid = dice.one(["0", "1", "uhlc", "4294967295", "4294967296", "-1", "x", str(dice.below(100))])
        return f"{key}/@adv/{dice.one(['pub', 'sub'])}/{zid}/{eid}/{dice.one(['_', 'x/y'])}"

    def _query(self, dice: "_Dice", number: int) -> Message:
        keys = self._machine(dice).keys
        some = [keys.alarm_event, keys.alarm_state, keys.health, keys.descriptor, keys.stream, f"{keys.root}/**"]
        names = ["after", "limit", "_max", "_sn", "_time", "_anyke", *TEXTS[:3], TEXTS[8]]
        values = [str(number) for number in (*WHOLE, *REAL)] + ["1..2", "..", "[now(-1h)..now()]", *TEXTS]
        parts = [f"{dice.one(names)}={dice.one(values)}" for _ in range(dice.one([0, 1, 1, 2, 5]))]
        payload = dice.some(dice.one([0, 0, 1, 10_000]))
        return Message(number, "query", "ask", dice.one(some), payload, encoding=";".join(parts))

    def _deletion(self, dice: "_Dice", number: int) -> Message:
        keys = self._machine(dice).keys
        some = [keys.stream, keys.descriptor, keys.alarm_event, keys.alarm_state, keys.health, f"{keys.root}/**"]
        return Message(number, "deletion", "delete", dice.one(some), attachment=dice.some(dice.one([0, 32])))

    def _odd_key(self, dice: "_Dice", number: int) -> Message:
        """A forged sequence number of a publisher (heartbeat), or random bytes on an unexpected key."""
        keys = self._machine(dice).keys
        if dice.chance(0.5):
            payload = dice.one([b"", b"\xff" * 9, struct.pack("<I", dice.one(WHOLE) % 2**32), dice.some(4)])
            return Message(number, "heartbeat", "put", self._advanced(dice, keys.stream), payload)
        tails = ["", "/stream/x", "/alarm", "/alive/publisher", "/alive/replay", "/" + "a/" * 200 + "b", "/ä€😀", "/ "]
        root = dice.one([keys.root, "rotorwatch", "rotorwatch/demo", f"rotorwatch/{'x' * 300}/lab", "rotorwatch/*/lab"])
        return Message(
            number, "odd key", "put", root + dice.one(tails), dice.some(dice.below(300)), b"", dice.one(ENCODINGS)
        )


class _Dice:
    """Random choices."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def below(self, count: int) -> int:
        return int(self._rng.integers(max(1, count)))

    def chance(self, share: float) -> bool:
        return float(self._rng.random()) < share

    def one(self, items: Sequence[_T]) -> _T:
        return items[int(self._rng.integers(len(items)))]

    def some(self, count: int) -> bytes:
        return self._rng.bytes(count)

    def damaged(self, whole: bytes) -> bytes:
        """Cut, lengthen, repeat or change bytes, more often near the beginning."""
        at = self.below(min(len(whole), 700) if self.chance(0.7) else len(whole)) if whole else 0
        how = self.below(6)
        if how == 0:
            return whole[:at]
        if how == 1:
            return whole + self.some(self.one([1, 4, 300]))
        if how == 2:
            return whole * 2
        if how == 3:
            return whole[:at] + whole[at + self.one([1, 4, 8, 64]) :]
        changed = bytearray(whole)
        for _ in range(self.one([1, 1, 2, 6]) if whole else 0):
            width = self.one([1, 4, 8])
            at = self.below(min(len(whole), 700) if self.chance(0.7) else len(whole)) // width * width
            value = (self.one(WHOLE) % 2 ** (8 * width)).to_bytes(width, "little")
            changed[at : at + width] = value[: len(whole) - at]
        return bytes(changed)

    def spoilt_json(self, value: Any) -> bytes:
        """JSON with some values replaced or removed, sometimes malformed or in another encoding."""
        value = json.loads(json.dumps(value))
        for _ in range(self.one([0, 1, 1, 2, 4])):
            value = self._replaced(value)
        text = json.dumps(value, ensure_ascii=self.chance(0.5))
        if self.chance(0.15):
            cut = self.below(len(text))
            long = text.replace('":', '":' + "9" * 5000, 1)
            text = self.one([text[:cut], "[" * 50_000, text + text, long, "{" + text])
        encoding = self.one(["utf-8"] * 9 + ["utf-16", "utf-32"])
        return text.encode(encoding, "surrogatepass")

    def _replaced(self, value: Any) -> Any:
        """A copy of a tree with one node replaced, removed or renamed."""
        inside = list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []
        if inside and self.chance(0.8):
            at = self.one(inside)
            changed = value.copy()
            if self.chance(0.15):
                del changed[at]
            elif isinstance(value, dict) and self.chance(0.1):
                changed[self.one(TEXTS)] = changed.pop(at)
            else:
                changed[at] = self._replaced(value[at])
            return changed
        deep: Any = []
        for _ in range(self.one([1, 100])):
            deep = [deep]
        choices = [self.one(WHOLE), self.one(REAL), self.one(TEXTS), "\ud800", None, True, [], {}, deep, [value] * 70]
        return self.one(choices)


def arrow_stream(dice: _Dice, samples: np.ndarray, metadata: list[tuple[str, str]]) -> bytes:
    """An Arrow stream; in half of all cases valid, with one column of fixed-size lists."""
    flat, width = pa.array(np.ascontiguousarray(samples).reshape(-1)), samples.shape[1]
    empty = pa.nulls(len(samples), pa.list_(flat.type, 0))
    column: Any = pa.FixedSizeListArray.from_arrays(flat, width) if width else empty
    other = pa.array(np.zeros(samples.size, dice.one([np.float16, np.int8, np.int64, np.uint32])))
    text = pa.array([b"x" * 50] * len(column), dice.one([pa.binary(), pa.large_binary()]))
    forms: tuple[Callable[[], dict[str, Any]], ...] = (
        lambda: {dice.one(["samples", *TEXTS]): column},
        lambda: {"samples": column, dice.one(["other", ""]): column},
        lambda: {},
        lambda: {"samples": pa.array(np.zeros(len(samples)).tolist()).dictionary_encode()},
        lambda: {"samples": pa.array(np.asarray(samples, np.float64).tolist())},
        lambda: {"samples": pa.FixedSizeListArray.from_arrays(column, 1)},
        lambda: {"samples": column.slice(0, 0)},
        lambda: {"samples": column.slice(min(3, len(column)))},
        lambda: {"samples": pa.nulls(len(column), column.type)},
        lambda: {"samples": flat.cast(pa.float64())},
        lambda: {"samples": text},
        lambda: {"samples": pa.StructArray.from_arrays([column], names=["samples"])},
        lambda: {"samples": pa.FixedSizeListArray.from_arrays(other, width) if width else empty},
    )
    columns = dice.one(forms)() if dice.chance(0.5) else {"samples": column}
    batches = dice.one([1, 1, 1, 1, 0, 2, 3]) if columns else 0
    compression = dice.one(["zstd", "lz4"]) if dice.chance(0.05) else None
    schema = pa.schema([pa.field(name, each.type) for name, each in columns.items()])
    schema = schema.with_metadata(pa.KeyValueMetadata(metadata))
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema, options=pa.ipc.IpcWriteOptions(compression=compression)) as writer:
        for _ in range(batches):
            writer.write_batch(pa.record_batch(list(columns.values()), schema=schema))
    stream: bytes = sink.getvalue().to_pybytes()
    return stream
