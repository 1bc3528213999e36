"""The stream: the same samples in any cut, contiguous blocks, and truth that fits."""

import numpy as np
import pytest

from models.errors import MachineFileError
from models.machine import Machine, load_machine
from models.signals.block import FloatArray
from simulator.scenario import ChannelSettings, Event, Scenario, Sensors, load_scenario
from simulator.stream import DEFAULT_START_NS, TruthRecord, blocks

EVENTS = (
    Event(at_s=1.0, ramp_s=2.5, parameter="k_by", relative_change=-0.3),
    Event(at_s=1.2345, sensor="y1", sensor_fault="stuck"),
    Event(at_s=2.0, sensor="z2", sensor_fault="dropout"),
    Event(at_s=2.2, sensor="y1", sensor_fault="none"),
    Event(at_s=3.0111, speed_rpm=1500.0),
    Event(at_s=3.3, source="disc y", force_rms_N=2.0),
    Event(at_s=3.5, parameter="e", relative_change=0.3),
)


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_scenario("healthy")[1]


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("healthy")[0].overridden(duration_s=4.2345, faults=EVENTS)


def _all(scenario: Scenario, machine: Machine, block_s: float = 0.1) -> tuple[FloatArray, list[TruthRecord]]:
    stream = list(blocks(scenario, machine, block_s))
    samples = np.concatenate([block.samples for block, _ in stream])
    return np.asarray(samples, dtype=np.float64), [entry for _, truth in stream for entry in truth]


@pytest.mark.parametrize("block_s", [0.0005, 0.013, 0.37, 2.0, 100.0])
def test_the_cut_into_blocks_changes_no_bit(scenario: Scenario, machine: Machine, block_s: float) -> None:
    samples, truth = _all(scenario, machine)
    again, truth_again = _all(scenario, machine, block_s)
    assert again.tobytes() == samples.tobytes()
    assert truth_again == truth


def test_blocks_are_contiguous(scenario: Scenario, machine: Machine) -> None:
    made = [block for block, _ in blocks(scenario, machine, start_ns=5, run=9)]
    assert [block.sequence for block in made] == list(range(43))
    assert {(block.run, block.rate_hz, block.samples.dtype.str) for block in made} == {(9, 2000.0, "<f4")}
    assert made[0].start_ns == 5
    assert [block.start_ns for block in made[1:]] == [block.end_ns for block in made[:-1]]
    assert [len(block.samples) for block in made] == [200] * 42 + [69]
    assert made[-1].end_ns == 5 + 4_234_500_000


def test_a_rate_that_is_no_whole_number_of_nanoseconds_does_not_drift(scenario: Scenario, machine: Machine) -> None:
    odd = machine.model_copy(update={"rate_hz": 2048.0 / 3})
    made = [block for block, _ in blocks(scenario, odd, 0.05)]
    first, last = made[0], made[-1]
    count = sum(len(block.samples) for block in made[:-1])
    assert last.start_ns - first.start_ns == round(count * 3e9 / 2048)


def test_truth_tells_what_happens_when(scenario: Scenario, machine: Machine) -> None:
    _, truth = _all(scenario, machine)
    assert [entry.data_s for entry in truth] == [0, 1, 1.2345, 2, 2.2, 3, 3.011, 3.3, 3.5]
    assert [entry.time_ns - DEFAULT_START_NS for entry in truth] == [round(entry.data_s * 1e9) for entry in truth]
    by_time = {entry.data_s: entry for entry in truth}
    assert set(by_time[0].relative_changes.values()) == {0.0}
    assert by_time[0].ramping == ()
    assert by_time[1].ramping == ("k_by",)
    assert by_time[1.2345].sensor_faults == {"y1": {"stuck": None}}
    assert by_time[2].sensor_faults == {"y1": {"stuck": None}, "z2": {"dropout": None}}
    assert by_time[2.2].sensor_faults == {"z2": {"dropout": None}}
    assert by_time[3].relative_changes["k_by"] == pytest.approx(-0.3 * 2.05 / 2.5)
    assert (by_time[3].speed_rpm, by_time[3.011].speed_rpm) == (1320.0, 1500.0)
    assert by_time[3.3].sources[2].force_rms_N == 2.0
    last = by_time[3.5]
    assert (last.relative_changes["k_by"], last.relative_changes["e"], last.ramping) == (-0.3, 0.3, ())
    assert (last.machine, last.scenario, last.seed, last.run) == ("lab", "healthy", 1, 1)
    assert TruthRecord.model_validate_json(last.model_dump_json()) == last


def test_each_truth_record_comes_with_the_block_it_begins_in(scenario: Scenario, machine: Machine) -> None:
    for block, truth in blocks(scenario, machine, 0.013):
        assert all(block.start_ns <= entry.time_ns < block.end_ns for entry in truth)


def test_samples_show_what_the_truth_says(scenario: Scenario, machine: Machine) -> None:
    samples, _ = _all(scenario, machine)
    column = {channel.name: samples[:, n] for n, channel in enumerate(machine.sensors)}
    assert np.array_equal(np.flatnonzero(np.isnan(column["z2"])), np.arange(4000, 8469))
    held = column["y1"][2469:4400]
    assert np.ptp(held) == 0
    assert held[0] == column["y1"][2468]
    assert np.ptp(column["y1"][4400:4500]) > 0
    turns = np.diff(np.unwrap(column["theta"])) * 2000 * 60 / (2 * np.pi)
    assert np.allclose(turns[:6021], 1320.0, atol=0.1)  # float32 resolves 2π to 5e-7 rad, 0.01 rpm
    assert np.allclose(turns[6022:], 1500.0, atol=0.1)


def test_sensors_never_change_how_the_machine_moves(scenario: Scenario, machine: Machine) -> None:
    plain = Scenario.model_validate({
        **scenario.model_dump(),
        "sensors": Sensors(channels={"z1": ChannelSettings(noise_relative=1.0)}).model_dump(),
        "events": [event.model_dump() for event in EVENTS if event.sensor is None],
    })  # fmt: skip
    noiseless = scenario.model_copy(update={"sensors": Sensors()})
    one, _ = _all(noiseless, machine)
    other, _ = _all(plain, machine)
    names = [channel.name for channel in machine.sensors]
    same = [name for name, a, b in zip(names, one.T, other.T, strict=True) if np.array_equal(a, b)]
    assert same == [name for name in names if name not in ("y1", "z1", "z2")]
    np.testing.assert_array_equal(one[:4000, names.index("z2")], other[:4000, names.index("z2")])


def test_another_seed_is_another_realisation(scenario: Scenario, machine: Machine) -> None:
    one, _ = _all(scenario, machine)
    other, _ = _all(scenario.overridden(seed=99), machine)
    correlation = np.corrcoef(one[:2000, 0], other[:2000, 0])[0, 1]
    assert abs(correlation) < 0.8
    np.testing.assert_array_equal(one[:, -1], other[:, -1])  # the shaft turns as it did


def test_channels_have_noise_of_their_own(scenario: Scenario, machine: Machine) -> None:
    quiet = scenario.model_copy(update={"events": (), "duration_s": 20.0, "sensors": Sensors()})
    clean, _ = _all(quiet, machine)
    noisy, _ = _all(quiet.model_copy(update={"sensors": Sensors(noise_relative=0.5)}), machine)
    noise = (noisy - clean)[:, :8]
    correlations = np.corrcoef(noise.T) - np.eye(8)
    assert np.abs(correlations).max() < 5 / np.sqrt(40_000)


def test_a_machine_without_the_channel_is_refused(scenario: Scenario, machine: Machine) -> None:
    short = machine.model_copy(update={"sensors": machine.sensors[1:]})
    with pytest.raises(MachineFileError, match=r"events\.1\.sensor: 'y1' is not a channel of machine lab"):
        blocks(scenario, short)
    with pytest.raises(ValueError, match="holds no sample"):
        blocks(scenario, machine, 1e-4)


def test_both_shipped_machines_run(scenario: Scenario) -> None:
    for name in ("lab", "heavy"):
        machine = load_machine(name).model_copy(update={"dtype": "float64"})
        samples, _ = _all(scenario.model_copy(update={"events": ()}), machine)
        assert samples.shape == (8469, 9)
        assert np.all(np.isfinite(samples))
        assert np.all(samples.std(axis=0) > 0)
