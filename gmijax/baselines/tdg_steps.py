"""The compiled halves of a step, which is cut where data leaves a GMI: the template `tdg`.

`simulate` ends with what the agent must know, `infer` is the agent's. They draw the policy's noise
from the environments' own keys, so that they collect what an unroll in one GMI does.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from gmijax.collection.programs import ActingPolicy, CollectedStep, RecordSpec
from gmijax.learning.unroll import Counts, count, outcome_of
from gmijax.sim.wrappers import BatchedEnv, BatchState, split_keys
from gmijax.types import Array, PyTree


def simulate(
    env: BatchedEnv,
    keep: RecordSpec,
    model: PyTree,
    state: BatchState,
    counts: Counts,
    action: Array,
    log_prob: Array,
) -> tuple[BatchState, Array, Counts, CollectedStep | None]:
    """The simulator's half of a step: physics, then keys for the next action.

    The keys of `state` are those of this step (`next_keys`); actions [N, A] and log densities [N]
    are the agent's.

    Returns:
      The state, random bits [N, ...] uint32 for the agent's next draw, the counts with those of
      this step, and the step.
    """
    after, out = env.step(model, state, action)
    one = jax.tree.map(lambda x: x[None], (out.reward, outcome_of(out)))
    counts = jax.tree.map(jnp.add, counts, count(*one))
    step = keep.of(state, log_prob, action, out)
    after, bits = next_keys(after)
    return after, bits, counts, step


def next_keys(state: BatchState) -> tuple[BatchState, Array]:
    """Draws a key per environment for the agent, as bits [N, ...] that can be sent."""
    state, keys = split_keys(state)
    return state, jax.random.key_data(keys)


def infer(policy: ActingPolicy, weights: PyTree, obs: Array, bits: Array) -> tuple[Array, Array]:
    """The agent's half of a step: actions [N, A] and log densities [N]."""
    return policy.choose(weights, obs, jax.random.wrap_key_data(bits))
