"""Jobs of a sweep as one program, with real processes on the CPU: a failure, a kill, going on."""

from __future__ import annotations

import json
import math
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from training_jobs import POINT, STEPS, gmi_pid, kill, start, train, wait_until

import gmijax
from gmijax.learning.episode_window import WINDOW_EPISODES
from gmijax.runs.checkpoints import newest_checkpoint
from gmijax.runs.history import read_metrics

ITERATIONS = 500
"""Of jobs that are killed and stopped before their end."""

SWEEP = (*POINT, "sweep.pack=vmap", "sweep.jobs_per_gpu=4", "run.dir=all")


def states(folder: Path) -> list[str]:
    report = json.loads((folder / "all" / "sweep.json").read_text())
    return [job["state"] for job in report["jobs"]]


def lines(run: Path) -> list[dict[str, Any]]:
    return list(read_metrics(run / "metrics.jsonl"))


@pytest.mark.timeout(400)
def test_jobs_in_one_program_do_as_alone_and_fail_alone(tmp_path: Path) -> None:
    common = (f"num_timesteps={6 * STEPS}", "algo.learning_rate_schedule=fixed")
    alone = train(*POINT, *common, "seed=1", "run.dir=alone", cwd=tmp_path)
    assert alone.returncode == 0, alone.stderr
    # With such steps the parameters are soon no numbers.
    rates = "algo.learning_rate=3e-4,1e30"
    done = train(*SWEEP, *common, "seed=0,1", rates, cwd=tmp_path, command="sweep")
    assert done.returncode == 1
    assert "2 of 4 jobs failed; job 1: " in done.stderr
    assert "NonFiniteError" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert states(tmp_path) == ["completed", "failed"] * 2
    runs = [tmp_path / "all" / f"{number:03d}" for number in range(4)]
    assert (tmp_path / "all" / "jobs" / "000" / "gmi_0" / "stdout.log").exists()

    same, other = lines(tmp_path / "alone"), lines(runs[2])
    assert len(same) == len(other) == 6
    assert lines(runs[0])[0]["reward_per_step"] != other[0]["reward_per_step"]
    for mine, packed in zip(same, other, strict=True):
        assert mine.keys() == packed.keys()
        for key in ("env_steps", "reward_per_step", "loss/value_loss", "policy/noise_std"):
            assert math.isclose(mine[key], packed[key], rel_tol=1e-3), key
    summaries = [
        json.loads((run / "summary.json").read_text()) for run in (tmp_path / "alone", runs[2])
    ]
    assert summaries[0].keys() == summaries[1].keys()
    assert summaries[1]["status"] == "completed"
    policies = [gmijax.load_policy(run) for run in (tmp_path / "alone", runs[2])]
    actions = [policy(np.ones(policy.obs_size, np.float32)) for policy in policies]
    np.testing.assert_allclose(*actions, rtol=1e-3)
    found = [newest_checkpoint(run).checkpoint for run in runs]
    assert [None if one is None else int(one.name) for one in found] == [6 * STEPS, None] * 2


@pytest.mark.timeout(400)
def test_after_a_kill_and_a_stop_all_jobs_of_a_program_go_on(tmp_path: Path) -> None:
    # The first one diverges at once.
    command = (*SWEEP, "seed=0,1", "algo.learning_rate=1e30,3e-4")
    command = (*command, f"num_timesteps={ITERATIONS * STEPS}")
    command = (*command, "algo.learning_rate_schedule=fixed", "run.checkpoint_every=20")
    command = (*command, "run.max_restarts=2", "run.stop_timeout_s=1e-6")
    runs = [tmp_path / "all" / name for name in ("001", "003")]
    sweep = start(*command, cwd=tmp_path, command="sweep")

    def steps_saved() -> int:
        found = newest_checkpoint(runs[0]).checkpoint
        return 0 if found is None else int(found.name)

    wait_until(lambda: sweep.poll() is not None or steps_saved(), 200.0, "a checkpoint")
    pid = gmi_pid(tmp_path / "all" / "jobs" / "000", 0)
    assert pid is not None
    kill(pid)
    before = steps_saved()
    wait_until(
        lambda: sweep.poll() is not None or steps_saved() > before + 40 * STEPS, 200.0, "more"
    )
    sweep.send_signal(signal.SIGINT)
    assert sweep.wait(timeout=120) == 130
    assert states(tmp_path) == ["failed", "interrupted"] * 2
    assert (tmp_path / "stdout.txt").read_text().count("stopping: running jobs save and end") == 1

    done = train(*command, cwd=tmp_path, command="sweep")
    assert done.returncode == 1
    assert states(tmp_path) == ["failed", "completed"] * 2
    assert "NonFiniteError" in done.stderr
    for run in runs:
        # Windows go on where jobs do: a hundred episodes of 20 steps are there from here on.
        full = [line["window/episodes"] for line in lines(run) if line["env_steps"] > 60 * STEPS]
        assert min(full) >= WINDOW_EPISODES
        summary = json.loads((run / "summary.json").read_text())
        assert summary["status"] == "completed"
        assert [line["env_steps"] for line in lines(run)] == [
            STEPS * (number + 1) for number in range(ITERATIONS)
        ]
