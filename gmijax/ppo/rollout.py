"""One rollout: physics, policy and storage of T steps, then advantages and statistics."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gmijax.config import PpoConfig
from gmijax.normalize import Moments, merge_all, moments_of, normalize
from gmijax.policy import ActorCritic, ActorCriticParams, log_prob
from gmijax.ppo.advantages import gae
from gmijax.ppo.losses import Samples
from gmijax.sim.wrappers import BatchedEnv, BatchState, EpisodeSums, split_keys
from gmijax.types import Array, PRNGKey, PyTree


class RolloutStats(NamedTuple):
    """What GMIs must know of each other's rollouts; see `merge_stats`.

    Attributes:
      obs: moments of the raw observations, [O].
      advantage: moments of the advantages, [].
      episodes: sums over the episodes that ended.
      reward_sum: [] sum of all rewards, unscaled.
      nonfinite_obs: [] number of steps with a NaN or infinite observation.
      nonfinite_reward: [] number of steps with a NaN or infinite reward.
    """

    obs: Moments
    advantage: Moments
    episodes: EpisodeSums
    reward_sum: Array
    nonfinite_obs: Array
    nonfinite_reward: Array


class Transition(NamedTuple):
    """One step of all environments, as stored during the rollout; leading axis [N]."""

    obs: Array
    action: Array
    mean: Array
    reward: Array
    next_obs: Array
    terminated: Array
    truncated: Array


def policy_noise(keys: PRNGKey, action_size: int) -> Array:
    """Standard normal noise [N, A], each row from the key of its own environment.

    Rows depend on the environment alone, so the way environments are spread over GMIs does not
    change the samples.
    """
    return jax.vmap(lambda key: jax.random.normal(key, (action_size,)))(keys)


def act(
    networks: ActorCritic,
    params: ActorCriticParams,
    moments: Moments,
    env_state: BatchState,
    action_size: int,
) -> tuple[BatchState, Array, Array, Array]:
    """Draws one action per environment: `(env_state, normalised obs, mean, action)`."""
    env_state, keys = split_keys(env_state)
    obs = normalize(moments, env_state.env.obs)
    mean = networks.action_mean(params, obs)
    return (
        env_state,
        obs,
        mean,
        mean + jnp.exp(params.log_std) * policy_noise(keys, action_size),
    )


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

    def step(state: BatchState, _: None) -> tuple[BatchState, tuple[Transition, EpisodeSums]]:
        raw_obs = state.env.obs
        state, _, mean, action = act(networks, params, moments, state, env.spec.action_size)
        state, out = env.step(model, state, action)
        kept = Transition(
            raw_obs, action, mean, out.reward, out.next_obs, out.terminated, out.truncated
        )
        return state, (kept, out.finished)

    env_state, (rollout, finished) = jax.lax.scan(
        step, env_state, None, length=config.unroll_length
    )
    samples = _with_advantages(networks, config, params, moments, rollout)
    stats = RolloutStats(
        obs=moments_of(rollout.obs, 2),
        advantage=moments_of(samples.advantage, 2),
        episodes=jax.tree.map(lambda x: jnp.sum(x, axis=0), finished),
        reward_sum=jnp.sum(rollout.reward),
        nonfinite_obs=_count_nonfinite(rollout.next_obs),
        nonfinite_reward=_count_nonfinite(rollout.reward[..., None]),
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


def _count_nonfinite(values: Array) -> Array:
    bad = ~jnp.all(jnp.isfinite(values), axis=-1)
    return jnp.sum(bad.astype(jnp.float32))
