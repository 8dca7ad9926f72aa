"""Checkpoints of the full state: their parts, and when they are complete.

`<run>/checkpoints/<12-digit env steps>/{learner,gmi_0,gmi_1,...,meta.json}`: what all GMIs share
is written by the leader, each GMI's environments, and its replay if asked, by itself. Everything
goes to a hidden folder that is renamed when all GMIs have finished and all of it is on the disk,
so a checkpoint is there as a whole or not at all.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from gmijax.collectives.interface import Communicator
from gmijax.config import TrainConfig
from gmijax.config.schema import to_dict
from gmijax.errors import ConfigError, NonFiniteError, ParameterMismatch
from gmijax.learning import saved_arrays
from gmijax.learning.episode_window import Standing
from gmijax.learning.kept_checkpoints import keep_best, keep_last_replays, remove
from gmijax.runs.checkpoints import CheckpointMeta, file_check
from gmijax.runs.folder import META, RunPaths, read_json, replay_name, replays_of, write_json
from gmijax.runs.names import nearby
from gmijax.types import PyTree

T = TypeVar("T")

LEARNER = "learner"

EPISODES = "episodes.json"
"""The latest episodes before a checkpoint, which metrics after it include."""


def checkpoint_meta(
    config: TrainConfig,
    env_steps: int,
    num_gmis: int,
    standing: Standing,
    eval_return: float | None = None,
) -> CheckpointMeta:
    """Content of `meta.json` for a checkpoint of this run by `num_gmis` GMIs."""
    algo = config.algo
    return CheckpointMeta(
        env=config.env.label,
        algo=algo.name,
        env_steps=env_steps,
        num_gmis=num_gmis,
        num_envs=config.envs_per_gmi,
        hidden=algo.hidden_layer_sizes,
        impl=config.physics.impl,
        mean_return=standing.mean_return,
        window_full=standing.is_full,
        limit_steps=standing.limit_steps,
        eval_return=eval_return,
        learning_rate=algo.learning_rate,
    )


def require_equal(comm: Communicator, gmi: int, params: PyTree, env_steps: int) -> None:
    """Raises `ParameterMismatch` if the parameters of trainers differ; names them by their `gmi`.

    Collective.
    """
    gathered = comm.all_gather(np.append(digest(params), np.float32(gmi)))
    digests, gmis = gathered[:, :-1], gathered[:, -1].astype(int).tolist()
    different = [gmi for gmi, one in zip(gmis, digests, strict=True) if (one != digests[0]).any()]
    if different:
        raise ParameterMismatch(
            f"after {env_steps} env steps the parameters of GMIs {different} differ from "
            f"those of GMI {gmis[0]}"
        )


def require_finite(params: PyTree, env_name: str, env_steps: int) -> None:
    """Raises `NonFiniteError` if parameters to be saved are NaN or infinite."""
    # By numpy: jax would make two programs for every shape.
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.device_get(params))):
        raise NonFiniteError(
            f"{env_name}: parameters are not finite after {env_steps} env steps; nothing was saved"
        )


def save_learner(paths: RunPaths, env_steps: int, learner_state: PyTree) -> None:
    """Writes the shared part of the checkpoint at `env_steps`, not yet under its name."""
    saved_arrays.save(_partial(paths, env_steps) / LEARNER, learner_state)


def save_envs(paths: RunPaths, env_steps: int, gmi: int, env_state: PyTree) -> None:
    """Writes the environments of one GMI, as `save_learner` does the shared part."""
    saved_arrays.save(_partial(paths, env_steps) / f"gmi_{gmi}", env_state)


def save_replay(paths: RunPaths, env_steps: int, gmi: int, replay: PyTree) -> None:
    """Writes the replay of one GMI, as `save_learner` does the shared part."""
    saved_arrays.save(_partial(paths, env_steps) / replay_name(gmi), replay)


def require_disk_for(run: RunPaths, replay: PyTree | None, num_gmis: int) -> None:
    """Raises `ConfigError` if the disk of a run has no space for the replays of so many GMIs.

    `replay` may be shapes and dtypes; None: there is none to be saved.
    """
    need = num_gmis * saved_arrays.size_bytes(replay) / 2**20
    if need and need > (free := shutil.disk_usage(run.root).free / 2**20):
        raise ConfigError(
            f"algo.save_replay=true: the replays take {need:,.0f} MiB at the end, and the disk of "
            f"{nearby(run.root)} has {free:,.0f} MiB left; lower algo.replay_steps, or set "
            "algo.save_replay=false"
        )


def save_episodes(
    paths: RunPaths, env_steps: int, config: TrainConfig, window: Mapping[str, Any]
) -> None:
    """Writes what `EpisodeWindow.state` gave, as `save_learner` does the shared part."""
    write_json(_partial(paths, env_steps) / EPISODES, {"task": _task(config), **window})


def saved_episodes(checkpoint: Path, config: TrainConfig) -> dict[str, Any] | None:
    """What `save_episodes` wrote; None without it, or where returns are of another task now."""
    path = checkpoint / EPISODES
    found = read_json(path) if path.exists() else {}
    return found if found.get("task") == _task(config) else None


def _task(config: TrainConfig) -> str:
    return json.dumps(to_dict(config.env), sort_keys=True)


def finish_checkpoint(paths: RunPaths, meta: CheckpointMeta, keep: int | None = None) -> Path:
    """Gives a checkpoint its name, once all have written their parts; returns its folder.

    Args:
      paths: the run folder.
      meta: what the checkpoint holds; the list of its files is added.
      keep: how many checkpoints stay, among them always the best one (see `ranked`) and the
        last one; None: all.
    """
    final, partial = paths.checkpoint(meta.env_steps), paths.unfinished(meta.env_steps)
    files = [path for path in sorted(partial.rglob("*")) if path.is_file()]
    checks = {path.relative_to(partial).as_posix(): file_check(path) for path in files}
    for path in (*files, *(path for path in partial.rglob("*") if path.is_dir())):
        _sync(path)
    meta = dataclasses.replace(meta, files=checks, time_s=time.time())
    write_json(partial / META, meta.to_dict())
    _sync(partial)
    if final.exists():  # A broken one, which a restart has passed over; or one without replays.
        remove(paths, final)
    os.replace(partial, final)
    _sync(final.parent)
    if keep is not None:
        keep_best(paths, keep, final)
    if replays_of(final):
        keep_last_replays(paths, final)
    return final


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def has_envs(checkpoint: Path, gmi: int) -> bool:
    """Whether a checkpoint holds environments of that GMI."""
    return (checkpoint / f"gmi_{gmi}").is_dir()


def has_replay(checkpoint: Path, gmi: int) -> bool:
    """Whether a checkpoint holds the replay of that GMI."""
    return (checkpoint / replay_name(gmi)).is_dir()


def restore_learner(checkpoint: Path, template: T) -> T:
    """The learner's state; `template` gives structure, shapes and dtypes.

    Raises:
      ConfigError: the checkpoint does not fit the template.
    """
    return saved_arrays.restore(checkpoint / LEARNER, template)


def learner_sizes(checkpoint: Path) -> tuple[int, int, int]:
    """Sizes of the policy in a checkpoint.

    Returns:
      O, length of an observation; how many of its first numbers the policy sees; A, length of an
      action.

    Raises:
      ConfigError: the checkpoint holds no learner's state.
    """
    folder = checkpoint / LEARNER
    shapes = saved_arrays.saved_shapes(folder)
    try:
        (obs_size,) = shapes["obs_moments.mean"]
        (action_size,) = shapes["params.log_std"]
        actor_obs_size, _ = shapes["params.policy.params.Dense_0.kernel"]
    except (KeyError, ValueError) as error:
        raise ConfigError(f"checkpoint {nearby(folder)}: holds no policy") from error
    return obs_size, actor_obs_size, action_size


def restore_envs(checkpoint: Path, gmi: int, template: T) -> T:
    """The environments of one GMI; `template` gives structure, shapes and dtypes."""
    return saved_arrays.restore(checkpoint / f"gmi_{gmi}", template)


def restore_replay(checkpoint: Path, gmi: int, template: T) -> T:
    """The replay of one GMI, in the host's memory; `template` gives structure, shapes and dtypes.

    Raises:
      ConfigError: it has other shapes.
    """
    return saved_arrays.on_host(saved_arrays.restore(checkpoint / replay_name(gmi), template))


def digest(tree: PyTree) -> np.ndarray:
    """SHA-256 of all bytes of a tree as [16] float32 of 16-bit numbers, exact in float32."""
    sha = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        sha.update(np.ascontiguousarray(leaf).tobytes())
    return np.frombuffer(sha.digest(), np.uint16).astype(np.float32)


def _partial(paths: RunPaths, env_steps: int) -> Path:
    partial = paths.unfinished(env_steps)
    # Not the run folder: one that was moved away must not come back with half of its files.
    paths.checkpoints.mkdir(exist_ok=True)
    partial.mkdir(exist_ok=True)
    return partial
