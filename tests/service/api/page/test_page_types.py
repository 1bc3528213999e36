"""Type annotations of the page: TypeScript checks every module against the records described by the API.

Deno brings TypeScript in a Python package; the page is not run here, and nothing is downloaded.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.service.api.page.browsing import run_deno
from tests.service.api.test_api_doc import description
from tests.service.rig.live import ROOT

PAGE = ROOT / "service" / "api" / "page"
RECORDS = "monitor/records.d.ts"  #: imported by the modules, and generated only here
OPTIONS = {
    "checkJs": True,
    "strict": True,
    "noImplicitReturns": True,
    "noImplicitOverride": False,  # JavaScript has no such keyword, and in a comment it is clutter
    "lib": ["dom", "dom.iterable", "esnext"],
}


def found(folder: Path, checked: list[Path]) -> str:
    """Errors that TypeScript finds in modules, without any downloads."""
    config = folder / "deno.json"
    config.write_text(json.dumps({"compilerOptions": OPTIONS}))
    done = run_deno(folder, "check", "--config", str(config), *map(str, checked))
    return done.stdout + done.stderr if done.returncode else ""


def as_type(schema: dict[str, Any]) -> str:
    """A JSON schema as a type of TypeScript."""
    if "$ref" in schema:
        return str(schema["$ref"].rsplit("/", 1)[1])
    if parts := schema.get("anyOf") or schema.get("oneOf"):
        return " | ".join(f"({as_type(part)})" for part in parts)
    if values := schema.get("enum") or ([schema["const"]] if "const" in schema else None):
        return " | ".join(json.dumps(value) for value in values)
    match schema.get("type"):
        case "array" if "prefixItems" in schema:
            return f"[{', '.join(map(as_type, schema['prefixItems']))}]"
        case "array":
            return f"({as_type(schema['items'])})[]"
        case "object" if "properties" in schema:
            needed = schema.get("required", ())
            lines = (
                f"{name}{'' if name in needed else '?'}: {as_type(one)}" for name, one in schema["properties"].items()
            )
            return f"{{{'; '.join(lines)}}}"
        case "object":
            held = schema.get("additionalProperties")
            return f"Record<string, {as_type(held) if isinstance(held, dict) else 'unknown'}>"
        case "integer" | "number":
            return "number"
        case "string" | "boolean" | "null" as plain:
            return str(plain)
        case _:
            return "unknown"


@pytest.fixture(scope="module")
def errors(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Errors of TypeScript in the page as it is, and in a few modules if the API had other fields and one a fault.

    TypeScript reads its own library once for both.
    """
    folder = tmp_path_factory.mktemp("types")
    schemas: dict[str, Any] = description()["components"]["schemas"]
    stream, alarm = schemas["StreamStatus"]["properties"], schemas["Alarm"]["properties"]
    ages = {"data_age_ms" if name == "data_age_s" else name: one for name, one in stream.items()}
    changed = {
        "StreamStatus": {**schemas["StreamStatus"], "properties": ages},
        "Alarm": {**schemas["Alarm"], "properties": alarm | {"since_ns": {"type": "null"}}},
    }
    for page, known in (("right", schemas), ("wrong", schemas | changed)):
        shutil.copytree(PAGE, folder / page)
        lines = (f"export type {name} = {as_type(one)};" for name, one in known.items())
        (folder / page / RECORDS).write_text("\n".join(lines))
    wrong = "/** @param {number} one */\nexport const twice = (one) => one.length;\n"
    (folder / "wrong" / "monitor" / "twice.js").write_text(wrong)
    few = (folder / "wrong" / "monitor" / f"{name}.js" for name in ("monitor", "states", "twice"))
    said = found(folder, [*sorted((folder / "right").rglob("*.js")), *few]).split("\n\n")
    return {page: "\n\n".join(one for one in said if f"/{page}/" in one) for page in ("right", "wrong")}


def test_every_module_passes_type_checks_against_the_api(errors: dict[str, str]) -> None:
    assert len(list(PAGE.rglob("*.js"))) > 20
    assert errors["right"] == ""


def test_a_wrong_type_and_a_field_missing_from_the_api_are_found(errors: dict[str, str]) -> None:
    said = errors["wrong"]
    assert "'null'" in said
    assert "Property 'data_age_s' does not exist" in said
    assert "Property 'length' does not exist on type 'number'" in said
