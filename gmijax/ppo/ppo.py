"""An iteration of PPO (arXiv:1707.06347): a rollout, then updates with the gradients of its loss.

These are pure functions. `iterate` is one program of each GMI, in which it exchanges numbers with
its peers. Programs hold nothing that depends on a GMI's rank, so that all GMIs share one entry of
the compilation cache. What it builds on: acting in `gmijax.learning.unroll`, the loop over
minibatches in `gmijax.learning.updates`, networks and optimiser in `gmijax.learning.learner`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from gmijax.collectives.interface import Peers
from gmijax.learning.learner import (
    TrainState,
    acting_weights,
    finish_iteration,
    policy_figures,
    rate_figures,
)
from gmijax.learning.normalize import merge, std_of
from gmijax.learning.policy import ActorCriticParams
from gmijax.learning.unroll import Counts
from gmijax.learning.updates import explained_variance, minibatch_order, run_updates
from gmijax.ppo.loss import PpoLosses, UpdateContext, ppo_loss
from gmijax.ppo.rollout import PpoLearner, Samples, rollout
from gmijax.ppo.statistics import RolloutStats, merge_stats
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.types import Array, PyTree


def iterate(
    env: BatchedEnv,
    learner: PpoLearner,
    peers: Peers,
    model: PyTree,
    state: TrainState,
    env_state: BatchState,
) -> tuple[TrainState, BatchState, IterationMetrics]:
    """One iteration, together with the GMIs `peers`."""
    weights = acting_weights(learner, state)
    env_state, samples, stats = rollout(env, learner, model, weights, env_state)
    state, metrics = learn(learner, peers, state, samples, stats)
    return state, env_state, metrics


class IterationMetrics(NamedTuple):
    """Figures of one iteration, over all GMIs; leaves are scalars.

    No two of them may be the same number by definition: a GPU's program writes one of these to
    the host and copies it there to the other, for which the host waits until all else is done.

    Attributes:
      counts: sums over all steps.
      losses: means over all minibatches of the iteration.
      figures: others by the names that they are logged under.
      rates: of the learning rates of all updates, see `rate_figures`.
    """

    counts: Counts
    losses: PpoLosses
    figures: dict[str, Array]
    rates: dict[str, Array]


def learn(
    learner: PpoLearner,
    peers: Peers,
    state: TrainState,
    samples: Samples,
    stats: RolloutStats,
) -> tuple[TrainState, IterationMetrics]:
    """All updates of an iteration, on samples [T, N] and this GMI's statistics.

    The statistics of observations change only after them: the policy that is updated then sees
    the observations exactly as the policy that acted did, and the first probability ratio is 1.
    """
    samples = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples)
    everyone = peers.gather(stats)
    stats = merge_stats(everyone)
    if state.value_moments is not None:
        state = state._replace(value_moments=merge(state.value_moments, stats.target))
    context = update_context(learner, state, stats)
    order = minibatch_order(learner.config, state, peers.rank(), samples.advantage.shape[0])
    state, losses, rates = run_updates(
        learner, peers, gradients, state, samples, context, order, after=everyone
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


def update_context(learner: PpoLearner, state: TrainState, stats: RolloutStats) -> UpdateContext:
    """The constants of an iteration's updates; `stats` are those of all GMIs together."""
    mean, std = stats.advantage.mean, std_of(stats.advantage)
    if not learner.config.normalize_advantage:
        mean, std = jnp.zeros(()), jnp.ones(())
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
