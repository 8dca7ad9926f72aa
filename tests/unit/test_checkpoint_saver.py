"""Checkpoints that are written beside the training."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from training_jobs import wait_until

from gmijax.collectives.communicator import SingleRankCommunicator
from gmijax.learning import checkpoint_saver
from gmijax.learning.checkpoint import restore_envs
from gmijax.learning.checkpoint_saver import CheckpointPart, CheckpointSaver
from gmijax.runs.checkpoints import CheckpointMeta, newest_checkpoint
from gmijax.runs.folder import RunPaths


def part(folder: Path, env_steps: int, envs: Any = None) -> CheckpointPart:
    meta = CheckpointMeta("ant", "ppo", env_steps, 1, 8, ((8,), (8,)), "jax")
    return CheckpointPart(RunPaths(folder), meta, {"w": np.ones(2)}, envs)


@pytest.fixture
def saver() -> CheckpointSaver:
    return CheckpointSaver(0, SingleRankCommunicator(), None)


def test_training_goes_on_while_a_checkpoint_is_written(
    saver: CheckpointSaver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_write, save = threading.Event(), checkpoint_saver.save_envs

    def wait_and_save(*arguments: Any) -> None:
        assert may_write.wait(60)
        save(*arguments)

    monkeypatch.setattr(checkpoint_saver, "save_envs", wait_and_save)
    saver.begin([part(tmp_path, 10, {"x": np.arange(3.0)})])
    assert not saver.is_written
    assert newest_checkpoint(tmp_path).checkpoint is None
    may_write.set()
    wait_until(lambda: saver.is_written, 60, "written")
    assert newest_checkpoint(tmp_path).checkpoint is None
    saver.name()
    assert not saver.is_written
    saver.finish()
    assert saver.last_steps == 10
    found = newest_checkpoint(tmp_path).checkpoint
    assert found is not None
    assert restore_envs(found, 0, {"x": np.zeros(3)})["x"].tolist() == [0.0, 1.0, 2.0]


def test_the_next_checkpoint_waits_for_the_one_before(
    saver: CheckpointSaver, tmp_path: Path
) -> None:
    saver.finish()
    assert saver.last_steps is None
    for env_steps in (10, 20, 30):
        saver.begin([part(tmp_path, env_steps)])
    saver.finish()
    assert saver.last_steps == 30
    names = sorted(path.name for path in RunPaths(tmp_path).checkpoints.iterdir())
    assert [int(name) for name in names] == [10, 20, 30]


def test_what_keeps_a_checkpoint_from_being_written_is_raised(
    saver: CheckpointSaver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint_saver, "save_learner", fail)
    saver.begin([part(tmp_path, 10)])
    with pytest.raises(OSError, match="No space left"):
        saver.finish()
    with pytest.raises(OSError, match="No space left"):
        assert saver.is_written


def test_several_runs_get_their_checkpoints_together(
    saver: CheckpointSaver, tmp_path: Path
) -> None:
    folders = [tmp_path / name for name in "ab"]
    for folder in folders:
        folder.mkdir()
    saver.begin([part(folder, 10) for folder in folders])
    saver.finish()
    assert all(newest_checkpoint(folder).checkpoint is not None for folder in folders)
