"""Receivers of webhooks: real HTTP servers that answer as the test says and keep what they received."""

import json
import ssl
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from standardwebhooks import Webhook

from rotorwatch.records.alarms import AlarmCloudEvent, EventKind, Severity
from rotorwatch.records.example import example
from service.delivery.webhooks.signature import new_secret
from service.history.records import StoredEvent
from service.settings.webhooks import WebhookSettings

Answering = Callable[["Got"], tuple[int, Mapping[str, str]]]


@dataclass(frozen=True, slots=True)
class Got:
    path: str
    headers: Mapping[str, str]
    body: bytes

    @property
    def id(self) -> str:
        return self.headers["webhook-id"]

    def verified(self, secret: str) -> Any:
        """The body, if an independent implementation accepts the signature."""
        return Webhook(secret).verify(self.body, dict(self.headers))


def _taken(_: Got) -> tuple[int, Mapping[str, str]]:
    return 204, {}


@dataclass(slots=True)
class Hook:
    """A receiver; `answer` returns the response to a request and may take its time."""

    url: str = ""
    got: list[Got] = field(default_factory=list)
    answer: Answering = _taken
    connections: int = 0

    def ids(self) -> list[str]:
        return [one.id for one in self.got]


@contextmanager
def hook(answer: Answering = _taken, context: ssl.SSLContext | None = None) -> Iterator[Hook]:
    found = Hook(answer=answer)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def setup(self) -> None:
            found.connections += 1
            super().setup()

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            got = Got(self.path, {name.lower(): value for name, value in self.headers.items()}, body)
            found.got.append(got)
            status, headers = found.answer(got)
            try:
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                if status != 204:
                    self.send_header("content-length", "0")
                self.end_headers()
            except OSError:  # the client no longer waits for the response
                self.close_connection = True

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # the library's name
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    server.block_on_close = False
    if context is not None:
        server.socket = context.wrap_socket(server.socket, server_side=True)
    found.url = f"{'http' if context is None else 'https'}://127.0.0.1:{server.server_address[1]}/hook"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        yield found
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def settings_for(receiver: Hook | str, folder: Path, secret: str | None = None, **more: object) -> WebhookSettings:
    """Settings of a webhook whose secret is in a file of the folder."""
    file = folder / "hook.secret"
    file.write_text((new_secret() if secret is None else secret) + "\n", encoding="utf-8")
    file.chmod(0o600)
    url = receiver if isinstance(receiver, str) else receiver.url
    return WebhookSettings.model_validate({"name": "pager", "url": url, "secret_file": file, **more})


def alarm_event(sequence: int, place: str = "demo/lab", *, annunciated: bool = True, **changes: str) -> StoredEvent:
    """An entry of a machine's alarm log as the monitor writes it."""
    fields = {"kind": "raised", "severity": "alert", "alarm": "k_by"} | changes
    text = json.dumps(example(AlarmCloudEvent))
    event = AlarmCloudEvent.model_validate_json(text)
    identifier = f"{place}/{sequence}/{fields['alarm']}/{fields['kind']}"
    data = event.data.model_copy(update={
        "sequence": sequence, "kind": EventKind(fields["kind"]), "severity": Severity(fields["severity"]),
        "annunciated": annunciated,
    })  # fmt: skip
    event = event.model_copy(update={"id": identifier, "sequence": f"{sequence:020d}", "data": data})
    return StoredEvent(
        sequence=sequence, id=identifier, time_ns=1_767_225_600_000_000_000 + sequence,
        recorded_ns=1_767_225_600_000_000_000 + sequence, state="unacknowledged", occurrence=1, actor="",
        text=event.model_dump_json(), **fields,
    )  # fmt: skip
