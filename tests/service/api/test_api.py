"""The HTTP API of a running service that has seen a fault: real server, real session, real evaluation."""

import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import sleep

import httpx
import pytest

from models.machine import Machine, load_machine
from models.physics.rotor import PARAMETERS
from rotorwatch.records.alarms import AlarmStates
from rotorwatch.records.health import MEASURES, Health
from rotorwatch.records.history import ReadingList, ReportList
from rotorwatch.records.machines import DetectableChanges, MachineConfiguration
from rotorwatch.records.monitor import CallerRights
from rotorwatch.records.plots import (
    CentrelineSeries,
    FullSpectrumSnapshot,
    VectorSeries,
    WaterfallSnapshot,
    WaveformSnapshot,
)
from rotorwatch.records.recordings import RecordingList
from rotorwatch.records.snapshots import OrbitSnapshot, SpectrumSnapshot
from service.access.scopes import Scope
from service.api import samples
from service.api.app import DescribedApp
from service.api.routes.page import page_files
from service.history.records import Step, StoredReading
from service.runtime.runtime import Runtime
from service.stream.worker import MachineWorker
from tests.service.analysis.snapshotting import numbers
from tests.service.rig.live import ROOT, START_NS
from tests.service.rig.monitored import GUARDED, PLACE, answered, client, faulty, fed, problem, token
from tests.service.rig.replaying import S, recording
from tests.service.rig.run_up import BLOCKS, SHAFT_UM
from tests.sure import sure

HOP_NS = 5_000_000_000


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Runtime, MachineWorker]]:
    folder = tmp_path_factory.mktemp("machine")
    recording(folder / "recordings" / "demo" / "lab" / "run-up.mcap", BLOCKS)
    with faulty(folder) as running:
        yield running


@pytest.fixture(scope="module")
def http(seen: tuple[Runtime, MachineWorker]) -> Iterator[httpx.Client]:
    with client(seen[0]) as found:
        yield found


def test_callers_can_query_their_scopes(http: httpx.Client, tmp_path: Path) -> None:
    assert answered(http.get("/api/v1/caller"), CallerRights).scopes == ("read", "operate", "configure")
    with fed(tmp_path, GUARDED) as (runtime, _):
        text = token(runtime, Scope.READ, Scope.OPERATE)
        with client(runtime, text) as sent, client(runtime) as typed:
            rights = answered(sent.get("/api/v1/caller"), CallerRights)
            assert rights == CallerRights(name="anna", scopes=("read", "operate"))
            typed.auth = ("anybody", text)  # a token sent as a password only reads
            assert answered(typed.get("/api/v1/caller"), CallerRights).scopes == ("read",)


def test_the_configuration_is_the_machine_file(http: httpx.Client, seen: tuple[Runtime, MachineWorker]) -> None:
    found = answered(http.get(f"{PLACE}/configuration"), MachineConfiguration)
    assert (file := Machine.model_validate(found.file)) == seen[1].machine
    assert (file.alarms.on_delay_s, file.rotor.k_by_N_per_m) == (10.0, load_machine("lab").rotor.k_by_N_per_m)
    assert found.machine_hash == seen[1].identity["machine_hash"]


def test_health_names_the_fault_with_its_interval_time_and_agreement(http: httpx.Client) -> None:
    health = answered(http.get(f"{PLACE}/health"), Health)
    assert (health.state, health.filled) == ("alert", 1.0)
    report = sure(health.report)
    assert report == next(iter(answered(http.get(f"{PLACE}/reports?limit=1"), ReportList).reports))
    assert report.start_ns == report.end_ns - 12 * HOP_NS
    assert [parameter.name for parameter in report.parameters] == list(PARAMETERS)
    k_by = report.parameters[0]
    assert k_by.text == "bearing stiffness, horizontal"
    assert k_by.interval_95 is not None
    assert k_by.interval_95[0] < -0.33 < k_by.interval_95[1] + 0.02
    verdict = sure(report.verdict)
    (found,) = verdict.changed
    assert (found.name, found.text) == ("k_by", "bearing stiffness, horizontal")
    assert found.since_ns < found.found_ns
    assert (verdict.detected, verdict.outside_model) == (True, False)
    assert verdict.confidence > 0.99
    assert verdict.text.startswith("changed: bearing stiffness, horizontal (k_by) since 00:00:")
    assert report.opinions
    for opinion in report.opinions:
        told = next(one for one in opinion.agreement if one.name == "k_by")
        assert (told.between, told.verdict) == (("likelihood", opinion.by), "agree")
        assert abs(told.difference_z or 9.0) < 4
    assert [alarm.name for alarm in health.alarms if alarm.raised] == ["k_by"]
    assert health.quality.accepted_blocks == 780
    assert health.quality.gaps == health.quality.queue_dropped_blocks == health.quality.link_missed_blocks == 0
    assert health.stream.descriptor_mismatch == ()


def test_measures_of_the_window_are_in_the_history_and_on_the_page(http: httpx.Client) -> None:
    report = sure(answered(http.get(f"{PLACE}/health"), Health).report)
    page = (ROOT / "service/api/page/machine/data-quality.js").read_text(encoding="utf-8")
    for name, (field, measure) in MEASURES.items():
        value = getattr(report, field)
        assert answered(http.get(f"{PLACE}/readings?quantity={name}"), ReadingList).readings[-1].value == value
        assert f"report?.{field}" in page, measure
    assert problem(http.get(f"{PLACE}/readings?quantity=nose"), 422).detail.startswith("quantity: ")


def test_readings_are_reduced_to_the_requested_number_of_points(http: httpx.Client) -> None:
    every = [one.value for one in answered(http.get(f"{PLACE}/readings?name=k_by"), ReadingList).readings]
    (whole,) = answered(http.get(f"{PLACE}/readings?name=k_by&points=1"), ReadingList).buckets
    assert (whole.name, whole.count, whole.minimum, whole.maximum) == ("k_by", 4, min(every), max(every))
    assert whole.mean == pytest.approx(sum(every) / 4)
    told = http.get(f"{PLACE}/readings?name=k_by&name=e&points=3")
    two = answered(told, ReadingList)
    assert told.text == two.model_dump_json()
    assert two.readings == ()
    assert {one.name for one in two.buckets} == {"k_by", "e"}
    assert sum(one.count for one in two.buckets) == 8
    assert all(sum(one.name == name for one in two.buckets) <= 3 for name in ("k_by", "e"))
    assert {one.name for one in answered(http.get(f"{PLACE}/readings?points=2"), ReadingList).buckets} == {*PARAMETERS}


@pytest.mark.parametrize(
    ("query", "text"),
    [
        ("readings", "name: 0 are given, expected one; several go with points"),
        ("readings?name=k_by&name=e", "name: 2 are given, expected one; several go with points"),
        ("readings?points=5&after=3", "after: goes with single readings, not with points"),
        ("spectra?from_hz=50&to_hz=40", "to_hz: 40 is not above from_hz 50"),
        ("spectra?channel=nose", "demo/lab: channel is 'nose', which is not a channel of it; expected one of"),
        ("correlations?first=y1&first=y2&second=y1", "demo/lab: 2 values of first and 1 of second, expected"),
        ("spectra?second=z1", "demo/lab: 0 values of first and 1 of second, expected as many"),
        ("correlations?first=y9", "demo/lab: first is 'y9', which is not a channel of it; expected one of y1, z1"),
        ("spectra?first=y1&second=theta", "demo/lab: second is 'theta', which is the shaft angle; expected one of"),
        ("spectra?from_hz=200", "demo/lab: band is 200 to"),
        ("readings?name=k_bx", "demo/lab: name is 'k_bx', but it has no such parameter; expected one of k_by, c_by"),
        ("readings?quantity=equation&name=32&points=9", "demo/lab: name is '32', but it has no such equation"),
        ("readings?quantity=speed&name=misfit", "demo/lab: name is 'misfit', but it has no such speed; expected"),
        ("readings?quantity=level&name=y9:overall", "demo/lab: name is 'y9:overall', but it has no such level; expec"),
        ("alarms?name=nose", "name: no alarm 'nose'; there are: k_by"),
        ("alarms/events?name=nose", "name: no alarm 'nose'; there are: k_by"),
        ("alarms?name=k_by&name=level:y9", "demo/lab: no alarm level:y9; there are: k_by"),
        ("alarms/events?name=level:y9", "demo/lab: no alarm level:y9; there are: k_by"),
        ("../../../trends?of=demo/lab/level/y9:overall", "demo/lab: of is 'y9:overall', but it has no such level"),
        ("../../../trends?of=k_by", "of: expected site/machine/quantity/name, where the quantity is one of parame"),
        ("reports?limit=1001", "limit: expected at most 1000 (found '1001')"),
        ("reports?limit=0", "limit: expected 1 or more (found '0')"),
        ("readings?name=k_by&points=0", "points: expected 1 or more (found '0')"),
        ("orbits?revolutions=65", "revolutions: expected at most 64 (found '65')"),
        ("spectra?" + 65 * "channel=y1&", "channel: expected at most 64"),
        ("reports?limit=1e3", "limit: expected a whole number (found '1e3')"),
        ("reports?before=9223372036854775808", "before: expected at most "),
        ("alarms?state=angry", "state: expected one of normal, "),
        ("readings?quantity=speeds&name=x", "quantity: expected one of parameter, equation, level, "),
        ("detectable?change=-1", "change: expected above -1 (found '-1')"),
        ("detectable?change=nan", "change: expected a finite number (found 'nan')"),
    ],
)
def test_arguments_that_are_invalid_or_do_not_fit_together_are_explained(
    http: httpx.Client, query: str, text: str
) -> None:
    """For all routes and arguments `test_openapi` generates more."""
    assert problem(http.get(f"{PLACE}/{query}"), 422).detail.startswith(text)


def test_readings_that_only_the_history_has_can_be_queried(seen: tuple[Runtime, MachineWorker]) -> None:
    """As of a channel that the machine file no longer has."""
    history = seen[1].history
    history.commit(Step(readings=(StoredReading(START_NS, "level", "gone:overall", 2.5, None),)))
    with client(seen[0]) as http:
        found = answered(http.get(f"{PLACE}/readings?quantity=level&name=gone:overall"), ReadingList)
        assert [one.value for one in found.readings] == [2.5]


@pytest.mark.parametrize(
    ("query", "names"),
    [
        ("state=unacknowledged", ["k_by"]), ("state=normal&name=e", ["e"]), ("state=shelved", []),
        ("name=k_by&name=e", ["k_by", "e"]), ("raised=true&all=true", ["k_by"]), ("raised=true&name=e", []),
    ],
)  # fmt: skip
def test_alarms_are_filtered(http: httpx.Client, query: str, names: list[str]) -> None:
    assert [one.name for one in answered(http.get(f"{PLACE}/alarms?{query}"), AlarmStates).alarms] == names


def test_detectable_changes_of_each_parameter(http: httpx.Client) -> None:
    plain = answered(http.get(f"{PLACE}/detectable"), DetectableChanges)
    assert [parameter.name for parameter in plain.parameters] == list(PARAMETERS)
    assert {parameter.length_s for parameter in plain.parameters} == {None}
    sizes = {parameter.name: parameter.gain for parameter in plain.parameters}
    assert 0.01 < sizes["k_by"] < 0.1 < sizes["c_by"] + 0.05 < 0.3
    asked = answered(http.get(f"{PLACE}/detectable?change=-0.1"), DetectableChanges)
    assert asked.change == -0.1
    for parameter in asked.parameters:
        assert (sure(parameter.length_s) < 60.0) == (parameter.loss > -0.1)


def test_spectra_and_orbits_are_those_asked_for(http: httpx.Client) -> None:
    spectra = answered(
        http.get(f"{PLACE}/spectra?channel=y1&first=y1&second=y2&from_hz=10&to_hz=40&units=SI"), SpectrumSnapshot
    )
    assert [one.channel for one in spectra.densities] == ["y1"]
    assert [(one.first, one.second) for one in spectra.cross] == [("y1", "y2")]
    assert 10 <= min(spectra.frequencies_hz) < max(spectra.frequencies_hz) <= 40
    assert spectra.densities[0].unit == "m^2/Hz"
    orbits = answered(http.get(f"{PLACE}/orbits?revolutions=3"), OrbitSnapshot)
    assert {one.location for one in orbits.orbits} == {"bearing", "disc"}
    assert (orbits.revolutions, orbits.path_reason) == (3, "")
    assert all(one.path is not None for one in orbits.orbits)
    assert len(orbits.pulses_s) == 4
    # The samples are the newest: the last whole revolution ends less than another one before the end of the stream.
    left_s = START_NS / 1e9 + 78.0 - (sure(orbits.path_start_ns) / 1e9 + orbits.pulses_s[-1])
    assert left_s == pytest.approx(60 / 1320, abs=0.001) or 0 <= left_s < 60 / 1320


def test_the_description_is_built_once_for_concurrent_callers(monkeypatch: pytest.MonkeyPatch) -> None:
    def finish(made: dict[str, object]) -> None:
        sleep(0.05)  # others ask while it is incomplete
        made["times finished"] = int(str(made.get("times finished", 0))) + 1

    monkeypatch.setattr("service.api.app.share_problems", finish)
    app = DescribedApp(title="described")
    with ThreadPoolExecutor(8) as callers:
        seen = list(callers.map(lambda _: dict(app.openapi()), range(8)))
    assert [one.get("times finished") for one in seen] == [1] * 8


def test_page_files_are_cached_by_version_and_contain_no_inline_code(http: httpx.Client) -> None:
    answer = http.get("/")
    assert (answer.headers["content-type"], answer.headers["cache-control"]) == ("text/html; charset=utf-8", "no-cache")
    assert "unsafe" not in answer.headers["content-security-policy"]
    assert "//" not in answer.text
    assert not re.search(r"<script(?! type=\"module\" src=)|<style|style=|\bon\w+=", answer.text)
    paths = re.findall(r'(?:src|href)="(/page/[^"]+)"', answer.text)
    sheets = {name for name in page_files() if name.endswith(".css")} - {"uPlot.min.css"}  # which charts load
    assert {path.split("/", 3)[3] for path in paths} == sheets | {"rotorwatch-page.js"}
    _, _, version, _ = paths[0].split("/")
    for path in (*paths, *(f"/page/{version}/{name}" for name in ("uPlot.iife.js", "plots/orbit-plot.js"))):
        loaded = http.get(path)
        assert loaded.status_code == 200
        assert "immutable" in loaded.headers["cache-control"]
        assert loaded.headers["content-type"].startswith(("text/css", "text/javascript"))
        problem(http.get(path.replace(version, version[::-1])), 404)
    for name in ("index.html", "../routes/page.py", "%2e%2e/routes/page.py"):
        problem(http.get(f"/page/{version}/{name}"), 404)
    problem(http.get("/redoc"), 404)


@pytest.mark.parametrize(
    ("path", "near"),
    [
        (f"{PLACE}/heath", f"{PLACE}/health"), ("/api/v1/machine/demo/lab", PLACE), ("/api/v1/alarms", None),
        ("/machines", "/api/v1/machines"), ("/heathz", "/healthz"), ("/favicon.ico", None), ("/" + 5000 * "x", None),
    ],
)  # fmt: skip
def test_an_unknown_path_gets_404_with_the_closest_match(http: httpx.Client, path: str, near: str | None) -> None:
    found = problem(http.get(path), 404)
    assert path[:64] in found.detail
    assert len(found.detail) < 400
    if near is None:
        assert "did you mean" not in found.detail
    else:
        assert found.detail.endswith(f"did you mean {near}?")


def test_a_change_too_small_to_detect_is_refused(http: httpx.Client) -> None:
    for change in ("0", "1e-300", "-9e-7"):
        found = problem(http.get(f"{PLACE}/detectable?change={change}"), 422)
        assert found.detail.endswith("is not a change that could be found, expected at least 0.000001 up or down")
    tiny = answered(http.get(f"{PLACE}/detectable?change=1e-6"), DetectableChanges)
    assert all(one.length_s is not None and one.length_s > 1e6 for one in tiny.parameters)


def test_a_misspelt_argument_is_refused(http: httpx.Client) -> None:
    found = problem(http.get(f"{PLACE}/reports?sinse_ns=5&limit=3"), 422)
    assert found.detail == ("sinse_ns: no argument of this route, expected one of before, limit, since_ns, until_ns")
    assert problem(http.get("/api/v1/machines?a=1"), 422).detail == "a: no argument of this route, expected none"
    for path in ("/healthz?a=1", "/readyz?a=1", "/?a=1"):
        assert http.get(path).status_code == 200


def test_an_internal_error_gets_500_without_details(
    seen: tuple[Runtime, MachineWorker], http: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("secret of the inside")

    monkeypatch.setattr(seen[1], "health", fail)
    answer = http.get(f"{PLACE}/health")
    assert "secret" not in problem(answer, 500).model_dump_json()
    monkeypatch.undo()
    assert http.get(f"{PLACE}/health").status_code == 200


def test_values_of_plots_come_from_the_requested_source(http: httpx.Client) -> None:
    now = answered(http.get(f"{PLACE}/waveforms"), WaveformSnapshot)
    assert (now.source, now.revolutions) == ("newest samples", 8)
    assert START_NS + 78 * S - sure(now.end_ns) < S // 10
    assert [one.channel for one in now.waveforms] == ["y1", "z1", "y2", "z2"]
    assert answered(http.get(f"{PLACE}/full-spectra"), FullSpectrumSnapshot).averages == 19
    assert answered(http.get(f"{PLACE}/waterfalls?channel=y2"), WaterfallSnapshot).channel == "y2"
    steady = answered(http.get(f"{PLACE}/waterfalls?over=speed"), WaterfallSnapshot)
    assert "need a run-up or coast-down" in steady.reason
    assert not steady.rows

    past = answered(http.get(f"{PLACE}/vectors?channel=y2"), VectorSeries)
    assert (past.source, past.revolutions) == ("history", None)
    assert "1320 rpm" in past.steady
    later = answered(http.get(f"{PLACE}/vectors", params={"since_ns": past.times_ns[-1]}), VectorSeries)
    assert later.times_ns == past.times_ns[-1:]
    never = answered(http.get(f"{PLACE}/centrelines?until_ns=5"), CentrelineSeries)
    assert (never.places, never.reason) == ((), "demo/lab: no reports in this stretch of time")

    run_up = {"recording": "run-up.mcap"}
    found = answered(http.get(f"{PLACE}/vectors", params={"channel": "y1", **run_up}), VectorSeries)
    assert found.source == "recordings"
    assert numbers(found.channels[0].amplitude) == pytest.approx(2 * SHAFT_UM, rel=0.03)
    for name, model in (
        ("waveforms", WaveformSnapshot),
        ("full-spectra", FullSpectrumSnapshot),
        ("waterfalls", WaterfallSnapshot),
        ("centrelines", CentrelineSeries),
    ):
        read = answered(http.get(f"{PLACE}/{name}", params=run_up), model)
        assert read.model_dump()["source"] == "recordings", name
        assert read.model_dump()["reason"] == "", name


def test_impossible_requests_for_plots_are_refused_or_explained(http: httpx.Client) -> None:
    listed = answered(http.get("/api/v1/recordings"), RecordingList).recordings
    (writing,) = (one.id.rsplit("/", 1)[1] for one in listed if not one.complete)
    assert "run-up.mcap.part" not in writing
    problem(http.get(f"{PLACE}/vectors", params={"recording": writing}), 422)
    problem(http.get(f"{PLACE}/vectors?recording=other.mcap"), 404)
    problem(http.get(f"{PLACE}/vectors?recording=..%2Fpump%2Fx.mcap"), 422)
    assert "theta" in problem(http.get(f"{PLACE}/waveforms?channel=theta"), 422).detail
    assert "name a recording" in problem(http.get(f"{PLACE}/vectors?slow_roll_rpm=300"), 422).detail
    explained = answered(http.get(f"{PLACE}/vectors?order=3"), VectorSeries)
    assert "are kept of 1x and 2x" in explained.reason


def test_recordings_are_read_one_at_a_time_and_bounded(http: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    path = f"{PLACE}/waterfalls?recording=run-up.mcap"
    with monkeypatch.context() as patched:
        patched.setattr(samples, "_MOST_BYTES", 1000)
        assert "expected at most" in problem(http.get(path), 422).detail
    monkeypatch.setattr(samples, "_PATIENCE_S", 0.01)
    with samples._ONE_AT_A_TIME:
        assert "for another caller" in problem(http.get(path), 503).detail
    assert answered(http.get(path), WaterfallSnapshot).rows
