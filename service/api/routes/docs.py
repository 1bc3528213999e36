"""The description of the API as a page to read and to try out; all that it loads comes from here."""

import base64
import hashlib
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal

from fastapi import FastAPI
from fastapi import Path as InPath
from fastapi.responses import FileResponse, HTMLResponse

from service.access.guard import Guard

_ASSETS = Path(str(files("fastapi_offline"))) / "static"
_SCRIPT = (
    'SwaggerUIBundle({url: "/openapi.json", dom_id: "#api", deepLinking: true, validatorUrl: null, '
    "tryItOutEnabled: true, defaultModelsExpandDepth: 0})"
)
_PAGE = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>rotorwatch: HTTP API</title>'
    '<link rel="icon" href="data:,"><link rel="stylesheet" href="/docs/swagger-ui.css"><div id="api"></div>'
    f'<script src="/docs/swagger-ui-bundle.js"></script><script>{_SCRIPT}</script></html>'
)
_HASH = base64.b64encode(hashlib.sha256(_SCRIPT.encode()).digest()).decode()
_POLICY = (
    f"default-src 'none'; script-src 'self' 'sha256-{_HASH}'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def add_docs_routes(app: FastAPI, guard: Guard) -> None:
    """Add the page and its assets."""

    @app.get("/docs", dependencies=[guard.read], include_in_schema=False, response_class=HTMLResponse)
    def docs() -> HTMLResponse:
        """Show the API."""
        return HTMLResponse(_PAGE, headers={"Content-Security-Policy": _POLICY})

    @app.get("/docs/{name}", dependencies=[guard.read], include_in_schema=False)
    def docs_asset(
        name: Annotated[Literal["swagger-ui-bundle.js", "swagger-ui.css"], InPath(description="of the file")],
    ) -> FileResponse:
        """Serve what the page loads."""
        return FileResponse(_ASSETS / name, headers={"Cache-Control": "private, max-age=86400"})
