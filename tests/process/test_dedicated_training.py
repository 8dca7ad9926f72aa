"""Training with trainers in GMIs of their own (`plan.template=tdg_ex`), on a tiny task."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import numpy as np
import pytest
from test_custom_task import SMALL, TASK
from training_jobs import FOREVER, iteration_of, learner_arrays, pids_of, start, train, wait_until

pytestmark = pytest.mark.timeout(600)

JOB = ("env=point.py:make", *SMALL)
APART = ("plan.gmis_per_gpu=3", "plan.template=tdg_ex")
STEPS = 2 * 16 * 4
"""Environment steps of an iteration: two GMIs, 16 environments, 4 steps."""


@pytest.fixture
def home(tmp_path: Path) -> Path:
    (tmp_path / "point.py").write_text(TASK)
    return tmp_path


def test_a_trainer_with_two_servants_learns_what_one_gmi_does(home: Path):
    steps = f"num_timesteps={5 * STEPS}"
    for overrides in ((*APART, "run.name=apart"), ("num_envs=32", "run.name=together")):
        done = train(*JOB, *overrides, steps, cwd=home)
        assert done.returncode == 0, done.stderr
    apart, together = (learner_arrays(home / "runs" / name) for name in ("apart", "together"))
    assert len(apart) == len(together)
    for ours, theirs in zip(apart, together, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-4)
    summary = json.loads((home / "runs" / "apart" / "summary.json").read_text())
    assert summary["env_steps"] == 5 * STEPS
    assert summary["plan"]["roles"] == ["trainer", "simulator+agent", "simulator+agent"]
    rollouts = json.loads((home / "runs" / "apart" / "gmi_2" / "result.json").read_text())
    assert rollouts["rollouts"] == 5


def test_trainers_of_two_gpus_stay_equal_and_a_stopped_run_goes_on(
    home: Path, request: pytest.FixtureRequest
):
    """A `ParameterMismatch` would end the job at the checkpoint."""
    two = (*JOB, "plan.gpus=2", "plan.gmis_per_gpu=2", "plan.template=tdg_ex")
    process = start(*two, FOREVER, "run.name=two", cwd=home)
    request.addfinalizer(process.kill)
    run = home / "runs" / "two"
    wait_until(lambda: iteration_of(run, 0) > 2, 240, "training")
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=90) == 130
    assert "run.resume=auto" in (home / "stderr.txt").read_text()
    assert not pids_of(run)
    summary = json.loads((run / "summary.json").read_text())
    assert summary["plan"]["strategy"] == "mpr"
    before = summary["env_steps"]
    # The environments of the servants are not saved: what follows may be any other template.
    more = (f"num_timesteps={before + STEPS}", "plan.gpus=1", "plan.template=auto")
    done = train("run.resume=runs/two", *more, "run.name=more", cwd=home)
    assert done.returncode == 0, done.stderr
    lines = (home / "runs" / "more" / "metrics.jsonl").read_text().splitlines()
    steps = [json.loads(line)["env_steps"] for line in lines]
    assert steps == [*range(STEPS, before + 1, STEPS), before + STEPS]
