"""Training over rings between virtual GPUs: equal parameters, and an end whatever dies."""

from __future__ import annotations

import json
import random
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from training_jobs import (
    FOREVER,
    STEPS,
    TINY,
    gmi_pid,
    kill,
    learner_arrays,
    pids_of,
    shared_memory,
    start,
    train,
    wait_until,
)

ITERATIONS = 13
"""Of four updates each: 52 updates."""


def _trained(strategy: str, gmis_per_gpu: int, cwd: Path) -> list[np.ndarray]:
    """The learner after `ITERATIONS` on two GPUs."""
    plan = ("plan.gpus=2", f"plan.gmis_per_gpu={gmis_per_gpu}", f"reduce.strategy={strategy}")
    steps = ITERATIONS * 2 * gmis_per_gpu * STEPS
    done = train(*TINY, *plan, f"num_timesteps={steps}", f"run.dir={strategy}", cwd=cwd)
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
    mpr = _trained("mpr", 2, tmp_path)
    assert len(mpr) > 10
    for strategy in ("mrr", "har"):
        for other, expected in zip(_trained(strategy, 2, tmp_path), mpr, strict=True):
            # Sums in another order: after 52 updates of Adam at 3e-4, each at most 3e-4, that
            # may have moved a parameter by a hundredth of one update.
            np.testing.assert_allclose(other, expected, rtol=1e-4, atol=3e-6)


@pytest.mark.timeout(300)
def test_kills_at_any_moment_leave_nothing_of_a_job_with_rings(tmp_path: Path) -> None:
    """Also while GMIs meet, when a library would rather end them by itself."""
    draw = random.Random(0)
    shm = shared_memory()
    for number in range(8):
        cwd = tmp_path / str(number)
        cwd.mkdir()
        run = cwd / "run"
        rings = ("plan.gpus=2", "reduce.strategy=mrr")
        job = start(*TINY, FOREVER, *rings, "run.dir=run", cwd=cwd)
        time.sleep(draw.uniform(1.0, 10.0))
        victims = [job.pid, *filter(None, (gmi_pid(run, gmi) for gmi in range(2)))]
        kill(draw.choice(victims))
        code = job.wait(timeout=30)
        assert code in (1, -signal.SIGKILL), (cwd / "stderr.txt").read_text()
        wait_until(lambda run=run: not pids_of(run), 10, f"all GMIs of kill {number} gone")
    assert shared_memory() <= shm
    plan = json.loads((tmp_path / "7" / "run" / "plan.json").read_text())
    assert plan["strategy"] == "mrr"
