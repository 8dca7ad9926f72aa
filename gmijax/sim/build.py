"""The environments of a GMI, as a run's configuration describes them."""

from __future__ import annotations

from gmijax.config import EnvConfig
from gmijax.sim.interface import Env
from gmijax.sim.randomize import randomized
from gmijax.sim.registry import make_env
from gmijax.sim.wrappers import BatchedEnv, training_env


def make_training_env(
    config: EnvConfig,
    impl: str,
    *,
    seed: int,
    first_env: int,
    num_envs: int,
    random_ep_len: bool = False,
) -> BatchedEnv:
    """`num_envs` auto-resetting environments, randomised where the configuration says so.

    Args:
      config: task and randomisation.
      impl: MJX implementation, decided.
      seed: of the run.
      first_env: number of the first of them in the whole job.
      num_envs: N.
      random_ep_len: see `training_env`.
    """
    env = make_worlds(config, impl, seed=seed, first_env=first_env, num_envs=num_envs)
    return training_env(env, random_ep_len=random_ep_len)


def make_worlds(config: EnvConfig, impl: str, *, seed: int, first_env: int, num_envs: int) -> Env:
    """The same for one world at a time, with a model that holds all; arguments as above."""
    env = make_env(
        str(config.name),
        suite=config.suite,
        impl=impl,
        episode_length=config.episode_length,
        max_envs=num_envs,
        source_sha256=config.source_sha256,
    )
    if config.randomize != "on":
        return env
    ranges = config.randomization
    return randomized(env, ranges, seed=seed, first_env=first_env, num_envs=num_envs)
