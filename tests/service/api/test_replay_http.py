"""Recordings and replays over HTTP: a real service, real processes."""

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import httpx
import pytest
from fastapi import HTTPException
from pydantic import BaseModel

import models.machine
from models.signals.keys import Grant
from rotorwatch.records.recordings import RecordingDetail, RecordingList
from rotorwatch.records.replays import ReplayAlarmList, ReplayJob, ReplayList, ReplayReportList, ReplayRequest
from service.api.routes.replays import ReplayRequests
from service.recordings.catalogue import Catalogue
from service.runtime.runtime import Runtime, running
from service.settings.service import HttpSettings, RecordingSettings, ReplaySettings, ServiceSettings
from simulator.scenario import parse_fault
from tests.service.commands.test_demo import children_of
from tests.service.rig import monitored
from tests.service.rig.live import START_NS, endpoint, scenario_blocks, settings, until
from tests.service.rig.monitored import problem
from tests.service.rig.replaying import hurried, recording
from tests.sure import sure

M = TypeVar("M", bound=BaseModel)
ID = "demo/lab/20260101T000000Z.mcap"
RECORDINGS, REPLAYS = "/api/v1/recordings", "/api/v1/replays"
QUICK = "demo/lab/20270101T000000Z.mcap"
DAY_NS = 86_400 * 10**9
ENDED = ("finished", "stopped", "failed")
OUTSIDE = ("../../secret.mcap", "demo/lab/../../secret.mcap", "/etc/passwd", "demo/lab/link.mcap", "--offline", "")
"""Names of no recording, for no replay may read outside the directory."""


def machine_text(name: str) -> str:
    return (Path(models.machine.__file__).parent / "machines" / f"{name}.toml").read_text(encoding="utf-8")


def plan(directory: Path | None, **replay: object) -> ServiceSettings:
    # The service records there too; the recordings of January must stay.
    recording = RecordingSettings(directory=None if directory is None else str(directory), keep_days=36_500.0)
    return settings(endpoint(), bundle="lab", recording=recording, replay=ReplaySettings.model_validate(replay))


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    recording(folder / ID, scenario_blocks(70.0, parse_fault("c_bz=0.5@0")))
    recording(folder / "demo/lab/20260101T010000Z.mcap", scenario_blocks(3.0, start_ns=START_NS + 3600 * 10**9))
    hurried(folder / "demo/lab/20260101T010000Z.mcap", folder / QUICK)
    (folder / "demo/pump").mkdir()
    (folder / "demo/pump/20260101T020000Z.mcap.part").write_bytes(b"being written")
    (folder / "secret.mcap").write_text("secret", encoding="utf-8")
    (folder / "demo/lab/link.mcap").symlink_to(folder / "secret.mcap")
    return folder


@pytest.fixture(scope="module")
def runtime(directory: Path) -> Iterator[Runtime]:
    with running(plan(directory)) as started:
        yield started


@pytest.fixture
def client(runtime: Runtime, replays_at_once: None) -> Iterator[httpx.Client]:
    with monitored.client(runtime) as opened:
        yield opened


def get(client: httpx.Client, path: str, model: type[M], **arguments: Any) -> M:
    return model.model_validate_json(client.get(path, params=arguments).raise_for_status().content)


def start(client: httpx.Client, headers: dict[str, str] | None = None, **request: Any) -> ReplayJob:
    answer = client.post(REPLAYS, json={"recordings": [ID], **request}, headers=headers)
    assert answer.status_code == 201, answer.text
    return ReplayJob.model_validate_json(answer.content)


def ended(client: httpx.Client, job: ReplayJob) -> ReplayJob:
    until(lambda: get(client, f"{REPLAYS}/{job.id}", ReplayJob).state in ENDED, "end of the replay")
    return get(client, f"{REPLAYS}/{job.id}", ReplayJob)


def test_recordings_are_listed_and_filtered(client: httpx.Client) -> None:
    first, second, part = get(client, RECORDINGS, RecordingList, until_ns=START_NS + DAY_NS).recordings
    assert first.id == ID
    assert (first.site, first.machine, first.messages, first.complete) == ("demo", "lab", 701, True)
    assert (first.start_ns, first.end_ns) == (START_NS, START_NS + 70 * 10**9)
    assert not part.complete
    by_time = get(client, RECORDINGS, RecordingList, since_ns=second.start_ns, until_ns=second.end_ns)
    assert by_time.recordings == (second,)
    one_of_two = get(client, RECORDINGS, RecordingList, machine="demo/pump").recordings
    assert one_of_two == get(client, RECORDINGS, RecordingList, site="demo", machine="pump").recordings == (part,)
    assert get(client, RECORDINGS, RecordingList, site="demo", machine="lab", until_ns=1).recordings == ()
    for unknown in ({"site": "demo", "machine": "fan"}, {"machine": "plant/lab"}):
        assert "demo/lab" in problem(client.get(RECORDINGS, params=unknown), 404).detail
    assert first.data_start_ns is None
    timed = get(client, RECORDINGS, RecordingList, until_ns=START_NS + DAY_NS, latest=1, data_times=True).recordings
    assert [(one.id, one.data_end_ns) for one in timed] == [(second.id, START_NS + 3603 * 10**9), (part.id, None)]
    detail = get(client, f"{RECORDINGS}/{ID}", RecordingDetail)
    assert detail.keys == {"rotorwatch/demo/lab/descriptor": 1, "rotorwatch/demo/lab/stream": 700}
    quick = get(client, f"{RECORDINGS}/{QUICK}", RecordingDetail)  # recorded in 0.15 s, on another day
    assert (quick.data_start_ns, quick.data_end_ns) == (START_NS + 3600 * 10**9, START_NS + 3603 * 10**9)
    assert quick.start_ns > START_NS + DAY_NS
    third = ended(client, start(client, recordings=[QUICK], from_ns=sure(quick.data_end_ns) - 10**9))
    assert (sure(third.summary).blocks, sure(third.progress).fraction) == (10, 1.0)


def test_a_recording_is_downloaded_whole_or_in_part(client: httpx.Client, directory: Path) -> None:
    whole = (directory / ID).read_bytes()
    answer = client.get(f"{RECORDINGS}/{ID}/download").raise_for_status()
    assert answer.content == whole
    # Paths that lead out of the directory are not recordings, however they are spelt.
    for place in ("demo/lab/link.mcap", "demo/lab/%2e%2e/%2e%2e/secret.mcap", "demo/lab/..%2f..%2fsecret.mcap"):
        problem(client.get(f"{RECORDINGS}/{place}/download"), 404)
    assert 'filename="20260101T000000Z.mcap"' in answer.headers["content-disposition"]
    for wish, status in (("bytes=999999999-", 416), ("bytes", 400), ("bytes=9-1", 400)):
        problem(client.get(f"{RECORDINGS}/{ID}/download", headers={"Range": wish}), status)
    part = client.get(f"{RECORDINGS}/{ID}/download", headers={"Range": "bytes=100-299"})
    assert (part.status_code, part.content) == (206, whole[100:300])
    found = problem(client.get(f"{RECORDINGS}/demo/pump/20260101T020000Z.mcap.part/download"), 409)
    assert "incomplete" in found.detail


def test_an_offline_replay_over_http_serves_reports_alarms_and_events(
    client: httpx.Client, runtime: Runtime, directory: Path
) -> None:
    job = start(client)
    assert (job.state, job.mode, job.machine, job.prefix) == ("running", "offline", "lab@lab", "")
    events: list[tuple[str, ReplayJob]] = []
    with client.stream("GET", f"{REPLAYS}/{job.id}/events") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        kind = ""
        for line in stream.iter_lines():
            if line.startswith("event: "):
                kind = line.removeprefix("event: ")
            elif line.startswith("data: "):
                events.append((kind, ReplayJob.model_validate_json(line.removeprefix("data: "))))
    assert [kind for kind, _ in events] == ["progress"] * (len(events) - 1) + ["end"]
    done = events[-1][1]
    assert (done.state, done.error) == ("finished", "")
    assert get(client, f"{REPLAYS}/{job.id}", ReplayJob) == done
    assert done in get(client, REPLAYS, ReplayList).replays
    summary = sure(done.summary)
    assert sure(done.progress).fraction == 1.0
    assert (summary.alarms, summary.raised, summary.blocks) == (1, ("c_bz",), 700)
    results = (directory / ".replays" / job.id / "results.jsonl").read_bytes()
    assert hashlib.sha256(results).hexdigest() == summary.sha256

    reports = get(client, f"{REPLAYS}/{job.id}/reports", ReplayReportList)
    assert (len(reports.reports), reports.next_offset) == (summary.windows, None)
    some = get(client, f"{REPLAYS}/{job.id}/reports", ReplayReportList, offset=2, limit=5)
    assert (some.reports, some.next_offset) == (reports.reports[2:7], 7)
    thin = get(client, f"{REPLAYS}/{job.id}/reports", ReplayReportList, offset=1, limit=2, every=4)
    assert (thin.reports, thin.next_offset) == (reports.reports[1:6:4], 9)
    (event,) = get(client, f"{REPLAYS}/{job.id}/alarms", ReplayAlarmList).events
    assert event.data.name == "c_bz"

    worker = runtime.machines()[0]
    assert (worker.history.reports(limit=10), worker.history.events(limit=10), worker.health().alarms) == ((), (), ())


def test_a_paced_replay_is_paused_moved_and_stopped(client: httpx.Client, runtime: Runtime) -> None:
    job = start(client, mode="paced", pace=5.0)
    place = f"{REPLAYS}/{job.id}"
    assert (job.prefix, job.machine) == (f"replay/{job.id}", None)

    def position_s() -> float:
        progress = get(client, place, ReplayJob).progress
        return -1.0 if progress is None else (progress.position_ns - START_NS) / 1e9

    until(lambda: position_s() > 0, "first block")
    limit = problem(client.post(REPLAYS, json={"recordings": [ID]}), 429)
    assert job.id in limit.detail
    assert ReplayJob.model_validate_json(client.post(f"{place}/pause", json={}).content).state == "paused"
    client.post(f"{place}/seek", json={"to_ns": START_NS + 50 * 10**9}).raise_for_status()
    until(lambda: position_s() == 50, "the place, told though paused")
    client.post(f"{place}/seek", json={"by_s": 10.0}).raise_for_status()
    until(lambda: position_s() == 60, "ten seconds later")
    assert get(client, place, ReplayJob).state == "paused"
    assert ReplayJob.model_validate_json(client.post(f"{place}/resume", json={}).content).state == "running"
    until(lambda: position_s() > 60, "the place")
    problem(client.get(f"{place}/reports"), 404)
    for wrong in ({}, {"to_ns": 1, "by_s": 1.0}, {"to_ns": -1}):
        problem(client.post(f"{place}/seek", json=wrong), 422)
    assert ReplayJob.model_validate_json(client.delete(place).content).state == "stopped"
    problem(client.post(f"{place}/pause", json={}), 409)
    assert runtime.machines()[0].health().quality.accepted_blocks == 0


def test_the_page_can_replay_a_section_with_a_shipped_machine_file(client: httpx.Client, runtime: Runtime) -> None:
    own = {"Origin": runtime.http_url, "Sec-Fetch-Site": "same-origin"}
    done = ended(client, start(client, own, machine="lab", from_ns=START_NS + 10**9, to_ns=START_NS + 31 * 10**9))
    assert (done.state, done.machine) == ("finished", "lab")
    assert done.summary is not None
    assert done.summary.bundle is None
    assert (done.summary.blocks, sure(done.progress).fraction) == (300, 1.0)
    failed = ended(client, start(client, from_ns=START_NS + DAY_NS))
    assert failed.state == "failed"
    assert "nothing was recorded in between" in failed.error
    assert failed.summary is None


def test_a_replay_with_an_uploaded_machine_file_and_other_limits(client: httpx.Client) -> None:
    text = machine_text("lab") + "\n[alarms.parameters.k_by]\nraise_above = 0.7\ndanger_above = 0.9\n"
    calm = "alarms.parameters.c_bz = {raise_above = 0.8, danger_above = 0.9}"
    job = start(client, machine_file=text, machine_file_name="calm.toml", changes=[calm])
    assert (job.machine, job.machine_file_sent, job.changes) == ("calm.toml", True, (calm,))
    found = ended(client, job)
    assert (found.state, found.error) == ("finished", "")
    assert found.summary is not None
    assert (found.summary.raised, found.summary.bundle) == ((), None)
    assert (found.summary.limits["k_by"].raise_above, found.summary.limits["c_bz"].raise_above) == (0.7, 0.8)
    assert (found.summary.site, found.summary.machine) == ("demo", "lab")
    with_networks = start(client, machine_file=text, bundle="heavy")
    assert with_networks.machine == "sent.toml@heavy"
    failed = ended(client, with_networks)  # networks of another machine
    assert failed.state == "failed"
    assert "trained for another machine" in failed.error


@pytest.mark.parametrize(
    ("changes", "status", "detail"),
    [
        ({"machine_file": machine_text("heavy")}, 422, "machine_file: of demo/heavy, the recordings are of demo/lab"),
        ({"machine_file": machine_text("lab") + "\n[paths]\n"}, 422, "machine_file: paths: unknown"),
        ({"machine_file": machine_text("lab").replace("rate_hz", "rate hz", 1)}, 422, "machine_file: line "),
        ({"machine_file": "x = " + "[\n" * 40_000}, 422, "machine_file: lists or tables are nested too deeply"),
        ({"machine_file": "." * 100_001}, 422, "machine_file: "),
        ({"machine_file": f"{'a.' * 40_000}a = 1"}, 422, "machine_file: line 1 has 80005 characters, at most 500 are"),
        ({"machine_file": f"x = [\n{'9' * 400}\n]"}, 422, "machine_file: x: unknown"),
        ({"machine_file": "\n".join(f"k{n} = 1" for n in range(6000))}, 422, "more mistakes"),
        ({"machine_file": "", "machine": "lab"}, 422, "machine_file: is given beside machine"),
        ({"machine_file": "", "mode": "paced"}, 422, "machine_file: nothing is evaluated"),
        ({"machine_file": machine_text("lab"), "machine_file_name": "../lab.toml"}, 422, "machine_file_name: "),
        ({"machine_file": machine_text("lab"), "bundle": "/etc"}, 422, "is not the name of shipped networks"),
        ({"machine_file": machine_text("lab"), "changes": ["alarms.on_delay_s = -1"]}, 422, "alarms.on_delay_s"),
        *(({"recordings": [name]}, 404, "recording") for name in OUTSIDE),
        ({"recordings": []}, 422, "recordings: "),
        ({"from_ns": 5, "to_ns": 5}, 422, "to_ns: 5 is not later than from_ns, 5"),
        ({"recordings": ["demo/pump/20260101T020000Z.mcap.part"]}, 409, "incomplete"),
        ({"mode": "paced", "pace": 0.01}, 422, "pace: "), ({"shell": "rm"}, 422, "shell: "),
        ({"machine": "../lab.toml"}, 422, "neither shipped nor monitored; monitored are demo/lab"),
        ({"machine": "lab", "bundle": "/etc"}, 422, "is not the name of shipped networks"),
        ({"bundle": "lab"}, 422, "needs machine"), ({"changes": ["alarms.on_delay_s ="]}, 422, "changes: "),
        ({"changes": ["alarms.on_delay_s = -1"]}, 422, "on_delay_s"), ({"changes": ["alarms.delay = 1"]}, 422, "delay"),
        ({"changes": ["alarms.on_delay_s = 1"], "mode": "paced"}, 422, "changes: nothing is evaluated"),
    ],
)  # fmt: skip
def test_invalid_requests_are_refused(client: httpx.Client, changes: dict[str, Any], status: int, detail: str) -> None:
    before = get(client, REPLAYS, ReplayList).replays
    found = problem(client.post(REPLAYS, json={"recordings": [ID], **changes}), status)
    assert detail in found.detail
    assert get(client, REPLAYS, ReplayList).replays == before


def test_unknown_replays_get_404(client: httpx.Client) -> None:
    for path in ("", "/reports", "/alarms", "/events"):
        problem(client.get(f"{REPLAYS}/nothing{path}"), 404)
    problem(client.delete(f"{REPLAYS}/nothing"), 404)


def test_replays_refused_by_settings_name_the_setting(directory: Path) -> None:
    with running(plan(None)) as runtime, monitored.client(runtime) as client:
        assert "[recording] directory" in problem(client.get(RECORDINGS), 404).detail
        assert "[recording] directory" in problem(client.post(REPLAYS, json={"recordings": [ID]}), 404).detail
        assert get(client, REPLAYS, ReplayList).replays == ()
    with running(plan(directory, enabled=False)) as runtime, monitored.client(runtime) as client:
        found = problem(client.post(REPLAYS, json={"recordings": [ID]}), 403)
        assert "[replay] enabled" in found.detail
        assert len(get(client, RECORDINGS, RecordingList, until_ns=START_NS + DAY_NS).recordings) == 3
    guarded = plan(directory)
    grant = Grant(who=("logger",), publishes=("demo/lab",))
    guarded = guarded.model_copy(update={"link": guarded.link.model_copy(update={"grants": (grant,)})})
    with pytest.raises(HTTPException, match="without grants, passwords and certificates"):
        ReplayRequests(guarded, Catalogue(directory)).start(ReplayRequest(recordings=(ID,), mode="paced"))


@pytest.mark.parametrize(
    ("host", "enabled", "expected"),
    [
        ("127.0.0.1", None, True),
        ("::1", None, True),
        ("localhost", None, True),
        ("0.0.0.0", None, False),  # noqa: S104  # nothing listens
        ("10.0.0.5", None, False),
        ("plant.example", None, False),
        ("10.0.0.5", True, True),
        ("127.0.0.1", False, False),
    ],
)
def test_replays_are_enabled_by_default_only_on_loopback(host: str, enabled: bool | None, expected: bool) -> None:
    asked = plan(None, enabled=enabled).model_copy(update={"http": HttpSettings(host=host)})
    assert ReplayRequests(asked, None).enabled is expected


def test_the_service_stops_its_replays_and_deletes_old_results(directory: Path) -> None:
    folder = directory / ".replays"
    with running(plan(directory, kept=1)) as runtime, monitored.client(runtime) as client:
        first = ended(client, start(client, to_ns=START_NS + 10**9))
        assert (folder / first.id).is_dir()
        second = start(client, mode="paced", pace=0.1)
        assert not (folder / first.id).exists()
        found = problem(client.get(f"{REPLAYS}/{first.id}"), 404)
        assert "the latest 1 are kept, until the service stops" in found.detail
        until(lambda: get(client, f"{REPLAYS}/{second.id}", ReplayJob).progress is not None, "first block")
        jobs = runtime.replays.jobs
    stopped = sure(jobs.find(second.id))
    assert stopped.view.state == "stopped"
    left = [Path(f"/proc/{one}/cmdline").read_bytes() for one in children_of(os.getpid())]
    assert not any(second.id.encode() in line for line in left)
