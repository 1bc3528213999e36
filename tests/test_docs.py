"""Fields and links in the documents are checked against the code and the files."""

import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from types import UnionType
from typing import get_args

import pytest
from pydantic import BaseModel

from models.machine import Machine
from models.signals.keys import Grant
from models.signals.link import TlsSettings
from service.interchange.mapping import Acceleration, Column, CsvFormat, Keyphasor, Mapping, TimeBase
from service.settings.service import ServiceSettings
from service.settings.webhooks import WebhookSettings

ROOT = Path(__file__).parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), ROOT / "rotorwatch" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def fields_of(model: type[BaseModel]) -> Iterator[tuple[str, str | None]]:
    """Names and descriptions of a model's fields and of those of its tables."""
    for name, field in model.model_fields.items():
        inner = field.annotation
        if isinstance(inner, UnionType):  # a table that may be left out
            inner = get_args(inner)[0]
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            yield name, "a table"
            yield from fields_of(inner)
        else:
            yield name, field.description


@pytest.mark.parametrize(
    ("pages", "models"),
    [
        (("machine-file",), (Machine,)),
        (("service", "access", "zenoh-security"), (ServiceSettings,)),
        (("zenoh-security",), (TlsSettings, Grant)),
        (("webhooks",), (WebhookSettings,)),
        (("interchange",), (Mapping, CsvFormat, TimeBase, Column, Acceleration, Keyphasor)),
    ],
    ids=lambda value: value[0] if isinstance(value[0], str) else "",
)
def test_every_field_is_documented(pages: tuple[str, ...], models: tuple[type[BaseModel], ...]) -> None:
    text = "".join((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8") for page in pages)
    for name, description in chain.from_iterable(map(fields_of, models)):
        assert re.search(rf"`{name}`|\[{name}\b|\.{name}[].]", text), f"no page of {pages} mentions {name}"
        assert description or "service" not in pages, name


def anchors_of(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub forms them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_between_documents_resolve(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", text):
        if not target.startswith("http"):
            found = page.parent / target if target else page
            assert found.exists(), f"{page.name} links to {target}"
            assert not anchor or anchor in anchors_of(found), f"{page.name} links to {target}#{anchor}"


def test_modules_stay_small() -> None:
    long = {
        str(path.relative_to(ROOT)): count
        for folder in ("models", "rotorwatch", "service", "simulator", "tests")
        for path in (ROOT / folder).rglob("*.py")
        if (count := len(path.read_text(encoding="utf-8").splitlines())) > 500
    }
    assert not long
