"""That a route's caller has a scope, as a dependency that OpenAPI shows."""

from typing import Annotated, Any

from fastapi import Depends, Request, Security
from fastapi.openapi.models import HTTPBase, HTTPBearer
from fastapi.security.base import SecurityBase
from starlette.exceptions import HTTPException

from service.access.audit import AuditNote
from service.access.credentials import BEARER, NEEDED
from service.access.scopes import Caller, Scope

CALLER = "access_caller"
"""Where the middleware leaves the caller, in ``request.state``."""


class Requirement:
    """Gives the caller of a route, who has a scope."""

    def __init__(self, scope: Scope) -> None:
        self.scope = scope

    def __call__(self, request: Request) -> Caller:
        """Return the caller.

        Raises
        ------
        HTTPException
            401 without a caller, 403 if the scope is missing.
        """
        caller = getattr(request.state, CALLER, None)
        if not isinstance(caller, Caller):  # it came past the middleware
            raise HTTPException(401, NEEDED, {"WWW-Authenticate": BEARER})
        if self.scope not in caller.scopes:
            granted = ", ".join(scope for scope in Scope if scope in caller.scopes)
            text = f"this needs the scope {self.scope}; {caller.name} has {granted or 'none'}"
            request.state.audit = AuditNote(reason=text)
            raise HTTPException(403, text)
        return caller


class _Shown(SecurityBase):
    """A way to present a token as OpenAPI shows it; looking at the token is the middleware's affair."""

    def __init__(self, model: HTTPBase, scheme_name: str) -> None:
        self.model = model
        self.scheme_name = scheme_name

    async def __call__(self) -> None:
        """Nothing is left to do."""


_BEARER = _Shown(HTTPBearer(bearerFormat="rw_<id>_<secret>", description="token of rotorwatch token create"), "token")
_BASIC = _Shown(
    HTTPBase(scheme="basic", description="for browsers, GET only: any user name, and the token as password"), "browser"
)


def requires(scope: Scope, *, in_browsers: bool = False) -> Any:
    """Dependency that gives a `Caller` with a scope.

    Parameters
    ----------
    in_browsers : bool
        Whether OpenAPI shows that the token may also come as a password.
    """
    requirement = Requirement(scope)

    def with_token(
        caller: Annotated[Caller, Depends(requirement)],
        _token: Annotated[None, Security(_BEARER, scopes=[scope.value])],
    ) -> Caller:
        return caller

    def with_token_or_password(
        caller: Annotated[Caller, Depends(requirement)],
        _token: Annotated[None, Security(_BEARER, scopes=[scope.value])],
        _password: Annotated[None, Security(_BASIC, scopes=[scope.value])],
    ) -> Caller:
        return caller

    return Depends(with_token_or_password if in_browsers else with_token)
