"""Channels, descriptor, keys and link settings."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from models.errors import MachineFileError
from models.machine import load_machine
from models.physics.rotor import STATES
from models.signals.channels import ACCELERATIONS, UNIT_TO_SI, Channel, ChannelDescriptor, Quantity, state_name
from models.signals.keys import PREFIX, MachineKeys
from models.signals.link import LinkSettings


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
        ({"unit": "mm/s"}, "unit 'mm/s' is not one of"),
        ({"name": ""}, "at least 1 character"),
        ({"name": "a b"}, "pattern"),
        ({"name": "x" * 65}, "at most 64"),
        ({"quantity": "noise"}, "Input should be"),
        ({"gain": "1"}, "Extra inputs"),
    ],
)
def test_unusable_channels_are_refused(fields: dict[str, str], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Channel.model_validate(_channel(**fields))


def test_a_name_or_a_quantity_occurs_once() -> None:
    with pytest.raises(ValidationError, match="channel name occurs twice: XE-1"):
        _descriptor(_channel(), _channel(direction="z"))
    with pytest.raises(ValidationError, match="measured quantity occurs twice: y1"):
        _descriptor(_channel(), _channel(name="XE-2"))


def test_the_hash_changes_with_whatever_shapes_the_stream() -> None:
    y, z = _channel(), _channel(name="XE-2", direction="z")
    variants = [
        _descriptor(y, z), _descriptor(z, y), _descriptor(y), _descriptor({**y, "unit": "mm"}, z),
        _descriptor(y, z, rate_hz=4000.0), _descriptor(y, z, dtype="float64"),
    ]  # fmt: skip
    assert len({variant.schema_hash for variant in variants}) == len(variants)
    again = ChannelDescriptor.model_validate_json(variants[0].model_dump_json())
    assert again.schema_hash == variants[0].schema_hash
    assert again.states == ("y1", "z1")


def test_keys_lie_below_the_machine() -> None:
    keys = MachineKeys("plant-2", "Pump_7")
    names = (
        keys.stream, keys.descriptor, keys.truth, keys.report, keys.health, keys.alarm_event, keys.alarm_state,
        keys.publisher_alive, keys.monitor_alive,
    )  # fmt: skip
    assert all(name.startswith(f"{PREFIX}/plant-2/Pump_7/") for name in names)
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("name", ["", "a/b", "*", "a b", "$x", "-a", "ü", "a" * 65, "a\n"])
def test_names_that_would_break_a_key_are_refused(name: str) -> None:
    with pytest.raises(MachineFileError, match="site name"):
        MachineKeys(name, "lab")
    with pytest.raises(MachineFileError, match="machine name"):
        MachineKeys("demo", name)


@given(name=st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", fullmatch=True))
def test_plain_names_are_accepted(name: str) -> None:
    assert MachineKeys(name, name).root == f"{PREFIX}/{name}/{name}"


def test_shipped_machines_have_different_streams_under_different_keys() -> None:
    lab, heavy = load_machine("lab"), load_machine("heavy")
    assert lab.keys.stream != heavy.keys.stream
    assert lab.descriptor.schema_hash != heavy.descriptor.schema_hash


def test_a_link_stays_local_and_quiet_by_default() -> None:
    items = LinkSettings().zenoh_items()
    assert json.loads(items["listen/endpoints"]) == []
    assert json.loads(items["connect/endpoints"]) == []
    assert items["scouting/multicast/enabled"] == items["scouting/gossip/enabled"] == "false"
    assert items["transport/shared_memory/enabled"] == "false"
    with pytest.raises(ValidationError, match="Extra inputs"):
        LinkSettings.model_validate({"lisen": []})
