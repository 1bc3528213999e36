"""Client for a monitor's HTTP API."""

import os
import re
import ssl
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Self

import httpx

from rotorwatch.client.answers import M, refusal, understood
from rotorwatch.client.errors import ClientError, NoAnswer
from rotorwatch.client.event_stream import ServiceEvent, service_events
from rotorwatch.records.alarms import Alarm, AlarmCloudEvent, AlarmState, AlarmStates, EventKind, Severity
from rotorwatch.records.health import Health, Report
from rotorwatch.records.history import (
    AlarmEventList,
    AlarmEvidence,
    AuditList,
    AuditRecord,
    Reading,
    ReadingBucket,
    ReadingList,
    ReportList,
)
from rotorwatch.records.machines import DetectableChanges, MachineConfiguration, MachineDescription, MachineList
from rotorwatch.records.operations import OperationDone, OperationKind
from rotorwatch.records.snapshots import CorrelationSnapshot, OrbitSnapshot, SpectrumSnapshot, Units

TOKEN_VARIABLE = "ROTORWATCH_TOKEN"  # noqa: S105  # the name of a variable
_PAGE = 500

_MACHINES = "/api/v1/machines"
_PLACE = re.compile(r"[A-Za-z0-9_-]+/[A-Za-z0-9_-]+")
_BELOW = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.:-]*(/[A-Za-z0-9_-][A-Za-z0-9_.:-]*)*")

_Parameter = str | int | float | bool | None | Sequence[str]


class Client:
    """A connection to a monitor.

    Machines are named ``<site>/<machine>``. Methods that change an alarm take the `Alarm` as the operator saw it; if it
    has changed since, nothing is done and `Conflict` is raised.

    Parameters
    ----------
    url : str
        Address of the monitor's API.
    token : str, optional
        Access token; by default, the value of the environment variable ``ROTORWATCH_TOKEN``.
    ca : Path, optional
        Certificates (PEM) of the authority that issued the monitor's; by default, those this computer trusts.
    certificate : tuple of Path, optional
        Own certificate and its key (PEM), if the monitor requires one.
    timeout_s : float
        Longest time to wait for an answer, in seconds.

    Raises
    ------
    ClientError
        If the address or the token is malformed, or a certificate cannot be read. Every method raises `NoAnswer` if
        there is no answer in time, and `RequestRefused` or a subclass with the service's message if it refuses.

    Examples
    --------
    >>> with Client("http://127.0.0.1:8080") as plant:
    ...     print(plant.health("demo/lab").state)  # doctest: +SKIP
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8080",
        token: str | None = None,
        *,
        ca: Path | None = None,
        certificate: tuple[Path, Path] | None = None,
        timeout_s: float = 30.0,
    ) -> None:
        text = (os.environ.get(TOKEN_VARIABLE, "") if token is None else token).strip()
        if not text.isascii() or not text.isprintable() or " " in text:
            raise ClientError("the token has invalid characters; expected rw_ and what follows, on one line")
        self._http = httpx.Client(
            base_url=_checked(url),
            headers={"Authorization": f"Bearer {text}"} if text else {},
            verify=_tls(url, ca, certificate),
            timeout=timeout_s,
            trust_env=False,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    # Machines

    def machines(self) -> tuple[MachineDescription, ...]:
        """Every monitored machine with its state."""
        return self._read(MachineList, _MACHINES, {}).machines

    def machine(self, place: str) -> MachineDescription:
        """One machine: stream, channels, keys, state."""
        return self._get(MachineDescription, place)

    def configuration(self, place: str) -> MachineConfiguration:
        """The machine file in use."""
        return self._get(MachineConfiguration, place, "configuration")

    def health(self, place: str) -> Health:
        """The current health of a machine."""
        return self._get(Health, place, "health")

    def detectable(self, place: str, change: float | None = None) -> DetectableChanges:
        """Minimum detectable changes as the machine runs now, and the data needed to find a relative `change`."""
        return self._get(DetectableChanges, place, "detectable", change=change)

    # Alarms

    def alarms(
        self, place: str, *, states: Sequence[AlarmState] = (), names: Sequence[str] = (), everything: bool = False
    ) -> AlarmStates:
        """Alarms that are not normal; or those with given states or names, or all that ever occurred."""
        wanted = [AlarmState(state).value for state in states]
        return self._get(AlarmStates, place, "alarms", state=wanted, name=names, all=everything)

    def alarm(self, place: str, name: str) -> Alarm:
        """The current state of one alarm."""
        return self._get(Alarm, place, f"alarms/{name}")

    def evidence(self, place: str, name: str, occurrence: int | None = None) -> AlarmEvidence:
        """Report, spectra, orbits and correlations before an alarm, with it and after; of its latest occurrence."""
        return self._get(AlarmEvidence, place, f"alarms/{name}/evidence", occurrence=occurrence)

    def acknowledge(self, place: str, seen: Alarm, reason: str = "") -> OperationDone:
        """Acknowledge an alarm: state that it has been seen."""
        return self._operate(place, seen, "acknowledge", reason=reason)

    def reset(self, place: str, seen: Alarm, reason: str = "") -> OperationDone:
        """Reset a latched alarm."""
        return self._operate(place, seen, "reset", reason=reason)

    def shelve(
        self, place: str, seen: Alarm, reason: str, *, duration_s: float | None = None, one_shot: bool = False
    ) -> OperationDone:
        """Silence an alarm for some seconds of data time, or until its condition clears (`one_shot`)."""
        limits = {} if duration_s is None else {"duration_s": duration_s}
        return self._operate(place, seen, "shelve", reason=reason, one_shot=one_shot, **limits)

    def unshelve(self, place: str, seen: Alarm, reason: str = "") -> OperationDone:
        """End the shelving of an alarm."""
        return self._operate(place, seen, "unshelve", reason=reason)

    def remove_from_service(self, place: str, seen: Alarm, reason: str) -> OperationDone:
        """Take an alarm out of service, until it is returned."""
        return self._operate(place, seen, "remove-from-service", reason=reason)

    def return_to_service(self, place: str, seen: Alarm, reason: str = "") -> OperationDone:
        """Return an alarm to service."""
        return self._operate(place, seen, "return-to-service", reason=reason)

    # History

    def alarm_events(
        self,
        place: str,
        *,
        after: int | None = None,
        since_ns: int | None = None,
        until_ns: int | None = None,
        name: str | None = None,
        kind: EventKind | None = None,
        severity: Severity | None = None,
    ) -> Iterator[AlarmCloudEvent]:
        """Alarm events, fetched page by page: newest first, or after a sequence number in the order of the log.

        Parameters
        ----------
        after : int, optional
            Sequence number; -1 for the whole log. The iterator ends with the latest event.
        since_ns, until_ns : int, optional
            Only events with since_ns ≤ time_ns < until_ns.
        name, kind, severity : optional
            Only events of this alarm, kind or severity.
        """
        chosen = {"since_ns": since_ns, "until_ns": until_ns, "name": name, "kind": kind, "severity": severity}
        path = _path(place, "alarms/events")
        cursor = "before" if after is None else "after"
        for page in self._pages(AlarmEventList, path, cursor, after, limit=_PAGE, **chosen):
            yield from page.events
            if after is not None and len(page.events) < _PAGE:
                return

    def reports(self, place: str, *, since_ns: int | None = None, until_ns: int | None = None) -> Iterator[Report]:
        """Window reports, the latest to arrive first, fetched page by page."""
        path = _path(place, "reports")
        for page in self._pages(ReportList, path, "before", None, since_ns=since_ns, until_ns=until_ns, limit=_PAGE):
            yield from page.reports

    def readings(
        self, place: str, quantity: str, name: str = "", *, since_ns: int | None = None, until_ns: int | None = None
    ) -> Iterator[Reading]:
        """Every reading of a parameter, equation, level, misfit or speed, oldest first, fetched page by page."""
        wanted: dict[str, _Parameter] = {"quantity": quantity, "name": name or None}
        path = _path(place, "readings")
        for page in self._pages(ReadingList, path, "after", None, since_ns=since_ns, until_ns=until_ns, **wanted):
            yield from page.readings

    def trend(
        self,
        place: str,
        quantity: str,
        names: Sequence[str] = (),
        *,
        points: int = 300,
        since_ns: int | None = None,
        until_ns: int | None = None,
    ) -> tuple[ReadingBucket, ...]:
        """Readings reduced to at most `points` buckets for each name; all names if none is given."""
        wanted: dict[str, _Parameter] = {"quantity": quantity, "name": names, "points": points}
        return self._get(ReadingList, place, "readings", since_ns=since_ns, until_ns=until_ns, **wanted).buckets

    def audit(self, *, machine: str | None = None, actor: str | None = None) -> Iterator[AuditRecord]:
        """Entries of the audit log (callers, requests and outcomes), newest first, fetched page by page."""
        for page in self._pages(AuditList, "/api/v1/audit", "before", None, machine=machine, actor=actor, limit=_PAGE):
            yield from page.entries

    # Snapshots

    def correlations(
        self,
        place: str,
        pairs: Sequence[tuple[str, str]] = (),
        *,
        units: Units = "channel",
        recordings: Sequence[str] = (),
        replay: str | None = None,
        until_ns: int | None = None,
    ) -> CorrelationSnapshot:
        """Correlation functions of a window, measured and predicted by theory.

        Parameters
        ----------
        recordings : sequence of str
            File names of recordings of the machine, instead of live data.
        replay : str, optional
            Id of a replay of the machine, instead of recordings; theory then uses the readings of the replay.
        until_ns : int, optional
            End of the window in recorded data; by default the last window.
        """
        first, second = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
        wanted: dict[str, _Parameter] = {"recording": recordings, "replay": replay, "until_ns": until_ns}
        return self._get(CorrelationSnapshot, place, "correlations", first=first, second=second, units=units, **wanted)

    def spectra(  # noqa: PLR0913  # options of the request
        self,
        place: str,
        channels: Sequence[str] = (),
        pairs: Sequence[tuple[str, str]] = (),
        *,
        from_hz: float | None = None,
        to_hz: float | None = None,
        units: Units = "channel",
        recordings: Sequence[str] = (),
        replay: str | None = None,
        until_ns: int | None = None,
    ) -> SpectrumSnapshot:
        """Power spectral densities and cross-spectra of a window, chosen as in `correlations`, with theory."""
        first, second = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
        chosen: dict[str, _Parameter] = {"channel": channels, "first": first, "second": second, "units": units}
        wanted: dict[str, _Parameter] = {"recording": recordings, "replay": replay, "until_ns": until_ns}
        return self._get(SpectrumSnapshot, place, "spectra", from_hz=from_hz, to_hz=to_hz, **chosen, **wanted)

    def orbits(
        self,
        place: str,
        *,
        revolutions: int = 0,
        units: Units = "channel",
        recordings: Sequence[str] = (),
        replay: str | None = None,
        until_ns: int | None = None,
    ) -> OrbitSnapshot:
        """1x orbits of a window, chosen as in `correlations`, and `revolutions` unfiltered revolutions."""
        wanted: dict[str, _Parameter] = {"recording": recordings, "replay": replay, "until_ns": until_ns}
        return self._get(OrbitSnapshot, place, "orbits", revolutions=revolutions, units=units, **wanted)

    # Events

    def events(self, *machines: str, after: str = "", from_beginning: bool = False) -> Iterator[ServiceEvent]:
        """Alarm events and changes of health as they happen; continues automatically after a lost connection.

        Every alarm event is delivered once, in the order of its machine's log. A program that stores the cursor of the
        last event and passes it as `after` gets all events without a gap. The latest health is delivered at the start.

        Parameters
        ----------
        *machines : str
            Only events of these machines; all by default.
        after : str
            Cursor of the last event that was taken; empty to begin now.
        from_beginning : bool
            Without `after`, begin with the first event in the log.

        Raises
        ------
        LogReplaced
            If the log is not the one that was followed before.
        """
        parameters: dict[str, str | list[str]] = {"from": "beginning" if from_beginning else "now"}
        if machines:
            parameters["machine"] = list(machines)
        return service_events(self._http, parameters, after)

    def _get(self, model: type[M], place: str, below: str = "", **parameters: _Parameter) -> M:
        return self._read(model, _path(place, below), parameters)

    def _pages(
        self, model: type[M], path: str, cursor: str, begin: int | None, **parameters: _Parameter
    ) -> Iterator[M]:
        """Fetch pages until one has no cursor of a next page."""
        while True:
            page = self._read(model, path, {cursor: begin} | parameters)
            yield page
            begin = getattr(page, f"next_{cursor}")
            if begin is None:
                return

    def _operate(self, place: str, seen: Alarm, kind: OperationKind, **order: str | float | bool) -> OperationDone:
        path = _path(place, f"alarms/{seen.name}/{kind}")
        answer = self._send("POST", path, {}, order, {"If-Match": f'"{seen.version}"'})
        return understood(OperationDone, answer.content, path)

    def _read(self, model: type[M], path: str, parameters: Mapping[str, _Parameter]) -> M:
        return understood(model, self._send("GET", path, parameters, None, {}).content, path)

    def _send(
        self, method: str, path: str, parameters: Mapping[str, _Parameter], body: object, headers: dict[str, str]
    ) -> httpx.Response:
        given = {
            name: list(value) if isinstance(value, Sequence) and not isinstance(value, str) else value
            for name, value in parameters.items()
            if value is not None
        }
        try:
            answer = self._http.request(method, path, params=given, json=body, headers=headers)
        except httpx.TransportError as error:
            # With TLS 1.3 at least, a client without the required certificate gets no error message.
            dropped = isinstance(error, httpx.RemoteProtocolError | httpx.ReadError | httpx.WriteError)
            secure = self._http.base_url.scheme == "https"
            why = "it requires a certificate from an authority it trusts" if secure else "the address begins with https"
            hint = f"; perhaps {why}" if dropped else ""
            raise NoAnswer(f"{self._http.base_url}: {str(error) or type(error).__name__}{hint}") from error
        except ValueError as error:  # NaN and infinity cannot be written as JSON
            raise ClientError(f"{path}: expected finite numbers (found {body})") from error
        if answer.status_code != httpx.codes.OK:
            raise refusal(answer)
        return answer


def _checked(url: str) -> httpx.URL:
    """Parse the address of a service; ClientError if it is not a valid HTTP address."""
    with suppress(httpx.InvalidURL):
        found = httpx.URL(url)
        if found.scheme in {"http", "https"} and found.host and (found.port or 0) < 65_536:
            return found
    meant = f"; did you mean http://{url}?" if url and "://" not in url else ""
    raise ClientError(f"url is {url!r}, expected http://HOST:PORT or https://HOST:PORT{meant}")


def _path(place: str, below: str) -> str:
    """URL path of a machine, or of a resource below it; ClientError for a name that might lead to another path."""
    if not _PLACE.fullmatch(place):
        raise ClientError(f"{place!r}: expected a machine as site/machine, such as demo/lab")
    if below and not _BELOW.fullmatch(below):
        raise ClientError(f"{below!r}: expected a name of letters, digits, - and _, such as k_by or level:DE-H")
    return f"{_MACHINES}/{place}/{below}".rstrip("/")


def _tls(url: str, ca: Path | None, certificate: tuple[Path, Path] | None) -> ssl.SSLContext:
    """TLS context with trusted authorities and own certificate; for plain HTTP without authorities, to save time."""
    plain = ca is None and url.startswith("http:")
    try:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT) if plain else ssl.create_default_context(cafile=ca)
        if certificate is not None:
            context.load_cert_chain(*certificate)
    except OSError as error:  # includes ssl.SSLError for invalid certificates
        files = ", ".join(str(file) for file in (ca, *(certificate or ())) if file is not None)
        raise ClientError(f"certificates {files}: cannot be used: {error.strerror or error}") from error
    return context
