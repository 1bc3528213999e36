"""A client that a generator of others makes out of the description works against the running service.

By hand the same was done with ``openapi-typescript``.
"""

import importlib
import json
import subprocess
import sys
from collections.abc import Iterator
from types import ModuleType

import pytest

from service.access.scopes import Scope
from service.runtime import Runtime
from tests.service.monitored import GUARDED, client, fed, token

PACKAGE = "generated_rotorwatch"


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runtime]:
    with fed(tmp_path_factory.mktemp("machine"), GUARDED) as (running, _):
        yield running


@pytest.fixture(scope="module")
def generated(runtime: Runtime, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModuleType]:
    """The generated package; a warning of the generator is a failure."""
    folder = tmp_path_factory.mktemp("generated")
    with client(runtime, token(runtime, Scope.READ, name="generator")) as http:
        (folder / "openapi.json").write_bytes(http.get("/openapi.json").raise_for_status().content)
    (folder / "config.json").write_text(json.dumps({"post_hooks": []}), encoding="utf-8")  # nobody reads it
    options = ["--path", "openapi.json", "--config", "config.json", "--output-path", PACKAGE, "--meta", "none"]
    done = subprocess.run(
        [sys.executable, "-m", "openapi_python_client", "generate", *options, "--fail-on-warning"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARNING" not in done.stdout + done.stderr
    sys.path.insert(0, str(folder))
    try:
        yield importlib.import_module(PACKAGE)
    finally:
        sys.path.remove(str(folder))
        for name in [one for one in sys.modules if one.startswith(PACKAGE)]:
            del sys.modules[name]


def test_a_generated_client_asks_orders_and_understands_refusals(generated: ModuleType, runtime: Runtime) -> None:
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
