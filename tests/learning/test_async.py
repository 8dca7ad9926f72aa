"""A real task is learnt asynchronously. Slow: `make test-all`."""

from __future__ import annotations

from pathlib import Path

import pytest
from training_jobs import train

from gmijax.runs.history import read_metrics


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_ball_balance_learns_from_two_agents(tmp_path: Path) -> None:
    done = train(
        "env=ball_balance", "algo=a3c", "plan.serving_gmis_per_gpu=2", "num_envs=128",
        "algo.batch_size=256", "num_timesteps=500e3", "run.dir=run", cwd=tmp_path, timeout_s=880,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    lines = read_metrics(tmp_path / "run" / "metrics.jsonl")
    returns = [line["return"] for line in lines if line["return"] is not None]
    # A ball that falls past the tray earns about 12; one that stays on it 485.
    assert returns[0] < 30
    assert returns[-1] > 60
