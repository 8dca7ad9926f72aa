"""Whole episodes with a policy: one per environment, nothing learned.

An episode runs in chunks of one compiled program. An environment whose episode is over stands
still until the last one has ended, so no automatic reset is needed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gmijax.compile_once import compile_once
from gmijax.learning.learner import Learner, TrainState, acting_weights
from gmijax.learning.memory import require_memory
from gmijax.learning.unroll import act, unroll
from gmijax.player.outcome import Episodes
from gmijax.sim.divergence import diverged_by_source, end_diverged
from gmijax.sim.interface import Env, EnvState
from gmijax.sim.wrappers import BatchState, env_keys, select_envs, training_env, vectorise
from gmijax.types import Array, PRNGKey, PyTree

CHUNK_STEPS = 50
"""Steps of the compiled program: at most so many are wasted after the last episode's end."""


class EpisodeOptions(NamedTuple):
    """How to run episodes.

    Attributes:
      num_envs: N.
      num_shown: E, of how many environments the positions are kept.
      seed: seed of starts and noise.
      deterministic: act with the policy's mean instead of sampling.
      max_steps: where episodes are cut off, None for nowhere.
      first_env: number of the first environment, from which its random key comes.
      key: the configuration key that sets N, for messages.
    """

    num_envs: int
    num_shown: int
    seed: int
    deterministic: bool
    max_steps: int | None
    first_env: int = 0
    key: str = "num_envs"


class EpisodeRunner:
    """Programs that run episodes to their ends, made once for weights of the same shapes.

    Args:
      env: one environment, with its time limit.
      learner: the networks.
      options: how to run, and how many episodes.
    """

    def __init__(self, env: Env, learner: Learner, options: EpisodeOptions) -> None:
        length, most = env.spec.episode_length, options.max_steps
        self._limit = length if most is None else min(most, length)
        self._model, self._options = env.model, options
        self._keys = env_keys(jax.random.key(options.seed), options.first_env, options.num_envs)
        self._begin: Any = jax.jit(partial(_begin, env, options.num_shown))
        self._chunk: Any = jax.jit(partial(_run_chunk, env, learner, options))
        self._compile_s = 0.0

    def trace(self, state: TrainState) -> None:
        """Traces the programs; `state` has the shapes of those that will be given to `run`.

        Raises:
          ConfigError: so many environments do not fit into memory.
        """
        started = time.monotonic()
        batch, _ = jax.eval_shape(self._begin, self._model, self._keys)
        require_memory(self._options.key, self._options.num_envs, batch)
        self._begin = self._begin.lower(self._model, self._keys)
        self._chunk = self._chunk.lower(self._model, state, self._step_limit(), batch)
        self._compile_s += time.monotonic() - started

    def compile(self) -> None:
        """Compiles what was traced, or takes it from the cache."""
        started = time.monotonic()
        self._begin, self._chunk = compile_once(self._begin), compile_once(self._chunk)
        self._compile_s += time.monotonic() - started

    def run(self, state: TrainState, go_on: Callable[[int, bool], bool]) -> Episodes:
        """Runs an episode in each environment.

        Args:
          state: weights and the observations' statistics.
          go_on: called after every chunk with the number of chunks done, and whether any episode
            still runs; returns whether to run another chunk.
        """
        started = time.monotonic()
        batch, shown = self._begin(self._model, self._keys)
        qpos = [np.asarray(shown)[None]]
        diverged = np.zeros(self._options.num_envs, bool)
        for done in range(1, -(-self._limit // CHUNK_STEPS) + 1):
            batch, moved, bad, running = self._chunk(self._model, state, self._step_limit(), batch)
            qpos.append(np.asarray(moved))
            diverged |= np.asarray(bad)
            if not go_on(done, bool(np.asarray(running).any())):
                break
        lengths = np.asarray(batch.env.steps)
        return Episodes(
            returns=np.asarray(batch.return_sum),
            lengths=lengths,
            terminated=np.asarray(batch.env.terminated),
            truncated=np.asarray(batch.env.truncated),
            diverged=diverged,
            terms={name: np.asarray(sums) for name, sums in batch.term_sums.items()},
            metrics={name: np.asarray(values) for name, values in batch.env.metrics.items()},
            qpos=np.concatenate(qpos)[: int(lengths[: self._options.num_shown].max()) + 1],
            compile_s=self._compile_s,
            run_s=time.monotonic() - started,
        )

    def _step_limit(self) -> Array:
        return jnp.asarray(self._limit, jnp.int32)


def run_episodes(
    env: Env,
    learner: Learner,
    state: TrainState,
    options: EpisodeOptions,
    on_progress: Callable[[int], None],
) -> Episodes:
    """Compiles and runs episodes, once.

    Args:
      env: one environment, with its time limit.
      learner: the networks.
      state: their weights and the observations' statistics.
      options: how to run, and how many episodes.
      on_progress: called with 0 when the program has been compiled, and with the number of
        chunks of `CHUNK_STEPS` done after every one.
    """
    runner = EpisodeRunner(env, learner, options)
    runner.trace(state)
    runner.compile()
    on_progress(0)

    def go_on(chunks: int, running: bool) -> bool:
        on_progress(chunks)
        return running

    return runner.run(state, go_on)


def _begin(env: Env, num_shown: int, model: PyTree, keys: PRNGKey) -> tuple[BatchState, Array]:
    """Environments at their starts, and qpos [E, nq]."""
    batch = training_env(env).init(model, keys)
    return batch, _shown_qpos(env, batch.env, num_shown)


def _run_chunk(
    env: Env,
    learner: Learner,
    options: EpisodeOptions,
    model: PyTree,
    state: TrainState,
    limit: Array,
    batch: BatchState,
) -> tuple[BatchState, Array, Array, Array]:
    """Moves every environment by up to `CHUNK_STEPS`.

    Returns:
      The state, qpos [CHUNK_STEPS, E, nq], which environments diverged meanwhile, and whose
      episodes still run, [N] bool both.
    """
    weights = acting_weights(learner, state)
    step_all = vectorise(env).step

    def choose(before: BatchState) -> tuple[BatchState, Any, Array]:
        after, drawn, action = act(learner.networks, weights, before)
        if options.deterministic:
            action = learner.networks.distribution.mode(drawn.output)
        return after, drawn, action

    def step(model: PyTree, before: BatchState, action: Array) -> tuple[BatchState, Any]:
        moved = step_all(model, before.env, action)
        moved, bad = _without_bad_numbers(env, before.env, moved)
        after = BatchState(
            moved,
            before.return_sum + moved.reward,
            {name: sums + moved.reward_terms[name] for name, sums in before.term_sums.items()},
            before.head_start,
        )
        running = _is_running(before.env, limit)
        # In this order: contacts that all environments share must be those after the step.
        kept = select_envs(~running, before, after)
        return kept, (_shown_qpos(env, kept.env, options.num_shown), running & bad)

    stopping: Any = training_env(env)._replace(model=model, step=step)
    batch, (qpos, diverged) = unroll(
        stopping, choose, CHUNK_STEPS, lambda *step: step[-1], model, batch
    )
    return batch, qpos, jnp.any(diverged, axis=0), _is_running(batch.env, limit)


def _without_bad_numbers(env: Env, before: EnvState, state: EnvState) -> tuple[EnvState, Array]:
    """Ends diverged environments as training does, where they last were: they may be filmed."""
    bad = diverged_by_source(env, state)["any"]
    ended = end_diverged(before, state, bad)
    return ended._replace(physics=select_envs(bad, before.physics, ended.physics)), bad


def _is_running(state: EnvState, limit: Array | int) -> Array:
    return ~(state.terminated | state.truncated) & (state.steps < limit)


def _shown_qpos(env: Env, state: EnvState, num_shown: int) -> Array:
    """Positions [E, ...] as a `Trajectory` has them."""
    shown = jax.tree.map(lambda leaf: leaf[:num_shown], state)
    qpos = jax.vmap(env.qpos)(shown)
    if env.command is None:
        return qpos
    return jnp.concatenate([qpos, jax.vmap(env.command)(shown)], axis=-1)
