"""PPO with rollouts made in other GMIs than the updates: the template `tdg_ex`.

A trainer sends the weights to the GMIs that serve it, takes their rollouts of T steps, and updates
as a co-located GMI would with all their environments. So m serving GMIs with N environments and
one trainer learn what one GMI with m N does, up to rounding. Everything moves through host
memory, as the paper has it (sec. 5.1, Table 5): experience to the trainer, parameters back.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from gmijax.collectives.interface import Collectives, Communicator, FloatBuffer
from gmijax.compile_once import compile_once
from gmijax.learning.algorithm import IterationMetrics
from gmijax.learning.learner import (
    ActingWeights,
    TrainState,
    acting_weights,
    init_learner,
    pack_weights,
)
from gmijax.ppo.ppo import learn
from gmijax.ppo.rollout import PpoLearner, Samples, rollout
from gmijax.ppo.statistics import merge_stats, no_stats
from gmijax.sim.wrappers import BatchedEnv, BatchState
from gmijax.supervise.heartbeat import GmiState
from gmijax.types import Array, PyTree

if TYPE_CHECKING:
    from gmijax.channels.messenger import Messenger

_Answers: TypeAlias = tuple[list[Samples], list[FloatBuffer]]
"""Of every worker: samples [T, N] and packed statistics."""


class RolloutWorkers(NamedTuple):
    """The GMIs that make a trainer's rollouts.

    Attributes:
      mail: to them.
      gmis: their ids; their environments stand in this order in the samples.
      start_timeout_s: longest wait for the first rollout: they may still compile.
    """

    mail: Messenger
    gmis: tuple[int, ...]
    start_timeout_s: float


class RemoteIteration:
    """An iteration on rollouts that other GMIs make: `TracedStep`; here are no environments."""

    def __init__(
        self, env: BatchedEnv, learner: PpoLearner, comm: Communicator, workers: RolloutWorkers
    ) -> None:
        self._workers = workers
        self._step = comm.program(partial(_learn_from, env, learner), donates_own=False)
        self._pack: Any = jax.jit(lambda state: pack_weights(acting_weights(learner, state)))
        self._first: _Answers | None = None
        self._timeout_s: float | None = workers.start_timeout_s
        self.rollout_s = 0.0

    def times(self) -> dict[str, float]:
        """Seconds of the last rollout and of the wait for it, as they are logged."""
        return {"time/rollout_s": self.rollout_s}

    @property
    def exchange_s(self) -> float | None:
        """See `TracedStep`."""
        return self._step.exchange_s

    def trace(self, constants: Any, shared: TrainState, own: None) -> None:
        """See `TracedStep`; waits for first rollouts, which are used by the first call."""
        del constants, own
        self._first = self._ask(shared)
        self._timeout_s = None
        self._step.trace((), shared, self._first)

    def compile(self) -> None:
        """See `TracedStep`."""
        self._step.compile()

    def __call__(self, shared: TrainState, own: None) -> tuple[TrainState, None, IterationMetrics]:
        """See `TracedStep`."""
        started = time.monotonic()
        answers, self._first = self._first or self._ask(shared), None
        self.rollout_s = time.monotonic() - started
        state, _, metrics = self._step(shared, answers)
        return state, own, metrics

    def wait(self) -> None:
        """See `TracedStep`."""
        self._step.wait()

    def close(self) -> None:
        """Makes the serving GMIs end."""
        for gmi in self._workers.gmis:
            self._workers.mail.send(None, gmi)

    def _ask(self, state: TrainState) -> _Answers:
        """Rollouts with the weights of `state`: samples [T, N], packed statistics."""
        mail, gmis, _ = self._workers
        weights = np.asarray(self._pack(state))
        for gmi in gmis:
            mail.send(weights, gmi)
        answers = [mail.recv(gmi, timeout_s=self._timeout_s) for gmi in gmis]
        return [Samples(*samples) for samples, _ in answers], [stats for _, stats in answers]


def serve_rollouts(
    env: BatchedEnv,
    learner: PpoLearner,
    env_state: BatchState,
    mail: Messenger,
    trainer: int,
    on_state: Callable[[GmiState, int], None],
) -> int:
    """Makes rollouts for `trainer` until it needs no more; returns how many.

    `env_state` is the environments' state at the start and donated; `on_state` is called with
    `compiling`, `ready` or `running`, and the number of rollouts made.
    """
    on_state("compiling", 0)
    state = init_learner(learner, env.spec.obs_size, jax.random.key(0))
    packed, unpack = ravel_pytree(acting_weights(learner, state))
    program: Any = jax.jit(partial(_rollout, env, learner, unpack), donate_argnums=(2,))
    program = compile_once(program.lower(env.model, np.asarray(packed), env_state))
    on_state("ready", 0)
    number = 0
    while (weights := mail.recv(trainer)) is not None:
        on_state("running", number)
        env_state, samples, stats = program(env.model, weights, env_state)
        mail.send((tuple(map(np.asarray, samples)), np.asarray(stats)), trainer)
        number += 1
    return number


def _rollout(
    env: BatchedEnv,
    learner: PpoLearner,
    unpack: Callable[[Array], ActingWeights],
    model: PyTree,
    packed: Array,
    env_state: BatchState,
) -> tuple[BatchState, Samples, Array]:
    env_state, samples, _, stats = rollout(env, learner, model, unpack(packed), env_state)
    return env_state, samples, ravel_pytree(stats)[0]


def _learn_from(
    env: BatchedEnv,
    learner: PpoLearner,
    collectives: Collectives,
    _: Any,
    state: TrainState,
    answers: _Answers,
) -> tuple[TrainState, tuple[()], IterationMetrics]:
    """Updates on the rollouts of several GMIs, whose environments stand one behind the other."""
    samples, packed = answers
    joined = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=1), *samples)
    unpack = ravel_pytree(no_stats(env.spec, env.overflows))[1]
    stats = merge_stats(jax.vmap(unpack)(jnp.stack(packed)))
    state, metrics = learn(learner, collectives, state, joined, stats)
    return state, (), metrics
