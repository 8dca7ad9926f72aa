"""`run.profile` on a real GPU: run `pytest -m gpu tests/gpu/test_profile_gpu.py`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from training_jobs import events, train

from gmijax.machine.snapshot import detect_machine

pytestmark = [pytest.mark.gpu, pytest.mark.timeout(400)]


@pytest.mark.parametrize("impl", ["jax", "warp"])
def test_a_training_goes_on_after_its_trace(impl: str, tmp_path: Path) -> None:
    """Its loops run as CUDA graphs, and a tracer that detaches can break the next launch."""
    if not detect_machine().gpus:
        pytest.skip("needs a GPU")
    if impl == "warp":
        pytest.importorskip("warp", reason="warp-lang is not installed")
    size = ("num_envs=4096", "num_timesteps=3e6", "plan.gpus=1", f"physics.impl={impl}")
    options = ("run.profile=20:25", "run.dir=run")
    done = train("env=ant", *size, *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    run = tmp_path / "run"
    assert not events(run, "fault")
    assert json.loads((run / "summary.json").read_text())["profile"]["iterations"] == [20, 25]
    assert list(run.glob("profile/plugins/profile/*/perfetto_trace.json.gz"))
