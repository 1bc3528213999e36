"""What the page says of its types holds: TypeScript checks every module, and that the records are those of the API.

Deno brings TypeScript in a package of Python; nothing of the page is run here, and nothing is fetched.
"""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from tests.service.api.page.browsing import run_deno
from tests.service.api.test_api_doc import description
from tests.service.rig.live import ROOT

PAGE = ROOT / "service" / "api" / "page"
RECORDS = PAGE / "monitor" / "records.js"
OPTIONS = {
    "checkJs": True,
    "strict": True,
    "noImplicitReturns": True,
    "noImplicitOverride": False,  # a word in JavaScript it would be, in a comment it is clutter
    "lib": ["dom", "dom.iterable", "esnext"],
}
#: What the page calls by a shorter name than the API.
CALLED = {
    "AlarmEvent": "AlarmEventData", "Bucket": "ReadingBucket", "Density": "ChannelDensity", "Ellipse": "OrbitEllipse",
    "Orbits": "OrbitSnapshot", "Spectra": "SpectrumSnapshot", "Stream": "StreamStatus",
}  # fmt: skip


def found(folder: Path, checked: list[Path]) -> str:
    """What TypeScript finds in modules, on a computer that has fetched nothing and fetches nothing."""
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
def schemas() -> dict[str, Any]:
    known: dict[str, Any] = description()["components"]["schemas"]
    return known


def compared(folder: Path, schemas: dict[str, Any], records: str, *beside: Path) -> str:
    """What is wrong with records of the page, beside those of the API, and with other modules: it takes as long."""
    (folder / "records.js").write_text(records)
    there = re.findall(r"^ \* @typedef \{.*\} (\w+)$", records, re.MULTILINE)
    assert len(there) == records.count("@typedef")
    unknown = [name for name in there if CALLED.get(name, name) not in schemas]
    assert not unknown, f"the API has no records of these names: {unknown}"
    lines = ['import type * as page from "./records.js";']
    lines += [f"type {name} = {as_type(one)};" for name, one in schemas.items()]
    lines += [f"export const told{name} = (it: {CALLED.get(name, name)}): page.{name} => it;" for name in there]
    (folder / "told.ts").write_text("\n".join(lines))
    return found(folder, [folder / "told.ts", *beside])


def test_every_module_is_of_the_types_it_says_and_reads_the_api(tmp_path: Path, schemas: dict[str, Any]) -> None:
    modules = sorted(PAGE.rglob("*.js"))
    assert len(modules) > 20
    assert compared(tmp_path, schemas, RECORDS.read_text(), *modules) == ""


def test_a_wrong_type_and_a_record_that_differs_are_found(tmp_path: Path, schemas: dict[str, Any]) -> None:
    wrong = tmp_path / "wrong.js"
    wrong.write_text("/** @param {number} one */\nexport const twice = (one) => one.length;\n")
    records = RECORDS.read_text()
    for there, instead in (
        ("raised_ns: number | null", "raised_ns: number"),
        ("data_age_s: number | null", "data_age_ms: number"),
    ):
        assert there in records
        records = records.replace(there, instead)
    said = compared(tmp_path, schemas, records, wrong)
    assert "'null' is not assignable to type 'number'" in said
    assert "'data_age_ms' is missing" in said
    assert "Property 'length' does not exist on type 'number'" in said
