"""Tables are created once, by whoever comes first; old versions are migrated, those of other programs left alone."""

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


def test_a_change_of_tables_needs_a_new_revision() -> None:
    """After changing a table, write a migration, then update what is expected here."""
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
    opened_and_closed(url)  # nothing left to migrate


def test_several_monitors_open_an_empty_database_at_once(url: str) -> None:
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(opened_and_closed, [url] * 4))
    assert executed(url, "SELECT version_num FROM alembic_version") == [(REVISION,)]


def test_opening_an_up_to_date_database_does_not_import_alembic(url: str) -> None:
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
def test_a_history_of_unknown_revision_is_refused(url: str, change: str, message: str) -> None:
    opened_and_closed(url)
    executed(url, change)
    with pytest.raises(StoreError, match=message):
        opened_and_closed(url)


def test_the_database_of_another_program_is_refused_unchanged(url: str) -> None:
    executed(url, "CREATE TABLE orders (number INTEGER)")
    file = Path(url.removeprefix("sqlite:///"))
    before = file.read_bytes() if file.is_file() else b""
    with pytest.raises(StoreError, match="a table 'orders' not of the history"):
        opened_and_closed(url)
    assert before == (file.read_bytes() if file.is_file() else b"")
    assert executed(url, "SELECT * FROM orders") == []


def test_reports_compressed_without_a_dictionary_are_read() -> None:
    """Those of earlier versions; and the dictionary is unchanged, or no later report could be read."""
    assert unpack(zstandard.compress(b'{"state": "healthy"}')) == '{"state": "healthy"}'
    dictionary = Path(claim.__file__).with_name("reports.dictionary").read_bytes()
    assert hashlib.sha256(dictionary).hexdigest() == "af2696c3ddde702e4bf51e00016417f4cb4fa04bf9e1e9b5ee9fba2fa27ef8ac"
