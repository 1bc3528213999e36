"""The whole description of the API against a running service with data, tokens on.

Every route of the application is requested without a token, with a wrong one, and with one that lacks only the
scope. Then requests are made up from the description, valid and invalid ones, and every response must agree with it.
An ordinary run makes few, the same every time; for a long search with others::

    ROTORWATCH_API_CASES=2000 python -m pytest tests/service/api/test_openapi.py -k made_up -s
"""

import json
import os
import re
from collections import Counter
from collections.abc import Iterator
from typing import Any

import httpx
import hypothesis
import jsonschema_rs
import pytest
import schemathesis
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from schemathesis.core.result import Ok
from schemathesis.specs.openapi import checks

from rotorwatch import __version__
from service.access.guard import Guard
from service.access.scopes import Scope
from service.api.app import create_app
from service.runtime.runtime import Runtime
from tests.service.rig.monitored import GUARDED, client, faulty, problem, token

READ, OPERATE, CONFIGURE = Scope
POSITIVE, NEGATIVE = schemathesis.GenerationMode.POSITIVE, schemathesis.GenerationMode.NEGATIVE
STREAMS = {"/api/v1/events", "/api/v1/replays/{replay_id}/events"}
PUBLIC = {("GET", "/"), ("GET", "/healthz"), ("GET", "/page/{version}/{name:path}")}
#: Routes that exist but are not part of the interface for programs.
UNDESCRIBED = {
    ("GET", "/"), ("GET", "/openapi.json"), ("GET", "/docs"), ("GET", "/docs/{name}"),
    ("GET", "/page/{version}/{name:path}"),
}  # fmt: skip
#: Routes that do not exist, which is not revealed without a token.
STRAY = {("GET", "/nowhere"), ("PATCH", "/api/v1/machines"), ("POST", "/healthz")}
VALUES = {
    "site": "demo", "version": "0", "machine": "lab", "name": "k_by", "replay_id": "0123456789ab",
    "token_id": "0123456789ab",
}  # fmt: skip
CASES = int(os.environ.get("ROTORWATCH_API_CASES", "0"))
#: Routes with conditions on their arguments that a schema cannot state, such as one above another.
DEPENDENT = {
    "GET /api/v1/events", "GET /api/v1/machines/{site}/{machine}/alarms",
    "GET /api/v1/machines/{site}/{machine}/alarms/events", "GET /api/v1/machines/{site}/{machine}/correlations",
    "GET /api/v1/machines/{site}/{machine}/full-spectra", "GET /api/v1/machines/{site}/{machine}/orbits",
    "GET /api/v1/machines/{site}/{machine}/readings", "GET /api/v1/machines/{site}/{machine}/spectra",
    "GET /api/v1/machines/{site}/{machine}/vectors", "GET /api/v1/machines/{site}/{machine}/waterfalls",
    "GET /api/v1/machines/{site}/{machine}/waveforms", "GET /api/v1/trends", "POST /api/v1/replays",
    "POST /api/v1/tokens",
}  # fmt: skip
#: Errors that a valid request may get: not found, conflict, or precondition required.
STATE = {404, 409, 428}
#: The checks that apply to this description.
CHECKS = [
    schemathesis.checks.not_a_server_error, checks.status_code_conformance, checks.content_type_conformance,
    checks.response_headers_conformance, checks.response_schema_conformance, checks.negative_data_rejection,
]  # fmt: skip


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runtime]:
    with faulty(tmp_path_factory.mktemp("machine"), GUARDED) as (running, _):
        yield running


@pytest.fixture(scope="module")
def http(runtime: Runtime) -> Iterator[httpx.Client]:
    with client(runtime, token(runtime)) as found:
        yield found


@pytest.fixture(scope="module")
def description(http: httpx.Client) -> dict[str, Any]:
    found: dict[str, Any] = http.get("/openapi.json").json()
    return found


def application(runtime: Runtime) -> FastAPI:
    store = runtime.store
    return create_app(runtime, Guard(store.tokens, store.audit, runtime.settings.access, runtime.settings.http.host))


def routes(app: FastAPI) -> set[tuple[str, str]]:
    return {
        (method, context.path or "") for context in iter_route_contexts(app.routes) for method in context.methods or ()
    }


def needed(method: str, path: str) -> Scope:
    if path.startswith(("/api/v1/audit", "/api/v1/history", "/api/v1/settings", "/api/v1/tokens")) or path.endswith(
        ("/remove-from-service", "/return-to-service")
    ):
        return CONFIGURE
    return READ if method == "GET" or path == "/api/v1/session" else OPERATE


def ask(http: httpx.Client, method: str, path: str) -> httpx.Response:
    """Send a well-formed request; of streams only the beginning is read."""
    body = {"reason": "x", "expected_state": "shelved"} if "/alarms/" in path else {"recordings": ["a/b/c.mcap"]}
    address = path.replace(":path", "").format(**VALUES)
    with http.stream(method, address, json=body if method == "POST" else None) as answer:
        if not answer.headers["content-type"].startswith("text/event-stream"):
            answer.read()
    return answer


@pytest.fixture(scope="module")
def described(description: dict[str, Any]) -> set[tuple[str, str]]:
    return {(method.upper(), path) for path, methods in description["paths"].items() for method in methods}


def test_no_route_answers_without_a_valid_token(runtime: Runtime, described: set[tuple[str, str]]) -> None:
    asked = 0
    for text in ("", "rw_000000000000_" + 43 * "0", "secret"):
        with client(runtime, text) as nobody:
            for method, path in sorted(described | UNDESCRIBED | STRAY):
                if (method, path) in PUBLIC:
                    assert ask(nobody, method, path).status_code == (404 if "{" in path else 200)
                    continue
                answer = ask(nobody, method, path)
                assert answer.headers["www-authenticate"].startswith("Bearer"), path
                problem(answer, 401)
                asked += 1
    assert asked >= 3 * 30


def test_a_wrong_method_and_an_unknown_machine_are_refused_by_name(http: httpx.Client, description: Any) -> None:
    for path, methods in description["paths"].items():
        for method in {"get", "post", "put", "patch", "delete"} - methods.keys():
            answer, allowed = http.request(method, path.format(**VALUES)), ", ".join(sorted(methods)).upper()
            assert answer.headers["allow"] == allowed
            assert all(told in problem(answer, 405).detail for told in (method.upper(), allowed))
        for method in methods if path.startswith("/api/v1/machines/{site}") else ():
            found = problem(ask(http, method.upper(), path.replace("{machine}", "pump")), 404)
            assert found.detail == "no machine demo/pump; there are: demo/lab", path


def test_routes_are_described_and_require_their_scope(
    runtime: Runtime, http: httpx.Client, description: Any, described: Any
) -> None:
    """A route refuses a token with all scopes but its own, and accepts one with that scope alone."""
    assert routes(application(runtime)) <= described | UNDESCRIBED
    assert len(described) >= 30
    with_scope = {scope: token(runtime, scope, name=f"only {scope}") for scope in Scope}
    without = {scope: token(runtime, *(one for one in Scope if one != scope), name=f"no {scope}") for scope in Scope}
    for method, path in sorted(described | UNDESCRIBED):
        if (method, path) in PUBLIC:
            continue
        scope = needed(method, path)
        with client(runtime, without[scope]) as wrong, client(runtime, with_scope[scope]) as right:
            found = problem(ask(wrong, method, path), 403)
            assert found.detail.startswith(f"this needs the scope {scope}; no {scope} has "), path
            assert ask(right, method, path).status_code not in (401, 403), path
    for path, methods in description["paths"].items():
        for method, route in methods.items():
            declared = [part.get("token") for part in route.get("security", []) if "token" in part]
            public = (method.upper(), path) in PUBLIC
            assert declared == ([] if public else [[needed(method.upper(), path)]]), path
            in_browsers = any("browser" in part for part in route.get("security", []))
            assert in_browsers == (declared == [[READ]]), path
    assert http.get("/openapi.json").status_code == 200


def test_the_api_page_loads_nothing_from_other_hosts(http: httpx.Client) -> None:
    page = http.get("/docs")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    loaded = re.findall(r'(?:src|href|url)(?:=|: )"([^"]*)"', page.text)
    assert len(loaded) == 4
    for one in loaded:
        if one != "data:,":
            assert one.startswith("/")
            assert http.get(one).status_code == 200, one
    assert "http" not in page.headers["content-security-policy"]
    problem(http.get("/docs/core.py"), 422)


def test_everything_is_described_with_examples(description: dict[str, Any]) -> None:
    """Every argument has a text, every body and response an example that fits its schema."""
    schemas = description["components"]["schemas"]
    for name, schema in schemas.items():
        for field, part in schema.get("properties", {}).items():
            assert part.get("description") or set(part) == {"$ref"}, f"{name}.{field}"
    for path, methods in description["paths"].items():
        for method, route in methods.items():
            place = f"{method.upper()} {path}"
            assert route["summary"], place
            assert route["description"], place
            assert len(route["tags"]) == 1, place
            for argument in route.get("parameters", []):
                if argument["in"] != "path":
                    assert argument.get("description"), f"{place}: {argument['name']}"
            for part in route.get("requestBody", {}).get("content", {}).values():
                shown = [one["value"] for one in part.get("examples", {}).values()] or [part["example"]]
                for one in shown:
                    check(schemas, part["schema"], one, place)
            for status, described in route["responses"].items():
                answer = described
                if not status.startswith("2"):  # each problem is described once
                    answer = description["components"]["responses"][described["$ref"].rpartition("/")[2]]
                assert answer["description"], f"{place}: {status}"
                ((kind, part),) = answer["content"].items()
                assert (kind == "application/problem+json") == (not status.startswith("2")), place
                if kind in ("application/json", "application/problem+json"):
                    check(schemas, part["schema"], part["example"], f"{place}: {status}")
                else:
                    assert kind in ("text/event-stream", "application/octet-stream", "text/plain")
                if not status.startswith("2"):
                    assert part["example"]["status"] == int(status), place


def inner(value: object) -> Iterator[dict[str, Any]]:
    if isinstance(value, dict):
        yield value
        value = list(value.values())
    if isinstance(value, list):
        for one in value:
            yield from inner(one)


def test_names_tags_and_schemas_suit_code_generators(description: dict[str, Any]) -> None:
    assert description["info"]["version"] == __version__
    names = [route["operationId"] for methods in description["paths"].values() for route in methods.values()]
    assert len(set(names)) == len(names)
    for name in names:
        assert re.fullmatch("[a-z]+(_[a-z]+){0,3}", name), name
    for kind in ("schemas", "responses"):
        for name in description["components"][kind]:
            assert re.fullmatch("([A-Z][a-z]+)+", name), name
    tuples = [one for one in inner(description) if isinstance(one.get("prefixItems"), list)]
    assert tuples
    assert all("items" in one for one in tuples)
    # With every problem spelt out at every operation it was half a megabyte.
    assert len(json.dumps(description, ensure_ascii=False)) < 5_000 * len(names)
    there = {one["name"] for one in description["tags"]}
    used = {tag for methods in description["paths"].values() for route in methods.values() for tag in route["tags"]}
    assert used == there
    assert set(description["components"]["securitySchemes"]) == {"token", "browser"}


def check(schemas: dict[str, Any], schema: dict[str, Any], shown: object, place: str) -> None:
    whole = {**schema, "components": {"schemas": schemas}}
    error = next(iter(jsonschema_rs.validator_for(whole).iter_errors(shown)), None)
    assert error is None, f"{place}: {error}"


def validated(case: schemathesis.Case[Any], url: str, text: str) -> Any:
    """Send a made-up request and check the response against the description."""
    headers = {"Authorization": f"Bearer {text}"}
    if case.operation.path in STREAMS:
        arguments = case.as_transport_kwargs(base_url=url, headers=headers)
        try:
            request = httpx.Request(
                arguments["method"],
                arguments["url"],
                params=arguments.get("params"),
                headers={name: value for name, value in arguments["headers"].items() if value is not None},
            )
        except httpx.InvalidURL:  # too long to be sent
            hypothesis.reject()
        with httpx.Client(trust_env=False, timeout=180.0) as reader:
            streamed = reader.send(request, stream=True)
            body = b"" if streamed.status_code == 200 else streamed.read()
            streamed.close()
        whole = httpx.Response(streamed.status_code, headers=streamed.headers, content=body, request=streamed.request)
        whole.elapsed = streamed.elapsed
        case.validate_response(whole, checks=CHECKS, headers=headers)
        return whole
    response = case.call(base_url=url, headers=headers)
    case.validate_response(response, checks=CHECKS, headers=headers)
    return response


def made_up(
    operation: Any, mode: schemathesis.GenerationMode, path: dict[str, str] | None, cases: int, url: str, text: str
) -> list[tuple[str, int]]:
    """Send requests to one route; return the statuses."""
    found: list[tuple[str, int]] = []
    there = {one.name for one in operation.query}

    @hypothesis.settings(
        max_examples=cases, derandomize=not CASES, database=None, phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )  # fmt: skip
    @hypothesis.given(case=operation.as_strategy(mode, path_parameters=path))
    def run(case: schemathesis.Case[Any]) -> None:
        if mode is POSITIVE:  # OpenAPI allows other arguments as well
            case.query = {name: value for name, value in (case.query or {}).items() if name in there}
        answer = validated(case, url, text)
        found.append((operation.label, answer.status_code))
        if mode is POSITIVE and not 200 <= answer.status_code < 300 and answer.status_code not in STATE:
            refusal = answer.json()
            # An error in a single argument would contradict the description.
            assert answer.status_code == 422, refusal
            assert operation.label in DEPENDENT, refusal
            assert "errors" not in refusal, refusal

    try:
        run()
    except hypothesis.errors.Unsatisfiable:  # no request to it can be invalid
        assert mode is NEGATIVE
    return found


@pytest.mark.slow
def test_made_up_requests_are_answered_as_described(runtime: Runtime, description: dict[str, Any]) -> None:
    # Tokens are tested above; here they are always sent.
    plain = json.loads(json.dumps(description))
    del plain["components"]["securitySchemes"]
    for methods in plain["paths"].values():
        for route in methods.values():
            route.pop("security", None)
    schema = schemathesis.openapi.from_dict(plain)
    text = token(runtime, name="made up")
    seen: Counter[tuple[str, int]] = Counter()
    looked_at = 0
    for found in schema.get_all_operations():
        assert isinstance(found, Ok)
        operation = found.ok()
        known = {one.name: VALUES[one.name] for one in operation.path_parameters if one.name in VALUES} or None
        # A random text is hardly ever the name of a machine, so known names are used too. Without a name, this would
        # be the same request again, which may be another only for one that changes something.
        unknown = [(POSITIVE, None, 1)] if known or operation.method != "get" else []
        for mode, fixed, cases in ((POSITIVE, known, 1), *unknown, (NEGATIVE, known, 3)):
            for label, status in made_up(operation, mode, fixed, CASES or cases, runtime.http_url, text):
                seen[label, status] += 1
        looked_at += 1
    statuses = Counter[int]()
    for (_, status), count in seen.items():
        statuses[status] += count
    print(f"{sum(statuses.values())} requests to {looked_at} routes: {dict(sorted(statuses.items()))}")  # noqa: T201  # the result of a long search
    assert looked_at == sum(len(methods) for methods in description["paths"].values())
    # Each succeeded, or would have if the machine, recording or replay existed.
    assert {label for label, status in seen if status in (200, 201, 404)} == {label for label, _ in seen}
    # 503 is documented too, but the service had no fault.
    assert set(statuses) == {200, 201, 400, 404, 409, 422, 428}
