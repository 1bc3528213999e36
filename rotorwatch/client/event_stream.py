"""Server-sent events as they come, across lost connections."""

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
_SILENCE_S = 60.0  # the service says something every 15 s, if only that it is there
_FIRST_PAUSE_S = 0.5
_LONGEST_PAUSE_S = 30.0

_log = logging.getLogger("rotorwatch.client")


@dataclass(frozen=True, slots=True)
class ServiceEvent:
    """Something that happened: one of `alarm` and `health` is there."""

    cursor: str  # where to go on after this event: keep it, and give it back as `after`
    alarm: AlarmCloudEvent | None = None  # what happened to an alarm
    health: Health | None = None  # health of a machine that has changed


def service_events(http: httpx.Client, parameters: Mapping[str, str | list[str]], after: str) -> Iterator[ServiceEvent]:
    """Listen for ever; a connection that is lost is made again, and goes on right after the last event.

    `after` is the cursor of the last event that was taken; empty for none.

    Raises
    ------
    NoAnswer
        If the first connection cannot be made. Later ones are tried again and again.
    RequestRefused
        If the service does not want to be listened to: no token, no such machine.
    LogReplaced
        If the log is not the one that was followed.
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
