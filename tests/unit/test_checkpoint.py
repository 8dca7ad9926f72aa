"""Checkpoints that cannot be used are refused in one line."""

from __future__ import annotations

import math
import os
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

from gmijax.cli.compose import compose
from gmijax.errors import ConfigError
from gmijax.learning.checkpoint import (
    finish_checkpoint,
    restore_envs,
    restore_learner,
    save_envs,
    save_learner,
)
from gmijax.learning.learner import TrainState, learner_shapes
from gmijax.learning.saved_arrays import on_host
from gmijax.runs.checkpoints import CheckpointMeta, newest_checkpoint
from gmijax.runs.folder import RunPaths
from gmijax.runs.ranking import best_checkpoint, best_evaluation
from gmijax.sim.interface import EnvSpec


def restore_with(error: Exception, monkeypatch: pytest.MonkeyPatch, at: Path) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(ocp.StandardCheckpointer, "restore", fail)
    restore_learner(at, {"a": jnp.zeros(2)})


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ValueError("trees differ:\nhere\nthere"), "trees differ:"),
        (ValueError(), "ValueError"),
        (KeyError("a"), "'a'"),
        (FileNotFoundError("gone"), "gone"),
        # What orbax raises for an array whose file was cut off.
        (Exception("Encountered error while reading"), "Encountered error while reading"),
    ],
)
def test_checkpoint_that_does_not_fit_is_bad_input(
    error: Exception, message: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    with pytest.raises(
        ConfigError, match=rf"^checkpoint {tmp_path}/learner does not fit this job: {message}$"
    ):
        restore_with(error, monkeypatch, tmp_path)


def test_failure_of_the_device_is_not_the_checkpoints(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    with pytest.raises(RuntimeError, match="RESOURCE_EXHAUSTED"):
        restore_with(RuntimeError("RESOURCE_EXHAUSTED"), monkeypatch, tmp_path)


def test_a_policy_from_before_averages_goes_on_learning(tmp_path: Path):
    run = RunPaths(tmp_path)
    save_learner(run, 1, {"params": {"w": jnp.arange(3.0)}, "targets": jnp.ones(2)})
    old = finish_checkpoint(run, CheckpointMeta("ant", "sac", 1, 1, 8, ((8,), (8,)), "jax"))
    like = {"params": {"w": jnp.zeros(3)}, "targets": jnp.zeros(2), "live": {"w": jnp.zeros(3)}}
    found = restore_learner(old, like)
    assert found["live"]["w"].tolist() == found["params"]["w"].tolist() == [0.0, 1.0, 2.0]
    with pytest.raises(ConfigError, match=r"its live.w is \[3\], that of this job \[4\]"):
        restore_learner(old, like | {"live": {"w": jnp.zeros(4)}})
    with pytest.raises(ConfigError, match=r"it has no live.x, this job has$"):
        restore_learner(old, like | {"live": {"x": jnp.zeros(3), "w": jnp.zeros(3)}})


class Before(NamedTuple):
    weights: Any
    moments: Any


class Now(NamedTuple):
    weights: Any
    moments: Any
    more: Any = None


def test_a_checkpoint_from_before_a_field_fits_where_the_field_is_not_used(tmp_path: Path):
    run = RunPaths(tmp_path)
    known = Before({"w": jnp.arange(3.0)}, (jnp.ones(()), jnp.zeros(2)))
    like = Now({"w": jnp.zeros(3)}, (jnp.zeros(()), jnp.zeros(2)))

    def saved(env_steps: int, state: Any) -> Path:
        save_learner(run, env_steps, state)
        meta = CheckpointMeta("ant", "ppo", env_steps, 1, 8, ((8,), (8,)), "jax")
        return finish_checkpoint(run, meta)

    old = saved(1, known)
    new = saved(2, Now(known.weights, known.moments, jnp.full(2, 7.0)))
    found = restore_learner(old, like)
    assert found.more is None
    jax.tree.map(np.testing.assert_array_equal, tuple(found)[:2], tuple(known))
    assert restore_learner(new, like._replace(more=jnp.zeros(2))).more.tolist() == [7.0, 7.0]
    with pytest.raises(ConfigError, match=r"does not fit this job: it has no more, this job has$"):
        restore_learner(old, like._replace(more=jnp.zeros(2)))


def test_environments_from_before_a_part_of_their_state_fit_where_it_is_not_used(tmp_path: Path):
    run = RunPaths(tmp_path)
    known = Before(jnp.arange(3), jax.random.split(jax.random.key(1), 2))
    save_envs(run, 1, 0, {"physics": known})
    meta = CheckpointMeta("ant", "ppo", 1, 1, 8, ((8,), (8,)), "jax")
    old = finish_checkpoint(run, meta)
    like = Now(jnp.zeros(3, jnp.int32), jax.random.split(jax.random.key(0), 2))
    found = restore_envs(old, 0, {"physics": like})["physics"]
    assert found.more is None
    chex.assert_trees_all_equal(on_host(tuple(found)[:2]), on_host(tuple(known)))
    with pytest.raises(ConfigError, match=r"it has no physics.more, this job has$"):
        restore_envs(old, 0, {"physics": like._replace(more=jnp.zeros(2))})


def zeros(width: int) -> TrainState:
    """A state whose networks have one layer of so many units; nothing is computed."""
    widths = (f"algo.{net}_hidden_layer_sizes=[{width}]" for net in ("policy", "value"))
    spec = EnvSpec("point", 3, 2, 0.1, 10, (), actor_obs_size=3)
    shapes = learner_shapes(spec, compose("env=ant", *widths).algo)
    arrays = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes._replace(key=()))
    return arrays._replace(key=jax.random.key(0))


def test_a_checkpoint_of_other_networks_says_what_does_not_fit(tmp_path: Path):
    run = RunPaths(tmp_path)
    save_learner(run, 1, zeros(4))
    meta = CheckpointMeta("point", "ppo", 1, 1, 8, ((4,), (4,)), "jax")
    saved = finish_checkpoint(run, meta)
    with pytest.raises(ConfigError, match=r"its opt_state.1.mu is \[\d+\], that of this job \["):
        restore_learner(saved, zeros(5))


def save(
    run: RunPaths,
    env_steps: int,
    mean_return: float | None,
    keep: int | None,
    eval_return: float | None = None,
) -> Path:
    folder = run.checkpoints / f".{env_steps:012d}.partial" / "learner"
    folder.mkdir(parents=True)
    (folder / "weights").write_bytes(b"0123456789")
    of_run = ("ant", "ppo", env_steps, 1, 8, ((8,), (8,)), "jax")
    meta = CheckpointMeta(*of_run, mean_return, eval_return)
    return finish_checkpoint(run, meta, keep)


def test_a_checkpoint_lists_its_files_and_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    run = RunPaths(tmp_path)
    synced: list[str] = []
    real_sync, real_replace = os.fsync, os.replace

    def fsync(fd: int) -> None:
        synced.append(os.readlink(f"/proc/self/fd/{fd}"))
        real_sync(fd)

    def replace(source: object, target: object) -> None:
        if Path(str(target)) == run.checkpoint(100):
            partial = Path(str(source))
            wanted = {partial, partial / "learner", partial / "learner" / "weights"}
            assert {str(path) for path in wanted} <= set(synced)
        real_replace(str(source), str(target))

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    checkpoint = save(run, 100, None, None)
    assert synced[-1] == str(run.checkpoints)  # The name itself.
    meta = CheckpointMeta.read(checkpoint)
    assert meta.files == {"learner/weights": (10, zlib.crc32(b"0123456789"))}
    assert newest_checkpoint(run.root) == (checkpoint.resolve(), ())


UNEVEN = (None, 9.0, 1.0, -3.0, None, 2.0)


@pytest.mark.parametrize(
    ("returns", "keep", "left"),
    [
        (UNEVEN, None, [1, 2, 3, 4, 5, 6]),
        (UNEVEN, 5, [2, 3, 4, 5, 6]),
        (UNEVEN, 3, [2, 5, 6]),
        (UNEVEN, 2, [2, 6]),
        (UNEVEN, 1, [2, 6]),
        ((1.0, 2.0, 3.0), 1, [3]),  # The last is the best.
    ],
)
def test_the_last_and_the_best_checkpoint_stay(
    tmp_path: Path, returns: tuple[float | None, ...], keep: int | None, left: list[int]
):
    run = RunPaths(tmp_path)
    for env_steps, mean in enumerate(returns, start=1):
        save(run, env_steps, mean, keep)
    assert sorted(int(path.name) for path in run.checkpoints.iterdir()) == left


def test_the_best_in_an_evaluation_stays_and_is_known_again(tmp_path: Path):
    run = RunPaths(tmp_path)
    assert best_checkpoint(run.root) is None
    save(run, 1, 9.0, 2)
    assert best_checkpoint(run.root) == run.checkpoint(1)  # While there is no evaluation.
    for env_steps, evaluated in ((2, 3.0), (3, 5.0), (4, None), (5, 4.0), (6, None), (7, 4.0)):
        save(run, env_steps, float(-env_steps), 2, evaluated)
    assert sorted(int(path.name) for path in run.checkpoints.iterdir()) == [3, 7]
    assert best_checkpoint(run.root) == run.checkpoint(3)
    assert best_evaluation(run.root, 7) == 5.0
    # What a restart has not reached again does not count.
    assert best_evaluation(run.root, 2) == -math.inf
    (run.checkpoint(3) / "learner" / "weights").write_bytes(b"")
    assert best_checkpoint(run.root) == run.checkpoint(7)


def test_a_broken_checkpoint_of_the_same_step_is_replaced(tmp_path: Path):
    run = RunPaths(tmp_path)
    (save(run, 100, None, None) / "learner" / "weights").write_bytes(b"")
    assert newest_checkpoint(run.root).checkpoint is None
    save(run, 100, None, None)
    assert newest_checkpoint(run.root).checkpoint == run.checkpoint(100)


def test_a_part_of_a_host_copy_is_saved_as_the_part_itself(tmp_path: Path):
    def one(number: int) -> dict[str, jax.Array]:
        key = jax.random.split(jax.random.key(number), 2)
        return {"key": key, "empty": jnp.zeros((2, 0)), "x": jnp.full((2, 3), 1.0 + number)}

    ones = [one(number) for number in range(3)]
    copy = on_host(jax.tree.map(lambda *leaves: jnp.stack(leaves), *ones))
    run = RunPaths(tmp_path)
    save_envs(run, 8, 0, jax.tree.map(lambda leaf: leaf[1], copy))
    (saved,) = run.checkpoints.iterdir()
    restored = restore_envs(saved, 0, ones[0])
    assert jax.tree.map(jnp.shape, restored) == jax.tree.map(jnp.shape, ones[1])
    assert np.array_equal(restored["x"], ones[1]["x"])
    assert np.array_equal(
        jax.random.key_data(restored["key"]), jax.random.key_data(ones[1]["key"])
    )
