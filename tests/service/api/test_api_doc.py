"""The page on the HTTP API has every route, its arguments and examples as in the service's own description.

The text after *Needs the scope* is generated from that description; ``python -m tests.service.api.test_api_doc`` writes
it anew. The commands in the page are run unchanged except for the address.
"""

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rotorwatch.records.example import example
from rotorwatch.records.monitor import Problem
from service.access.guard import Guard
from service.api.app import create_app
from service.runtime.runtime import Runtime
from tests.service.rig.live import ROOT, settings, until
from tests.service.rig.monitored import GUARDED, PLACE, client, fed, token

PAGE = ROOT / "docs" / "api.md"
MADE = "Needs the scope"
NOBODY = "Needs no token"
WIDTH = 118


def description() -> dict[str, Any]:
    """The service's own description, without running it."""
    plan = settings("tcp/127.0.0.1:0")
    runtime = Runtime(plan)
    store = runtime.store
    app = create_app(runtime, Guard(store.tokens, store.audit, plan.access, plan.http.host))
    return app.openapi()


def sections(page: str) -> dict[str, str]:
    parts = re.split(r"^## (.+)$", page, flags=re.MULTILINE)
    return {title.strip("`"): body for title, body in zip(parts[1::2], parts[2::2], strict=True)}


def routes(described: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {
        f"{method.upper()} {path}": route
        for path, methods in described["paths"].items()
        for method, route in methods.items()
    }


def compact(value: Any, indent: int = 0) -> str:
    """JSON with everything that fits on one line on one line."""
    line = json.dumps(value, ensure_ascii=False)
    if len(line) + indent <= WIDTH or not isinstance(value, dict | list) or not value:
        return line
    inner = " " * (indent + 2)
    if isinstance(value, dict):
        parts = [f"{inner}{json.dumps(name)}: {compact(one, indent + 2)}" for name, one in value.items()]
        return "{\n" + ",\n".join(parts) + "\n" + " " * indent + "}"
    return "[\n" + ",\n".join(inner + compact(one, indent + 2) for one in value) + "\n" + " " * indent + "]"


def meaning(argument: dict[str, Any]) -> str:
    """Purpose of an argument, its limits and its default."""
    schema = argument["schema"]
    inner = next((one for one in schema.get("anyOf", []) if one.get("type") != "null"), schema)
    text: str = argument["description"]
    choice = inner.get("items", inner).get("enum", ())
    if 0 < len(choice) <= 12:
        text += ": " + ", ".join(f"`{one}`" for one in choice)
    low, high = inner.get("minimum"), inner.get("maximum")
    if low is not None and high is not None and high < 2**62:
        text += f"; {low:g} to {high:g}"
    if schema.get("default") not in (None, [], False):
        text += f"; default {schema['default']}"
    return text


def made(route: dict[str, Any], shown_before: dict[str, str], title: str) -> str:
    """Text on a route made from the description; a response already shown is not repeated."""
    scopes = [scope for part in route.get("security", []) for scope in part.get("token", [])]
    text = f"{MADE} `{scopes[0]}`.\n" if scopes else f"{NOBODY}.\n"
    arguments = [one for one in route.get("parameters", []) if one["in"] != "path"]
    if arguments:
        rows = "".join(
            f"| `{one['name']}`{' (header)' if one['in'] == 'header' else ''} | {meaning(one)} |\n" for one in arguments
        )
        text += f"\n| argument | meaning |\n|---|---|\n{rows}"
    for part in route.get("requestBody", {}).get("content", {}).values():
        (shown,) = part["examples"].values()
        text += f"\nBody:\n\n```json\n{compact(shown['value'])}\n```\n"
    if "requestBody" not in route or route["operationId"] == "acknowledge":
        answer = next(one for status, one in route["responses"].items() if status.startswith("2"))
        ((kind, part),) = answer["content"].items()
        if kind == "application/json":
            example_text = compact(part["example"])
            before = shown_before.setdefault(example_text, title)
            if before != title:
                text += f"\nAnswer as under `{before}`.\n"
            else:
                text += f"\nAnswer:\n\n```json\n{example_text}\n```\n"
        elif "example" in part:
            text += f"\nAnswer:\n\n```\n{shortened(part['example'])}```\n"
    return text


def shortened(text: str) -> str:
    return "".join(line if len(line) <= WIDTH else f"{line[:WIDTH]} ...\n" for line in text.splitlines(keepends=True))


def overview(found: dict[str, dict[str, Any]]) -> str:
    rows = ""
    for title, route in found.items():
        scopes = [scope for part in route.get("security", []) for scope in part.get("token", [])]
        text = route["description"].split(". ")[0].split("; ")[0].rstrip(".").replace("\n", " ")
        rows += f"| `{title}` | {scopes[0] if scopes else 'none'} | {text} |\n"
    return f"{MADE} `read`, `operate`, `configure`, or none:\n\n| route | scope | |\n|---|---|---|\n{rows}"


def written(page: str, described: dict[str, Any]) -> str:
    """The page with its generated parts replaced."""
    found = routes(described)
    shown: dict[str, str] = {}
    parts = re.split(r"^(## .+)$", page, flags=re.MULTILINE)
    text = parts[0]
    for heading, body in zip(parts[1::2], parts[2::2], strict=True):
        title = heading.removeprefix("## ").strip("`")
        prose = re.split(rf"^(?:{MADE}|{NOBODY})", body, maxsplit=1, flags=re.MULTILINE)[0].strip()
        if title == "Routes":
            tail = overview(found)
        elif title == "Errors":
            tail = f"{MADE} only if the route does. Such as:\n\n```json\n{compact(example(Problem))}\n```\n"
        else:
            tail = made(found[title], shown, title) if title in found else ""
        text += f"{heading}\n\n{prose + chr(10) * 2 if prose else ''}{tail}\n"
    return text.rstrip() + "\n"


def test_every_route_has_a_section() -> None:
    titles = set(sections(PAGE.read_text(encoding="utf-8")))
    assert titles == set(routes(description())) | {"Routes", "Errors"}


def test_arguments_and_examples_agree_with_the_description() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert page == written(page, description()), "python -m tests.service.api.test_api_doc writes it anew"


def test_every_section_says_more_than_the_description() -> None:
    for title, body in sections(PAGE.read_text(encoding="utf-8")).items():
        prose = re.split(rf"^(?:{MADE}|{NOBODY})", body, maxsplit=1, flags=re.MULTILINE)[0]
        assert title == "Routes" or len(prose.split()) >= 3, title


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    with fed(tmp_path_factory.mktemp("machine"), GUARDED) as (runtime, feed):
        feed.gap()
        with client(runtime, token(runtime)) as http:
            until(lambda: '"unacknowledged"' in http.get(f"{PLACE}/alarms").text, "alarm")
        yield runtime.http_url, token(runtime, name="reader of the page")


# The page's commands are for a terminal with curl; a fresh machine has Python, git and make alone.
@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not installed")
def test_curl_commands_in_the_page_work(served: tuple[str, str], tmp_path: Path) -> None:
    url, text = served
    blocks = re.findall(r"```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    commands = [line for block in blocks for line in block.replace("\\\n", " ").splitlines() if line.startswith("curl")]
    assert len(commands) >= 12
    for command in commands:
        assert "http://127.0.0.1:8080" in command
        done = subprocess.run(
            ["/bin/sh", "-c", command.replace("http://127.0.0.1:8080", url)],
            env={"ROTORWATCH_TOKEN": text, "PATH": "/usr/local/bin:/usr/bin:/bin"}, cwd=tmp_path, capture_output=True,
            text=True, timeout=300, check=False,
        )  # fmt: skip
        ended_by_us = 28
        assert done.returncode in ((0, ended_by_us) if "--max-time" in command else (0,)), done.stderr
        assert done.stdout, command
        assert '"type":"about:blank"' not in done.stdout, f"{command}: {done.stdout}"
        if "api/v1/events" in command:
            assert "event: start" in done.stdout


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8"), description()), encoding="utf-8")
