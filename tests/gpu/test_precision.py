"""What networks compute in, on a GPU. Run with `pytest -m gpu tests/gpu/test_precision.py`."""

from __future__ import annotations

from pathlib import Path

import pytest
from training_jobs import train

from gmijax.runs.history import read_metrics

pytestmark = [pytest.mark.gpu, pytest.mark.timeout(600)]


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_the_policy_that_is_updated_is_the_one_that_acted(precision: str, tmp_path: Path) -> None:
    """One update an iteration: its divergence is rounding, and steers no learning rate."""
    done = train(
        *("env=ball_balance", "num_envs=1024", f"num_timesteps={20 * 1024 * 16}"),
        *("algo.num_minibatches=1", "algo.num_updates_per_batch=1", "algo.unroll_length=16"),
        *(f"algo.precision={precision}", "run.dir=run"),
        cwd=tmp_path,
        timeout_s=580.0,
    )
    assert done.returncode == 0, done.stderr
    lines = read_metrics(tmp_path / "run" / "metrics.jsonl")
    assert len(lines) == 20
    assert max(abs(line["loss/kl"]) for line in lines) < 1e-6
    assert max(line["loss/clip_fraction"] for line in lines) == 0.0
