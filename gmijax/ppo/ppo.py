"""An iteration of PPO (arXiv:1707.06347): a rollout, then updates with the gradients of its loss.

These are pure functions. `iterate` is one program of each GMI, in which it exchanges numbers with
its peers. Programs hold nothing that depends on a GMI's rank, so that all GMIs share one entry of
the compilation cache. What it builds on: acting in `gmijax.learning.unroll`, the loop over
minibatches in `gmijax.learning.updates`, networks and optimiser in `gmijax.learning.learner`.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from gmijax.collectives.interface import Collectives
from gmijax.learning.algorithm import Algorithm, IterationMetrics
from gmijax.learning.learner import (
    TrainState,
    acting_weights,
    finish_iteration,
    init_learner,
    make_learner,
    policy_figures,
    rate_figures,
    with_targets,
)
from gmijax.learning.normalize import Moments, merge_all, moments_of, std_of
from gmijax.learning.policy import ActorCriticParams
from gmijax.learning.updates import exchange_size, explained_variance, minibatch_order, run_updates
from gmijax.ppo.loss import PpoLosses, UpdateContext, ppo_loss
from gmijax.ppo.rollout import PpoLearner, RolloutTrajectory, Samples, rollout, valued_anew
from gmijax.ppo.statistics import RolloutStats, merge_stats
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.types import Array, PyTree


def iterate(
    env: BatchedEnv,
    learner: PpoLearner,
    collectives: Collectives,
    model: PyTree,
    state: TrainState,
    env_state: BatchState,
) -> tuple[TrainState, BatchState, IterationMetrics]:
    """One iteration, together with the GMIs of `collectives`."""
    weights = acting_weights(learner, state)
    env_state, samples, trajectory, stats = rollout(env, learner, model, weights, env_state)
    again = trajectory if learner.config.recompute_advantages else None
    state, metrics = learn(learner, collectives, state, samples, stats, again)
    return state, env_state, metrics


def learn(
    learner: PpoLearner,
    collectives: Collectives,
    state: TrainState,
    samples: Samples,
    stats: RolloutStats,
    trajectory: RolloutTrajectory | None = None,
) -> tuple[TrainState, IterationMetrics]:
    """All updates of an iteration, on samples [T, N] and this GMI's statistics.

    With `trajectory` advantages are computed anew before every pass (arXiv:2006.05990, 3.5).
    The statistics of observations change only after all updates: the policy that is updated sees
    the observations exactly as the policy that acted did, and the first probability ratio is 1.
    """
    everyone = collectives.all_gather(stats)
    stats = merge_stats(everyone)
    state = with_targets(learner, state, stats.target)
    context = update_context(learner, state, stats)
    order = minibatch_order(learner.config, state, collectives.rank(), samples.advantage.size)
    if trajectory is None:
        state, losses, rates = run_updates(
            learner, collectives, gradients, state, flat(samples), context, order, after=everyone
        )
    else:
        passes = order.reshape(learner.config.num_updates_per_batch, -1, order.shape[-1])
        state, losses, rates = _updates_by_pass(
            learner, collectives, state, samples, trajectory, context, passes, everyone
        )
    means = jax.tree.map(jnp.mean, losses)
    state = finish_iteration(learner, state, stats.obs)
    figures = {
        **policy_figures(state),
        "value/explained_variance": explained_variance(stats.target, stats.advantage),
    }
    return state, IterationMetrics(
        stats.counts, means, figures, rate_figures(learner.config, rates)
    )


def flat(samples: Samples) -> Samples:
    """Samples [T * N] of samples [T, N]."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples)


def _updates_by_pass(
    learner: PpoLearner,
    collectives: Collectives,
    state: TrainState,
    samples: Samples,
    trajectory: RolloutTrajectory,
    context: UpdateContext,
    passes: Array,
    after: RolloutStats,
) -> tuple[TrainState, PpoLosses, Array]:
    """As `run_updates` with `passes` [epochs, minibatches, B], each over samples valued anew."""

    def one_pass(state: TrainState, order: Array) -> tuple[TrainState, tuple[PpoLosses, Array]]:
        renewed = valued_anew(learner, acting_weights(learner, state), samples, trajectory)
        everyone = collectives.all_gather(moments_of(renewed.advantage, 2), after=after)
        mean, std = advantage_scale(learner, merge_all(everyone))
        now = context._replace(advantage_mean=mean, advantage_std=std)
        state, losses, rates = run_updates(
            learner, collectives, gradients, state, flat(renewed), now, order, after=everyone
        )
        return state, (losses, rates)

    state, updates = jax.lax.scan(one_pass, state, passes)
    losses, rates = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), updates)
    return state, losses, rates


def advantage_scale(learner: PpoLearner, advantage: Moments) -> tuple[Array, Array]:
    """Mean and deviation, [] each, by which advantages are normalised; 0 and 1 where they are not.

    `advantage` are the moments over all GMIs.
    """
    if not learner.config.normalize_advantage:
        return jnp.zeros(()), jnp.ones(())
    return advantage.mean, std_of(advantage)


def update_context(learner: PpoLearner, state: TrainState, stats: RolloutStats) -> UpdateContext:
    """The constants of an iteration's updates; `stats` are those of all GMIs together."""
    mean, std = advantage_scale(learner, stats.advantage)
    return UpdateContext(mean, std, state.params.log_std, state.value_moments)


def gradients(
    learner: PpoLearner,
    params: ActorCriticParams,
    samples: Samples,
    context: UpdateContext,
    indices: Array,
) -> tuple[ActorCriticParams, PpoLosses]:
    """Gradient and loss parts on the minibatch `indices` [B] of flat samples [T * N]."""
    minibatch = jax.tree.map(lambda x: x[indices], samples)
    return jax.grad(ppo_loss, has_aux=True)(
        params, minibatch, context, learner.networks, learner.config
    )


PPO = Algorithm(
    make_learner=make_learner,
    init=init_learner,
    iterate=iterate,
    num_averaged=partial(exchange_size, losses=PpoLosses),
)
