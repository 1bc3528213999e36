"""Who sends a machine's stream."""

from dataclasses import replace

import numpy as np
import pytest

from models.arrivals import Senders
from models.signals.block import SampleBlock

S = 10**9


def block(sequence: int, run: int = 1, start_s: float = 0.0, value: float = 0.0) -> SampleBlock:
    samples = np.full((10, 2), value, dtype=np.float32)
    return SampleBlock(round((start_s + sequence) * S), sequence, run, 10.0, samples)


def test_one_publisher_with_repetitions_and_reordering_contradicts_nobody() -> None:
    senders = Senders()
    rng = np.random.default_rng(1)
    order = np.argsort(np.arange(400) + rng.uniform(0, 8, 400))
    for number in (*order[:200], *order[150:400]):
        assert not senders.take(block(int(number)))
    assert senders.conflict == ""


def test_restarts_contradict_nobody() -> None:
    senders = Senders()
    for run in range(1, 30):
        late = [block(20 + n, run - 1, start_s=100 * (run - 1)) for n in range(4)] if run > 1 else []
        for n in range(20):
            assert not senders.take(block(n, run, start_s=100 * run))
            if late and n % 2:
                senders.take(late.pop(0))  # what was still on its way
    assert senders.conflict == ""


def test_a_count_that_begins_anew_is_no_other_version() -> None:
    senders = Senders()
    for start_s in (0.0, 50.0, 300.0):
        for n in range(20):
            assert not senders.take(block(n, run=0, start_s=start_s, value=start_s))
    assert senders.conflict == ""


@pytest.mark.parametrize(("runs", "first"), [((1, 2), 0), ((0, 0), 100_000)])
def test_two_publishers_are_named_as_long_as_both_send(runs: tuple[int, int], first: int) -> None:
    senders = Senders()
    a, b = runs
    for n in range(30):
        senders.take(block(n, a))
        senders.take(block(first + n, b, start_s=-first, value=1.0))
    assert f"runs {a} and {b} both send" in senders.conflict
    for n in range(30, 400):
        senders.take(block(n, a))
    assert senders.conflict == ""


def test_a_slow_second_publisher_is_noticed_too() -> None:
    senders = Senders()
    for n in range(200):
        senders.take(block(n, 1))
        if n % 20 == 0:
            senders.take(block(n // 20, 2))
    assert "both send" in senders.conflict


def test_of_a_block_in_two_versions_neither_is_believed() -> None:
    senders = Senders()
    for n in range(10):
        assert not senders.take(block(n))
    forged = replace(block(12), samples=block(12).samples + 1)
    assert not senders.take(forged)  # nobody knows yet
    assert not senders.take(block(10))
    assert not senders.take(block(11))
    assert senders.take(block(12))
    assert senders.take(forged)
    assert senders.take(block(12))
    assert not senders.take(block(13))
    assert "block 12 of run 1" in senders.conflict
