"""Training over rings between virtual GPUs: equal parameters, and an end whatever dies."""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import pytest
from training_jobs import (
    POINT_TASK,
    STEPS,
    TINY,
    kill_somebody,
    learner_arrays,
    shared_memory,
    train,
)

ITERATIONS = 13
"""Of four updates each: 52 updates."""


def _trained(strategy: str, gmis_per_gpu: int, cwd: Path, task: str = TINY[0]) -> list[np.ndarray]:
    """The learner after `ITERATIONS` on two GPUs."""
    plan = ("plan.gpus=2", f"plan.gmis_per_gpu={gmis_per_gpu}", f"reduce.strategy={strategy}")
    steps = ITERATIONS * 2 * gmis_per_gpu * STEPS
    run = (f"num_timesteps={steps}", f"run.dir={strategy}")
    done = train(task, *TINY[1:], *plan, *run, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return learner_arrays(cwd / strategy)


@pytest.mark.timeout(400)
def test_two_gmis_learn_the_same_bits_under_every_strategy(tmp_path: Path) -> None:
    # The sum of two numbers has one order only.
    mpr = _trained("mpr", 1, tmp_path)
    for strategy in ("mrr", "har", "flat"):
        for other, expected in zip(_trained(strategy, 1, tmp_path), mpr, strict=True):
            np.testing.assert_array_equal(other, expected)


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_four_gmis_learn_the_same_under_every_strategy(tmp_path: Path) -> None:
    # Sums in another order: where a contact may begin a step earlier for it, so may all that
    # follows. There are none in this task.
    (tmp_path / "point.py").write_text(POINT_TASK)
    mpr = _trained("mpr", 2, tmp_path, "env=point.py:make")
    assert len(mpr) > 10
    for strategy in ("mrr", "har"):
        found = _trained(strategy, 2, tmp_path, "env=point.py:make")
        for other, expected in zip(found, mpr, strict=True):
            # Each of 52 updates moves a parameter by 3e-4 at most.
            np.testing.assert_allclose(other, expected, rtol=1e-4, atol=3e-6)


@pytest.mark.timeout(300)
def test_kills_at_any_moment_leave_nothing_of_a_job_with_rings(tmp_path: Path) -> None:
    """Also while GMIs meet, when a library would rather end them by itself."""
    draw = random.Random(0)
    shm = shared_memory()
    rings = ("plan.gpus=2", "reduce.strategy=mrr")
    for number in range(8):
        kill_somebody(*rings, cwd=tmp_path / str(number), draw=draw, within_s=(1.0, 10.0))
    assert shared_memory() <= shm
    plan = json.loads((tmp_path / "7" / "run" / "plan.json").read_text())
    assert plan["strategy"] == "mrr"
