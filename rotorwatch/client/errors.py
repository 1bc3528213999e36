"""Exceptions of the clients.

::

    ClientError
    ├── LogReplaced           the alarm log is not the one that was followed before
    ├── NoAnswer              no answer, or not in time
    └── RequestRefused        the service refused: `status` and the problem's text
        ├── AccessRefused         401, 403: no token, or one without the scope
        ├── NotFound              404: no such machine, alarm, ...
        ├── Conflict              409, 412: the alarm has changed since it was seen, or its state does not allow it
        └── Unavailable           429, 503: try again later
"""


class ClientError(Exception):
    """Base class of all exceptions that the clients raise."""


class LogReplaced(ClientError):  # noqa: N818  # named after the event, like those below
    """The alarm log is not the one that was followed before; the message states the evidence."""


class NoAnswer(ClientError):  # noqa: N818
    """There was no answer, not in time, or an unreadable one; the message names the address."""


class RequestRefused(ClientError):  # noqa: N818
    """The service refused a request with this HTTP status; the message is the detail of its problem."""

    def __init__(self, status: int, detail: str) -> None:
        super().__init__(detail)
        self.status = status


class AccessRefused(RequestRefused):
    """There is no token, it is invalid, or it lacks the scope of the route."""


class NotFound(RequestRefused):
    """There is no such machine, alarm, or page."""


class Conflict(RequestRefused):
    """The alarm has changed since it was seen, or its state does not allow the operation."""


class Unavailable(RequestRefused):
    """There were too many requests, or the service (a proxy: 502, 504) could not answer in time: try again later."""
