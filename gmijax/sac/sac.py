"""An iteration of SAC: T times a step into the replay and updates on batches drawn from it.

The policy learns once after every `policy_every` updates of the critics: several times in a round,
or once after several rounds. Which is known when the program is made, so that no gradient is
computed that is not used, also where several runs share a program.

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
from gmijax.learning.saved_arrays import size_bytes
from gmijax.learning.unroll import RolloutSums, act, count, merge_sums, outcome_of, unroll
from gmijax.sac.losses import CriticFigures
from gmijax.sac.replay import Replay, insert, kind_of
from gmijax.sac.state import Memory, SacLearner, SacState, begin, init, num_averaged
from gmijax.sac.updates import UpdateFigures, losses_of, update_critics, update_policy
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
    length = config.rounds_per_turn
    keys = jax.random.split(key, (config.unroll_length // length, length + 1))
    turn = partial(_turn, env, learner, collectives, model)
    (state, memory), (stats, losses) = jax.lax.scan(turn, (state, memory), keys)
    stats = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), stats)
    everyone = collectives.all_gather(merge_sums(stats), after=losses)
    seen, counts = merge_sums(everyone)
    state = finish_iteration(learner, state, seen)
    figures = {
        **policy_figures(state._replace(params=state.live)),
        "policy/temperature": jnp.exp(state.log_temperature),
        "replay/steps": memory.replay.filled.astype(jnp.float32),
        "replay/clipped": memory.replay.num_clipped,
        "replay/mib": jnp.asarray(size_bytes(memory.replay) / 2**20, jnp.float32),
    }
    return state, memory, IterationMetrics(counts, losses_of(losses), figures, {})


def _turn(
    env: BatchedEnv,
    learner: SacLearner,
    collectives: Collectives,
    model: PyTree,
    before: tuple[SacState, Memory],
    keys: PRNGKey,
) -> tuple[tuple[SacState, Memory], tuple[RolloutSums, UpdateFigures]]:
    """As many rounds as an update of the policy is made after; `keys` [rounds + 1]."""

    def one_round(before: tuple[SacState, Memory], key: PRNGKey) -> Any:
        state, memory = before
        memory, stats = step_into_replay(env, learner, model, state, memory)
        state, figures = learn_in_round(learner, collectives, memory.replay, state, key)
        return (state, memory), (stats, figures)

    (state, memory), (stats, figures) = jax.lax.scan(one_round, before, keys[1:])
    state, figures = learn_after_turn(learner, collectives, memory.replay, state, figures, keys[0])
    return (state, memory), (stats, figures)


def learn_in_round(
    learner: SacLearner, collectives: Collectives, replay: Replay, state: SacState, key: PRNGKey
) -> tuple[SacState, UpdateFigures]:
    """The updates after a step: of the policy too, if its turn comes as often."""
    num_updates, every = learner.config.updates_per_step, learner.config.policy_every
    # The same on all GMIs, whose replays fill alike. Before, there is too little to learn from.
    is_ready = replay.filled >= learner.config.learning_starts
    of_critics = partial(update_critics, learner, collectives, replay)
    if num_updates < every:
        after, figures = jax.lax.scan(of_critics, state, jax.random.split(key, num_updates))
        return _where(is_ready, after, state), UpdateFigures(figures, None, is_ready)

    def turn(state: SacState, keys: PRNGKey) -> tuple[SacState, tuple[CriticFigures, Array]]:
        state, figures = jax.lax.scan(of_critics, state, keys[1:])
        state, loss = update_policy(learner, collectives, replay, state, keys[0])
        return state, (figures, loss)

    keys = jax.random.split(key, (num_updates // every, every + 1))
    after, (figures, losses) = jax.lax.scan(turn, state, keys)
    return _where(is_ready, after, state), UpdateFigures(figures, losses, is_ready)


def learn_after_turn(
    learner: SacLearner,
    collectives: Collectives,
    replay: Replay,
    state: SacState,
    figures: UpdateFigures,
    key: PRNGKey,
) -> tuple[SacState, UpdateFigures]:
    """The update of the policy after several rounds, where it is that rare; `figures` of them."""
    if learner.config.updates_per_step >= learner.config.policy_every:
        return state, figures
    after, loss = update_policy(learner, collectives, replay, state, key)
    state = _where(figures.is_ready[-1], after, state)
    return state, figures._replace(policy_loss=loss)


def _where(condition: Array, new: SacState, old: SacState) -> SacState:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def step_into_replay(
    env: BatchedEnv, learner: SacLearner, model: PyTree, state: SacState, memory: Memory
) -> tuple[Memory, RolloutSums]:
    """A step of this GMI's environments, into its replay."""
    weights = acting_weights(learner, state)._replace(params=state.live)

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
    known = weights.moments
    # The first iteration has its own statistics alone.
    units = jax.tree.map(partial(jnp.where, known.count > 0), known, seen)
    replay = insert(memory.replay, units, obs, action, reward, kind)
    return Memory(envs, replay), RolloutSums(seen, count(reward, outcomes))


SAC = Algorithm(
    make_learner=make_learner,
    init=init,
    iterate=iterate,
    num_averaged=num_averaged,
    begin=begin,
    envs=lambda memory: memory.envs,
    replay=lambda learner, memory: memory.replay if learner.config.save_replay else None,
    with_replay=lambda memory, replay: memory._replace(replay=replay),
    learned=lambda state: (
        state.params,
        state.live,
        state.critics,
        state.targets,
        state.log_temperature,
    ),
)
