"""The two compiled forms of an update on one batch.

`FusedUpdate`: one trainer, all passes over the batch are one jit with donated state.
`SplitUpdate`: several trainers; gradient and step are jits of their own, and a reducer averages
gradients and statistics between them, on the host or on the device.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Sharding

from gmijax.a3c.learner import (
    acting_weights,
    batch_moments,
    begin_batch,
    finish_batch,
    gradients,
    minibatch_order,
    pack_weights,
)
from gmijax.a3c.losses import LossMetrics, Unrolls, UpdateContext
from gmijax.collectives.interface import Reducer
from gmijax.config import A3cConfig
from gmijax.host_memory import host_sharding
from gmijax.learner import (
    Learner,
    LearnerState,
    apply_gradients,
    init_learner,
    make_learner,
    rate_figures,
)
from gmijax.normalize import merge_all, no_samples
from gmijax.sim.interface import EnvSpec
from gmijax.split_updates import SplitUpdates
from gmijax.types import Array

_NUM_LOSSES = len(LossMetrics._fields)


class Updated(NamedTuple):
    """What an update leaves, beside the state.

    Attributes:
      weights: [W] float32, to publish; see `pack_weights`.
      losses: means over all minibatches of all trainers, [] each.
      rates: learning rates of all minibatches, see `rate_figures`.
    """

    weights: Array
    losses: LossMetrics
    rates: dict[str, Array]


class Update(Protocol):
    """All passes over one batch of every trainer."""

    def compile(self, state: LearnerState, batch: Unrolls, weight: Array) -> None:
        """Compiles all programs for these shapes (or takes them from the cache)."""
        ...

    def __call__(
        self, state: LearnerState, batch: Unrolls, weight: Array
    ) -> tuple[LearnerState, Updated]:
        """Learns from one batch; collective where there are several trainers.

        Args:
          state: of the learner; donated.
          batch: [T, B].
          weight: [B], 0 for unrolls that are too old to learn from; the others weigh alike on
            all trainers, and the mean over all of them is 1.
        """
        ...


def exchange_size(spec: EnvSpec, config: A3cConfig) -> int:
    """Number of float32 that trainers average per minibatch: gradient and parts of the loss."""
    learner = make_learner(spec, config)
    key = jax.eval_shape(lambda: jax.random.key(0))
    state = jax.eval_shape(functools.partial(init_learner, learner, spec.obs_size), key)
    return sum(leaf.size for leaf in jax.tree.leaves(state.params)) + _NUM_LOSSES


class FusedUpdate:
    """The update of a job with one trainer, as one jit."""

    def __init__(self, learner: Learner[A3cConfig]) -> None:
        self._program: Any = jax.jit(
            functools.partial(_fused, learner),
            donate_argnums=(0,),
            out_shardings=_with_weights_at(host_sharding()),
        )

    def compile(self, state: LearnerState, batch: Unrolls, weight: Array) -> None:
        """See `Update`."""
        self._program = self._program.lower(state, batch, weight).compile()

    def __call__(
        self, state: LearnerState, batch: Unrolls, weight: Array
    ) -> tuple[LearnerState, Updated]:
        """See `Update`."""
        return self._program(state, batch, weight)


def _with_weights_at(where: Sharding | None) -> Any:
    """`out_shardings` of a program that returns a state and `Updated`."""
    if where is None:
        return None
    rest: Any = None
    weights: Any = where
    return None, Updated(weights, rest, rest)


def _fused(
    learner: Learner[A3cConfig], state: LearnerState, batch: Unrolls, weight: Array
) -> tuple[LearnerState, Updated]:
    context = begin_batch(learner, state, batch, weight)
    seen = batch_moments(learner, state, batch)
    order = minibatch_order(learner, state, jnp.zeros((), jnp.int32), batch.reward.shape[1])

    def step(
        state: LearnerState, indices: Array
    ) -> tuple[LearnerState, tuple[LossMetrics, Array]]:
        grads, losses = gradients(learner, state.params, batch, context, indices)
        state = apply_gradients(learner, state, grads, losses.steering_kl)
        return state, (losses, state.learning_rate)

    state, (losses, rates) = jax.lax.scan(step, state, order)
    state = finish_batch(state, seen)
    weights = pack_weights(acting_weights(learner, state))
    means = jax.tree.map(jnp.mean, losses)
    return state, Updated(weights, means, rate_figures(learner.config, rates))


class SplitUpdate:
    """The update of one of several trainers: jits around a reducer."""

    def __init__(self, learner: Learner[A3cConfig], obs_size: int, reducer: Reducer) -> None:
        self._learner = learner
        self._obs_size = obs_size
        self._reducer = reducer
        self._rank = np.int32(reducer.rank)
        self._begin: Any = jax.jit(self._begin_fn)
        self._updates = SplitUpdates(learner, reducer, gradients, LossMetrics)
        self._finish: Any = jax.jit(
            self._finish_fn,
            donate_argnums=(0,),
            out_shardings=_with_weights_at(host_sharding()),
        )

    def compile(self, state: LearnerState, batch: Unrolls, weight: Array) -> None:
        """See `Update`."""
        order, context, packed = jax.eval_shape(self._begin_fn, state, batch, weight, self._rank)
        gathered = jax.ShapeDtypeStruct((self._reducer.world_size, *packed.shape), jnp.float32)
        told = self._updates.trace(state, batch, context, order)
        self._begin = self._begin.lower(state, batch, weight, self._rank).compile()
        self._updates.compile()
        self._finish = self._finish.lower(state, gathered, told).compile()

    def __call__(
        self, state: LearnerState, batch: Unrolls, weight: Array
    ) -> tuple[LearnerState, Updated]:
        """See `Update`."""
        batch = jax.device_put(batch)  # Once, and not with every program.
        order, context, packed = self._begin(state, batch, weight, self._rank)
        gathered = np.array(self._reducer.all_gather(np.asarray(packed)))
        state, told = self._updates(state, batch, context, order)
        return self._finish(state, gathered, told)

    def _begin_fn(
        self, state: LearnerState, batch: Unrolls, weight: Array, rank: Array
    ) -> tuple[Array, UpdateContext, Array]:
        order = minibatch_order(self._learner, state, rank, batch.reward.shape[1])
        seen = ravel_pytree(batch_moments(self._learner, state, batch))[0]
        return order, begin_batch(self._learner, state, batch, weight), seen

    def _finish_fn(
        self, state: LearnerState, gathered: Array, told: list[Array]
    ) -> tuple[LearnerState, Updated]:
        unpack = ravel_pytree(no_samples((self._obs_size,)))[1]
        state = finish_batch(state, merge_all(jax.vmap(unpack)(gathered)))
        weights = pack_weights(acting_weights(self._learner, state))
        losses, rates = self._updates.summary(told)
        return state, Updated(weights, losses, rate_figures(self._learner.config, rates))
