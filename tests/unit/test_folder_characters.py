"""Checkpoints can be read again whatever their folder is called."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

from gmijax.errors import GmijaxError
from gmijax.learning.checkpoint import (
    LEARNER,
    finish_checkpoint,
    restore_envs,
    restore_learner,
    save_envs,
    save_learner,
)
from gmijax.runs.checkpoints import CheckpointMeta, newest_checkpoint
from gmijax.runs.folder import RunPaths

META = CheckpointMeta("ant", "ppo", 7, 1, 8, ((8,), (8,)), "jax")


@pytest.mark.parametrize(
    "name",
    ["hidden=[64,64]", "a\\b", "[", "[!a]", "a[b]/c", "gs:", "s3://x", "line\nbreak", "%5B*?{}|~"],
)
def test_what_was_saved_can_be_read(tmp_path: Path, name: str):
    run = RunPaths(tmp_path / name)
    run.root.mkdir(parents=True)
    save_learner(run, 7, {"w": jnp.arange(3.0)})
    save_envs(run, 7, 0, {"x": jnp.ones(2)})
    checkpoint = finish_checkpoint(run, META)
    assert newest_checkpoint(run.root).checkpoint == checkpoint.resolve()
    require_readable(checkpoint)
    require_readable(RunPaths(run.root.rename(tmp_path / "plain")).checkpoint(7))


def require_readable(at: Path) -> None:
    assert restore_learner(at, {"w": jnp.zeros(3)})["w"].tolist() == [0.0, 1.0, 2.0]
    assert restore_envs(at, 0, {"x": jnp.zeros(2)})["x"].tolist() == [1.0, 1.0]


def test_what_cannot_be_read_again_is_no_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    run, real = RunPaths(tmp_path), ocp.StandardCheckpointer.save

    def save(self: Any, directory: Path, *args: Any) -> None:
        real(self, directory, *args)
        self.wait_until_finished()
        (directory / "manifest.ocdbt").unlink()

    monkeypatch.setattr(ocp.StandardCheckpointer, "save", save)
    with pytest.raises(GmijaxError, match=f"{LEARNER}: cannot be read again after it was written"):
        save_learner(run, 7, {"w": np.zeros(3)})
    assert newest_checkpoint(run.root).checkpoint is None
