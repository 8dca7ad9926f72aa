"""The latest transitions of a GMI's environments, in the memory of its device.

A ring of S steps of N environments. Every observation is there once: that behind a step is the one
of the next row, where an episode continues. Where it ended, the next row is the start of another
one: nothing is needed of it after a termination, and where time ran out, or a simulation diverged,
what follows is not known. A return of several steps ends before such a step, and a transition
that begins with it is not learnt from. That leaves out one step of an episode.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from gmijax.learning.normalize import Moments, std_of
from gmijax.sim.interface import EnvSpec
from gmijax.types import Array, PRNGKey

GOES_ON, TERMINATED, CUT = 0, 1, 2
"""What follows a step: more of the episode, nothing, or what is not known."""

_LEAST_UNIT = 1.0
"""Of observations in float16. Smaller ones would gain nothing: float16 keeps 11 bits of any
distance from the mean above 6e-5. An input that has not moved yet has its range then too."""


class Replay(NamedTuple):
    """The ring.

    Attributes:
      obs: [S, N, O], float32 and raw, or float16 in the `units` of its row.
      action: [S, N, A], as the environment got it, of the same dtype.
      reward: [S, N] float32, unscaled.
      kind: [S, N] int8: `GOES_ON`, `TERMINATED` or `CUT`.
      head: [] int32, the row that is written next.
      filled: [] int32, rows that are written.
      units: [S, 2, O] float32, the number that stands for 0 in a row and the unit; [0, 2, O] in
        float32.
      num_clipped: [] float32, observed numbers so far that were out of the range of float16.
    """

    obs: Array
    action: Array
    reward: Array
    kind: Array
    head: Array
    filled: Array
    units: Array
    num_clipped: Array


class Transitions(NamedTuple):
    """What updates learn from; leading axis [B].

    Attributes:
      obs: [B, O], raw as `sample` draws them, normalised as the losses take them.
      action: [B, A], in [-1, 1].
      reward: [B], of the steps up to `next_obs` or the end of the task, discounted; unscaled as
        they are drawn, scaled as the losses take them.
      discount: [B], how much what follows `next_obs` counts; 0 where the task has ended.
      is_known: [B] bool; those of which nothing is known do not count.
      next_obs: [B, O], as `obs`.
    """

    obs: Array
    action: Array
    reward: Array
    discount: Array
    is_known: Array
    next_obs: Array


def empty_replay(spec: EnvSpec, num_steps: int, num_envs: int, dtype: DTypeLike) -> Replay:
    """A ring of `num_steps` rows without transitions."""
    shape = num_steps, num_envs
    rows_with_units = 0 if dtype == jnp.float32 else num_steps
    return Replay(
        obs=jnp.zeros((*shape, spec.obs_size), dtype),
        action=jnp.zeros((*shape, spec.action_size), dtype),
        reward=jnp.zeros(shape, jnp.float32),
        kind=jnp.full(shape, CUT, jnp.int8),
        # An array each: both are donated.
        head=jnp.zeros((), jnp.int32),
        filled=jnp.zeros((), jnp.int32),
        units=jnp.zeros((rows_with_units, 2, spec.obs_size), jnp.float32),
        num_clipped=jnp.zeros((), jnp.float32),
    )


def kind_of(terminated: Array, truncated: Array, is_diverged: Array) -> Array:
    """What follows steps [...], int8."""
    kind = jnp.where(terminated, TERMINATED, jnp.where(truncated, CUT, GOES_ON))
    return jnp.where(is_diverged, CUT, kind).astype(jnp.int8)


def insert(
    replay: Replay, moments: Moments, obs: Array, action: Array, reward: Array, kind: Array
) -> Replay:
    """The ring with T more rows [T, N, ...], of which S is a multiple; `obs` are raw.

    In float16 the observations are kept in units of `moments`, the statistics at this time.
    """
    num_steps, length = len(replay.obs), len(obs)

    def written(ring: Array, rows: Array) -> Array:
        start = (replay.head, *(0,) * (ring.ndim - 1))
        return jax.lax.dynamic_update_slice(ring, rows.astype(ring.dtype), start)

    units, num_clipped = replay.units, replay.num_clipped
    if len(units):
        # Each row has its own: statistics move far from what they were at the first steps.
        unit = jnp.maximum(std_of(moments), _LEAST_UNIT)
        units = written(
            units, jnp.broadcast_to(jnp.stack([moments.mean, unit]), (length, *units.shape[1:]))
        )
        obs = (obs - moments.mean) / unit
        # An infinity would become NaN when it is normalised.
        most = float(jnp.finfo(replay.obs.dtype).max)
        num_clipped += jnp.sum(jnp.abs(obs) > most, dtype=jnp.float32)
        obs = jnp.clip(obs, -most, most)
    return replay._replace(
        obs=written(replay.obs, obs),
        action=written(replay.action, action),
        reward=written(replay.reward, reward),
        kind=written(replay.kind, kind),
        head=(replay.head + length) % num_steps,
        filled=jnp.minimum(replay.filled + length, num_steps),
        units=units,
        num_clipped=num_clipped,
    )


def sample(
    replay: Replay, key: PRNGKey, batch_size: int, n_step: int, discounting: float
) -> Transitions:
    """`batch_size` transitions, uniformly of all; consumes `key`.

    Each sums the rewards of up to `n_step` steps: fewer where the episode ends, or where the next
    observation is not known. None begins with the newest row.
    """
    num_steps, num_envs = replay.reward.shape
    age_key, env_key = jax.random.split(key)
    age = jax.random.randint(age_key, (batch_size,), 2, jnp.maximum(replay.filled, 2) + 1)
    env = jax.random.randint(env_key, (batch_size,), 0, num_envs)
    first, steps = replay.head - age, jnp.arange(n_step)
    rows = (first[:, None] + steps) % num_steps, env[:, None]
    is_newest = age[:, None] - steps <= 1  # Or not written yet, which is behind it.
    kind = replay.kind[rows]
    kind = jnp.where(is_newest & (kind == GOES_ON), CUT, kind)
    goes_on = kind == GOES_ON
    # All steps before it continue.
    is_reached = jnp.cumprod(jnp.roll(goes_on, 1, axis=1).at[:, 0].set(True), axis=1) > 0
    counts = is_reached & (kind != CUT)
    factors = discounting ** jnp.arange(n_step + 1, dtype=jnp.float32)
    rewards = jnp.where(counts, factors[:-1] * replay.reward[rows], 0.0)
    num_counted = jnp.sum(counts, axis=1)
    has_ended = jnp.any(is_reached & (kind == TERMINATED), axis=1)
    return Transitions(
        obs=_observations(replay, first % num_steps, env),
        action=replay.action[first % num_steps, env].astype(jnp.float32),
        reward=jnp.sum(rewards, axis=1),
        discount=jnp.where(has_ended, 0.0, factors[num_counted]),
        is_known=num_counted > 0,
        next_obs=_observations(replay, (first + num_counted) % num_steps, env),
    )


def sample_obs(replay: Replay, key: PRNGKey, batch_size: int) -> Array:
    """Raw observations [B, O], uniformly of all; consumes `key`."""
    num_steps, num_envs = replay.reward.shape
    age_key, env_key = jax.random.split(key)
    age = jax.random.randint(age_key, (batch_size,), 1, jnp.maximum(replay.filled, 1) + 1)
    env = jax.random.randint(env_key, (batch_size,), 0, num_envs)
    return _observations(replay, (replay.head - age) % num_steps, env)


def _observations(replay: Replay, row: Array, env: Array) -> Array:
    """[B, O] float32, raw."""
    obs = replay.obs[row, env].astype(jnp.float32)
    if not len(replay.units):
        return obs
    zero, unit = replay.units[row, 0], replay.units[row, 1]
    return zero + unit * obs
