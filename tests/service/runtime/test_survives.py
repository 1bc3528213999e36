"""kill -9 of a monitor and what its successor knows: real programs, a real database, actions of operators."""

from pathlib import Path
from typing import Any

import httpx
import pytest

from models.machine import Machine, load_machine
from simulator.scenario import parse_fault
from tests.service.rig.live import QUICK, Program, endpoint, machine_file, program, scenario_blocks, send, until

ALARMS = "/api/v1/machines/demo/lab/alarms"
FAULT = parse_fault("c_bz=0.5@0")


def monitor(folder: Path, address: str, file: str) -> tuple[str, ...]:
    settings = folder / "monitor.toml"
    settings.write_text(
        f'[link]\nlisten = ["{address}"]\n[http]\nport = 0\n[queue]\nwhen_full = "wait"\n'
        f'[history]\nurl = "sqlite:///history.sqlite"\n[[machines]]\nfile = "{file}"\n',
        encoding="utf-8",
    )
    return ("service", "run", "--config", str(settings))


def running(folder: Path, address: str, file: str) -> Any:
    history = f"sqlite:///{folder / 'history.sqlite'}"
    return program(folder, *monitor(folder, address, file), ROTORWATCH_HISTORY__URL=history)


def do(at: Program, kind: str, name: str, state: str, **order: object) -> None:
    body = {"reason": "told so", "expected_state": state, **order}
    httpx.post(f"{at.url()}{ALARMS}/{name}/{kind}", json=body, trust_env=False, timeout=180.0).raise_for_status()


def log(at: Program) -> list[tuple[str, str, int, int]]:
    answer = httpx.get(f"{at.url()}{ALARMS}/events?after=-1&limit=1000", trust_env=False, timeout=180.0)
    told = [one["data"] for one in answer.raise_for_status().json()["events"]]
    found = [(one["kind"], one["name"], one["sequence"], one["occurrence"]) for one in told]
    return sorted(found, key=lambda one: one[2])


def states(at: Program) -> dict[str, str]:
    alarms = httpx.get(f"{at.url()}{ALARMS}", trust_env=False, timeout=180.0).raise_for_status().json()["alarms"]
    return {alarm["name"]: alarm["state"] for alarm in alarms}


@pytest.mark.slow
def test_alarms_and_operator_actions_survive_kill_9(tmp_path: Path) -> None:
    file, address = machine_file(tmp_path, *QUICK), endpoint()
    machine: Machine = load_machine(file)
    stream = scenario_blocks(80.0, FAULT)
    with running(tmp_path, address, file) as first:
        first.wait_for("HTTP API")
        send(address, stream[:450], machine)
        until(lambda: first.health().quality.accepted_blocks == 450, "all blocks")
        do(first, "acknowledge", "c_bz", "unacknowledged")
        do(first, "shelve", "model", "normal", duration_s=3600)
        do(first, "remove-from-service", "data-stuck", "normal")
        before = log(first)
        assert [one[:2] for one in before] == [
            ("raised", "c_bz"), ("acknowledged", "c_bz"), ("shelved", "model"), ("removed-from-service", "data-stuck"),
        ]  # fmt: skip
        first.kill()

    with running(tmp_path, address, file) as second:
        second.wait_for("HTTP API")
        assert log(second) == before
        assert states(second) == {"c_bz": "acknowledged", "model": "shelved", "data-stuck": "out-of-service"}
        health = second.health()
        assert health.restart.startswith("resumed at 2026-01-01T00:00:45.000000Z; there is no window until")
        assert health.filled == 0.0
        assert health.state in {"alert", "danger"}
        # Blocks that no cache holds any more are missing; later data raise no alarm twice.
        send(address, stream[480:], machine)
        until(lambda: second.health().quality.accepted_blocks == len(stream) - 480, "the rest")
        after = second.health()
        assert after.quality.gaps == 1
        assert "3 s of data are missing (30 blocks)" in after.quality.last_gap
        new = log(second)[len(before) :]
        assert [one[:2] for one in new] == [("raised", "data-gap"), ("cleared", "data-gap")]
        assert [one[2] for one in log(second)] == list(range(len(before) + 2))
        assert states(second)["c_bz"] == "acknowledged"
        assert second.stop() == 0

    # Another machine file: the accumulated window does not fit, the alarms do.
    changed = machine_file(tmp_path, *QUICK, ("on_delay_s = 5.0", "on_delay_s = 6.0"))
    with running(tmp_path, address, changed) as third:
        third.wait_for("HTTP API")
        health = third.health()
        assert health.restart.startswith("alarms are as they were at 2026-01-01T00:01:20")
        assert "the window is filling anew: machine file was " in health.restart
        assert health.filled == 0.0
        assert states(third)["c_bz"] == "acknowledged"
        assert health.state in {"alert", "danger"}  # a raised alarm outranks warming
        assert third.stop() == 0
