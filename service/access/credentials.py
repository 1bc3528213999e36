"""What a request says about its caller: address, token if there is one, and whether a page from elsewhere made it.

A browser by itself adds what admits its user: it reaches a loopback service, and sends a password that it has kept. So
no request that could change anything is accepted from another page. Where no token is needed, none at all is accepted
under a name that is not this service's: a foreign name that leads here would make its page one of ours.
"""

import base64
import binascii
import ipaddress
from urllib.parse import urlsplit

from fastapi import Request
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import cookie_parser

from models.signals.link import is_address
from service.access.scopes import Caller
from service.settings.access import AccessSettings

COOKIE = "rotorwatch_token"
"""Name of the cookie in which a browser keeps the token of a signed-in user."""

NEEDED = "an access token is needed; programs send it as header Authorization: Bearer rw_…"
BEARER = 'Bearer realm="rotorwatch"'
_BASIC = 'Basic realm="rotorwatch", charset="UTF-8"'
_V6_NETWORK = 64
SAFE_METHODS = frozenset(("GET", "HEAD", "OPTIONS"))
"""Methods that change nothing."""

_WITH_BODY = frozenset(("POST", "PUT", "PATCH"))
_FROM_HERE = ("none", "same-origin")
_FORWARDED = ("forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip")


def address_of(request: Request) -> str:
    """Where a request came from; empty where there are no addresses."""
    return "" if request.client is None else request.client.host


def network_of(address: str) -> str:
    """What counts as one address: for IPv6 the first 64 bits, because a caller has the others to itself."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv4Address):
        return str(parsed)
    if parsed.ipv4_mapped is not None:
        return str(parsed.ipv4_mapped)
    return str(ipaddress.ip_network((parsed, _V6_NETWORK), strict=False))


def key_of(caller: Caller) -> str:
    """Key under which a caller's requests and streams are counted."""
    return caller.token_id or network_of(caller.address)


def presented_text(headers: Headers, method: str) -> str | None:
    """Token in the header ``Authorization``, or in the cookie of a signed-in user.

    The password of HTTP Basic counts only for methods that change nothing.
    """
    kept = kept_text(headers)
    if kept is not None:
        return kept
    found = headers.getlist("authorization")
    scheme, _, value = found[0].partition(" ") if len(found) == 1 else ("", "", "")
    if scheme.lower() == "bearer":
        return value.strip()
    if scheme.lower() == "basic" and method in SAFE_METHODS:
        try:
            return base64.b64decode(value.strip(), validate=True).decode("utf-8").partition(":")[2]
        except (binascii.Error, ValueError):
            return None
    return None


def kept_text(headers: Headers) -> str | None:
    """Token of a signed-in user, in the cookie that the browser adds by itself; None if a program sends its own token.

    A password beside it does not count: a browser that was once given one, which is for reading, goes on sending it.
    """
    if headers.get("authorization", "basic").partition(" ")[0].lower() != "basic":
        return None
    return cookie_parser(headers.get("cookie", "")).get(COOKIE)


def challenges(request: Request) -> tuple[str, ...]:
    """Values of ``WWW-Authenticate``, one header each: Chromium reads only the first challenge of a header.

    A browser that shows a page is also told how to ask for a password.
    """
    invalid = ', error="invalid_token"' if "authorization" in request.headers else ""
    shows_page = request.method in SAFE_METHODS and "text/html" in request.headers.get("accept", "")
    return (BEARER + invalid, *((_BASIC,) if shows_page else ()))


def unauthenticated(request: Request) -> str:
    """Why a request has no caller; does not reveal whether an invalid token was ever valid."""
    if kept_text(request.headers) is not None:
        return "you are no longer signed in: the token has expired or was revoked"
    if "authorization" not in request.headers:
        return NEEDED
    if presented_text(request.headers, request.method) is None:
        return f"the header Authorization holds no access token, expected: Bearer rw_… ({request.method})"
    return "the access token is not valid: no such token was created here, or it has expired or was revoked"


def check_origin(request: Request, access: AccessSettings, listens_on: str) -> None:
    """Refuse a request that may come from somebody else's page.

    Where callers need no token, the host name is checked, and nothing is accepted from a proxy. A browser that adds the
    cookie by itself must say which page asks.

    Raises
    ------
    HTTPException
        403 for a request from elsewhere.
    """
    headers = request.headers
    host = headers.get("host", "")
    if access.open_on_loopback:
        name = _host_name(f"//{host}")
        if not is_address(name) and name not in ("localhost", listens_on, *access.hosts):
            raise HTTPException(403, f"host {host!r} is not one of this service; see [access] hosts in the settings")
        passed_on = next((header for header in _FORWARDED if header in headers), None)
        if passed_on is not None:
            raise HTTPException(
                403, f"a proxy sent this (header {passed_on}), but without tokens the API is for this computer alone"
            )
    if request.method in SAFE_METHODS:
        return
    origin = headers.get("origin")
    if origin is None and kept_text(headers) is not None:
        raise HTTPException(
            403, "a cookie alone may not change anything: the header Origin, which browsers send, is missing"
        )
    if origin is not None:
        scheme, _, place = origin.partition("://")
        # A proxy may have put another name into the request than the page is under.
        if scheme not in ("http", "https") or (place != host and place.lower() not in access.hosts):
            raise HTTPException(403, f"a page from {origin[:200]} may not do this")
    if headers.get("sec-fetch-site", "none") not in _FROM_HERE:
        raise HTTPException(403, "a page from elsewhere may not do this")


def check_body_type(request: Request) -> None:
    """Refuse what a form on somebody else's page could send to a route that takes a body.

    A form can send neither JSON nor other methods; a script from elsewhere would have to ask first.

    Raises
    ------
    HTTPException
        415 for a body that is not sent as JSON.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if request.method in _WITH_BODY and kind != "application/json":
        raise HTTPException(415, f"content type is {kind[:100] or 'missing'}, expected application/json")


def _host_name(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:  # brackets that do not close, or without an address in them
        return ""
