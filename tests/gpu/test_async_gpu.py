"""Asynchronous training on a real GPU. Run with `pytest -m gpu tests/gpu/test_async_gpu.py`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from training_jobs import train

from gmijax.channels.build import ChannelTopology
from gmijax.config.channel import ChannelConfig
from tests.channel_job import ChannelJob

pytestmark = [pytest.mark.gpu, pytest.mark.timeout(600)]

STEPS = 40 * 64 * 16


def test_experience_on_the_gpu_arrives_whole_and_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without MPS: the processes take turns."""
    monkeypatch.setenv("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    topology = ChannelTopology(agents=(0, 1), trainers=(2,), gpu_of=(0, 0, 0))
    task = {"count": 5000, "envs": 50, "batch": 100, "pause_chance": 0.1, "timeout_s": 60.0}
    settings = ChannelConfig(capacity_mib=1, transport="device")
    with ChannelJob(tmp_path, settings, topology, **task).start() as job:
        for rank in job.ranks:
            result = job.result(rank)
            assert result["error"] is None, result
        for agent in topology.agents:
            np.testing.assert_array_equal(np.sort(job.numbers(2, agent)), np.arange(5000))


@pytest.mark.parametrize("transport", ["memory", "device"])
@pytest.mark.parametrize("trainers", [1, 2])
def test_a_job_trains_whichever_way_experience_goes(
    trainers: int, transport: str, tmp_path: Path
) -> None:
    done = train(
        *("env=ball_balance", "algo=a3c", "physics.impl=jax", "num_envs=64", "run.dir=run"),
        *(f"num_timesteps={STEPS}", "plan.serving_gmis_per_gpu=2", "plan.backend=mps"),
        *(f"plan.training_gmis_per_gpu={trainers}", f"channel.transport={transport}"),
        cwd=tmp_path,
        timeout_s=500.0,
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["env_steps"] >= STEPS
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert sum(json.loads(line)["diverged_steps"] for line in lines) == 0
