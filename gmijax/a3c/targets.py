"""Unrolls, and what they teach: targets of values and advantages (arXiv:1602.01783)."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from gmijax.a3c.returns import Returns, n_step_returns, vtrace
from gmijax.config import A3cConfig
from gmijax.learning.learner import (
    Learner,
    TrainState,
    acting_weights,
    next_values,
    state_values,
)
from gmijax.learning.normalize import Moments, moments_of_those, normalize
from gmijax.learning.updates import probability_ratio
from gmijax.types import Array

A3cLearner: TypeAlias = Learner[A3cConfig]

_MIN_STD = 1e-8
MIN_WEIGHT = 1e-8


class Unrolls(NamedTuple):
    """B unrolls of T steps, as agents made them; fields are the channels they travelled in.

    Attributes:
      state: [T, B, O] raw observations.
      action: [T, B, A], raw, as the distribution drew it.
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


class Targets(NamedTuple):
    """Constants of all passes over one batch, by the policy before the first one.

    Attributes:
      weight: [B], 0 for unrolls that are too old to learn from; the others weigh alike, so that
        the mean over the batches of all trainers is 1.
      moments: statistics that observations are normalised with.
      output: [T, B, H] of that policy's network.
      log_std: [A] likewise.
      log_prob: [T, B], of the actions under that policy.
      value: [T, B], target of the value function.
      advantage: [T, B], normalised if that is wanted.
      step_weight: [T, B] of the policy gradient: V-trace's, and 0 where `_is_learnt` is true.
      behaviour_kl: [], its estimated divergence from the policies that acted, in nats.
      fit: moments of the values' targets, and of these minus the values.
      value_moments: see `TrainState`.
    """

    weight: Array
    moments: Moments
    output: Array
    log_std: Array
    log_prob: Array
    value: Array
    advantage: Array
    step_weight: Array
    behaviour_kl: Array
    fit: tuple[Moments, Moments]
    value_moments: Moments | None = None


def batch_targets(
    learner: A3cLearner, state: TrainState, batch: Unrolls, weight: Array
) -> Targets:
    """Targets of a batch by the policy and the values before the first pass over it.

    They are not renewed between passes: values that have been fitted to the same batch know its
    rewards, and leave nothing for the advantages.
    """
    networks, config, params = learner.networks, learner.config, state.params
    weights = acting_weights(learner, state)
    moments = weights.moments
    obs = normalize(moments, jnp.concatenate([batch.state, batch.bootstrap]))
    output = networks.output(params, obs[:-1])
    logs = networks.distribution.log_prob(output, params.log_std, batch.action)
    log_ratios = logs - batch.log_prob
    ratios = probability_ratio(logs, batch.log_prob)
    values = state_values(networks, weights, obs)
    returns = returns_of(batch, values, ratios, config)
    fresh_moments = partial(moments_of_those, jnp.broadcast_to(weight > 0, ratios.shape))
    advantage = _normalised(returns, weight, config)
    # Copies, because the updates donate the state that they would alias.
    copied_moments, log_std = jax.tree.map(jnp.copy, (moments, params.log_std))
    return Targets(
        weight=weight,
        moments=copied_moments,
        output=output,
        log_std=log_std,
        log_prob=logs,
        value=returns.value,
        advantage=advantage,
        step_weight=jnp.where(_is_learnt(ratios, advantage, config), 0.0, returns.rho),
        # An estimate that is never negative and needs the actions only.
        behaviour_kl=weighted_mean(ratios - 1.0 - log_ratios, weight),
        fit=(fresh_moments(returns.value), fresh_moments(returns.value - values[:-1])),
    )


def returns_of(batch: Unrolls, values: Array, ratios: Array, config: A3cConfig) -> Returns:
    """Targets [T, B] from `values` [T + 1, B] and `ratios` [T, B]; V-trace or plain."""
    terminated, truncated = jnp.moveaxis(batch.done.astype(jnp.float32), -1, 0)
    follows = next_values(values, truncated, batch.cut_value)
    steps = (
        config.reward_scaling * batch.reward,
        *(values[:-1], follows, terminated, truncated),
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


def _normalised(returns: Returns, weight: Array, config: A3cConfig) -> Array:
    """Advantages [T, B] with mean 0 and deviation 1 under the weights of the steps."""
    if not config.normalize_advantage:
        return returns.advantage
    total = jnp.maximum(jnp.sum(returns.rho * weight), MIN_WEIGHT)
    mean = jnp.sum(returns.rho * weight * returns.advantage) / total
    centred = returns.advantage - mean
    std = jnp.sqrt(jnp.sum(returns.rho * weight * centred**2) / total)
    return centred / (std + _MIN_STD)


def _is_learnt(ratios: Array, advantage: Array, config: A3cConfig) -> Array:
    """Where the policy has moved beyond the clip range since the step, and the right way.

    Gradients come late: what a step teaches has been learnt from others meanwhile, and to learn
    it again would carry the policy too far.
    """
    if config.clipping_epsilon is None:
        return jnp.zeros(ratios.shape, bool)
    high, low = 1.0 + config.clipping_epsilon, 1.0 - config.clipping_epsilon
    return ((ratios > high) & (advantage > 0)) | ((ratios < low) & (advantage < 0))


def weighted_mean(values: Array, weight: Array) -> Array:
    """Mean [] of `values` [T, B] under `weight` [B], which is 1 in the mean over all batches."""
    return jnp.mean(values * weight)
