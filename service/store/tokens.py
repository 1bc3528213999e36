"""Tokens of access: their hashes, never their secrets."""

from sqlalchemy import insert, select, update

from service.store.database import Database
from service.store.errors import StoreError
from service.store.records import TokenRecord
from service.store.tables import tokens

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

        async def write() -> None:
            async with self._database.writing() as connection:
                there = select(tokens.c.token_id).where(tokens.c.token_id == record.token_id)
                if await connection.scalar(there) is not None:
                    raise StoreError(f"token {record.token_id}: there is one with this identifier already")
                await connection.execute(insert(tokens).values(values))

        self._database.call(write)

    def find(self, token_id: str) -> TokenRecord | None:
        """One token, revoked and expired ones included."""
        found = self._select(token_id)
        return found[0] if found else None

    def all(self) -> tuple[TokenRecord, ...]:
        """Every token, oldest first."""
        return self._select(None)

    def revoke(self, token_id: str, at_ns: int) -> bool:
        """Revoke a token; False if there is none, or it is revoked already."""

        async def write() -> bool:
            async with self._database.writing() as connection:
                chosen = (tokens.c.token_id == token_id, tokens.c.revoked_ns.is_(None))
                done = await connection.execute(update(tokens).where(*chosen).values(revoked_ns=at_ns))
                return done.rowcount > 0

        return self._database.call(write)

    def _select(self, token_id: str | None) -> tuple[TokenRecord, ...]:
        query = select(*_COLUMNS).order_by(tokens.c.created_ns, tokens.c.token_id)
        if token_id is not None:
            query = query.where(tokens.c.token_id == token_id)

        async def fetch() -> tuple[TokenRecord, ...]:
            async with self._database.reading() as connection:
                rows = (await connection.execute(query)).all()
            return tuple(
                TokenRecord(
                    token_id=row.token_id,
                    name=row.name,
                    scopes=tuple(row.scopes.split()),
                    secret_hash=row.secret_hash,
                    created_ns=row.created_ns,
                    expires_ns=row.expires_ns,
                    revoked_ns=row.revoked_ns,
                )
                for row in rows
            )

        return self._database.call(fetch)
