"""An unroll of an agent: physics and policy, in pieces that are joined on the device."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from gmijax.a3c.learner import ActingWeights
from gmijax.a3c.losses import Unrolls
from gmijax.acting import act
from gmijax.host_memory import host_sharding
from gmijax.normalize import normalize
from gmijax.policy import ActorCritic, log_prob
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import BatchedEnv, BatchState, EpisodeSums, zero_counts
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
    num_steps: int,
    model: PyTree,
    weights: ActingWeights,
    env_state: BatchState,
) -> tuple[BatchState, Unrolls, UnrollStats]:
    """Runs steps with one version of the policy: an unroll, or a piece of one."""

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

    env_state, (kept, next_obs, counts) = jax.lax.scan(step, env_state, None, length=num_steps)
    # A second pass over all rows is simple, and cheap beside the physics.
    values = networks.state_value(weights.params, normalize(weights.moments, next_obs))
    kept = kept._replace(
        cut_value=jnp.where(kept.done[..., 1], values, 0.0), bootstrap=env_state.env.obs[None]
    )
    totals = jax.tree.map(lambda x: jnp.sum(x, axis=0, dtype=jnp.float32), counts)
    return env_state, kept, totals


def join(pieces: Sequence[tuple[Unrolls, UnrollStats]]) -> tuple[Unrolls, Array]:
    """The unroll that pieces are in a row, and its packed statistics [M]."""
    kept, counts = zip(*pieces, strict=True)
    steps: Any = [piece._replace(bootstrap=None) for piece in kept]
    unroll: Unrolls = jax.tree.map(lambda *parts: jnp.concatenate(parts), *steps)
    totals = jax.tree.map(lambda *parts: sum(parts), *counts)
    return unroll._replace(bootstrap=kept[-1].bootstrap), ravel_pytree(totals)[0]


class UnrollPrograms:
    """The compiled programs of an agent's unrolls.

    Args:
      env: its environments.
      networks: that act.
      num_steps: of a piece.
      num_pieces: of an unroll.
      weights: an example.
      env_state: likewise.
      stays: whether unrolls stay on the device; else they go where the host can read them.
    """

    def __init__(
        self,
        env: BatchedEnv,
        networks: ActorCritic,
        num_steps: int,
        num_pieces: int,
        weights: ActingWeights,
        env_state: BatchState,
        *,
        stays: bool = False,
    ) -> None:
        self._model = env.model
        piece = jax.jit(partial(collect, env, networks, num_steps), donate_argnums=(2,))
        args = (env.model, weights, env_state)
        made = jax.eval_shape(piece, *args)[1:]
        where = host_sharding()
        unroll: Any = None if stays else where
        joining = jax.jit(join, out_shardings=(unroll, where) if where else None)
        self._piece: Any = piece.lower(*args).compile()
        self._join: Any = joining.lower([made] * num_pieces).compile()

    def piece(
        self, weights: ActingWeights, env_state: BatchState
    ) -> tuple[BatchState, tuple[Unrolls, UnrollStats]]:
        """Starts the next steps; `env_state` is donated."""
        env_state, kept, counts = self._piece(self._model, weights, env_state)
        return env_state, (kept, counts)

    def join(self, pieces: Sequence[tuple[Unrolls, UnrollStats]]) -> tuple[Unrolls, Array]:
        """See the function `join`."""
        return self._join(list(pieces))


def stats_example(spec: EnvSpec, overflows: tuple[str, ...] = ()) -> UnrollStats:
    """Zeros in the structure of `UnrollStats`."""
    episodes, diverged, overflowed = zero_counts(spec, overflows)
    return UnrollStats(
        episodes=episodes,
        reward_sum=jnp.zeros(()),
        diverged=diverged,
        overflowed=overflowed,
    )


def num_stats(env: BatchedEnv) -> int:
    """M, how many numbers `UnrollStats` are."""
    return len(jax.tree.leaves(stats_example(env.spec, env.overflows)))
