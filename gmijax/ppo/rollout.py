"""One rollout: physics, policy and storage of T steps, then advantages and statistics."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gmijax.acting import act
from gmijax.config import PpoConfig
from gmijax.normalize import (
    Moments,
    merge_all,
    moments_of,
    no_samples,
    normalize,
    without_outliers,
)
from gmijax.policy import ActorCritic, ActorCriticParams, log_prob
from gmijax.ppo.advantages import gae
from gmijax.ppo.losses import Samples
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import BatchedEnv, BatchState, EpisodeSums, zero_counts
from gmijax.types import Array, PyTree


class RolloutStats(NamedTuple):
    """What GMIs must know of each other's rollouts; see `merge_stats`.

    Attributes:
      obs: moments of the raw observations, [O].
      advantage: moments of the advantages, [].
      episodes: sums over the episodes that ended.
      reward_sum: [] sum of all rewards, unscaled.
      diverged: [] steps that ended a world because of a bad number, by where it was.
      overflowed: [] steps for which a buffer of the simulator was too small, by which.
    """

    obs: Moments
    advantage: Moments
    episodes: EpisodeSums
    reward_sum: Array
    diverged: dict[str, Array]
    overflowed: dict[str, Array]


class Transition(NamedTuple):
    """One step of all environments, as stored during the rollout; leading axis [N]."""

    obs: Array
    action: Array
    mean: Array
    reward: Array
    next_obs: Array
    terminated: Array
    truncated: Array


class Counts(NamedTuple):
    """What a step of all environments counts, [] each."""

    episodes: EpisodeSums
    diverged: dict[str, Array]
    overflowed: dict[str, Array]


def collect(
    env: BatchedEnv,
    networks: ActorCritic,
    config: PpoConfig,
    model: PyTree,
    params: ActorCriticParams,
    moments: Moments,
    env_state: BatchState,
) -> tuple[BatchState, Samples, RolloutStats]:
    """Runs T steps and estimates advantages.

    Returns:
      The environments' state, samples [T, N], and this GMI's statistics.
    """

    def step(state: BatchState, _: None) -> tuple[BatchState, tuple[Transition, Counts]]:
        raw_obs = state.env.obs
        state, mean, action = act(networks, params, moments, state, env.spec.action_size)
        state, out = env.step(model, state, action)
        kept = Transition(
            raw_obs, action, mean, out.reward, out.next_obs, out.terminated, out.truncated
        )
        return state, (kept, Counts(out.finished, out.diverged, out.overflowed))

    env_state, (rollout, counts) = jax.lax.scan(step, env_state, None, length=config.unroll_length)
    samples = _with_advantages(networks, config, params, moments, rollout)
    totals = jax.tree.map(lambda x: jnp.sum(x, axis=0, dtype=jnp.float32), counts)
    stats = RolloutStats(
        obs=moments_of(without_outliers(moments, rollout.obs), 2),
        advantage=moments_of(samples.advantage, 2),
        episodes=totals.episodes,
        reward_sum=jnp.sum(rollout.reward),
        diverged=totals.diverged,
        overflowed=totals.overflowed,
    )
    return env_state, samples, stats


def merge_stats(stacked: RolloutStats) -> RolloutStats:
    """Statistics of all GMIs together; every leaf of `stacked` has a leading axis [K]."""
    totals = jax.tree.map(lambda x: jnp.sum(x, axis=0), stacked)
    return totals._replace(obs=merge_all(stacked.obs), advantage=merge_all(stacked.advantage))


def _with_advantages(
    networks: ActorCritic,
    config: PpoConfig,
    params: ActorCriticParams,
    moments: Moments,
    rollout: Transition,
) -> Samples:
    obs = normalize(moments, rollout.obs)
    values = networks.state_value(params, obs)
    # V(s_{t+1}) is V of the next row, except where an episode ended and the next row is the
    # first observation of another one; a second pass over all rows is simple and cheap.
    next_values = networks.state_value(params, normalize(moments, rollout.next_obs))
    advantage = gae(
        config.reward_scaling * rollout.reward,
        values,
        next_values,
        rollout.terminated.astype(jnp.float32),
        rollout.truncated.astype(jnp.float32),
        discount=config.discounting,
        lam=config.gae_lambda,
    )
    return Samples(
        obs=obs,
        action=rollout.action,
        log_prob=log_prob(rollout.mean, params.log_std, rollout.action),
        mean=rollout.mean,
        value=values,
        advantage=advantage,
    )


def stats_example(spec: EnvSpec, overflows: tuple[str, ...] = ()) -> RolloutStats:
    """Zeros in the structure of `RolloutStats`."""
    episodes, diverged, overflowed = zero_counts(spec, overflows)
    return RolloutStats(
        obs=no_samples((spec.obs_size,)),
        advantage=no_samples(()),
        episodes=episodes,
        reward_sum=jnp.zeros(()),
        diverged=diverged,
        overflowed=overflowed,
    )
