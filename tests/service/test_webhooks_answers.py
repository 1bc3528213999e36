"""What a receiver's answers mean, and how long the pauses after them are."""

import pytest

from service.delivery.webhooks.answer import Answer, Meaning, answer_of, no_answer, pause_s


@pytest.mark.parametrize(
    ("status", "meaning"),
    [
        (200, Meaning.DELIVERED), (202, Meaning.DELIVERED), (204, Meaning.DELIVERED), (301, Meaning.REFUSED),
        (308, Meaning.REFUSED), (400, Meaning.REFUSED), (404, Meaning.REFUSED), (408, Meaning.TROUBLE),
        (410, Meaning.GONE), (413, Meaning.REFUSED), (425, Meaning.TROUBLE), (429, Meaning.TROUBLE),
        (499, Meaning.REFUSED), (500, Meaning.TROUBLE), (599, Meaning.TROUBLE),
    ],
)  # fmt: skip
def test_meaning_of_answers(status: int, meaning: Meaning) -> None:
    answer = answer_of(status, {}, 0.0)
    assert answer.meaning is meaning
    assert (answer.text == "") == (meaning is Meaning.DELIVERED)


@pytest.mark.parametrize(
    ("text", "wished_s"),
    [
        ("30", 30.0), (" 7 ", 7.0), ("999999999999", 3600.0), ("-5", 0.0), ("soon", 0.0), ("", 0.0), ("²", 0.0),
        ("Thu, 01 Jan 2026 00:02:00 GMT", 120.0), ("Thu, 01 Jan 2026 00:02:00", 120.0),
        ("Wed, 31 Dec 2025 00:00:00 GMT", 0.0), ("Fri, 01 Jan 2100 00:00:00 GMT", 3600.0),
    ],
)  # fmt: skip
def test_a_receiver_may_say_when_to_come_back(text: str, wished_s: float) -> None:
    answer = answer_of(503, {"retry-after": text}, 1_767_225_600.0)
    assert answer.retry_after_s == wished_s
    assert pause_s(answer, 1, 300.0, 1.0) == max(1.0, wished_s)


def test_pauses_differ_by_chance_and_are_bounded() -> None:
    refused = Answer(Meaning.REFUSED, "404 Not Found")
    assert pause_s(no_answer(""), 3, 300.0, 0.0) == 2.0
    assert pause_s(no_answer(""), 3, 300.0, 0.5) == 3.0
    assert pause_s(no_answer(""), 10_000, 300.0, 1.0) == 300.0
    assert pause_s(refused, 1, 300.0, 1.0) == 60.0
    assert pause_s(refused, 4, 300.0, 1.0) == 300.0
    assert pause_s(refused, 1, 5.0, 1.0) == 5.0
