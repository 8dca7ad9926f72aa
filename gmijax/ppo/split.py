"""The PPO iteration of one of several GMIs: rollout, gradient and update are jits of their own.

A reducer averages statistics and gradients between them, on the host or on the device.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from gmijax.collectives.interface import FloatBuffer, Reducer, stays_on_device
from gmijax.learner import (
    Learner,
    LearnerState,
    acting_moments,
    apply_gradients,
    gradient_sharding,
    host_sharding,
)
from gmijax.ppo.learner import finish_iteration, gradients, minibatch_order, update_context
from gmijax.ppo.losses import LossMetrics, Samples, UpdateContext
from gmijax.ppo.programs import IterationMetrics, flatten, metrics_of
from gmijax.ppo.rollout import RolloutStats, collect, merge_stats, stats_example
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.types import Array, PyTree

Mean = Callable[[Array], Array | FloatBuffer]
"""From a rank's gradient to the mean of all."""


class SplitIteration:
    """The iteration of one of several GMIs: jits around a reducer."""

    def __init__(self, env: BatchedEnv, learner: Learner, reducer: Reducer) -> None:
        self.times: dict[str, float] = {}
        self._env = env
        self._learner = learner
        self._reducer = reducer
        self._rank = jnp.asarray(reducer.rank, jnp.int32)
        self._rollout: Any = jax.jit(self._rollout_fn, donate_argnums=(2,))
        self._begin: Any = jax.jit(self._begin_fn)
        where = gradient_sharding(reducer)
        self._gradient: Any = jax.jit(self._gradient_fn, out_shardings=where)
        self._update: Any = jax.jit(
            self._update_fn, donate_argnums=(0,), out_shardings=(None, where, None)
        )
        self._apply: Any = jax.jit(self._apply_fn, donate_argnums=(0,))
        host = host_sharding()
        self._finish: Any = jax.jit(
            self._finish_fn, donate_argnums=(0,), out_shardings=(None, host) if host else None
        )

    def trace(self, state: LearnerState, env_state: BatchState) -> None:
        """See `Iteration`."""
        self._rollout = self._rollout.lower(self._env.model, state, env_state, self._rank)
        self.trace_updates(state, *self._rollout.out_info[1:])

    def compile(self) -> None:
        """See `Iteration`."""
        self._rollout = self._rollout.compile()
        self.compile_updates()

    def trace_updates(
        self, state: LearnerState, samples: Samples, order: Any, packed: Any
    ) -> None:
        """Traces all programs but the rollout; the last three arguments may be shapes only."""
        gathered = jax.ShapeDtypeStruct((self._reducer.world_size, *packed.shape), jnp.float32)
        self._begin = self._begin.lower(state, gathered)
        context, stats = self._begin.out_info
        index = jax.ShapeDtypeStruct((), jnp.int32)
        gradient_args = (state.params, samples, order, index, context)
        self._gradient = self._gradient.lower(*gradient_args)
        # Its shape only: it is made in pinned host memory, and comes back from elsewhere.
        buffer = jax.ShapeDtypeStruct(self._gradient.out_info.shape, jnp.float32)
        loss = jax.ShapeDtypeStruct((len(LossMetrics._fields),), jnp.float32)
        self._update = self._update.lower(state, buffer, *gradient_args[1:])
        self._apply = self._apply.lower(state, buffer)
        self._finish = self._finish.lower(state, stats, [loss] * order.shape[0])

    def compile_updates(self) -> None:
        """Compiles what `trace_updates` has traced."""
        self._begin = self._begin.compile()
        self._gradient = self._gradient.compile()
        self._update = self._update.compile()
        self._apply = self._apply.compile()
        self._finish = self._finish.compile()

    def __call__(
        self,
        state: LearnerState,
        env_state: BatchState,
    ) -> tuple[LearnerState, BatchState, IterationMetrics]:
        """See `Iteration`."""
        started = time.monotonic()
        env_state, samples, order, packed = self._rollout(
            self._env.model, state, env_state, self._rank
        )
        mine = np.asarray(packed)  # Waits for the rollout.
        rollout_s = time.monotonic() - started
        state, metrics = self.update(state, samples, order, mine)
        self.times = {"time/rollout_s": rollout_s, **self.times}
        return state, env_state, metrics

    def wait(self) -> None:
        """See `Iteration`; a call returns after the last exchange."""

    def update(
        self, state: LearnerState, samples: Samples, order: Array, mine: FloatBuffer
    ) -> tuple[LearnerState, IterationMetrics]:
        """All updates of an iteration; collective.

        Args:
          state: donated.
          samples: flat, of this rank.
          order: sample indices [epochs * minibatches, B].
          mine: packed statistics of this rank's rollouts.
        """
        context, stats = self._begin(state, np.array(self._reducer.all_gather(mine)))
        started = time.monotonic()
        reduce_s: list[float] = []

        def updates(mean: Mean) -> tuple[LearnerState, list[Array]]:
            return self._updates(mean, state, samples, order, context)

        if stays_on_device(self._reducer):
            state, losses = self._reducer.run_on_device(updates)
            if self._reducer.exchange_s is not None:
                reduce_s.append(self._reducer.exchange_s)
        else:
            state, losses = updates(functools.partial(self._host_mean, reduce_s))
        state, metrics = self._finish(state, stats, losses)
        update_s = time.monotonic() - started
        self.times = {"time/update_s": update_s}
        if reduce_s:
            self.times["time/reduce_s"] = sum(reduce_s)
        return state, metrics

    def _updates(
        self,
        mean: Mean,
        state: LearnerState,
        samples: Samples,
        order: Array,
        context: UpdateContext,
    ) -> tuple[LearnerState, list[Array]]:
        """The new state, and the losses of every minibatch."""
        losses: list[Array] = []
        buffer = self._gradient(state.params, samples, order, np.int32(0), context)
        for index in range(1, order.shape[0]):
            averaged, at = mean(buffer), np.int32(index)
            state, buffer, loss = self._update(state, averaged, samples, order, at, context)
            losses.append(loss)
        state, loss = self._apply(state, mean(buffer))
        return state, [*losses, loss]

    def _host_mean(self, reduce_s: list[float], buffer: Array) -> FloatBuffer:
        """The mean gradient of all GMIs; notes the seconds that the exchange took."""
        mine = np.asarray(buffer)  # Waits for the gradient.
        started = time.monotonic()
        # A copy: the reducer's view is overwritten by the next exchange, which may start
        # before the asynchronous update has read it.
        mean = np.array(self._reducer.mean(mine))
        reduce_s.append(time.monotonic() - started)
        return mean

    def _rollout_fn(
        self, model: PyTree, state: LearnerState, env_state: BatchState, rank: Array
    ) -> tuple[BatchState, Samples, Array, Array]:
        learner = self._learner
        moments = acting_moments(learner, state)
        env_state, samples, stats = collect(
            self._env, learner.networks, learner.config, model, state.params, moments, env_state
        )
        flat = flatten(samples)
        order = minibatch_order(learner, state, rank, flat.advantage.shape[0])
        return env_state, flat, order, ravel_pytree(stats)[0]

    def _begin_fn(
        self, state: LearnerState, gathered: Array
    ) -> tuple[UpdateContext, RolloutStats]:
        stats = merge_stats(jax.vmap(self._unpack_stats)(gathered))
        return update_context(self._learner, state, stats), stats

    def _gradient_fn(
        self, params: PyTree, samples: Samples, order: Array, index: Array, context: UpdateContext
    ) -> Array:
        grads, losses = gradients(self._learner, params, samples, order[index], context)
        return jnp.concatenate([ravel_pytree(grads)[0], jnp.stack(losses)])

    def _apply_fn(self, state: LearnerState, buffer: Array) -> tuple[LearnerState, Array]:
        unravel = ravel_pytree(state.params)[1]
        count = len(LossMetrics._fields)
        gradient, losses = unravel(buffer[:-count]), buffer[-count:]
        return apply_gradients(self._learner, state, gradient, LossMetrics(*losses).kl), losses

    def _update_fn(
        self,
        state: LearnerState,
        buffer: Array,
        samples: Samples,
        order: Array,
        index: Array,
        context: UpdateContext,
    ) -> tuple[LearnerState, Array, Array]:
        # Between two exchanges there is one program, not two: each start of one costs time on
        # the host, and that is most of what a small network's update takes.
        state, losses = self._apply_fn(state, buffer)
        return state, self._gradient_fn(state.params, samples, order, index, context), losses

    def _finish_fn(
        self, state: LearnerState, stats: RolloutStats, losses: list[Array]
    ) -> tuple[LearnerState, IterationMetrics]:
        state = finish_iteration(state, stats)
        means = jnp.mean(jnp.stack(losses), axis=0)
        return state, metrics_of(state, stats, LossMetrics(*means))

    @functools.cached_property
    def _unpack_stats(self) -> Any:
        """[M] float32 to `RolloutStats`, the inverse of the packing in `_rollout_fn`."""
        return ravel_pytree(stats_example(self._env.spec, self._env.overflows))[1]
