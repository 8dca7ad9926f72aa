"""SAC on a GPU. Run with `pytest -m gpu tests/gpu/test_sac_gpu.py`."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from training_jobs import train

from gmijax.runs.history import read_metrics

pytestmark = [pytest.mark.gpu, pytest.mark.timeout(900)]


@pytest.mark.parametrize("updates", [2, 8])
def test_networks_as_large_as_they_are_used_learn(updates: int, tmp_path: Path) -> None:
    # XLA for GPUs once compiled the updates without end, which small networks do not show.
    done = train(
        *("env=ball_balance", "physics.impl=jax", "algo=sac", "num_envs=1024"),
        *(f"algo.updates_per_step={updates}", f"num_timesteps={20 * 16 * 1024}"),
        "run.dir=run",
        cwd=tmp_path,
        timeout_s=580.0,
    )
    assert done.returncode == 0, done.stderr
    lines = read_metrics(tmp_path / "run" / "metrics.jsonl")
    assert len(lines) == 20
    assert all(math.isfinite(line["loss/critic_loss"]) for line in lines)
    assert lines[-1]["loss/critic_loss"] > 0
