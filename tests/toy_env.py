"""A task without physics, for tests of the algorithm: it compiles in a second."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from gmijax.learning.unroll import Counts
from gmijax.ppo.ppo import IterationMetrics, PpoLosses
from gmijax.sim.interface import Env, EnvSpec, EnvState
from gmijax.sim.wrappers import BatchedEnv, time_limit, training_env


def point_mass(episode_length: int = 20) -> BatchedEnv:
    """Many worlds of `point_mass_env`."""
    return training_env(point_mass_env(episode_length))


def point_mass_env(episode_length: int = 20) -> Env:
    """A point on a line that is rewarded for standing at 0; it ends beyond +-3."""
    spec = EnvSpec(
        "point_mass", 2, 1, 0.1, episode_length, ("near", "effort"), metrics=("distance",)
    )

    def outcome(x, v, action, steps, key):
        terms = {"near": 1.0 - x**2, "effort": -0.01 * jnp.sum(action**2)}
        return EnvState(
            physics=(x, v),
            task=(),
            obs=jnp.stack([x, v]),
            reward=sum(terms.values()),
            reward_terms=terms,
            metrics={"distance": jnp.abs(x)},
            terminated=jnp.abs(x) > 3.0,
            truncated=jnp.zeros((), bool),
            steps=steps,
            key=key,
        )

    def reset(model, key):
        key, draw = jax.random.split(key)
        x = jax.random.uniform(draw, minval=-2.0, maxval=2.0)
        state = outcome(x, jnp.zeros(()), jnp.zeros(1), jnp.zeros((), jnp.int32), key)
        zeros = {name: jnp.zeros(()) for name in state.reward_terms}
        return state._replace(
            reward=jnp.zeros(()), reward_terms=zeros, terminated=jnp.zeros((), bool)
        )

    def step(model, state, action):
        x, v = state.physics
        action = jnp.clip(action, -1.0, 1.0)
        v = 0.9 * v + 0.2 * action[0] * model["gain"]
        return outcome(x + 0.3 * v, v, action, state.steps + 1, state.key)

    # As models of MuJoCo, it has an array without elements.
    model = {"gain": jnp.ones(()), "none": jnp.zeros((0, 3))}
    env = Env(spec, model, reset, step, None, lambda state: state.physics[0][None])
    return time_limit(env, episode_length)


def metrics_from(counts: Counts) -> IterationMetrics:
    """Of an iteration with such rollouts, and zeros of its updates."""
    zero = jnp.zeros(())
    return IterationMetrics(counts, PpoLosses(*[zero] * len(PpoLosses._fields)), {}, {})
