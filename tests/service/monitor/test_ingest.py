"""The gate: each reason to refuse, gaps, restarts, stepped clocks, as a table of blocks."""

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


def test_contiguous_blocks_are_accepted_silently_with_jitter_too() -> None:
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
def test_what_does_not_follow_on_is_accepted_and_measured(later: SampleBlock, gap_s: float, told: str) -> None:
    verdict = judge(block(0), later)[1]
    assert (verdict.accepted, verdict.continuous) == (True, False)
    assert verdict.gap_s == pytest.approx(gap_s)
    assert told in verdict.text


def far(shift_s: int, run: int, count: int = 12) -> list[SampleBlock]:
    """Blocks that go on elsewhere in time, from sequence 0 in a run of their own, else as if nothing had happened."""
    return [block(n, sequence=n if run == 1 else n - 1, run=run, shift_ns=shift_s * 10**9) for n in range(1, count + 1)]


@pytest.mark.parametrize("run", [1, 2], ids=["same run", "new run"])
@pytest.mark.parametrize(("shift_s", "reason"), [(-5000, Reason.PAST), (5000, Reason.FUTURE)])
def test_another_time_is_believed_after_ten_blocks_that_agree(shift_s: int, reason: Reason, run: int) -> None:
    """Within a run the clock was set; a run that begins elsewhere is a publisher that was started anew."""
    verdicts = judge(block(0), *far(shift_s, run))[1:]
    assert [verdict.reason for verdict in verdicts] == [reason] * 9 + [None] * 3
    assert ("publisher restarted" in verdicts[9].text) is (run == 2)
    assert verdicts[9].new_run is (run == 2)
    assert verdicts[9].clock_step_s == pytest.approx(shift_s + 0.9)
    assert verdicts[9].gap_s == 0.0  # nothing is missing: the time is another one
    assert not verdicts[9].continuous
    assert verdicts[10].continuous


def test_a_run_that_was_there_before_is_no_new_one() -> None:
    """Two publishers that take turns on one key are told by their clocks."""
    verdicts = judge(block(0), *far(-5000, 2), *(block(n) for n in range(1, 12)))
    back = [verdict for verdict in verdicts[13:] if verdict.accepted]
    assert not back[0].new_run
    assert back[0].clock_step_s > 0


def test_wild_times_cost_their_blocks_and_never_move_the_clock() -> None:
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


def test_what_was_there_before_a_restart_is_no_news_once() -> None:
    gate = Gate(MACHINE)
    blocks = [block(number) for number in range(8)]
    for one in blocks[:5]:
        gate.judge(one)
    gate.begin()
    gate.judge(blocks[5])
    assert [gate.had(one) for one in blocks] == [True] * 5 + [False] * 3
    assert not any(gate.had(one) for one in blocks)  # whoever goes on repeating them is refused


def test_repeated_history_of_the_same_run_never_moves_the_clock() -> None:
    blocks = [block(n) for n in range(30)]
    verdicts = judge(*blocks, *blocks, block(30))
    assert all(verdict.reason is Reason.OVERLAP for verdict in verdicts[30:60])
    assert verdicts[60] == Admission()
