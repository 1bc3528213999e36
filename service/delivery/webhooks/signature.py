"""Secrets and signatures after the Standard Webhooks specification, version 1."""

import base64
import binascii
import hashlib
import hmac
import os
import secrets
from collections.abc import Sequence
from pathlib import Path

from models.errors import MachineFileError
from service.settings.webhooks import WebhookSettings

PREFIX = "whsec_"
_SHORTEST = 24
_LONGEST = 64
_NEW = 32
_READABLE_BY_OTHERS = 0o004
_MOST = 4
_EXPECTED = f"expected {PREFIX} and {_SHORTEST} to {_LONGEST} bytes in base 64, as rotorwatch webhook secret makes them"


def new_secret() -> str:
    """A new secret, 256 bits.

    Examples
    --------
    >>> len(parse_secret(new_secret()))
    32
    """
    return PREFIX + base64.b64encode(secrets.token_bytes(_NEW)).decode()


def parse_secret(text: str) -> bytes:
    """The key in a secret; raises `MachineFileError`, which does not show the text, if it is none."""
    encoded = text.removeprefix(PREFIX)
    try:
        key = base64.b64decode(encoded, validate=True)
    except (binascii.Error, ValueError):
        key = b""
    if not text.startswith(PREFIX) or not _SHORTEST <= len(key) <= _LONGEST:
        raise MachineFileError(f"this is not a webhook secret, {_EXPECTED}")
    return key


def signing_keys(settings: WebhookSettings) -> tuple[bytes, ...]:
    """The keys of a webhook, the newest first: several while a secret is being replaced.

    Raises
    ------
    MachineFileError
        Naming the file or variable that is missing, readable by others, or holds no secret.
    """
    if settings.secret_file is None:
        place = f"webhooks.{settings.name}: environment variable {settings.secret_variable}"
        text = os.environ.get(settings.secret_variable or "", "")
    else:
        place = f"webhooks.{settings.name}: secret_file {settings.secret_file}"
        text = _read(place, settings.secret_file)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if not 1 <= len(lines) <= _MOST:
        raise MachineFileError(f"{place} has {len(lines)} secrets, {_EXPECTED}; at most {_MOST} of them")
    try:
        return tuple(parse_secret(line) for line in lines)
    except MachineFileError as error:
        raise MachineFileError(f"{place}: {error}") from None


def signature(keys: Sequence[bytes], identifier: str, timestamp_s: int, body: bytes) -> str:
    """Value of the header ``webhook-signature``, with one signature for each key.

    Signed are ``webhook-id``, ``webhook-timestamp`` (seconds since 1970 UTC) and the body.
    """
    signed = f"{identifier}.{timestamp_s}.".encode() + body
    digests = (hmac.new(key, signed, hashlib.sha256).digest() for key in keys)
    return " ".join(f"v1,{base64.b64encode(digest).decode()}" for digest in digests)


def _read(place: str, path: Path) -> str:
    try:
        if path.stat().st_mode & _READABLE_BY_OTHERS:
            raise MachineFileError(
                f"{place} is readable by every user of this computer: chmod 600 {path}, and take a new secret if "
                "others may have read it"
            )
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise MachineFileError(f"{place} is not text") from error
    except OSError as error:
        raise MachineFileError(f"{place} cannot be read: {error.strerror or error}") from error
