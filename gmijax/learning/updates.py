"""Updates on minibatches, whatever the loss: in one program, or as programs around a reducer."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Sharding

from gmijax.collectives.interface import FloatBuffer, Peers, Reducer, stays_on_device
from gmijax.config import AlgoConfig
from gmijax.devices import host_sharding
from gmijax.learning.learner import Learner, TrainState, apply_gradients, learner_shapes
from gmijax.learning.policy import ActorCriticParams
from gmijax.sim.interface import EnvSpec
from gmijax.types import Array, PyTree

Gradients: TypeAlias = Callable[[Learner, ActorCriticParams, Any, Any, Array], tuple[Any, Any]]
"""`(learner, params, data, context, indices) -> (gradient, losses)` of a minibatch of `data`;
the losses are a named tuple of [] float32, with a property `steering_kl`."""

Mean: TypeAlias = Callable[[Array], Array | FloatBuffer]
"""From a rank's gradient to the mean of all."""


def minibatch_order(config: AlgoConfig, state: TrainState, rank: Array, size: int) -> Array:
    """Indices [epochs * minibatches, B] into data of length `size`: each once per epoch."""
    key = jax.random.fold_in(jax.random.fold_in(state.key, state.iteration), rank)
    keys = jax.random.split(key, config.num_updates_per_batch)
    order = jax.vmap(lambda k: jax.random.permutation(k, size))(keys)
    return order.reshape(config.num_updates_per_batch * config.num_minibatches, -1)


def exchange_size(spec: EnvSpec, config: AlgoConfig, losses: Any) -> int:
    """P, how many float32 trainers average per minibatch: gradient and parts of the loss."""
    params = learner_shapes(spec, config).params
    return sum(leaf.size for leaf in jax.tree.leaves(params)) + len(losses._fields)


def gradient_sharding(reducer: Reducer) -> Sharding | None:
    """Where a program should put gradients: where the reducer reads them; None for anywhere."""
    return None if stays_on_device(reducer) else host_sharding()


def run_updates(
    learner: Learner,
    peers: Peers | None,
    gradients: Gradients,
    state: TrainState,
    data: PyTree,
    context: Any,
    order: Array,
) -> tuple[TrainState, Any, Array]:
    """All updates on one set of data, within a program of all trainers.

    Args:
      learner: of this trainer.
      peers: the trainers, None if there is only this one.
      gradients: see `Gradients`.
      state: of the learner.
      data: of this trainer.
      context: what stays the same in all updates.
      order: indices into `data` [minibatches, B].

    Returns:
      The new state; losses and learning rates of all updates, with a leading axis.
    """

    def update(state: TrainState, indices: Array) -> tuple[TrainState, tuple[Any, Array]]:
        grads, losses = gradients(learner, state.params, data, context, indices)
        if peers is not None:
            packed, unpack = ravel_pytree((grads, losses))
            grads, losses = unpack(peers.mean(packed))
        state = apply_gradients(learner, state, grads, losses.steering_kl)
        return state, (losses, state.learning_rate)

    state, (losses, rates) = jax.lax.scan(update, state, order)
    return state, losses, rates


class SplitUpdates:
    """All updates on one set of data, where the host comes between; collective.

    Args:
      learner: of this trainer.
      reducer: among the trainers.
      gradients: see `Gradients`.
      losses: its named tuple.

    Attributes:
      reduce_s: seconds that the exchanges of the last call took, with waits for other trainers;
        None where they are not known.
    """

    def __init__(
        self, learner: Learner, reducer: Reducer, gradients: Gradients, losses: Any
    ) -> None:
        self.reduce_s: float | None = None
        self._learner = learner
        self._reducer = reducer
        self._gradients = gradients
        self._losses = losses
        where = gradient_sharding(reducer)
        self._gradient: Any = jax.jit(self._gradient_fn, out_shardings=where)
        self._update: Any = jax.jit(
            self._update_fn, donate_argnums=(0,), out_shardings=(None, where, None)
        )
        self._apply: Any = jax.jit(self._apply_fn, donate_argnums=(0,))

    def trace(self, state: TrainState, data: Any, context: Any, order: Any) -> list[Any]:
        """Traces all programs, for arguments that may be shapes only; shapes for `summary`."""
        rest = data, context, order, jax.ShapeDtypeStruct((), jnp.int32)
        self._gradient = self._gradient.lower(state.params, *rest)
        # Its shape only: it is made in pinned host memory, and comes back from elsewhere.
        buffer = jax.ShapeDtypeStruct(self._gradient.out_info.shape, jnp.float32)
        self._update = self._update.lower(state, buffer, *rest)
        self._apply = self._apply.lower(state, buffer)
        figures = jax.ShapeDtypeStruct((len(self._losses._fields) + 1,), jnp.float32)
        return [figures] * order.shape[0]

    def compile(self) -> None:
        """Compiles what `trace` has traced."""
        self._gradient = self._gradient.compile()
        self._update = self._update.compile()
        self._apply = self._apply.compile()

    def __call__(
        self, state: TrainState, data: Any, context: Any, order: Array
    ) -> tuple[TrainState, list[Array]]:
        """As `run_updates`; the second result is for `summary`, and `state` is donated."""

        def updates(mean: Mean) -> tuple[TrainState, list[Array]]:
            return self._updates(mean, state, data, context, order)

        if stays_on_device(self._reducer):
            result = self._reducer.run_on_device(updates)
            self.reduce_s = self._reducer.exchange_s
            return result
        exchanges_s: list[float] = []
        result = updates(functools.partial(self._host_mean, exchanges_s))
        self.reduce_s = sum(exchanges_s)
        return result

    def summary(self, figures: list[Array]) -> tuple[Any, Array]:
        """Means of the losses over all minibatches, and the learning rate after each of them."""
        stacked = jnp.stack(figures)
        return self._losses(*jnp.mean(stacked[:, :-1], axis=0)), stacked[:, -1]

    def _updates(
        self, mean: Mean, state: TrainState, data: Any, context: Any, order: Array
    ) -> tuple[TrainState, list[Array]]:
        losses: list[Array] = []
        buffer = self._gradient(state.params, data, context, order, np.int32(0))
        for index in range(1, order.shape[0]):
            averaged, at = mean(buffer), np.int32(index)
            state, buffer, loss = self._update(state, averaged, data, context, order, at)
            losses.append(loss)
        state, loss = self._apply(state, mean(buffer))
        return state, [*losses, loss]

    def _host_mean(self, exchanges_s: list[float], buffer: Array) -> FloatBuffer:
        """The mean gradient of all trainers; notes the seconds that the exchange took."""
        mine = np.asarray(buffer)  # Waits for the gradient.
        started = time.monotonic()
        # A copy: the reducer's view is overwritten by the next exchange, which may start
        # before the asynchronous update has read it.
        mean = np.array(self._reducer.mean(mine))
        exchanges_s.append(time.monotonic() - started)
        return mean

    def _gradient_fn(
        self, params: ActorCriticParams, data: Any, context: Any, order: Array, index: Array
    ) -> Array:
        grads, losses = self._gradients(self._learner, params, data, context, order[index])
        return jnp.concatenate([ravel_pytree(grads)[0], jnp.stack(losses)])

    def _apply_fn(self, state: TrainState, buffer: Array) -> tuple[TrainState, Array]:
        unravel, count = ravel_pytree(state.params)[1], len(self._losses._fields)
        gradient, losses = unravel(buffer[:-count]), buffer[-count:]
        kl = self._losses(*losses).steering_kl
        state = apply_gradients(self._learner, state, gradient, kl)
        return state, jnp.append(losses, state.learning_rate)

    def _update_fn(
        self,
        state: TrainState,
        buffer: Array,
        data: Any,
        context: Any,
        order: Array,
        index: Array,
    ) -> tuple[TrainState, Array, Array]:
        # Between two exchanges there is one program, not two: each start of one costs time on
        # the host, and that is most of what a small network's update takes.
        state, losses = self._apply_fn(state, buffer)
        return state, self._gradient_fn(state.params, data, context, order, index), losses
