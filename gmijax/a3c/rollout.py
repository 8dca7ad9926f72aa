"""An unroll of an agent: physics and policy."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax.numpy as jnp

from gmijax.a3c.targets import Unrolls
from gmijax.decoupled.unrolls import concatenated
from gmijax.learning.learner import ActingWeights, state_values
from gmijax.learning.normalize import normalize
from gmijax.learning.policy import ActorCritic
from gmijax.learning.unroll import (
    Counts,
    Drawn,
    Outcome,
    act,
    count,
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


def join(pieces: Sequence[Unrolls]) -> Unrolls:
    """The unroll that pieces are in a row."""
    steps: Any = [piece._replace(bootstrap=None) for piece in pieces]
    return concatenated(steps)._replace(bootstrap=pieces[-1].bootstrap)
