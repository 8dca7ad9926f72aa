"""The latest transitions of a GMI's environments, in the memory of its device.

A ring of S steps of N environments. Every observation is there once: that behind a step is the one
of the next row, where an episode goes on. Where it ended, the next row is the start of another
one: nothing is needed of it after a termination, and where time ran out, or a simulation diverged,
the step is not learnt from. That leaves out one step of an episode.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gmijax.sim.interface import EnvSpec
from gmijax.types import Array, PRNGKey

GOES_ON, TERMINATED, CUT = 0, 1, 2
"""What follows a step: more of the episode, nothing, or what is not known."""


class Replay(NamedTuple):
    """The ring.

    Attributes:
      obs: [S, N, O] float32, raw.
      action: [S, N, A], as the environment got it.
      reward: [S, N], unscaled.
      kind: [S, N] int8: `GOES_ON`, `TERMINATED` or `CUT`.
      head: [] int32, the row that is written next.
      filled: [] int32, rows that are written.
    """

    obs: Array
    action: Array
    reward: Array
    kind: Array
    head: Array
    filled: Array


class Transitions(NamedTuple):
    """What updates learn from; leading axis [B], or [S', N] before they are in a `Replay`.

    Attributes:
      obs: [..., O], raw.
      action: [..., A], in [-1, 1].
      reward: [...], unscaled.
      kind: [...] int8; those that are `CUT` do not count.
      next_obs: [..., O], raw; of no meaning but where the episode goes on.
    """

    obs: Array
    action: Array
    reward: Array
    kind: Array
    next_obs: Array


def empty_replay(spec: EnvSpec, num_steps: int, num_envs: int) -> Replay:
    """A ring of `num_steps` rows without transitions."""
    shape = num_steps, num_envs
    return Replay(
        obs=jnp.zeros((*shape, spec.obs_size), jnp.float32),
        action=jnp.zeros((*shape, spec.action_size), jnp.float32),
        reward=jnp.zeros(shape, jnp.float32),
        kind=jnp.full(shape, CUT, jnp.int8),
        # An array each: both are donated.
        head=jnp.zeros((), jnp.int32),
        filled=jnp.zeros((), jnp.int32),
    )


def kind_of(terminated: Array, truncated: Array, is_diverged: Array) -> Array:
    """What follows steps [...], int8."""
    kind = jnp.where(terminated, TERMINATED, jnp.where(truncated, CUT, GOES_ON))
    return jnp.where(is_diverged, CUT, kind).astype(jnp.int8)


def insert(replay: Replay, obs: Array, action: Array, reward: Array, kind: Array) -> Replay:
    """The ring with T more rows [T, N, ...], of which S is a multiple."""
    num_steps, length = len(replay.obs), len(obs)

    def written(ring: Array, rows: Array) -> Array:
        start = (replay.head, *(0,) * (ring.ndim - 1))
        return jax.lax.dynamic_update_slice(ring, rows.astype(ring.dtype), start)

    return Replay(
        obs=written(replay.obs, obs),
        action=written(replay.action, action),
        reward=written(replay.reward, reward),
        kind=written(replay.kind, kind),
        head=(replay.head + length) % num_steps,
        filled=jnp.minimum(replay.filled + length, num_steps),
    )


def sample(replay: Replay, key: PRNGKey, batch_size: int) -> Transitions:
    """`batch_size` transitions, uniformly of all; consumes `key`.

    Never of the newest row, whose next observation is not there yet.
    """
    num_steps, num_envs = replay.reward.shape
    age_key, env_key = jax.random.split(key)
    age = jax.random.randint(age_key, (batch_size,), 2, jnp.maximum(replay.filled, 2) + 1)
    row = (replay.head - age) % num_steps
    env = jax.random.randint(env_key, (batch_size,), 0, num_envs)
    return Transitions(
        obs=replay.obs[row, env],
        action=replay.action[row, env],
        reward=replay.reward[row, env],
        kind=replay.kind[row, env],
        next_obs=replay.obs[(row + 1) % num_steps, env],
    )
