"""Jobs of a sweep on one GPU. Run with `pytest -m gpu tests/gpu/test_sweeps_gpu.py`."""

from __future__ import annotations

from pathlib import Path

import pytest
from sweep_neighbours import Neighbours

pytestmark = [pytest.mark.gpu, pytest.mark.timeout(900)]

TASK = (
    *("env=ball_balance", "physics.impl=jax", f"num_timesteps={40 * 16 * 256}", "sweep.gpus=1"),
    "algo.unroll_length=16",
)
TOO_MANY = 1_572_864


def test_jobs_do_as_alone_beside_one_that_is_killed_and_one_out_of_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Else atomic additions come in another order each time, and no run is equal to another.
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_deterministic_ops=true")
    neighbours = Neighbours(tmp_path, *TASK)
    one = Neighbours(tmp_path, *TASK, "num_envs=256")
    alone = one.alone()
    assert len(alone) == 40
    states, lines = one.beside_a_killed_job(4)
    assert states == ["completed", "failed", "completed", "completed"]
    assert lines == alone
    states, lines = neighbours.beside_others("seed=0,1", f"num_envs=256,{TOO_MANY}")
    assert states == ["completed", "failed"] * 2
    assert lines == alone
