"""A rollout of PPO: T steps, the advantages of what was done, and its statistics."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from gmijax.config import PpoConfig
from gmijax.learning.learner import ActingWeights, Learner, in_rewards, next_values, state_values
from gmijax.learning.normalize import moments_of, normalize
from gmijax.learning.unroll import Drawn, act, count, outcome_of, unroll
from gmijax.ppo.statistics import RolloutStats, obs_moments
from gmijax.sim.wrappers import BatchedEnv, BatchState, StepOutput
from gmijax.types import Array, PyTree

PpoLearner: TypeAlias = Learner[PpoConfig]


class Samples(NamedTuple):
    """Inputs of the loss, for every step; leading axes are [T, N], [T * N] or [B].

    Attributes:
      obs: [..., O], normalised as the policy saw it, in the precision of its hidden layers.
      action: [..., A], raw, as the distribution drew it.
      log_prob: [...], of the action when it was drawn.
      output: [..., H], of the policy's network when the action was drawn.
      value: [...], estimate when the action was drawn, or when the pass began.
      advantage: [...], not normalised.
    """

    obs: Array
    action: Array
    log_prob: Array
    output: Array
    value: Array
    advantage: Array


class RolloutTrajectory(NamedTuple):
    """What, with values of the observations, advantages follow from.

    Attributes:
      reward: [T, N], scaled.
      terminated, truncated: [T, N] bool, the task has ended; time ran out.
      cut_output: [T, N], of the value network of the rollout for s_{t+1}; it counts where time
        ran out.
      last_obs: [1, N, O], normalised, after the last step.
    """

    reward: Array
    terminated: Array
    truncated: Array
    cut_output: Array
    last_obs: Array


def rollout(
    env: BatchedEnv,
    learner: PpoLearner,
    model: PyTree,
    weights: ActingWeights,
    env_state: BatchState,
) -> tuple[BatchState, Samples, RolloutTrajectory, RolloutStats]:
    """Runs T steps.

    Returns:
      The environments' state, samples [T, N], what advantages can be computed anew from, and
      this GMI's statistics.
    """
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
    next_obs = normalize(weights.moments, out.next_obs)
    next_outputs = networks.state_value(weights.params, next_obs)
    rewards = config.reward_scaling * out.reward
    trajectory = RolloutTrajectory(
        rewards, out.terminated, out.truncated, next_outputs, next_obs[-1:]
    )
    advantage = _advantages(config, trajectory, values, in_rewards(weights, next_outputs))
    log_prob = networks.distribution.log_prob(output, weights.params.log_std, action)
    stats = RolloutStats(
        obs=obs_moments(config, weights.moments, raw_obs, out),
        advantage=moments_of(advantage, 2),
        target=moments_of(values + advantage, 2),
        counts=count(out.reward, outcome_of(out)),
    )
    obs = obs.astype(networks.policy.dtype)  # The first layer would: fewer bytes to shuffle.
    samples = Samples(obs, action, log_prob, output, values, advantage)
    return env_state, samples, trajectory, stats


def valued_anew(
    learner: PpoLearner, weights: ActingWeights, samples: Samples, trajectory: RolloutTrajectory
) -> Samples:
    """`samples` [T, N] with values and advantages by other weights than those that acted."""
    rows = jnp.concatenate([samples.obs, trajectory.last_obs.astype(samples.obs.dtype)])
    values = state_values(learner.networks, weights, rows)
    cut_values = in_rewards(weights, trajectory.cut_output)
    follows = next_values(values, trajectory.truncated, cut_values)
    advantage = _advantages(learner.config, trajectory, values[:-1], follows)
    return samples._replace(value=values[:-1], advantage=advantage)


def _advantages(
    config: PpoConfig, steps: RolloutTrajectory, values: Array, next_values: Array
) -> Array:
    """[T, N]; see `gae`."""
    return gae(
        steps.reward,
        values,
        next_values,
        steps.terminated,
        steps.truncated,
        discount=config.discounting,
        lam=config.gae_lambda,
    )


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
