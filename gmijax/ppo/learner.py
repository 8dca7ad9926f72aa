"""The pure update functions of PPO.

Two paths are built from them, and no third: one program of the whole iteration, of one GMI or of
several whose exchanges are part of it (`gmijax.ppo.programs`); and several, split at the gradient
with a reducer between the halves (`gmijax.ppo.split`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from gmijax.learner import Learner, LearnerState
from gmijax.normalize import merge, std_of
from gmijax.policy import ActorCriticParams
from gmijax.ppo.losses import LossMetrics, Samples, UpdateContext, ppo_loss
from gmijax.ppo.rollout import RolloutStats
from gmijax.types import Array


def minibatch_order(learner: Learner, state: LearnerState, rank: Array, samples: int) -> Array:
    """Sample indices [epochs * minibatches, B]: every sample once per epoch."""
    config = learner.config
    key = jax.random.fold_in(jax.random.fold_in(state.key, state.iteration), rank)
    keys = jax.random.split(key, config.num_updates_per_batch)
    order = jax.vmap(lambda k: jax.random.permutation(k, samples))(keys)
    return order.reshape(config.num_updates_per_batch * config.num_minibatches, -1)


def update_context(learner: Learner, state: LearnerState, stats: RolloutStats) -> UpdateContext:
    """What all updates of an iteration share; `stats` are those of all GMIs together."""
    mean, std = stats.advantage.mean, std_of(stats.advantage)
    if not learner.config.normalize_advantage:
        mean, std = jnp.zeros(()), jnp.ones(())
    # A copy, because the updates donate the parameters that it would alias.
    return UpdateContext(mean, std, jnp.copy(state.params.log_std))


def gradients(
    learner: Learner,
    params: ActorCriticParams,
    samples: Samples,
    context: UpdateContext,
    indices: Array,
) -> tuple[ActorCriticParams, LossMetrics]:
    """Gradient and loss parts on the minibatch `indices` [B] of flat samples [T * N]."""
    minibatch = jax.tree.map(lambda x: x[indices], samples)
    return jax.grad(ppo_loss, has_aux=True)(
        params, minibatch, context, learner.networks, learner.config
    )


def finish_iteration(state: LearnerState, stats: RolloutStats) -> LearnerState:
    """Counts the iteration and takes its observations into the statistics.

    The statistics change only between iterations: the policy that is updated then sees the
    observations exactly as the policy that acted did, and the first probability ratio is 1.
    """
    return state._replace(
        obs_moments=merge(state.obs_moments, stats.obs), iteration=state.iteration + 1
    )
