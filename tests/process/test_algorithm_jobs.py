"""Jobs of the algorithms beside PPO and A3C: several GMIs, checkpoints, another start."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_lines import run as run_here
from training_jobs import POINT, learner_arrays, train

from gmijax.runs.checkpoints import what_is_broken

BASE = (
    *(POINT[0], "num_envs=16", "algo.unroll_length=4", "algo.policy_hidden_layer_sizes=[8]"),
    *("run.grace_s=3", "run.max_restarts=0"),
)

SAC = (
    *("algo=sac", "algo.batch_size=32", "algo.updates_per_step=1"),
    *("algo.critic_hidden_layer_sizes=[16]", "algo.num_atoms=11", "algo.replay_steps=16"),
    "algo.learning_starts=4",
)
SAVING = (
    *(*BASE, *SAC, "plan.gpus=2", "run.checkpoint_every=2", "algo.save_replay=true"),
    *("algo.replay_precision=float16", "algo.n_step=2"),
)


@pytest.mark.timeout(300)
def test_a_student_keeps_its_teacher_and_goes_on(tmp_path: Path) -> None:
    done = train(*POINT, "num_timesteps=640", "run.dir=runs/teacher", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    begun = tmp_path / "runs" / "begun"  # Later, and nothing is saved of it.
    begun.mkdir()
    for name in ("config.json", "plan.json"):
        shutil.copy(tmp_path / "runs" / "teacher" / name, begun)
    line = ("algo=distill", "algo.teacher=last", "plan.gpus=2", "num_timesteps=1024")
    done = train(*BASE, *line, "run.dir=runs/student", "run.checkpoint_every=2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "algo.teacher: last is runs/teacher; newer, but passed over: runs/begun" in done.stdout
    student = tmp_path / "runs" / "student"
    teacher = json.loads((student / "config.json").read_text())["algo"]["teacher"]
    assert Path(teacher).parent == tmp_path / "runs" / "teacher" / "checkpoints"
    # By now the newest run is the student's own.
    half = sorted((student / "checkpoints").iterdir())[0]
    done = train(f"run.resume={half}", "run.dir=runs/again", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    again = learner_arrays(tmp_path / "runs" / "again")
    for array, other in zip(again, learner_arrays(student), strict=True):
        np.testing.assert_array_equal(array, other)
    refused = run_here("train", *BASE, "algo=distill", "algo.teacher=runs/nobody", cwd=tmp_path)
    assert refused.code == 2
    assert "algo.teacher=runs/nobody: no such folder" in refused.stderr


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two GMIs that have learnt by SAC without a stop; the last checkpoint has their replays."""
    cwd = tmp_path_factory.mktemp("sac")
    done = train(*SAVING, "run.dir=whole", "num_timesteps=1024", cwd=cwd)
    assert done.returncode == 0, done.stderr
    assert "the replay of" not in done.stdout
    check_replays(cwd / "whole")
    return cwd / "whole"


def check_replays(run: Path) -> None:
    checkpoints = sorted((run / "checkpoints").iterdir())
    assert len(checkpoints) > 2
    replays = [path.name for one in checkpoints for path in one.glob("replay_*")]
    # Those of the end alone, also where another one came before.
    assert sorted(replays) == ["replay_0", "replay_1"]
    assert len(list(checkpoints[-1].glob("replay_*"))) == 2
    assert all(what_is_broken(one) is None for one in checkpoints)


def metrics_of(run: Path) -> list[dict[str, Any]]:
    return [json.loads(text) for text in (run / "metrics.jsonl").read_text().splitlines()]


@pytest.mark.timeout(300)
def test_two_gmis_learn_by_sac_and_fill_the_replay_anew_when_they_go_on(whole: Path) -> None:
    half, plain = sorted((whole / "checkpoints").iterdir())[0], whole.parent / "plain"
    # What is not in a checkpoint may be kept otherwise from there on.
    other = ("algo.save_replay=false", "algo.replay_precision=float32", "algo.n_step=1")
    done = train(f"run.resume={half}", *other, "run.dir=plain", cwd=whole.parent)
    assert done.returncode == 0, done.stderr
    assert "the replay of 256 transitions is not in the checkpoint" in done.stdout
    for run, first in ((whole, 0), (plain, 2)):
        lines = metrics_of(run)
        assert lines[-1]["env_steps"] == 1024
        assert lines[-1]["loss/critic_loss"] > 0
        assert lines[first]["replay/steps"] == 4.0
    assert not list(plain.glob("checkpoints/*/replay_*"))


@pytest.mark.timeout(300)
def test_a_replay_that_is_saved_goes_on_with_its_run(whole: Path) -> None:
    cwd = whole.parent
    for auto, last in (((), 640), (("run.resume=auto",), 1024)):
        done = train(*SAVING, *auto, "run.dir=again", f"num_timesteps={last}", cwd=cwd)
        assert done.returncode == 0, done.stderr
        assert "the replay of" not in done.stdout
        check_replays(cwd / "again")
    again = learner_arrays(cwd / "again")
    for array, other in zip(again, learner_arrays(whole), strict=True):
        np.testing.assert_array_equal(array, other)


@pytest.mark.timeout(300)
def test_a_replay_that_does_not_fit_is_refused(whole: Path) -> None:
    """Another one than the checkpoint's, and one that is larger than the memory."""
    saved, most = sorted((whole / "checkpoints").iterdir())[-1], 16_000_000_000
    resumed = (f"run.resume={saved}", "run.dir=bad", "num_timesteps=2048")
    for other in ("algo.replay_steps=32", "algo.replay_precision=float32"):
        refused = run_here("train", *resumed, other, cwd=whole.parent)
        assert refused.code == 2
        assert f"{other}: the replay in the checkpoint" in refused.stderr
    # Only a GMI knows how large its memory is.
    line = (*BASE, *SAC, "run.dir=big", f"algo.replay_steps={most}")
    done = train(*line, cwd=whole.parent)
    assert done.returncode == 2
    assert f"{most} steps of each (algo." in done.stderr
    assert len(done.stderr.splitlines()) == 1
