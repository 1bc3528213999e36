"""The client against a running service with tokens: reading, operating, and resuming after a lost connection.

A client generated from the description with a third-party tool works too; the same was tried by hand with
``openapi-typescript``.
"""

import importlib
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import httpx
import pytest
import trustme

from rotorwatch import (
    AccessRefused,
    Client,
    ClientError,
    Conflict,
    LogReplaced,
    NoAnswer,
    NotFound,
    RequestRefused,
    ServiceEvent,
)
from rotorwatch.client import errors
from service.access.scopes import Scope
from service.monitor.conversion import machine_description
from service.runtime.runtime import Runtime, running
from service.settings.access import AccessSettings
from service.settings.service import HttpSettings, ServiceSettings
from service.stream.worker import MachineWorker
from tests.service.access.test_access_tokens import files
from tests.service.rig.live import IN_ORDER, OPEN, ROOT, endpoint, feeding, kept_in, machine_file, settings, until
from tests.service.rig.monitored import GUARDED, client, faulty, fed, token

PLACE = "demo/lab"
PAGE = (ROOT / "docs" / "client.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Runtime, MachineWorker]]:
    with faulty(tmp_path_factory.mktemp("machine"), GUARDED) as found:
        yield found


@pytest.fixture
def plant(seen: tuple[Runtime, MachineWorker]) -> Iterator[Client]:
    with Client(seen[0].http_url, _token(seen[0])) as client:
        yield client


_TOKENS: dict[int, str] = {}


def _token(runtime: Runtime) -> str:
    """One token for all tests of a service: names are taken only once."""
    if id(runtime) not in _TOKENS:
        _TOKENS[id(runtime)] = token(runtime)
    return _TOKENS[id(runtime)]


def test_machine_configuration_and_health_are_read(plant: Client, seen: tuple[Runtime, MachineWorker]) -> None:
    _, worker = seen
    (machine,) = plant.machines()
    assert machine == plant.machine(PLACE)
    assert machine == machine_description(worker.identity, worker.machine, worker.health().state)
    assert plant.configuration(PLACE).machine_hash == worker.identity["machine_hash"]
    assert plant.health(PLACE).report == worker.health().report is not None
    assert plant.detectable(PLACE, -0.05) == worker.detectable(-0.05)


def test_alarms_and_their_log_are_read(plant: Client, seen: tuple[Runtime, MachineWorker]) -> None:
    _, worker = seen
    assert plant.alarms(PLACE) == worker.alarms()
    everything = plant.alarms(PLACE, everything=True)
    assert everything == worker.alarms(include_normal=True)
    raised = plant.alarm(PLACE, "k_by")
    assert raised in everything.alarms
    evidence = plant.evidence(PLACE, "k_by")
    assert (evidence.name, evidence.occurrence) == ("k_by", raised.occurrence)
    assert plant.evidence(PLACE, "k_by", 1) == evidence
    with pytest.raises(NotFound):
        plant.evidence(PLACE, "k_by", 99)
    assert plant.alarms(PLACE, states=[raised.state], names=["k_by", "e"]).alarms == (raised,)
    assert plant.alarm(PLACE, "level:y1_dot").name == "level:y1_dot"
    assert plant.alarms(PLACE, names=["e"]).alarms == tuple(one for one in everything.alarms if one.name == "e")
    forwards = list(plant.alarm_events(PLACE, after=-1))
    assert [event.data.sequence for event in forwards] == list(range(everything.sequence + 1))
    assert (list(plant.alarm_events(PLACE)), list(plant.alarm_events(PLACE, after=0))) == (forwards[::-1], forwards[1:])
    assert list(plant.alarm_events(PLACE, name="c_by")) == [e for e in forwards[::-1] if e.data.name == "c_by"]


def test_pages_are_joined(plant: Client, seen: tuple[Runtime, MachineWorker], monkeypatch: pytest.MonkeyPatch) -> None:
    reports, forwards = list(plant.reports(PLACE)), list(plant.alarm_events(PLACE, after=-1))
    assert len(reports) == seen[1].tally.windows > 10
    readings = list(plant.readings(PLACE, "parameter", "k_by"))
    monkeypatch.setattr("rotorwatch.client.client._PAGE", 3)
    assert list(plant.reports(PLACE)) == reports
    assert list(plant.readings(PLACE, "parameter", "k_by")) == readings
    assert list(plant.readings(PLACE, "parameter", "k_by", since_ns=readings[2].end_ns)) == readings[2:]
    end_ns = [report.end_ns for report in reports]
    assert [r.end_ns for r in plant.reports(PLACE, since_ns=end_ns[8], until_ns=end_ns[1])] == end_ns[2:9]
    monkeypatch.setattr("rotorwatch.client.client._PAGE", 1)
    assert (list(plant.alarm_events(PLACE, after=-1)), list(plant.alarm_events(PLACE))) == (forwards, forwards[::-1])
    entries = list(plant.audit())
    assert [entry.number for entry in entries] == sorted((entry.number for entry in entries), reverse=True)


def test_readings_trends_and_snapshots_are_read(plant: Client) -> None:
    readings = list(plant.readings(PLACE, "parameter", "k_by"))
    shown = [one.parameters[0] for one in plant.reports(PLACE) if one.parameters][::-1]
    assert [one.value for one in readings] == [one.relative_change for one in shown]
    assert [one.standard_error for one in readings] == [one.standard_error for one in shown]
    (bucket,) = plant.trend(PLACE, "parameter", ["k_by"], points=1)
    assert (bucket.count, bucket.minimum) == (len(readings), min(reading.value for reading in readings))
    assert {one.name for one in plant.trend(PLACE, "parameter", points=2)} >= {"k_by", "e", "EI"}
    assert len(list(plant.readings(PLACE, "speed"))) == len(readings)
    found = plant.correlations(PLACE, [("y1", "y2")])
    (pair,) = found.pairs
    assert (pair.first, pair.second) == ("y1", "y2")
    # A third of a bearing's stiffness is missing: only theory with the parameters read in the latest window fits.
    assert (pair.estimated_z or 9.0) < 3 < (pair.nominal_z or 0.0)
    assert found.end_ns == next(plant.reports(PLACE)).end_ns
    spectra = plant.spectra(PLACE, ["y1", "y2"], from_hz=10.0, to_hz=50.0)
    assert [density.channel for density in spectra.densities] == ["y1", "y2"]
    orbits = plant.orbits(PLACE, revolutions=2)
    assert len(orbits.orbits) == 2


@pytest.mark.parametrize(
    ("ask", "kind", "told"),
    [
        (lambda plant: plant.health("demo/pump"), NotFound, "no machine demo/pump; there are: demo/lab"),
        (lambda plant: plant.alarm(PLACE, "level:a.b"), NotFound, "no alarm level:a.b; there are: k_by"),
        (lambda plant: plant.alarm(PLACE, "k_bx"), NotFound, "no alarm k_bx; there are: k_by"),
        (lambda plant: plant.detectable(PLACE, -2.0), RequestRefused, "change: expected above -1 (found '-2.0')"),
        (lambda plant: plant.health("demo/../../audit"), ClientError, "expected a machine as site/machine"),
        (lambda plant: plant.alarm(PLACE, "../health"), ClientError, "expected a name of letters"),
        (lambda plant: plant.health("lab"), ClientError, "expected a machine as site/machine"),
        (lambda plant: next(plant.events("demo/pump")), NotFound, "no machine demo/pump; there are: demo/lab"),
        (lambda plant: next(plant.events(after="x")), RequestRefused, "is not site/machine=sequence"),
        (lambda plant: next(plant.events(after="demo/lab=900")), LogReplaced, "the log of demo/lab ends at"),
    ],
)
def test_refusals_raise_with_the_services_message(plant: Client, ask: Any, kind: type[Exception], told: str) -> None:
    with pytest.raises(ClientError) as caught:
        ask(plant)
    assert type(caught.value) is kind
    assert told in str(caught.value)


def test_invalid_tokens_are_refused(seen: tuple[Runtime, MachineWorker], monkeypatch: pytest.MonkeyPatch) -> None:
    runtime, _ = seen
    monkeypatch.delenv("ROTORWATCH_TOKEN", raising=False)
    with Client(runtime.http_url) as stranger:
        with pytest.raises(AccessRefused) as caught:
            stranger.machines()
        assert caught.value.status == 401
        with pytest.raises(AccessRefused, match="an access token is needed"):
            next(stranger.events())
    with Client(runtime.http_url, "rw_000000000000_" + 43 * "0") as mistaken:
        with pytest.raises(AccessRefused, match="not valid") as caught:
            mistaken.machines()
        assert caught.value.status == 401
    monkeypatch.setenv("ROTORWATCH_TOKEN", _token(runtime) + "\n")
    with Client(runtime.http_url) as known:
        assert len(known.machines()) == 1
        alarm = known.alarm(PLACE, "k_by")
    with pytest.raises(ClientError, match="on one line") as refused:
        Client(runtime.http_url, "rw_1\nrw_2")
    assert "rw_1" not in str(refused.value)
    with Client(runtime.http_url, token(runtime, Scope.READ, name="screen")) as screen:
        with pytest.raises(AccessRefused) as caught:
            screen.acknowledge(PLACE, alarm)
        assert caught.value.status == 403
        assert "screen has read" in str(caught.value)


def test_an_unreachable_service_or_invalid_url_is_named() -> None:
    for url in ("127.0.0.1:8080", "", "ftp://plant", "http://", "http://[::1", "http://plant:99999"):
        with pytest.raises(ClientError, match=re.escape(f"url is {url!r}, expected http://HOST:PORT")):
            Client(url)
    url = endpoint().replace("tcp/", "http://")
    with Client(url, "rw_x") as plant:
        with pytest.raises(NoAnswer, match=url):
            plant.machines()
        with pytest.raises(NoAnswer, match=url):
            next(plant.events())


def test_events_wait_for_a_service_that_restarts_behind_a_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = [httpx.Response(status) for status in (502, 503, 504)] + [httpx.Response(401)]
    monkeypatch.setattr("rotorwatch.client.event_stream._FIRST_PAUSE_S", 0.0)
    with Client("http://plant", "rw_x") as plant:
        plant._http = httpx.Client(base_url="http://plant", transport=httpx.MockTransport(lambda _: answers.pop(0)))
        with pytest.raises(AccessRefused):
            next(plant.events())
    assert not answers


def test_an_address_that_answers_with_pages_is_named() -> None:
    with Client("http://plant", "rw_x") as plant:
        page = httpx.MockTransport(lambda _: httpx.Response(200, text="<html>Sign in</html>"))
        plant._http = httpx.Client(base_url="http://plant", transport=page)
        with pytest.raises(ClientError, match="not JSON; is this the address of a monitor"):
            plant.machines()


@contextmanager
def gapped(plan: ServiceSettings, *, feed_it: bool = True) -> Iterator[Runtime]:
    """A service with a gap in its stream, which raises an alarm at once."""
    with feeding(plan) as (runtime, feed):
        if feed_it:
            feed.gap()
            until(lambda: runtime.machines()[0].alarms().sequence >= 0, "alarm")
        yield runtime


def plan(folder: Path, **changes: object) -> ServiceSettings:
    latching = ("[alarms]", '[alarms]\nlatching = ["data-gap"]')
    return settings(endpoint(), machine_file(folder, IN_ORDER, latching), when_full="wait").model_copy(update=changes)


def test_operations_on_alarms_and_conflicts(tmp_path: Path) -> None:
    with gapped(plan(tmp_path)) as runtime, Client(runtime.http_url, "") as plant:
        first = plant.alarm(PLACE, "data-gap")
        done = plant.acknowledge(PLACE, first, "cable was moved")
        assert (done.alarm.state, done.events[0].data.reason) == ("acknowledged", "cable was moved")
        with pytest.raises(Conflict, match="no longer as it was seen"):
            plant.shelve(PLACE, first, "by somebody who saw it earlier")
        with pytest.raises(ClientError, match="expected finite numbers"):
            plant.shelve(PLACE, first, "is being repaired", duration_s=float("nan"))
        done = plant.shelve(PLACE, done.alarm, "is being repaired", duration_s=60.0, one_shot=True)
        assert done.alarm.shelf is not None
        assert (done.alarm.shelf.one_shot, done.alarm.shelf.reason) == (True, "is being repaired")
        done = plant.unshelve(PLACE, done.alarm)
        with pytest.raises(Conflict, match="data-gap"):  # not latched: the condition persists
            plant.reset(PLACE, done.alarm, "too early")
        done = plant.remove_from_service(PLACE, done.alarm, "for good")
        done = plant.return_to_service(PLACE, done.alarm, "after all")
        kinds = [event.data.kind for event in plant.alarm_events(PLACE, after=first.version)]
        assert kinds == ["acknowledged", "shelved", "unshelved", "removed-from-service", "returned-to-service"]


def test_events_continue_after_a_restart(tmp_path: Path) -> None:
    """The service restarts on the same port with its history: each event arrives once, in order."""
    port = int(endpoint().rsplit(":", 1)[1])
    kept = plan(tmp_path, history=kept_in(tmp_path), http=HttpSettings(port=port), access=OPEN)
    heard: list[ServiceEvent] = []
    errors: list[Exception] = []

    def listen(plant: Client) -> None:
        try:
            for event in plant.events(PLACE, from_beginning=True):
                if event.alarm is not None:
                    heard.append(event)
        except ClientError as error:
            errors.append(error)

    def work(plant: Client) -> None:
        alarm = plant.alarm(PLACE, "data-gap")
        for _ in range(3):
            alarm = plant.remove_from_service(PLACE, alarm, "away").alarm
            alarm = plant.return_to_service(PLACE, alarm, "back").alarm

    with Client(f"http://127.0.0.1:{port}", "") as plant, Client(f"http://127.0.0.1:{port}", "") as other:
        listener = threading.Thread(target=listen, args=(plant,), daemon=True)
        with gapped(kept):
            listener.start()
            until(lambda: len(heard) >= 1, "the first event")
            work(other)
        with gapped(kept, feed_it=False) as runtime:
            work(other)
            latest = runtime.machines()[0].alarms().sequence
            until(lambda: errors != [] or heard[-1].cursor == f"{PLACE}={latest}", "all events")
            # Another listener, from the cursor of one of the events.
            later = plant_events_after(other, heard[4].cursor, latest - 4)
        with gapped(plan(tmp_path, http=HttpSettings(port=port), access=OPEN), feed_it=False):
            listener.join(180.0)  # a history without these events
    assert [event.alarm.data.sequence for event in heard if event.alarm] == list(range(latest + 1))
    assert later == heard[5:]
    assert [type(error) for error in errors] == [LogReplaced]


def plant_events_after(plant: Client, cursor: str, count: int) -> list[ServiceEvent]:
    stream = (event for event in plant.events(PLACE, after=cursor) if event.alarm is not None)
    return [next(stream) for _ in range(count)]


def test_https_with_a_private_authority(tmp_path: Path) -> None:
    with running(plan(tmp_path, access=AccessSettings(tls=files(tmp_path, trustme.CA())))) as runtime:
        text = token(runtime)
        with Client(runtime.http_url, text, ca=tmp_path / "ca.pem") as plant:
            assert plant.health(PLACE).state == "warming"
        with Client(runtime.http_url, text) as plant, pytest.raises(NoAnswer, match="certificate"):
            plant.health(PLACE)
    with pytest.raises(ClientError, match=r"nowhere\.pem"):
        Client("https://127.0.0.1", ca=tmp_path / "nowhere.pem")


def test_examples_in_the_page_run(
    seen: tuple[Runtime, MachineWorker], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Any
) -> None:
    """In the order of the page, Python and shell mixed, as a reader would run them."""
    runtime, worker = seen
    assert shutil.which("curl")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROTORWATCH_TOKEN", _token(runtime))
    known: dict[str, Any] = {}
    link = runtime.settings.link.listen[0]
    for language, text in re.findall(r"```(python|sh)\n(.*?)```", PAGE, flags=re.DOTALL):
        here = text.replace("http://127.0.0.1:8080", runtime.http_url).replace("tcp/127.0.0.1:7447", link)
        if language == "python":
            exec(compile(here, "docs/client.md", "exec"), known)  # noqa: S102  # our own page
            continue
        done = subprocess.run(["bash", "-c", here], env={**os.environ}, capture_output=True, text=True, check=False)
        streams = "--max-time" in here
        assert done.returncode == (28 if streams else 0), done.stderr
        assert ("event: alarm" in done.stdout) if streams else done.stdout.startswith("{")
    printed = capsys.readouterr().out
    assert "demo lab alert" in printed
    assert "shelved" in printed
    assert known["cursor"] == f"{PLACE}=0"
    (line,) = (tmp_path / "alarms.jsonl").read_text().splitlines()
    assert worker.history.events(limit=1)[0].text == line
    known["plant"].close()


def test_the_page_names_every_method_and_error() -> None:
    methods = [name for name in vars(Client) if not name.startswith("_")]
    for name in methods:
        assert name == "close" or f"`{name}(" in PAGE or f"`{name}`" in PAGE, f"docs/client.md does not mention {name}"
    for name in (name for name, found in vars(errors).items() if isinstance(found, type)):
        assert f"| `{name}` |" in PAGE


PACKAGE = "generated_rotorwatch"


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runtime]:
    with fed(tmp_path_factory.mktemp("machine"), GUARDED) as (running, _):
        yield running


@pytest.fixture(scope="module")
def generated(runtime: Runtime, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModuleType]:
    """The generated package; a warning of the generator fails the test."""
    folder = tmp_path_factory.mktemp("generated")
    with client(runtime, token(runtime, Scope.READ, name="generator")) as http:
        (folder / "openapi.json").write_bytes(http.get("/openapi.json").raise_for_status().content)
    (folder / "config.json").write_text(json.dumps({"post_hooks": []}), encoding="utf-8")  # no formatting
    options = ["--path", "openapi.json", "--config", "config.json", "--output-path", PACKAGE, "--meta", "none"]
    done = subprocess.run(
        [sys.executable, "-m", "openapi_python_client", "generate", *options, "--fail-on-warning"], cwd=folder,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARNING" not in done.stdout + done.stderr
    sys.path.insert(0, str(folder))
    try:
        yield importlib.import_module(PACKAGE)
    finally:
        sys.path.remove(str(folder))
        for name in [one for one in sys.modules if one.startswith(PACKAGE)]:
            del sys.modules[name]


def test_a_generated_client_reads_operates_and_parses_refusals(generated: ModuleType, runtime: Runtime) -> None:
    def operation(name: str) -> ModuleType:
        return importlib.import_module(f"{PACKAGE}.api.{name}")

    models = importlib.import_module(f"{PACKAGE}.models")
    own = {"base_url": runtime.http_url, "httpx_args": {"trust_env": False}}
    with generated.AuthenticatedClient(token=token(runtime, name="integrator"), **own) as plant:
        (found,) = operation("machines.machines").sync(client=plant).machines
        assert (found.site, found.machine) == ("demo", "lab")
        health = operation("machines.health").sync("demo", "lab", client=plant)
        assert isinstance(health, models.Health)
        assert health.state == models.HealthState.WARMING
        ready = operation("service.readyz").sync(client=plant)
        assert isinstance(ready, models.Readiness)
        assert ready.ready

        order = models.ShelveOrder(reason="sensor is replaced", expected_state=models.AlarmState.NORMAL)
        done = operation("alarms.shelve").sync("demo", "lab", "k_by", client=plant, body=order)
        assert isinstance(done, models.OperationDone)
        assert done.alarm.state == models.AlarmState.SHELVED
        again = operation("alarms.shelve").sync_detailed("demo", "lab", "k_by", client=plant, body=order)
        assert (again.status_code, again.parsed.status) == (409, 409)

        unknown = operation("machines.health").sync("demo", "pump", client=plant)
        assert isinstance(unknown, models.Problem)
        assert (unknown.status, unknown.title) == (404, "Not Found")
        assert "demo/lab" in unknown.detail
    with generated.AuthenticatedClient(token="rw_000000000000_" + 43 * "0", **own) as stranger:
        refused = operation("machines.machines").sync(client=stranger)
        assert isinstance(refused, models.Problem)
        assert refused.status == 401
