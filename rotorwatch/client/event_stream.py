"""Receives server-sent events, reconnecting after a lost connection."""

import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import httpx
from httpx_sse import SSEError, connect_sse

from rotorwatch.client.answers import refusal, understood
from rotorwatch.client.errors import Conflict, LogReplaced, NoAnswer, Unavailable
from rotorwatch.records.alarms import AlarmCloudEvent
from rotorwatch.records.health import Health

_PATH = "/api/v1/events"
_SILENCE_S = 60.0  # the service sends an event or a keep-alive comment every 15 s
_FIRST_PAUSE_S = 0.5
_LONGEST_PAUSE_S = 30.0

_log = logging.getLogger("rotorwatch.client")


@dataclass(frozen=True, slots=True)
class ServiceEvent:
    """An event of the service; either `alarm` or `health` is set."""

    cursor: str  # position after this event: store it, and pass it as `after` to continue
    alarm: AlarmCloudEvent | None = None  # alarm event
    health: Health | None = None  # changed health of a machine


def service_events(http: httpx.Client, parameters: Mapping[str, str | list[str]], after: str) -> Iterator[ServiceEvent]:
    """Yield events for ever; a lost connection is restored, continuing right after the last event.

    `after` is the cursor of the last event that was taken; empty for none.

    Raises
    ------
    NoAnswer
        If the first connection fails. Later ones are retried.
    RequestRefused
        If the service refuses the request: no token, or no such machine.
    LogReplaced
        If the log is not the one that was followed before.
    """
    cursor, pause_s, connected = after, _FIRST_PAUSE_S, False
    while True:
        headers = {"Last-Event-ID": cursor} if cursor else {}
        try:
            with connect_sse(
                http,
                "GET",
                _PATH,
                params=dict(parameters),
                headers=headers,
                timeout=httpx.Timeout(http.timeout.connect, read=_SILENCE_S),
            ) as source:
                if source.response.status_code != httpx.codes.OK:
                    source.response.read()
                    raise refusal(source.response)
                for said in source.iter_sse():
                    connected, pause_s = True, _FIRST_PAUSE_S
                    cursor = said.id or cursor
                    if said.event == "alarm":
                        yield ServiceEvent(cursor, alarm=understood(AlarmCloudEvent, said.data, _PATH))
                    elif said.event == "health":
                        yield ServiceEvent(cursor, health=understood(Health, said.data, _PATH))
            trouble = "the service has ended the stream"
        except Conflict as error:
            raise LogReplaced(str(error)) from error
        except SSEError as error:
            raise NoAnswer(f"{http.base_url}: {error}") from error
        except Unavailable as error:
            trouble = str(error)
        except httpx.TransportError as error:
            trouble = f"{http.base_url}: {str(error) or type(error).__name__}"
            if not connected:
                raise NoAnswer(trouble) from error
        _log.warning("events: %s; trying again", trouble)
        time.sleep(pause_s)
        pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)
