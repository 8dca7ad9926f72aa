"""Acting in a batch of environments: one action, T steps, and what is counted meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp

from gmijax.learning.learner import ActingWeights
from gmijax.learning.normalize import Moments, merge_all, normalize
from gmijax.learning.policy import ActorCritic
from gmijax.sim.divergence import sources
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import BatchedEnv, BatchState, EpisodeSums, StepOutput, split_keys
from gmijax.types import Array, PyTree

K = TypeVar("K")

Choose: TypeAlias = Callable[[BatchState], tuple[BatchState, Any, Array]]
"""`(state) -> (state, what it knows of the action [N, ...], action [N, A])`; draws its keys from
the environments'."""

Outcome: TypeAlias = tuple[EpisodeSums, dict[str, Array], dict[str, Array]]
"""`finished`, `diverged` and `overflowed` of a `StepOutput`."""


class Counts(NamedTuple):
    """Sums over steps of many environments, [] each; add those of several GMIs.

    Attributes:
      episodes: sums over the episodes that ended.
      reward_sum: sum of all rewards, unscaled.
      diverged: steps that ended an environment because of a bad number, by where it was.
      overflowed: steps for which a buffer of the simulator was too small, by which.
    """

    episodes: EpisodeSums
    reward_sum: Array
    diverged: dict[str, Array]
    overflowed: dict[str, Array]


class RolloutSums(NamedTuple):
    """What GMIs exchange of a rollout.

    Attributes:
      obs: moments of the raw observations, [O].
      counts: sums over all steps.
    """

    obs: Moments
    counts: Counts


class Drawn(NamedTuple):
    """What is known of the actions of N environments.

    Attributes:
      output: [N, H], of the policy's network.
      raw: [N, A], what its distribution drew.
    """

    output: Array
    raw: Array


def act(
    networks: ActorCritic, weights: ActingWeights, state: BatchState
) -> tuple[BatchState, Drawn, Array]:
    """Draws one action per environment: `(state, what is known of it, action [N, A])`."""
    params = weights.params
    state, keys = split_keys(state)
    output = networks.output(params, normalize(weights.moments, state.env.obs))
    raw = networks.distribution.sample(output, params.log_std, keys)
    return state, Drawn(output, raw), networks.distribution.action_of(raw)


def unroll(
    env: BatchedEnv,
    choose: Choose,
    length: int,
    keep: Callable[[BatchState, Any, Array, Any], K],
    model: PyTree,
    state: BatchState,
) -> tuple[BatchState, K]:
    """Runs T steps.

    Args:
      env: the environments.
      choose: see `Choose`, for example `act`.
      length: T.
      keep: `(state before, what is known of the action, action, outcome)` to what is kept of a
        step.
      model: physics model of the environments.
      state: their state.

    Returns:
      The state after the last step, and what was kept, with a leading axis [T].
    """

    def step(before: BatchState, _: None) -> tuple[BatchState, K]:
        drawn, known, action = choose(before)
        after, out = env.step(model, drawn, action)
        return after, keep(before, known, action, out)

    return jax.lax.scan(step, state, None, length=length)


def outcome_of(out: StepOutput) -> Outcome:
    """The parts of a step that `count` sums."""
    return out.finished, out.diverged, out.overflowed


def count(rewards: Array, outcomes: Outcome) -> Counts:
    """Sums over an unroll, from rewards [T, N] and outcomes with a leading axis [T]."""
    episodes, diverged, overflowed = jax.tree.map(
        lambda x: jnp.sum(x, axis=0, dtype=jnp.float32), outcomes
    )
    return Counts(episodes, jnp.sum(rewards), diverged, overflowed)


def merge_counts(stacked: Counts) -> Counts:
    """Counts together; every leaf of `stacked` has a leading axis [K]."""
    return jax.tree.map(lambda x: jnp.sum(x, axis=0), stacked)


def merge_sums(stacked: RolloutSums) -> RolloutSums:
    """Sums together; every leaf of `stacked` has a leading axis [K]."""
    return RolloutSums(merge_all(stacked.obs), merge_counts(stacked.counts))


def no_counts(spec: EnvSpec, overflows: tuple[str, ...] = ()) -> Counts:
    """Zeros in the structure of `Counts`."""
    zero = jnp.zeros(())
    terms, metrics = dict.fromkeys(spec.reward_terms, zero), dict.fromkeys(spec.metrics, zero)
    return Counts(
        EpisodeSums(zero, zero, zero, terms, metrics),
        zero,
        dict.fromkeys(sources(spec.reward_terms), zero),
        dict.fromkeys(overflows, zero),
    )
