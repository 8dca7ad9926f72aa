"""The pure update functions of A3C on batches of whole unrolls."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from gmijax.a3c.losses import LossMetrics, Unrolls, UpdateContext, a3c_loss, update_context
from gmijax.config import A3cConfig
from gmijax.learner import (
    Learner,
    LearnerState,
    acting_moments,
    init_learner,
    make_learner,
)
from gmijax.normalize import Moments, merge, moments_of, without_outliers
from gmijax.policy import ActorCriticParams
from gmijax.sim.interface import EnvSpec
from gmijax.types import Array, PRNGKey


class ActingWeights(NamedTuple):
    """What an agent needs to act; see `pack_weights`.

    Attributes:
      params: weights of policy and value function.
      moments: statistics that observations are normalised with.
    """

    params: ActorCriticParams
    moments: Moments


def acting_weights(learner: Learner[A3cConfig], state: LearnerState) -> ActingWeights:
    """What agents act with when trainers have `state`."""
    return ActingWeights(state.params, acting_moments(learner, state))


def pack_weights(weights: ActingWeights) -> Array:
    """All numbers as one array [W] float32, as trainers publish them."""
    return ravel_pytree(weights)[0]


def unpack_weights(example: ActingWeights, packed: Array) -> ActingWeights:
    """Inverts `pack_weights`; `example` gives the structure."""
    return ravel_pytree(example)[1](packed)


def num_weights(spec: EnvSpec, config: A3cConfig) -> int:
    """W, length of the packed weights."""
    learner = make_learner(spec, config)

    def packed(key: PRNGKey) -> Array:
        return pack_weights(acting_weights(learner, init_learner(learner, spec.obs_size, key)))

    return jax.eval_shape(lambda: packed(jax.random.key(0))).size


def minibatch_order(
    learner: Learner[A3cConfig], state: LearnerState, rank: Array, batch_size: int
) -> Array:
    """Unroll indices [epochs * minibatches, b]: every unroll once per epoch."""
    config = learner.config
    key = jax.random.fold_in(jax.random.fold_in(state.key, state.iteration), rank)
    keys = jax.random.split(key, config.num_updates_per_batch)
    order = jax.vmap(lambda k: jax.random.permutation(k, batch_size))(keys)
    return order.reshape(config.num_updates_per_batch * config.num_minibatches, -1)


def begin_batch(
    learner: Learner[A3cConfig], state: LearnerState, batch: Unrolls, weight: Array
) -> UpdateContext:
    """What all passes over a batch share."""
    moments = acting_moments(learner, state)
    context = update_context(
        state.params, batch, weight, moments, learner.networks, learner.config
    )
    # Copies, because the updates donate the state that they would alias.
    copied = jax.tree.map(jnp.copy, (moments, state.params.log_std))
    return context._replace(moments=copied[0], log_std=copied[1])


def gradients(
    learner: Learner[A3cConfig],
    params: ActorCriticParams,
    batch: Unrolls,
    context: UpdateContext,
    indices: Array,
) -> tuple[ActorCriticParams, LossMetrics]:
    """Gradient and loss parts on the unrolls `indices` [b] of a batch."""
    minibatch: Unrolls = jax.tree.map(lambda x: x[:, indices], batch)
    theirs = context._replace(
        weight=context.weight[indices],
        mean=context.mean[:, indices],
        log_prob=context.log_prob[:, indices],
        value=context.value[:, indices],
        advantage=context.advantage[:, indices],
        step_weight=context.step_weight[:, indices],
    )
    return jax.grad(a3c_loss, has_aux=True)(
        params, minibatch, theirs, learner.networks, learner.config
    )


def batch_moments(learner: Learner[A3cConfig], state: LearnerState, batch: Unrolls) -> Moments:
    """Statistics [O] of a batch's observations."""
    return moments_of(without_outliers(acting_moments(learner, state), batch.state), 2)


def finish_batch(state: LearnerState, obs: Moments) -> LearnerState:
    """Counts the batch, which makes a new version of the policy, and takes in its statistics."""
    return state._replace(obs_moments=merge(state.obs_moments, obs), iteration=state.iteration + 1)
