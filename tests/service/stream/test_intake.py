"""What has come for many machines is taken by one thread."""

from collections import deque

from service.stream.intake import Intake
from tests.service.rig.live import until


def test_all_channels_are_emptied_until_that_is_ended() -> None:
    intake, waiting, taken = Intake(), deque([1, 2]), list[int]()
    other, seen = deque[int](), list[int]()

    def empty() -> None:
        taken.extend(waiting.popleft() for _ in range(len(waiting)))

    end = intake.add(empty)
    intake.add(lambda: seen.extend(other.popleft() for _ in range(len(other))))
    try:
        until(lambda: taken == [1, 2], "the first messages")
        waiting.append(3)
        until(lambda: taken == [1, 2, 3], "what came later")
        end()
        waiting.append(4)
        other.append(5)
        until(lambda: seen == [5], "the message of the other channel")
        end()  # once more changes nothing
    finally:
        intake.close()
    assert taken == [1, 2, 3]
