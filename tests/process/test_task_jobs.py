"""Every task, from its own settings to a checkpoint: two iterations of a real job."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from training_jobs import train

from gmijax.sim.registry import TASKS

NUM_ENVS = 8
STEPS = NUM_ENVS * 2


# Each compiles for half a minute or more; `test_wheel` trains one, `tests/contract` has them all.
@pytest.mark.slow
@pytest.mark.parametrize("task", sorted(TASKS))
def test_a_task_trains_for_two_iterations(task: str, tmp_path: Path) -> None:
    done = train(
        *(f"env={task}", f"num_envs={NUM_ENVS}", f"num_timesteps={2 * STEPS}", "run.dir=run"),
        *("algo.unroll_length=2", "algo.num_minibatches=2", "algo.num_updates_per_batch=1"),
        "physics.impl=jax",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["env"], summary["env_steps"]) == (task, 2 * STEPS)
    lines = [json.loads(x) for x in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [line["env_steps"] for line in lines] == [STEPS, 2 * STEPS]
    assert all(line["diverged_steps"] == 0 for line in lines)
    assert (tmp_path / "run" / "checkpoints" / f"{2 * STEPS:012d}").is_dir()
