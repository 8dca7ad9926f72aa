"""The loss of PPO (arXiv:1707.06347) on a minibatch."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from gmijax.config import PpoConfig
from gmijax.learning.normalize import Moments, in_units
from gmijax.learning.policy import ActorCritic, ActorCriticParams
from gmijax.learning.updates import (
    bound_loss,
    clipped_surrogate,
    mean_of_states,
    probability_ratio,
    saturated_fraction,
)
from gmijax.ppo.rollout import Samples
from gmijax.types import Array


class UpdateContext(NamedTuple):
    """Constants of all updates on one rollout, or of one pass over it.

    Attributes:
      advantage_mean: [] over all samples of all GMIs (0 where not normalised).
      advantage_std: [] likewise (1 where not normalised).
      old_log_std: [A] of the policy that made the rollout.
      value_moments: see `TrainState`.
    """

    advantage_mean: Array
    advantage_std: Array
    old_log_std: Array
    value_moments: Moments | None = None


class PpoLosses(NamedTuple):
    """Means over a minibatch, [] float32 each.

    Attributes:
      policy_loss: minus the clipped surrogate.
      value_loss: half the squared error of the values, clipped if that is wanted.
      entropy: of the policy, in nats.
      kl: divergence of the policy from the one that made the rollout, in nats.
      clip_fraction: share of samples whose probability ratio is beyond the clip range.
      value_clip_fraction: share of samples whose value has moved beyond the clip range.
      saturated_fraction: see the function of this name.
    """

    policy_loss: Array
    value_loss: Array
    entropy: Array
    kl: Array
    clip_fraction: Array
    value_clip_fraction: Array
    saturated_fraction: Array

    @property
    def steering_kl(self) -> Array:
        """The divergence that the adaptive learning rate follows."""
        return self.kl


def ppo_loss(
    params: ActorCriticParams,
    samples: Samples,
    context: UpdateContext,
    networks: ActorCritic,
    config: PpoConfig,
) -> tuple[Array, PpoLosses]:
    """Loss [] of one minibatch [B] and its parts.

    The minibatch mean is plain: the mean over GMIs of equal minibatches is the mean over all.
    """
    output, distribution = networks.output(params, samples.obs), networks.distribution
    mode = distribution.mode(output)
    advantage = (samples.advantage - context.advantage_mean) / context.advantage_std
    logs = distribution.log_prob(output, params.log_std, samples.action)
    ratio = probability_ratio(logs, samples.log_prob)
    policy_loss = -jnp.mean(clipped_surrogate(ratio, advantage, config.clipping_epsilon))
    value = networks.state_value(params, samples.obs)
    old, target = samples.value, samples.value + samples.advantage
    if context.value_moments is not None:
        old, target = (in_units(context.value_moments, x) for x in (old, target))
    value_loss = _value_loss(value, old, target, config)
    bonus = mean_of_states(distribution.entropy(output, params.log_std))
    loss = (
        policy_loss
        + config.value_cost * value_loss
        - config.entropy_cost * bonus
        + config.bound_cost * jnp.mean(bound_loss(mode))
    )
    kl = jnp.mean(
        distribution.kl_divergence(samples.output, context.old_log_std, output, params.log_std)
    )
    return loss, PpoLosses(
        policy_loss,
        value_loss,
        bonus,
        kl,
        clip_fraction=jnp.mean(jnp.abs(ratio - 1.0) > config.clipping_epsilon),
        value_clip_fraction=jnp.mean(jnp.abs(value - old) > config.clipping_epsilon),
        saturated_fraction=jnp.mean(saturated_fraction(mode)),
    )


def _value_loss(value: Array, old: Array, target: Array, config: PpoConfig) -> Array:
    error = (value - target) ** 2
    if config.clip_value_loss:
        step = jnp.clip(value - old, -config.clipping_epsilon, config.clipping_epsilon)
        error = jnp.maximum(error, (old + step - target) ** 2)
    return 0.5 * jnp.mean(error)
