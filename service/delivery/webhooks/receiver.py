"""Posts events to one receiver over HTTP, and says what its answer means for what is sent next, and when."""

import asyncio
import ssl
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from enum import Enum, auto
from http import HTTPStatus

import httpx

from models.errors import MachineFileError
from rotorwatch import __version__
from service.delivery.webhooks.signature import signature, signing_keys
from service.settings.webhooks import WebhookSettings

CONTENT_TYPE = "application/cloudevents+json"
_MOST_READ = 65_536
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


class Receiver:
    """Where one webhook's events go; secrets and certificates are read at once.

    All but `interrupt` are for one thread. The connection is kept open between events. Proxies of the environment
    (``HTTPS_PROXY``, ``NO_PROXY``) are used, but not for receivers on this computer.

    Raises
    ------
    MachineFileError
        If the address, the secret or the authority cannot be used.
    """

    def __init__(self, settings: WebhookSettings) -> None:
        self._settings = settings
        self._keys = signing_keys(settings)
        self._environment = not settings.on_this_computer
        self._trust = _trusted(settings, self._environment)
        try:
            self._url = httpx.URL(settings.url)
        except httpx.InvalidURL as error:
            raise MachineFileError(f"webhooks.{settings.name}: url is not a web address: {error}") from None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._client: httpx.AsyncClient | None = None
        self._task: asyncio.Task[Answer] | None = None
        self._interrupted = False

    def post(self, identifier: str, body: bytes) -> Answer:
        """Make one attempt; takes `timeout_s` at most.

        Parameters
        ----------
        identifier : str
            ``webhook-id``: the same in every attempt at the same event.
        body : bytes
            A CloudEvent, JSON.
        """
        if self._loop is None:
            self._loop = asyncio.new_event_loop()
        return self._loop.run_until_complete(self._interruptible(identifier, body))

    def interrupt(self) -> None:
        """Give up the present attempt and all that would follow; for any thread."""
        self._interrupted = True
        if self._loop is not None:
            with suppress(RuntimeError):  # closed already
                self._loop.call_soon_threadsafe(self._cancel)

    def close(self) -> None:
        """Close the connection."""
        if self._loop is None:
            return
        if self._client is not None:
            self._loop.run_until_complete(self._client.aclose())
        self._loop.close()

    def _cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()

    async def _interruptible(self, identifier: str, body: bytes) -> Answer:
        if self._interrupted:
            return Answer(Meaning.TROUBLE, "interrupted")
        self._task = asyncio.create_task(self._attempt(identifier, body))
        try:
            return await self._task
        except asyncio.CancelledError:
            if self._interrupted:
                return Answer(Meaning.TROUBLE, "interrupted")
            raise
        finally:
            self._task = None

    async def _attempt(self, identifier: str, body: bytes) -> Answer:
        answer: Answer | None = None
        why = ""
        timestamp_s = int(time.time())
        headers = {
            "content-type": CONTENT_TYPE,
            "user-agent": f"rotorwatch/{__version__}",
            "webhook-id": identifier,
            "webhook-timestamp": str(timestamp_s),
            "webhook-signature": signature(self._keys, identifier, timestamp_s, body),
        }
        try:
            # For the attempt as a whole: httpx's own timeouts begin anew with every byte that comes in.
            async with asyncio.timeout(self._settings.timeout_s):
                async with self._opened().stream("POST", self._url, content=body, headers=headers) as response:
                    answer = answer_of(response.status_code, response.headers, time.time())
                    await _drained(response)
        except TimeoutError:
            why = f"no answer within {self._settings.timeout_s:g} s"
        except (httpx.ConnectError, httpx.ProxyError) as error:
            why = f"no connection: {error}"
        except (httpx.HTTPError, httpx.InvalidURL, OSError) as error:
            why = f"the connection broke: {str(error) or type(error).__name__}"
        finally:
            if self._client is not None:
                self._client.cookies.clear()
        # Only the status matters: a receiver that has answered has the event, whatever becomes of the rest.
        return Answer(Meaning.TROUBLE, why) if answer is None else answer

    def _opened(self) -> httpx.AsyncClient:
        if self._client is None:
            self._client = httpx.AsyncClient(
                verify=self._trust,
                trust_env=self._environment,
                timeout=self._settings.timeout_s,
                follow_redirects=False,
            )
        return self._client


async def _drained(response: httpx.Response) -> None:
    """Read and discard the rest of a short answer, so that the connection can be used again."""
    read = 0
    async for part in response.aiter_raw():
        read += len(part)
        if read > _MOST_READ:
            return


def _trusted(settings: WebhookSettings, environment: bool) -> ssl.SSLContext:
    if settings.ca_file is None:
        return httpx.create_ssl_context(trust_env=environment)
    try:
        return ssl.create_default_context(cafile=settings.ca_file)
    except OSError as error:
        damaged = isinstance(error, ssl.SSLError)
        why = "holds no certificate (PEM)" if damaged else f"cannot be read: {error.strerror or error}"
        raise MachineFileError(f"webhooks.{settings.name}: ca_file {settings.ca_file} {why}") from error
