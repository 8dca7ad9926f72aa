"""PPO from top to bottom: rollout, advantages, losses, updates, iteration (arXiv:1707.06347).

These are pure functions. `iterate` is one program of each GMI, in which it exchanges numbers with
its peers. Programs hold nothing that depends on a GMI's rank, so that all GMIs share one entry of
the compilation cache.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from gmijax.collectives.interface import Peers
from gmijax.config import PpoConfig
from gmijax.learning.learner import (
    ActingWeights,
    Learner,
    TrainState,
    acting_weights,
    policy_figures,
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
    no_samples,
    normalize,
    std_of,
    without_outliers,
)
from gmijax.learning.policy import ActorCritic, ActorCriticParams
from gmijax.learning.unroll import Counts, Outcome, act, count, no_counts, outcome_of, unroll
from gmijax.learning.updates import (
    bound_loss,
    clipped_surrogate,
    explained_variance,
    mean_of_states,
    minibatch_order,
    run_updates,
    saturated_fraction,
)
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import BatchedEnv, BatchState, StepOutput
from gmijax.types import Array, PyTree

PpoLearner: TypeAlias = Learner[PpoConfig]


class Transition(NamedTuple):
    """One step of all environments; leading axis [N], or [T, N] of a rollout."""

    obs: Array
    action: Array
    output: Array
    reward: Array
    next_obs: Array
    terminated: Array
    truncated: Array
    is_diverged: Array | None  # None where nobody asks.


class Samples(NamedTuple):
    """Inputs of the loss, for every step; leading axes are [T, N], [T * N] or [B].

    Attributes:
      obs: [..., O], normalised as the policy saw it.
      action: [..., A], before clipping.
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


class RolloutStats(NamedTuple):
    """Statistics of a rollout that GMIs exchange; see `merge_stats`.

    Attributes:
      obs: moments of the raw observations, [O].
      advantage: moments of the advantages, [].
      target: moments of the value function's targets, [].
      counts: sums over all steps.
    """

    obs: Moments
    advantage: Moments
    target: Moments
    counts: Counts


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


def rollout(
    env: BatchedEnv,
    learner: PpoLearner,
    model: PyTree,
    weights: ActingWeights,
    env_state: BatchState,
) -> tuple[BatchState, Samples, RolloutStats]:
    """Runs T steps; the environments' state, samples [T, N], and this GMI's statistics."""

    def keep(
        before: BatchState, output: Array, action: Array, out: StepOutput
    ) -> tuple[Transition, Outcome]:
        bad = out.is_diverged if learner.config.obs_outliers == "diverged" else None
        step = out.reward, out.next_obs, out.terminated, out.truncated, bad
        return Transition(before.env.obs, action, output, *step), outcome_of(out)

    choose, length = partial(act, learner.networks, weights), learner.config.unroll_length
    env_state, (steps, outcomes) = unroll(env, choose, length, keep, model, env_state)
    samples = _with_advantages(learner, weights, steps)
    stats = RolloutStats(
        obs=_obs_moments(weights.moments, steps),
        advantage=moments_of(samples.advantage, 2),
        target=moments_of(samples.value + samples.advantage, 2),
        counts=count(steps.reward, outcomes),
    )
    return env_state, samples, stats


def _obs_moments(moments: Moments, steps: Transition) -> Moments:
    if steps.is_diverged is None:
        return moments_of(without_outliers(moments, steps.obs), 2)
    ended = steps.terminated | steps.truncated
    return moments_of_those(~until_diverged(steps.is_diverged, ended), steps.obs)


def until_diverged(is_diverged: Array, ended: Array) -> Array:
    """Which steps [T, N] belong to an episode that ends later on because its world diverged.

    Long before a number leaves all bounds it is thousands of times the usual.
    """

    def back(later: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        bad, over = step
        wild = bad | (later & ~over)
        return wild, wild

    none = jnp.zeros_like(ended[0])
    return jax.lax.scan(back, none, (is_diverged, ended), reverse=True)[1]


def _with_advantages(learner: PpoLearner, weights: ActingWeights, steps: Transition) -> Samples:
    networks, config = learner.networks, learner.config
    obs = normalize(weights.moments, steps.obs)
    values = state_values(networks, weights, obs)
    # V(s_{t+1}) is V of the next row, except where an episode ended and the next row is the
    # first observation of another one; a second pass over all rows is simple and cheap.
    next_values = state_values(networks, weights, normalize(weights.moments, steps.next_obs))
    advantage = gae(
        config.reward_scaling * steps.reward,
        values,
        next_values,
        steps.terminated.astype(jnp.float32),
        steps.truncated.astype(jnp.float32),
        discount=config.discounting,
        lam=config.gae_lambda,
    )
    logs = networks.distribution.log_prob(steps.output, weights.params.log_std, steps.action)
    return Samples(obs, steps.action, logs, steps.output, values, advantage)


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


def flatten(samples: Samples) -> Samples:
    """[T, N, ...] to [T * N, ...]."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples)


def merge_stats(stacked: RolloutStats) -> RolloutStats:
    """Statistics of all GMIs together; every leaf of `stacked` has a leading axis [K]."""
    counts = jax.tree.map(lambda x: jnp.sum(x, axis=0), stacked.counts)
    moments = (merge_all(part) for part in (stacked.obs, stacked.advantage, stacked.target))
    return RolloutStats(*moments, counts)


def no_stats(spec: EnvSpec, overflows: tuple[str, ...] = ()) -> RolloutStats:
    """Zeros in the structure of `RolloutStats`."""
    shapes = (spec.obs_size,), (), ()
    return RolloutStats(*map(no_samples, shapes), no_counts(spec, overflows))


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
        clip_fraction=_share(jnp.abs(ratio - 1.0) > config.clipping_epsilon),
        value_clip_fraction=_share(jnp.abs(value - old) > config.clipping_epsilon),
        saturated_fraction=jnp.mean(saturated_fraction(mode)),
    )


def _share(where: Array) -> Array:
    return jnp.mean(where.astype(jnp.float32))


def _value_loss(value: Array, old: Array, target: Array, config: PpoConfig) -> Array:
    error = (value - target) ** 2
    if config.clip_value_loss:
        step = jnp.clip(value - old, -config.clipping_epsilon, config.clipping_epsilon)
        error = jnp.maximum(error, (old + step - target) ** 2)
    return 0.5 * jnp.mean(error)


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


def update_context(learner: PpoLearner, state: TrainState, stats: RolloutStats) -> UpdateContext:
    """The constants of an iteration's updates; `stats` are those of all GMIs together."""
    mean, std = stats.advantage.mean, std_of(stats.advantage)
    if not learner.config.normalize_advantage:
        mean, std = jnp.zeros(()), jnp.ones(())
    return UpdateContext(mean, std, state.params.log_std, state.value_moments)


def learn(
    learner: PpoLearner,
    peers: Peers,
    state: TrainState,
    samples: Samples,
    stats: RolloutStats,
) -> tuple[TrainState, IterationMetrics]:
    """All updates of an iteration, on flat samples and this GMI's statistics."""
    everyone = peers.gather(stats)
    stats = merge_stats(everyone)
    if state.value_moments is not None:
        state = state._replace(value_moments=merge(state.value_moments, stats.target))
    context = update_context(learner, state, stats)
    order = minibatch_order(learner.config, state, peers.rank(), samples.advantage.shape[0])
    state, losses, rates = run_updates(
        learner, peers, gradients, state, samples, context, order, after=everyone
    )
    return finish(learner, state, stats, jax.tree.map(jnp.mean, losses), rates)


def finish(
    learner: PpoLearner, state: TrainState, stats: RolloutStats, losses: PpoLosses, rates: Array
) -> tuple[TrainState, IterationMetrics]:
    """Counts the iteration and takes its observations into the statistics.

    The statistics change only between iterations: the policy that is updated then sees the
    observations exactly as the policy that acted did, and the first probability ratio is 1.

    `stats` and `losses`, which are means over all minibatches, are of all GMIs.
    """
    state = state._replace(
        obs_moments=merge(state.obs_moments, stats.obs), iteration=state.iteration + 1
    )
    figures = {
        **policy_figures(state),
        "value/explained_variance": explained_variance(stats.target, stats.advantage),
    }
    spread = rate_figures(learner.config, rates)
    return state, IterationMetrics(stats.counts, losses, figures, spread)


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
    state, metrics = learn(learner, peers, state, flatten(samples), stats)
    return state, env_state, metrics
