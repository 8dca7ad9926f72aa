"""Acting in a batch of environments: one action, T steps, and what is counted meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp

from gmijax.learning.learner import ActingWeights
from gmijax.learning.normalize import normalize
from gmijax.learning.policy import ActorCritic
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import (
    BatchedEnv,
    BatchState,
    EpisodeSums,
    StepOutput,
    split_keys,
    zero_counts,
)
from gmijax.types import Array, PRNGKey, PyTree

K = TypeVar("K")

Choose: TypeAlias = Callable[[BatchState], tuple[BatchState, Array, Array]]
"""`(state) -> (state, mean [N, A], action [N, A])`; draws its keys from the environments'."""

Outcome: TypeAlias = tuple[EpisodeSums, dict[str, Array], dict[str, Array]]
"""`finished`, `diverged` and `overflowed` of a `StepOutput`."""


class Counts(NamedTuple):
    """Sums over steps of many environments, [] each; add those of several GMIs.

    Attributes:
      episodes: sums over the episodes that ended.
      reward_sum: sum of all rewards, unscaled.
      diverged: steps that ended a world because of a bad number, by where it was.
      overflowed: steps for which a buffer of the simulator was too small, by which.
    """

    episodes: EpisodeSums
    reward_sum: Array
    diverged: dict[str, Array]
    overflowed: dict[str, Array]


def policy_noise(keys: PRNGKey, action_size: int) -> Array:
    """Standard normal noise [N, A], each row from the key of its own environment.

    Rows depend on the environment alone, so the way environments are spread over GMIs does not
    change the samples.
    """
    return jax.vmap(lambda key: jax.random.normal(key, (action_size,)))(keys)


def act(
    networks: ActorCritic, weights: ActingWeights, state: BatchState
) -> tuple[BatchState, Array, Array]:
    """Draws one action per environment: `(state, mean [N, A], action [N, A])`."""
    params = weights.params
    state, keys = split_keys(state)
    mean = networks.action_mean(params, normalize(weights.moments, state.env.obs))
    noise = policy_noise(keys, networks.policy.out)
    return state, mean, mean + jnp.exp(params.log_std) * noise


def unroll(
    env: BatchedEnv,
    choose: Choose,
    length: int,
    keep: Callable[[BatchState, Array, Array, Any], K],
    model: PyTree,
    state: BatchState,
) -> tuple[BatchState, K]:
    """Runs T steps.

    Args:
      env: the environments.
      choose: see `Choose`, for example `act`.
      length: T.
      keep: `(state before, mean, action, output of the step)` to what is kept of a step.
      model: physics model of the environments.
      state: their state.

    Returns:
      The state after the last step, and what was kept, with a leading axis [T].
    """

    def step(before: BatchState, _: None) -> tuple[BatchState, K]:
        drawn, mean, action = choose(before)
        after, out = env.step(model, drawn, action)
        return after, keep(before, mean, action, out)

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


def no_counts(spec: EnvSpec, overflows: tuple[str, ...] = ()) -> Counts:
    """Zeros in the structure of `Counts`."""
    episodes, diverged, overflowed = zero_counts(spec, overflows)
    return Counts(episodes, jnp.zeros(()), diverged, overflowed)
