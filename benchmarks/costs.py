"""Measures the resources that machines of several kinds need, end to end, for ``rotorwatch size``.

Run: ``python benchmarks/costs.py`` (half an hour; ``--cases 1 4`` measures only the first and the fourth kind and keeps
the others). One kind after the other is watched by a monitor of one process, as in ``capacity.py``, and the costs are
written to ``service/runtime/costs.toml``. Processor time is measured, not duration, but it grows on a busy computer
too: run nothing else.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from capacity import KINDS, Figures, measure, monitored
from machine_kind import MachineKind

from models.mistakes import read_toml
from rotorwatch import __version__

CASES = (
    MachineKind(),
    MachineKind(13),
    MachineKind(networks=False),
    MachineKind(9, 1000.0, networks=False),
    MachineKind(9, 4000.0, networks=False),
    MachineKind(13, 4000.0, networks=False),
    MachineKind(hop_s=10.0, networks=False),
    MachineKind(13, 4000.0, 10.0, networks=False),
    *(
        MachineKind(channels, rate_hz, hop_s, diagnosed=False, networks=False)
        for channels, rate_hz, hop_s in ((4, 1000.0, 5.0), (8, 2000.0, 5.0), (12, 4000.0, 5.0), (8, 2000.0, 10.0))
    ),
)
FILE = Path("service/runtime/costs.toml")
_SMALLEST = MachineKind(1, 1000.0, 5.0, diagnosed=False, networks=False)
_HEADING = """# What machines of several kinds take, for `rotorwatch size`; written by `python benchmarks/costs.py`.
# What each figure means stands in service/runtime/sizing.py.
"""


def computer() -> str:
    """Number of cores and name of the processor."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    name = next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown processor"
    )
    return f"{os.cpu_count()} cores of {name.replace('(R)', '').replace('(TM)', '')}"


def process_mb() -> float:
    """Memory of a monitor of the smallest machine before any data."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        machine = _SMALLEST.machine(Path(name), "kit0")
        with monitored(Path(name), [machine], {}) as (process, _, _):
            return process.memory_mb()


def case(kind: MachineKind, figures: Figures, machines: int, base_mb: float) -> dict[str, Any]:
    """Costs of a kind as fields of `service.runtime.sizing.Case`."""
    return kind.fields | {
        "processor_ms": round(figures.processor_ms, 1),
        "memory_mb": round((figures.memory_mb - base_mb) / machines, 2),
        "written_kb": round(figures.written_kb, 1),
        "reports_kb": round(figures.reports_kb, 2),
        "readings_kb": round(figures.readings_kb, 3),
        "told_kb": round(figures.told_kb, 2),
    }


def written(heading: dict[str, Any], recording: dict[str, Any], cases: list[dict[str, Any]]) -> str:
    """The cost file as TOML; its numbers, strings and lists are written like JSON."""

    def table(fields: dict[str, Any]) -> list[str]:
        return [f"{name} = {json.dumps(value)}" for name, value in fields.items()]

    lines = [*table(heading), "", "[recording]", *table(recording)]
    for one in cases:
        lines += ["", "[[cases]]", *table(one)]
    return _HEADING + "\n".join(lines) + "\n"


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description="resources that a machine needs, for rotorwatch size")
    parser.add_argument(
        "--machines", type=int, default=10, help="machines of each kind; from thirty on, processes share them"
    )
    parser.add_argument("--seconds", type=float, default=30.0, help="seconds measured for each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cases", type=int, nargs="+", help="only these cases, numbered from 1")
    parser.add_argument("--out", type=Path, default=FILE)
    asked = parser.parse_args()
    former: dict[str, Any] = read_toml(FILE)
    known = {tuple(one[name] for name in _SMALLEST.fields): one for one in former.get("cases", ())}
    base_mb = round(process_mb(), 1)
    heading = {
        "computer": computer(),
        "version": __version__,
        "machines": asked.machines,
        "seconds": asked.seconds,
        "seeds": [asked.seed + one for one in range(min(KINDS, asked.machines))],
        "process_mb": base_mb,
    }
    alike = ("computer", "version", "machines", "seconds", "seeds")
    if asked.cases and any(former.get(name) != heading[name] for name in alike):
        parser.error(f"--cases: the others were measured otherwise ({', '.join(alike)}): measure all")
    for number, kind in enumerate(CASES, start=1):
        if asked.cases and number not in asked.cases:
            continue
        print(f"{number} of {len(CASES)}: {kind}", flush=True)
        figures = measure(kind, asked.machines, asked.seed, asked.seconds, 0.0, of_shard=False)
        known[tuple(kind.fields.values())] = case(kind, figures, asked.machines, base_mb)
        cases = [known[tuple(one.fields.values())] for one in CASES if tuple(one.fields.values()) in known]
        asked.out.write_text(written(heading, former["recording"], cases), encoding="utf-8")


if __name__ == "__main__":
    main()
