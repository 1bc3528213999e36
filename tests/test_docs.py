"""Untested docs lie: fields, links and commands in the documents are checked against the code."""

import re
from pathlib import Path

import pytest
from pydantic import BaseModel

from models.machine import Machine

ROOT = Path(__file__).parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), ROOT / "rotorwatch" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def fields_of(model: type[BaseModel]) -> set[str]:
    found = set(model.model_fields)
    for field in model.model_fields.values():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            found |= fields_of(field.annotation)
    return found


def test_every_field_of_the_machine_file_is_documented() -> None:
    page = (ROOT / "docs" / "machine-file.md").read_text(encoding="utf-8")
    structure = {"rotor", "operation", "condition", "sensors", "window", "ingest", "alarms", "limits", "parameters"}
    structure |= {"levels", "schedule", "suppress"}
    for name in fields_of(Machine) - structure:
        assert f"`{name}`" in page, f"docs/machine-file.md does not mention {name}"
    for name in structure:
        assert f"[{name}" in page or f".{name}" in page, f"docs/machine-file.md does not mention table {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_between_documents_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_modules_stay_small() -> None:
    long = {
        str(path.relative_to(ROOT)): count
        for folder in ("models", "rotorwatch", "service", "simulator", "tests")
        for path in (ROOT / folder).rglob("*.py")
        if (count := len(path.read_text(encoding="utf-8").splitlines())) > 500
    }
    assert not long
