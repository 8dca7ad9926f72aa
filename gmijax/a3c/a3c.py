"""Advantage actor-critic on batches of whole unrolls (arXiv:1602.01783): loss and update.

With the defaults this is what the field calls APPO: V-trace, a clipped surrogate, and several
passes over a batch.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gmijax.a3c.targets import (
    MIN_WEIGHT,
    A3cLearner,
    Targets,
    Unrolls,
    batch_targets,
    weighted_mean,
)
from gmijax.collectives.interface import Collectives, Communicator, TracedStep
from gmijax.config import A3cConfig
from gmijax.learning.learner import (
    TrainState,
    acting_moments,
    acting_weights,
    finish_iteration,
    pack_weights,
    rate_figures,
    with_targets,
)
from gmijax.learning.normalize import (
    in_units,
    merge_all,
    moments_of,
    normalize,
    without_outliers,
)
from gmijax.learning.policy import ActorCritic, ActorCriticParams
from gmijax.learning.updates import (
    bound_loss,
    clipped_surrogate,
    explained_variance,
    minibatch_order,
    probability_ratio,
    run_updates,
    saturated_fraction,
)
from gmijax.types import Array


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
        return self.kl / jnp.maximum(self.weight, MIN_WEIGHT)


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
    policy_loss = weighted_mean(_policy_terms(logs, targets, config), weight)
    target = targets.value
    if targets.value_moments is not None:
        target = in_units(targets.value_moments, target)
    value_loss = 0.5 * weighted_mean((values - target) ** 2, weight)
    entropy = distribution.entropy(output, params.log_std)
    bonus = weighted_mean(entropy, weight)  # Also of one [] that all states share.
    loss = (
        policy_loss
        + config.value_cost * value_loss
        - config.entropy_cost * bonus
        + config.bound_cost * weighted_mean(bound_loss(mode), weight)
    )
    moved = distribution.kl_divergence(targets.output, targets.log_std, output, params.log_std)
    return loss, A3cLosses(
        policy_loss,
        value_loss,
        bonus,
        weighted_mean(moved, weight),
        targets.behaviour_kl,
        weighted_mean(saturated_fraction(mode), weight),
        jnp.mean(weight),
    )


def _policy_terms(logs: Array, targets: Targets, config: A3cConfig) -> Array:
    if config.clipping_epsilon is None:
        return -logs * targets.step_weight * targets.advantage
    ratios = probability_ratio(logs, targets.log_prob)
    gain = clipped_surrogate(ratios, targets.advantage, config.clipping_epsilon)
    return -targets.step_weight * gain


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


class UpdateResult(NamedTuple):
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


def make_update(learner: A3cLearner, comm: Communicator) -> TracedStep:
    """The update as a program: `(state, (batch, weight)) -> (state, (), Updated)`.

    The batch has unrolls [T, B]. The weight [B] is 0 for unrolls that are too old to learn from;
    the others weigh alike on all trainers, and the mean over all of them is 1.
    """
    return comm.program(partial(update, learner), donates_own=False)


def update(
    learner: A3cLearner,
    collectives: Collectives,
    _: Any,
    state: TrainState,
    weighted: tuple[Unrolls, Array],
) -> tuple[TrainState, tuple[()], UpdateResult]:
    """See `make_update`."""
    batch, weight = weighted
    targets = batch_targets(learner, state, batch, weight)
    obs = without_outliers(acting_moments(learner.config, state), batch.state)
    everyone = collectives.all_gather((moments_of(obs, 2), *targets.fit))
    seen, target, error = map(merge_all, everyone)
    state = with_targets(learner, state, target)
    targets = targets._replace(value_moments=state.value_moments)
    order = minibatch_order(learner.config, state, collectives.rank(), batch.reward.shape[1])
    state, losses, rates = run_updates(
        learner, collectives, gradients, state, batch, targets, order, after=everyone
    )
    # Counts the batch, which makes a new version of the policy, and adds its statistics.
    state = finish_iteration(learner, state, seen)
    weights = pack_weights(acting_weights(learner, state))
    means = jax.tree.map(jnp.mean, losses)
    explained = explained_variance(target, error)
    return state, (), UpdateResult(weights, means, rate_figures(learner.config, rates), explained)
