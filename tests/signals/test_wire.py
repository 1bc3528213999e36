"""Channels, keys, and the wire format: round trips, every refusal, and the page that describes it (``docs/wire.md``).

The examples of the page run here, which keeps them correct.
"""

import ctypes
import json
import re
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Callable
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError

from models.errors import MachineFileError, WireError
from models.physics.rotor import STATES
from models.signals.block import SampleBlock
from models.signals.channels import ACCELERATIONS, UNIT_TO_SI, Channel, ChannelDescriptor, Quantity, state_name
from models.signals.keys import PREFIX, MachineKeys
from models.signals.link import LinkSettings
from models.signals.wire import ARROW_ENCODING, BLOCK_ENCODING, HEADER_BYTES, decode_block, encode_arrow, encode_block
from tests.loopback import endpoint, session_of
from tests.sure import sure

PAGE = (Path(__file__).parents[2] / "docs" / "wire.md").read_text(encoding="utf-8")
Encoder = Callable[[SampleBlock, str], tuple[bytes, bytes, str]]


def page_blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def _block(samples: npt.NDArray[Any] | None = None) -> SampleBlock:
    if samples is None:
        samples = np.arange(12, dtype=np.float32).reshape(4, 3)
    return SampleBlock(start_ns=1_767_225_600_000_000_123, sequence=7, run=3, rate_hz=2000.0, samples=samples)


def _header(**fields: float) -> bytes:
    values: dict[str, Any] = {
        "start_ns": 0, "sequence": 0, "rate_hz": 2000.0, "dtype": 1, "channels": 3, "run": 1, "samples": 4,
    }  # fmt: skip
    values.update(fields)
    return struct.pack("<qQdBBHI", *values.values())


_samples = st.one_of(
    [
        arrays(dtype, st.tuples(st.integers(1, 40), st.integers(1, 64)), elements=elements)
        for dtype, elements in ((np.float32, st.floats(width=32)), (np.float64, st.floats(width=64)))
    ]
)


@pytest.mark.parametrize("encode", [encode_block, encode_arrow])
@settings(max_examples=60)
@given(
    samples=_samples, start_ns=st.integers(-(2**63), 2**63 - 1), sequence=st.integers(0, 2**64 - 1),
    run=st.integers(0, 2**16 - 1), rate_hz=st.floats(1e-3, 1e6), schema_hash=st.sampled_from(["", "0123456789ab"]),
)  # fmt: skip
def test_any_block_survives_the_round_trip(
    encode: Encoder, samples: npt.NDArray[Any], start_ns: int, sequence: int, run: int, rate_hz: float, schema_hash: str
) -> None:
    sent = SampleBlock(start_ns, sequence, run, rate_hz, samples)
    received = decode_block(*encode(sent, schema_hash))
    assert (received.start_ns, received.sequence, received.run, received.rate_hz) == (start_ns, sequence, run, rate_hz)
    assert received.schema_hash == schema_hash
    assert received.samples.dtype == samples.dtype
    assert received.samples.tobytes() == samples.tobytes()  # bit by bit: NaN payloads and signed zeros too
    assert received.samples.shape == samples.shape


@pytest.mark.parametrize("encode", [encode_block, encode_arrow])
@pytest.mark.parametrize(
    "view",
    [
        np.asfortranarray(np.arange(12, dtype=np.float32).reshape(4, 3)),
        np.arange(24, dtype=np.float64).reshape(4, 6)[:, ::2],
    ],
    ids=["fortran", "strided"],
)
def test_layout_in_memory_does_not_matter(encode: Encoder, view: npt.NDArray[Any]) -> None:
    received = decode_block(*encode(_block(view), ""))
    np.testing.assert_array_equal(received.samples, view)


def test_big_endian_samples_are_sent_little_endian() -> None:
    samples = np.arange(12, dtype=">f4").reshape(4, 3)
    payload, _, _ = encode_block(_block(samples), "")
    assert payload == samples.astype("<f4").tobytes()


PAYLOAD = b"\0" * 48


@pytest.mark.parametrize(
    ("payload", "header", "encoding", "message"),
    [
        (PAYLOAD, _header(), "text/plain", "encoding 'text/plain' is not"),
        (PAYLOAD, _header()[:-1], BLOCK_ENCODING, "header .* has 31 bytes, expected 32"),
        (PAYLOAD, _header(dtype=0), BLOCK_ENCODING, "dtype is 0, expected 1"),
        (b"", _header(samples=0), BLOCK_ENCODING, "samples is 0, expected 1 to 1000000"),
        (b"", _header(samples=1_000_001), BLOCK_ENCODING, "samples is 1000001, expected 1 to 1000000"),
        (b"", _header(channels=0), BLOCK_ENCODING, "channels is 0, expected 1 to 64"),
        (b"", _header(channels=65), BLOCK_ENCODING, "channels is 65, expected 1 to 64"),
        (PAYLOAD[:-1], _header(), BLOCK_ENCODING, "payload has 47 bytes, expected 48 for 4 samples × 3 channels"),
        (PAYLOAD, _header(dtype=2), BLOCK_ENCODING, "payload has 48 bytes, expected 96"),
        (PAYLOAD, _header(rate_hz=0.0), BLOCK_ENCODING, "rate_hz is 0.0, expected 0.001 to 1000000.0"),
        (PAYLOAD, _header(rate_hz=1e7), BLOCK_ENCODING, "rate_hz is 10000000.0"),
        (PAYLOAD, _header(rate_hz=float("nan")), BLOCK_ENCODING, "rate_hz is nan"),
        (b"", b"", ARROW_ENCODING, "Arrow stream"),
        (b"not an arrow stream at all", b"", ARROW_ENCODING, "Arrow stream"),
    ],
)
def test_what_is_not_a_block_is_refused(payload: bytes, header: bytes, encoding: str, message: str) -> None:
    with pytest.raises(WireError, match=message):
        decode_block(payload, header, encoding)


def _arrow(column: Any, name: str = "samples", **metadata: str) -> bytes:
    fields = {"start_ns": "0", "sequence": "0", "run": "1", "rate_hz": "2000.0", **metadata}
    schema = pa.schema([pa.field(name, column.type)], metadata={k: v for k, v in fields.items() if v})
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema) as writer:
        writer.write_batch(pa.record_batch([column], schema=schema))
    return bytes(sink.getvalue())


def _arrow_column(values: list[Any], kind: str) -> Any:
    return pa.FixedSizeListArray.from_arrays(pa.array(values, getattr(pa, kind)()), 3)


_WORDS = pa.array(["a"] * 6).dictionary_encode()


@pytest.mark.parametrize(
    ("column", "name", "said"),
    [
        (_arrow_column([1.0] * 6, "float32"), "other", "'samples'"), (pa.array([1.0, 2.0]), "samples", "'samples'"),
        (_arrow_column([1] * 6, "int32"), "samples", "float32 or float64"),
        (_arrow_column([], "float32"), "samples", "samples is 0"),
        (_WORDS, "samples", "Arrow"), (pa.FixedSizeListArray.from_arrays(_WORDS, 3), "samples", "Arrow"),
        (pa.array([[[1.0]]]), "samples", "Arrow"),
    ],
)  # fmt: skip
def test_arrow_columns_must_be_lists_of_floats(column: Any, name: str, said: str) -> None:
    with pytest.raises(WireError, match=said):
        decode_block(_arrow(column, name=name), b"", ARROW_ENCODING)


@settings(max_examples=100)
@given(
    payload=st.binary(max_size=200),
    header=st.binary(max_size=40),
    encoding=st.sampled_from([BLOCK_ENCODING, ARROW_ENCODING]),
)
def test_arbitrary_bytes_make_a_block_or_a_wire_error(payload: bytes, header: bytes, encoding: str) -> None:
    try:
        block = decode_block(payload, header, encoding)
    except WireError:
        return
    assert block.samples.ndim == 2


def test_a_truncated_arrow_stream_is_refused() -> None:
    payload, _, encoding = encode_arrow(_block(), "")
    refused = 0
    for cut in range(len(payload)):
        try:
            block = decode_block(payload[:cut], b"", encoding)
        except WireError:
            refused += 1
        else:  # only the end-of-stream mark may be missing
            np.testing.assert_array_equal(block.samples, _block().samples)
    assert refused > len(payload) * 0.9


_C_TYPES = {
    "int64_t": ctypes.c_int64, "uint64_t": ctypes.c_uint64, "double": ctypes.c_double,
    "uint8_t": ctypes.c_uint8, "uint16_t": ctypes.c_uint16, "uint32_t": ctypes.c_uint32,
}  # fmt: skip
_C_FIELDS: list[tuple[str, Any]] = [
    (name, _C_TYPES[kind]) for kind, name in re.findall(r"^ +(\w+) +(\w+);", page_blocks("c")[0], re.MULTILINE)
]


class _CHeader(ctypes.LittleEndianStructure):
    """The C struct of the page, built from its text."""

    _fields_ = _C_FIELDS


def test_the_page_c_struct_and_table_are_the_header() -> None:
    header = _CHeader.from_buffer_copy(encode_block(_block(), "")[1])
    assert ctypes.sizeof(_CHeader) == HEADER_BYTES
    assert (header.start_ns, header.sequence, header.rate_hz) == (1_767_225_600_000_000_123, 7, 2000.0)
    assert (header.dtype, header.channels, header.run, header.samples) == (1, 3, 3, 4)
    rows = re.findall(r"^\| (\d+) \| (\d) \| \w+ \| (\w+) \|", PAGE, re.MULTILINE)
    table = [(name, int(offset), int(size)) for offset, size, name in rows]
    in_c = [(name, getattr(_CHeader, name)) for name, _ in _C_FIELDS]
    assert table == [(name, field.offset, field.size) for name, field in in_c]
    assert ("0.001 to 1e6 |" in PAGE, "N, 1 to 64 |" in PAGE) == (True, True)  # what the refusals above expect


def test_the_page_names_encodings_and_units() -> None:
    assert BLOCK_ENCODING in PAGE
    assert ARROW_ENCODING in PAGE
    for quantity, units in UNIT_TO_SI.items():
        row = sure(re.search(rf"^\| {quantity} \|.*\| ([^|]+) \|$", PAGE, re.MULTILINE))
        assert row[1].split(", ") == list(units)


def test_the_page_arrow_example_is_a_block() -> None:
    names: dict[str, Any] = {}
    exec(page_blocks("python")[-1], names)  # noqa: S102  # our own page
    block = decode_block(names["payload"], b"", ARROW_ENCODING)
    np.testing.assert_array_equal(block.samples, np.array([[1, 2, 3], [4, 5, 6]], dtype=np.float32))
    assert (block.start_ns, block.sequence, block.run, block.rate_hz) == (1_767_225_600_000_000_000, 0, 1, 2000.0)
    assert block.schema_hash == ""


def test_the_page_python_example_is_received(tmp_path: Path) -> None:
    script = tmp_path / "example.py"
    script.write_text(page_blocks("python")[0], encoding="utf-8")
    address = endpoint()
    received: list[tuple[str, bytes, bytes, str]] = []
    complete = threading.Event()

    def keep(sample: zenoh.Sample) -> None:
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        received.append((str(sample.key_expr), sample.payload.to_bytes(), attachment, str(sample.encoding)))
        if sum(key.endswith("/stream") for key, *_ in received) == 4:
            complete.set()

    with session_of(LinkSettings(listen=(address,))) as session:
        session.declare_subscriber("rotorwatch/demo/rig7/*", keep)
        begin = time.time_ns()
        with subprocess.Popen([sys.executable, str(script), address, "4"]) as process:
            assert complete.wait(180)
            assert process.wait(180) == 0
    descriptors = [payload for key, payload, _, _ in received if key.endswith("/descriptor")]
    descriptor = ChannelDescriptor.model_validate_json(descriptors[0])
    assert descriptor == ChannelDescriptor.model_validate_json(page_blocks("json")[0])
    stream = [decode_block(p, a, e) for key, p, a, e in received if key.endswith("/stream")]
    assert [block.sequence for block in stream] == [0, 1, 2, 3]
    assert {block.schema_hash for block in stream} == {descriptor.schema_hash}
    assert len({block.run for block in stream}) == 1
    for earlier, later in pairwise(stream):
        assert later.start_ns == earlier.end_ns
    assert stream[0].start_ns >= begin
    samples = np.concatenate([block.samples for block in stream])
    angle = 2 * np.pi * 22.0 * np.arange(800) / 2000.0
    # float32 resolves 10 um to 1e-6 um
    np.testing.assert_allclose(samples[:, 0], 10 * np.cos(angle), atol=2e-6)
    np.testing.assert_allclose(samples[:, 2], angle % (2 * np.pi), atol=1e-6)


@pytest.mark.parametrize("codec", ["zstd", "lz4"])
def test_compressed_streams_are_refused_unread(codec: str) -> None:
    column = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(10_000_000, np.float32)), 10)
    schema = pa.schema([pa.field("samples", column.type)], metadata={"start_ns": "0", "sequence": "0", "run": "1"})
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema, options=pa.ipc.IpcWriteOptions(compression=codec)) as writer:
        writer.write_batch(pa.record_batch([column], schema=schema))
    bomb = sink.getvalue().to_pybytes()
    tracemalloc.start()
    with pytest.raises(WireError, match="compressed"):
        decode_block(bomb, b"", ARROW_ENCODING)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_000_000


@pytest.mark.parametrize(
    ("field", "text"),
    [
        ("sequence", "9" * 4300), ("sequence", str(2**64)), ("sequence", "-1"), ("run", "65536"),
        ("start_ns", str(2**63)), ("rate_hz", "1e-320"), ("rate_hz", "inf"), ("rate_hz", "nan"), ("rate_hz", "0"),
        *product(("start_ns", "sequence", "run", "rate_hz"), ("", "soon")),
    ],
)  # fmt: skip
def test_numbers_have_the_same_bounds_in_both_encodings(field: str, text: str) -> None:
    payload = _arrow(_arrow_column([1.0] * 6, "float32"), **{field: text})
    with pytest.raises(WireError, match=field) as refused:
        decode_block(payload, b"", ARROW_ENCODING)
    assert len(str(refused.value)) < 300


@settings(max_examples=100)
@given(data=st.data())
def test_a_damaged_arrow_stream_is_refused_or_a_block(data: st.DataObject) -> None:
    payload = bytearray(encode_arrow(_block(), "")[0])
    for _ in range(data.draw(st.integers(1, 6))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    try:
        block = decode_block(bytes(payload), b"", ARROW_ENCODING)
    except WireError:
        return
    assert block.samples.ndim == 2
    assert block.end_ns > block.start_ns


def _channel(**fields: str) -> dict[str, str]:
    return {
        "name": "XE-1", "quantity": "displacement", "location": "bearing", "direction": "y", "unit": "um", **fields,
    }  # fmt: skip


def _descriptor(*channels: dict[str, str], rate_hz: float = 2000.0, dtype: str = "float32") -> ChannelDescriptor:
    return ChannelDescriptor.model_validate({
        "site": "demo", "machine": "lab", "rate_hz": rate_hz, "dtype": dtype, "channels": channels,
    })  # fmt: skip


def test_every_state_and_the_angle_can_be_measured() -> None:
    measurable, refusals = set(), []
    for quantity in Quantity:
        for location in ("bearing", "disc", "shaft"):
            for direction in ("y", "z", "rotation"):
                unit = next(iter(UNIT_TO_SI[quantity]))
                fields = _channel(quantity=quantity, location=location, direction=direction, unit=unit)
                try:
                    measurable.add(state_name(Channel.model_validate(fields)))
                except ValidationError as error:
                    refusals.append(str(error))
    assert measurable == {*STATES, *ACCELERATIONS, "theta"}
    assert len(measurable) + len(refusals) == len(Quantity) * 9
    assert all(" at location '" in refusal for refusal in refusals)


@pytest.mark.parametrize(
    ("quantity", "unit", "factor"),
    [
        ("displacement", "um", 1e-6),
        ("displacement", "mil", 25.4e-6),  # a thousandth of an inch of 25.4 mm
        ("velocity", "mm/s", 1e-3),
        ("acceleration", "g", 9.80665),  # standard gravity, ISO 80000-3
        ("velocity", "in/s", 0.0254),
    ],
)
def test_units_turn_into_si(quantity: str, unit: str, factor: float) -> None:
    assert Channel.model_validate(_channel(quantity=quantity, unit=unit)).to_si == pytest.approx(factor, rel=1e-12)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"unit": "mm/s"}, "unit 'mm/s' is not one of"), ({"name": ""}, "at least 1 character"),
        ({"name": "a b"}, "pattern"), ({"name": "x" * 65}, "at most 64"), ({"gain": "1"}, "Extra inputs"),
    ],
)  # fmt: skip
def test_unusable_channels_are_refused(fields: dict[str, str], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Channel.model_validate(_channel(**fields))


@pytest.mark.parametrize("location", ["bearing1", "bearing DE", "shaft-end"])
def test_a_place_with_more_than_a_word_is_a_name_not_a_misspelling(location: str) -> None:
    channel = Channel.model_validate(_channel(location=location, direction="vertical"))
    assert state_name(channel) == "@XE-1"  # of which only levels are watched


def test_a_name_or_a_quantity_occurs_once() -> None:
    with pytest.raises(ValidationError, match="channel name occurs twice: XE-1"):
        _descriptor(_channel(), _channel(direction="z"))
    with pytest.raises(ValidationError, match="measured quantity occurs twice: y1"):
        _descriptor(_channel(), _channel(name="XE-2"))


def test_the_schema_hash_changes_with_everything_that_shapes_the_stream() -> None:
    y, z = _channel(), _channel(name="XE-2", direction="z")
    variants = [
        _descriptor(y, z), _descriptor(z, y), _descriptor(y), _descriptor({**y, "unit": "mm"}, z),
        _descriptor(y, z, rate_hz=4000.0), _descriptor(y, z, dtype="float64"),
    ]  # fmt: skip
    assert len({variant.schema_hash for variant in variants}) == len(variants)
    again = ChannelDescriptor.model_validate_json(variants[0].model_dump_json())
    assert (again.schema_hash, again.states) == (variants[0].schema_hash, ("y1", "z1"))


def test_all_keys_begin_with_the_machine() -> None:
    keys = MachineKeys("plant-2", "Pump_7")
    names = (
        keys.stream, keys.descriptor, keys.truth, keys.report, keys.health, keys.alarm_event, keys.alarm_state,
        keys.publisher_alive, keys.monitor_alive,
    )  # fmt: skip
    assert all(name.startswith(f"{PREFIX}/plant-2/Pump_7/") for name in names)
    assert len(set(names)) == len(names)
    for name in ("a", "7", "Z-", "0_x-9", "Pump_7-north", "q" * 64):
        assert MachineKeys(name, name).root == f"{PREFIX}/{name}/{name}"


@pytest.mark.parametrize("name", ["", "a/b", "*", "a b", "$x", "-a", "ü", "a" * 65, "a\n"])
def test_names_that_would_break_a_key_are_refused(name: str) -> None:
    with pytest.raises(MachineFileError, match="site name"):
        MachineKeys(name, "lab")
    with pytest.raises(MachineFileError, match="machine name"):
        MachineKeys("demo", name)


def test_a_link_stays_local_and_quiet_by_default() -> None:
    items = LinkSettings().zenoh_items()
    assert json.loads(items["listen/endpoints"]) == json.loads(items["connect/endpoints"]) == []
    assert items["scouting/multicast/enabled"] == items["scouting/gossip/enabled"] == "false"
    assert items["transport/shared_memory/enabled"] == "false"
    with pytest.raises(ValidationError, match="Extra inputs"):
        LinkSettings.model_validate({"lisen": []})
