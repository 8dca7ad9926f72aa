"""Where a GMI begins: first states of learner and environments, or those of a checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from gmijax.compile_once import compile_once
from gmijax.config import ServeConfig, TrainConfig
from gmijax.errors import ConfigError
from gmijax.learning.algorithm import load_algorithm
from gmijax.learning.checkpoint import (
    has_envs,
    has_replay,
    restore_envs,
    restore_learner,
    saved_episodes,
)
from gmijax.learning.episode_window import EpisodeWindow
from gmijax.learning.learner import Learner, TrainState, init_learner
from gmijax.learning.memory import in_gib, memory_bytes
from gmijax.learning.saved_arrays import size_bytes
from gmijax.runs.checkpoints import CheckpointMeta
from gmijax.runs.saved_config import saved_config
from gmijax.sim.interface import Env
from gmijax.sim.randomize import make_envs
from gmijax.sim.wrappers import BatchedEnv, BatchState, env_keys
from gmijax.types import Array, PRNGKey


def envs_of(config: TrainConfig | ServeConfig, rank: int) -> Env:
    """The environments of the GMI that is number `rank` of those that simulate."""
    return make_envs(
        config.env,
        config.physics.impl,
        seed=config.seed,
        first_env=rank * config.envs_per_gmi,
        num_envs=config.envs_per_gmi,
    )


def first_state(
    init: Callable[[Learner[Any], int, PRNGKey], TrainState],
    learner: Learner[Any],
    obs_size: int,
    config: TrainConfig,
) -> tuple[TrainState, int]:
    """The learner's state, and the environment steps that it has learnt from.

    `init` makes the state of a new run, see `Algorithm`.

    Raises:
      ConfigError: the checkpoint to continue from does not fit.
    """
    key = _keys(config.seed)[0]

    def start(key: PRNGKey, rate: Array) -> TrainState:
        return init(learner, obs_size, key)._replace(learning_rate=rate)

    # An argument: jobs that differ in it alone have the same programs.
    state = jax.jit(start)(key, jnp.asarray(config.algo.learning_rate, jnp.float32))
    if config.run.resume is None:
        return state, 0
    checkpoint = Path(config.run.resume)
    state = restore_learner(checkpoint, state)
    # The schedule's rate is part of the state, unless the user asks for another one now.
    wanted, meta = config.algo.learning_rate, CheckpointMeta.read(checkpoint)
    # A run that continues in its own folder has written its new configuration by now.
    before = meta.learning_rate
    if before is None:  # Written by an older version.
        before = saved_config(checkpoint)["algo"].get("learning_rate", wanted)
    if wanted != before:
        state = state._replace(learning_rate=jnp.asarray(wanted, jnp.float32))
    return state, meta.env_steps


def saved_state(checkpoint: Path, learner: Learner[Any], obs_size: int) -> Any:
    """The learner's state in a checkpoint of a run with such a learner.

    Raises:
      ConfigError: it does not fit the learner.
    """
    config = learner.config
    init = load_algorithm(config).init if config.implementation else init_learner
    shapes = jax.eval_shape(partial(init, learner, obs_size), jax.random.key(0))
    return restore_learner(checkpoint, shapes)


@jax.jit
def _keys(seed: int) -> tuple[PRNGKey, PRNGKey]:
    """Those of the learner and of the environments of a job."""
    learner, envs = jax.random.split(jax.random.key(seed))
    return learner, envs


def first_envs(
    env: BatchedEnv,
    config: TrainConfig,
    rank: int,
    *,
    gmi: int | None = None,
    num_gmis: int | None = None,
    num_runs: int = 1,
) -> BatchState:
    """Environments at their starts, or as a checkpoint has them.

    The key of an environment comes from its number in the whole job, so that k GMIs of n
    environments and one of k * n simulate the same ones.

    Args:
      env: the environments.
      config: of the run.
      rank: number of this GMI among those that simulate.
      gmi: whose environments of a checkpoint to take, None for no GMI's.
      num_gmis: only from a checkpoint of so many GMIs, None for any.
      num_runs: that share the GMI; all of them have to fit.

    Raises:
      ConfigError: more environments than memory can hold.
    """
    num_envs = config.envs_per_gmi
    key = _keys(config.seed)[1]
    resume = None if config.run.resume is None else Path(config.run.resume)
    meta = None if resume is None else CheckpointMeta.read(resume)
    if meta is not None:  # Other environments than the first run's: never its starts again.
        key = jax.random.fold_in(key, meta.env_steps % 2**31)
    algo = config.algo
    env_state = begin_episodes(
        *(env, key, rank * num_envs, num_envs),
        kept_steps=algo.kept_steps,
        kept_itemsize=algo.kept_itemsize,
        kept_key=algo.kept_key,
        num_runs=num_runs,
    )
    if resume is None or gmi is None or not envs_go_on(config, gmi, num_gmis):
        return env_state
    return restore_envs(resume, gmi, env_state)


def envs_go_on(config: TrainConfig, gmi: int, num_gmis: int | None) -> bool:
    """Whether the environments of a GMI are those of its checkpoint; see `first_envs`."""
    if config.run.resume is None or not has_envs(Path(config.run.resume), gmi):
        return False
    meta = CheckpointMeta.read(Path(config.run.resume))
    own = config.envs_per_gmi, config.physics.impl
    return num_gmis in (None, meta.num_gmis) and (meta.num_envs, meta.impl) == own


def replay_goes_on(config: TrainConfig, gmi: int, num_gmis: int) -> bool:
    """Whether a GMI continues with the replay of its checkpoint: if its environments do."""
    goes_on = envs_go_on(config, gmi, num_gmis)
    return goes_on and has_replay(Path(str(config.run.resume)), gmi)


def first_window(
    config: TrainConfig, limit_steps: float, gmi: int, num_gmis: int | None
) -> EpisodeWindow:
    """The latest episodes of a job at its start, or those before its checkpoint.

    Args:
      config: of the run.
      limit_steps: a time limit of all its environments together, in environment steps.
      gmi: one that simulates.
      num_gmis: see `first_envs`.
    """
    window = EpisodeWindow(limit_steps)
    if config.run.resume is not None:
        saved = saved_episodes(Path(config.run.resume), config)
        if saved is not None:
            window.restore(saved, envs_go_on=envs_go_on(config, gmi, num_gmis))
    return window


def begin_episodes(
    env: BatchedEnv,
    key: PRNGKey,
    first_env: int,
    num_envs: int,
    *,
    kept_steps: int,
    kept_itemsize: int = 4,
    kept_key: str = "unroll_length",
    num_runs: int = 1,
) -> BatchState:
    """Environments `first_env` to `first_env + num_envs - 1` of a job at their starts.

    `kept_steps` are the steps of all of them whose experience is in memory at once, with
    `kept_itemsize` bytes for each number of an observation or action; `kept_key` sets how many.
    There are `num_runs` times as many environments in memory as this makes.

    Raises:
      ConfigError: the state of so many environments, and their experience, which is the least
        that a job needs, are more than the memory of the device (on a CPU, of the host).
    """
    init = jax.jit(env.init)
    # Before anything of that size is made. It is traced once: the call below finds it.
    keys = jax.ShapeDtypeStruct((num_envs,), key.dtype)
    state = init.eval_shape(env.model, keys)
    step_bytes = kept_itemsize * (env.spec.obs_size + env.spec.action_size)
    step_bytes += jnp.dtype(jnp.float32).itemsize  # The reward.
    env_bytes = num_runs * size_bytes(state)
    all_step_bytes = num_runs * num_envs * step_bytes
    least_bytes = env_bytes + kept_steps * all_step_bytes
    limit_bytes = memory_bytes()
    if limit_bytes is not None and least_bytes > limit_bytes:
        need, have = in_gib(least_bytes), in_gib(limit_bytes)
        them = "them" if num_runs == 1 else f"those of {num_runs} runs"
        most_steps = int((limit_bytes - env_bytes) / all_step_bytes)
        most_envs = int(limit_bytes * num_envs / least_bytes)
        fits = [f"{kept_key} up to {most_steps}"] * (most_steps > 0)
        fits += [f"num_envs less than {most_envs}"] * (most_envs > 1)
        raise ConfigError(
            f"num_envs={num_envs}: a GMI would need more than {need} for {them} and {kept_steps} "
            f"steps of each ({kept_key}), and has {have}; allowed: "
            f"{', or '.join(fits) or f'less of both num_envs and {kept_key}'}"
        )
    starts = env_keys(key, first_env, num_envs)
    return compile_once(init.lower(env.model, starts))(env.model, starts)
