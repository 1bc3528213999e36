"""What a request says about its caller: address, and token if there is one."""

import base64
import binascii
import ipaddress

from fastapi import Request
from starlette.datastructures import Headers
from starlette.requests import cookie_parser

from service.access.origin import SAFE_METHODS
from service.access.scopes import Caller

COOKIE = "rotorwatch_token"
"""Name of the cookie in which a browser keeps the token of a signed-in user."""

NEEDED = "an access token is needed; programs send it as header Authorization: Bearer rw_…"
BEARER = 'Bearer realm="rotorwatch"'
_BASIC = 'Basic realm="rotorwatch", charset="UTF-8"'
_V6_NETWORK = 64


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
