"""Whole episodes with a trained policy: one per environment, nothing learned.

An episode runs in chunks of one compiled program. A world whose episode is over stands still
until the last one has ended, so no automatic reset is needed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from gmijax.learning.learner import Learner, TrainState, acting_weights
from gmijax.learning.unroll import act, unroll
from gmijax.sim.divergence import diverged_by_source, end_diverged
from gmijax.sim.interface import Env, EnvState
from gmijax.sim.wrappers import BatchState, env_keys, select_worlds, training_env, vectorise
from gmijax.types import Array, PyTree

CHUNK_STEPS = 50
"""Steps of the compiled program: at most so many are wasted after the last episode's end."""


class Options(NamedTuple):
    """Options of `run_episodes`.

    Attributes:
      num_envs: N.
      num_shown: E, of how many environments the positions are kept.
      seed: seed of starts and noise.
      deterministic: act with the policy's mean instead of sampling.
      max_steps: where episodes are cut off, None for nowhere.
    """

    num_envs: int
    num_shown: int
    seed: int
    deterministic: bool
    max_steps: int | None


class Episodes(NamedTuple):
    """Outcome of N episodes.

    Attributes:
      returns: [N] undiscounted returns.
      lengths: [N] steps.
      terminated: [N] bool, ended by the task.
      truncated: [N] bool, ended by the time limit; neither means cut off.
      diverged: [N] bool, terminated because of a bad number (see `gmijax.sim.divergence`).
      terms: [N] each, what every reward term added to the returns.
      metrics: [N] each, the task's metrics at the end.
      qpos: [L + 1, E, nq] positions of the first E worlds, from the start to the end of the
        longest of their episodes; L is that episode's length.
      compile_s: seconds until the first step could run.
      run_s: seconds of simulation.
    """

    returns: npt.NDArray[np.float32]
    lengths: npt.NDArray[np.int32]
    terminated: npt.NDArray[np.bool_]
    truncated: npt.NDArray[np.bool_]
    diverged: npt.NDArray[np.bool_]
    terms: dict[str, npt.NDArray[np.float32]]
    metrics: dict[str, npt.NDArray[np.float32]]
    qpos: npt.NDArray[np.float32]
    compile_s: float
    run_s: float


def run_episodes(
    env: Env,
    learner: Learner,
    state: TrainState,
    options: Options,
    on_progress: Callable[[int], None],
) -> Episodes:
    """Runs episodes to their ends.

    Args:
      env: one world, with its time limit.
      learner: the networks.
      state: their weights and the observations' statistics.
      options: how to run, and how many episodes.
      on_progress: called with 0 when the program has been compiled, and with the number of
        chunks of `CHUNK_STEPS` done after every one.
    """
    started = time.monotonic()
    length = env.spec.episode_length
    limit = length if options.max_steps is None else min(options.max_steps, length)
    keys = env_keys(jax.random.key(options.seed), 0, options.num_envs)
    batch = jax.jit(training_env(env).init)(env.model, keys)
    arguments = (env.model, state, jnp.asarray(limit, jnp.int32))
    chunk = jax.jit(partial(_run_chunk, env, learner, options))
    compiled = chunk.lower(*arguments, batch).compile()
    qpos = [np.asarray(_shown_qpos(env, batch.env, options.num_shown))[None]]
    diverged = np.zeros(options.num_envs, bool)
    compile_s = time.monotonic() - started
    on_progress(0)
    for done in range(1, -(-limit // CHUNK_STEPS) + 1):
        batch, moved, bad = compiled(*arguments, batch)
        qpos.append(np.asarray(moved))
        diverged |= np.asarray(bad)
        on_progress(done)
        if not np.asarray(_is_running(batch.env, limit)).any():
            break
    run_s = time.monotonic() - started - compile_s
    lengths = np.asarray(batch.env.steps)
    return Episodes(
        returns=np.asarray(batch.return_sum),
        lengths=lengths,
        terminated=np.asarray(batch.env.terminated),
        truncated=np.asarray(batch.env.truncated),
        diverged=diverged,
        terms={name: np.asarray(sums) for name, sums in batch.term_sums.items()},
        metrics={name: np.asarray(values) for name, values in batch.env.metrics.items()},
        qpos=np.concatenate(qpos)[: int(lengths[: options.num_shown].max()) + 1],
        compile_s=compile_s,
        run_s=run_s,
    )


def _run_chunk(
    env: Env,
    learner: Learner,
    options: Options,
    model: PyTree,
    state: TrainState,
    limit: Array,
    batch: BatchState,
) -> tuple[BatchState, Array, Array]:
    """Moves every world by up to `CHUNK_STEPS`.

    Returns:
      The state, qpos [CHUNK_STEPS, E, nq], and which worlds diverged meanwhile, [N] bool.
    """
    weights = acting_weights(learner, state)
    step_all = vectorise(env).step

    def choose(before: BatchState) -> tuple[BatchState, Array, Array]:
        drawn, output, action = act(learner.networks, weights, before)
        if options.deterministic:
            action = learner.networks.distribution.mode(output)
        return drawn, output, action

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
        kept = select_worlds(running, after, before)
        return kept, (_shown_qpos(env, kept.env, options.num_shown), running & bad)

    stopping: Any = training_env(env)._replace(model=model, step=step)
    batch, (qpos, diverged) = unroll(
        stopping, choose, CHUNK_STEPS, lambda *step: step[-1], model, batch
    )
    return batch, qpos, jnp.any(diverged, axis=0)


def _without_bad_numbers(env: Env, before: EnvState, state: EnvState) -> tuple[EnvState, Array]:
    """Ends diverged worlds as training does, where they last were: they may be filmed."""
    bad = diverged_by_source(env, state)["any"]
    ended = end_diverged(before, state, bad)
    return ended._replace(physics=select_worlds(bad, before.physics, ended.physics)), bad


def _is_running(state: EnvState, limit: Array | int) -> Array:
    return ~(state.terminated | state.truncated) & (state.steps < limit)


def _shown_qpos(env: Env, state: EnvState, num_shown: int) -> Array:
    return jax.vmap(env.qpos)(jax.tree.map(lambda leaf: leaf[:num_shown], state))
