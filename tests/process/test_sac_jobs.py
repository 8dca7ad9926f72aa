"""Real jobs of SAC in which one GMI acts and another one learns."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest
from toy_env import point_mass
from training_jobs import (
    FOREVER,
    POINT,
    events,
    gmi_pid,
    kill,
    pids_of,
    require_gone,
    shared_memory,
    start,
    train,
    wait_until,
)

from gmijax.learning.algorithm import saved_state
from gmijax.learning.learner import make_learner
from gmijax.runs.history import read_metrics
from gmijax.runs.resume import find_checkpoint
from gmijax.runs.saved_config import trained_config

UNROLL = 16 * 4
"""Environment steps of one unroll, after which come updates of each of its 4 steps."""

SAC = (
    *(POINT[0], "num_envs=16", "algo=sac", "algo.unroll_length=4", "algo.batch_size=32"),
    *("algo.policy_hidden_layer_sizes=[8]", "algo.critic_hidden_layer_sizes=[16]"),
    *("algo.updates_per_step=2", "algo.num_atoms=11", "algo.replay_steps=16"),
    *("algo.learning_starts=4", "run.measure_throughput=false", "run.grace_s=3"),
    *("plan.serving_gmis_per_gpu=1", "reduce.timeout_s=30"),
)

AGENT, LEARNER = 1, 0


def _updates(run: Path) -> int:
    """How many the learner of a run's last checkpoint has made."""
    checkpoint, env = find_checkpoint(str(run), "test"), point_mass()
    learner = make_learner(env.spec, trained_config(checkpoint)[1])
    return int(saved_state(checkpoint, learner, env.spec.obs_size).updates)


def _summary(run: Path) -> dict[str, Any]:
    return json.loads((run / "summary.json").read_text())


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of 100 unrolls."""
    cwd = tmp_path_factory.mktemp("apart")
    line = (f"num_timesteps={100 * UNROLL}", "run.checkpoint_every=40", "run.dir=run")
    done = train(*SAC, *line, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return cwd / "run"


@pytest.mark.timeout(300)
def test_every_step_has_its_updates_whoever_is_faster(first: Path) -> None:
    summary = _summary(first)
    assert (summary["status"], summary["env_steps"]) == ("completed", 100 * UNROLL)
    plan = summary["plan"]
    assert (plan["template"], plan["layout"]) == ("decoupled", [[0, 1]])
    assert plan["roles"] == ["trainer", "simulator+agent"]
    # The first unroll fills the replay as far as learning needs.
    assert _updates(first) == 100 * 4 * 2
    lines = read_metrics(first / "metrics.jsonl")
    assert lines[-1]["async/updates_per_step"] == 2
    assert lines[-1]["loss/critic_loss"] > 0
    names = {"time/receive_s", "time/wait_s", "replay/steps", "policy/temperature"}
    assert names <= lines[-1].keys()
    assert 0 < summary["staleness"]["mean"] < 10
    names = sorted(path.name for path in Path(summary["checkpoint"]).iterdir())
    assert names == ["episodes.json", "gmi_1", "learner", "meta.json", "policy.npz"]


@pytest.mark.timeout(300)
def test_one_program_goes_on_from_its_checkpoint(first: Path) -> None:
    """That two GMIs do, `test_a_job_goes_on_after_each_of_the_two_is_killed` shows."""
    cwd, run = first.parent, first.parent / "in_turn"
    line = (f"run.resume={first}", f"num_timesteps={120 * UNROLL}", "run.dir=in_turn")
    done = train(*line, "plan.serving_gmis_per_gpu=null", cwd=cwd)
    assert done.returncode == 0, done.stderr
    assert "the replay of 256 transitions is not in the checkpoint" in done.stdout
    summary = _summary(run)
    assert summary["plan"]["template"] == "tcg_ex"
    assert summary["env_steps"] == 120 * UNROLL
    # It learns from the fourth row on, and not only when all four are there.
    assert _updates(run) == 120 * 4 * 2 - 3 * 2


@pytest.mark.timeout(300)
def test_its_checkpoint_plays(first: Path) -> None:
    line = (f"run.dir={first}", "num_envs=4", "max_steps=40", "html=off")
    done = train(*line, cwd=first.parent, command="play")
    assert done.returncode == 0, done.stderr


def _wait_for_lines(job: subprocess.Popen[bytes], run: Path, beyond: int) -> int:
    """Waits for a line of metrics with more environment steps, and returns those of the last."""

    def steps() -> int:
        assert job.poll() is None, (run.parent / "stderr.txt").read_text()
        lines = read_metrics(run / "metrics.jsonl")
        return lines[-1]["env_steps"] if lines else 0

    wait_until(lambda: steps() > beyond, 120, f"more than {beyond} steps")
    return steps()


@pytest.mark.timeout(400)
def test_a_job_goes_on_after_each_of_the_two_is_killed(tmp_path: Path) -> None:
    run, shm = tmp_path / "run", shared_memory()
    line = (FOREVER, "run.dir=run", "run.checkpoint_every=20", "run.max_restarts=2")
    job = start(*SAC, *line, cwd=tmp_path)
    _wait_for_lines(job, run, 0)
    wait_until(lambda: list(run.glob("checkpoints/[0-9]*")), 60, "a checkpoint")
    saved = 0
    for attempt, victim in enumerate((AGENT, LEARNER), start=1):
        kill(gmi_pid(run, victim) or 0)
        wait_until(
            lambda attempt=attempt: len(events(run, "recovered")) == attempt, 90, "it goes on"
        )
        again = events(run, "start")[attempt]
        saved = int(Path(again["checkpoint"]).name)
        _wait_for_lines(job, run, saved + UNROLL)
    job.send_signal(signal.SIGINT)
    assert job.wait(timeout=90) == 130
    assert pids_of(run) == []
    summary = _summary(run)
    assert (summary["status"], len(summary["restarts"])) == ("interrupted", 2)
    assert [again["gmi"] for again in summary["restarts"]] == [AGENT, LEARNER]
    assert json.dumps(summary["restarts"]).count("SIGKILL") >= 2
    assert summary["env_steps"] > saved >= 20 * UNROLL
    assert _updates(run) == summary["env_steps"] // 16 * 2
    require_gone(shared_memory, shm)
