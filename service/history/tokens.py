"""Tokens of access: their hashes, never their secrets."""

from typing import Any

from sqlalchemy import insert, select, update

from service.history.database import Database
from service.history.errors import StoreError
from service.history.records import TokenRecord
from service.history.tables import tokens

__all__ = ["TokenStore"]

_COLUMNS = [tokens.c[name] for name in TokenRecord.__dataclass_fields__]


class TokenStore:
    """Every token there is or was; for any thread. All methods raise `StoreError` if the database fails."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, record: TokenRecord) -> None:
        """Keep a new token.

        Raises
        ------
        StoreError
            If a scope holds a blank, or there is a token with this identifier.
        """
        if any(not scope or scope.split() != [scope] for scope in record.scopes):
            raise StoreError(f"token {record.token_id}: scopes are {record.scopes}, expected words without blanks")
        values = {name: getattr(record, name) for name in TokenRecord.__dataclass_fields__}
        values["scopes"] = " ".join(record.scopes)
        with self._database.writing() as connection:
            there = select(tokens.c.token_id).where(tokens.c.token_id == record.token_id)
            if connection.scalar(there) is not None:
                raise StoreError(f"token {record.token_id}: there is one with this identifier already")
            connection.execute(insert(tokens).values(values))

    def find(self, token_id: str) -> TokenRecord | None:
        """One token, revoked and expired ones included."""
        rows = self._database.rows(select(*_COLUMNS).where(tokens.c.token_id == token_id))
        return _record(*rows[0]) if rows else None

    def all(self) -> tuple[TokenRecord, ...]:
        """Every token, oldest first."""
        query = select(*_COLUMNS).order_by(tokens.c.created_ns, tokens.c.token_id)
        return tuple(_record(*row) for row in self._database.rows(query))

    def revoke(self, token_id: str, at_ns: int) -> bool:
        """Revoke a token; False if there is none, or it is revoked already."""
        chosen = (tokens.c.token_id == token_id, tokens.c.revoked_ns.is_(None))
        with self._database.writing() as connection:
            return connection.execute(update(tokens).where(*chosen).values(revoked_ns=at_ns)).rowcount > 0


def _record(token_id: str, name: str, scopes: str, *rest: Any) -> TokenRecord:
    return TokenRecord(token_id, name, tuple(scopes.split()), *rest)
