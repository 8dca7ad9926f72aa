"""What SAC's learner remembers, and what a GMI keeps beside it."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax

from gmijax.config import SacConfig
from gmijax.learning.learner import Learner, make_learner
from gmijax.learning.normalize import Moments, no_samples
from gmijax.learning.policy import ActorCriticParams
from gmijax.sac.critics import critics_of
from gmijax.sac.losses import CriticFigures
from gmijax.sac.replay import Replay, empty_replay
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.types import Array, PRNGKey, PyTree

SacLearner: TypeAlias = Learner[SacConfig]

_BETAS, _WEIGHT_DECAY = (0.9, 0.95), 1e-3
"""Of Adam, with weight decay, as FastSAC has it."""


class SacState(NamedTuple):
    """All that learning must remember; equal, bit by bit, on every GMI.

    Attributes:
      params: weights of the policy that is evaluated, played and exported: an exponential average
        of `live`; `value` is empty.
      opt_states: of critics, policy and temperature.
      obs_moments: statistics of all observations before this iteration.
      learning_rate: [] float32.
      iteration: [] int32, finished iterations.
      key: base of the keys of updates; never consumed, only folded with iteration and rank.
      live: weights of the policy that learns and explores.
      critics: weights of both critics, [2, ...].
      targets: slow copies of them.
      log_temperature: [] of the weight of the entropy.
      updates: [] int32, of the critics.
      value_moments: None, there is no value function.
    """

    params: ActorCriticParams
    opt_states: tuple[PyTree, PyTree, PyTree]
    obs_moments: Moments
    learning_rate: Array
    iteration: Array
    key: PRNGKey
    live: ActorCriticParams
    critics: PyTree
    targets: PyTree
    log_temperature: Array
    updates: Array
    value_moments: None = None


class Memory(NamedTuple):
    """What a GMI keeps for itself: its environments, and what they have done."""

    envs: BatchState
    replay: Replay


def init(learner: SacLearner, obs_size: int, key: PRNGKey) -> SacState:
    """The first state; consumes `key`."""
    config, networks = learner.config, learner.networks
    params_key, critics_key, shuffle_key = jax.random.split(key, 3)
    params = networks.init(params_key, obs_size)
    critics = critics_of(config).init(critics_key, obs_size, networks.distribution.action_size)
    log_temperature = jnp.log(jnp.asarray(config.init_temperature, jnp.float32))
    of_critics, of_policy, of_temperature = optimizers(config)
    return SacState(
        params=params,
        opt_states=(
            of_critics.init(critics),
            of_policy.init(params),
            of_temperature.init(log_temperature),
        ),
        obs_moments=no_samples((obs_size,)),
        learning_rate=jnp.asarray(config.learning_rate, jnp.float32),
        iteration=jnp.zeros((), jnp.int32),
        key=shuffle_key,
        live=jax.tree.map(jnp.copy, params),
        critics=critics,
        targets=jax.tree.map(jnp.copy, critics),
        log_temperature=log_temperature,
        updates=jnp.zeros((), jnp.int32),
    )


def begin(learner: SacLearner, env: BatchedEnv, envs: BatchState) -> Memory:
    """The environments with an empty replay."""
    config, num_envs = learner.config, envs.env.reward.shape[0]
    dtype = jnp.dtype(config.replay_precision)
    return Memory(envs, empty_replay(env.spec, config.replay_steps, num_envs, dtype))


def optimizers(config: SacConfig) -> tuple[optax.GradientTransformation, ...]:
    """Of critics, policy and temperature; without the learning rate, which is in the state."""
    adam = optax.scale_by_adam(*_BETAS)
    clip = optax.clip_by_global_norm(config.max_grad_norm)
    decayed = optax.flatten(optax.chain(clip, adam, optax.add_decayed_weights(_WEIGHT_DECAY)))
    return decayed, decayed, adam


def num_averaged(spec: EnvSpec, config: SacConfig) -> int:
    """See `gmijax.learning.algorithm.Algorithm`."""
    # An update is of the critics and the temperature, or of the policy.
    learner = make_learner(spec, config)
    state = jax.eval_shape(lambda: init(learner, spec.obs_size, jax.random.key(0)))
    critics, policy = (
        sum(leaf.size for leaf in jax.tree.leaves(tree)) for tree in (state.critics, state.params)
    )
    return max(critics + 1 + len(CriticFigures._fields), policy + 1)
