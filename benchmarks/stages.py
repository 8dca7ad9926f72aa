"""The parts of a PPO iteration as programs of their own, to be run over and over."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gmijax.collectives.program import LocalCollectives
from gmijax.config import PpoConfig, TrainConfig
from gmijax.learning.learner import Learner, acting_weights, init_learner, make_learner
from gmijax.learning.unroll import act
from gmijax.ppo.ppo import iterate, learn
from gmijax.ppo.rollout import Samples
from gmijax.ppo.statistics import no_stats
from gmijax.sim.interface import EnvSpec
from gmijax.sim.randomize import make_worlds
from gmijax.sim.wrappers import BatchedEnv, env_keys, training_env


class Stage(NamedTuple):
    """A part of an iteration.

    Attributes:
      name: `simulator`, `agent`, `trainer`, or `iteration` for all of them together.
      program: from (given, state) to the next state, what a GMI does in an iteration.
      given: what it reads.
      state: the first one.
      spec: of the environment.
    """

    name: str
    program: Callable[[Any, Any], Any]
    given: Any
    state: Any
    spec: EnvSpec


def stages(config: TrainConfig, impl: str) -> Iterator[Stage]:
    """Agent, trainer, simulator and the whole, with random experience where they need some."""
    algo, num_envs = config.algo, config.envs_per_gmi
    assert isinstance(algo, PpoConfig)
    worlds = make_worlds(config.env, impl, seed=0, first_env=0, num_envs=num_envs)
    env = training_env(worlds)
    learner, key = make_learner(env.spec, algo), jax.random.key(0)
    state = init_learner(learner, env.spec.obs_size, key)
    envs = jax.jit(env.init)(env.model, env_keys(key, 0, num_envs))
    zeros = jnp.zeros((num_envs, env.spec.action_size))
    actions = jax.random.uniform(key, zeros.shape, minval=-1.0)
    samples = _samples(num_envs * algo.unroll_length, env.spec, key)
    stats = no_stats(env.spec, env.overflows)
    spec = env.spec
    yield Stage("agent", partial(_act, learner), state, (envs, zeros), spec)
    yield Stage("trainer", partial(_train, learner), (samples, stats), state, spec)
    yield Stage("simulator", partial(_simulate, env, algo), (env.model, actions), envs, spec)
    yield Stage("iteration", partial(_iterate, env, learner), env.model, (state, envs), spec)


def _simulate(env: BatchedEnv, algo: PpoConfig, given: Any, envs: Any) -> Any:
    """T steps of all environments."""
    model, actions = given

    def step(_: Any, envs: Any) -> Any:
        return env.step(model, envs, actions)[0]

    return jax.lax.fori_loop(0, algo.unroll_length, step, envs)


def _act(learner: Learner, state: Any, carry: Any) -> Any:
    """T actions for all environments."""
    weights = acting_weights(learner, state)

    def step(_: Any, carry: Any) -> Any:
        envs, total = carry
        # Other observations in every step, or the network would be evaluated only once.
        obs = envs.env.obs + 1e-9 * total[:, :1]
        envs = envs._replace(env=envs.env._replace(obs=obs))
        envs, _, action = act(learner.networks, weights, envs)
        return envs, total + action

    return jax.lax.fori_loop(0, learner.config.unroll_length, step, carry)


def _train(learner: Learner, given: Any, state: Any) -> Any:
    """All updates of an iteration, with advantages that are there."""
    samples, stats = given
    return learn(learner, LocalCollectives(), state, samples, stats)[0]


def _iterate(env: BatchedEnv, learner: Learner, model: Any, carry: Any) -> Any:
    """A whole iteration of one GMI."""
    return iterate(env, learner, LocalCollectives(), model, *carry)[:2]


def _samples(count: int, spec: EnvSpec, key: jax.Array) -> Samples:
    """Random samples [1, count]: how long an update takes does not depend on what is in them."""
    shapes = (spec.obs_size,), (spec.action_size,), ()
    obs, action, advantage = (jax.random.normal(key, (1, count, *shape)) for shape in shapes)
    zeros = jnp.zeros((1, count))
    return Samples(obs, action, zeros, jnp.zeros_like(action), zeros, advantage)
