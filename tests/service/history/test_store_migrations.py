"""The tables are made once, whoever comes first; those of older versions are migrated, those of others left alone."""

import hashlib
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import zstandard
from sqlalchemy import create_mock_engine

from service.history import claim, migrations
from service.history.claim import unpack
from service.history.records import Step, StoredReading, StoreError
from service.history.tables import REVISION, metadata
from tests.service.rig.postgres import KINDS, database_url, executed, opened, opened_and_closed


@pytest.fixture(params=KINDS)
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return database_url(request.param, tmp_path, empty=True)


def test_tables_change_with_their_revision() -> None:
    """Whoever changes a table writes a migration, and then changes what is expected here."""
    made = []
    engine = create_mock_engine("sqlite://", lambda statement, *_, **__: made.append(statement))
    metadata.create_all(engine, checkfirst=False)
    words = " ".join(str(statement.compile(dialect=engine.dialect)) for statement in made).split()
    digest = hashlib.sha256(" ".join(words).encode()).hexdigest()
    assert (REVISION, digest) == ("0005", "13f485abccd4a3bf596a894b7f8f295facc7f6a1eb3e74b19529c3388ee19897")


def test_tables_of_older_versions_are_migrated(url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with opened(url) as store:
        assert store.machine("demo", "lab").commit(Step(readings=(StoredReading(1, "parameter", "e", 0.1, None),)))
    folder = Path(shutil.copytree(migrations.FOLDER, tmp_path / "migrations"))
    (folder / "versions" / "r0006_colour.py").write_text(
        "from alembic import op\n"
        "revision, down_revision = '0006', '0005'\n"
        "def upgrade(): op.execute(\"ALTER TABLE tokens ADD COLUMN colour TEXT DEFAULT 'red'\")\n"
    )
    monkeypatch.setattr(migrations, "FOLDER", folder)
    monkeypatch.setattr("service.history.tables.REVISION", "0006")
    with opened(url) as store:
        assert [one.value for one in store.machine("demo", "lab").readings(quantity="parameter", name="e")] == [0.1]
    assert executed(url, "SELECT colour FROM tokens") == []
    assert executed(url, "SELECT version_num FROM alembic_version") == [("0006",)]
    opened_and_closed(url)  # which is nothing then


def test_several_monitors_open_an_empty_database_at_once(url: str) -> None:
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(opened_and_closed, [url] * 4))
    assert executed(url, "SELECT version_num FROM alembic_version") == [(REVISION,)]


def test_a_database_that_is_up_to_date_is_opened_without_what_only_migrations_need(url: str) -> None:
    opened_and_closed(url)
    code = (
        "import sys; from service.history.store import Store; from service.history.records import Retention; "
        "store = Store(sys.argv[1], Retention()); store.open(); store.machine('demo', 'lab'); store.close(); "
        "print({'alembic', 'sqlalchemy.orm', 'sqlalchemy.ext.asyncio'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code, url], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("UPDATE alembic_version SET version_num = '9999'", "revision 9999, which this version of rotorwatch does not"),
        ("DROP TABLE alembic_version", "a table 'alarm_events' not of the history"),
    ],
)
def test_a_database_of_others_is_left_alone(url: str, change: str, message: str) -> None:
    opened_and_closed(url)
    executed(url, change)
    with pytest.raises(StoreError, match=message):
        opened_and_closed(url)


def test_nothing_is_put_into_the_database_of_another_program(url: str) -> None:
    executed(url, "CREATE TABLE orders (number INTEGER)")
    file = Path(url.removeprefix("sqlite:///"))
    before = file.read_bytes() if file.is_file() else b""
    with pytest.raises(StoreError, match="a table 'orders' not of the history"):
        opened_and_closed(url)
    assert before == (file.read_bytes() if file.is_file() else b"")
    assert executed(url, "SELECT * FROM orders") == []


def test_reports_that_were_compressed_by_themselves_are_read() -> None:
    """Those of earlier versions; and what all are compressed against is what it was, or none could be read."""
    assert unpack(zstandard.compress(b'{"state": "healthy"}')) == '{"state": "healthy"}'
    dictionary = Path(claim.__file__).with_name("reports.dictionary").read_bytes()
    assert hashlib.sha256(dictionary).hexdigest() == "af2696c3ddde702e4bf51e00016417f4cb4fa04bf9e1e9b5ee9fba2fa27ef8ac"
