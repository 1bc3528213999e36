"""What has come for many machines is taken by one thread."""

from collections import deque

import pytest

from service.stream.intake import Intake
from tests.service.live import until


def test_messages_are_taken_in_their_order_until_that_is_ended() -> None:
    intake, waiting, taken = Intake(), deque(range(2500)), list[int]()
    end = intake.add(lambda: waiting.popleft() if waiting else None, taken.append)
    try:
        until(lambda: len(taken) == 2500, "all messages")
        end()
        waiting.append(2500)
        other, seen = deque([1]), list[int]()
        intake.add(lambda: other.popleft() if other else None, seen.append)
        until(lambda: seen == [1], "the message of another channel")
        end()
    finally:
        intake.close()
    assert taken == list(range(2500))


def test_a_channel_that_is_no_more_ends_no_other(capsys: pytest.CaptureFixture[str]) -> None:
    def gone() -> None:
        raise RuntimeError("undeclared")

    intake, waiting, taken = Intake(), deque([1, 2]), list[int]()
    intake.add(gone, taken.append)
    intake.add(lambda: waiting.popleft() if waiting else None, taken.append)
    try:
        until(lambda: taken == [1, 2], "the messages of the other channel")
        waiting.append(3)
        until(lambda: taken == [1, 2, 3], "what came later")
    finally:
        intake.close()
    assert "".join(capsys.readouterr()).count("messages can no longer be taken") == 1
