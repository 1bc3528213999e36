"""Settings of webhooks: who receives which alarm events, and how long attempts and pauses may last."""

from pathlib import Path
from typing import Any, Self
from urllib.parse import urlsplit

from pydantic import BaseModel, Field, model_validator

from models.signals.keys import NAME_PATTERN
from models.signals.link import is_loopback
from rotorwatch.records.alarms import EventKind, Severity


class WebhookSettings(BaseModel, extra="forbid", frozen=True, hide_input_in_errors=True):
    """One receiver of alarm events; an event is sent if machine, kind and severity are all among those wanted."""

    name: str = Field(
        pattern=f"^{NAME_PATTERN}$", description="name of the webhook; the progress of delivery is kept under it"
    )
    url: str = Field(description="where events are posted: https, or http on this computer")
    insecure: bool = Field(
        default=False, description="allow http to another computer, where anyone in between can read it"
    )
    secret_file: Path | None = Field(
        default=None,
        description="file of mode 600 with the secret (whsec_...), relative to the settings file; if it has several "
        "lines, events are signed with each",
    )
    secret_variable: str | None = Field(
        default=None,
        pattern=r"^[A-Za-z_][A-Za-z0-9_]*$",
        description="environment variable with the secret, instead of a file",
    )
    ca_file: Path | None = Field(
        default=None, description="authority of the receiver's certificate (PEM), if not one of the well-known ones"
    )
    machines: tuple[str, ...] = Field(
        default=("*/*",), min_length=1, description="only events of these machines, as site/machine with * and ?"
    )
    kinds: tuple[EventKind, ...] = Field(default=(), description="only these kinds of event; all if left out")
    severities: tuple[Severity, ...] = Field(default=(), description="only events of these severities; all if left out")
    annunciated_only: bool = Field(
        default=False, description="leave out events of alarms that are shelved, suppressed or out of service"
    )
    timeout_s: float = Field(
        default=10.0, ge=0.1, le=300.0, description="how long one attempt may take altogether, in seconds"
    )
    longest_pause_s: float = Field(
        default=300.0, ge=1.0, le=86_400.0, description="longest pause between attempts, in seconds"
    )

    @model_validator(mode="before")
    @classmethod
    def _no_secret(cls, fields: Any) -> Any:  # whatever the file has; checked field by field afterwards
        if isinstance(fields, dict) and "secret" in fields:
            # Raised here, so that the value is in no message.
            raise ValueError(
                "secret does not belong in settings, which many may read: put it into a file of mode 600 and name "
                "that in secret_file, or name an environment variable in secret_variable"
            )
        return fields

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.secret_file is None) == (self.secret_variable is None):
            raise ValueError("expected the secret in one of secret_file and secret_variable")
        self._check_url()
        for pattern in self.machines:
            if pattern.count("/") != 1 or not all(pattern.split("/")):
                raise ValueError(f"machines: {pattern!r} is not site/machine such as demo/lab or demo/*")
        return self

    def _check_url(self) -> None:
        # The text of the address may hold a secret and is in no message.
        try:
            parts = urlsplit(self.url)
            host, port = parts.hostname, parts.port
        except ValueError as error:
            raise ValueError(f"url cannot be read: {error}") from error
        if parts.scheme not in {"https", "http"} or not host or not self.url.isprintable() or " " in self.url:
            raise ValueError("url is not a web address, expected https://host/path")
        if port == 0:
            raise ValueError("url has port 0, expected 1 to 65535")
        if parts.username is not None or parts.password is not None:
            raise ValueError("url contains a user name, expected none: receivers identify the sender by the signature")
        if parts.scheme == "http" and not self.insecure and not is_loopback(host):
            raise ValueError(
                "url is http and not on this computer, so anyone in between could read it: expected https, or "
                "insecure = true"
            )
        if self.ca_file is not None and parts.scheme == "http":
            raise ValueError("ca_file is for https, and url is http")

    @property
    def target(self) -> str:
        """The address without path and query, which may hold a secret.

        Examples
        --------
        >>> hook = WebhookSettings(name="a", url="https://hooks.example/T0/key?x=1", secret_variable="S")
        >>> hook.target
        'https://hooks.example'
        """
        parts = urlsplit(self.url)
        return f"{parts.scheme}://{parts.netloc}"

    @property
    def on_this_computer(self) -> bool:
        """Whether the receiver runs on this computer."""
        return is_loopback(urlsplit(self.url).hostname or "")
