"""Link of the processes that share a monitor's machines: a Zenoh session of their own, which nobody else reaches."""

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import zenoh
from pydantic import Field

from models.errors import RotorwatchError
from models.signals.link import LinkSettings
from service.stream.monitored import NoAnswerError
from service.stream.transport import Link

_NEWS, _HEARS = "news", "hears"
_THREADS = 4
_ANSWER_S = 15.0


class KnownSettings(LinkSettings):
    """Settings of a link with a name and a password that are in no file."""

    name: str
    secret: str = Field(repr=False)

    def zenoh_items(self) -> dict[str, str]:
        """As `LinkSettings.zenoh_items`."""
        place = "transport/auth/usrpwd"
        known = {f"{place}/user": json.dumps(self.name), f"{place}/password": json.dumps(self.secret)}
        return super().zenoh_items() | known


class ShardLink:
    """The side of the process that monitors machines, on a link that must outlive it.

    Questions are asked under ``process/site/machine``; `places` are the ``site/machine`` that it monitors. A
    `RotorwatchError` raised by `answer` is sent to the caller, with its kind.
    """

    def __init__(
        self, link: Link, process: str, places: tuple[str, ...], answer: Callable[[str, bytes], bytes]
    ) -> None:
        self._news = link.session.declare_publisher(_NEWS, congestion_control=zenoh.CongestionControl.BLOCK)
        self._answer = answer
        self._pool = ThreadPoolExecutor(_THREADS, "answer")  # a slow answer holds up no other
        self._declared = [
            link.session.declare_queryable(f"{process}/{place}", link.guarded(self._asked)) for place in places
        ]
        ask(link, _HEARS, b"")  # whoever answers knows by then what was declared here

    def tell(self, content: bytes) -> None:
        """Send to the process that serves the machines."""
        self._news.put(content)

    def close(self) -> None:
        """Answer nothing any more."""
        for one in self._declared:
            one.undeclare()  # type: ignore[no-untyped-call]
        self._pool.shutdown()

    def _asked(self, query: zenoh.Query) -> None:
        self._pool.submit(self._reply, query)

    def _reply(self, query: zenoh.Query) -> None:
        with query:
            try:
                place = str(query.key_expr).partition("/")[2]
                content = self._answer(place, b"" if query.payload is None else query.payload.to_bytes())
            except RotorwatchError as error:
                query.reply_err(str(error), encoding=type(error).__name__)
            except Exception as error:  # the caller must not wait for an answer that does not come
                query.reply_err(f"{type(error).__name__}: {error}", encoding=RotorwatchError.__name__)
            else:
                query.reply(query.key_expr, content)


def hear(link: Link, callback: Callable[[bytes], None]) -> Callable[[], object]:
    """Take what every shard sends, on a thread of Zenoh's; returns a function that ends it."""

    def take(sample: zenoh.Sample) -> None:
        callback(sample.payload.to_bytes())

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"")

    undo = ExitStack()
    # Indirect, as messages take long to read and Zenoh's own threads are needed meanwhile.
    heard = zenoh.handlers.Callback(link.guarded(take), indirect=True)
    undo.callback(link.session.declare_subscriber(_NEWS, heard).undeclare)
    undo.callback(link.session.declare_queryable(_HEARS, link.guarded(answer)).undeclare)
    return undo.close


def ask(link: Link, key: str, question: bytes, errors: tuple[type[RotorwatchError], ...] = ()) -> bytes:
    """Ask the process that monitors a machine, under ``process/site/machine``.

    Errors of the kinds in `errors` are raised as such, others as `RotorwatchError`.

    Raises
    ------
    NoAnswerError
        If there is no answer in 15 s.
    """
    for reply in link.session.get(key, payload=question, timeout=_ANSWER_S):
        if reply.ok is not None:
            return reply.ok.payload.to_bytes()
        if reply.err is not None:
            kinds = {kind.__name__: kind for kind in errors}
            text = reply.err.payload.to_string()
            if str(reply.err.encoding) in kinds:
                raise kinds[str(reply.err.encoding)](text)
            if text != "Timeout":
                raise RotorwatchError(text)
    raise NoAnswerError(f"{key.partition('/')[2]}: the process that monitors it does not answer")
