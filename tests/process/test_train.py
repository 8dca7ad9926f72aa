"""Real training jobs in real processes."""

from __future__ import annotations

import json
import random
import re
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from traced_profile import PROFILED, check_profile
from training_jobs import (
    FOREVER,
    POINT,
    POINT_TASK,
    STEPS,
    events,
    gmi_pid,
    iteration_of,
    kill,
    kill_somebody,
    learner_arrays,
    mps_directories,
    pids_of,
    require_gone,
    shared_memory,
    start,
    train,
    wait_until,
)

from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.history import read_metrics
from gmijax.runs.resume import find_checkpoint


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


# With a single minibatch the order of samples does not matter, so that one GMI with all of the
# environments sees the same ones.
SAME = ("algo.num_minibatches=1", "algo.num_updates_per_batch=3", f"num_timesteps={6 * 2 * STEPS}")


@pytest.fixture(scope="module")
def two_gmis(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six iterations of two GMIs, of which two are traced; MUJOCO_GL names what is not there."""
    cwd = tmp_path_factory.mktemp("two")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MUJOCO_GL", "missing")
        done = train(
            *POINT, *SAME, "plan.gmis_per_gpu=2", "run.dir=run", "run.profile=2:3",
            "run.measure_throughput=true", "run.checkpoint_every=3", "-v", cwd=cwd,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "strategy mpr" in done.stdout
    assert re.search(PROFILED, done.stdout)
    return cwd / "run"


@pytest.mark.timeout(300)
def test_two_gmis_leave_every_file_of_the_contract(two_gmis: Path) -> None:
    for name in ("config.json", "plan.json", "summary.json", "metrics.jsonl"):
        assert (two_gmis / name).is_file(), name
    assert any((two_gmis / "tensorboard").iterdir())
    assert sorted(p.name for p in (two_gmis / "checkpoints").iterdir()) == [
        f"{3 * 2 * STEPS:012d}",
        f"{6 * 2 * STEPS:012d}",
    ]
    for gmi in range(2):
        assert (two_gmis / f"gmi_{gmi}" / "stdout.log").is_file()
        assert (two_gmis / f"gmi_{gmi}" / "stderr.log").is_file()
        assert not (two_gmis / f"gmi_{gmi}" / "error.json").exists()


def test_the_summary_says_what_was_done(two_gmis: Path) -> None:
    summary = _read(two_gmis / "summary.json")
    assert (summary["status"], summary["env"]) == ("completed", "point.py:make")
    assert summary["env_steps"] == 6 * 2 * STEPS
    wanted = {
        "backend": "cpu",
        "layout": [[0, 1]],
        "num_envs_per_gmi": 16,
        "intra": "host",
        "template": "tcg_ex",
        "roles": ["simulator+agent+trainer"] * 2,
    }
    assert {key: summary["plan"][key] for key in wanted} == wanted
    assert Path(summary["checkpoint"]).is_dir()
    assert summary["versions"]["jax"]
    assert all(summary[f"step_per_s_{kind}"] > 0 for kind in ("sim", "inference", "train"))


def test_there_is_a_line_of_metrics_per_iteration(two_gmis: Path) -> None:
    lines = [json.loads(text) for text in (two_gmis / "metrics.jsonl").read_text().splitlines()]
    assert [line["env_steps"] for line in lines] == [k * 2 * STEPS for k in range(1, 7)]
    assert {"return", "env_steps_per_s", "loss/kl", "policy/learning_rate"} <= lines[-1].keys()


@pytest.mark.timeout(300)
def test_two_gmis_compute_what_one_process_with_all_environments_does(two_gmis: Path) -> None:
    done = train(*POINT, *SAME, "num_envs=32", "run.dir=one", "-v", cwd=two_gmis.parent)
    assert done.returncode == 0, done.stderr
    assert "Algorithm 1 says mpr" not in done.stdout
    one = learner_arrays(two_gmis.parent / "one")
    for both, alone in zip(learner_arrays(two_gmis), one, strict=True):
        # Eighteen updates of Adam at 3e-4: a wrong gradient would move parameters by 5e-3.
        np.testing.assert_allclose(both, alone, rtol=2e-3, atol=2e-4)


@pytest.mark.timeout(300)
def test_a_resumed_run_logs_what_one_that_was_not_stopped_does(tmp_path: Path) -> None:
    line = (*POINT, f"num_timesteps={24 * STEPS}", "run.checkpoint_every=12")
    done = train(*line, "run.dir=whole", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # What it would have left, had it been killed between its last line and its last checkpoint.
    shutil.copytree(tmp_path / "whole", tmp_path / "parts")
    shutil.rmtree(tmp_path / "parts" / "checkpoints" / f"{24 * STEPS:012d}")
    (tmp_path / "parts" / "summary.json").unlink()
    done = train(*line, "run.dir=parts", "run.resume=auto", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    starts = [event["checkpoint"] for event in events(tmp_path / "parts", "start")]
    assert starts == [None, str(tmp_path / "parts" / "checkpoints" / f"{12 * STEPS:012d}")]
    one, other = (read_metrics(tmp_path / name / "metrics.jsonl") for name in ("whole", "parts"))
    assert len(one) == len(other) == 24
    for mine, theirs in zip(one, other, strict=True):
        for key in (
            "return",
            "window/return",
            "window/episodes",
            "reward/near",
            "loss/value_loss",
        ):
            assert mine.get(key) == theirs.get(key), key
    assert one[11]["return"] is not None  # There is something to go on with.
    meta = CheckpointMeta.read(find_checkpoint(str(tmp_path / "parts"), "test"))
    assert meta.mean_return == one[-1]["window/return"]
    assert meta.window_full == bool(one[-1]["window/full"])


@pytest.mark.timeout(300)
def test_an_interrupt_saves_and_stops_everything(tmp_path: Path) -> None:
    run = tmp_path / "run"
    # That is the time after other signals.
    command = (*POINT, FOREVER, "plan.gpus=2", "run.stop_timeout_s=1e-6")
    job = start(*command, "run.dir=run", cwd=tmp_path)
    wait_until(lambda: iteration_of(run, 1) >= 2, 120, "two iterations")
    job.send_signal(signal.SIGINT)
    assert job.wait(timeout=90) == 130
    assert (
        "finishing the iterations that have begun, then saving"
        in (tmp_path / "stdout.txt").read_text()
    )
    assert pids_of(run) == []
    assert _read(run / "summary.json")["status"] == "interrupted"
    checkpoint = find_checkpoint(str(run), "test")
    assert (checkpoint / "gmi_0").is_dir()
    assert (checkpoint / "gmi_1").is_dir()
    assert "run.resume=" in (tmp_path / "stderr.txt").read_text()


@pytest.mark.timeout(300)
def test_a_killed_gmi_ends_the_job_and_is_named(tmp_path: Path) -> None:
    run = tmp_path / "run"
    job = start(
        *POINT, FOREVER, "plan.gpus=2", "run.dir=run", "run.checkpoint_every=2", cwd=tmp_path
    )
    wait_until(lambda: any(run.glob("checkpoints/[0-9]*")), 120, "a checkpoint")
    pid = gmi_pid(run, 1)
    assert pid is not None
    kill(pid)
    assert job.wait(timeout=90) == 1
    assert pids_of(run) == []
    errors = (tmp_path / "stderr.txt").read_text().strip().splitlines()
    assert "GMI 1" in errors[0]
    assert "SIGKILL" in errors[0]
    assert "run folder: run" in errors[0]
    # What was saved before the fault is still whole, and there is no half of another one.
    assert find_checkpoint(str(run), "test").is_dir()
    assert _read(run / "summary.json")["status"] == "failed"


@pytest.mark.timeout(300)
def test_a_run_that_starts_again_is_not_traced_again(tmp_path: Path) -> None:
    """The tracer may be what failed."""
    run = tmp_path / "run"
    again = ("run.profile=2:3", "run.checkpoint_every=2", "run.max_restarts=1")
    job = start(*POINT, FOREVER, *again, "run.dir=run", cwd=tmp_path)
    wait_until(lambda: any(run.glob("checkpoints/[0-9]*")), 120, "a checkpoint")
    pid = gmi_pid(run, 0)
    assert pid is not None
    kill(pid)
    wait_until(lambda: bool(events(run, "recovered")), 120, "a recovery")
    job.send_signal(signal.SIGINT)
    assert job.wait(timeout=90) == 130
    message = "run.profile=2:3: not traced again; what there is, is in run/profile"
    assert message in (tmp_path / "stdout.txt").read_text()
    assert len(list(run.glob("profile/plugins/profile/*"))) == 1
    assert "profile" not in _read(run / "summary.json")


@pytest.mark.timeout(400)
@pytest.mark.parametrize(
    "plan",
    [
        ("plan.gmis_per_gpu=2",),
        # Also while GMIs connect, when a library would rather end them by itself.
        ("plan.gpus=2", "reduce.strategy=mrr"),
    ],
    ids=["memory", "rings"],
)
def test_kills_at_any_moment_leave_nothing(plan: tuple[str, ...], tmp_path: Path) -> None:
    """Also while starting and compiling, GMIs and controller alike."""
    draw = random.Random(plan[0])
    shm, pipes = shared_memory(), mps_directories()
    for number in range(2):
        kill_somebody(*plan, cwd=tmp_path / str(number), draw=draw, within_s=(0.3, 7.0))
    require_gone(shared_memory, shm)
    require_gone(mps_directories, pipes)


def test_iterations_of_the_leader_are_traced_for_a_profile(two_gmis: Path) -> None:
    check_profile(two_gmis)


AS_ON_GPUS = (
    POINT_TASK
    + """
from fake_device_memory import FAKES
from gmijax.collectives import communicator

communicator.DEVICE = lambda: FAKES["fake"]
"""
)
"""The task, in processes whose GMIs run steps of all as those on GPUs do."""


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "options",
    [
        ("plan.gpus=2", f"num_timesteps={5 * 2 * STEPS}"),
        (
            *("algo=a3c", "plan.gpus=3", "plan.serving_gpus=[0]", "plan.training_gpus=[1,2]"),
            f"num_timesteps={12 * 2 * STEPS}",
        ),
    ],
    ids=["ppo", "a3c"],
)
def test_iterations_of_one_of_two_trainers_are_traced_for_a_profile(
    options: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "point.py").write_text(AS_ON_GPUS)
    way = ("reduce.strategy=flat", "reduce.timeout_s=20", "run.profile=2:3", "run.dir=run")
    done = train(*POINT, *options, *way, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.search(PROFILED, done.stdout)
    check_profile(tmp_path / "run")
