"""The gate: reasons for refusal, gaps, restarts and stepped clocks, on sequences of blocks."""

import numpy as np
import pytest

from models.ingest import Admission, Gate, Reason
from models.machine import load_machine
from models.signals.block import SampleBlock

MACHINE = load_machine("lab")
START_NS = 1_800_000_000_000_000_000
LENGTH = 200
STEP_NS = 100_000_000


def block(number: int, *, sequence: int | None = None, run: int = 1, shift_ns: int = 0) -> SampleBlock:
    samples = np.random.default_rng(number).standard_normal((LENGTH, 9)).astype(np.float32)
    start_ns = START_NS + number * STEP_NS + shift_ns
    return SampleBlock(start_ns, number if sequence is None else sequence, run, 2000.0, samples)


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
