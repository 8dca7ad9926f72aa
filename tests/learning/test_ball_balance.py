"""A real task is learnt. Slow: `make test-all`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from training_jobs import train


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_ball_balance_learns_in_two_gmis(tmp_path: Path) -> None:
    done = train(
        "env=ball_balance", "plan.gpus=2", "num_envs=256", "num_timesteps=500e3", "run.dir=run",
        "run.measure_throughput=false", cwd=tmp_path, timeout_s=580,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "run" / "metrics.jsonl").read_text()
    lines = [json.loads(line) for line in text.splitlines()]
    returns = [line["return"] for line in lines if line["return"] is not None]
    # A ball that falls past the tray earns about 12; one that stays on it 485.
    assert returns[0] < 30
    assert returns[-1] > 120
