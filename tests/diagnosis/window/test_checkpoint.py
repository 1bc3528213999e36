"""The state of a monitor, stored as bytes at any block and restored: everything continues bit for bit."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from models.checkpoint import checked, from_bytes, prefixed, to_bytes, unprefixed
from models.commissioning.commissioned import install
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.likelihood.following import Linearised
from models.diagnosis.likelihood.lengths import LengthFits
from models.diagnosis.likelihood.spectral_model import CORNERS
from models.diagnosis.verdict.sequential_state import SequentialState, finding, hop_arrays
from models.diagnosis.verdict.stretch import Stretch
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.sliding import SlidingWindow, digest_of
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import CheckpointError
from models.ingest import Admission, Gate, Reason
from models.physics.rotor import PARAMETERS
from models.signals.block import SampleBlock
from models.signals.wire import encode_block
from service.monitor.monitor import MachineMonitor
from service.monitor.reports import MonitorReport
from simulator.scenario import Event
from tests.service.rig.live import LAB, scenario_blocks
from tests.sure import sure
from tests.windows import full_windows

FAULT_S, DURATION_S = 78.0, 106.0
WITHOUT_ANGLE = LAB.model_copy(update={"sensors": tuple(one for one in LAB.sensors if one.name != "theta")})
MACHINES = {"phase reference": (LAB, "lab"), "no phase reference": (WITHOUT_ANGLE, None)}


@lru_cache
def stream(machine: str) -> tuple[SampleBlock, ...]:
    """A bearing that loses a quarter of its stiffness, two gaps, and one block twice."""
    fault = Event(at_s=FAULT_S, parameter="k_by", relative_change=-0.25)
    columns = len(MACHINES[machine][0].sensors)
    found = [replace(one, samples=one.samples[:, :columns]) for one in scenario_blocks(DURATION_S, fault)]
    return (*found[:332], *found[337:700], found[650], *found[700:901], *found[904:])


def monitor(machine: str) -> MachineMonitor:
    return MachineMonitor(install(*MACHINES[machine]))


@lru_cache
def uninterrupted(machine: str) -> tuple[MonitorReport, ...]:
    """Reports of an uninterrupted run, after asserting that each hop stores little."""
    running, found, kept = monitor(machine), list[MonitorReport](), tuple[str, ...]()
    for block in stream(machine):
        found.append(running.step(block))
        if found[-1].windows:
            state = running.state(kept)
            kept = state.parts
            assert len(state.state) + sum(len(data) for _, data in state.new_parts) < 20e3
    assert len(kept) > 2
    return tuple(found)


def renewed(
    running: MachineMonitor,
    kept: dict[str, bytes],
    build: Callable[[], MachineMonitor],
    heard: Sequence[tuple[bytes, bytes, str]],
) -> MachineMonitor:
    """Another monitor, restored from bytes alone, that recalls the messages heard so far, if any."""
    state = running.state(tuple(kept), whole=not heard)
    kept |= dict(state.new_parts)
    again = build()
    again.restore(state.state, [kept[name] for name in state.parts])
    again.restore_alarms(state.alarms)
    for payload in heard:
        again.recall(*payload)
    assert again.recalled == ""
    return again


@pytest.mark.slow
@pytest.mark.parametrize(
    ("machine", "recorded"),
    [
        ("no phase reference", False),
        pytest.param("phase reference", False, marks=pytest.mark.long),
        *(pytest.param(machine, True, marks=pytest.mark.long) for machine in MACHINES),
    ],
)
def test_a_monitor_stopped_at_any_block_continues_bit_for_bit(machine: str, recorded: bool) -> None:
    """Statistics, readings, verdicts and alarms; stopped in warm-up, at and between hops, around gap and fault."""
    blocks, expected = stream(machine), uninterrupted(machine)
    rng = np.random.default_rng(11)
    hops = [number for number, report in enumerate(expected) if report.windows]
    after_fault = [number for number in hops if blocks[number].start_ns - blocks[0].start_ns > FAULT_S * 1e9]
    stops = {hops[2] + 1, 335, *(hops[at] + 1 for at in (-9, -7, -1)), *(number + 1 for number in after_fault[:2])}
    stops |= {int(number) for number in rng.integers(0, len(blocks), 2)}
    running, kept = monitor(machine), dict[str, bytes]()
    messages = [encode_block(block, "") for block in blocks] if recorded else []
    for number, block in enumerate(blocks):
        if number in stops:
            running = renewed(running, kept, lambda: monitor(machine), messages[:number])
        assert running.step(block) == expected[number], f"block {number}"
    assert sum(bool(window.parameters) for report in expected for window in report.windows) >= 6
    last = sure(expected[hops[-1]].windows[-1].verdict)
    assert [finding.name for finding in last.changed] == ["k_by"]
    assert {report.verdict.reason for report in expected} == {None, "overlap"}
    assert sum(not report.verdict.continuous for report in expected) == 3  # two gaps, one repetition


@lru_cache
def windows(spread: float = 0.0) -> tuple[WindowStatistics, ...]:
    """Sixteen windows at speeds that are never quite the same, but always between the same two frequencies.

    Within each the speed wanders by `spread`.
    """
    rng, looser = np.random.default_rng(3), Event(at_s=130.0, parameter="c_bz", relative_change=0.6)
    stream = scenario_blocks(138.0, looser)
    return tuple(
        replace(
            full,
            speed_rad_s=full.speed_rad_s * (1.002 + 1e-4 * rng.standard_normal()),
            hop_speed_rad_s=full.hop_speed_rad_s * np.linspace(1 - spread, 1 + spread, full.hop_speed_rad_s.size),
        )
        for full in full_windows(SlidingWindow(plan_for(LAB, lagged=False)), stream)
    )


@pytest.mark.slow
@pytest.mark.parametrize(("spread", "corners"), [pytest.param(0.0, 1, marks=pytest.mark.long), (0.01, CORNERS)])
def test_a_maximum_followed_over_many_windows_continues_bit_for_bit(spread: float, corners: int) -> None:
    """Twelve windows are followed from one search, then one takes its own units: stored after every window."""
    fit, running = LikelihoodFit(LAB, follow=True), LikelihoodFit(LAB, follow=True)
    fit._corners = running._corners = corners
    expected = [fit.diagnose(window) for window in windows(spread)]
    assert len(expected) == 16
    for window, diagnosis in zip(windows(spread), expected, strict=True):
        again = LikelihoodFit(LAB, follow=True)
        again.restore(from_bytes(to_bytes(running.checkpoint())))
        found = again.diagnose(window)
        assert found.parameters == diagnosis.parameters
        assert_same_bits(found.full_covariance, diagnosis.full_covariance)
        assert found.misfit_z == diagnosis.misfit_z
        assert (found.suspect, found.steps) == (diagnosis.suspect, diagnosis.steps)
        running = again


def test_slopes_kept_from_an_earlier_search_are_restored_at_its_speed() -> None:
    """A search that does not move keeps the slopes of the previous search, at that search's speed."""
    first, second = windows()[:2]
    fit = LikelihoodFit(LAB, follow=True)
    fit.diagnose(first)
    line = sure(fit._line)
    search = fit._search(line.model, second, second.speed_rad_s, line.weights.strengths)
    found = search.maximise(line.theta, 0, 0.15, 3.0, line.derivatives)
    assert found.derivatives.speed_rad_s == first.speed_rad_s != second.speed_rad_s
    moved = Linearised.around(line.model, search.weights, found)
    again = Linearised.restored(line.model, search.weights, from_bytes(to_bytes(moved.checkpoint())))
    assert_same_bits(again.derivatives.slopes, moved.derivatives.slopes)
    assert_same_bits(again.derivatives.information, moved.derivatives.information)


@lru_cache
def remembered() -> dict[str, np.ndarray]:
    """The arrays of a monitor that follows a maximum, with all that is in its window."""
    running = monitor("no phase reference")
    for block in stream("no phase reference")[:690]:
        running.step(block)
    state = running.state(whole=True)
    return from_bytes(state.state) | {
        name: array for _, part in state.new_parts for name, array in from_bytes(part).items()
    }


def test_the_digest_of_samples_does_not_depend_on_their_precision() -> None:
    single = np.random.default_rng(7).standard_normal((50, 3)).astype(np.float32)
    double = single.astype(np.float64)
    assert digest_of(single) == digest_of(double) != digest_of(double * (1 + 1e-12))


def test_a_state_that_does_not_fit_is_refused_and_changes_nothing() -> None:
    arrays = remembered()
    window = unprefixed("window", arrays)
    empty = SlidingWindow(plan_for(WITHOUT_ANGLE, lagged=False))
    with pytest.raises(CheckpointError, match=r"^times_ns is missing$"):
        empty.restore({name: array for name, array in window.items() if not name.startswith("hop_3/")})
    with pytest.raises(CheckpointError, match="other channels or settings"):
        SlidingWindow(plan_for(WITHOUT_ANGLE, lagged=True)).restore(window)
    with pytest.raises(CheckpointError, match=r"pending has .* expected float32 and .*, 9\)"):
        SlidingWindow(plan_for(LAB, lagged=False)).restore(window)
    with pytest.raises(CheckpointError, match="level is missing"):
        empty.restore({name: array for name, array in window.items() if name != "level"})
    with pytest.raises(CheckpointError, match="level has no values"):
        empty.restore(window | {"level": np.empty(0)})
    assert empty.hops == ()
    assert not empty.lacks
    empty.restore(window)
    assert len(empty.hops) == 12
    likelihood = unprefixed("evaluator/likelihood", arrays)
    for change in (
        {"window/states": np.array(["y1", "nowhere"])},
        {"window/scale": np.ones(3)},
        {"window/line/information": np.ones((2, 2))},
        {"window/line/searched": np.full_like(likelihood["window/line/searched"], np.nan)},
        {"window/excluded": np.ones_like(likelihood["window/excluded"])},
        {"hop": np.array(1.5)},
    ):
        fits = LengthFits(WITHOUT_ANGLE)
        with pytest.raises(CheckpointError):
            fits.restore(likelihood | change)
        assert fits.checkpoint().keys() == LengthFits(WITHOUT_ANGLE).checkpoint().keys()
    gate = Gate(LAB)
    with pytest.raises(CheckpointError, match="courses"):
        gate.restore({"courses": np.array([["1", "2", "x", "4", "5"]])})
    assert gate.courses == ()
    with pytest.raises(CheckpointError, match="findings are of parameters"):
        SequentialState.restored(
            SequentialState().checkpoint() | {"findings": np.array([[9, 1, 2]]), "finding_stretch_s": np.ones(1)}
        )


def test_a_gate_restored_during_a_clock_step_continues_identically() -> None:
    blocks = scenario_blocks(6.0)
    stepped = [replace(one, start_ns=one.start_ns - 10**12) for one in blocks[20:]]
    wild = replace(blocks[7], start_ns=blocks[7].start_ns + 10**12)
    arriving = [*blocks[:7], wild, *blocks[8:20], wild, *stepped[:5], blocks[3], *stepped[2:30], blocks[19]]
    arriving += [*stepped[30:], wild, blocks[2]]
    expected = [Gate(LAB).judge(one) for one in arriving[:1]]
    for stop in range(1, len(arriving)):
        gate = Gate(LAB)
        verdicts = [gate.judge(one) for one in arriving[:stop]]
        again = Gate(LAB)
        again.restore(from_bytes(to_bytes(gate.checkpoint())))
        verdicts += [again.judge(one) for one in arriving[stop:]]
        assert len(expected) == 1 or verdicts == expected
        expected = verdicts
    assert sum(one.clock_step_s != 0 for one in expected) == 1
    assert expected[-3] == Admission()
    assert [one.reason for one in expected[-2:]] == [Reason.OVERLAP, Reason.OVERLAP]


numbers = st.floats(width=64)
times = st.integers(-(2**62), 2**62)


@st.composite
def stretches(draw: st.DrawFn) -> Stretch:
    n = len(PARAMETERS)
    lower = np.tril(draw(arrays_of.arrays(np.float64, (n, n), elements=numbers)))
    common = arrays_of.arrays(np.float64, (n, n), elements=numbers)
    return Stretch(
        draw(times), draw(times), draw(arrays_of.arrays(np.float64, (n,), elements=numbers)),
        lower + np.tril(lower, -1).T, draw(st.none() | numbers), draw(st.none() | common),
    )  # fmt: skip


limits = st.tuples(times, times).map(lambda both: (min(both), max(both)))
findings = st.builds(finding, st.sampled_from(PARAMETERS), times, times, numbers, st.none() | limits)
states = st.builds(
    SequentialState,
    st.dictionaries(
        st.sampled_from([1, 2, 4, 8, 16, 32]),
        st.lists(stretches(), min_size=1, max_size=4, unique_by=lambda one: one.end_ns).map(
            lambda ring: sorted(ring, key=lambda one: one.end_ns)
        ),
    ),
    st.none() | times,
    st.tuples(*[numbers] * len(PARAMETERS)),
    st.lists(findings, max_size=3).map(tuple),
    st.none() | times,
    st.none() | times,
)


@settings(max_examples=15, suppress_health_check=[HealthCheck.data_too_large])
@given(states)
def test_the_state_of_the_sequential_test_is_restored_exactly(state: SequentialState) -> None:
    hops = [from_bytes(to_bytes(hop_arrays(came))) for _, came in sorted(state.hops().items())]
    again = SequentialState.restored(from_bytes(to_bytes(state.checkpoint())), hops)
    assert shown(again) == shown(state)
    older = {name: array for name, array in state.checkpoint().items() if name not in {"dated_ns", "between_ns"}}
    without = SequentialState.restored(older, hops)  # as an earlier version stored it
    assert (without.dated_ns, {one.between_ns for one in without.findings} - {None}) == (None, set())


def shown(state: SequentialState) -> str:
    """The complete state with every number in full precision."""
    with np.printoptions(floatmode="unique", threshold=1000):
        return repr(replace(state, sums=dict(sorted(state.sums.items()))))


def assert_same_bits(one: np.ndarray, other: np.ndarray) -> None:
    assert (one.dtype, one.shape) == (other.dtype, other.shape)
    assert np.array_equal(one, other, equal_nan=one.dtype.kind in "fc")
    if one.dtype.kind == "f":
        np.testing.assert_array_equal(np.signbit(one), np.signbit(other))


shapes = arrays_of.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
kinds = (np.dtype(np.float64), np.dtype(np.complex128), np.dtype(np.int64), np.dtype(np.bool_), np.dtype("<U5"))
of_any_kind: st.SearchStrategy[np.ndarray] = st.one_of([arrays_of.arrays(kind, shapes) for kind in kinds])
named = st.dictionaries(st.text("abcdefghij_/.file", min_size=1, max_size=12), of_any_kind, max_size=5)


@settings(max_examples=30)
@given(named)
def test_arrays_round_trip_through_bytes(arrays: dict[str, np.ndarray]) -> None:
    data = to_bytes(arrays)
    again = from_bytes(data)
    assert list(again) == list(arrays)
    for name, array in arrays.items():
        assert_same_bits(again[name], array)
    assert data == to_bytes(again)


def test_memory_order_is_kept_and_object_arrays_are_refused() -> None:
    across = np.asfortranarray(np.arange(12.0).reshape(3, 4))
    again = from_bytes(to_bytes({"across": across}))["across"]
    assert again.flags.f_contiguous
    assert not again.flags.c_contiguous
    with pytest.raises(CheckpointError, match="nothing: an array of type object"):
        to_bytes({"nothing": np.array([None])})


@settings(max_examples=60)
@given(st.data())
def test_damaged_bytes_are_refused(data: st.DataObject) -> None:
    whole = to_bytes({"level": np.arange(5.0), "names": np.array(["y1", "z1"])})
    at = data.draw(st.integers(0, len(whole) - 1))
    flipped = bytearray(whole)
    flipped[at] ^= 1 << data.draw(st.integers(0, 7))
    for damaged in (bytes(flipped), whole[:at], whole + b"\0"):
        with pytest.raises(CheckpointError):
            from_bytes(damaged)


@pytest.mark.parametrize(
    ("foreign", "says"),
    [
        (b"", "0 bytes"),
        (b"PK\x03\x04" + bytes(100), "expected a checkpoint"),
        (b"RWCP\x09\x00" + bytes(100), "format 9, expected format 2"),
        (b"RWCP\x02\x00" + bytes(100), "damaged"),
    ],
)
def test_foreign_bytes_are_refused(foreign: bytes, says: str) -> None:
    with pytest.raises(CheckpointError, match=says):
        from_bytes(foreign)


def test_prefixes_separate_the_parts_of_a_state() -> None:
    parts = prefixed("a", {"x": np.array(1)}) | prefixed("ab", {"x": np.array(2)})
    assert unprefixed("a", parts) == {"x": np.array(1)}
    assert unprefixed("b", parts) == {}
    with pytest.raises(CheckpointError, match=r"^x is missing$"):
        checked(parts, "x", np.int64, ())


@pytest.mark.slow
def test_a_window_is_recalled_although_a_block_arrives_out_of_order() -> None:
    blocks, before = stream("phase reference"), monitor("phase reference")
    for block in blocks[:680]:
        before.step(block)
    state = before.state()
    expected = [window for block in blocks[680:760] for window in before.step(block).windows]
    after = monitor("phase reference")
    after.restore(state.state, [part for _, part in state.new_parts])
    after.restore_alarms(state.alarms)
    arriving = [*blocks[:679], blocks[680], blocks[679], *blocks[681:760]]
    said = [one for block in arriving for one in after.step_payload(*encode_block(block, ""))]
    assert after.recalled == ""
    assert [window for one in said for window in one.windows] == expected != []
