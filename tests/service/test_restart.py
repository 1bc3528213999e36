"""Programs that are killed and come back: real processes, kill -9, one side at a time."""

from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import httpx
import pytest

from rotorwatch.records.health import Health
from rotorwatch.records.history import ReportList
from tests.service.live import SHORT, Program, endpoint, machine_file, program, until

PACE = "8"


def monitor(folder: Path, address: str) -> tuple[str, ...]:
    """Of a machine with a window of 20 s."""
    file = machine_file(folder, *SHORT)
    return ("service.rotorwatch", "run", "--machine", file, "--listen", address, "--http-port", "0")


def simulator(address: str, start: str, *more: str) -> tuple[str, ...]:
    return (
        "simulator.rotorsim", "publish", "healthy", "--connect", address, "--pace", PACE, "--start", start,
        "--wait-for-subscriber", "180", *more,
    )  # fmt: skip


def reaches(watched: Program, condition: Callable[[Health], bool], what: str) -> Health:
    """Health as soon as a condition holds."""
    found: list[Health] = []

    def look() -> bool:
        found[:] = [watched.health()]
        return condition(found[0])

    until(look, what, timeout_s=180.0)
    return found[0]


@pytest.mark.parametrize(
    ("start", "told"),
    [
        pytest.param("2026-01-01T00:01:30Z", {"stream-lost", "data-gap"}, id="later"),
        pytest.param("2025-06-01T00:00:00Z", set(), id="earlier", marks=pytest.mark.long),
    ],
)
def test_killed_publisher_comes_back_and_the_monitor_carries_on(tmp_path: Path, start: str, told: set[str]) -> None:
    """Healthy before, healthy after, a gap between: reported as a gap, no alarm on the machine, windows full again."""
    address = endpoint()
    with program(tmp_path, *monitor(tmp_path, address)) as watched:
        watched.wait_for("HTTP API")
        with program(tmp_path, *simulator(address, "2026-01-01T00:00:00Z", "--run", "1")) as publisher:
            reaches(watched, lambda health: health.state == "healthy" and health.filled == 1.0, "full window")
            publisher.kill()
        before = reaches(watched, lambda health: not health.stream.publisher_alive, "death of the publisher noticed")
        assert before.quality.gaps == 0
        with program(tmp_path, *simulator(address, start, "--run", "2", "--seed", "7700021")):
            gap = reaches(watched, lambda health: health.quality.gaps == 1, "gap")
            assert "publisher restarted" in gap.quality.last_gap
            assert gap.stream.publisher_alive
            # Windows of a run that was ahead are later than those that are waited for.
            until(
                lambda: 50e9 < newest_full_window(watched) - start_ns(start) < 3600e9, "half a minute of full windows"
            )
            after = watched.health()
        assert after.quality.gaps == 1
        events = httpx.get(
            f"{watched.url()}/api/v1/machines/demo/lab/alarms/events", trust_env=False, timeout=180.0
        ).json()["events"]
        # What happened to the stream is told; nothing is said of the machine.
        # The silence between the runs may have been noticed; a start at another time is no clock that was set.
        assert told <= {event["data"]["name"] for event in events} <= told | {"stream-lost"}
        assert not any(alarm.raised for alarm in after.alarms)
        assert watched.process.poll() is None


def newest_full_window(watched: Program) -> int:
    """End of the newest window that was evaluated."""
    answer = httpx.get(f"{watched.url()}/api/v1/machines/demo/lab/reports?limit=1", trust_env=False, timeout=180.0)
    (report,) = ReportList.model_validate_json(answer.content).reports
    return report.end_ns if report.parameters and report.state == "healthy" else 0


def start_ns(text: str) -> float:
    return datetime.fromisoformat(text).timestamp() * 1e9


def test_killed_monitor_comes_back_and_the_publisher_carries_on(tmp_path: Path) -> None:
    address = endpoint()
    with program(tmp_path, *monitor(tmp_path, address)) as first:
        first.wait_for("HTTP API")
        with program(tmp_path, *simulator(address, "2026-01-01T00:00:00Z")) as publisher:
            reaches(first, lambda health: health.quality.accepted_blocks > 100, "blocks at the first monitor")
            first.kill()
            with program(tmp_path, *monitor(tmp_path, address)) as second:
                full = reaches(second, lambda health: health.state == "healthy", "full window at the second monitor")
                assert full.stream.publisher_alive
                assert full.stream.descriptor_mismatch == ()
                assert full.quality.accepted_blocks >= 200
                assert full.quality.refused_blocks == {}
                assert full.alarms == ()
                assert full.restart == ""  # it had no history to go on from
                assert publisher.process.poll() is None
                assert second.stop() == 0
