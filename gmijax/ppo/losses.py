"""The clipped surrogate loss of PPO (Schulman et al. 2017, arXiv:1707.06347)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from gmijax.config import PpoConfig
from gmijax.policy import ActorCritic, ActorCriticParams, entropy, kl_divergence, log_prob
from gmijax.types import Array

_ACTION_BOUND = 1.1
"""Means beyond this are penalised; actions are clipped to 1, and a little room is harmless."""


class Samples(NamedTuple):
    """What the loss needs of every step; leading axes are [T, N] or [B].

    Attributes:
      obs: [..., O], normalised as the policy saw it.
      action: [..., A], before clipping.
      log_prob: [...], of the action when it was drawn.
      mean: [..., A], of the policy when the action was drawn.
      value: [...], estimate when the action was drawn.
      advantage: [...], not normalised.
    """

    obs: Array
    action: Array
    log_prob: Array
    mean: Array
    value: Array
    advantage: Array


class LossMetrics(NamedTuple):
    """Means over a minibatch, [] float32 each."""

    policy_loss: Array
    value_loss: Array
    entropy: Array
    kl: Array
    clip_fraction: Array

    @property
    def steering_kl(self) -> Array:
        """What the adaptive learning rate follows."""
        return self.kl


class UpdateContext(NamedTuple):
    """What stays the same during all updates on one rollout.

    Attributes:
      advantage_mean: [] over all samples of all GMIs (0 where not normalised).
      advantage_std: [] likewise (1 where not normalised).
      old_log_std: [A] of the policy that made the rollout.
    """

    advantage_mean: Array
    advantage_std: Array
    old_log_std: Array


def ppo_loss(
    params: ActorCriticParams,
    samples: Samples,
    context: UpdateContext,
    networks: ActorCritic,
    config: PpoConfig,
) -> tuple[Array, LossMetrics]:
    """Loss [] of one minibatch [B] and its parts.

    The minibatch mean is plain: the mean over GMIs of equal minibatches is the mean over all.
    """
    mean = networks.action_mean(params, samples.obs)
    advantage = (samples.advantage - context.advantage_mean) / context.advantage_std
    ratio = jnp.exp(log_prob(mean, params.log_std, samples.action) - samples.log_prob)
    clipped = jnp.clip(ratio, 1.0 - config.clipping_epsilon, 1.0 + config.clipping_epsilon)
    policy_loss = -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
    value_loss = _value_loss(networks.state_value(params, samples.obs), samples, config)
    bonus = entropy(params.log_std)
    bound_loss = jnp.mean(jnp.sum(jnp.maximum(jnp.abs(mean) - _ACTION_BOUND, 0.0) ** 2, -1))
    loss = (
        policy_loss
        + config.value_cost * value_loss
        - config.entropy_cost * bonus
        + config.bound_cost * bound_loss
    )
    kl = jnp.mean(kl_divergence(samples.mean, context.old_log_std, mean, params.log_std))
    outside = jnp.mean((jnp.abs(ratio - 1.0) > config.clipping_epsilon).astype(jnp.float32))
    return loss, LossMetrics(policy_loss, value_loss, bonus, kl, outside)


def _value_loss(value: Array, samples: Samples, config: PpoConfig) -> Array:
    target = samples.value + samples.advantage
    error = (value - target) ** 2
    if config.clip_value_loss:
        step = jnp.clip(value - samples.value, -config.clipping_epsilon, config.clipping_epsilon)
        error = jnp.maximum(error, (samples.value + step - target) ** 2)
    return 0.5 * jnp.mean(error)
