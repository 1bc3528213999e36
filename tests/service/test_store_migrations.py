"""The migrations make exactly the tables that the code uses, once, whoever comes first."""

import hashlib
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import zstandard
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import create_engine, inspect, make_url, text
from sqlalchemy.engine import Engine
from structlog.testing import capture_logs

from service.history import claim
from service.history.claim import unpack
from service.history.migrations import migrate
from service.history.records import Checkpoint, CheckpointHead, Step, StoredReading, StoreError
from service.history.tables import REVISION, metadata
from tests.service.postgres import KINDS, database_url, opened


@pytest.fixture(params=KINDS)
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return database_url(request.param, tmp_path, empty=True)


def engine_for(url: str) -> Engine:
    made = make_url(url)
    return create_engine(made.set(drivername={"sqlite": "sqlite", "postgresql": "postgresql+psycopg"}[made.drivername]))


def opened_and_closed(url: str) -> None:
    with opened(url):
        pass


def test_migrations_and_tables_agree(url: str) -> None:
    engine = engine_for(url)
    with engine.begin() as connection:
        migrate(connection)
    opened_and_closed(url)  # which is nothing then
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


def test_an_empty_file_becomes_what_migrations_make_of_it(tmp_path: Path) -> None:
    """To the constraint and the trigger; only the text of a table that was altered is another."""
    made: list[object] = []
    for name in ("created", "migrated"):
        engine = engine_for(url := f"sqlite:///{tmp_path / name}")
        if name == "created":
            opened_and_closed(url)
        else:
            with engine.begin() as connection:
                migrate(connection)
        with engine.connect() as connection:
            found = inspect(connection)
            made.append(
                [
                    connection.execute(text("SELECT type, name, tbl_name FROM sqlite_master ORDER BY name")).all(),
                    connection.scalars(text("SELECT sql FROM sqlite_master WHERE type != 'table' ORDER BY name")).all(),
                    connection.execute(text("SELECT name, wr, strict FROM pragma_table_list ORDER BY name")).all(),
                    connection.scalars(text("SELECT version_num FROM alembic_version")).all(),
                    {
                        table: [repr(found.get_columns(table)), found.get_pk_constraint(table)]
                        + [sorted(map(repr, ask(table))) for ask in (found.get_foreign_keys, found.get_indexes)]
                        + [sorted(map(repr, found.get_unique_constraints(table)))]
                        for table in found.get_table_names()
                    },
                ]
            )
        engine.dispose()
    assert made[0] == made[1]


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
        assert connection.scalars(text("SELECT version_num FROM alembic_version")).all() == [REVISION]
    engine.dispose()


def test_a_database_that_is_up_to_date_is_opened_without_what_only_migrations_need(url: str) -> None:
    opened_and_closed(url)
    code = (
        "import sys; from service.history.store import Store; from service.history.records import Retention; "
        "store = Store(sys.argv[1], Retention()); store.open(); store.machine('demo', 'lab'); store.close(); "
        "print({'alembic', 'sqlalchemy.orm', 'sqlalchemy.ext.asyncio'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code, url], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_buckets_of_an_older_version_get_the_readings_that_are_still_there(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.history.trend._SINGLE", 0)
    engine = engine_for(url)
    statements = (
        "INSERT INTO machines VALUES (1, 'demo', 'lab', '', 3, 0, 3)",
        "INSERT INTO series VALUES (1, 1, 'parameter', 'k_by')",
        # Two readings were reduced, of which the later one ended in a bucket in which there are others still.
        "INSERT INTO buckets VALUES (1, 0, 600000000000, 5, 1, 7.0, 7.0, 7.0, 0, 0.0)",
        "INSERT INTO buckets VALUES (1, 600000000000, 600000000000, 6, 1, 1.0, 1.0, 1.0, 1, 0.5)",
        "INSERT INTO evaluations VALUES (1, 2, 800000000000, 2), (1, 3, 1200000000000, 3), (1, 4, 1600000000000, 4)",
        "INSERT INTO readings VALUES (1, 2, 1, 2, 0.25), (1, 3, 1, 3, 0.25), (1, 4, 1, 4, 0.25)",
    )
    with engine.begin() as connection:
        migrate(connection, "0001")
        for statement in statements:
            connection.execute(text(statement))
    engine.dispose()
    with opened(url) as store:
        found = store.machine("demo", "lab").downsampled(quantity="parameter", points=100)
    assert [(one.count, one.minimum, one.mean, one.maximum, one.mean_standard_error) for one in found] == [
        (1, 7.0, 7.0, 7.0, None), (2, 1.0, 1.5, 2.0, 0.375), (2, 3.0, 3.5, 4.0, 0.25)
    ]  # fmt: skip


@pytest.mark.parametrize("single", [0, 100], ids=["from buckets", "from single readings"])
def test_readings_and_buckets_of_rows_are_those_that_were_there(
    url: str, single: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.history.trend._SINGLE", single)
    engine = engine_for(url)
    statements = (
        "INSERT INTO machines VALUES (1, 'demo', 'lab', '', 9, 0, 4), (2, 'demo', 'pump', '', 9, 0, 1)",
        "INSERT INTO series VALUES (1, 1, 'parameter', 'e', -1), (2, 2, 'parameter', 'e', -1), "
        "(3, 1, 'parameter', 'k_by', -1)",
        # The second bucket of a machine is being filled; of the first, one that was closed has been gone on with.
        "INSERT INTO buckets VALUES (1, 0, 600000000000, 3, 1, 0.1, 0.1, 0.1, 0, 0.0), "
        "(3, 0, 600000000000, 2, 1, 7.0, 7.0, 7.0, 1, 0.5)",
        "INSERT INTO open_buckets VALUES (3, 0, 600000000000, 3, 1, 8.0, 8.0, 8.0, 0, 0.0), "
        "(1, 600000000000, 600000000000, 5, 1, 3.0, 3.0, 3.0, 0, 0.0), "
        "(2, 600000000000, 600000000000, 5, 1, -1.0, -1.0, -1.0, 0, 0.0)",
        "INSERT INTO evaluations VALUES (1, 2, 100000000000, 2), (1, 3, 200000000000, 3), (1, 4, 600000000000, 5), "
        "(2, 1, 600000000000, 5)",
        "INSERT INTO readings VALUES (1, 2, 3, 7.0, 0.5), (1, 3, 1, 0.1, NULL), (1, 3, 3, 8.0, NULL), "
        "(1, 4, 1, 3.0, NULL), (2, 1, 2, -1.0, NULL)",
    )
    with engine.begin() as connection:
        migrate(connection, "0003")
        for statement in statements:
            connection.execute(text(statement))
    engine.dispose()
    with opened(url) as store:
        lab, pump = store.machine("demo", "lab"), store.machine("demo", "pump")
        # What comes next completes the bucket, and is counted once.
        assert lab.commit(Step(readings=(StoredReading(1_300 * 10**9, "parameter", "e", 5.0, 0.25),)))
        found = {
            name: [
                (one.number, one.end_ns, one.value, one.standard_error)
                for one in lab.readings(quantity="parameter", name=name)
            ]
            for name in ("e", "k_by")
        }
        parts = [
            (one.name, one.count, one.minimum, one.mean, one.maximum, one.mean_standard_error)
            for one in lab.downsampled(quantity="parameter", until_ns=1_800 * 10**9, since_ns=0, points=3)
        ]
        assert [one.value for one in pump.readings(quantity="parameter", name="e")] == [-1.0]
        assert [one.mean for one in pump.downsampled(quantity="parameter")] == [-1.0]
    assert found == {
        "e": [(3, 200 * 10**9, 0.1, None), (4, 600 * 10**9, 3.0, None), (5, 1_300 * 10**9, 5.0, 0.25)],
        "k_by": [(2, 100 * 10**9, 7.0, 0.5), (3, 200 * 10**9, 8.0, None)],
    }
    assert parts == [
        ("e", 1, 0.1, 0.1, 0.1, None), ("e", 1, 3.0, 3.0, 3.0, None), ("e", 1, 5.0, 5.0, 5.0, 0.25),
        ("k_by", 2, 7.0, 7.5, 8.0, 0.5),
    ]  # fmt: skip


@pytest.mark.parametrize("url", [pytest.param("sqlite", marks=pytest.mark.long), "postgresql"], indirect=True)
def test_a_large_history_says_how_far_it_is_brought_up_to_date(url: str) -> None:
    numbers = "WITH RECURSIVE n (k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n WHERE k < 20003) "
    engine = engine_for(url)
    with engine.begin() as connection, capture_logs() as lines:
        migrate(connection, "0003")
        connection.execute(text("INSERT INTO machines VALUES (1, 'demo', 'lab', '', 9, 0, 20003)"))
        connection.execute(text("INSERT INTO series VALUES (1, 1, 'parameter', 'e', -1)"))
        for inserted in (
            "INSERT INTO evaluations SELECT 1, k, k, 1 FROM n",
            "INSERT INTO readings SELECT 1, k, 1, CAST(k AS DOUBLE PRECISION) / 7, NULL FROM n",
        ):
            connection.execute(text(numbers + inserted))
        migrate(connection)
    engine.dispose()
    told = [(line["table"], line["rows"]) for line in lines if line["event"] == "the history is brought up to date"]
    assert told == [("windows", 20_000)]
    with opened(url) as store:
        found = store.machine("demo", "lab").readings(quantity="parameter", name="e", limit=30_000)
    assert [(one.number, one.value) for one in found] == [(number, number / 7) for number in range(1, 20_004)]


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


def test_a_checkpoint_of_an_older_version_keeps_its_alarms(url: str) -> None:
    engine = engine_for(url)
    alarms = '{"k_by": "raised"}'
    with engine.begin() as connection:
        migrate(connection, "0002")
        connection.execute(text("INSERT INTO machines VALUES (1, 'demo', 'lab', '', 3, 0, 3)"))
        connection.execute(
            text("INSERT INTO checkpoints VALUES (1, 1, NULL, 'hash', '0.1', 5, 6, :alarms, :state)"),
            {"alarms": alarms, "state": b"RWCP"},
        )
        connection.execute(text("INSERT INTO checkpoint_hops VALUES (1, 5, :moments)"), {"moments": b"moments"})
    engine.dispose()
    with opened(url) as store:
        found = store.machine("demo", "lab").restore()
    assert found == Checkpoint(CheckpointHead(1, None, "hash", "0.1", 5, 6, alarms, b"RWCP"), ())


def test_reports_that_were_compressed_by_themselves_are_read() -> None:
    """Those of earlier versions; and what all are compressed against is what it was, or none could be read."""
    assert unpack(zstandard.compress(b'{"state": "healthy"}')) == '{"state": "healthy"}'
    dictionary = Path(claim.__file__).with_name("reports.dictionary").read_bytes()
    assert hashlib.sha256(dictionary).hexdigest() == "af2696c3ddde702e4bf51e00016417f4cb4fa04bf9e1e9b5ee9fba2fa27ef8ac"
