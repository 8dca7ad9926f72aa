"""Environment steps per second of simulation alone and of simulation with inference.

With the training rate these are the three columns that Isaac Lab and rl_games report. All GMIs
measure at the same time, because they share the GPU.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from gmijax.collectives.interface import Communicator
from gmijax.compile_once import compile_once
from gmijax.config import TrainConfig
from gmijax.learning.learner import Learner, TrainState, acting_weights
from gmijax.learning.unroll import Drawn, act, unroll
from gmijax.sim.wrappers import BatchedEnv, BatchState, split_keys
from gmijax.types import Array, PyTree

_BLOCKS = 3
_BLOCK_S = 1.0


class ThroughputMeter:
    """Measures both rates; every GMI of the job must use it in the same way."""

    def __init__(
        self, env: BatchedEnv, learner: Learner, config: TrainConfig, comm: Communicator
    ) -> None:
        self._model = env.model
        self._num_envs = config.envs_per_gmi
        self._steps = config.algo.unroll_length
        self._comm = comm
        self._programs: dict[str, Any] = {
            name: jax.jit(partial(_moved, env, choose, self._steps), donate_argnums=(2,))
            for name, choose in (
                ("step_per_s_sim", partial(_random, env)),
                ("step_per_s_inference", partial(_policy, learner)),
            )
        }

    def trace(self, state: TrainState, env_state: BatchState) -> None:
        """Traces both programs; part of the start, whose time limit it needs."""
        for name, program in self._programs.items():
            self._programs[name] = program.lower(self._model, state, env_state)

    def compile(self) -> None:
        """Compiles what was traced."""
        for name, program in self._programs.items():
            self._programs[name] = compile_once(program)

    def measure(
        self, state: TrainState, env_state: BatchState, beat: Callable[[], None]
    ) -> dict[str, float]:
        """Environment steps per second of all GMIs together, by name in the summary.

        `env_state` is donated, `beat` is called after every unroll.
        """
        rates: dict[str, float] = {}
        for name, program in self._programs.items():
            move = partial(program, self._model, state)
            rates[name], env_state = self._rate(move, env_state, beat)
        return rates

    def _rate(
        self,
        move: Callable[[BatchState], BatchState],
        env_state: BatchState,
        beat: Callable[[], None],
    ) -> tuple[float, BatchState]:
        def timed(repeats: int, envs: BatchState) -> tuple[float, BatchState]:
            self._comm.all_gather(np.zeros(1, np.float32))
            started = time.monotonic()
            for _ in range(repeats):
                envs = move(envs)
            jax.block_until_ready(envs)
            seconds = time.monotonic() - started
            beat()
            return seconds, envs

        _, env_state = timed(1, env_state)
        once_s, env_state = timed(1, env_state)
        slowest_s = float(self._comm.all_gather(np.array([once_s], np.float32)).max())
        repeats = max(1, min(1000, round(_BLOCK_S / slowest_s)))
        seconds = []
        for _ in range(_BLOCKS):
            block_s, env_state = timed(repeats, env_state)
            seconds.append(block_s)
        steps = self._num_envs * self._steps * repeats
        mine = np.array([steps / statistics.median(seconds)], np.float32)
        return float(self._comm.all_gather(mine).sum()), env_state


def _moved(
    env: BatchedEnv,
    choose: Callable[[TrainState, BatchState], tuple[BatchState, Any, Array]],
    length: int,
    model: PyTree,
    state: TrainState,
    env_state: BatchState,
) -> BatchState:
    return unroll(env, partial(choose, state), length, lambda *_: None, model, env_state)[0]


def _random(env: BatchedEnv, _: TrainState, envs: BatchState) -> tuple[BatchState, Array, Array]:
    envs, keys = split_keys(envs)
    size = (env.spec.action_size,)
    actions = jax.vmap(lambda k: jax.random.uniform(k, size, minval=-1.0))(keys)
    return envs, actions, actions


def _policy(
    learner: Learner, state: TrainState, envs: BatchState
) -> tuple[BatchState, Drawn, Array]:
    return act(learner.networks, acting_weights(learner, state), envs)
