"""An iteration of SAC: T times a step into the replay and updates on batches drawn from it.

Agents and learner take turns in one program. Where several GMIs train, each has its own
environments and its own replay, and they average the gradients of their batches.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from gmijax.collectives.interface import Collectives
from gmijax.learning.algorithm import Algorithm, IterationMetrics
from gmijax.learning.learner import acting_weights, finish_iteration, make_learner, policy_figures
from gmijax.learning.normalize import moments_of, without_outliers
from gmijax.learning.unroll import RolloutSums, act, count, merge_sums, outcome_of, unroll
from gmijax.sac.replay import insert, kind_of
from gmijax.sac.state import Memory, SacLearner, SacLosses, SacState, begin, init, num_averaged
from gmijax.sac.updates import update
from gmijax.sim.wrappers import BatchedEnv, BatchState, StepOutput
from gmijax.types import Array, PRNGKey, PyTree


def iterate(
    env: BatchedEnv,
    learner: SacLearner,
    collectives: Collectives,
    model: PyTree,
    state: SacState,
    memory: Memory,
) -> tuple[SacState, Memory, IterationMetrics]:
    """See `gmijax.learning.algorithm.Iterate`: T rounds of a step and its updates."""
    config = learner.config
    key = jax.random.fold_in(jax.random.fold_in(state.key, state.iteration), collectives.rank())
    keys = jax.random.split(key, config.unroll_length)
    one_round = partial(_round, env, learner, collectives, model)
    (state, memory), (stats, losses, is_due) = jax.lax.scan(one_round, (state, memory), keys)
    everyone = collectives.all_gather(merge_sums(stats), after=losses)
    seen, counts = merge_sums(everyone)
    state = finish_iteration(learner, state, seen)
    figures = {
        **policy_figures(state),
        "policy/temperature": jnp.exp(state.log_temperature),
        "replay/steps": memory.replay.filled.astype(jnp.float32),
    }
    means = jax.tree.map(jnp.mean, losses)
    of_policy = jnp.sum(losses.policy_loss) / jnp.maximum(jnp.sum(is_due), 1.0)
    means = means._replace(policy_loss=of_policy)
    return state, memory, IterationMetrics(counts, means, figures, {})


def _round(
    env: BatchedEnv,
    learner: SacLearner,
    collectives: Collectives,
    model: PyTree,
    before: tuple[SacState, Memory],
    key: PRNGKey,
) -> tuple[tuple[SacState, Memory], tuple[RolloutSums, SacLosses, Array]]:
    """A step of all environments, and the updates after it."""
    config, (state, memory) = learner.config, before
    memory, stats = _act(env, learner, model, state, memory)
    step = partial(update, learner, collectives, memory.replay)
    keys = jax.random.split(key, config.updates_per_step)
    after, (losses, is_due) = jax.lax.scan(step, state, keys)
    # The same on all GMIs, whose replays fill alike. Before, there is too little to learn from.
    is_ready = memory.replay.filled >= config.learning_starts
    state = jax.tree.map(lambda new, old: jnp.where(is_ready, new, old), after, state)
    losses = jax.tree.map(lambda x: jnp.where(is_ready, x, 0.0), losses)
    return (state, memory), (stats, losses, is_due & is_ready)


def _act(
    env: BatchedEnv, learner: SacLearner, model: PyTree, state: SacState, memory: Memory
) -> tuple[Memory, RolloutSums]:
    """A step of this GMI's environments, into its replay."""
    weights = acting_weights(learner, state)

    def keep(before: BatchState, drawn: Any, action: Array, out: StepOutput) -> Any:
        del drawn
        kind = kind_of(out.terminated, out.truncated, out.is_diverged)
        return before.env.obs, action, out.reward, kind, outcome_of(out)

    envs, (obs, action, reward, kind, outcomes) = unroll(
        env,
        partial(act, learner.networks, weights),
        1,
        keep,
        model,
        memory.envs,
    )
    # Each observation counts once, when it is made: batches show the same ones again and again.
    seen = moments_of(without_outliers(weights.moments, obs), 2)
    replay = insert(memory.replay, obs, action, reward, kind)
    return Memory(envs, replay), RolloutSums(seen, count(reward, outcomes))


SAC = Algorithm(
    make_learner=make_learner,
    init=init,
    iterate=iterate,
    num_averaged=num_averaged,
    begin=begin,
    envs=lambda memory: memory.envs,
    learned=lambda state: (state.params, state.critics, state.targets, state.log_temperature),
)
