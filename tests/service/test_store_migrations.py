"""The migrations make exactly the tables that the code uses, once, whoever comes first."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import create_engine, inspect, make_url, text
from sqlalchemy.engine import Engine

from service.store.errors import StoreError
from service.store.retention import Retention
from service.store.store import Store
from service.store.tables import metadata
from tests.service.postgres import KINDS, database_url


@pytest.fixture(params=KINDS)
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return database_url(request.param, tmp_path)


def engine_for(url: str) -> Engine:
    made = make_url(url)
    return create_engine(made.set(drivername={"sqlite": "sqlite", "postgresql": "postgresql+psycopg"}[made.drivername]))


def opened_and_closed(url: str) -> None:
    store = Store(url, Retention())
    store.open()
    store.close()


def test_migrations_and_tables_agree(url: str) -> None:
    opened_and_closed(url)
    opened_and_closed(url)  # a second time is nothing
    engine = engine_for(url)
    with engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True, "compare_server_default": True})
        assert compare_metadata(context, metadata) == []
        found = inspect(connection)
        for name, table in metadata.tables.items():
            # Alembic does not compare keys and their names.
            assert found.get_pk_constraint(name)["constrained_columns"] == [each.name for each in table.primary_key]
            nullable = {column["name"]: column["nullable"] for column in found.get_columns(name)}
            assert nullable == {column.name: column.nullable for column in table.columns}
    engine.dispose()


def test_a_difference_would_be_noticed(url: str) -> None:
    opened_and_closed(url)
    engine = engine_for(url)
    with engine.begin() as connection:
        connection.execute(text("ALTER TABLE tokens ADD COLUMN colour TEXT"))
        context = MigrationContext.configure(connection)
        assert [change[0] for change in compare_metadata(context, metadata)] == ["remove_column"]
    engine.dispose()


def test_several_monitors_open_an_empty_database_at_once(url: str) -> None:
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(opened_and_closed, [url] * 4))
    engine = engine_for(url)
    with engine.connect() as connection:
        assert connection.scalars(text("SELECT version_num FROM alembic_version")).all() == ["0001"]
    engine.dispose()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("UPDATE alembic_version SET version_num = '9999'", "revision 9999, which this version of rotorwatch does not"),
        ("DROP TABLE alembic_version", "a table 'machines' that is not ours"),
    ],
)
def test_a_database_of_others_is_left_alone(url: str, change: str, message: str) -> None:
    opened_and_closed(url)
    engine = engine_for(url)
    with engine.begin() as connection:
        connection.execute(text(change))
    engine.dispose()
    with pytest.raises(StoreError, match=message):
        opened_and_closed(url)
