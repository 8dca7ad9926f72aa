"""Real asynchronous jobs in real processes, on a task that compiles in a second."""

from __future__ import annotations

import json
import re
import signal
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_lines import run as run_here
from traced_profile import PROFILED, check_profile
from training_jobs import (
    FOREVER,
    POINT,
    POINT_TASK,
    STEPS,
    gmi_pid,
    iteration_of,
    kill,
    learner_arrays,
    pids_of,
    require_gone,
    shared_memory,
    start,
    train,
    wait_until,
)

from gmijax.a3c.report import MAX_COUNTED
from gmijax.learning.episode_window import WINDOW_EPISODES
from gmijax.runs.history import read_metrics
from gmijax.runs.resume import find_checkpoint

UPDATE = STEPS
"""Environment steps of one batch of one trainer."""

SMALL = (*POINT, "algo=a3c", "reduce.timeout_s=30")


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def two_and_two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two agents and two trainers, 150 updates, of which two are traced."""
    cwd = tmp_path_factory.mktemp("async")
    done = train(
        *SMALL, "env.history=2", "plan.serving_gmis_per_gpu=2", "plan.training_gmis_per_gpu=2",
        f"num_timesteps={150 * 2 * UPDATE}", "run.checkpoint_every=50", "run.dir=run",
        "run.profile=2:3", cwd=cwd,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.search(PROFILED, done.stdout)
    return cwd / "run"


@pytest.mark.timeout(300)
def test_what_a_job_leaves_has_the_figures_of_the_paper(two_and_two: Path) -> None:
    summary = _read(two_and_two / "summary.json")
    assert (summary["status"], summary["algo"]) == ("completed", "a3c")
    # Unrolls that were too old do not count: a few updates more may have been needed.
    assert 0 <= summary["env_steps"] - 150 * 2 * UPDATE < 2 * UPDATE
    plan = summary["plan"]
    assert (plan["template"], plan["strategy"], plan["layout"]) == (
        "decoupled",
        "mpr",
        [[0, 1, 2, 3]],
    )
    assert plan["roles"] == ["trainer"] * 2 + ["simulator+agent"] * 2
    assert summary["pps"] > 0
    assert summary["ttop"] > 0
    assert 0 <= summary["staleness"]["mean"] <= summary["staleness"]["p99"] <= MAX_COUNTED
    lines = [json.loads(text) for text in (two_and_two / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["env_steps"] == summary["env_steps"]
    assert {
        *("async/pps", "async/ttop", "async/staleness_mean", "async/staleness_p99"),
        *("channel/occupancy", "channel/bytes_per_s", "time/receive_s"),
        *("loss/behaviour_kl", "return", "policy/learning_rate"),
    } <= lines[-1].keys()
    # What was acted upon was learnt from, is too old, or still on its way.
    agents = [_read(two_and_two / f"gmi_{gmi}" / "result.json") for gmi in (2, 3)]
    acted = sum(result["env_steps"] for result in agents)
    assert acted >= lines[-1]["env_steps"]
    # Every agent has added its environments.
    checkpoint = find_checkpoint(str(two_and_two), "test")
    assert str(checkpoint) == summary["checkpoint"]
    names = sorted(path.name for path in checkpoint.iterdir())
    assert names == ["episodes.json", "gmi_2", "gmi_3", "learner", "meta.json", "policy.npz"]


def test_iterations_of_a_trainer_are_traced_for_a_profile(two_and_two: Path) -> None:
    check_profile(two_and_two)


@pytest.mark.timeout(300)
def test_its_checkpoint_plays(two_and_two: Path) -> None:
    """For a seed always the same: tests/unit/test_play_episodes.py."""
    wanted = ("num_envs=4", "max_steps=40", "deterministic=false", "seed=1")
    folder = two_and_two / "play" / find_checkpoint(str(two_and_two), "test").name
    done = train(
        *(f"run.dir={two_and_two}", *wanted, "html=off"),
        cwd=two_and_two.parent,
        command="play",
    )
    assert done.returncode == 0, done.stderr
    returns = _read(folder / "returns.json")
    assert f"returns: {(folder / 'returns.json').relative_to(two_and_two.parent)}" in done.stdout
    assert "effort" in done.stdout
    assert "point_mass has no model that could be filmed" in done.stdout
    assert returns["env_steps"] == int(folder.name)
    assert len(returns["episodes"]) == returns["num_envs"] == 4
    mean = sum(item["return"] for item in returns["episodes"]) / 4
    assert returns["return"]["mean"] == pytest.approx(mean, rel=1e-5)
    assert f"{mean:.2f}" in done.stdout
    for item in returns["episodes"]:
        assert not (item["terminated"] and item["truncated"])
        assert item["return"] == pytest.approx(sum(item["terms"].values()), rel=1e-4)
    assert not {"video.mp4", "view.html"} & {path.name for path in folder.iterdir()}


def wait_for_updates(job: subprocess.Popen[bytes], run: Path, gmis: Iterable[int]) -> None:
    def is_there() -> bool:
        return job.poll() is not None or all(iteration_of(run, gmi) for gmi in gmis)

    wait_until(is_there, 120, "updates")
    assert job.poll() is None, (run.parent / "stderr.txt").read_text()


@pytest.mark.timeout(300)
def test_a_job_goes_on_from_its_checkpoint_until_an_agent_is_killed_and_named(
    two_and_two: Path,
) -> None:
    cwd, before = two_and_two.parent, _read(two_and_two / "summary.json")["env_steps"]
    run, shm, victim = cwd / "on", shared_memory(), 2
    job = start(
        *(f"run.resume={two_and_two}", "run.dir=on", "run.checkpoint_every=10", FOREVER),
        cwd=cwd,
    )
    wait_for_updates(job, run, (0, victim))
    wait_until(
        lambda: job.poll() is not None or list(run.glob("checkpoints/[0-9]*")), 120, "a checkpoint"
    )
    # A line comes once in half a second, a checkpoint may come before it.
    history = read_metrics(two_and_two / "metrics.jsonl")
    wait_until(
        lambda: job.poll() is not None or len(read_metrics(run / "metrics.jsonl")) > len(history),
        120,
        "a line of its own",
    )
    assert job.poll() is None, (cwd / "stderr.txt").read_text()
    kill(gmi_pid(run, victim) or 0)
    assert job.wait(timeout=90) == 1
    assert pids_of(run) == []
    error = (cwd / "stderr.txt").read_text()
    assert f"GMI {victim} failed" in error
    assert "SIGKILL" in error
    require_gone(shared_memory, shm)
    old, new = learner_arrays(two_and_two), learner_arrays(run)
    assert [a.shape for a in old] == [a.shape for a in new]
    assert not all(np.array_equal(a, b) for a, b in zip(old, new, strict=True))
    lines = read_metrics(run / "metrics.jsonl")
    assert lines[: len(history)] == history
    assert all(line["env_steps"] > before for line in lines[len(history) :])
    kept = _read(find_checkpoint(str(two_and_two), "test") / "episodes.json")
    episodes = sum(one["count"] for one in kept["ended"])
    assert episodes == history[-1]["window/episodes"]  # The last line is in the last checkpoint.
    assert lines[len(history)]["window/episodes"] >= min(episodes, WINDOW_EPISODES)


@pytest.mark.timeout(300)
def test_an_interrupt_saves_the_whole_job(tmp_path: Path) -> None:
    """Of trainers on several GPUs, which reduce in rings; experience travels tensor by tensor."""
    cwd = tmp_path
    run = cwd / "run"
    job = start(
        *(*SMALL, FOREVER, "run.dir=run", "plan.serving_gpus=[0,1]", "plan.training_gpus=[0,1]"),
        *("reduce.strategy=har", "channel.design=uni", "run.stop_timeout_s=1e-6"),
        cwd=cwd,
    )
    wait_for_updates(job, run, range(4))
    job.send_signal(signal.SIGINT)
    assert job.wait(timeout=90) == 130
    assert pids_of(run) == []
    summary = _read(run / "summary.json")
    assert summary["status"] == "interrupted"
    plan = summary["plan"]
    assert (plan["layout"], plan["strategy"]) == ([[0, 2], [1, 3]], "har")
    saved = find_checkpoint(str(run), "test")
    assert all((saved / name).is_dir() for name in ("learner", "gmi_2", "gmi_3"))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("plan.training_gmis_per_gpu=0",), "plan.training_gmis_per_gpu=0"),
        (("plan.serving_gpus=0", "plan.training_gpus=1"), "plan.serving_gpus=0"),
        (("channel.capacity_mib=100000000",), "channel.capacity_mib=100000000"),
        (("algo.batch_size=24",), "algo.batch_size=24"),
        (("algo.num_minibatches=3",), "algo.num_minibatches=3"),
        (("plan.template=tcg_ex",), "plan.template=tcg_ex"),
        (("channel.transport=device",), "channel.transport=device: CUDA IPC needs an NVIDIA GPU"),
        (("plan.training_gmis_per_gpu=2", "reduce.strategy=mrr"), "reduce.strategy=mrr"),
    ],
)
def test_bad_input_starts_nothing(
    tmp_path: Path, overrides: tuple[str, ...], message: str
) -> None:
    (tmp_path / "point.py").write_text(POINT_TASK)
    done = run_here("train", *SMALL, *overrides, "run.dir=run", cwd=tmp_path)
    assert done.code == 2, done.stderr
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
