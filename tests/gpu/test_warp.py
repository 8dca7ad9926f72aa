"""Every task with MJX-Warp on a real GPU. Run with `pytest -m gpu tests/gpu/test_warp.py`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from supervision import CHECKOUT
from training_jobs import child_environment, train

from gmijax.sim.impl import ON_GPU

pytest.importorskip("warp", reason="warp-lang is not installed")

# The first run of a task compiles its kernels, for a minute or more.
pytestmark = [pytest.mark.gpu, pytest.mark.timeout(1200)]

SMALL = (
    *("physics.impl=warp", "num_envs=512", "algo.unroll_length=16", "algo.num_minibatches=4"),
    *("run.checkpoint_every=0", "run.dir=run"),
)
ITERATION = 512 * 16


@pytest.mark.parametrize("randomize", ["off", "on"])
@pytest.mark.parametrize("task", sorted(ON_GPU))
def test_a_task_trains_and_no_buffer_is_too_small(
    task: str, randomize: str, tmp_path: Path
) -> None:
    steps = 20 * ITERATION
    done = train(
        *SMALL,
        f"env={task}",
        f"env.randomize={randomize}",
        f"num_timesteps={steps}",
        "--verbose",
        cwd=tmp_path,
        timeout_s=1100.0,
    )
    assert done.returncode == 0, done.stderr
    assert "physics.impl warp: set" in done.stdout
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["impl"] == "warp"
    assert summary["env_steps"] == steps
    assert summary["overflow_steps"] == {"contact": 0.0, "constraint": 0.0}
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert sum(json.loads(line)["diverged_steps"] for line in lines) < 1e-3 * steps


@pytest.mark.parametrize("task", sorted(ON_GPU))
def test_a_task_steps_as_with_mjx_jax(task: str, tmp_path: Path) -> None:
    """The simulator's counts of itself too: loops on a GPU have lost that before."""
    done = subprocess.run(
        [sys.executable, str(CHECKOUT / "tests" / "steps_of_both.py"), task],
        cwd=tmp_path,
        env=child_environment() | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"},
        capture_output=True,
        text=True,
        timeout=1100,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads(done.stdout.splitlines()[-1]) == {"obs": [], "reward": []}


def test_two_gmis_share_a_gpu(tmp_path: Path) -> None:
    done = train(
        *SMALL,
        *("env=ant", "plan.gmis_per_gpu=2", "plan.backend=mps", f"num_timesteps={8 * ITERATION}"),
        cwd=tmp_path,
        timeout_s=1100.0,
    )
    assert done.returncode == 0, done.stderr
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert all(json.loads(line)["physics/contact_overflow_steps"] == 0.0 for line in lines)
