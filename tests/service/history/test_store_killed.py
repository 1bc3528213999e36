"""kill -9 of a process that writes: whole steps only, no event twice, and what was called durable is there."""

import time
from pathlib import Path

import numpy as np

from tests.service.rig.live import program
from tests.service.rig.postgres import opened
from tests.sure import sure

ROUNDS = 4


def test_a_killed_writer_leaves_whole_steps(url: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    safe = -1
    for _ in range(ROUNDS):
        with program(tmp_path, "tests.service.history.test_store", url) as writer:
            writer.wait_for(f"{safe + 3}\n")
            time.sleep(rng.uniform(0.0, 0.05))  # at any moment of a transaction
            writer.kill()
            safe = int(writer.output().rsplit("\n", 2)[-2])
        with opened(url) as store:
            lab = store.machine("demo", "lab")
            last = lab.last_sequence()
            steps = (last + 1) // 2
            assert last % 2 == 1  # both events of a step or none
            assert steps - 2 <= safe < steps  # what was called durable, and at most the step in mid-write
            assert [event.id for event in lab.events(limit=10_000)] == [f"event-{n}" for n in range(last + 1)]
            texts = [report.text for _, report in lab.reports(limit=10_000)]
            assert texts == [f'{{"number": {n}}}' for n in range(steps - 1, -1, -1)]
            assert len(lab.readings(quantity="misfit", name="z", limit=10_000)) == steps
            restored = sure(lab.restore())
            assert [part for _, part in restored.parts] == [b"part %d" % n for n in range(steps - 3, steps)]
            safe = steps - 1
