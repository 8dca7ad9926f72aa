"""A run folder with checkpoints as a training writes them, as far as a viewer reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gmijax.cli.compose import compose
from gmijax.config import ALGORITHMS
from gmijax.config.schema import to_dict
from gmijax.player.plain_env import PlainEnv
from gmijax.player.policy import PlainPolicy, write_policy
from gmijax.runs.checkpoints import CheckpointMeta, file_check
from gmijax.runs.folder import META, POLICY, RunPaths, write_json


def make_plain_run(root: Path, *env_steps: int, task: str = "ball_balance") -> RunPaths:
    """Makes a run folder of a task with a policy that does nothing after each of `env_steps`."""
    run, config = RunPaths(root), compose(f"env={task}", "num_envs=64")
    assert isinstance(config.algo, ALGORITHMS)
    root.mkdir(parents=True)
    write_json(run.config, to_dict(config))
    for steps in env_steps:
        add_checkpoint(run, steps, task)
    return run


def add_checkpoint(run: RunPaths, env_steps: int, task: str = "ball_balance") -> Path:
    """Writes one more checkpoint; its action is `env_steps` / 1000 in every number."""
    checkpoint = run.checkpoint(env_steps)
    checkpoint.mkdir(parents=True)
    policy = constant_policy(PlainEnv(compose(f"env={task}").env), env_steps / 1000.0)
    write_policy(checkpoint / POLICY, policy)
    files = {POLICY: file_check(checkpoint / POLICY)}
    meta = CheckpointMeta(
        task, "ppo", env_steps, 1, 64, ((8,), (8,)), "jax", time_s=float(env_steps), files=files
    )
    write_json(checkpoint / META, meta.to_dict())
    return checkpoint


def constant_policy(env: PlainEnv, action: float) -> PlainPolicy:
    """Takes the same action in all states."""
    sizes = env.spec.actor_obs_size or env.spec.obs_size, env.spec.action_size
    zeros, ones = np.zeros(sizes[0], np.float32), np.ones(sizes[0], np.float32)
    return PlainPolicy(
        [np.zeros(sizes, np.float32)],
        [np.full(sizes[1], action, np.float32)],
        zeros,
        ones,
        None,
        "normal",
        sizes[1],
        {},
    )
