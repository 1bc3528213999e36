"""Shards on the computers of a Ray cluster: a node lost, a node added, and settings that a fleet refuses."""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import Pipe
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from typer.testing import CliRunner

from benchmarks.studies.reporting.study import spread_over
from models.errors import BundleError, MachineFileError
from models.machine import load_machine
from models.signals.block import SampleBlock
from models.signals.link import LinkSettings
from rotorwatch.records.health import HealthState
from service.commands.rotorwatch import app
from service.runtime.fleet import HEALTH_CHECKS, ShardActor, better_place, fleet_count
from service.runtime.runtime import Runtime, running
from service.runtime.shards import Shards
from service.settings.service import FleetSettings, HistorySettings, MachineEntry, ServiceSettings
from service.stream.transport import route
from simulator.scenario import parse_fault
from tests.service.rig.live import ROOT, Feed, endpoint, open_session, scenario_blocks, until
from tests.service.rig.postgres import postgres_server
from tests.service.rig.replaying import recording
from tests.service.runtime.test_shards import plan_for

if TYPE_CHECKING:
    from ray.cluster_utils import Cluster


def fleet_plan(folder: Path, database: str, count: int = 2) -> ServiceSettings:
    """Settings of a fleet of two machines in `count` shards."""
    plan = plan_for(folder, count)
    link = LinkSettings(mode="client", connect=plan.link.listen)
    changed = {"link": link, "history": HistorySettings(url=database), "fleet": FleetSettings(listen=endpoint())}
    return plan.model_copy(update=changed)


@pytest.fixture(scope="module")
def cluster() -> Iterator["Cluster"]:
    """A Ray cluster on this computer: a head node without cores and two worker nodes with one core each."""
    from ray.cluster_utils import Cluster  # noqa: PLC0415  # half a second, and every worker reads this module

    head = {
        "num_cpus": 0,
        "include_dashboard": False,
        "include_log_monitor": False,
        "no_monitor": True,  # of the autoscaler
        "_system_config": {"worker_niceness": 0} | json.loads(HEALTH_CHECKS),
    }
    made = Cluster(initialize_head=True, head_node_args=head)
    try:
        for _ in range(2):
            made.add_node(num_cpus=1)
        yield made
    finally:
        made.shutdown()  # type: ignore[no-untyped-call]


def actors_of(runtime: Runtime) -> list[Any]:
    assert isinstance(runtime._machines, Shards)
    return [shard.process for shard in runtime._machines._shards]


def computers_of(runtime: Runtime) -> list[str]:
    """Node of each shard; empty for a shard that is not running."""
    return [one.computer for one in actors_of(runtime)]


def test_shards_move_off_a_lost_computer_and_onto_a_new_one(cluster: "Cluster", tmp_path: Path) -> None:
    blocks = scenario_blocks(45.0, parse_fault("k_by=-0.33@0"))
    assert HEALTH_CHECKS in (ROOT / "docs" / "service.md").read_text(encoding="utf-8")
    with postgres_server() as server:
        plan = fleet_plan(tmp_path, server.new_database("fleet"))
        at = plan.link.connect[0]
        broken = MachineEntry(file=plan.machines[1].file, bundle=str(tmp_path / "nothing"))
        failed = Runtime(plan.model_copy(update={"machines": (plan.machines[0], broken)}), cluster.address)
        with route(LinkSettings(listen=(at,))), pytest.raises(BundleError, match="nothing: not a bundle"):
            failed.start()
        with (
            route(LinkSettings(listen=(at,))),
            running(plan, cluster.address) as runtime,
            open_session(at, "client") as session,
        ):
            machines = runtime.machines()
            feeds = [Feed(session, one.machine) for one in machines]

            def fed(chosen: Sequence[SampleBlock], counts: Callable[[int], bool]) -> None:
                for feed in feeds:
                    feed.put(*chosen)
                for one in machines:
                    until(lambda: counts(one.status().tally.blocks), f"blocks of {one.machine.name}")  # noqa: B023

            fed(blocks[:440], lambda count: count == 440)
            until(lambda: all(one.health().state is HealthState.ALERT for one in machines), "the alarms")
            before = [one.history.events(after=-1) for one in machines]
            there = computers_of(runtime)
            assert len(set(there)) == 2
            lost = next(node for node in cluster.worker_nodes if node.node_id == there[0])
            cluster.remove_node(lost, allow_graceful=False)
            until(lambda: not runtime.readiness().ready, "that it is told")
            assert "its computer was lost and is being started again" in machines[0].health().reason
            assert machines[0].health().state is HealthState.ALERT  # a raised alarm stays visible
            until(lambda: runtime.readiness().ready, "that it goes on")
            assert computers_of(runtime) == [there[1], there[1]]
            assert "00:42" not in machines[1].health().restart
            assert machines[0].health().restart.startswith("resumed at 2026-01-01T00:00:42")
            revived, settled = actors_of(runtime)
            assert revived.placed_s > settled.placed_s
            revived.placed_s, settled.placed_s = math.inf, -math.inf  # however long the rest takes
            cluster.add_node(num_cpus=1)
            until(lambda: len(set(computers_of(runtime)) - {""}) == 2 and runtime.readiness().ready, "a move")
            assert revived.computer == there[1]  # it catches up: the other one moves
            fed(blocks[440:], lambda count: count >= 10)
            for one, log in zip(machines, before, strict=True):
                after = one.history.events(after=-1)
                assert after[: len(log)] == log
                assert [event.sequence for event in after] == list(range(len(after)))
                assert [event.alarm for event in after if event.kind == "raised"].count("k_by") == 1


def test_a_shard_that_ended_before_it_was_asked_to_stop_has_no_more_to_say(monkeypatch: pytest.MonkeyPatch) -> None:
    """The request to stop, which nobody has read, resets the connection."""
    monkeypatch.setattr(ShardActor, "begin", lambda _: None)
    actor = ShardActor(ServiceSettings(), LinkSettings())
    actor._connection, theirs = Pipe()
    actor.ask_to_stop()
    theirs.close()
    with pytest.raises(EOFError):
        actor.said(0, 1.0)


def test_offline_replay_on_a_cluster_gives_the_results_of_single_replays(cluster: "Cluster", tmp_path: Path) -> None:
    plan = plan_for(tmp_path, 1)
    kits = [load_machine(entry.file) for entry in plan.machines]
    files = [
        str(recording(tmp_path / f"{kit.name}.mcap", scenario_blocks(30.0 + 10.0 * number), kit))
        for number, kit in enumerate(kits)
    ]
    machines = "".join(f'[[machines]]\nfile = "{entry.file}"\n' for entry in plan.machines)
    (tmp_path / "plant.toml").write_text(machines, encoding="utf-8")
    offline = ["replay", *files, "--offline", "--config", str(tmp_path / "plant.toml")]
    for kit in kits:
        alone = ["--key", f"{kit.site}/{kit.name}", "--out", str(tmp_path / f"{kit.name}.jsonl")]
        assert CliRunner().invoke(app, [*offline, *alone]).exit_code == 0
    command = [*offline, "--ray", cluster.address, "--out", str(tmp_path / "results")]
    found = CliRunner().invoke(app, command)
    assert found.exit_code == 0, found.output
    for kit in kits:
        there = (tmp_path / "results" / f"{kit.site}.{kit.name}.jsonl").read_text(encoding="utf-8")
        assert there == (tmp_path / f"{kit.name}.jsonl").read_text(encoding="utf-8")
        assert there
    assert "2 of 2" in found.output
    again = CliRunner().invoke(app, command)
    assert again.exit_code == 2
    assert "already exists; --overwrite replaces it" in again.output
    (tmp_path / "other.toml").write_text(machines.partition("\n[[")[0], encoding="utf-8")
    missing = CliRunner().invoke(app, [*command, "--overwrite", "--config", str(tmp_path / "other.toml")])
    assert missing.exit_code == 2
    assert "none is demo/pump, which was recorded" in missing.output
    with spread_over(1, cluster.address) as spread:
        assert list(spread(abs, [-1, 2, -3])) == [1, 2, 3]


def test_shard_count_of_a_fleet_and_settings_that_it_refuses(tmp_path: Path) -> None:
    plan = fleet_plan(tmp_path, "postgresql://me@host/plant")
    assert fleet_count(plan) == 2
    many = plan.model_copy(update={"machines": 31 * plan.machines})
    assert fleet_count(many) == 2
    assert fleet_count(many.model_copy(update={"shards": plan.shards.model_copy(update={"count": None})})) == 5
    for update, what in (
        ({"fleet": None}, r"expected \[fleet\]"),
        ({"history": HistorySettings(url=f"sqlite:///{tmp_path}/history.sqlite")}, "history.url: expected postgresql"),
        ({"link": LinkSettings(listen=(endpoint(),))}, "link: expected connect"),
    ):
        with pytest.raises(MachineFileError, match=what):
            fleet_count(plan.model_copy(update=update))


def test_an_unreachable_cluster_is_named_with_the_command_that_starts_one(tmp_path: Path) -> None:
    (tmp_path / "fleet.toml").write_text(
        '[link]\nmode = "client"\nconnect = ["tcp/127.0.0.1:7447"]\n'
        '[history]\nurl = "postgresql://me@127.0.0.1/plant"\n[fleet]\nlisten = "tcp/127.0.0.1:7448"\n',
        encoding="utf-8",
    )
    command = ["fleet", "--config", str(tmp_path / "fleet.toml"), "--address", endpoint().removeprefix("tcp/")]
    found = CliRunner().invoke(app, command)
    assert found.exit_code == 1
    assert "no Ray cluster at 127.0.0.1:" in found.output
    assert "RAY_worker_niceness=0 ray start --head" in found.output


def test_a_shard_moves_only_to_a_computer_with_more_room() -> None:
    assert better_place([], {"a": 2.0}) is None
    assert better_place([("a", 0.4), ("b", 0.4)], {"a": 2.0, "b": 2.0}) is None
    assert better_place([("a", 0.4), ("a", 0.4), ("b", 0.4)], {"a": 2.0, "b": 2.0}) is None  # it would be the same
    assert better_place([("a", 0.4)] * 3 + [("b", 0.4)], {"a": 2.0, "b": 2.0, "c": 2.0}) == (0, "c")
    assert better_place([("a", 0.4)] * 2, {"a": 8.0, "b": 0.5}) is None  # a small one would be fuller
    assert better_place([("lost", 0.4), ("a", 0.4)], {"a": 2.0, "b": 2.0}) is None
