"""PPO (arXiv:1707.06347) from top to bottom: rollout, advantages, updates, loss.

These are pure functions. `iterate` is one program of each GMI, in which it exchanges numbers with
its peers. Programs hold nothing that depends on a GMI's rank, so that all GMIs share one entry of
the compilation cache. What it builds on: acting in `gmijax.learning.unroll`, the loop over
minibatches in `gmijax.learning.updates`, networks and optimiser in `gmijax.learning.learner`.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from gmijax.collectives.interface import Peers
from gmijax.config import PpoConfig
from gmijax.learning.learner import (
    ActingWeights,
    Learner,
    TrainState,
    acting_weights,
    finish_iteration,
    policy_figures,
    rate_figures,
    state_values,
)
from gmijax.learning.normalize import Moments, in_units, merge, moments_of, normalize, std_of
from gmijax.learning.policy import ActorCritic, ActorCriticParams
from gmijax.learning.unroll import Counts, Drawn, act, count, outcome_of, unroll
from gmijax.learning.updates import (
    bound_loss,
    clipped_surrogate,
    explained_variance,
    mean_of_states,
    minibatch_order,
    run_updates,
    saturated_fraction,
)
from gmijax.ppo.statistics import RolloutStats, merge_stats, obs_moments
from gmijax.sim.wrappers import BatchedEnv, BatchState, StepOutput
from gmijax.types import Array, PyTree

PpoLearner: TypeAlias = Learner[PpoConfig]


def iterate(
    env: BatchedEnv,
    learner: PpoLearner,
    peers: Peers,
    model: PyTree,
    state: TrainState,
    env_state: BatchState,
) -> tuple[TrainState, BatchState, IterationMetrics]:
    """One iteration, together with the GMIs `peers`."""
    weights = acting_weights(learner, state)
    env_state, samples, stats = rollout(env, learner, model, weights, env_state)
    state, metrics = learn(learner, peers, state, samples, stats)
    return state, env_state, metrics


class Samples(NamedTuple):
    """Inputs of the loss, for every step; leading axes are [T, N], [T * N] or [B].

    Attributes:
      obs: [..., O], normalised as the policy saw it, in the precision of its hidden layers.
      action: [..., A], raw, as the distribution drew it.
      log_prob: [...], of the action when it was drawn.
      output: [..., H], of the policy's network when the action was drawn.
      value: [...], estimate when the action was drawn.
      advantage: [...], not normalised.
    """

    obs: Array
    action: Array
    log_prob: Array
    output: Array
    value: Array
    advantage: Array


def rollout(
    env: BatchedEnv,
    learner: PpoLearner,
    model: PyTree,
    weights: ActingWeights,
    env_state: BatchState,
) -> tuple[BatchState, Samples, RolloutStats]:
    """Runs T steps; the environments' state, samples [T, N], and this GMI's statistics."""
    networks, config = learner.networks, learner.config

    def keep(before: BatchState, drawn: Drawn, action: Array, out: StepOutput) -> Any:
        del action
        return before.env.obs, drawn, out

    env_state, (raw_obs, (output, action), out) = unroll(
        env, partial(act, networks, weights), config.unroll_length, keep, model, env_state
    )
    obs = normalize(weights.moments, raw_obs)
    values = state_values(networks, weights, obs)
    # V(s_{t+1}) is V of the next row, except where an episode ended and the next row is the
    # first observation of another one; a second pass over all rows is simple and cheap.
    next_values = state_values(networks, weights, normalize(weights.moments, out.next_obs))
    advantage = gae(
        config.reward_scaling * out.reward,
        values,
        next_values,
        out.terminated,
        out.truncated,
        discount=config.discounting,
        lam=config.gae_lambda,
    )
    log_prob = networks.distribution.log_prob(output, weights.params.log_std, action)
    stats = RolloutStats(
        obs=obs_moments(config, weights.moments, raw_obs, out),
        advantage=moments_of(advantage, 2),
        target=moments_of(values + advantage, 2),
        counts=count(out.reward, outcome_of(out)),
    )
    obs = obs.astype(networks.policy.dtype)  # The first layer would: fewer bytes to shuffle.
    return env_state, Samples(obs, action, log_prob, output, values, advantage), stats


def gae(
    rewards: Array,
    values: Array,
    next_values: Array,
    terminated: Array,
    truncated: Array,
    *,
    discount: float,
    lam: float,
) -> Array:
    """Advantages [T, N]; all arrays are [T, N] (Schulman et al. 2016, arXiv:1506.02438).

        delta_t = r_t + discount * (1 - terminated_t) * V(s_{t+1}) - V(s_t)
        A_t     = delta_t + discount * lam * (1 - ended_t) * A_{t+1}

    `next_values[t]` is V(s_{t+1}) before any auto-reset: a truncated step bootstraps from it, a
    terminated one does not, and neither lets the next episode's advantages through.
    """
    deltas = rewards + discount * (1.0 - terminated) * next_values - values
    decay = discount * lam * (1.0 - jnp.maximum(terminated, truncated))

    def back(later: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        delta, factor = step
        advantage = delta + factor * later
        return advantage, advantage

    return jax.lax.scan(back, jnp.zeros_like(deltas[0]), (deltas, decay), reverse=True)[1]


class IterationMetrics(NamedTuple):
    """Figures of one iteration, over all GMIs; leaves are scalars.

    No two of them may be the same number by definition: a GPU's program writes one of these to
    the host and copies it there to the other, for which the host waits until all else is done.

    Attributes:
      counts: sums over all steps.
      losses: means over all minibatches of the iteration.
      figures: others by the names that they are logged under.
      rates: of the learning rates of all updates, see `rate_figures`.
    """

    counts: Counts
    losses: PpoLosses
    figures: dict[str, Array]
    rates: dict[str, Array]


def learn(
    learner: PpoLearner,
    peers: Peers,
    state: TrainState,
    samples: Samples,
    stats: RolloutStats,
) -> tuple[TrainState, IterationMetrics]:
    """All updates of an iteration, on samples [T, N] and this GMI's statistics.

    The statistics of observations change only after them: the policy that is updated then sees
    the observations exactly as the policy that acted did, and the first probability ratio is 1.
    """
    samples = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples)
    everyone = peers.gather(stats)
    stats = merge_stats(everyone)
    if state.value_moments is not None:
        state = state._replace(value_moments=merge(state.value_moments, stats.target))
    context = update_context(learner, state, stats)
    order = minibatch_order(learner.config, state, peers.rank(), samples.advantage.shape[0])
    state, losses, rates = run_updates(
        learner, peers, gradients, state, samples, context, order, after=everyone
    )
    means = jax.tree.map(jnp.mean, losses)
    state = finish_iteration(learner, state, stats.obs)
    figures = {
        **policy_figures(state),
        "value/explained_variance": explained_variance(stats.target, stats.advantage),
    }
    return state, IterationMetrics(
        stats.counts, means, figures, rate_figures(learner.config, rates)
    )


class UpdateContext(NamedTuple):
    """Constants of all updates on one rollout.

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


def update_context(learner: PpoLearner, state: TrainState, stats: RolloutStats) -> UpdateContext:
    """The constants of an iteration's updates; `stats` are those of all GMIs together."""
    mean, std = stats.advantage.mean, std_of(stats.advantage)
    if not learner.config.normalize_advantage:
        mean, std = jnp.zeros(()), jnp.ones(())
    return UpdateContext(mean, std, state.params.log_std, state.value_moments)


def gradients(
    learner: PpoLearner,
    params: ActorCriticParams,
    samples: Samples,
    context: UpdateContext,
    indices: Array,
) -> tuple[ActorCriticParams, PpoLosses]:
    """Gradient and loss parts on the minibatch `indices` [B] of flat samples [T * N]."""
    minibatch = jax.tree.map(lambda x: x[indices], samples)
    return jax.grad(ppo_loss, has_aux=True)(
        params, minibatch, context, learner.networks, learner.config
    )


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
    ratio = jnp.exp(logs - samples.log_prob)
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
