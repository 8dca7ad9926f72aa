"""Updates of one of several trainers: gradient and step are programs around a reducer.

What the algorithms share where their updates cannot be one program of all trainers.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from gmijax.collectives.interface import FloatBuffer, Reducer, stays_on_device
from gmijax.learner import Learner, LearnerState, apply_gradients, gradient_sharding
from gmijax.policy import ActorCriticParams
from gmijax.types import Array

Gradients: TypeAlias = Callable[[Learner, ActorCriticParams, Any, Any, Array], tuple[Any, Any]]
"""`(learner, params, data, context, indices) -> (gradient, losses)` of a minibatch of `data`;
the losses are a named tuple of [] float32, with a property `steering_kl`."""

Mean: TypeAlias = Callable[[Array], Array | FloatBuffer]
"""From a rank's gradient to the mean of all."""


class SplitUpdates:
    """All updates on one set of data; collective.

    Args:
      learner: of this trainer.
      reducer: among the trainers.
      gradients: see `Gradients`.
      losses: its named tuple.

    Attributes:
      reduce_s: seconds that the exchanges of the last call took, with waits for other trainers;
        None where they cannot be told apart.
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

    def trace(self, state: LearnerState, data: Any, context: Any, order: Any) -> list[Any]:
        """Traces all programs, for arguments that may be shapes only; shapes for `summary`."""
        rest = data, context, order, jax.ShapeDtypeStruct((), jnp.int32)
        self._gradient = self._gradient.lower(state.params, *rest)
        # Its shape only: it is made in pinned host memory, and comes back from elsewhere.
        buffer = jax.ShapeDtypeStruct(self._gradient.out_info.shape, jnp.float32)
        self._update = self._update.lower(state, buffer, *rest)
        self._apply = self._apply.lower(state, buffer)
        told = jax.ShapeDtypeStruct((len(self._losses._fields) + 1,), jnp.float32)
        return [told] * order.shape[0]

    def compile(self) -> None:
        """Compiles what `trace` has traced."""
        self._gradient = self._gradient.compile()
        self._update = self._update.compile()
        self._apply = self._apply.compile()

    def __call__(
        self, state: LearnerState, data: Any, context: Any, order: Array
    ) -> tuple[LearnerState, list[Array]]:
        """The new state, and what every minibatch told, packed; see `summary`.

        Args:
          state: donated.
          data: of this trainer, on its device.
          context: what stays the same in all updates.
          order: indices into `data` [minibatches, b].
        """

        def updates(mean: Mean) -> tuple[LearnerState, list[Array]]:
            return self._updates(mean, state, data, context, order)

        if stays_on_device(self._reducer):
            result = self._reducer.run_on_device(updates)
            self.reduce_s = self._reducer.exchange_s
            return result
        exchanges_s: list[float] = []
        result = updates(functools.partial(self._host_mean, exchanges_s))
        self.reduce_s = sum(exchanges_s)
        return result

    def summary(self, told: list[Array]) -> tuple[Any, Array]:
        """Means of the losses over all minibatches, and the learning rate after each of them."""
        stacked = jnp.stack(told)
        return self._losses(*jnp.mean(stacked[:, :-1], axis=0)), stacked[:, -1]

    def _updates(
        self, mean: Mean, state: LearnerState, data: Any, context: Any, order: Array
    ) -> tuple[LearnerState, list[Array]]:
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

    def _apply_fn(self, state: LearnerState, buffer: Array) -> tuple[LearnerState, Array]:
        unravel, count = ravel_pytree(state.params)[1], len(self._losses._fields)
        gradient, losses = unravel(buffer[:-count]), buffer[-count:]
        kl = self._losses(*losses).steering_kl
        state = apply_gradients(self._learner, state, gradient, kl)
        return state, jnp.append(losses, state.learning_rate)

    def _update_fn(
        self,
        state: LearnerState,
        buffer: Array,
        data: Any,
        context: Any,
        order: Array,
        index: Array,
    ) -> tuple[LearnerState, Array, Array]:
        # Between two exchanges there is one program, not two: each start of one costs time on
        # the host, and that is most of what a small network's update takes.
        state, losses = self._apply_fn(state, buffer)
        return state, self._gradient_fn(state.params, data, context, order, index), losses
