"""Updates on minibatches, whatever the loss, and the parts of losses that PPO and A3C share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from gmijax.collectives.interface import Collectives
from gmijax.config import AlgoConfig, RolloutConfig
from gmijax.learning.learner import Learner, TrainState, apply_gradients, learner_shapes
from gmijax.learning.normalize import Moments
from gmijax.learning.policy import ActorCriticParams
from gmijax.sim.interface import EnvSpec
from gmijax.types import Array, PyTree

Gradients: TypeAlias = Callable[[Learner, ActorCriticParams, Any, Any, Array], tuple[Any, Any]]
"""`(learner, params, data, context, indices) -> (gradient, losses)` of a minibatch of `data`;
the losses are a named tuple of [] float32, with a property `steering_kl`."""

_ACTION_BOUND = 1.1
"""Means beyond this are penalised; actions are clipped to 1, and a small margin is harmless."""

_SATURATED = 0.999
"""Means beyond this count as saturated; a tanh only comes close to 1."""

_LARGEST_LOG_RATIO = 20.0
"""Of probabilities; see `probability_ratio`."""


def minibatch_order(config: RolloutConfig, state: TrainState, rank: Array, size: int) -> Array:
    """Indices [epochs * minibatches, B] into data of length `size`: each once per epoch."""
    key = jax.random.fold_in(jax.random.fold_in(state.key, state.iteration), rank)
    keys = jax.random.split(key, config.num_updates_per_batch)
    order = jax.vmap(lambda k: jax.random.permutation(k, size))(keys)
    return order.reshape(config.num_updates_per_batch * config.num_minibatches, -1)


def exchange_size(spec: EnvSpec, config: AlgoConfig, losses: Any) -> int:
    """P, how many float32 trainers average per minibatch: gradient and parts of the loss."""
    params = learner_shapes(spec, config).params
    return sum(leaf.size for leaf in jax.tree.leaves(params)) + len(losses._fields)


def run_updates(
    learner: Learner,
    collectives: Collectives,
    gradients: Gradients,
    state: TrainState,
    data: PyTree,
    context: Any,
    order: Array,
    after: Any,
) -> tuple[TrainState, Any, Array]:
    """All updates on one set of data, within a program of all trainers.

    Args:
      learner: of this trainer.
      collectives: the trainers.
      gradients: see `Gradients`.
      state: of the learner.
      data: of this trainer.
      context: what stays the same in all updates.
      order: indices into `data` [minibatches, B].
      after: result of the exchange before, see `Collectives`.

    Returns:
      The new state; losses and learning rates of all updates, with a leading axis.
    """

    def update(state: TrainState, indices: Array) -> tuple[TrainState, tuple[Any, Array]]:
        own = gradients(learner, state.params, data, context, indices)
        grads, losses = collectives.mean(own, after=after)
        state = apply_gradients(learner, state, grads, losses.steering_kl)
        return state, (losses, state.learning_rate)

    state, (losses, rates) = jax.lax.scan(update, state, order)
    return state, losses, rates


def probability_ratio(log_prob: Array, old_log_prob: Array) -> Array:
    """How much likelier [...] actions have become, from log densities [...].

    A float32 overflows at e^88, and one sample there, whatever its advantage, makes the gradient
    of a whole minibatch not finite. Beyond `_LARGEST_LOG_RATIO` a sample has no gradient.
    """
    return jnp.exp(jnp.minimum(log_prob - old_log_prob, _LARGEST_LOG_RATIO))


def clipped_surrogate(ratio: Array, advantage: Array, epsilon: float) -> Array:
    """Gain [...] of every sample, to be maximised (PPO, arXiv:1707.06347, equation 7).

    A change of the policy gains nothing beyond a probability ratio of 1 +- `epsilon`.
    """
    clipped = jnp.clip(ratio, 1.0 - epsilon, 1.0 + epsilon)
    return jnp.minimum(ratio * advantage, clipped * advantage)


def bound_loss(mean: Array) -> Array:
    """Squared distance [...] of action means [..., A] from [-1.1, 1.1]."""
    return jnp.sum(jnp.maximum(jnp.abs(mean) - _ACTION_BOUND, 0.0) ** 2, -1)


def saturated_fraction(mean: Array) -> Array:
    """Share [...] of action means [..., A] at the limits of [-1, 1], within 0.001, or beyond."""
    return jnp.mean((jnp.abs(mean) > _SATURATED).astype(jnp.float32), -1)


def mean_of_states(values: Array) -> Array:
    """Mean [] of `values` [...], or [] where they are the same in all states."""
    return jnp.mean(values) if values.ndim else values


def explained_variance(target: Moments, error: Moments) -> Array:
    """Share [] of the variance of the values' targets that the values explain.

    1 where they are the targets, 0 where a constant would do as well, or where nothing varies.

    Args:
      target: of the targets of some samples.
      error: of the targets minus the values of the same.
    """
    varies = target.m2 > 0.0
    return jnp.where(varies, 1.0 - error.m2 / jnp.where(varies, target.m2, 1.0), 0.0)
