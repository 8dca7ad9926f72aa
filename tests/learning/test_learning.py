"""A real task is learnt, by both algorithms. Slow: `make test-all`."""

from __future__ import annotations

from pathlib import Path

import pytest
from training_jobs import train

from gmijax.runs.history import read_metrics


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("overrides", "reached"),
    [
        (("plan.gpus=2", "num_envs=256"), 120),
        (("algo=a3c", "plan.serving_gmis_per_gpu=2", "num_envs=128", "algo.batch_size=256"), 60),
    ],
    ids=["ppo", "a3c"],
)
def test_ball_balance_learns_in_two_gmis(
    overrides: tuple[str, ...], reached: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "0")  # It runs for minutes.
    shared = ("env=ball_balance", "num_timesteps=500e3", "run.dir=run")
    done = train(*shared, *overrides, cwd=tmp_path, timeout_s=880)
    assert done.returncode == 0, done.stderr
    lines = read_metrics(tmp_path / "run" / "metrics.jsonl")
    returns = [line["return"] for line in lines if line["return"] is not None]
    # A ball that falls past the tray earns about 12; one that stays on it 485.
    assert returns[0] < 30
    assert returns[-1] > reached
