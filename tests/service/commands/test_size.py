"""``rotorwatch size``: estimates from measured costs, exact where possible, with a warning outside of their range."""

import json

import pytest
from typer.testing import CliRunner

from service.commands.rotorwatch import app
from service.history.records import Retention
from service.runtime.sizing import Costs, Kind, Measured, RecordingCost, Size, load_costs, sized
from service.settings.service import RecordingSettings

COSTS = load_costs()
LAB = Kind(channels=9, rate_hz=2000.0, hop_s=5.0, diagnosed=True, networks=True)


def size_of(kind: Kind, machines: int, costs: Costs = COSTS, cores: int = 8, busy: float = 0.6) -> Size:
    return sized(costs, kind, machines, retention=Retention(), recording=RecordingSettings(), cores=cores, busy=busy)


def told(*arguments: str) -> str:
    result = CliRunner().invoke(app, ["size", *arguments])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.parametrize("what", ["processor_ms", "memory_mb", "reports_kb", "readings_kb", "told_kb"])
def test_the_cost_model_is_close_to_every_measured_case(what: Measured) -> None:
    for case in COSTS.cases:
        assert COSTS.of(case, what) == pytest.approx(getattr(case, what), rel=0.35), case


def test_costs_that_follow_the_model_are_recovered() -> None:
    def processor_ms(kind: Kind) -> float:
        return 20.0 + 2.0 * kind.hop_s + 30.0 * kind.samples + kind.diagnosed * (40.0 + 50.0 * kind.samples)

    others = {"memory_mb": 5.0, "written_kb": 20.0, "reports_kb": 1.5, "readings_kb": 0.3, "told_kb": 11.0}
    kinds = [
        {"channels": channels, "rate_hz": rate_hz, "hop_s": hop_s, "diagnosed": diagnosed, "networks": False}
        for channels, rate_hz, hop_s in ((4, 1000.0, 5.0), (9, 2000.0, 5.0), (12, 4000.0, 10.0))
        for diagnosed in (True, False)
    ]
    cases = [kind | others | {"processor_ms": processor_ms(Kind.model_validate(kind))} for kind in kinds]
    made = COSTS.model_dump(exclude={"cases"}) | {"cases": cases}
    between = Kind(channels=8, rate_hz=3000.0, hop_s=7.5, diagnosed=True, networks=False)
    assert Costs.model_validate(made).of(between, "processor_ms") == pytest.approx(processor_ms(between), rel=1e-6)


def test_rates_and_disk_space_are_exact() -> None:
    costs = COSTS.model_copy(update={"recording": RecordingCost(compressed=0.5, processor_s_per_mb=0.01)})
    found = size_of(LAB, 100, costs)
    assert found.network_in_mb_s == pytest.approx(100 * 9 * 2000 * 4 / 1e6)
    assert found.recorded_gb_day == pytest.approx(100 * 9 * 2000 * 4 * 86_400 / 1e9 * 0.5)
    assert found.recording_cores == pytest.approx(100 * 0.072 * 0.01)
    # At 3.1 GB a day a machine fills 20 GB in less than seven days.
    assert found.recordings_days == pytest.approx(20 / 3.1104)
    assert found.recordings_gb == pytest.approx(100 * 20)
    assert found.cores == pytest.approx(100 * COSTS.of(LAB, "processor_ms") / 1e3 / 5)


def test_numbers_of_processes_and_computers_follow_the_load() -> None:
    assert (size_of(LAB, 29, cores=2).shards, size_of(LAB, 30, cores=2).shards) == (0, 2)
    assert size_of(LAB, 300, cores=64).shards == 20
    busy = size_of(LAB.model_copy(update={"hop_s": 0.1}), 10, cores=1)
    assert busy.shards >= busy.computers > 1
    assert busy.cores / busy.shards <= 0.6
    one = size_of(LAB.model_copy(update={"channels": 1000, "rate_hz": 1e6}), 1)
    assert (one.shards, one.computers) == (0, 1)
    assert one.machine_core > 1
    fleet = size_of(LAB, 3000, cores=4, busy=0.5)
    assert fleet.shards == 200
    assert fleet.computers == pytest.approx((fleet.cores + fleet.recording_cores) / 2, abs=1)
    assert fleet.memory_mb == pytest.approx(201 * COSTS.process_mb + 3000 * COSTS.of(LAB, "memory_mb"))


def test_more_channels_or_a_higher_rate_cost_no_less() -> None:
    base = size_of(LAB, 50)
    for field, larger in (("channels", 13), ("rate_hz", 4000.0)):
        more = size_of(LAB.model_copy(update={field: larger}), 50)
        assert (more.cores, more.memory_mb, more.history_gb) >= (base.cores, base.memory_mb, base.history_gb)
    assert size_of(LAB.model_copy(update={"diagnosed": False, "networks": False}), 50).cores < base.cores


def test_output_fits_80_columns_and_names_what_was_not_measured() -> None:
    asked = ("--machines", "200", "--channels", "12", "--rate", "4000", "--hop", "5")
    assert "OUTSIDE of what was measured: rate 4000 Hz" in told(*asked)  # networks were measured at 2 kHz
    inside = told(*asked, "--no-networks")
    assert "OUTSIDE" not in inside
    assert "all 200" in inside
    assert "38.4 MB/s" in inside
    outside = told("--machines", "100000", "--channels", "64", "--rate", "25600", "--levels-only")
    assert "OUTSIDE of what was measured: channels 64" in outside
    assert "OUTSIDE of what was measured: rate 25600 Hz" in outside
    assert max(len(line) for line in (inside + outside).splitlines()) <= 80
    found = json.loads(told("--machines", "20", "--levels-only", "--channels", "8", "--json"))
    assert found["kind"]["diagnosed"] is False
    assert found["network_in_mb_s"] == pytest.approx(20 * 8 * 2000 * 4 / 1e6)


@pytest.mark.parametrize(
    ("option", "value", "field"),
    [("--keep-days", "0", "keep_days"), ("--hop", "inf", "hop_s"), ("--rate", "nan", "rate_hz")],
)
def test_impossible_options_are_refused(option: str, value: str, field: str) -> None:
    result = CliRunner().invoke(app, ["size", "--machines", "2", option, value])
    assert result.exit_code == 2
    assert field in result.output
