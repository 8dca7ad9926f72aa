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
from gmijax.learning.checkpoint_saver import CheckpointSaver
from gmijax.runs.folder import RunPaths
from gmijax.runs.resume import CheckpointMeta, newest_checkpoint


def meta(env_steps: int) -> CheckpointMeta:
    return CheckpointMeta("ant", "ppo", env_steps, 1, 8, ((8,), (8,)), "jax")


@pytest.fixture
def saver(tmp_path: Path) -> CheckpointSaver:
    return CheckpointSaver(RunPaths(tmp_path), 0, SingleRankCommunicator(), None)


def test_training_goes_on_while_a_checkpoint_is_written(
    saver: CheckpointSaver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_write, save = threading.Event(), checkpoint_saver.save_envs

    def wait_and_save(*arguments: Any) -> None:
        assert may_write.wait(60)
        save(*arguments)

    monkeypatch.setattr(checkpoint_saver, "save_envs", wait_and_save)
    envs = {"x": np.arange(3.0)}
    saver.begin(meta(10), {"w": np.ones(2)}, envs)
    envs["x"] += 1.0  # As training does with donated memory.
    assert not saver.is_written
    assert newest_checkpoint(tmp_path).checkpoint is None
    may_write.set()
    wait_until(lambda: saver.is_written, 60, "written")
    assert newest_checkpoint(tmp_path).checkpoint is None
    saver.name()
    assert not saver.is_written
    found = saver.finish()
    assert found == newest_checkpoint(tmp_path).checkpoint
    assert found is not None
    assert restore_envs(found, 0, {"x": np.zeros(3)})["x"].tolist() == [0.0, 1.0, 2.0]


def test_the_next_checkpoint_waits_for_the_one_before(
    saver: CheckpointSaver, tmp_path: Path
) -> None:
    assert saver.finish() is None
    for env_steps in (10, 20, 30):
        saver.begin(meta(env_steps), {"w": np.ones(2)}, None)
    assert saver.finish() == RunPaths(tmp_path).checkpoint(30)
    names = sorted(path.name for path in RunPaths(tmp_path).checkpoints.iterdir())
    assert [int(name) for name in names] == [10, 20, 30]


def test_what_keeps_a_checkpoint_from_being_written_is_raised(
    saver: CheckpointSaver, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint_saver, "save_learner", fail)
    saver.begin(meta(10), {"w": np.ones(2)}, None)
    with pytest.raises(OSError, match="No space left"):
        saver.finish()
    with pytest.raises(OSError, match="No space left"):
        assert saver.is_written
