"""Environment steps per second of simulation alone and of simulation with inference.

With the training rate these are the three columns that Isaac Lab and rl_games report. All GMIs
measure at the same time, because they share the GPU.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from gmijax.collectives.interface import Reducer
from gmijax.config import TrainConfig
from gmijax.ppo.learner import Learner, LearnerState, acting_moments
from gmijax.ppo.rollout import act
from gmijax.sim.wrappers import BatchedEnv, BatchState, split_keys
from gmijax.types import Array, PyTree

_BLOCKS = 3
_BLOCK_S = 1.0

Policy = Callable[[BatchState], tuple[BatchState, Array]]


class Throughput(NamedTuple):
    """Environment steps per second of all GMIs together."""

    step_per_s_sim: float
    step_per_s_inference: float


def measure_throughput(
    env: BatchedEnv,
    learner: Learner,
    config: TrainConfig,
    state: LearnerState,
    env_state: BatchState,
    reducer: Reducer,
) -> Throughput:
    """Measures both rates; every GMI of the job must call it. `env_state` is donated."""

    def random_actions(_: LearnerState, envs: BatchState) -> tuple[BatchState, Array]:
        envs, keys = split_keys(envs)
        size = (env.spec.action_size,)
        return envs, jax.vmap(lambda k: jax.random.uniform(k, size, minval=-1.0))(keys)

    def policy_actions(learned: LearnerState, envs: BatchState) -> tuple[BatchState, Array]:
        moments = acting_moments(learner, learned)
        envs, _, action = act(
            learner.networks, learned.params, moments, envs, env.spec.action_size
        )
        return envs, action

    rates = []
    for choose in (random_actions, policy_actions):

        def unroll(
            model: PyTree, learned: LearnerState, envs: BatchState, choose: Any = choose
        ) -> BatchState:
            def step(_: int, envs: BatchState) -> BatchState:
                envs, action = choose(learned, envs)
                return env.step(model, envs, action)[0]

            return jax.lax.fori_loop(0, config.algo.unroll_length, step, envs)

        program = _compile_once(unroll, (env.model, state, env_state), reducer)
        rate, env_state = _rate(program, env.model, state, env_state, config, reducer)
        rates.append(rate)
    return Throughput(*rates)


def _compile_once(function: Any, arguments: tuple[PyTree, ...], reducer: Reducer) -> Any:
    """Compiles on the leader first, so that the others find the program in the cache."""
    lowered = jax.jit(function, donate_argnums=(2,)).lower(*arguments)
    program = lowered.compile() if reducer.rank == 0 else None
    reducer.all_gather(np.zeros(1, np.float32))
    return program or lowered.compile()


def _rate(
    program: Any,
    model: PyTree,
    state: LearnerState,
    env_state: BatchState,
    config: TrainConfig,
    reducer: Reducer,
) -> tuple[float, BatchState]:
    def timed(repeats: int, envs: BatchState) -> tuple[float, BatchState]:
        reducer.all_gather(np.zeros(1, np.float32))
        started = time.monotonic()
        for _ in range(repeats):
            envs = program(model, state, envs)
        jax.block_until_ready(envs)
        return time.monotonic() - started, envs

    _, env_state = timed(1, env_state)
    once_s, env_state = timed(1, env_state)
    slowest_s = float(reducer.all_gather(np.array([once_s], np.float32)).max())
    repeats = max(1, min(1000, round(_BLOCK_S / slowest_s)))
    seconds = []
    for _ in range(_BLOCKS):
        block_s, env_state = timed(repeats, env_state)
        seconds.append(block_s)
    steps = config.num_envs * config.algo.unroll_length * repeats
    mine = np.array([steps / statistics.median(seconds)], np.float32)
    return float(reducer.all_gather(mine).sum()), env_state
