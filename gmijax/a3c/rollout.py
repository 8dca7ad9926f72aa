"""One unroll of an agent: physics and policy of T steps, as one program."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gmijax.a3c.learner import ActingWeights
from gmijax.a3c.losses import Unrolls
from gmijax.acting import act
from gmijax.normalize import normalize
from gmijax.policy import ActorCritic, log_prob
from gmijax.sim.divergence import sources
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import BatchedEnv, BatchState, EpisodeSums
from gmijax.types import Array, PyTree


class UnrollStats(NamedTuple):
    """What an agent tells of its unrolls, sums over all of them; [] each.

    Attributes:
      episodes: the episodes that ended.
      reward_sum: of all rewards, unscaled.
      diverged: steps that ended a world because of a bad number, by where it was.
      overflowed: steps for which a buffer of the simulator was too small, by which.
    """

    episodes: EpisodeSums
    reward_sum: Array
    diverged: dict[str, Array]
    overflowed: dict[str, Array]


def collect(
    env: BatchedEnv,
    networks: ActorCritic,
    unroll_length: int,
    model: PyTree,
    weights: ActingWeights,
    env_state: BatchState,
) -> tuple[BatchState, Unrolls, UnrollStats]:
    """Runs T steps with one version of the policy."""

    def step(state: BatchState, _: None) -> tuple[BatchState, tuple[Unrolls, Array, UnrollStats]]:
        params, moments = weights
        obs = state.env.obs
        state, mean, action = act(networks, params, moments, state, env.spec.action_size)
        state, out = env.step(model, state, action)
        kept = Unrolls(
            state=obs,
            action=action,
            reward=out.reward,
            done=jnp.stack([out.terminated, out.truncated], axis=-1),
            log_prob=log_prob(mean, params.log_std, action),
            cut_value=jnp.zeros_like(out.reward),
            bootstrap=jnp.zeros(()),
        )
        counts = UnrollStats(out.finished, jnp.sum(out.reward), out.diverged, out.overflowed)
        return state, (kept, out.next_obs, counts)

    env_state, (kept, next_obs, counts) = jax.lax.scan(step, env_state, None, length=unroll_length)
    # A second pass over all rows is simple, and cheap beside the physics.
    values = networks.state_value(weights.params, normalize(weights.moments, next_obs))
    kept = kept._replace(
        cut_value=jnp.where(kept.done[..., 1], values, 0.0), bootstrap=env_state.env.obs[None]
    )
    totals = jax.tree.map(lambda x: jnp.sum(x, axis=0, dtype=jnp.float32), counts)
    return env_state, kept, totals


def stats_example(spec: EnvSpec, overflows: tuple[str, ...] = ()) -> UnrollStats:
    """Zeros in the structure of `UnrollStats`."""
    zero = jnp.zeros(())
    terms, metrics = dict.fromkeys(spec.reward_terms, zero), dict.fromkeys(spec.metrics, zero)
    return UnrollStats(
        episodes=EpisodeSums(zero, zero, zero, terms, metrics),
        reward_sum=zero,
        diverged=dict.fromkeys(("any", *sources(spec.reward_terms)), zero),
        overflowed=dict.fromkeys(overflows, zero),
    )


def num_stats(env: BatchedEnv) -> int:
    """M, how many numbers `UnrollStats` are."""
    return len(jax.tree.leaves(stats_example(env.spec, env.overflows)))
