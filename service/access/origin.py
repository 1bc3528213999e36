"""Refuses requests that a page from elsewhere could make a browser send.

A browser by itself adds what admits its user: it reaches a loopback service, and sends a password that it has kept. So
no request that could change anything is accepted from another page. Where no token is needed, none at all is accepted
under a name that is not this service's: a foreign name that leads here would make its page one of ours.
"""

from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException

from models.signals.link import is_address

SAFE_METHODS = frozenset(("GET", "HEAD", "OPTIONS"))
"""Methods that change nothing."""

_WITH_BODY = frozenset(("POST", "PUT", "PATCH"))
_FROM_HERE = ("none", "same-origin")
_FORWARDED = ("forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip")


def check_origin(
    headers: Headers, method: str, *, listens_on: str, hosts: tuple[str, ...], open_to_all: bool, kept: bool
) -> None:
    """Refuse a request that may come from somebody else's page.

    Parameters
    ----------
    hosts : tuple of str
        Other names under which browsers reach the service.
    open_to_all : bool
        Whether callers need no token; then the host name is checked, and nothing is accepted from a proxy.
    kept : bool
        Whether the caller is known by a cookie, which a browser adds by itself: then it must say which page asks.

    Raises
    ------
    HTTPException
        403 for a request from elsewhere.
    """
    host = headers.get("host", "")
    if open_to_all:
        name = _host_name(f"//{host}")
        if not is_address(name) and name not in ("localhost", listens_on, *hosts):
            raise HTTPException(403, f"host {host!r} is not one of this service; see [access] hosts in the settings")
        passed_on = next((header for header in _FORWARDED if header in headers), None)
        if passed_on is not None:
            raise HTTPException(
                403, f"a proxy sent this (header {passed_on}), but without tokens the API is for this computer alone"
            )
    if method in SAFE_METHODS:
        return
    origin = headers.get("origin")
    if kept and origin is None:
        raise HTTPException(
            403, "a cookie alone may not change anything: the header Origin, which browsers send, is missing"
        )
    if origin is not None and not _is_ours(origin, host, hosts):
        raise HTTPException(403, f"a page from {origin[:200]} may not do this")
    if headers.get("sec-fetch-site", "none") not in _FROM_HERE:
        raise HTTPException(403, "a page from elsewhere may not do this")


def check_body_type(headers: Headers, method: str) -> None:
    """Refuse what a form on somebody else's page could send to a route that takes a body.

    A form can send neither JSON nor other methods; a script from elsewhere would have to ask first.

    Raises
    ------
    HTTPException
        415 for a body that is not sent as JSON.
    """
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    if method in _WITH_BODY and kind != "application/json":
        raise HTTPException(415, f"content type is {kind[:100] or 'missing'}, expected application/json")


def _is_ours(origin: str, host: str, hosts: tuple[str, ...]) -> bool:
    """Whether a page is one of this service; a proxy may have put another name into the request."""
    scheme, _, place = origin.partition("://")
    return scheme in ("http", "https") and (place == host or place.lower() in hosts)


def _host_name(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:  # brackets that do not close, or without an address in them
        return ""
