"""Blocks that the network delivered twice, late or not at all; refusals, gaps, restarts and stepped clocks."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.arrivals import Arrivals
from models.ingest import Admission, Course, Gate, Reason
from models.machine import load_machine
from models.signals.block import SampleBlock

MACHINE = load_machine("lab")
START_NS, STEP_NS, LENGTH = 1_800_000_000_000_000_000, 100_000_000, 200
SAMPLES = np.random.default_rng(1).standard_normal((LENGTH, 9)).astype(np.float32)
BOUND = 5


def block(number: int, *, sequence: int | None = None, run: int = 1, shift_ns: int = 0) -> SampleBlock:
    start_ns = START_NS + number * STEP_NS + shift_ns
    return SampleBlock(start_ns, number if sequence is None else sequence, run, 2000.0, SAMPLES)


def told(blocks: Iterable[SampleBlock]) -> list[tuple[int, int, int]]:
    return [(one.run, one.sequence, one.start_ns) for one in blocks]


def ordered(stream: Iterable[SampleBlock], bound: int = BOUND, arrivals: Arrivals | None = None) -> list[SampleBlock]:
    """Blocks that are passed on to the gate, up to the end of the stream."""
    arrivals = Arrivals(bound) if arrivals is None else arrivals
    found = []
    for one in stream:
        found += [*arrivals.take(one)]
        assert arrivals.waiting <= bound
    found += [*arrivals.flush()]
    assert arrivals.waiting == 0
    return found


def accepted(stream: Iterable[SampleBlock], gate: Gate | None = None) -> list[tuple[tuple[int, int, int], str]]:
    """Accepted blocks and what the gate says of each."""
    gate = Gate(MACHINE) if gate is None else gate
    verdicts = [(one, gate.judge(one)) for one in stream]
    return [(told([one])[0], verdict.text) for one, verdict in verdicts if verdict.accepted]


def refused(stream: Iterable[SampleBlock]) -> list[Reason]:
    gate = Gate(MACHINE)
    return [verdict.reason for one in stream if (verdict := gate.judge(one)).reason is not None]


def delivered(
    stream: Sequence[SampleBlock], late: Sequence[int], again: Sequence[tuple[int, int]]
) -> list[SampleBlock]:
    """The stream with each block overtaken by up to `late` others, and repetitions later on."""
    keys = [number + extra for number, extra in zip(range(len(stream)), late, strict=True)]
    order = sorted(range(len(stream)), key=lambda number: (keys[number], -number))
    found = [stream[number] for number in order]
    for which, after in again:
        # Not before its original has arrived: what comes first is the original.
        at = order.index(which % len(stream)) + 1
        found.insert(min(len(found), at + after), stream[which % len(stream)])
        order.insert(min(len(order), at + after), -1)
    return found


def lateness(n: int, bound: int = BOUND) -> st.SearchStrategy[list[int]]:
    return st.lists(st.integers(0, bound), min_size=n, max_size=n)


repetitions = st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 80)), max_size=12)
N = 40


@settings(max_examples=100)
@given(lateness(N), repetitions, st.just(set[int]()) | st.sets(st.integers(1, N - 1), max_size=12))
def test_reordering_and_repetition_change_nothing_and_missing_blocks_lose_no_others(
    late: list[int], again: list[tuple[int, int]], lost: set[int]
) -> None:
    whole = [block(number) for number in range(N)]
    stream = [one for one in whole if one.sequence not in lost]
    arriving = [one for one in delivered(whole, late, again) if one.sequence not in lost]
    gone_on = ordered(arriving)
    assert accepted(gone_on) == accepted(stream)
    if not lost:
        assert len(gone_on) == len(arriving)  # the gate hears of every repetition
        assert refused(gone_on) == [Reason.OVERLAP] * len(again)


@pytest.mark.slow
@settings(max_examples=60)
@given(
    lateness(3 * N), repetitions, st.sampled_from([-3600, -50, -2, 0, 2, 900, 7200]), st.integers(-20, 400),
    st.booleans(),
)  # fmt: skip
def test_a_clock_step_and_a_restart_change_nothing(
    late: list[int], again: list[tuple[int, int]], clock_s: int, pause: int, has_run: bool
) -> None:
    """The gate accepts the same, and repetitions of earlier blocks are still repetitions."""
    run = 2 if has_run else 1
    first = [block(number) for number in range(N)]
    second = [block(number, shift_ns=clock_s * 10**9) for number in range(N, 2 * N)]
    third = [
        block(number + 2 * N + pause, sequence=number if has_run else 2 * N + number, run=run, shift_ns=clock_s * 10**9)
        for number in range(N)
    ]
    stream = [*first, *second, *third]
    assert accepted(ordered(stream)) == accepted(stream)
    # Blocks of different runs overtake each other only if a publisher overtakes its own restart.
    late[N * 2 - BOUND : 2 * N] = [0] * BOUND
    gone_on = ordered(delivered(stream, late, again))
    assert accepted(gone_on) == accepted(stream)


def test_any_block_may_be_repeated_anywhere() -> None:
    """A wild time, a clock set back, set ahead, and a restart: every block repeated after every later one."""
    back, ahead = -1000 * 10**9, 9000 * 10**9
    stream = [
        *(block(number) for number in range(4)),
        block(4, shift_ns=10**12),
        *(block(number) for number in range(5, 7)),
        *(block(number, shift_ns=back) for number in range(7, 20)),
        *(block(number, shift_ns=ahead) for number in range(20, 33)),
        *(block(number, sequence=number - 33, run=2, shift_ns=ahead) for number in range(33, 36)),
    ]
    expected = accepted(stream)
    assert len(expected) == len(stream) - 1 - 9 - 9
    for which in range(len(stream)):
        for after in range(which, len(stream)):
            arriving = [*stream[: after + 1], stream[which], *stream[after + 1 :]]
            assert accepted(arriving) == expected, (which, after)
            assert accepted(ordered(arriving)) == expected, (which, after)


@settings(max_examples=100)
@given(lateness(N), repetitions, st.lists(st.integers(0, N), max_size=3))
def test_restarts_of_a_monitor_change_nothing(late: list[int], again: list[tuple[int, int]], stops: list[int]) -> None:
    """Waiting blocks are lost with the monitor and come again, with many others, from the publisher's cache."""
    stream = [block(number) for number in range(N)]
    arriving = delivered(stream, late, again)
    gate, arrivals = Gate(MACHINE), Arrivals(BOUND)
    found = []
    for number, one in enumerate(arriving):
        for _ in range(stops.count(number)):
            state = gate.checkpoint()
            gate, arrivals = Gate(MACHINE), Arrivals(BOUND)
            gate.restore(state)
            arrivals.resume(gate.courses)
            for cached in sorted(arriving[:number], key=lambda each: each.sequence)[-30:]:
                found += accepted(arrivals.take(cached), gate)
        found += accepted(arrivals.take(one), gate)
    found += accepted(arrivals.flush(), gate)
    assert found == accepted(stream)


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(st.integers(0, 12), st.integers(0, 2), st.integers(-30, 30), st.sampled_from([0, 1, 2**64 - 2])),
        max_size=80,
    ),
    st.integers(0, 4),
)
def test_every_block_is_passed_on_and_memory_is_bounded(coming: list[tuple[int, int, int, int]], bound: int) -> None:
    stream = [
        block(number, sequence=number + far, run=run, shift_ns=wrong * STEP_NS) for number, run, wrong, far in coming
    ]
    arrivals = Arrivals(bound)
    gone_on = []
    for one in stream:
        gone_on += [*arrivals.take(one)]
        held = {id(each) for copies in arrivals._waiting.values() for each in copies}
        assert len(held) <= bound
    gone_on += [*arrivals.flush()]
    # Every block is passed on; beyond `bound`, copies of a waiting block may be dropped.
    assert set(told(gone_on)) == set(told(stream))
    assert len(gone_on) <= len(stream)
    if bound == 0:
        assert gone_on == stream


def test_a_missing_block_is_awaited_and_given_up_at_the_bound() -> None:
    arrivals = Arrivals(3)

    def took(number: int) -> list[int]:
        return [arrived.sequence for arrived in arrivals.take(block(number))]

    assert [took(number) for number in (0, 2, 3, 4)] == [[0], [], [], []]
    assert arrivals.waiting == 3
    assert took(6) == [2, 3, 4]  # block 1 is given up, block 5 is not
    assert arrivals.waiting == 1
    assert took(5) == [5, 6]
    assert took(1) == [1]  # too late; the gate says so
    assert took(7) == [7]
    assert took(9) == []
    assert [arrived.sequence for arrived in arrivals.flush()] == [9]
    assert took(10) == [10]


def test_repetitions_of_a_waiting_block_follow_it() -> None:
    arrivals = Arrivals(2)
    other = replace(block(2), samples=SAMPLES + 1)
    for one in (block(0), block(2), block(2), block(2), block(2), other):
        arrivals.take(one)
    assert arrivals.waiting == 1
    gone_on = [*arrivals.take(block(1))]
    assert [one.sequence for one in gone_on] == [1, 2, 2, 2, 2]  # not more copies than the bound
    assert gone_on[-1] is other  # another content under the same number is not thrown away
    assert refused([block(0), *gone_on]) == [Reason.OVERLAP] * 3


def test_a_stream_joined_late_begins_at_once_and_a_new_one_awaits_its_first_block() -> None:
    late, young = Arrivals(3), Arrivals(3)
    assert len(late.take(block(36_000))) == 1
    assert young.take(block(2)) == young.take(block(1)) == ()
    assert [arrived.sequence for arrived in young.take(block(0))] == [0, 1, 2]


def test_a_new_run_ends_the_waiting_of_the_previous_run() -> None:
    arrivals = Arrivals(3)
    for number in (0, 2):
        arrivals.take(block(number))
    gone_on = [*arrivals.take(block(9, sequence=0, run=2))]
    assert told(gone_on) == told([block(2), block(9, sequence=0, run=2)])
    arrivals.take(block(11, sequence=2, run=2))
    assert len(arrivals.take(block(0))) == 1  # a repetition of the old run does not end the waiting of the new one
    assert arrivals.waiting == 1


def test_malformed_blocks_keep_their_place() -> None:
    broken = replace(block(2), samples=np.full((LENGTH, 9), np.nan, np.float32))
    narrow = replace(block(3), samples=np.zeros((LENGTH, 2), np.float32))
    arriving = [block(0), narrow, block(4), broken, broken, block(1)]
    gone_on = ordered(arriving)
    assert told(gone_on) == told([block(0), block(1), broken, broken, narrow, block(4)])
    assert refused(gone_on) == [Reason.NOT_FINITE] * 2 + [Reason.CHANNELS]


def test_arrivals_resume_at_the_block_that_a_restored_gate_expects() -> None:
    arrivals = Arrivals(3)
    arrivals.resume((Course(1, 0, -(2**63), 7, 2**63),))
    assert len(arrivals.take(block(3))) == 1  # there already
    assert arrivals.take(block(8)) == ()
    assert [arrived.sequence for arrived in arrivals.take(block(7))] == [7, 8]
    arrivals.resume(())
    assert [arrived.sequence for arrived in arrivals.take(block(100))] == [100]


def judge(*blocks: SampleBlock) -> list[Admission]:
    gate = Gate(MACHINE)
    return [gate.judge(each) for each in blocks]


def test_contiguous_blocks_are_accepted_even_with_jitter() -> None:
    assert judge(*(block(number) for number in range(5))) == [Admission()] * 5
    assert judge(block(0), block(1, shift_ns=150_000), block(2))[1:] == [Admission(), Admission()]


@pytest.mark.parametrize(
    ("later", "gap_s", "told"),
    [
        (block(4), 0.3, "0.3 s of data are missing (3 blocks)"),
        (block(1, sequence=0, run=2), 0.0, "restarted"),
        (block(9, sequence=0, run=2), 0.8, "restarted"),
        (block(1, shift_ns=500_000), 0.0005, ""),  # a sample
    ],
)
def test_gaps_and_restarts_are_accepted_and_measured(later: SampleBlock, gap_s: float, told: str) -> None:
    verdict = judge(block(0), later)[1]
    assert (verdict.accepted, verdict.continuous) == (True, False)
    assert verdict.gap_s == pytest.approx(gap_s)
    assert told in verdict.text


def far(shift_s: int, run: int, count: int = 12) -> list[SampleBlock]:
    """Blocks at shifted times, from sequence 0 in a new run, otherwise with the sequence continued."""
    return [block(n, sequence=n if run == 1 else n - 1, run=run, shift_ns=shift_s * 10**9) for n in range(1, count + 1)]


@pytest.mark.parametrize("run", [1, 2], ids=["same run", "new run"])
@pytest.mark.parametrize(("shift_s", "reason"), [(-5000, Reason.PAST), (5000, Reason.FUTURE)])
def test_a_shifted_time_is_accepted_after_ten_consistent_blocks(shift_s: int, reason: Reason, run: int) -> None:
    """Within a run the clock was set; in a new run the publisher was restarted."""
    verdicts = judge(block(0), *far(shift_s, run))[1:]
    assert [verdict.reason for verdict in verdicts] == [reason] * 9 + [None] * 3
    assert ("publisher restarted" in verdicts[9].text) is (run == 2)
    assert verdicts[9].new_run is (run == 2)
    assert verdicts[9].clock_step_s == pytest.approx(shift_s + 0.9)
    assert verdicts[9].gap_s == 0.0  # nothing is missing: only the time has changed
    assert not verdicts[9].continuous
    assert verdicts[10].continuous


def test_a_known_run_is_not_taken_for_a_new_one() -> None:
    """Two publishers alternating on one key are recognised by their clocks."""
    verdicts = judge(block(0), *far(-5000, 2), *(block(n) for n in range(1, 12)))
    back = [verdict for verdict in verdicts[13:] if verdict.accepted]
    assert not back[0].new_run
    assert back[0].clock_step_s > 0


def test_blocks_with_wild_times_are_refused_and_never_move_the_clock() -> None:
    wild = block(1, shift_ns=1000 * 10**9)
    verdicts = judge(block(0), wild, block(2), block(3))
    assert verdicts[1].reason is Reason.FUTURE
    assert "is the next one" in verdicts[1].text
    assert verdicts[2].gap_s == pytest.approx(0.1)
    assert verdicts[3].continuous
    scattered = [block(n, run=2, shift_ns=n * 9000 * 10**9) for n in range(1, 40)]
    assert all(verdict.reason is Reason.FUTURE for verdict in judge(block(0), *scattered)[1:])
    uncounted = [block(n, sequence=2 * n, run=2, shift_ns=9000 * 10**9) for n in range(1, 40)]
    assert all(verdict.reason is Reason.FUTURE for verdict in judge(block(0), *uncounted)[1:])
    again = judge(block(0), wild, block(2), wild)[3]
    assert (again.reason, "was refused before" in again.text) == (Reason.OVERLAP, True)


def test_blocks_repeated_after_a_restart_are_recognised_once() -> None:
    gate = Gate(MACHINE)
    blocks = [block(number) for number in range(8)]
    for one in blocks[:5]:
        gate.judge(one)
    gate.begin()
    gate.judge(blocks[5])
    assert [gate.had(one) for one in blocks] == [True] * 5 + [False] * 3
    assert not any(gate.had(one) for one in blocks)  # a second repetition is refused


def test_repeated_history_of_the_same_run_never_moves_the_clock() -> None:
    blocks = [block(n) for n in range(30)]
    verdicts = judge(*blocks, *blocks, block(30))
    assert all(verdict.reason is Reason.OVERLAP for verdict in verdicts[30:60])
    assert verdicts[60] == Admission()
