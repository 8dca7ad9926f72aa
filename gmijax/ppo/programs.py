"""What a PPO iteration is, and its form as one program with donated state.

That of one GMI, or of several whose exchanges can be part of it. All others split it
(`gmijax.ppo.split`).

Programs hold nothing that depends on a GMI's rank (it is an argument, or looked up by the place
of the device), so that all GMIs share one entry of the compilation cache.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from gmijax.collectives.interface import (
    Peers,
    Reducer,
    TracedStep,
    stays_on_device,
)
from gmijax.config import PpoConfig
from gmijax.host_memory import host_sharding
from gmijax.learner import (
    Learner,
    LearnerState,
    acting_moments,
    apply_gradients,
    init_learner,
    make_learner,
    rate_figures,
)
from gmijax.ppo.learner import finish_iteration, gradients, minibatch_order, update_context
from gmijax.ppo.losses import LossMetrics, Samples
from gmijax.ppo.rollout import RolloutStats, collect, merge_stats
from gmijax.sim.interface import EnvSpec
from gmijax.sim.wrappers import BatchedEnv, BatchState, EpisodeSums
from gmijax.types import Array, PyTree


class IterationMetrics(NamedTuple):
    """What one iteration tells, over all GMIs; leaves are scalars.

    No two of them may be the same number by definition: a GPU's program writes one of these to
    the host and copies it there to the other, for which the host waits until all else is done.

    Attributes:
      episodes: sums over the episodes that ended.
      reward_sum, diverged, overflowed: see `RolloutStats`.
      losses: means over all minibatches of the iteration.
      learning_rate: after the last update.
      rates: of all updates, see `rate_figures`.
      noise_std: mean standard deviation of the policy.
    """

    episodes: EpisodeSums
    reward_sum: Array
    diverged: dict[str, Array]
    overflowed: dict[str, Array]
    losses: LossMetrics
    learning_rate: Array
    rates: dict[str, Array]
    noise_std: Array


class Iteration(Protocol):
    """One PPO iteration: rollout, then updates.

    Attributes:
      times: seconds that parts of the last iteration took on this GMI, where they can be told
        apart; waiting for other GMIs is part of an exchange.
    """

    times: dict[str, float]

    def trace(self, state: LearnerState, env_state: BatchState) -> None:
        """Traces all programs for these shapes; every GMI does that itself, at the same time."""
        ...

    def compile(self) -> None:
        """Compiles what was traced, or takes it from the cache."""
        ...

    def __call__(
        self,
        state: LearnerState,
        env_state: BatchState,
    ) -> tuple[LearnerState, BatchState, IterationMetrics]:
        """Runs one iteration; both states are donated and must not be used again.

        What it returns may still be computed.
        """
        ...

    def wait(self) -> None:
        """Returns when nothing of the last call needs another GMI any more.

        Before its results are read: who reads them would wait for ever for a GMI that died.
        """
        ...


def exchange_size(spec: EnvSpec, config: PpoConfig) -> int:
    """Number of float32 that GMIs average per minibatch: gradient and parts of the loss."""
    learner = make_learner(spec, config)
    key = jax.eval_shape(lambda: jax.random.key(0))
    state = jax.eval_shape(functools.partial(init_learner, learner, spec.obs_size), key)
    return sum(leaf.size for leaf in jax.tree.leaves(state.params)) + len(LossMetrics._fields)


def flatten(samples: Samples) -> Samples:
    """[T, N, ...] to [T * N, ...]."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples)


def metrics_of(
    learner: Learner, state: LearnerState, stats: RolloutStats, losses: LossMetrics, rates: Array
) -> IterationMetrics:
    """What an iteration tells, from its results; `rates` are the learning rates of all updates."""
    std = jnp.mean(jnp.exp(state.params.log_std))
    # Without the moments: they have O numbers each and are of no use in a log.
    return IterationMetrics(
        stats.episodes,
        stats.reward_sum,
        stats.diverged,
        stats.overflowed,
        losses,
        state.learning_rate,
        rate_figures(learner.config, rates),
        std,
    )


class FusedIteration:
    """The iteration of a job with one GMI, as one jit."""

    def __init__(self, env: BatchedEnv, learner: Learner) -> None:
        self.times: dict[str, float] = {}
        self._env = env
        # Metrics lie where the host reads them at once: a copy from the device could only be made
        # after the next iteration, which has been started by then.
        where = host_sharding()
        self._program: Any = jax.jit(
            functools.partial(iterate, env, learner, None),
            donate_argnums=(1, 2),
            out_shardings=(None, None, where) if where else None,
        )

    def trace(self, state: LearnerState, env_state: BatchState) -> None:
        """See `Iteration`."""
        self._program = self._program.lower(self._env.model, state, env_state)

    def compile(self) -> None:
        """See `Iteration`."""
        self._program = self._program.compile()

    def __call__(
        self,
        state: LearnerState,
        env_state: BatchState,
    ) -> tuple[LearnerState, BatchState, IterationMetrics]:
        """See `Iteration`."""
        return self._program(self._env.model, state, env_state)

    def wait(self) -> None:
        """See `Iteration`; there is no other GMI."""


class SpmdIteration:
    """The iteration of several GMIs, as one program on all their GPUs or one of each GMI.

    Args:
      env: this GMI's environments.
      step: `iterate`, as one program.
    """

    def __init__(self, env: BatchedEnv, step: TracedStep) -> None:
        self.times: dict[str, float] = {}
        self._env = env
        self._step = step

    @classmethod
    def if_possible(
        cls, env: BatchedEnv, learner: Learner, reducer: Reducer
    ) -> SpmdIteration | None:
        """The iteration, None where the GMIs cannot run one program together."""
        if not stays_on_device(reducer):
            return None
        step = reducer.spmd(functools.partial(iterate, env, learner))
        return None if step is None else cls(env, step)

    def trace(self, state: LearnerState, env_state: BatchState) -> None:
        """See `Iteration`."""
        self._step.trace(self._env.model, state, env_state)

    def compile(self) -> None:
        """See `Iteration`."""
        self._step.compile()

    def __call__(
        self,
        state: LearnerState,
        env_state: BatchState,
    ) -> tuple[LearnerState, BatchState, IterationMetrics]:
        """See `Iteration`; raises what `TracedStep` raises."""
        stepped = self._step(state, env_state)
        if (reduce_s := self._step.exchange_s) is not None:
            self.times = {"time/reduce_s": reduce_s}
        return stepped

    def wait(self) -> None:
        """See `Iteration`; raises what `TracedStep` raises."""
        self._step.wait()


def iterate(
    env: BatchedEnv,
    learner: Learner,
    peers: Peers | None,
    model: PyTree,
    state: LearnerState,
    env_state: BatchState,
) -> tuple[LearnerState, BatchState, IterationMetrics]:
    """One PPO iteration as a pure function, with the GMIs `peers` if there are others."""
    env_state, samples, stats = collect(
        env,
        learner.networks,
        learner.config,
        model,
        state.params,
        acting_moments(learner, state),
        env_state,
    )
    rank = jnp.zeros((), jnp.int32)
    if peers is not None:
        packed, unpack = ravel_pytree(stats)  # One message, not one for each number.
        rank, stats = peers.rank(), merge_stats(jax.vmap(unpack)(peers.gather(packed)))
    state, losses, rates = learn(learner, peers, state, flatten(samples), stats, rank)
    means = jax.tree.map(jnp.mean, losses)
    return state, env_state, metrics_of(learner, state, stats, means, rates)


def learn(
    learner: Learner,
    peers: Peers | None,
    state: LearnerState,
    samples: Samples,
    stats: RolloutStats,
    rank: Array,
) -> tuple[LearnerState, LossMetrics, Array]:
    """All updates of an iteration, on flat samples; losses and learning rates of all of them."""
    context = update_context(learner, state, stats)
    order = minibatch_order(learner, state, rank, samples.advantage.shape[0])

    def update(
        state: LearnerState, indices: Array
    ) -> tuple[LearnerState, tuple[LossMetrics, Array]]:
        grads, losses = gradients(learner, state.params, samples, context, indices)
        if peers is not None:
            packed, unpack = ravel_pytree((grads, losses))
            grads, losses = unpack(peers.mean(packed))
        state = apply_gradients(learner, state, grads, losses.steering_kl)
        return state, (losses, state.learning_rate)

    state, (losses, rates) = jax.lax.scan(update, state, order)
    return finish_iteration(state, stats), losses, rates
