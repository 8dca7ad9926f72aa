"""Where a GMI begins: first states of learner and environments, or those of a checkpoint."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp

from gmijax.config import ServeConfig, TrainConfig
from gmijax.learning.checkpoint import has_envs, restore_envs, restore_learner
from gmijax.learning.learner import Learner, TrainState, init_learner
from gmijax.runs.folder import RunPaths, read_json
from gmijax.runs.resume import CheckpointMeta
from gmijax.sim.interface import Env
from gmijax.sim.randomize import make_worlds
from gmijax.sim.wrappers import BatchedEnv, BatchState, env_keys
from gmijax.types import Array, PRNGKey


def worlds_of(config: TrainConfig | ServeConfig, place: int) -> Env:
    """The worlds of the GMI that is number `place` of those that simulate."""
    return make_worlds(
        config.env,
        config.physics.impl,
        seed=config.seed,
        first_env=place * config.envs_per_gmi,
        num_envs=config.envs_per_gmi,
    )


def first_state(learner: Learner, obs_size: int, config: TrainConfig) -> tuple[TrainState, int]:
    """The learner's state, and the environment steps that it has learnt from.

    Raises:
      ConfigError: the checkpoint to go on from does not fit.
    """
    key = _keys(config.seed)[0]

    def start(key: PRNGKey, rate: Array) -> TrainState:
        return init_learner(learner, obs_size, key)._replace(learning_rate=rate)

    # An argument: jobs that differ in it alone have the same programs.
    state = jax.jit(start)(key, jnp.asarray(config.algo.learning_rate, jnp.float32))
    if config.run.resume is None:
        return state, 0
    checkpoint = Path(config.run.resume)
    state = restore_learner(checkpoint, state)
    # The schedule's rate is part of the state, unless the user asks for another one now.
    wanted = config.algo.learning_rate
    if wanted != read_json(RunPaths(checkpoint.parent.parent).config)["algo"]["learning_rate"]:
        state = state._replace(learning_rate=jnp.asarray(wanted, jnp.float32))
    return state, CheckpointMeta.read(checkpoint).env_steps


@jax.jit
def _keys(seed: int) -> tuple[PRNGKey, PRNGKey]:
    """Those of the learner and of the environments of a job."""
    learner, envs = jax.random.split(jax.random.key(seed))
    return learner, envs


def first_envs(
    env: BatchedEnv,
    config: TrainConfig,
    place: int,
    *,
    gmi: int | None = None,
    num_gmis: int | None = None,
) -> BatchState:
    """Environments at their starts, or as a checkpoint has them.

    The key of an environment comes from its number in the whole job, so that k GMIs of n
    environments and one of k * n simulate the same ones.

    Args:
      env: the environments.
      config: of the run.
      place: number of this GMI among those that simulate.
      gmi: whose environments of a checkpoint to take, None for nobody's.
      num_gmis: only from a checkpoint of so many GMIs, None for any.
    """
    num_envs = config.envs_per_gmi
    key = _keys(config.seed)[1]
    resume = None if config.run.resume is None else Path(config.run.resume)
    meta = None if resume is None else CheckpointMeta.read(resume)
    if meta is not None:  # Other environments than the first run's: never its starts again.
        key = jax.random.fold_in(key, meta.env_steps % 2**31)
    keys = env_keys(key, place * num_envs, num_envs)
    env_state = jax.jit(env.init)(env.model, keys)
    if resume is None or meta is None or gmi is None or not has_envs(resume, gmi):
        return env_state
    if num_gmis not in (None, meta.num_gmis):
        return env_state
    if (meta.num_envs, meta.impl) != (num_envs, config.physics.impl):
        return env_state
    return restore_envs(resume, gmi, env_state)
