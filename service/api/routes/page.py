"""Routes of the web page, and of the page that documents the API.

The page's files contain no data, which they request from the API, so anybody may load them. They are served below a
digest of all files, so that a browser can cache them indefinitely and never mixes two versions.
"""

import base64
import hashlib
from importlib.metadata import distribution
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal

from fastapi import FastAPI, HTTPException, Response
from fastapi import Path as InPath
from fastapi.responses import FileResponse, HTMLResponse

from service.access.guard import PAGE_FILES, Guard

_FOLDER = Path(str(files("service"))) / "api" / "page"
_TYPES = {".js": "text/javascript", ".css": "text/css"}
_CHARTS = ("uPlot.iife.js", "uPlot.min.css")
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_ASSETS = Path(str(files("fastapi_offline"))) / "static"
_SCRIPT = (
    'SwaggerUIBundle({url: "/openapi.json", dom_id: "#api", deepLinking: true, validatorUrl: null, '
    "tryItOutEnabled: true, defaultModelsExpandDepth: 0})"
)
_DOCS = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>rotorwatch: HTTP API</title>'
    '<link rel="icon" href="data:,"><link rel="stylesheet" href="/docs/swagger-ui.css"><div id="api"></div>'
    f'<script src="/docs/swagger-ui-bundle.js"></script><script>{_SCRIPT}</script></html>'
)
_HASH = base64.b64encode(hashlib.sha256(_SCRIPT.encode()).digest()).decode()
_DOCS_POLICY = _POLICY.replace(
    "script-src 'self'; style-src 'self'", f"script-src 'self' 'sha256-{_HASH}'; style-src 'self' 'unsafe-inline'"
)


def page_files() -> dict[str, bytes]:
    """All files of the page by name, including the chart library."""
    # The package itself is not imported, because it would import a notebook shell.
    charts = Path(str(distribution("uplot-python").locate_file("uplot/static")))
    found = {path.relative_to(_FOLDER).as_posix(): path for path in _FOLDER.rglob("*") if path.suffix in _TYPES}
    found |= {name: charts / name for name in _CHARTS}
    return {name: path.read_bytes() for name, path in sorted(found.items())}


def add_page_routes(app: FastAPI) -> None:
    """Add the page and the files that it loads."""
    found = page_files()
    digest = hashlib.sha256(repr(found).encode()).hexdigest()[:16]
    index = (_FOLDER / "index.html").read_text(encoding="utf-8").replace(PAGE_FILES, f"{PAGE_FILES}{digest}/")

    @app.get("/", include_in_schema=False, response_class=HTMLResponse)
    def page() -> HTMLResponse:
        return HTMLResponse(index, headers={"Content-Security-Policy": _POLICY, "Cache-Control": "no-cache"})

    @app.get(PAGE_FILES + "{version}/{name:path}", include_in_schema=False)
    def page_file(
        version: Annotated[str, InPath(description="digest of all files")],
        name: Annotated[str, InPath(description="name of the file")],
    ) -> Response:
        if version != digest or name not in found:
            raise HTTPException(404, f"the page has no file {name[:80]} in this version; reload /")
        # A worker script is subject to the policy in its own response.
        keep = {"Content-Security-Policy": _POLICY, "Cache-Control": "public, max-age=31536000, immutable"}
        return Response(found[name], media_type=_TYPES[Path(name).suffix], headers=keep)


def add_docs_routes(app: FastAPI, guard: Guard) -> None:
    """Add the page and its assets."""

    @app.get("/docs", dependencies=[guard.read], include_in_schema=False, response_class=HTMLResponse)
    def docs() -> HTMLResponse:
        return HTMLResponse(_DOCS, headers={"Content-Security-Policy": _DOCS_POLICY})

    @app.get("/docs/{name}", dependencies=[guard.read], include_in_schema=False)
    def docs_asset(
        name: Annotated[Literal["swagger-ui-bundle.js", "swagger-ui.css"], InPath(description="name of the file")],
    ) -> FileResponse:
        return FileResponse(_ASSETS / name, headers={"Cache-Control": "private, max-age=86400"})
