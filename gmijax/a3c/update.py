"""The compiled forms of all passes over one batch of every trainer.

`FusedUpdate`: one trainer, all passes over the batch are one jit with donated state.
`SplitUpdate`: several trainers; gradient and step are jits of their own, and a reducer averages
gradients and statistics between them, on the host or on the device.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from gmijax.a3c.a3c import (
    A3cLearner,
    A3cLosses,
    Targets,
    Unrolls,
    batch_moments,
    batch_targets,
    gradients,
)
from gmijax.collectives.interface import Reducer
from gmijax.devices import host_sharding
from gmijax.learning.learner import TrainState, acting_weights, pack_weights, rate_figures
from gmijax.learning.normalize import Moments, merge, merge_all, no_samples
from gmijax.learning.updates import SplitUpdates, minibatch_order, run_updates
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


class FusedUpdate:
    """The update of a job with one trainer, as one jit."""

    def __init__(self, learner: A3cLearner) -> None:
        self._program: Any = _jitted(functools.partial(_fused, learner))

    def compile(self, state: TrainState, batch: Unrolls, weight: Array) -> None:
        """Compiles all programs for these shapes, or takes them from the cache."""
        self._program = self._program.lower(state, batch, weight).compile()

    def __call__(
        self, state: TrainState, batch: Unrolls, weight: Array
    ) -> tuple[TrainState, Updated]:
        """Learns from one batch.

        Args:
          state: of the learner; donated.
          batch: [T, B].
          weight: [B], 0 for unrolls that are too old to learn from; the others weigh alike on
            all trainers, and the mean over all of them is 1.
        """
        return self._program(state, batch, weight)


class SplitUpdate:
    """The update of one of several trainers: jits around a reducer."""

    def __init__(self, learner: A3cLearner, obs_size: int, reducer: Reducer) -> None:
        self._learner = learner
        self._reducer = reducer
        self._rank = np.int32(reducer.rank)
        self._unpack_moments = ravel_pytree(no_samples((obs_size,)))[1]
        self._begin: Any = jax.jit(self._begin_fn)
        self._updates = SplitUpdates(learner, reducer, gradients, A3cLosses)
        self._finish: Any = _jitted(self._finish_fn)

    def compile(self, state: TrainState, batch: Unrolls, weight: Array) -> None:
        """See `FusedUpdate`."""
        self._begin = self._begin.lower(state, batch, weight, self._rank)
        order, targets, packed = self._begin.out_info
        gathered = jax.ShapeDtypeStruct((self._reducer.world_size, *packed.shape), jnp.float32)
        figures = self._updates.trace(state, batch, targets, order)
        self._begin = self._begin.compile()
        self._updates.compile()
        self._finish = self._finish.lower(state, gathered, figures).compile()

    def __call__(
        self, state: TrainState, batch: Unrolls, weight: Array
    ) -> tuple[TrainState, Updated]:
        """See `FusedUpdate`; collective."""
        batch = jax.device_put(batch)  # Once, and not with every program.
        order, targets, packed = self._begin(state, batch, weight, self._rank)
        gathered = np.array(self._reducer.all_gather(np.asarray(packed)))
        state, figures = self._updates(state, batch, targets, order)
        return self._finish(state, gathered, figures)

    def _begin_fn(
        self, state: TrainState, batch: Unrolls, weight: Array, rank: Array
    ) -> tuple[Array, Targets, Array]:
        order = minibatch_order(self._learner.config, state, rank, batch.reward.shape[1])
        seen = ravel_pytree(batch_moments(self._learner, state, batch))[0]
        return order, batch_targets(self._learner, state, batch, weight), seen

    def _finish_fn(
        self, state: TrainState, gathered: Array, figures: list[Array]
    ) -> tuple[TrainState, Updated]:
        seen = merge_all(jax.vmap(self._unpack_moments)(gathered))
        return _finished(self._learner, state, seen, *self._updates.summary(figures))


def make_update(learner: A3cLearner, obs_size: int, reducer: Reducer) -> FusedUpdate | SplitUpdate:
    """The fastest form that the job's trainers can run."""
    if reducer.world_size == 1:
        return FusedUpdate(learner)
    return SplitUpdate(learner, obs_size, reducer)


def _jitted(program: Any) -> Any:
    """`program(state, ...) -> (state, Updated)`: the state is donated, weights go to the host."""
    host: Any = host_sharding()
    anywhere: Any = None
    shardings = (None, Updated(host, anywhere, anywhere)) if host else None
    return jax.jit(program, donate_argnums=(0,), out_shardings=shardings)


def _fused(
    learner: A3cLearner, state: TrainState, batch: Unrolls, weight: Array
) -> tuple[TrainState, Updated]:
    targets = batch_targets(learner, state, batch, weight)
    seen = batch_moments(learner, state, batch)
    rank = jnp.zeros((), jnp.int32)
    order = minibatch_order(learner.config, state, rank, batch.reward.shape[1])
    state, losses, rates = run_updates(learner, None, gradients, state, batch, targets, order)
    return _finished(learner, state, seen, jax.tree.map(jnp.mean, losses), rates)


def _finished(
    learner: A3cLearner, state: TrainState, seen: Moments, losses: A3cLosses, rates: Array
) -> tuple[TrainState, Updated]:
    """Counts the batch, which makes a new version of the policy, and takes in its statistics."""
    state = state._replace(
        obs_moments=merge(state.obs_moments, seen), iteration=state.iteration + 1
    )
    weights = pack_weights(acting_weights(learner, state))
    return state, Updated(weights, losses, rate_figures(learner.config, rates))
