"""A rollout of PPO: steps, advantages (arXiv:1506.02438), and statistics that GMIs exchange."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from gmijax.config import PpoConfig
from gmijax.learning.learner import ActingWeights, Learner, state_values
from gmijax.learning.normalize import (
    Moments,
    merge_all,
    moments_of,
    moments_of_those,
    no_samples,
    normalize,
    without_outliers,
)
from gmijax.learning.unroll import Counts, Outcome, act, count, no_counts, outcome_of, unroll
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
      obs: [..., O], normalised as the policy saw it, in the precision of its hidden layers.
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
    obs = obs.astype(networks.policy.dtype)  # The first layer would: fewer bytes to shuffle.
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
    return RolloutStats(
        merge_all(stacked.obs), merge_all(stacked.advantage), merge_all(stacked.target), counts
    )


def no_stats(spec: EnvSpec, overflows: tuple[str, ...] = ()) -> RolloutStats:
    """Zeros in the structure of `RolloutStats`."""
    obs, one = no_samples((spec.obs_size,)), no_samples(())
    return RolloutStats(obs, one, one, no_counts(spec, overflows))
