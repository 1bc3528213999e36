"""What a receiver's answer means for what is sent next, and when."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from enum import Enum, auto
from http import HTTPStatus

_FIRST_S = {"trouble": 1.0, "refused": 60.0}
_LONGEST_ASKED_S = 3600.0
_MOST_DOUBLINGS = 30


class Meaning(Enum):
    """What the outcome of an attempt means for the next one."""

    DELIVERED = auto()
    """The event is taken."""
    TROUBLE = auto()
    """The receiver cannot be reached or is not well: nothing can be sent to it for a while."""
    REFUSED = auto()
    """The receiver does not want this event; others may be taken."""
    GONE = auto()
    """The receiver wants nothing any more."""


@dataclass(frozen=True, slots=True)
class Answer:
    """An attempt's outcome."""

    meaning: Meaning
    text: str = ""  # in a few words; empty if delivered
    retry_after_s: float = 0.0  # how long the receiver wishes to be left alone, in seconds


def answer_of(status: int, headers: Mapping[str, str], now_s: float) -> Answer:
    """The meaning of an HTTP answer; of its headers, ``retry-after`` counts.

    Examples
    --------
    >>> answer_of(503, {"retry-after": "7"}, 0.0)
    Answer(meaning=<Meaning.TROUBLE: 2>, text='503 Service Unavailable', retry_after_s=7.0)
    """
    text = _phrase(status)
    if 200 <= status < 300:
        return Answer(Meaning.DELIVERED)
    if status == HTTPStatus.GONE:
        return Answer(Meaning.GONE, text)
    if 300 <= status < 400:
        return Answer(Meaning.REFUSED, f"{text}: redirects are not followed, set url to the receiver's address")
    if status in {HTTPStatus.REQUEST_TIMEOUT, HTTPStatus.TOO_EARLY, HTTPStatus.TOO_MANY_REQUESTS} or status >= 500:
        return Answer(Meaning.TROUBLE, text, _wished_s(headers.get("retry-after", ""), now_s))
    return Answer(Meaning.REFUSED, text)


def pause_s(answer: Answer, failures: int, longest_s: float, chance: float) -> float:
    """How long to wait after a failed attempt.

    Parameters
    ----------
    failures : int
        Attempts that failed one after the other, this one included.
    longest_s : float
        Longest pause; only the receiver itself may ask for more, up to an hour.
    chance : float
        Random number from 0 (half the pause) to 1 (all of it), so that not all come back at the same moment.

    Examples
    --------
    >>> [pause_s(Answer(Meaning.TROUBLE), failures, 10.0, 1.0) for failures in (1, 2, 3, 4, 5)]
    [1.0, 2.0, 4.0, 8.0, 10.0]
    """
    first_s = _FIRST_S["refused" if answer.meaning is Meaning.REFUSED else "trouble"]
    whole_s = min(longest_s, first_s * 2.0 ** min(failures - 1, _MOST_DOUBLINGS))
    return max(whole_s * (0.5 + 0.5 * chance), answer.retry_after_s)


def _phrase(status: int) -> str:
    try:
        return f"{status} {HTTPStatus(status).phrase}"
    except ValueError:
        return str(status)


def _wished_s(text: str, now_s: float) -> float:
    """Seconds in a ``Retry-After``, given as such or as a date; 0 if it is neither."""
    text = text.strip()
    if text.isascii() and text.isdigit():
        return min(float(text[:9]), _LONGEST_ASKED_S)
    try:
        date = parsedate_to_datetime(text)
    except ValueError:
        return 0.0
    if date.tzinfo is None:
        date = date.replace(tzinfo=UTC)
    return min(max(0.0, (date - datetime.fromtimestamp(now_s, UTC)).total_seconds()), _LONGEST_ASKED_S)
