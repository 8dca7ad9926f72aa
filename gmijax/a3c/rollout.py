"""An unroll of an agent: physics and policy, in pieces that are joined on the device."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from gmijax.a3c.targets import Unrolls
from gmijax.compile_once import compile_once
from gmijax.devices import host_sharding
from gmijax.learning.learner import ActingWeights, state_values
from gmijax.learning.normalize import normalize
from gmijax.learning.policy import ActorCritic
from gmijax.learning.unroll import (
    Counts,
    Drawn,
    Outcome,
    act,
    count,
    no_counts,
    outcome_of,
    unroll,
)
from gmijax.sim.wrappers import BatchedEnv, BatchState, StepOutput
from gmijax.types import Array, PyTree


def collect(
    env: BatchedEnv,
    networks: ActorCritic,
    num_steps: int,
    model: PyTree,
    weights: ActingWeights,
    env_state: BatchState,
) -> tuple[BatchState, Unrolls, Counts]:
    """Runs steps with one version of the policy: an unroll, or a piece of one."""

    def keep(
        before: BatchState, drawn: Drawn, action: Array, out: StepOutput
    ) -> tuple[Unrolls, Array, Outcome]:
        del action
        output, raw = drawn
        kept = Unrolls(
            state=before.env.obs,
            action=raw,
            reward=out.reward,
            done=jnp.stack([out.terminated, out.truncated], axis=-1),
            log_prob=networks.distribution.log_prob(output, weights.params.log_std, raw),
            cut_value=jnp.zeros_like(out.reward),
            bootstrap=jnp.zeros(()),
        )
        return kept, out.next_obs, outcome_of(out)

    choose = partial(act, networks, weights)
    env_state, (kept, next_obs, outcomes) = unroll(env, choose, num_steps, keep, model, env_state)
    # A second pass over all rows is simple, and cheap beside the physics.
    values = state_values(networks, weights, normalize(weights.moments, next_obs))
    kept = kept._replace(
        cut_value=jnp.where(kept.done[..., 1], values, 0.0), bootstrap=env_state.env.obs[None]
    )
    return env_state, kept, count(kept.reward, outcomes)


def join(pieces: Sequence[tuple[Unrolls, Counts]]) -> tuple[Unrolls, Array]:
    """The unroll that pieces are in a row, and its packed counts [M]."""
    kept, counts = zip(*pieces, strict=True)
    steps: Any = [piece._replace(bootstrap=None) for piece in kept]
    joined: Unrolls = jax.tree.map(lambda *parts: jnp.concatenate(parts), *steps)
    totals = jax.tree.map(lambda *parts: sum(parts), *counts)
    return joined._replace(bootstrap=kept[-1].bootstrap), ravel_pytree(totals)[0]


class UnrollPrograms:
    """The compiled programs of an agent's unrolls, of `num_pieces` pieces of `num_steps` each.

    `weights` and `env_state` are examples. Unrolls that do not stay on the device go where the
    host can read them.
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
        lowered: Any = piece.lower(env.model, weights, env_state)
        where = host_sharding()
        unrolls: Any = None if stays else where
        joining = jax.jit(join, out_shardings=(unrolls, where) if where else None)
        self._join: Any = compile_once(joining.lower([lowered.out_info[1:]] * num_pieces))
        self._piece: Any = compile_once(lowered)

    def piece(
        self, weights: ActingWeights, env_state: BatchState
    ) -> tuple[BatchState, tuple[Unrolls, Counts]]:
        """Starts the next steps; `env_state` is donated."""
        env_state, kept, counts = self._piece(self._model, weights, env_state)
        return env_state, (kept, counts)

    def join(self, pieces: Sequence[tuple[Unrolls, Counts]]) -> tuple[Unrolls, Array]:
        """See the function `join`."""
        return self._join(list(pieces))


def num_counts(env: BatchedEnv) -> int:
    """M, how many numbers `Counts` are."""
    return len(jax.tree.leaves(no_counts(env.spec, env.overflows)))
