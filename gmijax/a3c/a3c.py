"""Advantage actor-critic on batches of whole unrolls (arXiv:1602.01783): targets, loss, update.

With the defaults this is what the field calls APPO: V-trace, a clipped surrogate, and several
passes over a batch.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from gmijax.a3c.returns import Returns, n_step_returns, vtrace
from gmijax.collectives.interface import Peers, Reducer, TracedStep
from gmijax.config import A3cConfig
from gmijax.learning.learner import (
    Learner,
    TrainState,
    acting_moments,
    acting_weights,
    pack_weights,
    rate_figures,
    state_values,
)
from gmijax.learning.normalize import (
    Moments,
    in_units,
    merge,
    merge_all,
    moments_of,
    moments_of_those,
    normalize,
    without_outliers,
)
from gmijax.learning.policy import ActorCritic, ActorCriticParams
from gmijax.learning.updates import (
    bound_loss,
    clipped_surrogate,
    explained_variance,
    mean_of_states,
    minibatch_order,
    run_updates,
    saturated_fraction,
)
from gmijax.types import Array

A3cLearner: TypeAlias = Learner[A3cConfig]

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
      step_weight: [T, B] of the policy gradient: V-trace's, and 0 where `_is_learnt` says so.
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


class A3cLosses(NamedTuple):
    """Means over a minibatch, [] float32 each, under the weights of its unrolls.

    Weights are 1 in the mean over all minibatches of a batch, and not in each of them. For the
    losses see `a3c_loss`.

    Attributes:
      entropy: of the policy, in nats.
      kl: divergence of the policy from itself before the first pass, in nats.
      behaviour_kl: of the policy before the first pass from those that acted, estimated.
      saturated_fraction: see the function of this name.
      weight: mean weight of the unrolls.
    """

    policy_loss: Array
    value_loss: Array
    entropy: Array
    kl: Array
    behaviour_kl: Array
    saturated_fraction: Array
    weight: Array

    @property
    def steering_kl(self) -> Array:
        """`kl` as a mean over what is learnt from; 0, which steers nothing, where that is none."""
        return self.kl / jnp.maximum(self.weight, _MIN_WEIGHT)


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
    ratios = jnp.exp(log_ratios)
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
        behaviour_kl=_mean(ratios - 1.0 - log_ratios, weight),
        fit=(fresh_moments(returns.value), fresh_moments(returns.value - values[:-1])),
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


def _normalised(returns: Returns, weight: Array, config: A3cConfig) -> Array:
    """Advantages [T, B] with mean 0 and deviation 1 under the weights of the steps."""
    if not config.normalize_advantage:
        return returns.advantage
    total = jnp.maximum(jnp.sum(returns.rho * weight), _MIN_WEIGHT)
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


def a3c_loss(
    params: ActorCriticParams,
    batch: Unrolls,
    targets: Targets,
    networks: ActorCritic,
    config: A3cConfig,
) -> tuple[Array, A3cLosses]:
    """Loss [] of a minibatch of unrolls and its parts.

    Policy gradient with the advantages of `targets`, half the squared error of the values, minus
    the entropy bonus (arXiv:1602.01783, section 4), means over all steps under the weights of
    their unrolls. The divisor is the same on all trainers, so that their mean weighs alike what
    each of them learns from, however much that is.
    With `clipping_epsilon` the policy's part is that of PPO (arXiv:1707.06347) relative to the
    policy before the first pass, under the weights of the steps: how old experience is, and how
    far one batch may move the policy, are two questions (arXiv:2110.00641, section 3).
    """
    weight, obs = targets.weight, normalize(targets.moments, batch.state)
    output, distribution = networks.output(params, obs), networks.distribution
    mode = distribution.mode(output)
    logs = distribution.log_prob(output, params.log_std, batch.action)
    values = networks.state_value(params, obs)
    policy_loss = _mean(_policy_terms(logs, targets, config), weight)
    target = targets.value
    if targets.value_moments is not None:
        target = in_units(targets.value_moments, target)
    value_loss = 0.5 * _mean((values - target) ** 2, weight)
    entropy = distribution.entropy(output, params.log_std)
    bonus = mean_of_states(entropy)
    loss = (
        policy_loss
        + config.value_cost * value_loss
        - config.entropy_cost * bonus * jnp.mean(weight)
        + config.bound_cost * _mean(bound_loss(mode), weight)
    )
    moved = distribution.kl_divergence(targets.output, targets.log_std, output, params.log_std)
    return loss, A3cLosses(
        policy_loss,
        value_loss,
        bonus,
        _mean(moved, weight),
        targets.behaviour_kl,
        _mean(saturated_fraction(mode), weight),
        jnp.mean(weight),
    )


def _policy_terms(logs: Array, targets: Targets, config: A3cConfig) -> Array:
    if config.clipping_epsilon is None:
        return -logs * targets.step_weight * targets.advantage
    ratios = jnp.exp(logs - targets.log_prob)
    gain = clipped_surrogate(ratios, targets.advantage, config.clipping_epsilon)
    return -targets.step_weight * gain


def _mean(values: Array, weight: Array) -> Array:
    """Mean [] of `values` [T, B] under `weight` [B], which is 1 in the mean over all batches."""
    return jnp.mean(values * weight)


def gradients(
    learner: A3cLearner,
    params: ActorCriticParams,
    batch: Unrolls,
    targets: Targets,
    indices: Array,
) -> tuple[ActorCriticParams, A3cLosses]:
    """Gradient and loss parts on the unrolls `indices` [b] of a batch."""
    minibatch: Unrolls = jax.tree.map(lambda x: x[:, indices], batch)
    theirs = targets._replace(
        weight=targets.weight[indices],
        output=targets.output[:, indices],
        log_prob=targets.log_prob[:, indices],
        value=targets.value[:, indices],
        advantage=targets.advantage[:, indices],
        step_weight=targets.step_weight[:, indices],
    )
    return jax.grad(a3c_loss, has_aux=True)(
        params, minibatch, theirs, learner.networks, learner.config
    )


class Updated(NamedTuple):
    """Results of an update, beside the state.

    Attributes:
      weights: [W] float32, to publish; see `pack_weights`.
      losses: means over all minibatches of all trainers, [] each.
      rates: of all minibatches, see `rate_figures`.
      explained_variance: [], see the function of this name.
    """

    weights: Array
    losses: A3cLosses
    rates: dict[str, Array]
    explained_variance: Array


def make_update(learner: A3cLearner, reducer: Reducer) -> TracedStep:
    """The update as a program: `(state, (batch, weight)) -> (state, (), Updated)`.

    The batch has unrolls [T, B]. The weight [B] is 0 for unrolls that are too old to learn from;
    the others weigh alike on all trainers, and the mean over all of them is 1.
    """
    return reducer.program(partial(update, learner), donates_own=False)


def update(
    learner: A3cLearner,
    peers: Peers,
    _: Any,
    state: TrainState,
    weighted: tuple[Unrolls, Array],
) -> tuple[TrainState, tuple[()], Updated]:
    """See `make_update`."""
    batch, weight = weighted
    targets = batch_targets(learner, state, batch, weight)
    observed = without_outliers(acting_moments(learner, state), batch.state)
    everyone = peers.gather((moments_of(observed, 2), *targets.fit))
    seen, target, error = map(merge_all, everyone)
    if state.value_moments is not None:
        state = state._replace(value_moments=merge(state.value_moments, target))
        targets = targets._replace(value_moments=state.value_moments)
    order = minibatch_order(learner.config, state, peers.rank(), batch.reward.shape[1])
    state, losses, rates = run_updates(
        learner, peers, gradients, state, batch, targets, order, after=everyone
    )
    # Counts the batch, which makes a new version of the policy, and takes in its statistics.
    state = state._replace(
        obs_moments=merge(state.obs_moments, seen), iteration=state.iteration + 1
    )
    weights = pack_weights(acting_weights(learner, state))
    means = jax.tree.map(jnp.mean, losses)
    explained = explained_variance(target, error)
    return state, (), Updated(weights, means, rate_figures(learner.config, rates), explained)
