"""PPO with rollouts made in other GMIs than the updates: the template `tdg_ex`.

A trainer sends the weights to the GMIs that serve it, takes their rollouts of T steps, and updates
as a co-located GMI would with all their environments. So m serving GMIs with N environments and
one trainer learn what one GMI with m N does, up to rounding. Everything moves through host
memory, as the paper has it (sec. 5.1, Table 4): experience to the trainer, parameters back.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from gmijax.collectives.interface import Reducer
from gmijax.learner import Learner, LearnerState, acting_moments, init_learner
from gmijax.partition.heartbeat import GmiState
from gmijax.ppo.learner import minibatch_order
from gmijax.ppo.losses import Samples
from gmijax.ppo.programs import IterationMetrics
from gmijax.ppo.rollout import collect, merge_stats, stats_example
from gmijax.ppo.split import SplitIteration
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.types import Array, PyTree


class Mail(Protocol):
    """Messages between GMIs, see `gmijax.collectives.messenger`."""

    def send(self, tree: Any, dst: int) -> None:
        """Sends nested data to GMI `dst`, without waiting for it."""
        ...

    def recv(self, src: int, *, timeout_s: float | None = None) -> Any:
        """Waits for the next message of GMI `src`."""
        ...


class Servants(NamedTuple):
    """The GMIs that make a trainer's rollouts.

    Attributes:
      mail: to them.
      gmis: their ids; their environments stand in this order in the samples.
      start_timeout_s: longest wait for the first rollout: they may still compile.
    """

    mail: Mail
    gmis: tuple[int, ...]
    start_timeout_s: float


class RemoteIteration:
    """The iteration of a trainer whose rollouts are made in other GMIs."""

    def __init__(
        self, env: BatchedEnv, learner: Learner, reducer: Reducer, servants: Servants
    ) -> None:
        self.times: dict[str, float] = {}
        self._env = env
        self._learner = learner
        self._servants = servants
        self._rank = jnp.asarray(reducer.rank, jnp.int32)
        self._updates = SplitIteration(env, learner, reducer)
        self._join: Any = jax.jit(partial(_join, env, learner))
        self._pack: Any = jax.jit(partial(_pack, learner))
        self._first: tuple[list[Samples], list[np.ndarray]] | None = None
        self._timeout_s: float | None = servants.start_timeout_s

    def trace(self, state: LearnerState, env_state: Any) -> None:
        """See `Iteration`; waits for first rollouts, which are used by the first call."""
        del env_state  # There are no environments here.
        self._first = self._ask(state)
        self._timeout_s = None
        arguments = state, *self._first, self._rank
        self._join = self._join.lower(*arguments)
        self._updates.trace_updates(state, *self._join.out_info)

    def compile(self) -> None:
        """See `Iteration`."""
        self._join = self._join.compile()
        self._updates.compile_updates()

    def __call__(
        self, state: LearnerState, env_state: Any
    ) -> tuple[LearnerState, Any, IterationMetrics]:
        """See `Iteration`."""
        started_s = time.monotonic()
        (samples, stats), self._first = self._first or self._ask(state), None
        samples, order, packed = self._join(state, samples, stats, self._rank)
        mine = np.asarray(packed)
        rollout_s = time.monotonic() - started_s
        state, metrics = self._updates.update(state, samples, order, mine)
        self.times = {"time/rollout_s": rollout_s, **self._updates.times}
        return state, env_state, metrics

    def wait(self) -> None:
        """See `Iteration`; a call returns after the last exchange."""

    def close(self) -> None:
        """Tells those that serve to end."""
        for gmi in self._servants.gmis:
            self._servants.mail.send(None, gmi)

    def _ask(self, state: LearnerState) -> tuple[list[Samples], list[np.ndarray]]:
        """Rollouts with the weights of `state`: samples [T, N], packed statistics."""
        mail, gmis = self._servants.mail, self._servants.gmis
        weights = np.asarray(self._pack(state))
        for gmi in gmis:
            mail.send(weights, gmi)
        answers = [mail.recv(gmi, timeout_s=self._timeout_s) for gmi in gmis]
        return [Samples(*samples) for samples, _ in answers], [stats for _, stats in answers]


def serve_rollouts(
    env: BatchedEnv,
    learner: Learner,
    env_state: BatchState,
    mail: Mail,
    trainer: int,
    on_state: Callable[[GmiState, int], None],
) -> int:
    """Makes rollouts for `trainer` until it says that it needs no more; returns how many.

    Args:
      env: the environments.
      learner: networks and hyper-parameters.
      env_state: their state at the start; donated.
      mail: to the trainer.
      trainer: its GMI.
      on_state: told `compiling`, `ready` or `running`, with the number of rollouts made.
    """
    on_state("compiling", 0)
    template = _weights_template(learner, env.spec.obs_size)
    program: Any = jax.jit(partial(_rollout, env, learner, template[1]), donate_argnums=(2,))
    program = program.lower(env.model, template[0], env_state).compile()
    on_state("ready", 0)
    number = 0
    while (weights := _next_weights(mail, trainer, on_state, number)) is not None:
        env_state, samples, packed = program(env.model, weights, env_state)
        mail.send((tuple(map(np.asarray, samples)), np.asarray(packed)), trainer)
        number += 1
    return number


def _next_weights(
    mail: Mail, trainer: int, on_state: Callable[[GmiState, int], None], number: int
) -> np.ndarray | None:
    weights = mail.recv(trainer)
    on_state("running", number)
    return weights


def _weights(learner: Learner, state: LearnerState) -> PyTree:
    return state.params, acting_moments(learner, state)


def _pack(learner: Learner, state: LearnerState) -> Array:
    """Parameters and observation statistics as one array."""
    return ravel_pytree(_weights(learner, state))[0]


def _weights_template(learner: Learner, obs_size: int) -> tuple[np.ndarray, Any]:
    """An array of their length, and what makes the tree of it again."""
    state = init_learner(learner, obs_size, jax.random.key(0))
    flat, unravel = ravel_pytree(_weights(learner, state))
    return np.asarray(flat), unravel


def _rollout(
    env: BatchedEnv,
    learner: Learner,
    unravel: Any,
    model: PyTree,
    weights: Array,
    env_state: BatchState,
) -> tuple[BatchState, Samples, Array]:
    params, moments = unravel(weights)
    env_state, samples, stats = collect(
        env, learner.networks, learner.config, model, params, moments, env_state
    )
    return env_state, samples, ravel_pytree(stats)[0]


def _join(
    env: BatchedEnv,
    learner: Learner,
    state: LearnerState,
    samples: Sequence[Samples],
    stats: Sequence[Array],
    rank: Array,
) -> tuple[Samples, Array, Array]:
    """Flat samples of all environments, the order of minibatches, and packed statistics."""
    together = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=1), *samples)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), together)
    order = minibatch_order(learner, state, rank, flat.advantage.shape[0])
    unpack = ravel_pytree(stats_example(env.spec, env.overflows))[1]
    merged = merge_stats(jax.vmap(unpack)(jnp.stack(stats)))
    return flat, order, ravel_pytree(merged)[0]
