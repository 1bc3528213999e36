"""Measures speed and memory of replaying a recording of a large machine offline.

Run: ``python benchmarks/replay.py [MINUTES]`` (60 by default). A rotor kit with twelve channels and a shaft angle at
4 kHz is simulated into recordings of that length and of a sixth of it; each is replayed offline by the command, one
after the other, in one thread. The results are the ratio to real time, and whether memory grows with the length.
"""

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from machine_kind import rotor_kit

from models.machine import load_machine
from simulator.scenario import load_scenario
from simulator.stream import blocks, record


def main() -> None:
    """Measure and print."""
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    one_thread = os.environ | dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "large.toml"
        file.write_text(rotor_kit(4000.0, tilt=True), encoding="utf-8")
        machine = load_machine(file)
        scenario, _ = load_scenario("healthy")
        print(f"{len(machine.sensors)} channels at {machine.rate_hz:g} Hz")
        print("minutes   MB   processor s   × real time   peak memory MB")
        for length in (minutes / 6, minutes):
            path = Path(place) / f"{length:g}.mcap"
            record(machine, blocks(scenario.overridden(seed=1, duration_s=60 * length), machine), path)
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            command = ["-m", "service", "replay", str(path), "--offline", "--machine", str(file)]
            # Each in its own process; the system only reports the largest peak memory of all child processes so far.
            subprocess.run(
                [sys.executable, *command, "--out", str(path.with_suffix(".jsonl"))],
                check=True,
                env=one_thread,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            used_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            size_mb, memory_mb = path.stat().st_size / 1e6, after.ru_maxrss / 1024
            print(f"{length:7g} {size_mb:6.0f} {used_s:10.1f} {60 * length / used_s:13.0f} {memory_mb:13.0f}")


if __name__ == "__main__":
    main()
