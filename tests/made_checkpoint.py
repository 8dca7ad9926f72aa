"""A checkpoint of a policy that nobody has trained: random weights and statistics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np

import gmijax
from gmijax.config.schema import to_dict
from gmijax.learning.checkpoint import checkpoint_meta, finish_checkpoint, save_learner
from gmijax.learning.episode_window import Standing
from gmijax.learning.learner import learner_shapes
from gmijax.learning.normalize import Moments
from gmijax.learning.policy_file import save_policy
from gmijax.runs.folder import RunPaths, write_json
from gmijax.sim.interface import EnvSpec

ENV_STEPS = 2048
OBS_SIZE = 24
ACTION_SIZE = 3

TINY = ("env=ball_balance", "algo.policy_hidden_layer_sizes=[16,8]", "num_envs=16")


def make_run(
    root: Path,
    *overrides: str,
    obs_size: int = OBS_SIZE,
    action_size: int = ACTION_SIZE,
    actor_obs_size: int | None = None,
) -> RunPaths:
    """A run folder with one checkpoint, at ENV_STEPS; some of its actions are beyond +-1."""
    config = gmijax.compose(*TINY, *overrides)
    run = RunPaths(root)
    run.root.mkdir(parents=True, exist_ok=True)
    write_json(run.config, to_dict(config))
    # Nothing is computed by jax: that would be compiled, leaf by leaf.
    spec = EnvSpec("x", obs_size, action_size, 0.0, 0, (), actor_obs_size=actor_obs_size)
    shapes, rng = learner_shapes(spec, config.algo), np.random.default_rng(0)

    def weights(leaf: Any) -> np.ndarray:
        return rng.normal(scale=0.2, size=leaf.shape).astype(leaf.dtype)

    state: Any = jax.tree.map(
        lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes._replace(key=shapes.iteration)
    )
    state = state._replace(
        params=jax.tree.map(weights, shapes.params),
        obs_moments=Moments(
            np.asarray(1e3, np.float32),
            np.linspace(-2.0, 2.0, obs_size, dtype=np.float32),
            1e3 * np.linspace(0.1, 9.0, obs_size, dtype=np.float32),
        ),
        key=jax.random.key(0),
    )
    save_learner(run, ENV_STEPS, state)
    save_policy(run, ENV_STEPS, config.env, config.algo, state)
    finish_checkpoint(run, checkpoint_meta(config, ENV_STEPS, 1, Standing()))
    return run
