"""Tasks without physics, for tests of the algorithm and of wrappers: they compile in a second."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gmijax.learning.algorithm import IterationMetrics
from gmijax.learning.unroll import Counts
from gmijax.ppo.loss import PpoLosses
from gmijax.sim import episode
from gmijax.sim.interaction import time_limit
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.sim.wrappers import BatchedEnv, training_env


def point_mass(episode_length: int = 20) -> BatchedEnv:
    """Many environments of `point_mass_env`."""
    return training_env(point_mass_env(episode_length))


def point_mass_env(episode_length: int = 20) -> Env:
    """A point on a line that is rewarded for standing at 0; it ends beyond +-3."""
    spec = EnvSpec(
        "point_mass", 2, 1, 0.1, episode_length, ("near", "effort"), metrics=("distance",)
    )

    def reset(model, key):
        key, draw = jax.random.split(key)
        x, v = jax.random.uniform(draw, minval=-2.0, maxval=2.0), jnp.zeros(())
        return episode.begin(spec, (x, v), (), jnp.stack([x, v]), key)

    def step(model, state, action):
        x, v = state.physics
        action = jnp.clip(action, -1.0, 1.0)
        v = 0.9 * v + 0.2 * action[0] * model["gain"]
        x = x + 0.3 * v
        terms = {"near": 1.0 - x**2, "effort": -0.01 * jnp.sum(action**2)}
        reward, metrics = (sum(terms.values()), terms), {"distance": jnp.abs(x)}
        gone = jnp.abs(x) > 3.0
        return episode.advance(state, (x, v), (), jnp.stack([x, v]), reward, gone, metrics)

    # As models of MuJoCo, it has an array without elements.
    model = {"gain": jnp.ones(()), "none": jnp.zeros((0, 3))}
    env = Env(spec, model, reset, step, None, lambda state: state.physics[0][None])
    return time_limit(env, episode_length)


class Walked(NamedTuple):
    level: jax.Array


def walker(episode_length: int = 100, *, carries: bool = False) -> Env:
    """One unit per step from a random start in [0, 1); it falls over at 3 or more.

    The reward is 1 for walking plus 10 times the action. With `carries` a level grows by one with
    every episode that runs out of time. An action above 1 breaks the environment, and its level.
    """
    spec = EnvSpec("walker", 1, 1, 1.0, 100, ("walk", "push"), metrics=("level",))

    def begin(key: jax.Array, level: jax.Array) -> EnvState:
        key, draw = jax.random.split(key)
        position = jax.random.uniform(draw, (1,))
        return episode.begin(spec, position, Walked(level), position, key)

    def reset(model: Any, key: jax.Array) -> EnvState:
        return begin(key, jnp.zeros(()))

    def next_episode(model: Any, ended: EnvState) -> EnvState:
        return begin(ended.key, ended.task.level + ended.truncated)

    def step(model: Any, state: EnvState, action: jax.Array) -> EnvState:
        assert state.obs.shape == (1,)
        position = state.physics + 1.0
        level = state.task.level + jnp.where(action[0] > 1, jnp.nan, 0.0)
        terms = {"walk": 1.0 + 0.0 * position[0], "push": 10.0 * action[0]}
        reward = terms["walk"] + terms["push"], terms
        obs, fallen, metrics = position + level * 0.0, position[0] >= 3.0, {"level": level}
        return episode.advance(state, position, Walked(level), obs, reward, fallen, metrics)

    env = Env(spec, None, reset, step, None, lambda state: state.physics)
    return time_limit(env._replace(next_episode=next_episode) if carries else env, episode_length)


def metrics_from(counts: Counts) -> IterationMetrics:
    """Of an iteration with such rollouts, and zeros of its updates."""
    zero = jnp.zeros(())
    return IterationMetrics(counts, PpoLosses(*[zero] * len(PpoLosses._fields)), {}, {})
