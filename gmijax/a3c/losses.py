"""The loss of advantage actor-critic on whole unrolls."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from gmijax.a3c.returns import Returns, n_step_returns, vtrace
from gmijax.config import A3cConfig
from gmijax.normalize import Moments, normalize
from gmijax.policy import ActorCritic, ActorCriticParams, entropy, kl_divergence, log_prob
from gmijax.types import Array

_ACTION_BOUND = 1.1
"""Means beyond this are penalised; actions are clipped to 1, and a little room is harmless."""

_MIN_STD = 1e-8
_MIN_WEIGHT = 1e-8


class Unrolls(NamedTuple):
    """B unrolls of T steps, as agents made them; fields are the channels they travelled in.

    Attributes:
      state: [T, B, O] raw observations.
      action: [T, B, A], before clipping.
      reward: [T, B], unscaled.
      done: [T, B, 2] bool: the task has ended; time ran out.
      log_prob: [T, B], of the action under the policy that acted.
      cut_value: [T, B], that policy's value of what the action led to, where time ran out; the
        next observation is then another episode's.
      bootstrap: [1, B, O], the observation that the next unroll begins with.
    """

    state: Array
    action: Array
    reward: Array
    done: Array
    log_prob: Array
    cut_value: Array
    bootstrap: Array


class UpdateContext(NamedTuple):
    """What stays the same during all passes over one batch: the policy before the first one.

    Attributes:
      weight: [B], 0 for unrolls that are too old to learn from; the others weigh alike, so that
        the mean over the batches of all trainers is 1.
      moments: statistics that observations are normalised with.
      mean: [T, B, A] of that policy.
      log_std: [A] likewise.
      log_prob: [T, B], of the actions under that policy.
      value: [T, B], target of the value function.
      advantage: [T, B], normalised if that is wanted.
      step_weight: [T, B] of the policy gradient: V-trace's, and 0 where `_is_learnt` says so.
      behaviour_kl: [], its estimated divergence from the policies that acted, in nats.
    """

    weight: Array
    moments: Moments
    mean: Array
    log_std: Array
    log_prob: Array
    value: Array
    advantage: Array
    step_weight: Array
    behaviour_kl: Array


class LossMetrics(NamedTuple):
    """Means over a minibatch, [] float32 each, under the weights of its unrolls.

    Weights are 1 in the mean over all minibatches of a batch, and not in each of them.

    Attributes:
      policy_loss: see `a3c_loss`.
      value_loss: likewise.
      entropy: of the policy, in nats.
      kl: divergence of the policy from itself before the first pass, in nats.
      behaviour_kl: of the policy before the first pass from those that acted, estimated.
      weight: mean weight of the unrolls.
    """

    policy_loss: Array
    value_loss: Array
    entropy: Array
    kl: Array
    behaviour_kl: Array
    weight: Array

    @property
    def steering_kl(self) -> Array:
        """`kl` as a mean over what is learnt from; 0, which steers nothing, where that is none."""
        return self.kl / jnp.maximum(self.weight, _MIN_WEIGHT)


def update_context(
    params: ActorCriticParams,
    batch: Unrolls,
    weight: Array,
    moments: Moments,
    networks: ActorCritic,
    config: A3cConfig,
) -> UpdateContext:
    """Targets of a batch by the policy and the values before the first pass over it.

    They are not renewed between passes: values that have been fitted to the same batch know its
    rewards, and leave nothing for the advantages.
    """
    obs = normalize(moments, jnp.concatenate([batch.state, batch.bootstrap]))
    mean = networks.action_mean(params, obs[:-1])
    logs = log_prob(mean, params.log_std, batch.action)
    log_ratios = logs - batch.log_prob
    ratios = jnp.exp(log_ratios)
    targets = returns_of(batch, networks.state_value(params, obs), ratios, config)
    advantage = _normalised(targets, weight, config)
    return UpdateContext(
        weight=weight,
        moments=moments,
        mean=mean,
        log_std=params.log_std,
        log_prob=logs,
        value=targets.value,
        advantage=advantage,
        step_weight=jnp.where(_is_learnt(ratios, advantage, config), 0.0, targets.rho),
        # An estimate that is never negative and needs the actions only.
        behaviour_kl=_mean(ratios - 1.0 - log_ratios, weight),
    )


def a3c_loss(
    params: ActorCriticParams,
    batch: Unrolls,
    context: UpdateContext,
    networks: ActorCritic,
    config: A3cConfig,
) -> tuple[Array, LossMetrics]:
    """Loss [] of a minibatch of unrolls and its parts.

    Policy gradient with the advantages of `context`, half the squared error of the values, minus
    the entropy bonus (arXiv:1602.01783, section 4), means over all steps under the weights of
    their unrolls. The divisor is the same on all trainers, so that their mean weighs alike what
    each of them learns from, however much that is.
    With `clipping_epsilon` the policy's part is that of PPO (arXiv:1707.06347) relative to the
    policy before the first pass, under the weights of the steps: how old experience is, and how
    far one batch may move the policy, are two questions (arXiv:2110.00641, section 3).
    """
    weight, obs = context.weight, normalize(context.moments, batch.state)
    mean = networks.action_mean(params, obs)
    logs = log_prob(mean, params.log_std, batch.action)
    values = networks.state_value(params, obs)
    policy_loss = _mean(_policy_terms(logs, context, config), weight)
    value_loss = 0.5 * _mean((values - context.value) ** 2, weight)
    bonus = entropy(params.log_std)
    beyond = jnp.sum(jnp.maximum(jnp.abs(mean) - _ACTION_BOUND, 0.0) ** 2, -1)
    loss = (
        policy_loss
        + config.value_cost * value_loss
        - config.entropy_cost * bonus * jnp.mean(weight)
        + config.bound_cost * _mean(beyond, weight)
    )
    moved = kl_divergence(context.mean, context.log_std, mean, params.log_std)
    return loss, LossMetrics(
        policy_loss,
        value_loss,
        bonus,
        _mean(moved, weight),
        context.behaviour_kl,
        jnp.mean(weight),
    )


def returns_of(batch: Unrolls, values: Array, ratios: Array, config: A3cConfig) -> Returns:
    """Targets [T, B] from `values` [T + 1, B] and `ratios` [T, B]; V-trace or plain."""
    terminated, truncated = jnp.moveaxis(batch.done.astype(jnp.float32), -1, 0)
    next_values = jnp.where(truncated > 0, batch.cut_value, values[1:])
    steps = (
        config.reward_scaling * batch.reward,
        *(values[:-1], next_values, terminated, truncated),
    )
    if not config.vtrace:
        return n_step_returns(*steps, discount=config.discounting)
    return vtrace(
        *steps,
        ratios,
        discount=config.discounting,
        lam=config.gae_lambda,
        rho_clip=config.rho_clip,
        trace_clip=config.trace_clip,
    )


def _policy_terms(logs: Array, context: UpdateContext, config: A3cConfig) -> Array:
    if config.clipping_epsilon is None:
        return -logs * context.step_weight * context.advantage
    ratios = jnp.exp(logs - context.log_prob)
    clipped = jnp.clip(ratios, 1.0 - config.clipping_epsilon, 1.0 + config.clipping_epsilon)
    gain = jnp.minimum(ratios * context.advantage, clipped * context.advantage)
    return -context.step_weight * gain


def _is_learnt(ratios: Array, advantage: Array, config: A3cConfig) -> Array:
    """Where the policy has moved beyond the clip range since the step, and the right way.

    Gradients come late: what a step teaches has been learnt from others meanwhile, and to learn
    it again would carry the policy too far.
    """
    if config.clipping_epsilon is None:
        return jnp.zeros(ratios.shape, bool)
    high, low = 1.0 + config.clipping_epsilon, 1.0 - config.clipping_epsilon
    return ((ratios > high) & (advantage > 0)) | ((ratios < low) & (advantage < 0))


def _normalised(targets: Returns, weight: Array, config: A3cConfig) -> Array:
    """Advantages [T, B] with mean 0 and deviation 1 under the weights of the steps."""
    if not config.normalize_advantage:
        return targets.advantage
    total = jnp.maximum(jnp.sum(targets.rho * weight), _MIN_WEIGHT)
    mean = jnp.sum(targets.rho * weight * targets.advantage) / total
    centred = targets.advantage - mean
    std = jnp.sqrt(jnp.sum(targets.rho * weight * centred**2) / total)
    return centred / (std + _MIN_STD)


def _mean(values: Array, weight: Array) -> Array:
    """Mean [] of `values` [T, B] under `weight` [B], which is 1 in the mean over all batches."""
    return jnp.mean(values * weight)
