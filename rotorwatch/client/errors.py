"""What can go wrong for a client.

::

    ClientError
    ├── LogReplaced           the alarm log is another one than that which was followed
    ├── NoAnswer              nobody answered, or not in time
    └── RequestRefused        the service said no: `status` and the problem's text
        ├── AccessRefused         401, 403: no token, or one without the scope
        ├── NotFound              404: no such machine, alarm, ...
        ├── Conflict              409, 412: the alarm is no longer as it was seen, or its state does not allow it
        └── Unavailable           429, 503: try again later
"""


class ClientError(Exception):
    """Everything a client raises."""


class LogReplaced(ClientError):  # noqa: N818  # named after what happened, as all below
    """The alarm log is not the one that was followed; the message says how that was seen."""


class NoAnswer(ClientError):  # noqa: N818
    """Nobody answered, not in time, or with something that is no answer; the message names the address."""


class RequestRefused(ClientError):  # noqa: N818
    """The service refused a request with this HTTP status; the message is the detail of its problem."""

    def __init__(self, status: int, detail: str) -> None:
        super().__init__(detail)
        self.status = status


class AccessRefused(RequestRefused):
    """There is no token, it is not valid, or its scopes do not include the route's."""


class NotFound(RequestRefused):
    """There is no such machine, alarm, or page."""


class Conflict(RequestRefused):
    """The alarm is no longer as it was seen, or its state does not allow what was asked for."""


class Unavailable(RequestRefused):
    """Too many requests, or the service could not do it in time: try again later."""
