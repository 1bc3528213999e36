"""Access tokens: ``rw_<id>_<secret>``, of which only a hash of the secret is stored (docs/decisions/0015-tokens.md)."""

import hashlib
import hmac
import re
import secrets
import string
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

from models.errors import MachineFileError
from service.access.scopes import ANONYMOUS, Scope
from service.history.records import TokenRecord

LONGEST_DAYS = 3650
_ALPHABET = string.digits + string.ascii_uppercase + string.ascii_lowercase
_ID_LENGTH = 12
_SECRET_LENGTH = 43  # the fewest of these characters that hold 256 bits
_TOKEN = re.compile(f"rw_([0-9A-Za-z]{{{_ID_LENGTH}}})_([0-9A-Za-z]{{{_SECRET_LENGTH}}})")
_ANY_SECRET = re.compile(f"rw_([0-9A-Za-z]{{{_ID_LENGTH}}})_[0-9A-Za-z]+")  # one that was cut off is a secret as well
_LONGEST_NAME = 64
_DAY_NS = 86_400 * 10**9
_NO_HASH = bytes(hashlib.sha256().digest_size)


class NameTakenError(MachineFileError):
    """A valid token has the name already."""


@dataclass(frozen=True, slots=True)
class PresentedToken:
    """A token that somebody sent, without its secret."""

    token_id: str
    secret_hash: bytes = field(repr=False)


def new_token(name: str, scopes: Iterable[Scope], *, now_ns: int, days: int | None = None) -> tuple[TokenRecord, str]:
    """Make a token: the record that is stored, and its text, which cannot be retrieved again.

    Parameters
    ----------
    name : str
        Who uses it, as the audit log shall say: at most 64 printable characters.
    days : int, optional
        How long it holds; for ever if left out.

    Raises
    ------
    MachineFileError
        Naming what cannot be used.

    Examples
    --------
    >>> record, text = new_token("control room", [Scope.READ], now_ns=0)
    >>> token_is_valid(record, parse_token(text), now_ns=1)
    True
    """
    if not name or len(name) > _LONGEST_NAME or not name.isprintable() or name != name.strip():
        raise MachineFileError(
            f"name is {name!r}, expected 1 to {_LONGEST_NAME} printable characters without spaces at the ends"
        )
    if name == ANONYMOUS or _ANY_SECRET.search(name):
        raise MachineFileError(f"name is {masked(name)!r}, which is not a valid name of a token's user")
    granted = tuple(scope.value for scope in Scope if scope in set(scopes))
    if not granted:
        raise MachineFileError(f"scope: none is given, expected one or more of {', '.join(Scope)}")
    if days is not None and not 1 <= days <= LONGEST_DAYS:
        raise MachineFileError(f"days is {days}, expected 1 to {LONGEST_DAYS}")
    token_id, secret = (
        "".join(secrets.choice(_ALPHABET) for _ in range(length)) for length in (_ID_LENGTH, _SECRET_LENGTH)
    )
    record = TokenRecord(
        token_id=token_id,
        name=name,
        scopes=granted,
        secret_hash=_hash(secret),
        created_ns=now_ns,
        expires_ns=None if days is None else now_ns + days * _DAY_NS,
        revoked_ns=None,
    )
    return record, f"rw_{token_id}_{secret}"


def check_name_is_free(name: str, there: Iterable[TokenRecord], now_ns: int) -> None:
    """Refuse, with NameTakenError, the name of a valid token: the audit log could not tell the two apart."""
    if any(one.name == name and token_state(one, now_ns) == "valid" for one in there):
        raise NameTakenError(f"a token of {name!r} is already valid: choose another name, or revoke it first")


def token_state(record: TokenRecord, now_ns: int) -> Literal["valid", "expired", "revoked"]:
    """Whether a token can be used, and why not."""
    if record.revoked_ns is not None:
        return "revoked"
    return "valid" if record.expires_ns is None or now_ns < record.expires_ns else "expired"


def parse_token(text: str) -> PresentedToken | None:
    """Take a token apart; None if it is not one."""
    found = _TOKEN.fullmatch(text)
    return None if found is None else PresentedToken(found[1], _hash(found[2]))


def token_is_valid(record: TokenRecord | None, presented: PresentedToken | None, now_ns: int) -> bool:
    """Whether a presented token is the stored one, has not expired and was not revoked.

    How long this takes does not depend on the secret, nor on whether there is such a token.
    """
    stored = _NO_HASH if record is None else record.secret_hash
    same = hmac.compare_digest(stored, b"" if presented is None else presented.secret_hash)
    if record is None or presented is None or record.token_id != presented.token_id:
        return False
    return same and token_state(record, now_ns) == "valid"


def masked(text: str) -> str:
    """Text in which every token has lost its secret.

    Examples
    --------
    >>> masked("/rw_0123456789AB_" + 43 * "x")
    '/rw_0123456789AB_…'
    """
    return _ANY_SECRET.sub(r"rw_\1_…", text)


def _hash(secret: str) -> bytes:
    return hashlib.sha256(secret.encode("ascii")).digest()
