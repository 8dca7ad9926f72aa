"""The compiled forms of a PPO iteration: one program, or jits with the host between them."""

from __future__ import annotations

import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from gmijax.collectives.interface import FloatBuffer, Reducer, TracedStep, stays_on_device
from gmijax.devices import host_sharding
from gmijax.learning.learner import TrainState, acting_weights
from gmijax.learning.updates import SplitUpdates, minibatch_order
from gmijax.ppo.ppo import (
    IterationMetrics,
    PpoLearner,
    PpoLosses,
    RolloutStats,
    Samples,
    UpdateContext,
    finish,
    flatten,
    gradients,
    iterate,
    merge_stats,
    no_stats,
    rollout,
    update_context,
)
from gmijax.ppo.tdg_ex import RemoteRollouts
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.types import Array, PyTree


class StepOfOne:
    """The program of a job with one GMI, which has no peers: `TracedStep`."""

    exchange_s = None

    def __init__(self, step: Any) -> None:
        # Metrics lie where the host reads them at once: a copy from the device could only be made
        # after the next iteration, which has been started by then.
        where = host_sharding()
        self._constants: Any = None
        self._program: Any = jax.jit(
            functools.partial(step, None),
            donate_argnums=(1, 2),
            out_shardings=(None, None, where) if where else None,
        )

    def trace(self, constants: Any, shared: Any, own: Any) -> None:
        """See `TracedStep`."""
        self._constants = constants
        self._program = self._program.lower(constants, shared, own)

    def compile(self) -> None:
        """See `TracedStep`."""
        self._program = self._program.compile()

    def __call__(self, shared: Any, own: Any) -> tuple[Any, Any, Any]:
        """See `TracedStep`."""
        return self._program(self._constants, shared, own)

    def wait(self) -> None:
        """See `TracedStep`; there is nobody to wait for."""


class LocalRollouts:
    """Rollouts in this GMI's own environments, as one program."""

    def __init__(self, env: BatchedEnv, learner: PpoLearner, rank: int) -> None:
        self._rank = jnp.asarray(rank, jnp.int32)
        self._model: Any = None
        self._program: Any = jax.jit(
            functools.partial(_packed_rollout, env, learner), donate_argnums=(2,)
        )

    def trace(self, model: PyTree, state: TrainState, env_state: Any) -> tuple[Any, Any, Any]:
        """Traces the program; shapes of the last three results of a call."""
        self._model = model
        self._program = self._program.lower(model, state, env_state, self._rank)
        return self._program.out_info[1:]

    def compile(self) -> None:
        """Compiles what was traced."""
        self._program = self._program.compile()

    def __call__(
        self, state: TrainState, env_state: BatchState
    ) -> tuple[BatchState, Samples, Array, FloatBuffer]:
        """Makes a rollout; `env_state` is donated.

        Returns:
          The environments' state, flat samples, the order of their minibatches
          [epochs * minibatches, B], and packed statistics [M], which are waited for.
        """
        env_state, samples, order, packed = self._program(
            self._model, state, env_state, self._rank
        )
        return env_state, samples, order, np.asarray(packed)


def _packed_rollout(
    env: BatchedEnv,
    learner: PpoLearner,
    model: PyTree,
    state: TrainState,
    env_state: BatchState,
    rank: Array,
) -> tuple[BatchState, Samples, Array, Array]:
    weights = acting_weights(learner, state)
    env_state, samples, stats = rollout(env, learner, model, weights, env_state)
    flat = flatten(samples)
    order = minibatch_order(learner.config, state, rank, flat.advantage.shape[0])
    return env_state, flat, order, ravel_pytree(stats)[0]


class SplitIteration:
    """The iteration of one of several GMIs as jits, with a reducer between them.

    Its methods are those of a `TracedStep`.

    Args:
      env: the environments, or one of those that others step.
      learner: of this GMI.
      reducer: averages statistics and gradients, on the host or on the device.
      rollouts: None for those of `env`.

    Attributes:
      times: seconds that parts of the last iteration took on this GMI; waiting for other GMIs is
        part of an exchange.
    """

    def __init__(
        self,
        env: BatchedEnv,
        learner: PpoLearner,
        reducer: Reducer,
        rollouts: RemoteRollouts | None = None,
    ) -> None:
        self.times: dict[str, float] = {}
        self._learner = learner
        self._reducer = reducer
        self._rollouts: Any = rollouts or LocalRollouts(env, learner, reducer.rank)
        self._unpack_stats = ravel_pytree(no_stats(env.spec, env.overflows))[1]
        self._begin: Any = jax.jit(self._begin_fn)
        self._updates = SplitUpdates(learner, reducer, gradients, PpoLosses)
        host = host_sharding()
        self._finish: Any = jax.jit(
            self._finish_fn, donate_argnums=(0,), out_shardings=(None, host) if host else None
        )

    def trace(self, model: PyTree, state: TrainState, env_state: Any) -> None:
        """See `TracedStep`."""
        samples, order, packed = self._rollouts.trace(model, state, env_state)
        gathered = jax.ShapeDtypeStruct((self._reducer.world_size, *packed.shape), jnp.float32)
        self._begin = self._begin.lower(state, gathered)
        context, stats = self._begin.out_info
        figures = self._updates.trace(state, samples, context, order)
        self._finish = self._finish.lower(state, stats, figures)

    def compile(self) -> None:
        """See `TracedStep`."""
        self._rollouts.compile()
        self._begin = self._begin.compile()
        self._updates.compile()
        self._finish = self._finish.compile()

    def __call__(
        self, state: TrainState, env_state: Any
    ) -> tuple[TrainState, Any, IterationMetrics]:
        """See `TracedStep`."""
        started = time.monotonic()
        env_state, samples, order, packed = self._rollouts(state, env_state)
        rolled_out = time.monotonic()
        gathered = np.array(self._reducer.all_gather(packed))
        context, stats = self._begin(state, gathered)
        updating = time.monotonic()
        state, figures = self._updates(state, samples, context, order)
        state, metrics = self._finish(state, stats, figures)
        self.times = {
            "time/rollout_s": rolled_out - started,
            "time/update_s": time.monotonic() - updating,
        }
        if self._updates.reduce_s is not None:
            self.times["time/reduce_s"] = self._updates.reduce_s
        return state, env_state, metrics

    def wait(self) -> None:
        """See `TracedStep`; a call returns after the last exchange."""

    def _begin_fn(self, state: TrainState, gathered: Array) -> tuple[UpdateContext, RolloutStats]:
        stats = merge_stats(jax.vmap(self._unpack_stats)(gathered))
        return update_context(self._learner, state, stats), stats

    def _finish_fn(
        self, state: TrainState, stats: RolloutStats, figures: list[Array]
    ) -> tuple[TrainState, IterationMetrics]:
        return finish(self._learner, state, stats, *self._updates.summary(figures))


def make_iteration(
    env: BatchedEnv, learner: PpoLearner, reducer: Reducer
) -> TracedStep | SplitIteration:
    """The fastest form that the job's GMIs can run: one program if possible."""
    step = functools.partial(iterate, env, learner)
    if stays_on_device(reducer):
        return reducer.spmd(step) or SplitIteration(env, learner, reducer)
    return StepOfOne(step) if reducer.world_size == 1 else SplitIteration(env, learner, reducer)


def times_of(iteration: TracedStep | SplitIteration) -> dict[str, float]:
    """Seconds of parts of the last iteration, by name, where they are known."""
    if isinstance(iteration, SplitIteration):
        return iteration.times
    return {} if iteration.exchange_s is None else {"time/reduce_s": iteration.exchange_s}
