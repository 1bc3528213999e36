"""Posts events to one receiver over HTTP."""

import asyncio
import ssl
import time
from contextlib import suppress

import httpx

from models.errors import MachineFileError
from rotorwatch import __version__
from service.delivery.webhooks.answer import Answer, Meaning, answer_of
from service.delivery.webhooks.signature import signature, signing_keys
from service.settings.webhooks import WebhookSettings

CONTENT_TYPE = "application/cloudevents+json"
_MOST_READ = 65_536


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
        self._url = _address(settings)
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
        try:
            # For the attempt as a whole: httpx's own timeouts begin anew with every byte that comes in.
            async with asyncio.timeout(self._settings.timeout_s):
                async with self._opened().stream(
                    "POST", self._url, content=body, headers=self._headers(identifier, body)
                ) as response:
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

    def _headers(self, identifier: str, body: bytes) -> dict[str, str]:
        timestamp_s = int(time.time())
        return {
            "content-type": CONTENT_TYPE,
            "user-agent": f"rotorwatch/{__version__}",
            "webhook-id": identifier,
            "webhook-timestamp": str(timestamp_s),
            "webhook-signature": signature(self._keys, identifier, timestamp_s, body),
        }


async def _drained(response: httpx.Response) -> None:
    """Read and discard the rest of a short answer, so that the connection can be used again."""
    read = 0
    async for part in response.aiter_raw():
        read += len(part)
        if read > _MOST_READ:
            return


def _address(settings: WebhookSettings) -> httpx.URL:
    try:
        return httpx.URL(settings.url)
    except httpx.InvalidURL as error:
        raise MachineFileError(f"webhooks.{settings.name}: url is not a web address: {error}") from None


def _trusted(settings: WebhookSettings, environment: bool) -> ssl.SSLContext:
    if settings.ca_file is None:
        return httpx.create_ssl_context(trust_env=environment)
    try:
        return ssl.create_default_context(cafile=settings.ca_file)
    except ssl.SSLError as error:
        raise MachineFileError(
            f"webhooks.{settings.name}: ca_file {settings.ca_file} holds no certificate (PEM)"
        ) from error
    except OSError as error:
        raise MachineFileError(
            f"webhooks.{settings.name}: ca_file {settings.ca_file} cannot be read: {error.strerror or error}"
        ) from error
