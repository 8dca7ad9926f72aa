"""The PPO iteration of one of several GMIs: rollout, gradient and update are jits of their own.

A reducer averages statistics and gradients between them, on the host or on the device.
"""

from __future__ import annotations

import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from gmijax.collectives.interface import FloatBuffer, Reducer
from gmijax.host_memory import host_sharding
from gmijax.learner import (
    Learner,
    LearnerState,
    acting_moments,
)
from gmijax.ppo.learner import finish_iteration, gradients, minibatch_order, update_context
from gmijax.ppo.losses import LossMetrics, Samples, UpdateContext
from gmijax.ppo.programs import IterationMetrics, flatten, metrics_of
from gmijax.ppo.rollout import RolloutStats, collect, merge_stats, stats_example
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.split_updates import SplitUpdates
from gmijax.types import Array, PyTree


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
        self._updates = SplitUpdates(learner, reducer, gradients, LossMetrics)
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
        told = self._updates.trace(state, samples, context, order)
        self._finish = self._finish.lower(state, stats, told)

    def compile_updates(self) -> None:
        """Compiles what `trace_updates` has traced."""
        self._begin = self._begin.compile()
        self._updates.compile()
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
        state, told = self._updates(state, samples, context, order)
        state, metrics = self._finish(state, stats, told)
        self.times = {"time/update_s": time.monotonic() - started}
        if self._updates.reduce_s is not None:
            self.times["time/reduce_s"] = self._updates.reduce_s
        return state, metrics

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

    def _finish_fn(
        self, state: LearnerState, stats: RolloutStats, told: list[Array]
    ) -> tuple[LearnerState, IterationMetrics]:
        state = finish_iteration(state, stats)
        return state, metrics_of(self._learner, state, stats, *self._updates.summary(told))

    @functools.cached_property
    def _unpack_stats(self) -> Any:
        """[M] float32 to `RolloutStats`, the inverse of the packing in `_rollout_fn`."""
        return ravel_pytree(stats_example(self._env.spec, self._env.overflows))[1]
