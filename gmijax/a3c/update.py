"""All passes over one batch of every trainer, as a step of all trainers."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gmijax.a3c.a3c import (
    A3cLearner,
    A3cLosses,
    Unrolls,
    batch_moments,
    batch_targets,
    gradients,
)
from gmijax.collectives.interface import Peers, Reducer, TracedStep
from gmijax.learning.learner import TrainState, acting_weights, pack_weights, rate_figures
from gmijax.learning.normalize import merge, merge_all
from gmijax.learning.updates import minibatch_order, run_updates
from gmijax.types import Array


class Updated(NamedTuple):
    """Results of an update, beside the state.

    Attributes:
      weights: [W] float32, to publish; see `pack_weights`.
      losses: means over all minibatches of all trainers, [] each.
      rates: learning rates of all minibatches, see `rate_figures`.
    """

    weights: Array
    losses: A3cLosses
    rates: dict[str, Array]


def make_update(learner: A3cLearner, reducer: Reducer) -> TracedStep:
    """The update as a program: `(state, (batch, weight)) -> (state, (), Updated)`.

    The batch has unrolls [T, B]. The weight [B] is 0 for unrolls that are too old to learn from;
    the others weigh alike on all trainers, and the mean over all of them is 1.
    """
    return reducer.program(partial(update, learner), donates_own=False)


def update(
    learner: A3cLearner,
    peers: Peers,
    _: Any,
    state: TrainState,
    weighted: tuple[Unrolls, Array],
) -> tuple[TrainState, tuple[()], Updated]:
    """See `make_update`."""
    batch, weight = weighted
    targets = batch_targets(learner, state, batch, weight)
    everyone = peers.gather(batch_moments(learner, state, batch))
    order = minibatch_order(learner.config, state, peers.rank(), batch.reward.shape[1])
    state, losses, rates = run_updates(
        learner, peers, gradients, state, batch, targets, order, after=everyone
    )
    # Counts the batch, which makes a new version of the policy, and takes in its statistics.
    state = state._replace(
        obs_moments=merge(state.obs_moments, merge_all(everyone)), iteration=state.iteration + 1
    )
    weights = pack_weights(acting_weights(learner, state))
    means = jax.tree.map(jnp.mean, losses)
    return state, (), Updated(weights, means, rate_figures(learner.config, rates))
