"""The two ways a task makes an `EnvState`: at the start of an episode and after a step."""

from __future__ import annotations

import numpy as np

from gmijax.arrays import array_module
from gmijax.sim.interface import EnvSpec, EnvState
from gmijax.types import Array, PRNGKey, PyTree


def begin(spec: EnvSpec, physics: PyTree, task: PyTree, obs: Array, key: PRNGKey) -> EnvState:
    """The state after a reset: nothing earned, nothing ended, no steps."""
    xp = array_module(obs)
    zero: Array = xp.zeros((), np.float32)
    false: Array = xp.zeros((), bool)
    return EnvState(
        physics=physics,
        task=task,
        obs=obs,
        reward=zero,
        reward_terms=dict.fromkeys(spec.reward_terms, zero),
        metrics=dict.fromkeys(spec.metrics, zero),
        terminated=false,
        truncated=false,
        steps=xp.zeros((), np.int32),
        key=key,
    )


def advance(
    before: EnvState,
    physics: PyTree,
    task: PyTree,
    obs: Array,
    reward: tuple[Array, dict[str, Array]],
    terminated: Array,
    metrics: dict[str, Array] | None = None,
    truncated: Array | None = None,
) -> EnvState:
    """The state one step after `before`; `reward` is what `rewards.total_reward` returns."""
    return EnvState(
        physics=physics,
        task=task,
        obs=obs,
        reward=reward[0],
        reward_terms=reward[1],
        metrics=metrics or {},
        terminated=terminated,
        # Time is the business of `interaction.time_limit`.
        truncated=array_module(obs).zeros((), bool) if truncated is None else truncated,
        steps=before.steps + 1,
        key=before.key,
    )
