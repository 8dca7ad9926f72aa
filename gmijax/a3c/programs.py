"""The two compiled forms of an update on one batch.

`FusedUpdate`: one trainer, all passes over the batch are one jit with donated state.
`SplitUpdate`: several trainers; gradient and step are jits of their own, and a reducer averages
gradients and statistics between them, on the host or on the device.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
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
    pack_losses,
    pack_weights,
)
from gmijax.a3c.losses import LossMetrics, Unrolls, UpdateContext
from gmijax.collectives.interface import FloatBuffer, Reducer, stays_on_device
from gmijax.config import A3cConfig
from gmijax.learner import (
    Learner,
    LearnerState,
    apply_gradients,
    gradient_sharding,
    host_sharding,
    init_learner,
    make_learner,
)
from gmijax.normalize import merge_all, no_samples
from gmijax.policy import ActorCriticParams
from gmijax.sim.interface import EnvSpec
from gmijax.types import Array

_NUM_LOSSES = len(LossMetrics._fields)


class Updated(NamedTuple):
    """What an update leaves, beside the state.

    Attributes:
      weights: [W] float32, to publish; see `pack_weights`.
      losses: means over all minibatches of all trainers, [] each.
    """

    weights: Array
    losses: LossMetrics


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
          weight: [B], 0 for unrolls that are too old to learn from, else 1.
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
    losses: Any = None
    weights: Any = where
    return None, Updated(weights, losses)


def _fused(
    learner: Learner[A3cConfig], state: LearnerState, batch: Unrolls, weight: Array
) -> tuple[LearnerState, Updated]:
    context = begin_batch(learner, state, batch, weight)
    seen = batch_moments(learner, state, batch)
    order = minibatch_order(learner, state, jnp.zeros((), jnp.int32), batch.reward.shape[1])

    def step(state: LearnerState, indices: Array) -> tuple[LearnerState, LossMetrics]:
        grads, losses = gradients(learner, state.params, batch, context, indices)
        return apply_gradients(learner, state, grads, losses.kl), losses

    state, losses = jax.lax.scan(step, state, order)
    state = finish_batch(state, seen)
    weights = pack_weights(acting_weights(learner, state))
    return state, Updated(weights, jax.tree.map(jnp.mean, losses))


class SplitUpdate:
    """The update of one of several trainers: jits around a reducer."""

    def __init__(self, learner: Learner[A3cConfig], obs_size: int, reducer: Reducer) -> None:
        self._learner = learner
        self._obs_size = obs_size
        self._reducer = reducer
        self._rank = np.int32(reducer.rank)
        where = gradient_sharding(reducer)
        self._begin: Any = jax.jit(self._begin_fn)
        self._gradient: Any = jax.jit(self._gradient_fn, out_shardings=where)
        self._step: Any = jax.jit(
            self._step_fn, donate_argnums=(0,), out_shardings=(None, where, None)
        )
        self._apply: Any = jax.jit(self._apply_fn, donate_argnums=(0,))
        self._finish: Any = jax.jit(
            self._finish_fn,
            donate_argnums=(0,),
            out_shardings=_with_weights_at(host_sharding()),
        )

    def compile(self, state: LearnerState, batch: Unrolls, weight: Array) -> None:
        """See `Update`."""
        order, context, packed = jax.eval_shape(self._begin_fn, state, batch, weight, self._rank)
        gathered = jax.ShapeDtypeStruct((self._reducer.world_size, *packed.shape), jnp.float32)
        index = jax.ShapeDtypeStruct((), jnp.int32)
        rest = (batch, context, order, index)
        buffer = jax.eval_shape(self._gradient_fn, state.params, *rest)
        losses = [jax.ShapeDtypeStruct((_NUM_LOSSES,), jnp.float32)] * order.shape[0]
        self._begin = self._begin.lower(state, batch, weight, self._rank).compile()
        self._gradient = self._gradient.lower(state.params, *rest).compile()
        self._step = self._step.lower(state, buffer, *rest).compile()
        self._apply = self._apply.lower(state, buffer).compile()
        self._finish = self._finish.lower(state, gathered, losses).compile()

    def __call__(
        self, state: LearnerState, batch: Unrolls, weight: Array
    ) -> tuple[LearnerState, Updated]:
        """See `Update`."""
        batch = jax.device_put(batch)  # Once, and not with every program.
        order, context, packed = self._begin(state, batch, weight, self._rank)
        gathered = np.array(self._reducer.all_gather(np.asarray(packed)))

        def steps(mean: Callable[[Array], Array | FloatBuffer]) -> tuple[LearnerState, Any]:
            losses: list[Array] = []
            moved, buffer = state, self._gradient(state.params, batch, context, order, np.int32(0))
            for index in range(1, order.shape[0]):
                rest = batch, context, order, np.int32(index)
                # One program between two exchanges: every start of one costs time on the host.
                moved, buffer, loss = self._step(moved, mean(buffer), *rest)
                losses.append(loss)
            moved, loss = self._apply(moved, mean(buffer))
            return moved, [*losses, loss]

        if stays_on_device(self._reducer):
            moved, losses = self._reducer.run_on_device(steps)
        else:
            moved, losses = steps(self._host_mean)
        return self._finish(moved, gathered, losses)

    def _host_mean(self, buffer: Array) -> FloatBuffer:
        # A copy: the reducer's view is overwritten by the next exchange, which may start
        # before the asynchronous step has read it.
        return np.array(self._reducer.mean(np.asarray(buffer)))

    def _begin_fn(
        self, state: LearnerState, batch: Unrolls, weight: Array, rank: Array
    ) -> tuple[Array, UpdateContext, Array]:
        order = minibatch_order(self._learner, state, rank, batch.reward.shape[1])
        seen = ravel_pytree(batch_moments(self._learner, state, batch))[0]
        return order, begin_batch(self._learner, state, batch, weight), seen

    def _gradient_fn(
        self,
        params: ActorCriticParams,
        batch: Unrolls,
        context: UpdateContext,
        order: Array,
        index: Array,
    ) -> Array:
        grads, losses = gradients(self._learner, params, batch, context, order[index])
        return jnp.concatenate([ravel_pytree(grads)[0], pack_losses(losses)])

    def _step_fn(
        self,
        state: LearnerState,
        buffer: Array,
        batch: Unrolls,
        context: UpdateContext,
        order: Array,
        index: Array,
    ) -> tuple[LearnerState, Array, Array]:
        state, losses = self._apply_fn(state, buffer)
        return state, self._gradient_fn(state.params, batch, context, order, index), losses

    def _apply_fn(self, state: LearnerState, buffer: Array) -> tuple[LearnerState, Array]:
        gradient, losses = buffer[:-_NUM_LOSSES], buffer[-_NUM_LOSSES:]
        unravel = ravel_pytree(state.params)[1]
        kl = LossMetrics(*losses).kl
        return apply_gradients(self._learner, state, unravel(gradient), kl), losses

    def _finish_fn(
        self, state: LearnerState, gathered: Array, losses: list[Array]
    ) -> tuple[LearnerState, Updated]:
        unpack = ravel_pytree(no_samples((self._obs_size,)))[1]
        state = finish_batch(state, merge_all(jax.vmap(unpack)(gathered)))
        weights = pack_weights(acting_weights(self._learner, state))
        return state, Updated(weights, LossMetrics(*jnp.mean(jnp.stack(losses), axis=0)))
